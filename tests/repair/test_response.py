"""Channel response: conventions, correction, and estimates from simulated and recorded images."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from tests.helpers import kondor_radar
from torchsar.core import Draws, Outcome, Signal
from torchsar.echo import ChannelResponse, apply_impairments, simulate
from torchsar.focus import OmegaK
from torchsar.focus.reference import matched_reference
from torchsar.metrics import error_db
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.repair import (
    CorrectResponse,
    EstimateResponse,
    correct_response,
    estimate_response_points,
    estimate_response_sharpest,
)
from torchsar.repair.response import band_grid, band_power, on_axis, unit_legendre
from torchsar.repair.response_phase import brightest_windows
from torchsar.scene import Dwell, RandomPoints, StripmapWorld


def without_line(phase_rad: torch.Tensor) -> torch.Tensor:
    """Phase (..., GRID) without the constant and linear parts over the band, by least squares."""
    line = unit_legendre(band_grid(), 1)
    line = line / torch.linalg.vector_norm(line, dim=-1, keepdim=True)
    return phase_rad - (phase_rad @ line.mT) @ line


def rms(x: torch.Tensor) -> float:
    return float(x.square().mean().sqrt())


def reference_phase(u: torch.Tensor) -> torch.Tensor:
    """1.2 u^3 + 0.5 sin(6 pi u) without its straight line, which is a displacement."""
    curve = 1.2 * u**3 + 0.5 * torch.sin(6 * math.pi * u)
    slope = 3 * (1.2 / 5 - 0.5 * 2 / (6 * math.pi) / 2)  # 3 times the mean of u * curve over -1..1
    return curve - slope * u


def test_legendre_is_orthonormal_over_the_band():
    basis = unit_legendre(torch.linspace(-1, 1, 20001, dtype=torch.float64), 12)
    torch.testing.assert_close(
        basis @ basis.mT / basis.shape[-1], torch.eye(13, dtype=torch.float64), atol=2e-3, rtol=0
    )


@pytest.fixture(scope="module")
def scene():
    radar = kondor_radar(prf_hz=800.0, integration_s=0.3)
    world = StripmapWorld(RandomPoints(24, 2500.0, 150.0, spread_db=6.0), Dwell(0.3), snr_db=20.0)
    recording, _ = simulate(radar, world, 768, 1280, Draws(5), dtype=torch.complex128)
    return radar, recording


def test_known_response_is_removed_exactly(scene):
    radar, recording = scene
    impaired, truth = apply_impairments(
        recording, {"r": ChannelResponse(reference_phase, lambda u: 10 ** (3 * u / 20))}, Draws(0)
    )
    u = band_grid()
    back = correct_response(
        impaired.signal.data, reference_phase(u), 10 ** (3 * u / 20), radar.pulse.bandwidth_hz / radar.sampling_hz
    )
    assert error_db(back, recording.signal.data) < -60
    assert set(truth) == {"r.phase_rad", "r.amplitude"}


@pytest.mark.slow
def test_the_reference_phase_is_estimated_and_corrected(scene):
    radar, recording = scene
    focus = OmegaK(radar, "flat")
    clean = focus(recording.signal)
    impaired, _ = apply_impairments(recording, {"r": ChannelResponse(reference_phase)}, Draws(0))
    image = focus(impaired.signal)
    found = EstimateResponse(radar)(image)
    assert bool(found.ok) and rms(without_line(found["phase_rad"] - reference_phase(band_grid()))) < 0.06
    repaired = CorrectResponse(radar)(image, found["phase_rad"])
    assert error_db(image, clean) > -10
    assert error_db(repaired, clean) < -22


def test_a_clean_image_is_almost_unchanged(scene):
    radar, recording = scene
    image = OmegaK(radar, "flat")(recording.signal)
    found = EstimateResponse(radar)(image)
    assert error_db(CorrectResponse(radar)(image, found["phase_rad"]), image) < -25


def test_amplitude_against_an_expected_spectrum(scene):
    radar, recording = scene
    focus = OmegaK(radar, "flat")
    clean = focus(recording.signal)
    impaired, _ = apply_impairments(recording, {"r": ChannelResponse(None, lambda u: 10 ** (3 * u / 20))}, Draws(0))
    image = focus(impaired.signal)
    found = EstimateResponse(radar, expected_power=band_power(clean.data))(image)
    repaired = CorrectResponse(radar)(image, torch.zeros_like(found["phase_rad"]), found["amplitude"])
    # the mean gain is no part of the response
    gain = (repaired.data.conj() * clean.data).sum() / repaired.data.abs().square().sum()
    assert error_db(repaired.data * gain, clean) < -25


def test_featureless_images_are_not_ok():
    noise = torch.randn(2, 100, 1400, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    noise[1] = 0
    for found in (
        EstimateResponse(kondor_radar(), estimate_response_points)(_image(noise)),
        EstimateResponse(kondor_radar())(_image(noise)),
    ):
        assert found.failed.tolist() == [True, True]
        assert bool(torch.isfinite(found["phase_rad"]).all()) and rms(found["phase_rad"][1]) == 0


def _image(data: torch.Tensor):
    from torchsar.core import Signal

    radar = kondor_radar()
    return Signal(data, radar.image_axes(radar.raw_axes(*data.shape[-2:])))


def ripple_phase(u: torch.Tensor, ripple: float) -> torch.Tensor:
    return without_line(0.4 * torch.sin(ripple * math.pi * u))


def few_targets(ripple: float) -> tuple[StripmapRadar, Signal]:
    """Four images of twelve targets, with a phase ripple along range."""
    pulse, fs, n = LinearFM(200e6, 1e-6), 250e6, 640
    radar = replace(kondor_radar(), pulse=pulse, sampling_hz=fs)
    generator = torch.Generator().manual_seed(3)
    f = torch.fft.fftfreq(n, dtype=torch.float64)
    at = 80 + 230 * torch.rand(4, 12, 1, dtype=torch.float64, generator=generator)
    echo = (
        torch.polar(torch.ones_like(f), -2 * math.pi * f * at) * pulse.spectrum(n, fs) * matched_reference(pulse, n, fs)
    )
    shape = torch.sinc((torch.arange(72, dtype=torch.float64)[:, None] - 6 * torch.arange(12) - 3) / 1.5)
    u = f * 2 * fs / pulse.bandwidth_hz
    response = torch.polar(torch.ones_like(u), on_axis(ripple_phase(band_grid(), ripple), u))
    image = torch.fft.ifft(shape.to(echo.dtype) @ (echo * response))
    image = image + 0.003 * torch.randn(image.shape, dtype=image.dtype, generator=generator)
    return radar, Signal(image, radar.image_axes(radar.raw_axes(72, n)))


FEW = partial(estimate_response_sharpest, width=128, points=40, orders=(4, 16), passes=2)


@pytest.mark.parametrize("ripple", [3.0, 5.0])
def test_the_deviation_covers_few_targets_and_fine_ripple(ripple):
    radar, image = few_targets(ripple)
    found = EstimateResponse(radar, FEW)(image)
    error = rms(without_line(found["phase_rad"] - ripple_phase(band_grid(), ripple)))
    assert bool(found.ok.all()) and 0.6 < error / rms(found.std["phase_rad"]) < 1.5


@pytest.mark.parametrize("method, ripple", [(FEW, 6.0), (FEW, 9.0), (estimate_response_points, 12.0)])
def test_ripple_finer_than_the_highest_degree_does_not_fit_the_model(method, ripple):
    """Removing what the fit of few targets finds of it is better than leaving it."""
    radar, image = few_targets(ripple)
    found = EstimateResponse(radar, method)(image)
    assert found.outcome.tolist() == [Outcome.MISFIT] * 4
    true = ripple_phase(band_grid(), ripple)
    assert method is not FEW or rms(without_line(found["phase_rad"] - true)) < rms(true)


def test_two_weak_points_that_agree_are_not_ok():
    """The same line twice: both halves find the same phase, which is that of the noise."""
    x = torch.randn(16, 72, 400, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    x[:, 30:42] *= 0.5
    x[:, 30, 200] = 8
    x[:, 40] = x[:, 30]
    x[:, [29, 31, 39, 41]] = 0
    found = FEW(x, 0.8)
    assert found.outcome.tolist() == [Outcome.NOISE] * 16


@pytest.mark.parametrize("method", [FEW, partial(estimate_response_points, points=40)])
def test_without_assessment_the_phase_is_the_same(method, monkeypatch):
    radar, image = few_targets(3.0)
    found = EstimateResponse(radar, method)(image)
    monkeypatch.setattr("torchsar.repair.response_phase.assess_response", None)
    plain = EstimateResponse(radar, method, assess=False)(image)
    assert plain.outcome.tolist() == [Outcome.NOT_ASSESSED] * 4 and not plain.std
    assert torch.equal(plain["phase_rad"], found["phase_rad"])
    assert torch.equal(plain["amplitude"], found["amplitude"])


@pytest.mark.parametrize("method", [FEW, estimate_response_points])
def test_a_trial_gives_alone_what_it_gives_beside_others(method):
    """Also beside a trial without windows, and one whose search ends at another step."""
    radar, image = few_targets(3.0)
    image.data[2] = 0
    image.data[3] += 0.2 * torch.randn(72, 640, dtype=image.data.dtype, generator=torch.Generator().manual_seed(8))
    together = EstimateResponse(radar, method)(image)
    assert together.ok.tolist() == [True, True, False, False]
    for trial in range(4):
        alone = EstimateResponse(radar, method)(image.with_data(image.data[trial]))
        torch.testing.assert_close(alone["phase_rad"], together["phase_rad"][trial], atol=1e-9, rtol=0)
        torch.testing.assert_close(alone.std["phase_rad"], together.std["phase_rad"][trial], atol=1e-9, rtol=1e-6)


def test_the_brightest_maxima_are_apart():
    image = torch.rand(1, 12, 64, generator=torch.Generator().manual_seed(0)).to(torch.complex64)
    windows, line = brightest_windows(image, 5, 16, apart=5)
    size = image[0].abs()
    wanted = [
        (float(size[i, j]), i)
        for i in range(12)
        for j in range(8, 56)
        if size[i, j] == size[max(0, i - 1) : i + 2, max(8, j - 5) : min(56, j + 6)].max()
    ]
    wanted = sorted(wanted, reverse=True)[:5]
    assert line[0].tolist() == [i for _, i in wanted]
    assert windows[0, :, 8].abs().tolist() == [value for value, _ in wanted]
