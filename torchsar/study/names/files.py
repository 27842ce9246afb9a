"""Parts of a world that are read from files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchsar.io.plain import measured_displacement, read_array, read_points
from torchsar.radar import read_track
from torchsar.scene import ImageReflectivity, MeasuredTrack, PointCloud, RecordedPath


def measured_track(file: str) -> MeasuredTrack:
    """Measured displacement at equally spaced times, interpolated by a cubic spline.

    Args:
        file: Text or .csv file of two columns, times in seconds and displacements in metres. They
            are separated by commas or blanks, and a line of names is allowed. Or .npy file of shape
            (n, 2), or .npz file with `time_s` (n,) and `displacement_m` (..., n).
    """
    time_s, displacement_m = (torch.as_tensor(x, dtype=torch.float64) for x in measured_displacement(file))
    try:
        return MeasuredTrack(time_s, displacement_m)
    except ValueError as problem:
        raise ValueError(f"{file}: {problem}") from None


def recorded_path(file: str, origin: Sequence[float] | None = None, start_s: float | None = None) -> RecordedPath:
    """Path of a motion log, between whose records cubic splines interpolate.

    Args:
        file: Table (.csv, text, .npz) with the columns time, x, y, z in s and m, or time, latitude,
            longitude, height in s, degrees and m, see `torchsar.radar.read_track`.
        origin: Origin of the coordinates of the world: x, y, z, or latitude, longitude, height;
            null for that of the log, or the place of its first record at height 0.
        start_s: Time of the first pulse on the clock of the log; null for the first record.
    """
    return RecordedPath(_read(read_track, file, origin), start_s)


def image_sea(
    file: str,
    azimuth_extent_m: Tensor | float,
    range_extent_m: Tensor | float,
    cnr_db: Tensor | float = 30.0,
    key: str | None = None,
    margin_s: float | None = None,
    lobes: int = 1,
    of: Literal["intensity", "amplitude"] = "intensity",
) -> ImageReflectivity:
    """Surface whose mean intensity is the image in a file.

    Args:
        file: Path of a .npy, .npz, .csv, HDF5 or MATLAB file, or of a picture, see
            `torchsar.io.read_array`.
        azimuth_extent_m: Along-track extent of the image in metres.
        range_extent_m: Range extent of the image in metres.
        cnr_db: Clutter-to-noise ratio of a range-compressed sample in dB.
        key: Name of the array in a file of several arrays.
        margin_s: Time in s by which the surface extends beyond the record at both ends; None to
            reach to the edge of the illumination.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface.
        of: What the pixels of a real image are.
    """
    image = np.asarray(_read(read_array, file, key))
    intensity = np.square(image, dtype=float) if of == "amplitude" and not np.iscomplexobj(image) else image
    return ImageReflectivity(
        intensity, azimuth_extent_m, range_extent_m, power_db=cnr_db, margin_s=margin_s, lobes=lobes
    )


def image_scene(
    file: str,
    azimuth_extent_m: float,
    range_extent_m: float,
    key: str | None = None,
    of: Literal["intensity", "amplitude"] = "amplitude",
    floor_db: float = -40.0,
    azimuth_m: Tensor | float = 0.0,
    range_m: Tensor | float = 0.0,
    heading_deg: Tensor | float = 0.0,
    fluctuation: Literal["phase", "speckle", "none"] = "phase",
) -> PointCloud:
    """Scene with a scatterer in the middle of every pixel of the image in a file.

    Args:
        file: Path of a .npy, .npz, .csv, HDF5 or MATLAB file with an array (azimuth, range), or of
            a picture, see `torchsar.io.read_array`.
        azimuth_extent_m: Azimuth extent of the image in metres.
        range_extent_m: Range extent of the image in metres.
        key: Name of the array in a file of several arrays.
        of: What the pixels of a real image are.
        floor_db: Level in dB relative to the brightest pixel, at or below which a pixel is left
            out.
        azimuth_m: Azimuth of the middle of the image in metres.
        range_m: Range of the middle of the image in metres.
        heading_deg: Angle in degrees by which the image is turned about its middle, from positive
            azimuth towards positive range.
        fluctuation: What each trial draws: "phase" of every scatterer, "speckle" (circular Gaussian
            amplitudes), or "none".
    """
    image = np.asarray(_read(read_array, file, key))
    amplitude = np.sqrt(image.clip(0), dtype=float) if of == "intensity" and not np.iscomplexobj(image) else image
    keys = {"azimuth_m": azimuth_m, "range_m": range_m, "heading_deg": heading_deg, "fluctuation": fluctuation}
    return PointCloud.of_image(amplitude, azimuth_extent_m, range_extent_m, floor_db, **keys)


def point_cloud(
    file: str,
    axes: Sequence[str] | None = None,
    scale: float = 1.0,
    azimuth_m: Tensor | float = 0.0,
    range_m: Tensor | float = 0.0,
    heading_deg: Tensor | float = 0.0,
    fluctuation: Literal["phase", "speckle", "none"] = "phase",
) -> PointCloud:
    """Scene of the points in a table, or of the vertices of a mesh.

    Args:
        file: Path of a table (.csv, text, .npy, or .npz with one array per column), or of a mesh
            (.ply, .obj), see `torchsar.io.read_points`.
        axes: Columns of azimuth (or cross range) and range, and of height for a world seen from any
            path; null for `azimuth`, `range` and, if there is one, `height`.
        scale: Length of one unit of the file in metres.
        azimuth_m: Azimuth of the origin of the file in metres.
        range_m: Range of the origin of the file in metres.
        heading_deg: Angle in degrees by which the points are turned about the origin, from positive
            azimuth towards positive range.
        fluctuation: What each trial draws: "phase" of every scatterer, "speckle" (circular Gaussian
            amplitudes), or "none".
    """
    keys = {"azimuth_m": azimuth_m, "range_m": range_m, "heading_deg": heading_deg, "fluctuation": fluctuation}
    return PointCloud(*_read(read_points, file, axes, scale), **keys)


def _read(read: Callable[..., Any], file: str, *keys: Any) -> Any:
    """Content that a function reads from a file. Raises ValueError if the file cannot be read."""
    try:
        return read(file, *keys)
    except OSError as error:
        raise ValueError(str(error)) from None
