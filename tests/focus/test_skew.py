"""Skewed Doppler spectra at large squint, and the precision of large migration."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchsar.core import Signal
from torchsar.focus import (
    OmegaKStolt,
    focus_strip,
    omega_k,
    omega_k_stolt,
    plan_strip,
    range_doppler,
    requirements,
)
from torchsar.focus.coordinates import PaddedLines
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.skew import DopplerSkew, azimuth_factor, common_lines, through_skewed_doppler
from torchsar.metrics import error_db
from torchsar.radar import LIGHT_M_S, LinearFM, StripmapRadar

L_BAND = StripmapRadar(1.25e9, LinearFM(250e6, 0.2e-6), 300e6, 80.0, 100.0, 4850.0, integration_s=1.047)
DOPPLER_HZ = 2 * 100.0 * 0.5 * 1.25e9 / LIGHT_M_S  # squint of 30 degrees


def test_the_remedy_of_range_doppler_is_a_form_that_is_enough() -> None:
    """Omega-K without Stolt interpolation is enough for a small squint and a narrow swath only."""
    narrow = StripmapRadar(3.2e9, LinearFM(200e6, 3e-6), 250e6, 2000.0, 7000.0, 700e3, integration_s=1.0)
    wide = StripmapRadar(9.6e9, LinearFM(2.88e9, 0.2e-6), 3.2e9, 1000.0, 100.0, 10e3, integration_s=2.0)
    for radar, samples, doppler_hz, form in (
        (narrow, 1536, 1304.0, "omega_k"),
        (wide, 100_000, 2190.0, "omega_k_stolt"),
    ):
        bulk, coupling, *_ = requirements(radar, radar.raw_axes(3072, samples), doppler_hz)
        assert coupling.effect == "range-Doppler" and bulk.ok == (form == "omega_k")
        assert not coupling.ok and coupling.remedy == f"use {form}"


def noise(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))


def test_the_factor_follows_from_the_aperture_and_the_skew():
    assert azimuth_factor(L_BAND, 0.0) == 1
    assert azimuth_factor(L_BAND, DOPPLER_HZ) == azimuth_factor(L_BAND, -DOPPLER_HZ) == 2
    assert azimuth_factor(replace(L_BAND, prf_hz=160.0), DOPPLER_HZ) == 1
    assert azimuth_factor(replace(L_BAND, prf_hz=160.0, integration_s=None), DOPPLER_HZ) == 2
    assert azimuth_factor(replace(L_BAND, prf_hz=1700.0, integration_s=None), DOPPLER_HZ) == 1
    assert azimuth_factor(replace(L_BAND, integration_s=None), torch.tensor([0.0, DOPPLER_HZ]), band_hz=10.0) == 2


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_each_sample_of_the_spectrum_is_used_once_at_its_own_doppler(factor):
    """With a filter of 1, the transform is unitary on the lines of the pulses, and every sample of
    the finer spectrum lies within half a PRF of the centroid of its range frequency.
    """
    raw = noise(2, 12, 16)
    centre = torch.tensor([DOPPLER_HZ, -170.0], dtype=torch.float64)
    geometry = FrameGeometry.of(L_BAND, raw, centre, None, 0.0)
    skew = replace(DopplerSkew.of(L_BAND, raw, centre, geometry.velocity_m_s, 20.0), band_hz=None, factor=factor)
    image = through_skewed_doppler(raw, lambda rows: rows, lambda at: (), geometry, skew)
    torch.testing.assert_close(image[..., ::factor, :], torch.fft.fft(raw), rtol=0, atol=1e-10)
    fine = torch.fft.fft(image, dim=-2)
    occupied = fine.abs() > 1e-9
    assert bool((occupied.sum(-2) == 12).all())
    whole = factor * L_BAND.prf_hz
    doppler = torch.fft.fftfreq(12 * factor, 1 / whole, dtype=torch.float64)[:, None]
    middle = centre[:, None, None] * (1 + L_BAND.range_frequency_hz(16) / L_BAND.carrier_hz)
    away = torch.remainder(doppler - middle + whole / 2, whole) - whole / 2
    assert float(away[occupied].abs().max()) <= L_BAND.prf_hz / 2 + 1e-9


@pytest.mark.parametrize("prf_hz", [80.0, 1900.0])
def test_trials_of_different_squint_equal_single_ones(prf_hz):
    radar = replace(L_BAND, prf_hz=prf_hz, integration_s=None, pointing_doppler_hz=DOPPLER_HZ + 20)
    raw, centre = noise(3, 24, 96), torch.tensor([DOPPLER_HZ, DOPPLER_HZ + 13.0, DOPPLER_HZ - 40.0])
    together = omega_k_stolt(raw, radar, doppler_hz=centre, eps=1e-9)
    for trial in range(3):
        alone = omega_k_stolt(raw[trial], radar, doppler_hz=float(centre[trial]), eps=1e-9)
        assert error_db(together[trial], alone) < -150
    with_gradients = omega_k_stolt(raw.clone().requires_grad_(), radar, doppler_hz=centre, eps=1e-9)
    assert error_db(with_gradients.detach(), together).max() < -150


def test_stages_and_strips_keep_the_lines_of_an_image_with_two_per_pulse():
    signal = Signal(noise(40, 128), L_BAND.raw_axes(40, 128))
    stage = OmegaKStolt(L_BAND, None, doppler_hz=DOPPLER_HZ)
    image = stage(signal)
    azimuth = image.axis("azimuth")
    assert azimuth.n == 80 and azimuth.step == pytest.approx(100.0 / 160.0)
    padded = PaddedLines(stage, 8)(signal)
    assert padded.axes == image.axes
    plan = plan_strip((40, 128), (-2, 2), 10**9)
    ((lines, block),) = focus_strip(signal.data, stage, L_BAND, plan)
    assert lines == slice(0, 80) and block.axes == image.axes
    torch.testing.assert_close(block.data, image.data)
    plain = Signal(image.data[::2], L_BAND.image_axes(signal.axes))
    one, other = common_lines(image, plain)
    assert one.axes == other.axes and torch.equal(one.data, other.data)


@pytest.mark.parametrize(
    "case",
    [  # orbit, aircraft and geosynchronous orbit: carrier, bandwidth, PRF, speed, range, squint
        (9.6e9, 1e9, 4000.0, 7000.0, 700e3, 45.0),
        (9.6e9, 1e9, 400.0, 200.0, 40e3, -45.0),
        (1.25e9, 170e6, 300.0, 3000.0, 4e7, 5.0),
    ],
)
@pytest.mark.parametrize("form", [omega_k, omega_k_stolt, range_doppler])
def test_large_migration_keeps_single_precision(form, case):
    carrier, bandwidth, prf, speed, near, deg = case
    radar = StripmapRadar(carrier, LinearFM(bandwidth, 0.1e-6), 1.2 * bandwidth, prf, speed, near)
    doppler = 2 * speed * math.sin(math.radians(deg)) * carrier / LIGHT_M_S
    raw = noise(96, 256)
    single = form(raw.to(torch.complex64), radar, doppler_hz=doppler)
    assert error_db(single.to(torch.complex128), form(raw, radar, doppler_hz=doppler)) < -80


def test_requirements_name_the_skew_and_limit_the_phase_of_range_doppler():
    axes = L_BAND.raw_axes(256, 1024)
    rows = {row.effect: row for row in requirements(L_BAND, axes, DOPPLER_HZ)}
    skew = rows["one Doppler centroid for all range frequencies"]
    assert "spans 96.22 Hz" in skew.neglects and not skew.ok and skew.remedy == "use omega_k_stolt"
    assert not rows["range-Doppler"].ok
    ahead = {row.effect: row for row in requirements(L_BAND, axes, 0.0)}
    assert ahead["one Doppler centroid for all range frequencies"].ok
    limit = replace(ahead["range-Doppler"], phase_rad=0.49, error_db=-25.0)
    assert limit.ok and not replace(limit, phase_rad=0.76).ok


def test_an_error_of_the_device_is_not_taken_for_vmap(monkeypatch: pytest.MonkeyPatch):
    raw, centre = noise(2, 12, 16), torch.tensor([DOPPLER_HZ, -170.0], dtype=torch.float64)
    geometry = FrameGeometry.of(L_BAND, raw, centre, None, 0.0)
    skew = DopplerSkew.of(L_BAND, raw, centre, geometry.velocity_m_s, 20.0)

    def failing(*_: object) -> torch.Tensor:
        raise RuntimeError("the device has failed")

    with monkeypatch.context() as patched, pytest.raises(RuntimeError, match="device has failed"):
        patched.setattr(torch.Tensor, "nonzero", failing)
        skew.jumps(slice(None))
