"""Metadata of zarr stores of version 3, read directly from their files and checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchsar.core.seal import SEAL, checksum, is_sealed


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
