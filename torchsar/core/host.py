"""Values of tensors on the host, on which a program decides, and whether a device can compute."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

Number = TypeVar("Number", bool, int, float)


def host_value(x: Tensor, otherwise: Number) -> Number:
    """Read a number from a tensor, which waits for its device.

    Inside `torch.func.vmap` a tensor stands for many trials, and its value cannot be read.

    Args:
        x: Tensor of one element, which may require a gradient.
        otherwise: What to return inside vmap; its type is that of the result.

    Returns:
        The number.

    Raises:
        RuntimeError: If the tensor has more than one element, or the device fails.
    """
    try:
        return type(otherwise)(x.item())
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return otherwise


def host_largest(x: Tensor, otherwise: Number) -> Number:
    """Read the largest value of a tensor, which waits for its device.

    Args:
        x: Tensor of real numbers, any shape.
        otherwise: What to return if the tensor is empty, and inside vmap.

    Returns:
        The largest value.
    """
    return host_value(x.max(), otherwise) if x.numel() else otherwise


def device_fault(device: torch.device | str) -> str:
    """Find out whether a device can compute; on some devices allocation alone succeeds.

    Args:
        device: The device, such as "cpu" or "cuda:1".

    Returns:
        Why it cannot compute, in one line; empty if it can.
    """
    try:
        torch.zeros(1, dtype=torch.complex128, device=device).abs().item()
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        return str(error).splitlines()[0].rstrip(".")
    return ""
