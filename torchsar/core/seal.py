"""Checksums of arrays and of trees of plain values, by which damaged files are found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

# entry of a tree that holds its checksum
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
