"""Random numbers of numpy's generator, drawn on the host and then copied.

The functions are those of `torchsar.core.philox`, with normal numbers by numpy's ziggurat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        dtype: Real or complex dtype; the numbers are drawn in float64 and then converted.
        device: Device of the result.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.
    """
    inner = (*shape, 2) if dtype.is_complex else tuple(shape)
    x = _stacked([np.asarray(g.standard_normal(inner)) for g in _generators(keys)])
    return (torch.view_as_complex(x) / 2**0.5 if dtype.is_complex else x).to(device=device, dtype=dtype)


def uniform(
    keys: Sequence[int], shape: Sequence[int], low: float, high: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Draw uniform numbers.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        low: Lower limit.
        high: Upper limit.
        dtype: Dtype of the result; the numbers are drawn in float64 and then converted.
        device: Device of the result.

    Returns:
        Numbers of shape (trial, *shape).
    """
    drawn = [np.asarray(g.uniform(low, high, tuple(shape))) for g in _generators(keys)]
    return _stacked(drawn).to(device=device, dtype=dtype)


def permutation(keys: Sequence[int], counts: Sequence[int], device: torch.device) -> Tensor:
    """Draw whole numbers in random order.

    Args:
        keys: Key of each trial, of 128 bits.
        counts: Number of whole numbers of each trial.
        device: Device of the result.

    Returns:
        Numbers 0 to count - 1 of each trial in random order, and then those from its count on in
        rising order, (trial, largest count), int64.
    """
    rows = [
        np.concatenate([g.permutation(count), np.arange(count, max(counts))])
        for g, count in zip(_generators(keys), counts, strict=True)
    ]
    return _stacked(rows).to(device=device, dtype=torch.int64)


def _generators(keys: Sequence[int]) -> list[np.random.Generator]:
    return [np.random.Generator(np.random.Philox(key=key)) for key in keys]


def _stacked(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))
