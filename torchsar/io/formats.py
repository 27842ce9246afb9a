"""The formats of data files, and the function that reads any of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from torchsar.core import Recording, Signal
from torchsar.io.cphd import read_cphd
from torchsar.io.fields import archive, refuse_absent
from torchsar.io.history import read_inverse, read_path
from torchsar.io.sicd import read_sicd
from torchsar.io.strip import read_stripmap


@dataclass(frozen=True)
class Format:
    """A format of data files.

    Args:
        name: Its name.
        suffixes: Endings of its files, in lower case.
        magic: Bytes with which its files may begin.
        read: Function that reads a file as a dtype; or the reason why it is not read, with what to
            do, as the end of a sentence.
    """

    name: str
    suffixes: tuple[str, ...]
    magic: tuple[bytes, ...]
    read: Callable[[Path, torch.dtype], Recording | Signal] | str


def _read_archive(path: Path, dtype: torch.dtype) -> Recording:
    """Read the recording in a numpy archive of any kind that this package reads."""
    keys = archive(path, "recorded data")
    if not {"iq", "history", "fp", "sig", "profiles"} & {*keys}:
        raise ValueError(
            f"{path} must hold one of the sample arrays iq (strip), history or fp (any path), sig (turntable) or "
            f"profiles (target in flight), got the keys {sorted(keys)}; torchsar import gives arrays these names"
        )
    if "iq" in keys:
        return read_stripmap(path, dtype)
    return (read_path if "history" in keys or "fp" in keys else read_inverse)(path, dtype)


_NEEDS_SIDECAR = (
    "must be imported first: torchsar import FILE --sidecar YAML --out RECORDING.npz, where the sidecar says what the "
    "file holds"
)
_NOT_COMPRESSED = (
    "holds received signals before range compression (CRSD), which are not read; convert it to compensated phase "
    "histories (CPHD)"
)
_TABLE = (
    "is a table of numbers, such as a motion log, and holds no samples; name it in the sidecar of the samples (side: "
    'transmitter_m: {file: FILE, name: "x,y,z"}), or read it by torchsar.radar.read_track'
)
# the first bytes of a file determine its format; the ending of its name is the second choice
FORMATS = (
    Format("CPHD", (".cphd",), (b"CPHD/",), read_cphd),
    Format("CRSD", (".crsd",), (b"CRSDsar/", b"CRSDtx/", b"CRSDrcv/"), _NOT_COMPRESSED),
    Format("SICD", (".nitf", ".ntf", ".sicd"), (b"NITF", b"NSIF"), read_sicd),
    Format("HDF5", (".h5", ".hdf5"), (b"\x89HDF\r\n\x1a\n",), _NEEDS_SIDECAR),
    Format("MATLAB", (".mat",), (b"MATLAB 5.0", b"MATLAB 7.3"), _NEEDS_SIDECAR),
    Format("table", (".csv", ".txt"), (), _TABLE),
    Format("numpy archive", (".npz",), (b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY"), _read_archive),
)


def format_of(path: str | Path) -> Format:
    """Find the format of a file by its first bytes, or else by its ending.

    Args:
        path: Path of the file.

    Returns:
        The format.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the format is not known.
    """
    path = Path(path)
    refuse_absent(path, "a data file")
    with path.open("rb") as file:
        head = file.read(16)
    matches = (
        *(one for one in FORMATS if head.startswith(one.magic)),
        *(one for one in FORMATS if path.suffix.lower() in one.suffixes),
    )
    if not matches:
        known = ", ".join(f"{one.name} ({', '.join(one.suffixes)})" for one in FORMATS)
        raise ValueError(
            f"{path} is of no known format; files that can be read are {known}; torchsar import reads others"
        )
    return matches[0]


def read(path: str | Path, dtype: torch.dtype = torch.complex64, channel: str | None = None) -> Recording | Signal:
    """Read a data file of any format, which its first bytes or its ending tell.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar import io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "turntable.npz"
    >>> sig, freq_hz = numpy.ones((3, 2), complex), [1e9, 2e9, 3e9]
    >>> numpy.savez(path, sig=sig, freq_hz=freq_hz, angle_deg=[0, 1])
    >>> io.read(path).signal.names
    ('pulse', 'range')

    Numpy archives (.npz) are read by `read_stripmap`, `read_path` or `read_inverse`, as their keys
    say; phase histories (CPHD) by `read_cphd`; complex images (SICD) by `read_sicd`.

    Args:
        path: Path of the file.
        dtype: complex64 or complex128, dtype of the samples.
        channel: Identifier of the channel of a CPHD file; None for its reference channel.

    Returns:
        Recording; of an image a Signal with the axes (azimuth, range).

    Raises:
        FileNotFoundError: If there is no such file.
        ModuleNotFoundError: If a library for the format is not installed; the message names the
            extra.
        ValueError: If the format is not known, or the file is damaged.
    """
    path, reader = Path(path), format_of(path).read
    if isinstance(reader, str):
        raise ValueError(f"{path} {reader}")
    if channel is None:
        return reader(path, dtype)
    if reader is not read_cphd:
        raise ValueError(f"{path} is no CPHD file, which alone has channels, got the channel {channel!r}; leave it out")
    return read_cphd(path, dtype, channel)


def read_history(path: str | Path, dtype: torch.dtype = torch.complex64, channel: str | None = None) -> Recording:
    """Read a phase history with the positions of its antennas from a file of any format.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar import io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flight.npz"
    >>> places = dict(transmitter_m=[[0, -5e3, 3e3], [1, -5e3, 3e3]], path_reference_m=[11e3, 11e3])
    >>> numpy.savez(path, history=numpy.ones((3, 2), complex), freq_hz=[1e9, 2e9, 3e9], **places)
    >>> io.read_history(path).aux["transmitter_m"].shape
    torch.Size([2, 3])

    Args:
        path: Path of the file.
        dtype: complex64 or complex128, dtype of the profiles.
        channel: Identifier of the channel of a CPHD file; None for its reference channel.

    Returns:
        Recording as by `read_path`.

    Raises:
        FileNotFoundError: If there is no such file.
        ModuleNotFoundError: If a library for the format is not installed.
        ValueError: If the file is damaged, of no known format, or has no such content.
    """
    found = format_of(path)
    if found.read is _read_archive and channel is None:
        return read_path(path, dtype)
    recording = read(path, dtype, channel)
    if not isinstance(recording, Recording) or "transmitter_m" not in recording.aux:
        raise ValueError(f"{path}: {found.name} holds no phase history with positions of the antennas")
    return recording
