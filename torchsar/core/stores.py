"""Metadata of zarr stores of version 3, read directly from their files and checked."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchsar.core.seal import SEAL, checksum, is_sealed


def fault_of_name(name: Any, longest: int) -> str:
    """Decide whether a store can have an entry of some name, for which it makes a folder.

    Args:
        name: The name.
        longest: Largest number of bytes; file systems allow 255, and names of files are longer.

    Returns:
        The reason why it cannot be used, as the end of a sentence; empty if it can.
    """
    if not isinstance(name, str) or name.strip() in ("", ".", "..", "zarr.json") or re.search("^__|/", name):
        return "since names are words without '/' that do not begin with '__'"
    if not name.isprintable():
        return "since names have only printable characters"
    size = len(name.encode())
    return f"since it has {size} bytes; use {longest} at most" if size > longest else ""


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
    return json.loads((path / "zarr.json").read_text("utf-8"))


def group_attributes(path: Path, ours: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read the attributes of a group after a check of their checksum; see `torchsar.core.sealed`.

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
