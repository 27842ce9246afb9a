"""System 004: point targets of the Kondor-like sensor reach theory over the swath and at several
squints.
"""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import kondor_radar
from torchsar.core import Draws
from torchsar.echo import simulate
from torchsar.focus import OmegaK
from torchsar.metrics import error_db, impulse_response
from torchsar.scene import Dwell, Points, StripmapWorld

# a squint shears the band by f_dc B / f0 = 25 Hz, which a shorter dwell would show as rounded
# azimuth side lobes
DWELL_S = 1.0


def focused(squint_deg, reference, dtype=torch.complex64):
    radar = kondor_radar(pointing_doppler_hz=None)
    doppler = 2 * radar.velocity_m_s * math.sin(math.radians(squint_deg)) / radar.wavelength_m
    edge = (1280 - radar.pulse_samples) / 2 * radar.range_step_m - 30
    scene = Points([0.0, 231.7, -180.2], [0.3, edge, -edge], [1.0, 1.0, 1.0])
    recording, truth = simulate(
        radar, StripmapWorld(scene, Dwell(DWELL_S), doppler_hz=doppler), 5120, 1280, Draws(0), dtype=dtype
    )
    image = OmegaK(radar, reference, doppler_hz=doppler)(recording.signal)
    return (
        radar,
        image,
        radar.image_position(
            truth.values["zero_doppler_s"], truth.values["closest_range_m"], doppler, radar.velocity_m_s
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("reference", ["matched", "flat"])
@pytest.mark.parametrize("squint_deg", [-0.25, 0.0, 0.35])
def test_point_targets_reach_theory(squint_deg, reference):
    radar, image, place = focused(squint_deg, reference)
    m = impulse_response(image, place)
    band = radar.azimuth_rate_hz_s(place[1]) * DWELL_S
    torch.testing.assert_close(m["irw_azimuth_m"], 0.8859 * radar.velocity_m_s / band, rtol=0.02, atol=0)
    torch.testing.assert_close(
        m["irw_range_m"], torch.full((3,), 0.8859 * 299792458 / 400e6, dtype=torch.float64), rtol=0.02, atol=0
    )
    for axis in ("azimuth", "range"):
        torch.testing.assert_close(
            m[f"pslr_{axis}_db"], torch.full((3,), -13.26, dtype=torch.float64), atol=0.1, rtol=0
        )
        # ten nulls of a sinc hold -10.17 dB; a finite time-bandwidth product rounds the band's
        # edges and loses a little side lobe
        torch.testing.assert_close(
            m[f"islr_{axis}_db"], torch.full((3,), -10.17, dtype=torch.float64), atol=0.3, rtol=0
        )
    for axis, truth in zip(("azimuth", "range"), place, strict=True):
        cell = m[f"irw_{axis}_m"]
        assert float(((m[f"position_{axis}_m"] - truth).abs() / cell).max()) < 0.05


@pytest.mark.slow
def test_single_precision_image_is_within_60_db():
    _, single, _ = focused(0.35, "matched")
    _, double, _ = focused(0.35, "matched", torch.complex128)
    assert float(error_db(single, double)) < -60
