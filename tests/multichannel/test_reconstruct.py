"""Reconstructed spectra against those of one channel with a higher PRF, and rejected arguments."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

from tests.multichannel.profiles import motion_of
from torchsar.core import Axis, Signal
from torchsar.multichannel import (
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    Reconstruct,
    reconstruct,
)
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar, range_of, time_of

F64 = torch.float64
quiet = pytest.mark.filterwarnings("ignore:at a pulse rate of")


def smooth_echo(radar, time_s, u_r=0.0, u_a=0.0, y0=0.0, width_s=0.8):
    """(channel, time): a Gaussian amplitude that each channel sees as late as its phases, so that
    no band overflows.
    """
    v = 300 - u_a
    delay = torch.tensor(radar.channel_m, dtype=F64)[:, None] * v / (v**2 + u_r**2)
    amplitude = torch.exp(-(((time_s - y0 / v - delay) / width_s) ** 2))
    return amplitude * torch.exp(
        -2j * math.pi * torch.remainder((range_of(radar, time_s, u_r, u_a, y0) - 5000) / radar.wavelength_m, 1)
    )


def full_band(radar, n, bands, move):
    """Spectrum about the Doppler centre of the reference of the track, sampled at bands * PRF."""
    fast = published_radar(prf_hz=radar.prf_hz * bands, channel_m=(0.0,))
    time = (torch.arange(bands * n, dtype=F64) - bands * n // 2) / fast.prf_hz
    echo = smooth_echo(fast, time, *move)[0] * torch.exp(-2j * math.pi * move[0] / 0.24 * time)
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(echo)))


@quiet
@pytest.mark.parametrize(
    "move", [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (-20.0, 0.0, 0.0), (10.0, 5.0, 150.0), (20.0, 8.0, -80.0)]
)
@pytest.mark.parametrize("n", [900, 901])
@pytest.mark.parametrize(
    "rebuild", [LeastSquares(2), LeastSquares(3), MinimumMeanSquare(4, 60.0)], ids=["two", "three", "prior"]
)
def test_rebuilds_the_spectrum_of_fast_sampling(rebuild, n, move):
    for channels in ((-0.8, 0.0, 0.8), (-0.8, 0.0, 0.75)):
        radar = published_radar(prf_hz=200.0, channel_m=channels)
        found = reconstruct(smooth_echo(radar, time_of(radar, n), *move), radar, motion_of(radar, *move), rebuild)
        expected = full_band(radar, n, rebuild.bands, move)
        assert float((found - expected).norm() / expected.norm()) < (
            0.025 if isinstance(rebuild, LeastSquares) else 0.05
        )


def test_one_channel_and_one_band():
    radar = published_radar(channel_m=(0.0,), prf_hz=400.0)
    found = Reconstruct(radar, LeastSquares(1))(
        Signal(smooth_echo(radar, time_of(radar, 1600), 10.0), radar.axes(1600)), u_r_m_s=10.0
    ).data
    torch.testing.assert_close(found, full_band(radar, 1600, 1, (10.0, 0.0, 0.0)), atol=1e-6, rtol=0)


@quiet
@pytest.mark.parametrize("name", ["u_r_m_s", "u_a_m_s", "y0_m"])
@pytest.mark.parametrize(
    "rebuild", [LeastSquares(2), LeastSquares(3), MinimumMeanSquare()], ids=["two", "three", "prior"]
)
def test_trials_with_one_value_each(rebuild, name):
    """Any of the values alone may have trials."""
    radar, values = published_radar(), torch.tensor([3.0, -8.0], dtype=F64)
    data = torch.randn(2, 3, 64, dtype=torch.complex128)
    stage = Reconstruct(radar, rebuild)
    together = stage(Signal(data, radar.axes(64)), **{name: values}).data
    for i in range(2):
        torch.testing.assert_close(
            together[i], stage(Signal(data[i], radar.axes(64)), **{name: float(values[i])}).data, atol=1e-9, rtol=0
        )


@quiet
def test_range_lines_are_rebuilt_one_by_one():
    radar, data = published_radar(), torch.randn(2, 3, 50, 6, dtype=torch.complex128)
    motion = PointMotion.of(radar, data, torch.tensor([3.0, -8.0], dtype=F64))
    for rebuild in (LeastSquares(2), MinimumMeanSquare()):
        together = reconstruct(data, radar, motion, rebuild, with_range=True)
        torch.testing.assert_close(
            together[..., 4], reconstruct(data[..., 4], radar, motion, rebuild), atol=1e-10, rtol=0
        )
        out = Reconstruct(radar, rebuild)(Signal(data, radar.axes(50, 6)), u_r_m_s=motion.u_r_m_s)
        assert out.names == ("doppler", "range") and torch.equal(out.data, together)


def test_axis_counts_doppler_from_the_centre():
    radar = published_radar()
    for n in (64, 65):
        doppler = Reconstruct(radar)(Signal(torch.randn(3, n, dtype=torch.complex64), radar.axes(n))).axis("doppler")
        values = doppler.values()
        assert (doppler.n, float(values[n]), doppler.step) == (2 * n, 0.0, pytest.approx(180 / n))
        assert doppler.dual().values()[n] == pytest.approx(0, abs=1e-12)


def test_gradients():
    radar = published_radar()
    data = torch.randn(2, 3, 6, dtype=torch.complex128, requires_grad=True)
    values = [torch.tensor(x, dtype=F64, requires_grad=True) for x in ([3.0, -5.0], [1.0, 2.0], [10.0, 30.0])]

    def power(data, u_r, u_a, y0, rebuild):
        return reconstruct(data, radar, PointMotion.of(radar, data, u_r, u_a, y0), rebuild)

    for rebuild in (LeastSquares(2), MinimumMeanSquare(4, 20.0)):
        assert torch.autograd.gradcheck(lambda d, a, b, c, r=rebuild: power(d, a, b, c, r), (data, *values))


def test_single_precision_agrees():
    radar = published_radar()
    data = azimuth_echo(radar, 900, 10.0)
    for bands, most_db in ((2, -125), (3, -115)):
        double, single = (
            reconstruct(x, radar, motion_of(radar, 10.0), LeastSquares(bands)) for x in (data, data.to(torch.complex64))
        )
        assert single.dtype == torch.complex64
        assert 20 * math.log10(float((single - double).norm() / double.norm())) < most_db


@pytest.mark.parametrize(("prf", "u_a"), [(187.5, 0.0), (180.0, 12.0)])
def test_channels_at_the_same_positions_are_rejected(prf, u_a):
    radar = published_radar(prf_hz=prf)
    signal = Signal(azimuth_echo(radar, 90), radar.axes(90))
    with pytest.raises(
        ValueError,
        match=(
            f"pulse rate of {prf:g} Hz and a speed past the target of {300 - u_a:g} m/s .* 3 bands cannot be separated"
        ),
    ):
        Reconstruct(radar, LeastSquares(3))(signal, u_a_m_s=u_a)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # two bands or a prior are well conditioned
        for rebuild in (LeastSquares(2), MinimumMeanSquare()):
            assert bool(torch.isfinite(Reconstruct(radar, rebuild)(signal, u_a_m_s=u_a).data.abs()).all())


def test_a_search_crosses_the_singular_speed():
    radar = published_radar()
    u_a = torch.linspace(11.0, 13.0, 21, dtype=F64, requires_grad=True)
    signal = Signal(azimuth_echo(radar, 90).expand(21, 3, 90), radar.axes(90))
    with pytest.warns(UserWarning, match="condition number inf.*noise and errors of the velocity grow"):
        data = Reconstruct(radar, LeastSquares(3))(signal, u_a_m_s=u_a).data
    (slope,) = torch.autograd.grad(data.abs().square().sum(), u_a)
    assert bool(torch.isfinite(data.abs()).all() and torch.isfinite(slope).all())


def test_a_poor_inverse_is_rejected_in_single_precision_first():
    radar, data = published_radar(), torch.randn(3, 90, dtype=torch.complex128)
    with pytest.warns(UserWarning, match="condition number 1.1[78]e\\+05"):
        Reconstruct(radar, LeastSquares(3))(Signal(data, radar.axes(90)), u_a_m_s=11.999)
    with pytest.raises(ValueError, match="cannot be separated"):
        Reconstruct(radar, LeastSquares(3))(Signal(data.to(torch.complex64), radar.axes(90)), u_a_m_s=11.999)


def test_refusals():
    radar = published_radar()
    with pytest.raises(ValueError, match="4 Doppler bands cannot be separated by 3 channels"):
        Reconstruct(radar, LeastSquares(4))
    with pytest.raises(ValueError, match="3 positions in the radar.* got the shape .2, 8."):
        Reconstruct(radar)(
            Signal(torch.ones(2, 8, dtype=torch.complex64), published_radar(channel_m=(0.0, 1.0)).axes(8))
        )
    channel, pulse = radar.axes(90)
    with pytest.raises(ValueError, match="slow time must be zero at pulse 40 of 80"):
        Reconstruct(radar)(
            Signal(torch.ones(3, 80, dtype=torch.complex64), (channel, Axis("pulse", 80, pulse.start, pulse.step, "s")))
        )
    signal = Signal(torch.ones(3, 90, dtype=torch.complex64), radar.axes(90))
    for name in ("u_r_m_s", "u_a_m_s", "y0_m"):
        with pytest.raises(ValueError, match=f"{name}: 1 of 1 values are NaN or Inf"):
            Reconstruct(radar)(signal, **{name: math.nan})
    with pytest.raises(ValueError, match="closest range of a point must be positive, got range_m=0"):
        Reconstruct(radar, range_m=0.0)(signal)
