"""Scenes from files: images of all systems are brightest where the file has its points."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.study.scenes import TILES, bench_of, scene_method, world, write
from torchsar.core import Draws, Signal
from torchsar.io import read_array, read_points
from torchsar.scene import PointCloud
from torchsar.study.settings.errors import ConfigError
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

# places (azimuth, range in m) of three points, the brightest first, extents of an image that has
# them in the middles of its pixels, and its shape, by system
PLACES = {
    "stripmap": ([(-7.5, -22.5), (4.5, 37.5), (10.5, 7.5)], (24.0, 120.0), (8, 8)),
    "isal": ([(-0.045, 0.015), (0.025, -0.015), (0.055, 0.005)], (0.16, 0.06), (16, 6)),
    "isal_rotation": ([(-0.375, 1.125), (0.375, -1.875), (0.525, -0.375)], (1.2, 6.0), (8, 8)),
    "sal": ([(-0.075, 1.7), (0.025, 0.9), (0.075, 1.3)], (0.2, 4.0), (4, 20)),
    "path": ([(-5.0, -3.0), (3.0, 5.0), (7.0, -1.0)], (16.0, 16.0), (8, 8)),
}
AMPLITUDES = (3.0, 2.0, 1.4)


# images in metres, without shifts by motion or pointing
SETTINGS: dict[str, dict] = {
    "stripmap": {"metrics": {"reference": "clean"}},
    "isal": {},
    "isal_rotation": {
        "processor": {
            name: {
                "stages": {
                    "range": {"stage": "range_phase", "omega_rad_s": 0.02, "warp_k": [10.0, 1000.0]},
                    "image": {"stage": "matched_fourier", "warp_k": [10.0, 1000.0], "omega_rad_s": 0.02}
                    | {"cross_range_m": [0.01, 130]},
                }
            }
            for name in ("ideal", "recommended")
        },
        "metrics": {},
    },
    "sal": {"metrics": {}},
    "path": {},
}
CHANGES = {"stripmap": {"doppler_hz": 0.0}, "sal": {"motion": {}}, "path": {"navigation": None}}


def seen(system: str, scene: dict) -> dict:
    return world(system, scene={"target": scene}, noise={"snr_db": None}, **CHANGES.get(system, {}))


def table(folder: Path, places: np.ndarray) -> dict:
    rows = [f"{r},{x},{level}" for (x, r), level in zip(places, AMPLITUDES)]
    (folder / "points.csv").write_text("\n".join(["range_m,azimuth_m,amplitude", *rows]))
    return {"kind": "point_cloud", "file": "points.csv"}


def mesh(folder: Path, places: np.ndarray) -> dict:
    """Vertices have no amplitudes: the brighter points are there more than once."""
    pytest.importorskip("trimesh")
    vertices = [f"v {1e3 * r} 0 {1e3 * x}" for (x, r), count in zip(places, (3, 2, 1)) for _ in range(count)]
    (folder / "points.obj").write_text("\n".join(vertices))
    cloud = {"kind": "point_cloud", "file": "points.obj", "axes": ["z", "x"], "scale": 1e-3}
    return {**cloud, "fluctuation": "none"}


def pixels(places: np.ndarray, extents: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
    image = np.zeros(shape)
    for place, level in zip(places, AMPLITUDES):
        image[tuple(np.round((place / extents + 0.5) * shape - 0.5).astype(int))] = level
    return image


def array(folder: Path, image: np.ndarray, extents: tuple[float, float]) -> dict:
    np.savez(folder / "image.npz", other=np.zeros(2), intensity=image**2)
    keys = {"file": "image.npz", "key": "intensity", "of": "intensity"}
    return {"kind": "image_scene", "azimuth_extent_m": extents[0], "range_extent_m": extents[1], **keys}


def picture(folder: Path, image: np.ndarray, extents: tuple[float, float]) -> dict:
    Image.fromarray((80 * image[::-1]).astype(np.uint8)).save(folder / "image.png")
    return {"kind": "image_scene", "azimuth_extent_m": extents[0], "range_extent_m": extents[1], "file": "image.png"}


def brightest(image: Signal, count: int = 3, apart: int = 4) -> np.ndarray:
    """Places of the highest maxima of an image that are apart in range, (maximum, axis)."""
    level, found = image.data.reshape(image.data.shape[-2:]).abs().clone(), []
    for _ in range(count):
        at = divmod(int(level.argmax()), level.shape[1])
        found.append([float(axis.values()[i]) for axis, i in zip(image.axes, at)])
        level[:, max(0, at[1] - apart) : at[1] + apart + 1] = 0
    return np.array(found)


def ideal(bench: Bench) -> Signal:
    name = "clean" if "clean" in bench.chains else "ideal"
    signal = bench.batch(Draws(1, "run", [0]), methods=[name]).outcomes[name].signal
    assert signal is not None
    return signal


@pytest.mark.parametrize("made", [table, mesh, array, picture])
@pytest.mark.parametrize("system", PLACES)
def test_images_are_brightest_where_the_file_says(system: str, made, tmp_path: Path) -> None:
    (listed, extents, shape), places = PLACES[system], np.array(PLACES[system][0])
    scene = made(tmp_path, places) if made in (table, mesh) else made(tmp_path, pixels(places, extents, shape), extents)
    bench = bench_of(tmp_path, system, **SETTINGS[system], world=seen(system, scene))
    image, origin = ideal(bench), np.zeros(2)
    step = np.array([axis.step for axis in image.axes])
    if system == "stripmap":  # ranges count from the middle of the part of lines that is fully compressed
        r, size = bench.radar, bench.world()
        origin[0] = size.lines // 2 / r.prf_hz * r.velocity_m_s
        origin[1] = r.near_range_m + (size.samples - r.pulse_samples) / 2 * r.range_step_m
    off = np.abs(brightest(image) - origin - listed)
    assert (off <= step).all(), (off, step, brightest(image) - origin)


def test_a_sea_is_brightest_where_the_image_says(tmp_path: Path) -> None:
    shape, extents = (6, 4), (540.0, 360.0)
    image = np.full(shape, 0.1)
    image[1, 3] = 1.0
    np.savetxt(tmp_path / "sea.csv", image, delimiter=",")
    sea = {
        "kind": "image_sea",
        "file": "sea.csv",
        "azimuth_extent_m": 540.0,
        "range_extent_m": 360.0,
        "of": "amplitude",
    }
    changed = world("geo_ocean", sea=sea, targets={"one": {"scr_db": -40.0}})
    methods = {"recommended": scene_method({"stage": "stationary_image"})}
    bench = bench_of(tmp_path, "geo_ocean", world=changed, processor=methods, metrics={})
    outcome = bench.batch(Draws(1, "run", [0])).outcomes["recommended"]
    made = outcome.judged.view.made[0].conventional
    power = made.data.reshape(made.data.shape[-2:]).abs().square()
    y, r = (axis.values() for axis in made.axes)
    r = r - bench.radar.reference_range_m
    mean = torch.zeros(shape)
    for i in range(shape[0]):
        for k in range(shape[1]):
            along = (y / extents[0] + 0.5) * shape[0]
            across = (r / extents[1] + 0.5) * shape[1]
            inside = ((along >= i) & (along < i + 1))[:, None] & ((across >= k) & (across < k + 1))
            mean[i, k] = power[inside].mean()
    assert divmod(int(mean.argmax()), shape[1]) == (1, 3)
    assert float(mean[1, 3]) > 5 * float(mean.flatten().topk(2).values[1])


def test_heights_are_those_of_the_file_and_only_of_a_world_with_heights(tmp_path: Path) -> None:
    """Seen at 45 degrees, a point 2 m above the ground lies 2 m nearer in an image of it."""
    (tmp_path / "tower.csv").write_text("azimuth_m,range_m,height_m\n4,1,2\n")
    scene = {"kind": "point_cloud", "file": "tower.csv"}
    bench = bench_of(tmp_path, "path", world=seen("path", scene))
    assert np.abs(brightest(ideal(bench), 1) - [[4.0, -1.0]]).max() <= TILES["step_m"]
    bench = bench_of(tmp_path, "isal", world=seen("isal", scene))
    with pytest.raises(
        (ConfigError, ValueError), match="scatterers have heights, which only a world seen from any path"
    ):
        ideal(bench)


def test_a_cloud_is_turned_and_displaced_and_fluctuates_per_trial() -> None:
    places, draws = [[1.0, 0.0], [0.0, 2.0]], Draws(1, trials=range(200))
    heading = torch.linspace(0, 180, 200).double()
    for kind, mean in (("phase", 1.0), ("speckle", 1.0), ("none", 1.0)):
        found = PointCloud(places, [1.0, 1j], 5.0, 7.0, heading, fluctuation=kind).scatterers(draws)
        power = found.amplitude.abs().square()
        assert float(power.mean()) == pytest.approx(mean, abs=0.2)
        assert (float(power.std()) > 0.5) == (kind == "speckle")
    turn = torch.deg2rad(heading)
    torch.testing.assert_close(found.azimuth_m, 5 + torch.stack([turn.cos(), -2 * turn.sin()], -1))
    torch.testing.assert_close(found.range_m, 7 + torch.stack([turn.sin(), 2 * turn.cos()], -1))


CLOUD = {"kind": "point_cloud", "file": "bad.csv"}
IMAGE = {"kind": "image_scene", "file": "bad.npy", "azimuth_extent_m": 1.0, "range_extent_m": 1.0}
BAD = {
    "absent": (CLOUD, None, "bad.csv does not exist"),
    "no points": (CLOUD, "azimuth_m,range_m\n", "bad.csv holds no rows of numbers"),
    "other columns": (
        CLOUD,
        "x,y,z\n1,2,3\n",
        r"has the columns x, y, z, and axes must .*; write for example axes: \[x, y\]",
    ),
    "one axis": ({**CLOUD, "axes": ["x"]}, "x,y\n1,2\n", "axes must name those of azimuth and range, .* got x"),
    "a gap": (CLOUD, "azimuth_m,range_m\n1,2\n3,\n", "finite numbers .*, got 2 finite of 2, 1 finite of 2"),
    "words": (CLOUD, "azimuth_m,range_m\n1,2\nfar,3\n", "row 3 is no row of numbers"),
    "a mesh cut off": (
        {**CLOUD, "file": "bad.ply"},
        "ply\nformat ascii 1.0\nelement vertex 3\n",
        "cannot be read as a mesh",
    ),
    "no vertices": (
        {**CLOUD, "file": "bad.obj", "axes": ["x", "y"]},
        "hello",
        "must hold one point or more .*, got 0 finite of 0",
    ),
    "no picture": (IMAGE, "words", "cannot be read as an array or a picture"),
    "a dark image": (IMAGE, np.zeros((3, 3)), r"got shape \(3, 3\) with a largest magnitude of 0"),
    "no extent": (
        {**IMAGE, "range_extent_m": -1.0},
        np.ones((2, 2)),
        "range_extent_m of an image must be a positive number",
    ),
    "one number": (CLOUD, "7\n", "has the columns 0, and axes must name"),
    "a line": (IMAGE, np.ones(3), r"must have the shape \(azimuth, range\) .*, got shape \(3,\)"),
    "nan": (IMAGE, np.full((2, 2), np.nan), "with a largest magnitude of nan"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_one_sentence(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, content, sentence = BAD[case]
    if isinstance(content, str):
        (tmp_path / str(scene["file"])).write_text(content)
    elif content is not None:
        np.save(tmp_path / str(scene["file"]), content)
    with pytest.raises(ConfigError, match=sentence) as error:
        bench_of(tmp_path, "isal", world=seen("isal", scene))
    assert "\n" not in str(error.value) and "world.scene.target" in str(error.value)


@pytest.mark.parametrize("mode, top", [("L", 255), ("I;16", 65535), ("1", 1), ("RGB", 255), ("F", 1.0)])
def test_pictures_of_all_depths_are_read_upright(mode: str, top: float, tmp_path: Path) -> None:
    depth = {"I;16": np.uint16, "1": bool, "F": np.float32}.get(mode, np.uint8)
    image = np.zeros((3, 4), depth)
    image[2, 1] = top
    shown = np.stack([image] * 3, -1) if mode == "RGB" else image
    path = tmp_path / ("picture.tif" if mode == "F" else "picture.png")
    Image.fromarray(shown).save(path)
    read = read_array(path)
    assert read.shape == (3, 4) and read[0, 1] == top and read.sum() == top
    assert PointCloud.of_image(read, 4.0, 3.0).place_m.tolist() == [[pytest.approx(-4 / 3), -0.375]]


def test_a_mesh_without_its_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\n")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(
        ModuleNotFoundError, match=r'points.obj needs the package trimesh: pip install "torchsar-lab\[formats\]"'
    ):
        read_points(tmp_path / "points.obj", ["x", "y"])


def test_files_are_sought_beside_the_config_and_then_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (beside := tmp_path / "study").mkdir()
    config = write(beside, "isal", world=seen("isal", {"kind": "point_cloud", "file": "points.csv"}))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "points.csv").write_text("azimuth,range\n0,0\n")
    assert load(config).config.world["scene"]["target"]["file"] == "points.csv"
    (beside / "points.csv").write_text("azimuth,range\n0,0\n1,1\n")
    assert load(config).config.world["scene"]["target"]["file"] == str(beside / "points.csv")
    given = load(config, ["world.scene.target.file=points.csv"]).config
    assert given.world["scene"]["target"]["file"] == "points.csv"
