"""Files of the numbers and arrays of a result."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import zarr
from torch import Tensor

from torchsar.core import Signal


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file. Numbers that are not finite become null, as the format requires."""
    path.write_text(json.dumps(_finite(tree), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _finite(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_finite(v) for v in x]
    if isinstance(x, Tensor):
        return _finite(x.tolist())
    return None if isinstance(x, float) and not math.isfinite(x) else x


def write_arrays(
    path: Path, images: Mapping[str, Signal], truth: Mapping[str, Tensor], estimates: Mapping[str, Mapping[str, Tensor]]
) -> None:
    """Write a zarr store of version 3: `METHOD/image` with its axes, `truth/NAME`, and
    `estimate/METHOD/STAGE.VALUE`.

    Args:
        path: Folder of the store.
        images: Images by path of their group.
        truth: True values by name.
        estimates: Estimates by method and name.
    """
    root = zarr.open_group(str(path), mode="w", zarr_format=3)
    for name, signal in images.items():
        group = root.create_group(name)
        for axis in signal.axes:
            _put(group, axis.name, axis.values(), (axis.name,), unit=axis.unit)
        _put(group, "image", signal.data, tuple(axis.name for axis in signal.axes), unit="1")
    if truth:
        group = root.create_group("truth")
        for name, value in truth.items():
            _put(group, name, value)
    if any(estimates.values()):
        group = root.create_group("estimate")
        for method, values in estimates.items():
            inner = group.create_group(method)
            for name, value in values.items():
                _put(inner, name, value)


def _put(group: zarr.Group, name: str, value: Tensor, dims: tuple[str, ...] | None = None, **attributes: Any) -> None:
    data = torch.as_tensor(value).detach().cpu().resolve_conj().numpy()
    chunks = tuple(min(n, 1024) for n in data.shape)
    array = group.create_array(
        name, shape=data.shape, dtype=data.dtype, chunks=chunks or "auto", dimension_names=dims, attributes=attributes
    )
    array[...] = data
