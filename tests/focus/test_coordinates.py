"""Coordinates of closest approach, and padded records."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import small_radar
from torchsar.core import Draws
from torchsar.echo import simulate
from torchsar.focus import ClosestRange, OmegaK, PaddedLines, closest_range
from torchsar.metrics import impulse_response
from torchsar.scene import AlwaysLit, Dwell, Points, StripmapWorld


@pytest.mark.parametrize("doppler_hz", [-400.0, 150.0])
def test_a_point_appears_at_its_closest_range(doppler_hz):
    radar = small_radar(prf_hz=800.0, pointing_doppler_hz=None)
    world = StripmapWorld(Points([0.0, 2.0], [-20.0, 60.0]), Dwell(0.5), doppler_hz=doppler_hz)
    recording, truth = simulate(radar, world, 600, 256, Draws(0), dtype=torch.complex128)
    beam = OmegaK(radar, "flat")(recording.signal, doppler_hz=torch.tensor(doppler_hz))
    image = ClosestRange(radar)(beam, doppler_hz=torch.tensor(doppler_hz))
    azimuth, slant = radar.image_position(
        truth.values["zero_doppler_s"], truth.values["closest_range_m"], doppler_hz, radar.velocity_m_s
    )
    closest = truth.values["closest_range_m"]
    # the correction is larger than two cells
    assert float((slant - closest).abs().min()) > 2 * radar.range_step_m
    found = impulse_response(image, (azimuth, closest))
    torch.testing.assert_close(found["position_range_m"], closest, atol=0.05 * radar.range_step_m, rtol=0)
    # a twentieth of a cell
    torch.testing.assert_close(found["position_azimuth_m"], azimuth, atol=0.15, rtol=0)
    torch.testing.assert_close(
        found["pslr_range_db"], impulse_response(beam, (azimuth, slant))["pslr_range_db"], atol=0.1, rtol=0
    )


def test_without_squint_the_image_is_unchanged():
    radar = small_radar()
    image = torch.randn(4, 64, dtype=torch.complex128)
    torch.testing.assert_close(closest_range(image, radar, 0.0, eps=1e-12), image, atol=1e-9, rtol=0)


def test_a_missing_centroid_raises_where_the_pointing_is_unknown():
    radar = small_radar(pointing_doppler_hz=None)
    recording, _ = simulate(radar, StripmapWorld(Points([0.0], [0.0])), 8, 64, Draws(0))
    with pytest.raises(ValueError, match="needs the doppler_hz"):
        ClosestRange(radar)(OmegaK(radar)(recording.signal))


def test_padding_prevents_wrap_around_of_cut_apertures():
    radar = small_radar()
    # illuminated all the time and far beyond the end of the record: without padding its echo folds
    # back into the image
    world = StripmapWorld(Points([25.0], [0.0]), AlwaysLit())
    recording, _ = simulate(radar, world, 128, 96, Draws(0), dtype=torch.complex128)
    plain, padded = OmegaK(radar, "flat")(recording.signal), PaddedLines(OmegaK(radar, "flat"))(recording.signal)
    assert padded.axes == plain.axes
    early = slice(0, 40)
    assert float(padded.data[early].abs().square().sum()) < 0.2 * float(plain.data[early].abs().square().sum())
