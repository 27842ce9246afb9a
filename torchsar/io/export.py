"""Files of the images and recordings of a run, in formats that other programs read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import nn

from torchsar.core import Recording, Signal
from torchsar.focus import PathImage
from torchsar.io.cphd import write_cphd
from torchsar.io.geometry import frame_of
from torchsar.io.geotiff import write_geotiff
from torchsar.io.netcdf import write_netcdf
from torchsar.io.sicd import write_sicd
from torchsar.radar import LocalFrame


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
