"""The grid that follows from the geometry of a recording, and the stage that uses it."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

from tests.contract.pretended import DEVICE, pretended_device, to_device, to_host
from tests.io.scenes import POINT, recorded
from torchsar.core import Chain, Recording, Signal, use
from torchsar.focus import DirectImage, SpotlightImage, TileImage
from torchsar.focus.spotlight_image import scene_grid
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, range_profiles

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


def history_of(places: torch.Tensor, reference_m: float, points, frequency_hz: torch.Tensor) -> tuple[Signal, dict]:
    """Range profiles of points, by the signal model, and their side data."""
    path = AntennaPath(places, None, torch.full((len(places),), 2.0 * reference_m, dtype=torch.float64))
    turns = path.path_m(torch.tensor(points, dtype=torch.float64))[..., None] * frequency_hz / LIGHT_M_S
    history = torch.exp(-2j * torch.pi * turns).sum(1)
    sensor = InverseRadar(float(frequency_hz.mean()), 1e9, 100.0)
    signal = Recording.from_arrays(range_profiles(history), sensor).signal
    return signal, {**path.side_data(), "frequency_hz": frequency_hz}


def peak_of(image: Signal, near: tuple[float, float], stage: SpotlightImage) -> tuple[float, float]:
    """Position (x, y) of the peak within half a metre of a point."""
    away = torch.linalg.vector_norm(stage.grid.pixels_m()[..., :2] - torch.tensor(near, dtype=torch.float64), dim=-1)
    at = int(torch.where(away < 0.5, image.data.abs(), 0).argmax())
    x, y, _ = stage.grid.pixels_m().reshape(-1, 3)[at].tolist()
    return x, y


def rail(start, stop, n: int = 161) -> torch.Tensor:
    share = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
    return torch.tensor(start, dtype=torch.float64) * (1 - share) + torch.tensor(stop, dtype=torch.float64) * share


WIDE_HZ = torch.linspace(3.1e9, 4.9e9, 128, dtype=torch.float64)  # a window of 10.6 m
RAILS = {
    "a rail through the origin": (rail([0.0, -3, 0], [0.0, 3, 0]), 9.0, [[9.4, 2.5, 0], [7.5, -2.4, 0]]),
    "dechirped, without a reference": (rail([0.0, -2, 0], [0.0, 2, 0]), 0.0, [[8.0, 1.0, 0], [3.0, -0.5, 0]]),
    "moved along -x": (rail([2.0, 5, 0], [-2.0, 5, 0]), 9.0, [[0.5, -4.0, 0]]),
    "along x": (rail([-2.0, 0, 0], [2.0, 0, 0]), 0.0, [[1.0, 7.0, 0]]),
    "raised": (rail([0.0, -2, 3], [0.0, 2, 3]), 8.0, [[7.0, 1.0, 0]]),
    "about the origin": (rail([-8.0, -3, 0], [-8.0, 3, 0]), 8.0, [[1.0, 2.0, 0]]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RAILS)
def test_rails_and_near_fields(name):
    places, reference_m, points = RAILS[name]
    signal, aux = history_of(places, reference_m, points, WIDE_HZ)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        stage = SpotlightImage(aux, error_db=-40.0)
    image = stage(signal)
    for x, y, _ in points:
        assert math.dist(peak_of(image, (x, y), stage), (x, y)) < 0.05
    assert not stage.sampling_limits(antennas(aux), WIDE_HZ)
    assert (name == "about the origin") == (not said), [str(one.message) for one in said]
    if said:
        assert "ground ranges from" in str(said[0].message) and "centre_m" in str(said[0].message)


def test_a_centre_may_be_given():
    places, reference_m, points = RAILS["a rail through the origin"]
    signal, aux = history_of(places, reference_m, points, WIDE_HZ)
    stage = SpotlightImage(aux, 2.0, 2.0, 0.04, centre_m=(9.0, 2.0))
    assert math.dist(peak_of(stage(signal), (9.4, 2.5), stage), (9.4, 2.5)) < 0.05
    assert stage.sampling_limits(antennas(aux), WIDE_HZ)


@pytest.mark.slow
@pytest.mark.parametrize("reference_m", [0.0, 4.0])
def test_a_whole_circle(reference_m):
    turn = torch.linspace(0, 2 * math.pi, 401, dtype=torch.float64)[:-1]
    places = torch.stack([4 * torch.cos(turn), 4 * torch.sin(turn), 0 * turn], -1)
    signal, aux = history_of(places, reference_m, [[0.5, -0.8, 0.0]], WIDE_HZ)
    stage = SpotlightImage(aux, 3.0, 3.0, 0.02, window="none", error_db=-40.0)
    image = stage(signal)
    exact = DirectImage(3.0, 3.0, 0.02, window="none")
    same = exact(signal, *(aux[key] for key in ("frequency_hz", "transmitter_m", "path_reference_m")))
    assert float((image.data - same.data).abs().square().mean() / same.data.abs().square().mean()) < 1e-4
    assert math.dist(peak_of(image, (0.5, -0.8), stage), (0.5, -0.8)) < 0.03


def test_lost_pulses_are_named_and_do_not_crop_the_image():
    aux = RECORDED[False].aux
    kept = torch.arange(48) < 20
    kept[34:] = True
    some = AntennaPath(aux["transmitter_m"][kept], None, aux["path_reference_m"][kept])
    wide = 1000 * torch.tensor([[-20.0, -4, 1], [10, -4, 1], [10, 8, 1], [-20, 8, 1]], dtype=torch.float64)
    with pytest.warns(UserWarning, match=r"the largest step between pulses, at pulse 19, is 15.* times the median one"):
        grid = scene_grid(aux["frequency_hz"], some, wide)
    assert grid.azimuth_m == pytest.approx(scene_grid(aux["frequency_hz"], antennas(aux), wide).azimuth_m, rel=0.02)


def test_grating_lobes_lie_where_the_warning_says():
    signal, aux = history_of(rail([-300.0, -20, 100], [-300.0, 20, 100], 41), 316.2, [[0.0, 0, 0]], WIDE_HZ)
    with pytest.warns(UserWarning, match="grating lobes") as said:
        stage = SpotlightImage(aux, 40.0, 4.0, 0.2, centre_m=(0.0, 0.0))
    assert said[0].filename == __file__ and "201 x 21 pixels of 0.2 m" in repr(stage)
    (limit,) = stage.pulse_limits(antennas(aux), WIDE_HZ)
    lobe_m = float(limit.consequence.split(" lie about ")[1].split(" m ")[0])
    level = stage(signal).data.abs().amax(-1)
    away = stage.axes[0].values().abs()
    lobe = torch.where(away > lobe_m / 2, level, 0)
    # the range band smears the lobe between its places at the highest and the lowest frequency
    assert 0.98 * lobe_m < float(away[lobe.argmax()]) < lobe_m * 4.9 / 3.1
    assert float(lobe.max() / torch.where((away > 3) & (away < lobe_m / 2), level, 0).max()) > 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small = SpotlightImage(aux, 0.98 * lobe_m, 4.0, 0.2, centre_m=(0.0, 0.0))
    assert small.pulse_limits(antennas(aux), WIDE_HZ)[0].ok


FLOWN = rail([-1000.0, -32, 500], [-1000.0, 31, 500], 64)
NEAR = rail([-5.0, -1.6, 0], [-5.0, 1.55, 0], 64)


@pytest.mark.parametrize(
    ("path", "sides", "turn"), [(FLOWN, (50.0, 20.0), 0.0), (FLOWN, (20.0, 50.0), math.pi / 2), (NEAR, (4.0, 2.0), 0.0)]
)
def test_an_image_as_wide_as_the_warning_advises_has_no_grating_lobes(path, sides, turn):
    """Along either axis, near the path, and in the trial whose pulses are the farthest apart."""
    still = path.mean(0, keepdim=True)
    paths = torch.stack([path, path.flip(0), still + 0.1 * (path - still)])
    trials = AntennaPath(paths, None, paths.new_zeros(3, len(path)))
    (limit,) = TileImage(*sides, 0.02 * min(sides), range_axis_rad=turn).pulse_limits(trials, WIDE_HZ)
    (alone,) = TileImage(*sides, 0.02 * min(sides), range_axis_rad=turn).pulse_limits(
        AntennaPath(path, None, paths.new_zeros(len(path))), WIDE_HZ
    )
    assert not limit.ok and limit.value == pytest.approx(alone.value)
    advised = 0.99 * float(limit.remedy.split(" about ")[1].split(" m ")[0])
    narrow = [min(side, advised) if side == max(sides) else side for side in sides]
    assert TileImage(*narrow, 0.02 * min(narrow), range_axis_rad=turn).pulse_limits(trials, WIDE_HZ)[0].ok
