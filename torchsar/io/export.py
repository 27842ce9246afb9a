"""Images and recordings in formats that other programs read."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from torchsar.core import Recording, Signal
from torchsar.focus.detection import to_db
from torchsar.focus.path_image import PathImage
from torchsar.io.cphd import write_cphd
from torchsar.io.extras import library, write_whole
from torchsar.io.geometry import frame_of, image_samples
from torchsar.io.sicd import write_sicd
from torchsar.io.strip import StripImage
from torchsar.radar import LocalFrame

# Largest distance in pixels between the affine map and the projection, by choice.
# Images with a larger distance are stored with ground control points.
_MOST_PIXELS = 0.1
# number of points along each axis at which the affine map is fitted, and which may become control
# points
_POINTS = 7
# _TILE: side of a tile in pixels, by choice
# _CACHE_BYTES: bytes of written tiles that are in memory, by choice
_TILE, _CACHE_BYTES = 512, 128 << 20


def write_geotiff(
    signal: Signal, path: str | Path, image: PathImage, frame: LocalFrame, decibels: bool = False
) -> float:
    """Write the amplitude of an image as a GeoTIFF in the projection UTM (polar stereographic near
    the poles).

    >>> import torch
    >>> from torchsar import Signal, focus, io, radar
    >>> stage = focus.DirectImage(azimuth_m=8.0, range_m=6.0, step_m=1.0)
    >>> image = Signal(torch.ones(9, 7, dtype=torch.complex64), stage.axes)
    >>> io.write_geotiff(image, "a.tif", stage, radar.LocalFrame(48, 11)) < 0.01  # doctest: +SKIP
    True

    Samples are not resampled. Columns are along the axis of the image that is closest to east, and
    rows along that closest to south; the file has the affine map of the pixels to the projection,
    with its rotation. If this map is wrong by more than a tenth of a pixel, as for images of more
    than about 100 km, the file has a grid of ground control points instead.

    Args:
        signal: Image of one trial with the axes (azimuth, range), as `image` returns it.
        path: Path of the file.
        image: Stage that formed the image.
        frame: Frame of its coordinates, such as LocalFrame(latitude_deg, longitude_deg, height_m);
            LocalFrame(*recording.aux["origin_deg_m"].tolist()) for a recording that holds it.
        decibels: True to write 20 lg of the amplitude relative to the largest one, False for the
            amplitude.

    Returns:
        Largest error of the affine map in pixels.

    Raises:
        ModuleNotFoundError: If rasterio is not installed (extra `geo`).
        FileNotFoundError: If the folder does not exist.
        ValueError: If the image has several trials, or is not of the stage.
    """
    rasterio, warp = (library(name, "geo", f"writing {path}") for name in ("rasterio", "rasterio.warp"))
    control = library("rasterio.control", "geo", f"writing {path}")
    data = image_samples(signal, image)
    amplitude = data.abs().double()
    values = to_db(amplitude.square()) if decibels else amplitude
    raster, corner, down, right = _north_up(values.float().numpy(), image)
    rows, columns = (np.linspace(0, n - 1, _POINTS) for n in raster.shape)
    rows, columns = (v.ravel() for v in np.meshgrid(rows, columns, indexing="ij"))
    local = torch.from_numpy(corner + rows[:, None] * down + columns[:, None] * right)
    crs = f"EPSG:{_zone(frame)}"
    earth = frame.geocentric_m(local).numpy()
    x, y = (np.asarray(v) for v in warp.transform("EPSG:4978", crs, *earth.T.tolist())[:2])
    # half a pixel is added because coordinates of a GeoTIFF refer to the corners of pixels
    terms = np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)], -1)
    affine, *_ = np.linalg.lstsq(terms, np.stack([x, y], -1), rcond=None)
    error = np.linalg.norm(terms @ affine - np.stack([x, y], -1), axis=-1).max() / image.grid.step_m
    place: dict[str, Any] = {"transform": rasterio.Affine(*affine[:, 0], *affine[:, 1])}
    if error > _MOST_PIXELS:
        found = zip(rows + 0.5, columns + 0.5, x, y, strict=True)
        place = {"gcps": [control.GroundControlPoint(*map(float, point)) for point in found]}

    def write(part: Path) -> None:
        height, width = raster.shape
        profile = {"driver": "GTiff", "height": height, "width": width, "count": 1, "dtype": "float32"}
        with rasterio.open(part, "w", **profile, crs=crs, **place) as file:
            file.write(raster, 1)
            file.set_band_description(1, "amplitude (dB)" if decibels else "amplitude")

    write_whole(path, write)
    return float(error)


def write_strip_geotiff(image: StripImage, path: str | Path) -> None:
    """Write the amplitude of a strip as a tiled GeoTIFF with overviews, reading it in parts.

    >>> import tempfile, torch
    >>> from torchsar import Axis, io
    >>> axes = Axis("azimuth", 8, 0.0, 2.0, "m"), Axis("range", 4, 9000.0, 3.0, "m")
    >>> image = io.StripImage.create(tempfile.mkdtemp(), axes, torch.complex64, {}, {})
    >>> io.write_strip_geotiff(image, "image.tif")  # doctest: +SKIP

    The file has columns along slant range and rows along azimuth, its coordinates are slant range
    and azimuth in metres, and it names no map projection: a straight stripmap path has no position
    on the Earth. Overviews are reduced by 2, 4, 8, ... with averaged amplitudes.

    Args:
        image: Image of `torchsar focus`.
        path: Path of the file.

    Raises:
        ModuleNotFoundError: If rasterio is not installed (extra `geo`).
        FileNotFoundError: If the folder does not exist.
        ValueError: If a chunk of the image is damaged.
    """
    rasterio, enums = (library(name, "geo", f"writing {path}") for name in ("rasterio", "rasterio.enums"))
    azimuth, range_ = image.axes
    corner = rasterio.Affine.translation(range_.start - range_.step / 2, azimuth.start - azimuth.step / 2)
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": azimuth.n,
        "width": range_.n,
        "count": 1,
        "dtype": "float32",
        "transform": corner * rasterio.Affine.scale(range_.step, azimuth.step),
        "tiled": True,
        "blockxsize": _TILE,
        "blockysize": _TILE,
        "BIGTIFF": "IF_SAFER",
    }
    fewest = max(1, max(azimuth.n, range_.n) // _TILE)
    factors = [2**k for k in range(1, fewest.bit_length())]

    def write(part: Path) -> None:
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES), rasterio.open(part, "w+", **profile) as file:
            for lines, signal in image.parts(_TILE):
                window = ((lines.start, lines.stop), (0, range_.n))
                file.write(signal.data.abs().float().numpy(), 1, window=window)
            file.set_band_description(1, "amplitude")
            file.update_tags(columns="slant range in m", rows="azimuth in m")
            if factors:
                file.build_overviews(factors, enums.Resampling.average)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        write_whole(path, write)


def _north_up(values: np.ndarray, image: PathImage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flip or transpose an image so that its rows are counted southward and its columns eastward.

    The directions are only approximate. Also returns the position of the first pixel, and the steps
    from row to row and from column to column in metres.
    """
    corner, step = image.grid.origin_m.numpy(), image.grid.step_m
    axes = [step * axis for axis in image.grid.axes.numpy()]
    if abs(axes[0][0]) > abs(axes[1][0]):
        values, axes = values.T, axes[::-1]
    for dim, ahead in ((0, -axes[0][1]), (1, axes[1][0])):
        if ahead < 0:
            corner = corner + (values.shape[dim] - 1) * axes[dim]
            values, axes[dim] = np.flip(values, dim), -axes[dim]
    return np.ascontiguousarray(values), corner, axes[0], axes[1]


def _zone(frame: LocalFrame) -> int:
    """EPSG code of the map projection for the position of a local frame."""
    north = frame.latitude_deg >= 0
    if abs(frame.latitude_deg) > 84 or frame.latitude_deg < -80:
        return 32661 if north else 32761
    longitude = (frame.longitude_deg + 180) % 360
    return (32600 if north else 32700) + math.floor(longitude / 6) + 1


def write_netcdf(signal: Signal, path: str | Path, title: str = "") -> None:
    """Write an image with its axes as a netCDF-4 file, which xarray and other programs open.

    >>> import h5py, tempfile, torch
    >>> from torchsar import Axis, Signal, io
    >>> axes = Axis("azimuth", 8, 0.0, 2.0, "m"), Axis("range", 4, 9000.0, 3.0, "m")
    >>> path = f"{tempfile.mkdtemp()}/image.nc"
    >>> io.write_netcdf(Signal(torch.ones(8, 4), axes), path)
    >>> sorted(h5py.File(path))
    ['azimuth', 'image', 'range']

    The format has no complex numbers: the variables `image_real` and `image_imag` are the parts of
    a complex image, and `image` is a real one. The coordinates of each axis are a variable with the
    name of the axis and the attribute `units`. The file has neither groups nor trials.

    Args:
        signal: Image without trials, (*axes), complex or real.
        path: Path of the file, which is replaced if it exists.
        title: Attribute `title` of the file.

    Raises:
        FileNotFoundError: If the folder does not exist.
        ModuleNotFoundError: If h5py is not installed (extra `formats`).
        ValueError: If the signal has trials.
    """
    if signal.trials:
        raise ValueError(f"a netCDF file holds one image, got trials of shape {tuple(signal.trials)}; select one")
    data = signal.data.detach().cpu().resolve_conj()
    parts = {"image_real": data.real, "image_imag": data.imag} if data.is_complex() else {"image": data}
    h5py = library("h5py", "formats", f"writing {path}")

    def write(part: Path) -> None:
        # netCDF lists variables in the order in which they were created
        with h5py.File(part, "w", track_order=True) as file:
            file.attrs["Conventions"], file.attrs["title"] = "CF-1.8", title
            for number, axis in enumerate(signal.axes):
                scale = file.create_dataset(axis.name, data=axis.values().numpy(), track_order=True)
                scale.attrs["units"], scale.attrs["_Netcdf4Dimid"] = axis.unit, number
                scale.make_scale(axis.name)
            for name, values in parts.items():
                variable = file.create_dataset(name, data=torch.resolve_neg(values).numpy(), track_order=True)
                variable.attrs["units"] = "1"
                for dim, axis in zip(variable.dims, signal.axes, strict=True):
                    dim.attach_scale(file[axis.name])

    write_whole(path, write)


def export_images(folder: Path, images: Mapping[str, Signal], title: str = "") -> None:
    """Write images as netCDF, each into a file of its name.

    Args:
        folder: The folder of the files.
        images: Images without trials by name; a '/' in a name makes a folder.
        title: Title of the experiment.

    Raises:
        ModuleNotFoundError: If h5py is not installed (extra `formats`).
    """
    for name, image in images.items():
        write_netcdf(image, _file(folder, f"{name}.nc"), f"{title}: {name}" if title else name)


def export_recording(
    folder: Path,
    form: str,
    name: str,
    recording: Recording,
    images: Mapping[str, tuple[Signal, nn.Module]],
    frame: LocalFrame | None = None,
) -> None:
    """Write a recording, or the images formed of it, in a format with positions on the Earth.

    Args:
        folder: The folder of the files.
        form: "cphd" for the recording, "sicd" or "geotiff" for the images.
        name: Name of the recording; a '/' in a name makes a folder.
        recording: Recording of one trial with the positions of the antennas.
        images: Images of one trial with the stages that formed them, by name. Images of other
            stages than `PathImage` are left out.
        frame: Frame of the local coordinates; None for that of the recording.

    Raises:
        ModuleNotFoundError: If the library of the format is not installed (extra `formats` or
            `geo`).
        ValueError: If the recording or an image cannot be written in this format.
    """
    if form == "cphd":
        write_cphd(recording, _file(folder, f"{name}.cphd"), frame)
        return
    for key, (image, stage) in images.items():
        if isinstance(stage, PathImage) and form == "sicd":
            write_sicd(image, _file(folder, f"{key}.nitf"), recording, stage, frame)
        elif isinstance(stage, PathImage):
            write_geotiff(image, _file(folder, f"{key}.tif"), stage, frame_of(recording, frame))


def _file(folder: Path, name: str) -> Path:
    """Path of a file in a folder, which is made if it does not exist."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
