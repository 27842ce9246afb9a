"""Reader of the numbers in MATLAB files of version 5 to 7, with all sizes checked.

Later versions are HDF5. Source: MathWorks, MAT-File Format, 2018, level 5.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from torchsar.io.fields import joined

_HEADER = 128  # bytes
_MATRIX, _COMPRESSED = 14, 15  # types of elements, of the format
# numbers by the type of the element in which they are stored, of the format
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# numbers by the class of the array, which may be wider, of the format
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), 6))
_STRUCT, _COMPLEX = 2, 0x800  # class and flag, of the format
_DEEPEST, _MOST_DIMS = 50, 32  # structures inside each other and dims of an array, by choice
# bytes of a variable in which its name is, by choice: far more than names and dims take
_NAME_BYTES = 4096


class MatlabFile:
    """The variables in a MATLAB file.

    Args:
        path: Path of the file.

    Attributes:
        names: Names of all variables.

    Raises:
        ValueError: If the file is damaged or cut off.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            header = file.read(_HEADER)
            mark = header[126:]
            if mark not in (b"IM", b"MI"):
                raise ValueError("its header is damaged")
            self._order = "<" if mark == b"IM" else ">"
            self._places = dict(self._variables(file, path.stat().st_size))
        self.names = list(self._places)

    def load(self, name: str) -> np.ndarray:
        """Load an array.

        Args:
            name: Names of a variable and of fields of structures, with '/' between them.

        Returns:
            The array, with the dims that it has in MATLAB.

        Raises:
            KeyError: If there is no such array.
            ValueError: If it does not hold numbers, or the file is damaged.
        """
        first, *rest = name.split("/")
        offset, size, kind = self._places[first]
        with self._path.open("rb") as file:
            file.seek(offset)
            content = file.read(size)
        held = _Matrix.parsed(memoryview(_unpacked(content) if kind == _COMPRESSED else content), self._order)
        for field in rest[:_DEEPEST]:
            held = held.field(field)
        return held.numbers(name)

    def _variables(self, file: IO[bytes], size: int) -> Iterator[tuple[str, tuple[int, int, int]]]:
        """Names of the variables, with the offset, the size and the type of their elements."""
        at = _HEADER
        while at < size:
            file.seek(at)
            tag = np.frombuffer(file.read(8), f"{self._order}u4")
            kind, held = (int(x) for x in tag) if len(tag) == 2 else (0, 0)
            if kind not in (_MATRIX, _COMPRESSED) or at + 8 + held > size:
                raise ValueError(f"it is cut off or damaged at byte {at}")
            start = file.read(min(held, _NAME_BYTES))
            if kind == _COMPRESSED:
                start = zlib.decompressobj().decompress(start, _NAME_BYTES)
            yield _Matrix.parsed(memoryview(start)[8 * (kind == _COMPRESSED) :], self._order).name, (at + 8, held, kind)
            at += 8 + held


@dataclass(frozen=True)
class _Matrix:
    """An array before its content is read.

    Args:
        name: Its name; empty for a field of a structure.
        flags: Its class, and whether it is complex.
        dims: Its shape.
        content: The elements that follow.
        order: Byte order.
    """

    name: str
    flags: int
    dims: tuple[int, ...]
    content: memoryview
    order: str

    @classmethod
    def parsed(cls, data: memoryview, order: str) -> _Matrix:
        """The array in the content of an element."""
        (_, flags), rest = _element(data, order)
        (_, dims), rest = _element(rest, order)
        (_, name), rest = _element(rest, order)
        shape = tuple(np.frombuffer(dims, f"{order}i4").tolist())
        if len(flags) != 8 or not 2 <= len(shape) <= _MOST_DIMS or min(shape) < 0:
            raise ValueError("the header of an array is damaged")
        return cls(bytes(name).decode("latin-1"), int(np.frombuffer(flags, f"{order}u4")[0]), shape, rest, order)

    def field(self, wanted: str) -> _Matrix:
        """The array in a field of a structure."""
        if self.flags & 0xFF != _STRUCT or math.prod(self.dims) != 1:
            raise KeyError(wanted)
        (_, length), rest = _element(self.content, self.order)
        (_, text), rest = _element(rest, self.order)
        n = int(np.frombuffer(length, f"{self.order}i4")[0]) if len(length) == 4 else 0
        if n < 1:
            raise ValueError("the names of a structure are damaged")
        for at in range(0, len(text) - n + 1, n):
            (kind, data), rest = _element(rest, self.order)
            if kind != _MATRIX:
                raise ValueError("a structure is damaged")
            if bytes(text[at : at + n]).split(b"\0")[0].decode("latin-1") == wanted:
                return _Matrix.parsed(data, self.order)
        raise KeyError(wanted)

    def numbers(self, name: str) -> np.ndarray:
        """The numbers of the array."""
        kind = self.flags & 0xFF
        if kind not in _CLASSES:
            raise ValueError(
                f"{name} must be an array of numbers, not a text, cell, structure, object or sparse matrix"
            )
        wanted, rest, parts = np.dtype(_CLASSES[kind]), self.content, []
        for _ in range(2 if self.flags & _COMPLEX else 1):
            (stored, data), rest = _element(rest, self.order)
            if stored not in _STORED or len(data) != math.prod(self.dims) * int(_STORED[stored][1]):
                raise ValueError(f"{name} is damaged, since its size is not that of its shape {self.dims}")
            with np.errstate(invalid="ignore"):  # integers have a checked size, but not a checked type
                part = np.frombuffer(data, self.order + _STORED[stored]).astype(wanted)
            parts.append(part.reshape(self.dims, order="F"))
        return parts[0] if len(parts) == 1 else joined(*parts)


def _element(data: memoryview, order: str) -> tuple[tuple[int, memoryview], memoryview]:
    """The type and the content of the first element, and what follows."""
    if len(data) < 8:
        raise ValueError("it is cut off or damaged, since an element is missing")
    kind, size = (int(x) for x in np.frombuffer(data[:8], f"{order}u4"))
    if kind >> 16:  # a small element, with its content in the tag
        kind, size, first, after = kind & 0xFFFF, kind >> 16, 4, 8
    else:
        first, after = 8, 8 + -(-size // 8) * 8
    if (size > 4 and first == 4) or first + size > len(data):
        raise ValueError(f"it is cut off or damaged, since an element has {len(data) - first} of {size} bytes")
    return (kind, data[first : first + size]), data[after:]


def _unpacked(content: bytes) -> bytes:
    """The content of the element of a compressed variable."""
    try:
        return zlib.decompress(content)[8:]
    except zlib.error as error:
        raise ValueError(f"a compressed variable is damaged ({error})") from None
