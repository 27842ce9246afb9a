"""Addresses of parameters, and checksums by which damaged files are found."""

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
        tree: Plain values, or mappings and sequences of them; other objects count by their repr().

    Returns:
        The text, in JSON.
    """
    return json.dumps(_plain(tree), sort_keys=True, separators=(",", ":"))


def _plain(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    # beyond 2^53, a float would make neighbouring whole numbers alike
    if x is None or isinstance(x, (bool, str)) or (isinstance(x, int) and abs(x) > 2**53):
        return x
    if isinstance(x, (int, float)):
        return float(x) + 0.0  # the sum makes -0.0 and 0.0, which are equal, alike
    return _plain(x.tolist()) if hasattr(x, "tolist") else repr(x)
