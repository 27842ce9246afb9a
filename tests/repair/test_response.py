"""Channel response: conventions, correction, and estimates from simulated and recorded images."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from tests.helpers import kondor_radar
from torchsar.core import Draws, Signal
from torchsar.echo import ChannelResponse, apply_impairments, simulate
from torchsar.focus import OmegaK
from torchsar.focus.reference import matched_reference
from torchsar.metrics import error_db
from torchsar.radar import LinearFM
from torchsar.repair import (
    CorrectResponse,
    EstimateResponse,
    correct_response,
    estimate_response_points,
    estimate_response_sharpest,
)
from torchsar.repair.response import band_grid, band_power, on_axis, unit_legendre, without_line
from torchsar.scene import Dwell, RandomPoints, StripmapWorld


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


def test_constant_and_linear_phase_are_removed():
    u = band_grid()
    assert rms(without_line(0.7 + 2.3 * u)) < 1e-12
    assert rms(without_line(reference_phase(u)) - reference_phase(u)) < 5e-3


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
        assert not bool(found.ok[1])
        assert bool(torch.isfinite(found["phase_rad"]).all()) and rms(found["phase_rad"][1]) == 0


def _image(data: torch.Tensor):
    from torchsar.core import Signal

    radar = kondor_radar()
    return Signal(data, radar.image_axes(radar.raw_axes(*data.shape[-2:])))


@pytest.mark.parametrize("ripple, most", [(3.0, 1.5), (6.0, 2.0)])
def test_the_deviation_covers_few_targets_the_edges_of_the_pulse_and_fine_ripple(ripple, most):
    radar = kondor_radar()
    pulse, fs, n = LinearFM(200e6, 1e-6), 250e6, 640
    radar = replace(radar, pulse=pulse, sampling_hz=fs)
    generator = torch.Generator().manual_seed(3)
    f = torch.fft.fftfreq(n, dtype=torch.float64)
    at = 80 + 230 * torch.rand(4, 12, 1, dtype=torch.float64, generator=generator)
    echo = (
        torch.polar(torch.ones_like(f), -2 * math.pi * f * at) * pulse.spectrum(n, fs) * matched_reference(pulse, n, fs)
    )
    shape = torch.sinc((torch.arange(72, dtype=torch.float64)[:, None] - 6 * torch.arange(12) - 3) / 1.5)

    def phase(u):
        return without_line(0.4 * torch.sin(ripple * math.pi * u))

    u = f * 2 * fs / pulse.bandwidth_hz
    response = torch.polar(torch.ones_like(u), on_axis(phase(band_grid()), u))
    image = torch.fft.ifft(shape.to(echo.dtype) @ (echo * response))
    image = image + 0.003 * torch.randn(image.shape, dtype=image.dtype, generator=generator)
    found = EstimateResponse(
        radar, partial(estimate_response_sharpest, width=128, points=40, orders=(4, 16), passes=2)
    )(Signal(image, radar.image_axes(radar.raw_axes(72, n))))
    error = rms(without_line(found["phase_rad"] - phase(band_grid())))
    assert not bool(found.ok.all()) or 0.6 < error / rms(found.std["phase_rad"]) < most
