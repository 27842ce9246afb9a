"""The config `spotlight`: an image of a recording of which only the file is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from tests.io.scenes import POINT, Built
from tests.test_docs import DOCS, block_with
from torchsar.cli import main
from torchsar.io import read_sicd

pytestmark = pytest.mark.usefixtures("blank_pictures")

pytest.importorskip("sarkit", reason="sarkit is not installed (extra `formats`)")


@pytest.mark.parametrize("domain", ["FX", "TOA"])
def test_a_file_is_focused_without_further_keys(tmp_path: Path, domain: str) -> None:
    file = Built(domain, bistatic=domain == "TOA").write(tmp_path / "data.cphd")
    small = [f"processor.recommended.stages.image.{key}" for key in ("azimuth_m=30", "range_m=36", "error_db=-40.0")]
    assert main(["run", "spotlight", f"data.file={file}", *small, "--out", str(tmp_path / "out")]) == 0
    tree = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert tree["methods"]["recommended"]["failed"] == ""
    names = sorted(one.name for one in (tmp_path / "out" / "figures").iterdir())
    assert names[0] == "01_images_all.png" and len(names) == 2 and "geometry" in names[1]
    group = zarr.open_group(str(tmp_path / "out" / "arrays.zarr"), mode="r")["recommended"]
    azimuth, range_, image = (np.asarray(group[name]) for name in ("azimuth", "range", "image"))
    i, j = np.unravel_index(np.abs(image.reshape(image.shape[-2:])).argmax(), image.shape[-2:])
    assert np.hypot(azimuth[i], range_[j]) == pytest.approx(np.hypot(*POINT[:2]), abs=0.5)


def test_a_recording_without_positions_gives_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.cphd"
    path.write_bytes(Built().write(tmp_path / "whole.cphd").read_bytes()[:3000])
    assert main(["run", "spotlight", f"data.file={path}", "--out", str(tmp_path / "out")]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line != "torchsar: run spotlight"]
    assert len(said) == 1 and str(path) in said[0] and not (tmp_path / "out").exists()


def test_the_example_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (extra `geo`)")
    file = Built(bistatic=True).write(tmp_path / "data.cphd")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(block_with(DOCS / "how_to" / "own_data.md", "python", "def image_of("), names)
    image = names["image_of"](file)
    with rasterio.open(tmp_path / "image.tif") as raster:
        assert raster.read(1).max() == pytest.approx(float(image.data.abs().max()))
    back = read_sicd(tmp_path / "image.nitf")
    assert [(axis.n, axis.step) for axis in back.axes] == [(axis.n, axis.step) for axis in image.axes]
