"""The grid that follows from the geometry of a recording, and the stage that uses it."""

from __future__ import annotations

import math

import pytest
import torch

from tests.contract.pretended import DEVICE, pretended_device, to_device, to_host
from tests.io.scenes import POINT, recorded
from torchsar.core import Chain, use
from torchsar.focus import SpotlightImage, TileImage
from torchsar.focus.spotlight_image import scene_grid
from torchsar.radar import LIGHT_M_S, AntennaPath

RECORDED = {both: recorded(both) for both in (False, True)}


def antennas(aux) -> AntennaPath:
    return AntennaPath(aux["transmitter_m"], aux.get("receiver_m"), aux["path_reference_m"])


@pytest.mark.parametrize("bistatic", [False, True])
def test_the_grid_samples_every_spatial_frequency(bistatic):
    aux = RECORDED[bistatic].aux
    grid = scene_grid(aux["frequency_hz"], antennas(aux))
    # gradients of the path by differences, in place of the formula
    axis = torch.tensor([[math.cos(grid.range_axis_rad), math.sin(grid.range_axis_rad), 0.0]], dtype=torch.float64)
    other = torch.stack([-axis[0, 1], axis[0, 0], axis[0, 2]])[None]
    paths = [antennas(aux).path_m(sign * direction) for direction in (axis, other) for sign in (1, -1)]
    slopes = [(ahead - behind)[:, 0] / 2 for ahead, behind in (paths[:2], paths[2:])]
    assert float(slopes[0].min()) > 1 and abs(float(slopes[1].mean())) < 1e-3
    bands = [torch.outer(slope, aux["frequency_hz"]) / LIGHT_M_S for slope in slopes]
    widths = [float(band.max() - band.min()) for band in bands]
    assert grid.step_m == pytest.approx(1 / (1.25 * max(widths)), rel=1e-4)
    step_hz = float(aux["frequency_hz"].diff().mean())
    assert grid.range_m == pytest.approx(LIGHT_M_S / step_hz / float(slopes[0].max()), rel=1e-4)


def test_the_image_covers_the_corners_as_far_as_it_is_unambiguous():
    aux = RECORDED[False].aux
    corners = torch.tensor([[-20.0, -4, 1], [10, -4, 1], [10, 8, 1], [-20, 8, 1]], dtype=torch.float64)
    grid = scene_grid(aux["frequency_hz"], antennas(aux), corners)
    assert grid.centre_m == pytest.approx((-5.0, 2.0), abs=0.1) and grid.height_m == 1.0
    assert (grid.range_m, grid.azimuth_m) == pytest.approx((30.0, 12.0), abs=0.5)
    wide = scene_grid(aux["frequency_hz"], antennas(aux), 1000 * corners)
    assert wide.range_m < 50 and wide.azimuth_m < 100
    coarse = AntennaPath(aux["transmitter_m"][::12], None, aux["path_reference_m"][::12])
    every = scene_grid(aux["frequency_hz"], coarse, 1000 * corners)
    assert every.azimuth_m == pytest.approx(wide.azimuth_m / 12, rel=0.1)
    with pytest.raises(ValueError, match="does not change over the pulses"):
        still = aux["transmitter_m"][:1].expand(9, 3)
        scene_grid(aux["frequency_hz"], AntennaPath(still, None, aux["path_reference_m"][:9]))


# around the bright point
CORNERS = torch.from_numpy(POINT) + 6 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def test_the_stage_needs_no_connection():
    recording = RECORDED[True].to(torch.complex64)
    stage = SpotlightImage({**recording.aux, "scene_corners_m": CORNERS}, error_db=-40.0)
    image = Chain(image=stage)(recording)
    i, j = divmod(int(image.data.abs().argmax()), image.axes[1].n)
    assert float((stage.grid.pixels_m()[i, j] - torch.from_numpy(POINT)).abs().max()) < stage.grid.step_m


def test_the_stage_takes_a_corrected_path():
    recording = RECORDED[False].to(torch.complex64)
    stage = SpotlightImage({**recording.aux, "scene_corners_m": CORNERS}, 10.0, 11.0, 0.5, error_db=-40.0)
    path = (
        recording.aux["transmitter_m"] + 0.01 * torch.randn(3, dtype=torch.float64) * torch.linspace(-1, 1, 48)[:, None]
    )
    image = Chain(image=use(stage, transmitter_m="given.path"))(recording, {"given.path": path})
    grid = scene_grid(recording.aux["frequency_hz"], antennas(recording.aux), CORNERS)
    other = TileImage(10.0, 11.0, 0.5, grid.centre_m, grid.range_axis_rad, error_db=-40.0)
    used = {"frequency_hz": recording.aux["frequency_hz"], "path_reference_m": recording.aux["path_reference_m"]}
    torch.testing.assert_close(image.data, other(recording.signal, transmitter_m=path, **used).data)


def test_the_geometry_follows_the_data_to_a_device():
    recording = RECORDED[False].to(torch.complex64)
    stage = SpotlightImage({**recording.aux, "scene_corners_m": CORNERS}, 10.0, 11.0, 0.5, error_db=-40.0)
    expected = stage(recording.signal).data
    with pretended_device():
        found = stage.to(DEVICE)(recording.signal.with_data(to_device(recording.signal.data)))
    torch.testing.assert_close(to_host(found.data), expected)


def test_large_scenes_are_cut_with_a_warning(monkeypatch):
    monkeypatch.setattr("torchsar.focus.spotlight_image._MOST_PIXELS", 4000)
    with pytest.warns(UserWarning, match=r"has .* pixels of 0.\d+ m; the image shows its middle, "):
        stage = SpotlightImage(RECORDED[False].aux)
    assert stage.axes[0].n * stage.axes[1].n == pytest.approx(4000, rel=0.05)
    assert SpotlightImage(RECORDED[False].aux, 60.0, 60.0).axes[0].n > 90


@pytest.mark.parametrize(
    ("aux", "match"),
    [
        (None, "which lack .*use TileImage"),
        ({"frequency_hz": torch.ones(2)}, r"lack \['transmitter_m', 'path_reference_m'\]"),
    ],
)
def test_other_data_are_refused(aux, match):
    with pytest.raises(ValueError, match=match):
        SpotlightImage(aux)
    trials = {name: value[None] for name, value in RECORDED[False].aux.items()}
    with pytest.raises(ValueError, match="must have no trials"):
        SpotlightImage(trials)
