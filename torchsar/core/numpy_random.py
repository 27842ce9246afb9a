"""Random numbers of numpy's generator, drawn on the host and then copied."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

# least count of numbers per trial for which several threads draw the trials
_MANY = 1 << 15


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
    out = np.empty((len(keys), *inner), np.float32 if dtype.to_real() == torch.float32 else np.float64)

    def draw(row: np.ndarray, generator: np.random.Generator) -> None:
        x = generator.standard_normal(inner)
        row[...] = x * (1 / 2**0.5) if dtype.is_complex else x

    fill(draw, [out[i, ...] for i in range(len(keys))], _generators(keys), math.prod(inner))
    made = torch.from_numpy(out.view(np.result_type(out, np.complex64)) if dtype.is_complex else out)
    return (made[..., 0] if dtype.is_complex else made).to(device=device, dtype=dtype)


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
    out = np.empty((len(keys), *shape))
    for i, generator in enumerate(_generators(keys)):
        out[i] = generator.uniform(low, high, tuple(shape))
    return torch.from_numpy(out).to(device=device, dtype=dtype)


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
    out = np.tile(np.arange(max(counts, default=0)), (len(keys), 1))
    for row, generator, count in zip(out, _generators(keys), counts, strict=True):
        row[:count] = generator.permutation(count)
    return torch.from_numpy(out).to(device)


def fill(draw: Callable[[Any, Any], object], rows: Sequence[Any], generators: Sequence[Any], n: int) -> None:
    """Draw the numbers of all trials: by several threads if a trial has many.

    Args:
        draw: Function that draws numbers from a generator into a row. It holds the lock of the
            interpreter only for a short time, as numpy and torch do.
        rows: Where the numbers of each trial are stored.
        generators: Generator of each trial.
        n: How many numbers the CPU draws for a trial.
    """
    threads = min(torch.get_num_threads(), len(rows)) if n > _MANY else 1
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(draw, rows, generators))
    else:
        for row, generator in zip(rows, generators, strict=True):
            draw(row, generator)


def _generators(keys: Sequence[int]) -> list[np.random.Generator]:
    return [np.random.Generator(np.random.Philox(key=key)) for key in keys]
