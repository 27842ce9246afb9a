"""GeoTIFF files: positions of points in map coordinates, by another library."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchsar.cli import main
from torchsar.core import Axis, Signal
from torchsar.focus import DirectImage, PathImage
from torchsar.io import StripImage, write_geotiff
from torchsar.radar import LocalFrame

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (extra `geo`)")


def image_of_a_point(stage: PathImage, row: int, column: int) -> tuple[Signal, torch.Tensor]:
    """An image of a bright pixel, and its position."""
    data = torch.full((stage.axes[0].n, stage.axes[1].n), 0.1, dtype=torch.complex64)
    data[row, column] = 10j
    return Signal(data, stage.axes), stage.grid.pixels_m()[row, column]


def on_the_map(frame: LocalFrame, local: torch.Tensor, crs: str) -> tuple[float, float]:
    pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed")
    change = pyproj.Transformer.from_crs("EPSG:4978", crs, always_xy=True)
    return change.transform(*frame.geocentric_m(local).tolist())[:2]


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0, -2.5])
@pytest.mark.parametrize(
    ("frame", "zone"),
    [
        (LocalFrame(48.0, 11.0, 500.0), 32632),
        (LocalFrame(-33.4, -70.6, 900.0), 32719),
        (LocalFrame(86.0, 40.0, 0.0), 32661),
    ],
)
def test_a_point_lies_within_a_pixel_of_its_place(tmp_path, frame, zone, turn):
    stage = DirectImage(400.0, 300.0, 2.0, (30.0, -50.0), turn)
    image, place = image_of_a_point(stage, 171, 22)
    error = write_geotiff(image, tmp_path / "a.tif", stage, frame)
    assert error < 0.01
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.crs.to_epsg() == zone and file.gcps[0] == []
        values = file.read(1)
        row, column = np.unravel_index(values.argmax(), values.shape)
        x, y = on_the_map(frame, place, file.crs.to_string())
        assert np.hypot(*(np.array(file.xy(row, column)) - (x, y))) < 0.05  # m; a pixel has 2 m
        assert file.transform.a > 0 and file.transform.e < 0 and values.max() == 10


def test_large_images_have_control_points(tmp_path):
    frame, stage = LocalFrame(60.0, 11.9, 0.0), DirectImage(160e3, 160e3, 200.0)
    image, place = image_of_a_point(stage, 300, 131)
    error = write_geotiff(image, tmp_path / "a.tif", stage, frame, decibels=True)
    assert 0.1 < error < 1
    with rasterio.open(tmp_path / "a.tif") as file:
        points, crs = file.gcps
        assert len(points) == 49 and crs.to_epsg() == 32632
        values = file.read(1)
        assert values.max() == 0 and values.min() == pytest.approx(-40.0)
        rows, columns = np.nonzero(values == 0)
        from rasterio.transform import GCPTransformer

        with GCPTransformer(points) as change:
            found = change.xy(rows[0], columns[0])
        assert np.hypot(*(np.array(found) - on_the_map(frame, place, crs.to_string()))) < 200.0


def test_other_images_are_refused(tmp_path):
    stage = DirectImage(40.0, 30.0, 2.0)
    image, _ = image_of_a_point(stage, 1, 1)
    frame = LocalFrame(48.0, 11.0)
    with pytest.raises(ValueError, match="but its stage forms"):
        write_geotiff(image, tmp_path / "a.tif", DirectImage(40.0, 30.0, 1.0), frame)
    with pytest.raises(ValueError, match="a file holds one trial"):
        write_geotiff(image.with_data(image.data.expand(2, -1, -1)), tmp_path / "a.tif", stage, frame)
    assert not list(tmp_path.iterdir())


def test_a_strip_has_overviews_and_its_own_coordinates(tmp_path, monkeypatch):
    monkeypatch.setattr("torchsar.io.strip._PART_BYTES", 1 << 20)
    axes = (Axis("azimuth", 1700, 500.0, 2.0, "m"), Axis("range", 600, 9000.0, 4.0, "m"))
    data = torch.randn(1700, 600, dtype=torch.complex64)
    image = StripImage.create(tmp_path / "image.zarr", axes, torch.complex64, {}, {})
    image.write(slice(0, 1700), data, 0)
    assert main(["export", str(tmp_path), "--to", "geotiff", "--out", str(tmp_path / "out")]) == 0
    with rasterio.open(tmp_path / "out" / "image.tif") as file:
        assert np.array_equal(file.read(1), data.abs().numpy()) and file.block_shapes == [(512, 512)]
        assert file.xy(3, 5) == (9000.0 + 5 * 4.0, 500.0 + 3 * 2.0)
        assert file.overviews(1) == [2] and file.tags()["rows"] == "azimuth in m"
        half = file.read(1, out_shape=(850, 300))
        np.testing.assert_allclose(half, data.abs().reshape(850, 2, 300, 2).mean((1, 3)).numpy(), rtol=1e-5)
    assert main(["export", str(tmp_path), "--to", "sicd", "--out", str(tmp_path / "other")]) == 2
