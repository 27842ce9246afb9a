"""Random numbers of torch's generator, drawn on the device where they are used."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchsar.core.host import untraced
from torchsar.core.numpy_random import fill


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        dtype: Real or complex dtype; numbers of less than single precision are drawn in float32.
        device: Device on which they are drawn.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.
    """
    drawn = dtype if dtype.to_real() == torch.float64 else torch.promote_types(dtype, torch.float32)
    return _filled(lambda row, generator: row.normal_(generator=generator), keys, shape, drawn, device).to(dtype)


def uniform(
    keys: Sequence[int], shape: Sequence[int], low: float, high: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Draw uniform numbers.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        low: Lower limit.
        high: Upper limit.
        dtype: Dtype in which the numbers are drawn.
        device: Device on which they are drawn.

    Returns:
        Numbers of shape (trial, *shape).
    """
    return _filled(lambda row, generator: row.uniform_(low, high, generator=generator), keys, shape, dtype, device)


@untraced()
def permutation(keys: Sequence[int], counts: Sequence[int], device: torch.device) -> Tensor:
    """Draw whole numbers in random order.

    Args:
        keys: Key of each trial, of 128 bits.
        counts: Number of whole numbers of each trial.
        device: Device on which they are drawn.

    Returns:
        Numbers 0 to count - 1 of each trial in random order, and then those from its count on in
        rising order, (trial, largest count), int64.
    """
    out = torch.arange(max(counts, default=0), device=device).repeat(len(keys), 1)
    for row, generator, count in zip(out, _generators(keys, device), counts, strict=True):
        torch.randperm(count, generator=generator, out=row[:count])
    return out


@untraced()
def _filled(
    draw: Callable[[Tensor, torch.Generator], object],
    keys: Sequence[int],
    shape: Sequence[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """Make a tensor (trial, *shape) of random numbers that `draw` fills in."""
    with torch.inference_mode(False):  # the threads that fill the tensor are not in inference mode
        out = torch.empty(len(keys), *shape, dtype=dtype, device=device)
    fill(draw, out.unbind(), _generators(keys, device), math.prod(shape) if device.type == "cpu" else 0)
    return out


def _generators(keys: Sequence[int], device: torch.device) -> list[torch.Generator]:
    """Random generators, one for each trial, seeded with the lower half of its key."""
    # the device "meta" computes no numbers and has no generators
    place = torch.device("cpu") if device.type == "meta" else device
    return [torch.Generator(place).manual_seed(key % (1 << 64)) for key in keys]
