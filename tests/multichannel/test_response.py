"""Channel response and reconstruction weights against the printed equations and tables."""

from __future__ import annotations

import math

import pytest
import torch

from tests.multichannel.profiles import LONG, figures_of, focused, motion_of
from torchsar.multichannel import (
    ElementPattern,
    FlatBand,
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    condition_number,
    doppler_offsets,
    noise_gain_db,
)
from torchsar.multichannel.azimuth import azimuth_filter
from torchsar.multichannel.reconstruct import refuse_channels
from torchsar.multichannel.response import band_matrix, first_bin, shared_response
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar, range_of

F64, C128 = torch.float64, torch.complex128
PRF = (125.0, 160.0, 170.0, 180.0, 185.0, 187.0, 187.5, 190.0, 195.0, 200.0, 250.0)
COND_3 = (1, 2.68, 4.30, 10.2, 30.6, 153, math.inf, 30.6, 10.2, 6.07, 1)
COND_2 = (1, 1.31, 1.37, 1.41, 1.41, 1.41, 1.41, 1.41, 1.41, 1.39, 1)
GAIN_3 = (0, 2.6, 5.5, 12.2, 21.6, 35.5, math.inf, 21.6, 12.2, 8.0, 0)
GAIN_2 = (0, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0)
MOTIONS = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (-20.0, 15.0, 0.0), (10.0, 5.0, 150.0)]


def printed_response(radar, f, u_r=0.0, u_a=0.0, y0=0.0, k1=0.0):
    """Eq. (34) with y0, (channel, f)."""
    dx, v = torch.tensor(radar.channel_m, dtype=F64)[:, None], radar.speed_m_s - u_a
    square, r0, lam = v**2 + u_r**2, radar.reference_range_m, radar.wavelength_m
    constant = dx**2 - (v * dx**2 + 2 * r0 * u_r * dx) * v / square + 2 * y0 * dx * u_r**2 / square
    return torch.exp(-2j * math.pi * ((constant / (2 * r0) + k1 * dx * v / square) / lam + f * dx * v / square))


def printed_27(radar, f, u_r, u_a, k1):
    """The response with the phase of Eq. (27) as printed."""
    dx, v = torch.tensor(radar.channel_m, dtype=F64)[:, None], radar.speed_m_s - u_a
    effective, r0 = (v**2 + u_r**2) / v, radar.reference_range_m
    phase = (dx**2 - (v * dx**2 - 2 * r0 * u_r * dx) / effective) / (2 * r0) + k1 * dx / effective
    return torch.exp(2j * math.pi * (phase / radar.wavelength_m - f * dx / effective))


@pytest.mark.parametrize(("bands", "conditions", "gains"), [(3, COND_3, GAIN_3), (2, COND_2, GAIN_2)])
def test_conditioning_table(bands, conditions, gains):
    for prf, condition, gain in zip(PRF, conditions, gains, strict=True):
        radar = published_radar(prf_hz=prf)
        assert float(condition_number(radar, motion_of(radar), bands)) == pytest.approx(condition, rel=0.01)
        assert float(noise_gain_db(radar, motion_of(radar), LeastSquares(bands))) == pytest.approx(gain, abs=0.06)


def test_the_singular_pulse_rate_moves_with_the_target():
    radar = published_radar()
    u_a = torch.tensor([5.0, 10.0, 11.0, 12.0], dtype=F64)
    found = condition_number(radar, PointMotion.of(radar, u_a, u_a_m_s=u_a), 3)
    assert found.tolist() == pytest.approx([17.2, 59.1, 117.8, math.inf], rel=0.01)
    assert float(
        condition_number(published_radar(prf_hz=187.5, channel_m=(-0.4, 0.4)), motion_of(radar), 2)
    ) == pytest.approx(1, abs=1e-6)
    # five channels half as far apart do not help, unevenly spaced channels do
    five = published_radar(channel_m=(-1.6, -0.8, 0.0, 0.8, 1.6))
    assert float(condition_number(five, motion_of(five, u_a=12.0), 3)) == math.inf
    uneven = published_radar(channel_m=(-0.8, 0.0, 0.75))
    assert [float(condition_number(uneven, motion_of(uneven), n)) for n in (3, 2)] == pytest.approx(
        [5.8, 1.39], rel=0.01
    )
    assert float(condition_number(radar, motion_of(radar), 4)) == math.inf


@pytest.mark.parametrize("move", MOTIONS)
@pytest.mark.parametrize("bands, n", [(2, 60), (3, 61)])
def test_response_is_the_printed_formula(move, bands, n):
    """The product of the shared and the separating part is Eq. (34) in all bands."""
    radar, motion = published_radar(), motion_of(published_radar(), *move)
    alike = shared_response(radar, motion, n, bands, C128)
    matrix = band_matrix(radar, motion, bands)
    found = torch.cat([alike * matrix[:, b, None] for b in range(bands)], -1)
    f = (torch.arange(bands * n, dtype=F64) + first_bin(n, bands)) * 180 / n + move[0] / 0.24
    torch.testing.assert_close(found, printed_response(radar, f, *move), atol=1e-10, rtol=0)


@pytest.mark.parametrize(
    ("move", "worst_rad"),
    [((0.0, 0.0, 0.0), 1e-6), ((10.0, 0.0, 0.0), 0.012), ((20.0, 0.0, 0.0), 0.03), ((10.0, 5.0, 150.0), 0.015)],
)
def test_response_against_exact_ranges(move, worst_rad):
    """R_m(t) = R(t - dx / v_e) + C / (2 R0): residual phase of Eqs. (6), (7)."""
    radar = published_radar()
    u_r, u_a, y0 = move
    t = torch.linspace(-2.25, 2.25, 201, dtype=F64) + y0 / (300 - u_a)
    single, dx, v = published_radar(channel_m=(0.0,)), torch.tensor(radar.channel_m, dtype=F64)[:, None], 300 - u_a
    delay = dx * v / (v**2 + u_r**2)
    late = torch.cat([range_of(single, t - d, *move) for d in delay])
    constant = -torch.angle(printed_response(radar, torch.zeros(1, dtype=F64), *move)) * 0.24 / (2 * math.pi)
    left = torch.remainder((range_of(radar, t, *move) - late - constant) / 0.24 + 0.5, 1) - 0.5
    assert 2 * math.pi * float(left.abs().max()) < worst_rad


def test_34_against_27_with_k1_left_in_the_data():
    """Eq. (34) is right where k1 remains in the data, the printed Eq. (27) is not."""
    k1, u_r = -243.0, 10.0
    radar = published_radar(transmit_range=(k1,))
    data, motion = azimuth_echo(radar, LONG, u_r), motion_of(radar, u_r)
    for rebuild, most in ((LeastSquares(3), -52.0), (LeastSquares(2), -64.0)):
        image = torch.fft.fftshift(
            torch.fft.ifft(
                torch.fft.ifftshift(
                    spectrum_by(printed_34, data, radar, rebuild, u_r, k1) * flat_filter(radar, motion, rebuild)
                )
            )
        )
        own = focused(data, radar, motion, rebuild, left_k1=k1)
        assert figures_of(own, radar, rebuild.bands, u_r).mfta_db < most
        torch.testing.assert_close(own.abs(), image.abs(), atol=1e-7 * float(image.abs().max()), rtol=0)
        wrong = spectrum_by(printed_27, data, radar, rebuild, u_r, k1) * flat_filter(radar, motion, rebuild)
        assert (
            figures_of(
                torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(wrong))), radar, rebuild.bands, u_r
            ).mfta_db
            > -8
        )


def printed_34(radar, f, u_r, u_a, k1):
    return printed_response(radar, f, u_r, u_a, k1=k1)


def spectrum_by(response, data, radar, rebuild, u_r, k1):
    """Eqs. (35), (36) bin by bin with a response (channel, f), about the Doppler centre."""
    n, bands = data.shape[-1], rebuild.bands
    centre = (u_r - k1) / radar.wavelength_m
    t = (torch.arange(n, dtype=F64) - n // 2) / radar.prf_hz
    spectrum = torch.fft.fft(torch.fft.ifftshift(data * torch.exp(-2j * math.pi * centre * t), dim=-1))
    f = (torch.arange(bands * n, dtype=F64) + first_bin(n, bands)) * radar.prf_hz / n + centre
    seen = torch.roll(spectrum, -first_bin(n, bands), -1)
    matrix = response(radar, f, u_r, 0.0, k1).unflatten(-1, (bands, n)).permute(2, 0, 1)
    return (torch.linalg.pinv(matrix) @ seen.T[..., None])[..., 0].T.flatten() * bands


def flat_filter(radar, motion, rebuild):
    offset = doppler_offsets(LONG, rebuild.bands, radar.prf_hz)
    return azimuth_filter(offset, radar, motion, C128) * (offset.abs() <= 337.5 / 2)


@pytest.mark.parametrize("channels", [(-0.8, 0.0, 0.8), (-0.8, 0.0, 0.75), (0.0, 0.9, -0.7, 0.35)])
@pytest.mark.parametrize("bands", [1, 2, 3])
def test_least_squares_is_the_pseudo_inverse(channels, bands):
    radar = published_radar(channel_m=channels, prf_hz=165.0)
    motion = motion_of(radar, 7.0, -3.0)
    weights = LeastSquares(bands).weights(radar, motion, 16)
    torch.testing.assert_close(weights, torch.linalg.pinv(band_matrix(radar, motion, bands)), atol=1e-8, rtol=0)


def test_least_mean_square_error_written_out():
    radar, n, bands, snr = published_radar(), 8, 5, 40.0
    motion = motion_of(radar, 10.0, 5.0)
    weights = MinimumMeanSquare(bands, snr).weights(radar, motion, n)
    matrix = band_matrix(radar, motion, bands)
    for i in range(n):
        offset = [(first_bin(n, bands) + b * n + i) * 180 / n for b in range(bands)]
        pattern = torch.diag(
            torch.tensor(
                [(math.sin(math.pi * x) / (math.pi * x) if x else 1.0) ** 2 for x in (0.8 * f / 295 for f in offset)],
                dtype=C128,
            )
        )
        expected = pattern @ matrix.mH @ torch.linalg.inv(matrix @ pattern @ matrix.mH + 1e-4 * torch.eye(3))
        torch.testing.assert_close(weights[i], expected, atol=1e-9, rtol=0)


def test_least_mean_square_becomes_the_inverse_without_noise():
    radar = published_radar(prf_hz=160.0)
    motion = motion_of(radar, 10.0)
    weights = MinimumMeanSquare(3, 120.0, FlatBand(3 * 160.0 + 1)).weights(radar, motion, 8)
    torch.testing.assert_close(weights, LeastSquares(3).weights(radar, motion, 8).expand(8, 3, 3), atol=1e-6, rtol=0)
    # bands without expected power are zero
    empty = MinimumMeanSquare(3, 40.0, FlatBand(100.0)).weights(radar, motion, 8)
    assert (
        float(empty[:, 0].abs().max()) == 0 == float(empty[:, 2].abs().max()) and float(empty[4, 1].abs().max()) > 0.3
    )


def test_weights_of_trials_and_their_gradients():
    radar = published_radar()
    u_r, u_a = (
        torch.tensor([10.0, -3.0], dtype=F64, requires_grad=True),
        torch.tensor([5.0, -7.0], dtype=F64, requires_grad=True),
    )
    for rebuild in (
        LeastSquares(2),
        LeastSquares(3),
        MinimumMeanSquare(5, 20.0),
        MinimumMeanSquare(2, 20.0, ElementPattern()),
    ):

        def weights(u_r, u_a, rebuild=rebuild):
            return rebuild.weights(radar, PointMotion.of(radar, u_r, u_r, u_a), 4)

        def gain(u_r, u_a, rebuild=rebuild):
            return noise_gain_db(radar, PointMotion.of(radar, u_r, u_r, u_a), rebuild, 4)

        assert torch.autograd.gradcheck(weights, (u_r, u_a)) and torch.autograd.gradcheck(gain, (u_r, u_a))
        # only one of the values has trials
        together = rebuild.weights(radar, PointMotion.of(radar, u_a, 0.0, u_a), 4)
        torch.testing.assert_close(together[1], rebuild.weights(radar, motion_of(radar, 0.0, -7.0), 4))
        torch.testing.assert_close(
            noise_gain_db(radar, PointMotion.of(radar, u_a, 0.0, u_a), rebuild, 4)[1],
            noise_gain_db(radar, motion_of(radar, 0.0, -7.0), rebuild, 4),
        )


def test_singular_weights_stay_finite():
    radar = published_radar()
    u_a = torch.tensor([11.9, 12.0, 12.1], dtype=F64, requires_grad=True)
    weights = LeastSquares(3).weights(radar, PointMotion.of(radar, u_a, 0.0, u_a), 4)
    (slope,) = torch.autograd.grad(weights.abs().sum(), u_a)
    assert bool(torch.isfinite(torch.view_as_real(weights)).all() and torch.isfinite(slope).all())


def test_refusals():
    with pytest.raises(ValueError, match="Doppler bands, at least one, got bands=0"):
        LeastSquares(0)
    with pytest.raises(ValueError, match="within \\+-120 dB, got 130"):
        MinimumMeanSquare(5, 130.0)
    with pytest.raises(ValueError, match="bandwidth_hz of a flat band must be positive, got -1"):
        FlatBand(-1.0)
    with pytest.raises(ValueError, match="300 m/s, as fast as the receiver"):
        motion_of(published_radar(), 0.0, 300.0)
    with pytest.raises(ValueError, match="NaN or Inf in u_r_m_s"):
        motion_of(published_radar(), math.nan)
    sentence = "2 Doppler bands cannot be separated by 1 channel; rebuild at most 1, or give a prior"
    with pytest.raises(ValueError, match=sentence):
        refuse_channels(published_radar(channel_m=(0.0,)), LeastSquares(2))
    refuse_channels(published_radar(channel_m=(0.0,)), MinimumMeanSquare(5))
