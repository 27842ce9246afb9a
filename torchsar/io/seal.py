"""Addresses of parameters, and checksums by which damaged files and zarr stores are found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

# entry of a tree in which its checksum is stored
SEAL = "checksum"


def checksum(arrays: Mapping[str, np.ndarray], about: Any = None) -> str:
    """Compute a checksum of named arrays.

    Args:
        arrays: Arrays of numbers by name, of any shape; their order does not matter, and every NaN
            counts as the same number.
        about: Values that JSON can hold, which are included.

    Returns:
        32 hexadecimal digits, which are different if a name, type, shape or number is.
    """
    found = hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16)
    for name, x in sorted(arrays.items()):
        content = np.where(np.isnan(x), np.asarray(np.nan, x.dtype), x) if x.dtype.kind in "fc" else x
        found.update(f"{name} {x.dtype.str} {x.shape} ".encode())
        found.update(np.ascontiguousarray(content).tobytes())
    return found.hexdigest()


def plain_files(path: Path) -> list[Path]:
    """List all files below a folder.

    Args:
        path: The folder.

    Returns:
        The files, sorted.

    Raises:
        ValueError: If anything but plain files and folders is there, such as a link or a pipe.
    """
    found = sorted(path.rglob("*"))
    for one in found:
        # one that another thread has renamed since it was listed is none of them
        if one.is_symlink() or (one.exists() and not (one.is_dir() or one.is_file())):
            raise ValueError(f"{one.relative_to(path)} is a link or no plain file")
    return [one for one in found if one.is_file()]


def files_checksum(path: Path, files: Iterable[Path]) -> str:
    """Compute a checksum of the names and the contents of files.

    Args:
        path: Folder to which the names are relative.
        files: The files.

    Returns:
        32 hexadecimal digits.

    Raises:
        OSError: If a file is missing or cannot be read.
    """
    found = hashlib.blake2b(digest_size=16)
    for file in files:
        found.update(f"{file.relative_to(path).as_posix()} {file.stat().st_size} ".encode())
        with file.open("rb") as content:
            while block := content.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def sealed(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a tree with its checksum.

    Args:
        tree: Values that JSON can hold, by name; other objects become texts. An earlier checksum in
            it is replaced.

    Returns:
        The tree as it is read back from JSON, with the checksum as a further entry.
    """
    plain = json.loads(json.dumps({name: value for name, value in tree.items() if name != SEAL}, default=str))
    return {**plain, SEAL: checksum({}, plain)}


def is_sealed(tree: Mapping[str, Any]) -> bool:
    """Check a tree that was read back.

    Args:
        tree: A tree with the checksum that `sealed` gave it.

    Returns:
        Whether the checksum is there and right.
    """
    return tree.get(SEAL) == checksum({}, {name: value for name, value in tree.items() if name != SEAL})


def address(parameters: Mapping[str, Any]) -> str:
    """Return a hash of the names and values of parameters, in whatever order they are given.

    The random numbers of a grid point follow from this hash. A point therefore has the same random
    numbers in every grid.

    Args:
        parameters: Values by name.

    Returns:
        24 hexadecimal digits.
    """
    return hashlib.blake2b(canonical(parameters).encode(), digest_size=12).hexdigest()


def canonical(tree: Any) -> str:
    """Return a text that is equal for equal content: keys are sorted, and 20 and 20.0 are alike.

    Args:
        tree: Plain values, or mappings and sequences of them; dataclasses count by
            their fields, and other objects by their repr().

    Returns:
        The text, in JSON.
    """
    return json.dumps(_plain(tree), sort_keys=True, separators=(",", ":"))


def _plain(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    # a float would make different whole numbers above 2^53 equal
    if x is None or isinstance(x, (bool, str)) or (isinstance(x, int) and abs(x) > 2**53):
        return x
    if isinstance(x, (int, float)):
        return float(x) + 0.0  # the addition turns -0.0 into 0.0, which is an equal number
    if is_dataclass(x):
        return {"": type(x).__qualname__} | {one.name: _plain(getattr(x, one.name)) for one in fields(x)}
    return _plain(x.tolist()) if hasattr(x, "tolist") else repr(x)


def document(path: Path) -> dict[str, Any]:
    """Read the metadata of a group or an array.

    Args:
        path: Folder of the group or array.

    Returns:
        Content of its file zarr.json.

    Raises:
        ValueError: If the file is no JSON.
        OSError: If it cannot be read.
    """
    return read_json(path / "zarr.json")


def read_json(path: Path, most_bytes: int = 1 << 28) -> Any:
    """Read a JSON file after a check of its size.

    Args:
        path: Path of the file.
        most_bytes: Largest size, above that of the manifest of a million files.

    Returns:
        Its content.

    Raises:
        ValueError: If the file is larger, or is no JSON.
        OSError: If it cannot be read.
    """
    if path.stat().st_size > most_bytes:
        raise ValueError(f"it has {path.stat().st_size} bytes, and may have {most_bytes}")
    return json.loads(path.read_text("utf-8"))


def group_attributes(path: Path, ours: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read the attributes of a group after a check of their checksum; see `sealed`.

    Args:
        path: Folder of the group.
        ours: Attributes that every group with a checksum has; other groups are not checked. By
            default every group with attributes is checked.

    Returns:
        The attributes; a new group has none.

    Raises:
        ValueError: If the attributes differ from their checksum, or have none.
        OSError: If they cannot be read.
    """
    tree = document(path)
    held = tree.get("attributes", {})
    checked = SEAL in held or all(held.get(name) == value for name, value in (ours or {}).items())
    if (tree.get("zarr_format"), tree.get("node_type")) != (3, "group") or (held and checked and not is_sealed(held)):
        raise ValueError("attributes differ from their checksum")
    return held


def array_metadata(path: Path) -> list[Any]:
    """Read the shape of an array, and compute a checksum of all its other metadata.

    Args:
        path: Folder of the array.

    Returns:
        The shape, which may grow, and the checksum.

    Raises:
        KeyError: If there is no shape.
        ValueError: If the file is no JSON.
        OSError: If it cannot be read.
    """
    tree = document(path)
    return [tree.pop("shape"), checksum({}, tree)]
