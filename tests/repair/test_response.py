"""Channel response: conventions, correction, and estimates from simulated and recorded images."""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import kondor_radar
from torchsar.core import Draws
from torchsar.echo import ChannelResponse, apply_impairments, simulate
from torchsar.focus import OmegaK
from torchsar.metrics import error_db
from torchsar.repair import CorrectResponse, EstimateResponse, correct_response, estimate_response_points
from torchsar.repair.response import band_grid, band_power, unit_legendre, without_line
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
