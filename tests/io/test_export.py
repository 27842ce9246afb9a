"""Images and recordings of a run in the formats of other programs, on the command line."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
import zarr

from tests.study.tiny import write_tiny
from torchsar.cli import main
from torchsar.core import Axis, Signal
from torchsar.io import read, read_images, write_netcdf
from torchsar.io.arrays import write_arrays
from torchsar.study.commands import run as run_command

h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")

_NAMES = {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
FLOWN = {
    "system": "path",
    "title": "flown",
    "radar": {"carrier_hz": 9.6e9, "bandwidth_hz": 300e6, "prf_hz": 200.0},
    "world": {
        "pulses": 48,
        "samples": 63,
        "trials": 2,
        "scene": {"points": {"kind": "points", "azimuth_m": [0.0, 10.0], "range_m": [0.0, -12.0]}},
        "transmitter": {
            "nominal": {"kind": "straight_path", "start_m": [-3535.0, -48.0, 3535.0], "velocity_m_s": [0.0, 400.0, 0.0]}
        },
        "noise": {"snr_db": 10.0},
    },
    "cases": {"calm": {"world.noise.snr_db": 20.0}, "loud": {"world.noise.snr_db": 0.0}},
    "processor": {
        "recommended": {
            "stages": {
                "image": {"stage": "tile_image", "azimuth_m": 30.0, "range_m": 40.0, "step_m": 0.5, "uses": _NAMES}
            }
        }
    },
}
ORIGIN = ["--origin", "48.0", "11.0", "500.0"]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of system path with two cases."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "flown.yaml").write_text(yaml.safe_dump(FLOWN))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_command, "draw_all", lambda *_, **__: [])
        assert main(["run", str(folder / "flown.yaml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


def exported(run: Path, form: str, out: Path, *words: str) -> list[str]:
    """Names of the files that the command writes."""
    assert main(["export", str(run), "--to", form, "--out", str(out), *words]) == 0
    return sorted(
        str(path.relative_to(out)) for path in out.rglob("*.*") if path.is_file() and ".torchsar" not in str(path)
    )


def test_images_as_netcdf(flown: Path, tmp_path: Path) -> None:
    assert exported(flown, "netcdf", tmp_path / "out") == ["calm/recommended.nc", "loud/recommended.nc"]
    held = zarr.open_group(str(flown / "arrays.zarr"), mode="r")
    with h5py.File(tmp_path / "out" / "calm" / "recommended.nc") as file:
        assert file.attrs["title"] == "flown: calm/recommended"
        image = file["image_real"][:] + 1j * file["image_imag"][:]
        assert (image == held["calm/recommended/image"][:]).all() and image.any()
        for dim, name in enumerate(("azimuth", "range")):
            assert (file[name][:] == held[f"calm/recommended/{name}"][:]).all()
            assert file[name].attrs["units"] == "m" and file["image_real"].dims[dim][0] == file[name]


def test_netcdf_opens_as_labelled_arrays(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    engines = [name for name in ("netcdf4", "h5netcdf") if name in xarray.backends.list_engines()]
    if not engines:
        pytest.skip("xarray has no engine for netCDF-4 here")
    axes = (Axis("azimuth", 3, -1.0, 0.5, "m"), Axis("range", 4, 100.0, 0.25, "m"))
    image = Signal(torch.arange(12.0).reshape(3, 4), axes)
    write_netcdf(image, tmp_path / "image.nc")
    with xarray.open_dataset(tmp_path / "image.nc", engine=engines[0]) as held:
        assert held["image"].dims == ("azimuth", "range") and held["azimuth"].attrs["units"] == "m"
        assert (held["image"].sel(range=100.25).values == [1.0, 5.0, 9.0]).all()


def test_recordings_as_cphd(flown: Path, tmp_path: Path) -> None:
    pytest.importorskip("sarkit", reason="the extra `formats` is not installed")
    names = exported(flown, "cphd", tmp_path / "out", *ORIGIN)
    assert names == ["calm/recording.cphd", "loud/recording.cphd"]
    found = read(tmp_path / "out" / names[0])
    assert found.signal.data.shape == (48, 63)
    torch.testing.assert_close(found.aux["origin_deg_m"], torch.tensor([48.0, 11.0, 500.0], dtype=torch.float64))


def test_images_as_sicd(flown: Path, tmp_path: Path) -> None:
    pytest.importorskip("sarkit", reason="the extra `formats` is not installed")
    names = exported(flown, "sicd", tmp_path / "out", *ORIGIN)
    assert names == ["calm/recommended.nitf", "loud/recommended.nitf"]
    image = read_images(flown / "arrays.zarr")["calm/recommended"]
    assert read(tmp_path / "out" / names[0]).data.numel() == image.data.numel()


def test_images_as_geotiff(flown: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="the extra `geo` is not installed")
    names = exported(flown, "geotiff", tmp_path / "out", *ORIGIN)
    assert names == ["calm/recommended.tif", "loud/recommended.tif"]
    image = read_images(flown / "arrays.zarr")["calm/recommended"]
    with rasterio.open(tmp_path / "out" / names[0]) as file:
        assert file.crs.to_epsg() == 32632
        np.testing.assert_allclose(np.sort(file.read(1), None), np.sort(image.data.abs().numpy(), None), rtol=1e-6)


def test_axes_and_images_come_back_exactly(tmp_path: Path) -> None:
    axes = (Axis("azimuth", 3, -0.1, 0.3, "m"), Axis("range", 4, 1 / 3, 0.7, "m"))
    images = {"a": Signal(torch.randn(3, 4, dtype=torch.complex64), axes), "case/b": Signal(torch.rand(3, 4), axes)}
    write_arrays(tmp_path / "arrays.zarr", images, {"x": torch.ones(2)}, {"a": {"s.v": torch.ones(1)}})
    found = read_images(tmp_path / "arrays.zarr")
    assert found.keys() == images.keys()
    for name, image in images.items():
        assert found[name].axes == axes and torch.equal(found[name].data, image.data)


@pytest.mark.parametrize("name", ["run", "absent"])
def test_a_folder_without_images_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(FileNotFoundError, match=f"{name} holds no images; give the store of a run, arrays.zarr"):
        read_images(tmp_path / name)


@pytest.fixture
def strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the result of a small run of stripmap data."""
    monkeypatch.setattr(run_command, "draw_all", lambda *_, **__: [])
    write_tiny(tmp_path)
    assert main(["run", str(tmp_path / "tiny.yaml"), "--out", str(tmp_path / "strip")]) == 0
    return tmp_path / "strip"


def refused(run: Path, form: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What an export says that ends without a file in the folder."""
    before = sorted(folder.rglob("*"))
    assert main(["export", str(run), "--to", form, "--out", str(folder / "out")]) == 2
    assert sorted(folder.rglob("*")) == before
    return capsys.readouterr().err.splitlines()[-1]


def test_mistakes_are_one_sentence_and_nothing_is_written(
    flown: Path, strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(tmp_path, "netcdf", tmp_path, capsys)
    assert "config.yaml does not exist; give the folder of the result of torchsar run" in said
    assert "has no image for sicd" in refused(strip, "sicd", tmp_path, capsys)
    (tmp_path / "mine" / "calm").mkdir(parents=True)
    (tmp_path / "mine" / "calm" / "recommended.nc").write_text("mine")
    assert main(["export", str(flown), "--to", "netcdf", "--out", str(tmp_path / "mine")]) == 2
    assert "torchsar did not write calm/recommended.nc" in capsys.readouterr().err
    assert (tmp_path / "mine" / "calm" / "recommended.nc").read_text() == "mine"


def test_data_without_a_place_on_the_earth_are_refused(
    flown: Path, strip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("sarkit", reason="the extra `formats` is not installed")
    for run, form in ((strip, "cphd"), (flown, "sicd")):
        assert "the recording does not say where on the Earth it lies" in refused(run, form, tmp_path, capsys)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A small store of the arrays of a run."""
    axes = (Axis("azimuth", 9, -0.1, 0.3, "m"), Axis("range", 7, 1 / 3, 0.7, "m"))
    image = Signal(torch.randn(9, 7, dtype=torch.complex64), axes)
    write_arrays(
        tmp_path / "a.zarr",
        {"r": image, "zero": Signal(0 * image.data, axes)},
        {"x": torch.ones(2)},
        {"r": {"s": torch.ones(1)}},
    )
    return tmp_path / "a.zarr"


def refused_by_sentence(store: Path) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=r"a\.zarr") as error:
        read_images(store)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_any_flipped_bit_of_a_run_is_found(store: Path) -> None:
    source, files = random.Random(5), sorted(path for path in store.rglob("*") if path.is_file())
    for _ in range(400):
        path = source.choice(files)
        data = bytearray(whole := path.read_bytes())
        data[source.randrange(len(data))] ^= 1 << source.randrange(8)
        path.write_bytes(data)
        refused_by_sentence(store)
        path.write_bytes(whole)
    assert read_images(store).keys() == {"r", "zero"}


def test_any_missing_or_strange_file_of_a_run_is_found(store: Path) -> None:
    for path in sorted(path for path in store.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        path.unlink()
        refused_by_sentence(store)
        os.mkfifo(path)  # reading from it would wait for ever
        refused_by_sentence(store)
        path.unlink()
        path.symlink_to("/dev/zero")
        refused_by_sentence(store)
        path.unlink()
        path.write_bytes(whole)
    assert read_images(store).keys() == {"r", "zero"}
