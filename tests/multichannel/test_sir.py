"""Signal intensity ratio against its printed formulas and by Monte Carlo trials of Table 2."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

from torchsar.core import Signal
from torchsar.multichannel import LeastSquares, MinimumMeanSquare, PointMotion, SignalIntensityRatio
from torchsar.multichannel.response import first_bin
from torchsar.multichannel.velocity.sir import signal_intensity
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar, range_of, time_of

F64 = torch.float64
RADAR = published_radar()
BAND = 337.5
pytestmark = pytest.mark.filterwarnings("ignore:at a pulse rate of")


def decibel(x: torch.Tensor) -> torch.Tensor:
    return 10 * torch.log10(x)


def reference_spectrum(n_pulse: int, u_r: float, gate_s: float | None, bands: int = 3) -> torch.Tensor:
    """Return the spectrum of the middle channel, sampled `bands` times as fast, rising."""
    single = published_radar(prf_hz=180.0 * bands, channel_m=(0.0,))
    time = time_of(single, bands * n_pulse)
    path = range_of(single, time, u_r)[0]
    gate = (time.abs() < gate_s / 2).to(F64) if gate_s else torch.sinc(0.8 / 0.24 * 300 * time / path)
    echo = gate * torch.exp(-2j * math.pi * torch.remainder((path - 5000 + u_r * time) / 0.24, 1))
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(echo)))


def three_bands_of(n_pulse: int, u_r: float, gate_s: float | None) -> torch.Tensor:
    """Return (channel, pulse) by Eq. (35): three bands with the response of Eq. (34), aliased."""
    spectrum = reference_spectrum(n_pulse, u_r, gate_s)
    offset = (torch.arange(3 * n_pulse, dtype=F64) + first_bin(n_pulse, 3)) * 180 / n_pulse
    dx, square = torch.tensor(RADAR.channel_m, dtype=F64)[:, None], 300**2 + u_r**2
    constant = dx**2 - (300 * dx**2 + 2 * 5000 * u_r * dx) * 300 / square
    seen = torch.exp(-2j * math.pi * (constant / (2 * 5000 * 0.24) + (offset + u_r / 0.24) * dx * 300 / square))
    folded = torch.roll((seen * spectrum).unflatten(-1, (3, n_pulse)).sum(-2), first_bin(n_pulse, 3), -1)
    time = torch.arange(n_pulse, dtype=F64) - n_pulse // 2
    return torch.fft.fftshift(torch.fft.ifft(folded), dim=-1) / 3 * torch.exp(2j * math.pi * u_r / 0.24 * time / 180)


def ratios(data: torch.Tensor, u_r: list[float]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    motion = PointMotion.of(RADAR, data, torch.tensor(u_r, dtype=F64))
    found = signal_intensity(data[..., None].expand(len(u_r), *data.shape, 1), RADAR, motion, LeastSquares(3), BAND)
    return found.power_ratio, found.amplitude_ratio, found.ratio


def test_printed_formulas():
    """Eqs. (37), (38) over a spectrum that was not reconstructed.

    The reconstruction of its three bands gives the same spectrum.
    """
    spectrum = reference_spectrum(900, 10.0, 4.5).abs()
    inside = ((torch.arange(2700) + first_bin(900, 3)) * 0.2).abs() <= BAND / 2
    power = (spectrum**2)[inside].sum() / ((spectrum**2).sum() - (spectrum**2)[inside].sum())
    amplitude = (540 - BAND) / BAND * spectrum[inside].sum() / (spectrum.sum() - spectrum[inside].sum())
    found = ratios(three_bands_of(900, 10.0, 4.5), [10.0])
    assert float(found[0][0]) == pytest.approx(float(power), rel=1e-9)
    assert float(found[1][0]) == pytest.approx(float(amplitude), rel=2e-3)  # whole bins
    assert float(found[2][0]) == pytest.approx(float(power * amplitude), rel=2e-3)


@pytest.mark.parametrize(("gate_s", "published"), [(4.5, (24.5, 14.8, 39.2)), (None, (7.3, 4.4, 11.6))])
def test_peaks_over_the_value_at_rest(gate_s, published):
    """Figures of an independent float64 prototype, with three bands and nothing outside them."""
    found = ratios(three_bands_of(3600, 10.0, gate_s), [0.0, 10.0])
    assert [float(decibel(x[1] / x[0])) for x in found] == pytest.approx(published, abs=0.3)


def test_aliasing_from_outside_the_bands_lowers_the_peak():
    """Direct echoes: energy outside three bands aliases through a matrix of condition number 10."""
    direct = ratios(azimuth_echo(RADAR, 3600, 10.0), [0.0, 10.0])
    assert [float(decibel(x[1] / x[0])) for x in direct] == pytest.approx((17.9, 10.1, 28.1), abs=0.2)


def test_the_ratio_has_no_steps():
    """Steps a tenth of a Doppler bin wide, and the slope that autograd gives."""
    data = azimuth_echo(RADAR, 900, 10.0)
    u_r = [9.0 + 0.002 * i for i in range(60)]
    curve = decibel(ratios(data, u_r)[2])
    assert float(curve.diff().abs().max()) < 0.05

    def total(value: torch.Tensor) -> torch.Tensor:
        return signal_intensity(
            data[..., None], RADAR, PointMotion.of(RADAR, data, value), LeastSquares(3), BAND
        ).ratio.log()

    at = torch.tensor(9.0, dtype=F64, requires_grad=True)
    total(at).backward()
    step = 1e-5
    assert at.grad is not None
    assert float(at.grad) == pytest.approx(
        float(total(at.detach() + step) - total(at.detach() - step)) / (2 * step), rel=1e-3
    )


@pytest.mark.parametrize("u_r", [-14.0, 0.0, 10.0])
def test_noise_free_velocity(u_r):
    signal = Signal(azimuth_echo(RADAR, 900, u_r), RADAR.axes(900))
    found = SignalIntensityRatio(RADAR, BAND)(signal)
    assert float(found["u_r_m_s"]) == pytest.approx(u_r, abs=0.07)
    assert bool(found.ok) and float(found.quality) > 0.99
    if u_r == 10:
        assert 9.95 < float(found["u_r_m_s"]) < 10.02


def noisy(radar, trials: int, raw_db: float, seed: int = 1) -> Signal:
    """Return echoes at u_r = 10 m/s in white noise.

    The SNR is that before range compression, 27 dB below that of a sample.
    """
    n = round(5 * radar.prf_hz)
    noise = torch.randn(trials, 3, n, generator=torch.Generator().manual_seed(seed), dtype=torch.complex64)
    return Signal(azimuth_echo(radar, n, 10.0).to(torch.complex64) + 10 ** (-(raw_db + 27) / 20) * noise, radar.axes(n))


# Table 2 of the paper: figures of an independent float64 prototype of the ratio
TABLE = [
    (170.0, -20, 0.25),
    (170.0, -10, 0.08),
    (180.0, -20, 0.40),
    (180.0, -10, 0.05),
    (180.0, 0, 0.04),
    (190.0, -20, 2.0),
    (190.0, 0, 0.03),
]


@pytest.mark.slow
@pytest.mark.parametrize(("prf_hz", "raw_db", "error"), TABLE)
def test_mean_errors_of_the_second_table(prf_hz, raw_db, error):
    radar = published_radar(prf_hz=prf_hz)
    found = SignalIntensityRatio(radar, BAND, search_m_s=(-20.0, 20.0))(noisy(radar, 24, raw_db))
    assert error / 1.8 < float((found["u_r_m_s"] - 10).abs().mean()) < error * 1.8


def test_predicted_std_and_ok():
    """Near the threshold the deviation was 1.6 times too large."""
    found = SignalIntensityRatio(RADAR, BAND, search_m_s=(7.5, 12.5))(noisy(RADAR, 60, -17, seed=3))
    inside = (found["u_r_m_s"] - 10).abs() < 2
    assert bool(inside.double().mean() > 0.98)
    error, std = ((x[inside].square().mean().sqrt()) for x in (found["u_r_m_s"] - 10, found.std["u_r_m_s"]))
    assert 0.75 < float(error / std) < 1.3
    lost = SignalIntensityRatio(RADAR, BAND, search_m_s=(-20.0, 20.0))(noisy(RADAR, 12, -50))
    assert float(lost.ok.to(F64).mean()) < 0.2 and float(lost.quality.mean()) < 0.2


def test_a_second_point_displaces_the_maximum_as_much_as_it_says():
    """A point 10 dB weaker displaced it by 4 predicted deviations in the rms."""
    speed = torch.linspace(-9.0, 9.0, 8, dtype=F64)
    other = (azimuth_echo(RADAR, 900, 7.0 - 2 * i, 3.0 - i, 50.0 - 12 * i) for i in range(8))
    clean = torch.stack([azimuth_echo(RADAR, 900, float(u_r)) for u_r in speed]) + 0.3 * torch.stack(list(other))
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(4), dtype=torch.complex128)
    found = SignalIntensityRatio(RADAR, BAND)(Signal(clean + 0.1 * noise, RADAR.axes(900)))
    error = (found["u_r_m_s"] - speed)[found.ok] / found.std["u_r_m_s"][found.ok]
    assert len(error) >= 6 and float(error.square().mean().sqrt()) < 1.6


def test_a_stationary_scene_biases_the_estimate_to_zero():
    """The error then equals u_r."""
    still = sum(
        (10 * azimuth_echo(RADAR, 900, 0.0, y0=y0) for y0 in (-60.0, -10.0, 25.0, 70.0)),
        torch.zeros(3, 900, dtype=torch.complex128),
    )
    found = SignalIntensityRatio(RADAR, BAND)(Signal(azimuth_echo(RADAR, 900, 10.0) + still, RADAR.axes(900)))
    assert abs(float(found["u_r_m_s"])) < 1


def test_trials_and_lines_are_independent():
    data = torch.stack([azimuth_echo(RADAR, 900, u_r, u_a) for u_r, u_a in ((3.0, 0.0), (-7.0, 5.0))])
    stage, axes = SignalIntensityRatio(RADAR, BAND, step_m_s=1.0), RADAR.axes(900)
    together = stage(
        Signal(data * torch.tensor([1.0, 1e-6])[:, None, None], axes), u_a_m_s=torch.tensor([0.0, 5.0], dtype=F64)
    )
    for i, u_a in enumerate((0.0, 5.0)):
        alone = stage(Signal(data[i], axes), u_a_m_s=u_a)
        assert float(together["u_r_m_s"][i]) == pytest.approx(float(alone["u_r_m_s"]), abs=1e-6)
    lines = torch.stack([data[0], 0 * data[0], 0.5 * data[0]], -1)
    assert float(stage(Signal(lines, RADAR.axes(900, 3)))["u_r_m_s"]) == pytest.approx(
        float(together["u_r_m_s"][0]), abs=1e-3
    )


def test_zero_data_and_the_end_of_the_search_are_not_ok():
    nothing = SignalIntensityRatio(RADAR, BAND, search_m_s=(-5.0, 10.0))(
        Signal(torch.zeros(2, 3, 64, dtype=torch.complex64), RADAR.axes(64))
    )
    assert nothing["u_r_m_s"].tolist() == [2.5, 2.5] and not bool(nothing.ok.any())
    beyond = SignalIntensityRatio(RADAR, BAND, search_m_s=(-5.0, 8.0))(
        Signal(azimuth_echo(RADAR, 900, 12.0), RADAR.axes(900))
    )
    assert not bool(beyond.ok)


def test_refusals_and_warnings():
    with pytest.raises(ValueError, match="leave nothing outside"):
        SignalIntensityRatio(RADAR, 360.0, LeastSquares(2))
    with pytest.raises(ValueError, match="4 Doppler bands"):
        SignalIntensityRatio(RADAR, BAND, LeastSquares(4))
    with pytest.raises(ValueError, match="two steps of step_m_s"):
        SignalIntensityRatio(RADAR, BAND, search_m_s=(3.0, 3.5))
    with pytest.raises(ValueError, match="nearly the same positions"):
        radar = published_radar(prf_hz=187.5)
        SignalIntensityRatio(radar, BAND, search_m_s=(-0.5, 0.5))(Signal(azimuth_echo(radar, 64), radar.axes(64)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prior = SignalIntensityRatio(RADAR, BAND, MinimumMeanSquare(3), search_m_s=(8.0, 12.0))
        assert float(prior(Signal(azimuth_echo(RADAR, 900, 10.0), RADAR.axes(900)))["u_r_m_s"]) == pytest.approx(
            10, abs=0.5
        )
