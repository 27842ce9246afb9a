"""Arrays in .npy and .npz files. Their shape, type and size are known before they are loaded."""

from __future__ import annotations

import io
import math
import os
import struct
import textwrap
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

# _MAGIC: first bytes of a file that holds a single array
# _LONGEST_HEADER: largest number of bytes before its numbers
_MAGIC, _LONGEST_HEADER = b"\x93NUMPY", 1 << 16
_AGAIN = "copy or save the file again"
Slices = tuple[slice, ...]


def machine_memory_bytes() -> int | None:
    """Return the size of the main memory of this machine.

    Returns:
        The size in bytes, or None on systems that do not report it.
    """
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def refuse_beyond_memory(what: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Check, before an array is loaded, that the main memory can hold it and a converted copy.

    Args:
        what: Path of the file and name of the array, for the message.
        shape: Its shape.
        dtype: Type of its numbers.

    Raises:
        ValueError: If it cannot.
    """
    size, memory = math.prod(shape) * dtype.itemsize, machine_memory_bytes()
    if memory is not None and 2 * size > memory:
        raise ValueError(
            f"{what}: {dtype} of shape {shape} takes {size / 1e9:.3g} GB, twice as much with a converted copy, and "
            f"this machine has {memory / 1e9:.3g} GB; cut the array into parts"
        )


@dataclass(frozen=True)
class StoredArray:
    """Array in a file that has not been loaded.

    Args:
        what: Path of the file and name of the array, for messages.
        shape: Shape of the array.
        dtype: Type of its numbers in the file.
        part: Function that reads the part which a slice for each of the first dimensions gives, and
            the whole array without slices.
        compressed: Whether it reads the whole array for every part.
    """

    what: str
    shape: tuple[int, ...]
    dtype: np.dtype
    part: Callable[[Slices], np.ndarray]
    compressed: bool = False

    @property
    def described(self) -> str:
        """Describe the type and the shape of the array in words."""
        return f"{self.dtype} of shape {self.shape}"

    def load(self, kinds: str = "") -> np.ndarray:
        """Load the array in the byte order of this machine.

        Args:
            kinds: Accepted types, each by a letter as in `numpy.dtype.kind`; empty for all.

        Returns:
            The array. Numbers that are wider than those of torch become float64 or complex128.

        Raises:
            ValueError: If the type is not accepted, the memory of the machine cannot hold the array
                and a converted copy, or the file is damaged.
        """
        if kinds and self.dtype.kind not in kinds:
            raise ValueError(f"{self.what} must hold {'' if 'c' in kinds else 'real '}numbers, got {self.described}")
        refuse_beyond_memory(self.what, self.shape, self.dtype)
        return self.read()

    def read(self, part: Slices = ()) -> np.ndarray:
        """Read a part of the array, given by a slice for each of the first dimensions, as `load`
        does.
        """
        widest = np.dtype({"f": np.float64, "c": np.complex128}.get(self.dtype.kind, self.dtype))
        kept = widest if self.dtype.itemsize > widest.itemsize else self.dtype.newbyteorder("=")
        with np.errstate(over="ignore"):
            return np.asarray(self.part(part)).astype(kept, copy=False)

    def rows(self, first: int, last: int) -> np.ndarray:
        """Load a part of the array along its first dimension; nothing else is in memory.

        Args:
            first: Index of the first row.
            last: Index after the last row, at most the length of the dimension.

        Returns:
            The rows, in the type that `load` returns.

        Raises:
            ValueError: If the array is compressed, or the file was cut off.
        """
        if self.compressed:
            raise ValueError(
                f"{self.what} is compressed, so that its rows cannot be read one by one; save it by numpy.savez, which "
                "does not compress"
            )
        return self.read((slice(first, last),))


class ArrayFile(Mapping[str, StoredArray]):
    """The arrays of a .npz file by name, or the single array of a .npy file under the name "".

    Only the headers of those arrays are read that are looked up, and nothing is loaded.

    Args:
        path: Path of the file; its suffix is of no importance.

    Raises:
        ValueError: If the file is empty, damaged, or of another format, or holds an array twice. A
            lookup raises it if the array is damaged, encrypted, or does not hold plain numbers or
            text.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            with self.path.open("rb") as file:
                start = file.read(len(_MAGIC))
        except OSError as error:
            raise ValueError(f"{path} cannot be read ({error.strerror or error})") from None
        if not start:
            raise ValueError(f"{path} is empty; {_AGAIN}")
        self._members = {"": None} if start == _MAGIC else self._archived(start)

    def _archived(self, start: bytes) -> dict[str, zipfile.ZipInfo | None]:
        """Members of the archive by the name of their array."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                found = [(info.filename.removesuffix(".npy"), info) for info in archive.infolist()]
        except Exception as error:  # numpy and zipfile raise errors of many kinds
            if start.startswith(b"PK"):
                raise ValueError(f"{self.path} is cut off or damaged ({_reason(error)}); {_AGAIN}") from None
            raise ValueError(
                f"{self.path} must be a numpy archive (.npz) or array (.npy), but it is a file of another kind; save "
                "the arrays by numpy.savez, or convert HDF5, MATLAB or flat binary data by torchsar import"
            ) from None
        members: dict[str, zipfile.ZipInfo | None] = {}
        for name, info in found:
            if name in members:
                raise ValueError(f"{self.path} holds the array {name!r} twice; save it again with one of them")
            members[name] = info
        return members

    def __getitem__(self, name: str) -> StoredArray:
        info, what = self._members[name], f"{self.path}: {name}" if name else str(self.path)
        size, opened = self.path.stat().st_size, partial(self.path.open, "rb")
        if info is not None:
            if info.flag_bits & 1:
                raise ValueError(f"{what} is encrypted; save the archive without a password")
            size, opened = info.file_size, partial(_member, self.path, info)
        stored = info is None or info.compress_type == zipfile.ZIP_STORED
        try:
            with opened() as stream:
                start = io.BytesIO(stream.read(_LONGEST_HEADER))
            one = np.lib.format.read_magic(start) == (1, 0)
            read = np.lib.format.read_array_header_1_0 if one else np.lib.format.read_array_header_2_0
            shape, turned, dtype = read(start)
            begin = start.tell() + (0 if info is None else _begin_of(self.path, info))
        except Exception as error:  # numpy and zipfile raise errors of many kinds
            raise ValueError(f"{what} is damaged or no numpy array ({_reason(error)}); {_AGAIN}") from None
        if dtype.hasobject:
            raise ValueError(f"{what} must hold plain numbers without pickled objects, got {dtype}; convert it")
        held, needed = size - start.tell(), math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or held != needed:
            raise ValueError(f"{what} is damaged: {dtype} of shape {shape} needs {needed} bytes, got {held}; {_AGAIN}")

        def part(slices: Slices) -> np.ndarray:
            if slices and stored:
                return self._rows(what, begin, shape, dtype, turned and len(shape) > 1, slices)
            try:
                with opened() as stream:
                    return np.lib.format.read_array(stream, allow_pickle=False)[slices]
            except Exception as error:  # numpy and zipfile raise errors of many kinds
                raise ValueError(f"{what} cannot be loaded ({_reason(error)}); {_AGAIN}") from None

        return StoredArray(what, shape, dtype, part, not stored)

    def _rows(
        self, what: str, begin: int, shape: tuple[int, ...], dtype: np.dtype, turned: bool, slices: Slices
    ) -> np.ndarray:
        """Read a part of an array that begins at a byte; `turned` if its first dimension is
        contiguous.
        """
        first, last, _ = slices[0].indices(shape[0])
        row = math.prod(shape[1:])
        if self.path.stat().st_size < begin + shape[0] * row * dtype.itemsize:
            raise ValueError(f"{what} was cut off while it was read; {_AGAIN}")
        if turned:
            return np.array(np.memmap(self.path, dtype, "r", begin, shape, "F")[slices], order="C")
        # read into memory, since the pages of a memory map count as memory of the process
        part = np.fromfile(self.path, dtype, (last - first) * row, offset=begin + first * row * dtype.itemsize)
        return part.reshape(last - first, *shape[1:])[(slice(None), *slices[1:])]

    def __contains__(self, name: object) -> bool:
        return name in self._members

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)


def _member(path: Path, info: zipfile.ZipInfo) -> IO[bytes]:
    """Open a member of an archive as a stream."""
    with zipfile.ZipFile(path) as archive:
        return archive.open(info)  # the file is closed together with the stream


def _begin_of(path: Path, info: zipfile.ZipInfo) -> int:
    """Position in the archive of the first byte of a member, after the header of the member."""
    with path.open("rb") as file:
        file.seek(info.header_offset)
        name, extra = struct.unpack("<26xHH", file.read(30))
    return info.header_offset + 30 + name + extra


def _reason(error: Exception) -> str:
    """First words of an error message in one line, or the kind of the error if it has no
    message.
    """
    return textwrap.shorten(str(error), 120, placeholder=" ...") or type(error).__name__
