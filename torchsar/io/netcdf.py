"""Writer of images as netCDF files."""

from __future__ import annotations

from pathlib import Path

import torch

from torchsar.core import Signal
from torchsar.io.extras import library, write_whole


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
