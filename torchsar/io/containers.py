"""Arrays of numbers in files of many formats, which are read in parts.

HDF5 and MATLAB 7.3 need h5py, of the extra `formats`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from torchsar.core import ArrayFile, StoredArray
from torchsar.core.stored import Slices
from torchsar.io.extras import library, reading
from torchsar.io.fields import complex_type, joined, refuse_absent
from torchsar.io.matlab import MatlabFile
from torchsar.radar.track import read_table
from torchsar.spelling import did_you_mean

# lower-case names of the real and the imaginary part in a compound type
_PARTS = (("r", "i"), ("re", "im"), ("real", "imag"), ("i", "q"))


@dataclass(frozen=True)
class Container:
    """File with named arrays.

    Args:
        path: Path of the file.
        kind: Name of its format, for messages.
        find: Function that returns an array by name, unchecked, with what can read parts of it.
            It raises KeyError if there is no such array.
        names: Function that returns the names of all arrays.
    """

    path: Path
    kind: str
    find: Callable[[str], tuple[Any, Callable[[Slices], np.ndarray]]]
    names: Callable[[], Iterable[str]]

    def array(self, name: str | None) -> StoredArray:
        """Return an array by its name.

        Args:
            name: Its name, with '/' between the names of groups or structures and that of the
                array. In HDF5, `group@attribute` is an attribute. None for the only array.

        Returns:
            The array; nothing but its shape and type was read.

        Raises:
            ValueError: If there is no such array, or it does not hold numbers.
        """
        with reading(self.path, self.kind):
            names = list(self.names()) if name is None else [name]
            if len(names) != 1:
                raise ValueError(
                    f"{self.path} ({self.kind}) holds the arrays {', '.join(names)}; give the name of one of them"
                )
            name = names[0]
            try:
                array, part = self.find(name.strip("/"))
            except KeyError:
                hint = did_you_mean(name.strip("/"), self.names())
                raise ValueError(f"{self.path} ({self.kind}) has no array {name!r}{hint}") from None
        dtype, shape = getattr(array, "dtype", None), getattr(array, "shape", None)
        what = f"{self.path}: {name}" if name else f"{self.path}"
        if not isinstance(dtype, np.dtype) or shape is None:
            raise ValueError(f"{what} must hold numbers, got {type(array).__name__}")
        fields = dtype.names or ()
        paired = len(fields) == 2 and tuple(field.lower() for field in fields) in _PARTS
        if paired:
            dtype = complex_type(np.result_type(*(dtype[field] for field in fields)))
        if dtype.kind not in "iufc":
            raise ValueError(f"{what} must hold numbers, got {dtype}")

        def read(slices: Slices) -> np.ndarray:
            with reading(self.path, self.kind):
                held = part(slices)
                return joined(*(held[field] for field in fields)) if paired else held

        return StoredArray(what, tuple(shape), dtype, read)


def open_container(path: Path, stack: ExitStack) -> Container | None:
    """Open a file by the format that its first bytes show, HDF5, MATLAB or numpy, or a table (.csv,
    .txt) by its ending.

    Args:
        path: Path of the file.
        stack: Context that closes the file.

    Returns:
        The file; None if it is of no such format, such as flat binary data.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or cut off.
        ModuleNotFoundError: If the library of the format is not installed.
    """
    refuse_absent(path, "a file")
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(b"MATLAB 5.0"):
        with reading(path, "MATLAB 5"):
            variables = MatlabFile(path)
        return Container(path, "MATLAB 5", lambda name: _later(*variables.find(name)), lambda: variables.names)
    # The signature of HDF5 is at one of these byte positions, after a header of another program,
    # such as MATLAB.
    hdf5 = any(start.startswith(b"\x89HDF\r\n\x1a\n", at) for at in (0, 512, 1024, 2048))
    if hdf5 or start.startswith(b"MATLAB 7.3"):
        return _hdf5(path, stack, start.startswith(b"MATLAB"))
    if start.startswith((b"\x93NUMPY", b"PK\x03\x04")):
        held = ArrayFile(path)
        return Container(
            path,
            "numpy",
            lambda name: _later(x, x.load) if (x := held[name]).compressed else (x, x.part),
            lambda: held,
        )
    if path.suffix.lower() in (".csv", ".txt"):
        columns = read_table(path)
        return Container(path, "table", lambda name: _later(x := _columns(columns, name), lambda: x), lambda: columns)
    return None


def _columns(columns: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """One column of a table, or several columns with names separated by commas, (row, column)."""
    held = [columns[one.strip()] for one in name.split(",")]
    return held[0] if len(held) == 1 else np.stack(held, -1)


def flat_array(
    path: Path, dtype: np.dtype, shape: tuple[int, ...], header: int = 0, prefix: int = 0, suffix: int = 0
) -> StoredArray:
    """Describe flat binary data: a header, then numbers with the last dimension contiguous.

    Args:
        path: Path of the file.
        dtype: Type and byte order of the numbers.
        shape: Shape of the array.
        header: Number of bytes before the first line, which is an entry of the first dimension.
        prefix: Number of bytes before the numbers of each line.
        suffix: Number of bytes after them.

    Returns:
        The array, mapped into memory part by part.

    Raises:
        ValueError: If the size of the file is not that of header and array.
    """
    inner = [dtype.itemsize * math.prod(shape[i + 1 :]) for i in range(len(shape))]
    line = prefix + inner[0] + suffix
    held, needed = path.stat().st_size, header + shape[0] * line
    if held != needed:
        lines = "" if held < header else f", which would be {(held - header) / line:.6g} entries of its first dim"
        raise ValueError(
            f"{path} has {held} bytes, and header_bytes {header} with {dtype.name} of shape {shape} and "
            f"{prefix} and {suffix} bytes around each entry of the first dim needs {needed}{lines}; correct these "
            f"keys{', or copy the file again if it was cut off' if held < needed else ''}"
        )

    # mapped for each part, so that parts read before take no memory
    def part(slices: Slices) -> np.ndarray:
        mapped = np.memmap(path, np.uint8, "r", header)
        return np.array(np.ndarray(shape, dtype, mapped, prefix, (line, *inner[1:]))[slices])  # pyright: ignore[reportCallIssue, reportArgumentType]

    return StoredArray(str(path), shape, dtype, part)


def _hdf5(path: Path, stack: ExitStack, matlab: bool) -> Container:
    """Open a file with h5py; the arrays of a MATLAB file have their dimensions in reverse order."""
    h5py, kind = library("h5py", "formats", f"reading {path}"), "MATLAB 7.3" if matlab else "HDF5"
    with reading(path, kind):
        file = stack.enter_context(h5py.File(path, "r"))

    def find(name: str) -> tuple[Any, Callable[[Slices], np.ndarray]]:
        place, at, attribute = name.partition("@")
        if at:
            value = np.asarray(file[place or "/"].attrs[attribute])
            return _later(value, lambda: value)
        held = file[name]
        if isinstance(held, h5py.Dataset):
            _refuse_unwritten(held, path)
        if not matlab or not isinstance(held, h5py.Dataset):
            return held, lambda slices: held[slices]
        full = [slice(None)] * held.ndim
        header = np.broadcast_to(np.empty((), held.dtype), held.shape[::-1])
        return header, lambda slices: held[tuple(reversed([*slices, *full[len(slices) :]]))].T

    def names() -> list[str]:
        found: list[str] = []
        file.visititems(lambda name, held: found.append(name) if isinstance(held, h5py.Dataset) else None)
        return found

    return Container(path, kind, find, names)


def _refuse_unwritten(held: Any, path: Path) -> None:
    """Raise ValueError if parts of a dataset have no numbers in the file, which may be far larger
    than the file.
    """
    if held.is_virtual or held.external or not held.size:
        return
    chunks = math.prod(-(-n // chunk) for n, chunk in zip(held.shape, held.chunks)) if held.chunks else 1
    written = held.id.get_num_chunks() if held.chunks else int(held.id.get_storage_size() > 0)
    if written < chunks:
        raise ValueError(
            f"{path}: {held.name} of shape {held.shape} was not written as a whole, since the file has {written} of "
            f"its {chunks} parts; write zeros where samples are missing"
        )


def _later(array: Any, load: Callable[[], np.ndarray]) -> tuple[Any, Callable[[Slices], np.ndarray]]:
    """Pair an array, or its type and shape, with a function that loads it once for its parts."""
    whole = cache(load)
    return array, lambda slices: whole()[slices]
