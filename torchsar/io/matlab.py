"""Reader of the numbers in MATLAB files of version 5 to 7, with all sizes checked.

The reader of scipy ends the whole program at some damaged files. Later versions are HDF5. Source:
MathWorks, MAT-File Format, 2018, level 5.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchsar.core.stored import refuse_beyond_memory
from torchsar.io.fields import complex_type, joined

# numbers fixed by the format: types of elements, class of structures, and flag of complex numbers
_MATRIX, _COMPRESSED, _STRUCT, _COMPLEX = 14, 15, 2, 0x800
# numpy type of stored numbers for each type of element, fixed by the format
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# numpy type of an array for each class of array, fixed by the format; it may be wider than the
# stored type
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), 6))


# name of a variable or field, with the number of an element if it is an array of structures
_PLACE = re.compile(r"([^()]*)(?:\((\d+)\))?.*", re.DOTALL)


class _Matrix(NamedTuple):
    """Header of an array (name, class with flags, shape) and the elements that follow it."""

    name: str
    flags: int
    shape: tuple[int, ...]
    elements: Iterator[tuple[int, memoryview]]


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
        data = memoryview(np.memmap(path, np.uint8, "r"))  # pyright: ignore[reportArgumentType]
        mark = bytes(data[126:128])
        if mark not in (b"IM", b"MI"):
            raise ValueError("its header is damaged")
        self._order = "<" if mark == b"IM" else ">"
        self._variables: dict[str, tuple[int, memoryview]] = {}
        for kind, content in self._elements(data[128:]):
            if kind not in (_MATRIX, _COMPRESSED):
                raise ValueError("it is cut off or damaged, since a variable is none")
            self._variables[self._matrix(self._start(kind, content)).name] = kind, content
        self.names = list(self._variables)

    def find(self, name: str) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
        """Find an array, without its numbers if it is a variable of its own.

        Args:
            name: Names of a variable and of fields of structures, with '/' between them, and
                elements of arrays of structures as in MATLAB, such as `data(2)/fp`.

        Returns:
            An array of its type and shape without content, and the function that loads the array,
            with the dims that it has in MATLAB.

        Raises:
            KeyError: If there is no such array.
            ValueError: If it does not hold numbers, or the file is damaged; the function, too.
        """
        (first, index), *fields = (_PLACE.fullmatch(part).groups() for part in name.split("/"))  # pyright: ignore[reportOptionalMemberAccess]
        kind, content = self._variables[first]
        held = self._matrix(self._whole(kind, content) if fields else self._start(kind, content))
        for field, next_index in fields:
            held, index = self._field(held, first, index, field), next_index
            first = f"{first}/{field}"
        if held.flags & 0xFF not in _CLASSES:
            raise ValueError(
                f"{name} must be an array of numbers, not a text, cell, structure, object or sparse matrix"
            )
        dtype = np.dtype(_CLASSES[held.flags & 0xFF])
        header = np.broadcast_to(np.empty((), complex_type(dtype) if held.flags & _COMPLEX else dtype), held.shape)
        return header, lambda: self._numbers(held if fields else self._matrix(self._whole(kind, content)), name)

    def _start(self, kind: int, content: memoryview) -> memoryview:
        """Content of a variable, or the first 4096 bytes of a compressed one: its name and dims
        need far less.
        """
        if kind != _COMPRESSED:
            return content
        return memoryview(zlib.decompressobj().decompress(content[:4096], 4096))[8:]

    def _whole(self, kind: int, content: memoryview) -> memoryview:
        """Content of a variable. The size that a compressed one states is checked before."""
        if kind != _COMPRESSED:
            return content
        head, unpacking = self._matrix(self._start(kind, content)), zlib.decompressobj()
        size = 8 + int(np.frombuffer(zlib.decompressobj().decompress(content[:4096], 8), f"{self._order}u4")[1])
        # 16 bytes hold any number, and 4096 what precedes them
        if head.flags & 0xFF in _CLASSES and size > 4096 + 16 * math.prod(head.shape):
            raise ValueError(f"{head.name} is damaged, since {size} bytes are not those of its shape {head.shape}")
        refuse_beyond_memory(head.name, (size,), np.dtype("u1"))
        try:
            data = unpacking.decompress(content, size + 1)
        except zlib.error as error:
            raise ValueError(f"a compressed variable is damaged ({error})") from None
        if len(data) != size or not unpacking.eof:
            raise ValueError(f"{head.name} is damaged, since its compressed numbers do not have its size")
        return memoryview(data)[8:]

    def _matrix(self, data: memoryview) -> _Matrix:
        """Parse the content of an element as an array."""
        elements = self._elements(data)
        flags, dims, name = (next(elements, (0, b""))[1] for _ in range(3))
        shape = tuple(np.frombuffer(dims, f"{self._order}i4").tolist())
        if len(flags) != 8 or not 2 <= len(shape) <= 32 or min(shape) < 0:
            raise ValueError("the header of an array is damaged")
        kind = int(np.frombuffer(flags, f"{self._order}u4")[0])
        return _Matrix(bytes(name).decode("latin-1"), kind, shape, elements)

    def _field(self, held: _Matrix, owner: str, index: str | None, wanted: str) -> _Matrix:
        """Find the array in a field of a structure, or of one element of an array of structures."""
        count = math.prod(held.shape)
        if held.flags & 0xFF != _STRUCT:
            raise KeyError(wanted)
        length, text = (next(held.elements, (0, b""))[1] for _ in range(2))
        n = int(np.frombuffer(length, f"{self._order}i4")[0]) if len(length) == 4 else 0
        if n < 1:
            raise ValueError("the names of a structure are damaged")
        names = [bytes(text[at : at + n]).split(b"\0")[0].decode("latin-1") for at in range(0, len(text) - n + 1, n)]
        element = int(index or "1") - 1
        if wanted not in names or not 0 <= element < count or (index is None and count > 1):
            raise ValueError(
                f"{owner} is an array of {count} structures with the fields {', '.join(names)}; name a field of one of "
                f"them, such as {owner}{'(1)' if count > 1 else ''}/{names[0]}, got {owner}"
                f"{f'({index})' if index else ''}/{wanted}"
            )
        kind, data = next(islice(held.elements, element * len(names) + names.index(wanted), None), (0, memoryview(b"")))
        if kind != _MATRIX:
            raise ValueError("a structure is damaged")
        return self._matrix(data)

    def _numbers(self, held: _Matrix, name: str) -> np.ndarray:
        """Parse the numbers of an array."""
        kind, parts = held.flags & 0xFF, []
        for _ in range(2 if held.flags & _COMPLEX else 1):
            stored, data = next(held.elements, (0, b""))
            if stored not in _STORED or len(data) != math.prod(held.shape) * int(_STORED[stored][1]):
                raise ValueError(f"{name} is damaged, since its size is not that of its shape {held.shape}")
            # the size of the stored numbers is checked, but not whether they fit the type of the
            # array
            with np.errstate(invalid="ignore"):
                part = np.frombuffer(data, self._order + _STORED[stored]).astype(_CLASSES[kind])
            parts.append(part.reshape(held.shape, order="F"))
        return parts[0] if len(parts) == 1 else joined(*parts)

    def _elements(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """Yield the type and the content of each element."""
        while len(data):
            if len(data) < 8:
                raise ValueError("it is cut off or damaged, since an element is missing")
            kind, size = np.frombuffer(data[:8], f"{self._order}u4").tolist()
            first, after = 8, 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
            if kind >> 16:  # a small element, whose content is inside the tag
                kind, size, first, after = kind & 0xFFFF, kind >> 16, 4, 8
            if (size > 4 and first == 4) or first + size > len(data):
                raise ValueError(f"it is cut off or damaged, since an element has {len(data) - first} of {size} bytes")
            yield kind, data[first : first + size]
            data = data[after:]
