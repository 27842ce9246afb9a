"""Focused points against direct evaluation: position and phase over the swath at several squints,
precision, and requirements.
"""

from __future__ import annotations

import functools
import importlib
import math
from dataclasses import replace

import pytest
import torch

from tests.focus import helpers
from tests.helpers import small_radar, small_recording
from torchsar.focus import (
    OmegaK,
    StoredOmegaK,
    backproject_strip,
    omega_k,
    omega_k_stolt,
    range_doppler,
    requirements,
)
from torchsar.focus.requirements import Aperture
from torchsar.focus.stored_omega_k import InvertibleOmegaK
from torchsar.metrics import error_db

CASES = {
    "kondor": functools.lru_cache(lambda: helpers.kondor_case()),
    "kondor_squint": functools.lru_cache(lambda: helpers.kondor_case(0.3)),
    "radarsat": functools.lru_cache(lambda: helpers.radarsat_case()),
    "airborne": functools.lru_cache(lambda: helpers.airborne_case()),
    "airborne_squint": functools.lru_cache(lambda: helpers.airborne_case(60.0)),
}


@functools.cache
def image_of(form, name):
    """Image of a case in complex128."""
    case = CASES[name]()
    return form(case.raw, case.radar, **case.arguments)


@pytest.fixture(autouse=True, scope="module")
def _images_are_dropped():
    yield
    image_of.cache_clear()
    helpers.spectrum_of.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_stolt_is_exact_over_the_swath(name):
    case = CASES[name]()
    image = image_of(omega_k_stolt, name)
    for cell in case.cells:
        assert abs(helpers.phase_error_deg(image, case, cell)) < 1
        assert max(abs(x) for x in helpers.peak_offset(image, case.line, cell)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kondor", "kondor_squint", "radarsat"])
def test_bulk_and_refocus_is_enough_from_orbit(name):
    case = CASES[name]()
    image = image_of(omega_k, name)
    for cell in case.cells:
        assert abs(helpers.phase_error_deg(image, case, cell)) < 1
        assert max(abs(x) for x in helpers.peak_offset(image, case.line, cell)) < 0.05


def test_bulk_and_refocus_displaces_where_the_requirements_predict_it():
    case = CASES["airborne"]()
    image = image_of(omega_k, "airborne")
    rows = requirements(case.radar, case.radar.raw_axes(*case.raw.shape), 0.0, integration_s=3.0)
    assert not rows[0].ok
    assert max(abs(x) for x in helpers.peak_offset(image, case.line, case.cells[0])) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kondor_squint", "airborne_squint"])
def test_backprojection_agrees_with_stolt_in_phase_and_shape(name):
    case = CASES[name]()
    stolt = omega_k_stolt(case.raw, case.radar, **case.arguments, eps=1e-9)
    x = (torch.arange(-4, 5, dtype=torch.float64) + case.line) / case.radar.prf_hz * case.radar.velocity_m_s
    for cell in (case.cells[0], case.cells[-1]):
        cells = torch.arange(-4, 5, dtype=torch.float64) + round(cell)
        patch = backproject_strip(
            case.raw,
            case.radar,
            x[:, None],
            case.radar.near_range_m + cells * case.radar.range_step_m,
            **case.arguments,
        )
        other = stolt[case.line - 4 : case.line + 5, round(cell) - 4 : round(cell) + 5]
        gain = (patch * other.conj()).sum() / other.abs().square().sum()
        # amplitudes follow different laws of the stationary phase; the phases are the same
        assert abs(math.degrees(math.atan2(float(gain.imag), float(gain.real)))) < 0.5
        assert error_db(gain * other, patch) < -30


@pytest.mark.slow
def test_range_doppler_is_a_baseline_without_squint_only():
    straight, squinted = CASES["kondor"](), CASES["kondor_squint"]()
    image = image_of(range_doppler, "kondor")
    assert max(abs(x) for cell in straight.cells for x in helpers.peak_offset(image, straight.line, cell)) < 0.02
    image = image_of(range_doppler, "kondor_squint")
    assert abs(helpers.peak_offset(image, squinted.line, squinted.cells[1])[0]) > 0.3
    rows = requirements(
        squinted.radar,
        squinted.radar.raw_axes(*squinted.raw.shape),
        squinted.arguments["doppler_hz"],
        integration_s=0.6,
    )
    assert rows[0].ok and not rows[1].ok


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kondor_squint", "radarsat"])
@pytest.mark.parametrize("form", [omega_k, omega_k_stolt, range_doppler])
def test_complex64_image_is_the_complex128_image(name, form):
    case = CASES[name]()
    finer = {} if form is omega_k else {"eps": 1e-7}  # a power series replaces interpolation in complex64
    double = form(case.raw, case.radar, **case.arguments, **finer)
    single = form(case.raw.to(torch.complex64), case.radar, **case.arguments)
    assert single.dtype == torch.complex64
    assert error_db(single.to(torch.complex128), double) < -90


def exact_patch(name, lines, cells):
    """Part of the exact image: backprojected at 7 km, Stolt from orbit, where the band of a target
    fills more lines.
    """
    case = CASES[name]()
    if name == "airborne":
        x = lines.double() / case.radar.prf_hz * case.radar.velocity_m_s
        r = case.radar.near_range_m + cells.double() * case.radar.range_step_m
        return backproject_strip(case.raw, case.radar, x[:, None], r, **case.arguments, eps=1e-5)
    return image_of(omega_k_stolt, name)[lines][:, cells]


@pytest.mark.slow
@pytest.mark.parametrize("name, dwell_s", [("airborne", 3.0), ("kondor_squint", 0.6)])
def test_predicted_phase_of_bulk_and_refocus_is_the_measured_one(name, dwell_s):
    """Spectra of the bulk + refocus and the exact response of a target at the edge of the swath,
    compared over the inner band.
    """
    case = CASES[name]()
    edge, doppler_hz = case.cells[0], case.arguments["doppler_hz"]
    offset_m = (edge - case.raw.shape[1] // 2) * case.radar.range_step_m
    lines, cells = torch.arange(case.line - 64, case.line + 64), torch.arange(round(edge) - 32, round(edge) + 32)
    window = torch.hann_window(128, periodic=False, dtype=torch.float64)[:, None] * torch.hann_window(
        64, periodic=False, dtype=torch.float64
    )
    bulk = image_of(omega_k, name)[lines][:, cells]
    ratio = torch.fft.fft2(bulk * window) * torch.fft.fft2(exact_patch(name, lines, cells) * window).conj()
    doppler, frequency = case.radar.doppler_hz(128, doppler_hz), case.radar.range_frequency_hz(64)
    whole = Aperture.of(case.radar, case.radar.near_range_m, doppler_hz, case.radar.velocity_m_s, doppler_hz, dwell_s)
    rows, columns = (
        (doppler - doppler_hz).abs() < 0.4 * whole.doppler_band_hz,
        frequency.abs() < 0.4 * case.radar.pulse.bandwidth_hz,
    )
    inner = replace(whole, at=replace(whole.at, doppler_hz=doppler[rows]), frequency_hz=frequency[columns])
    predicted = inner.bulk_residual_rad(offset_m)
    # bulk + refocus leaves exp(-j phase) on the spectrum of the target
    measured = -torch.angle(ratio[rows][:, columns])
    assert float((measured - predicted).abs().max()) < 0.03 + 0.1 * float(predicted.abs().max())
    if name == "airborne":
        assert float(measured.abs().max()) > 0.3


def test_stored_filters_and_blocks_equal_the_plain_path():
    case = CASES["kondor_squint"]()
    signal = case.signal(torch.complex64)
    stage = OmegaK(case.radar, "flat", doppler_hz=case.arguments["doppler_hz"])
    stored = StoredOmegaK(stage, signal.axes)(signal).data
    plain = omega_k(signal.data.clone().requires_grad_(), case.radar, **case.arguments).detach()
    assert error_db(stage(signal).data, plain) < -110
    assert error_db(stored, plain) < -110


def test_stored_filters_have_the_names_of_earlier_saved_ones():
    recording, _ = small_recording(16, 40)
    names = StoredOmegaK(OmegaK(small_radar()), recording.signal.axes).state_dict()
    assert list(names) == ["filter", "fine", "coarse"]


@pytest.mark.parametrize("call", ["focus", "defocus"])
def test_the_invertible_operator_refuses_what_is_no_matrix(call):
    """A matrix without samples gave an error of the FFT library, a list one of an attribute."""
    empty, x = torch.zeros(32, 0, dtype=torch.complex64), torch.ones(32, 8, dtype=torch.complex64)
    transform = getattr(InvertibleOmegaK(small_radar(), x, doppler_hz=0.0), call)
    for refuse, name in (
        (lambda given: InvertibleOmegaK(small_radar(), given, doppler_hz=0.0), "InvertibleOmegaK"),
        (transform, f"InvertibleOmegaK.{call}"),
    ):
        with pytest.raises(ValueError, match=rf"{name} works on samples .* got the shape \(32, 0\)"):
            refuse(empty)
        with pytest.raises(TypeError, match=f"{name} works on complex samples .* got list"):
            refuse(x.tolist())


def test_values_are_read_once_and_in_single_precision_only(monkeypatch):
    """On an accelerator every reading waits for the device; 201 stands for a large shift."""
    read = []

    def large(x, otherwise):
        read.append(x)
        return 201.0

    recording, _ = small_recording(16, 40, dtype=torch.complex128)
    given = {"radar": small_radar(), "doppler_hz": 0.0}
    plain = omega_k_stolt(recording.signal.data, **given)
    series = omega_k_stolt(recording.signal.data.to(torch.complex64), **given)
    exact = omega_k_stolt(recording.signal.data, **given, eps=1e-7)
    assert error_db(series, exact) < -95, "a power series replaces interpolation"
    for module in ("focus.omega_k", "focus.stolt"):
        monkeypatch.setattr(importlib.import_module(f"torchsar.{module}"), "host_largest", large)
    torch.testing.assert_close(omega_k_stolt(recording.signal.data, **given), plain, rtol=0, atol=0)
    assert not read
    single = omega_k_stolt(recording.signal.data.to(torch.complex64), **given)
    assert len(read) == 2 and error_db(single, plain) < -100, "one reading for the bulk filter, one for the shift"
