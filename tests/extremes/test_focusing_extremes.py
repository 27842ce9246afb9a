"""Levels, geometries and sizes at the edge of what numbers can hold."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.helpers import kondor_radar, small_radar, small_recording
from torchsar.core import Draws, Signal
from torchsar.echo import simulate
from torchsar.focus import OmegaK, RangeCompress, StoredOmegaK
from torchsar.metrics import entropy, error_db, impulse_response
from torchsar.radar import InverseRadar, LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, StripmapWorld


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e15, 1e30])
def test_levels_pass_linearly_in_single_precision(scale):
    recording, _ = small_recording()
    stage = OmegaK(small_radar(), "flat")
    image = stage(recording.signal).data
    scaled = stage(recording.signal.with_data(recording.signal.data * scale)).data
    torch.testing.assert_close(scaled / scale, image, rtol=1e-3, atol=1e-4 * float(image.abs().max()))
    torch.testing.assert_close(entropy(scaled), entropy(image), rtol=1e-3, atol=1e-3)


def focused_point(
    near_range_m: float, velocity_m_s: float, squint_deg: float = 0.0, dtype: torch.dtype = torch.complex128
):
    """One point with a time-bandwidth product of 50; returns (radar, image, its position).

    The PRF holds the Doppler band of the aperture and its spread over range frequency, f_dc B / f0,
    with a margin of 1.5.
    """
    sin = torch.sin(torch.deg2rad(torch.tensor(squint_deg, dtype=torch.float64)))
    radar = small_radar(near_range_m=near_range_m, velocity_m_s=velocity_m_s, pointing_doppler_hz=None)
    range_m = near_range_m + 50 * radar.range_step_m
    rate = float(radar.azimuth_rate_hz_s(range_m) * (1 - sin.square()))
    doppler = float(2 * velocity_m_s * sin / radar.wavelength_m)
    dwell = (50 / rate) ** 0.5
    radar = replace(radar, prf_hz=1.5 * (dwell * rate + abs(doppler) * radar.pulse.bandwidth_hz / radar.carrier_hz))
    world = StripmapWorld(Points([0.0], [0.0]), Dwell(dwell), doppler_hz=doppler)
    recording, truth = simulate(radar, world, int(1.4 * dwell * radar.prf_hz), 160, Draws(0), dtype=dtype)
    image = OmegaK(radar, "flat", doppler_hz=doppler)(recording.signal)
    return (
        radar,
        image,
        radar.image_position(truth.values["zero_doppler_s"], truth.values["closest_range_m"], doppler, velocity_m_s),
    )


@pytest.mark.parametrize(
    ("near_range_m", "velocity_m_s", "squint_deg"),
    [
        (10.0, 0.5, 0.0),  # a rail in a laboratory
        (4e3, 120.0, 0.0),  # a light aircraft
        (4e3, 120.0, 5.0),
        (40e3, 120.0, -45.0),
        (100e3, 120.0, 60.0),
        (700e3, 7000.0, 0.3),  # low orbit
        (4e7, 3000.0, 0.0),  # geosynchronous height
    ],
)
def test_from_a_laboratory_to_geosynchronous_height_and_to_large_squints(near_range_m, velocity_m_s, squint_deg):
    radar, image, (azimuth, range_m) = focused_point(near_range_m, velocity_m_s, squint_deg)
    _, single, _ = focused_point(near_range_m, velocity_m_s, squint_deg, dtype=torch.complex64)
    assert float(error_db(single, image)) < -60
    found = impulse_response(image, (azimuth, range_m))
    assert float((found["position_range_m"] - range_m).abs()) < 0.05 * radar.range_step_m
    assert float((found["position_azimuth_m"] - azimuth).abs()) < 0.05 * image.axis("azimuth").step
    assert float(found["irw_range_m"]) == pytest.approx(radar.range_resolution_m, rel=0.03)


@pytest.mark.parametrize("shape", [(1, 40), (2, 27), (31, 26), (7, 101)])
def test_odd_and_tiny_matrices(shape):
    radar = small_radar()
    x = torch.randn(*shape, dtype=torch.complex128)
    signal = Signal(x, radar.raw_axes(*shape))
    image = OmegaK(radar)(signal).data
    assert image.shape == x.shape and torch.isfinite(torch.view_as_real(image)).all()
    torch.testing.assert_close(StoredOmegaK(OmegaK(radar), signal.axes, torch.complex128)(signal).data, image)


def test_lines_shorter_than_the_pulse_are_refused():
    radar = small_radar()
    signal = Signal(torch.zeros(4, 10, dtype=torch.complex64), radar.raw_axes(4, 10))
    with pytest.raises(ValueError, match="a line of 10 samples does not hold the pulse of 25"):
        RangeCompress(radar)(signal)


def test_focusing_is_unitary_up_to_the_range_filter():
    # energy in the pulse band is kept, whatever the geometry: nothing grows, nothing vanishes
    radar = kondor_radar(pulse=LinearFM(250e6, 0.2e-6))
    x = torch.randn(64, 128, dtype=torch.complex128)
    image = OmegaK(radar, None)(Signal(x, radar.raw_axes(64, 128))).data
    torch.testing.assert_close(image.abs().square().sum(), x.abs().square().sum())


def test_nonsense_instruments_are_refused():
    with pytest.raises(ValueError, match=r"radar\.prf_hz must be a positive number, got nan"):
        small_radar(prf_hz=float("nan"))
    with pytest.raises(ValueError, match=r"radar\.integration_s must be a positive number or None, got -1"):
        small_radar(integration_s=-1.0)
    with pytest.raises(ValueError, match="StripmapRadar: carrier_hz must be a number, got '400'"):
        small_radar(carrier_hz="400")
    with pytest.raises(ValueError, match="InverseRadar: carrier_hz must be a number, got None"):
        InverseRadar(None, None, None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="InverseRadar: reference_range_m must be a number, got None"):
        InverseRadar(1e10, 1e9, 100.0, reference_range_m=None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="exceeds the complex sampling rate"):
        StripmapRadar(3e9, LinearFM(100e6, 1e-6), 50e6, 100.0, 100.0, 1000.0)
    with pytest.raises(ValueError, match="direction"):
        LinearFM(1e6, 1e-6, 0)


def test_zero_image_has_finite_impulse_figures():
    radar = small_radar()
    zero = Signal(torch.zeros(64, 64, dtype=torch.complex64), radar.image_axes(radar.raw_axes(64, 64)))
    found = impulse_response(zero, (5.0, 4050.0))
    assert all(torch.isfinite(torch.view_as_real(v) if v.is_complex() else v).all() for v in found.values())
