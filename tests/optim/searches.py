"""Functions with a known minimum for searches without gradients."""

from __future__ import annotations

import math

import torch
from torch import Tensor

F64 = torch.float64
CENTRE = torch.tensor([0.3, -0.7, 1.1], dtype=F64)


def sphere(x: Tensor) -> Tensor:
    return (x - CENTRE.to(x.dtype)).square().sum(-1)


def rotated(x: Tensor) -> Tensor:
    """A quadratic whose valleys lie across the unknowns, condition 1000."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4), dtype=F64)).Q
    return ((x - CENTRE) @ turn * torch.tensor([1.0, 5.0, 31.6], dtype=F64)).square().sum(-1)


def rastrigin(x: Tensor) -> Tensor:
    """A function with a thousand minima, of which the deepest is at 0 and has cost 0."""
    return (x.square() - 10 * torch.cos(2 * math.pi * x) + 10).sum(-1)


def box(*trials: int, half: float = 5.0, n: int = 3) -> tuple[Tensor, Tensor]:
    high = torch.full((*trials, n), half, dtype=F64)
    return -high, high
