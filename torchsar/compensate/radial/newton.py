"""Newton steps that refine the position of a peak after a coarse search.

Gradients pass through the steps, but not through the search.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import linear_phasor, power_of


def climbed(x: Tensor, turns: float, value: Tensor, steps: int) -> Tensor:
    """Refine, by Newton steps, the value v for which |sum_i x_i exp(-2j pi turns i v)| is greatest.

    Differentiable.

    Args:
        x: Samples x_i, shape (..., m), complex.
        turns: Change of phase from sample to sample, in turns per unit of v.
        value: Values of v to start from, shape (...,).
        steps: Number of Newton steps.

    Returns:
        The refined values, shape (...,), float64.
    """
    n = x.shape[-1]
    middle = (n - 1) / 2
    w = (torch.arange(n, dtype=torch.float64, device=x.device) - middle) * (2 * math.pi * turns)
    powers = torch.stack([torch.ones_like(w), w, w * w], -1).to(x.dtype)
    for _ in range(steps):
        turned = x * linear_phasor(-turns * value, -middle, n, x.dtype)
        s0, s1, s2 = (turned @ powers).unbind(-1)
        gradient = 2 * (s0.conj() * s1).imag
        bend = 2 * (power_of(s1) - (s0.conj() * s2).real)
        value = value + step_uphill(gradient, bend)
    return value


def step_uphill(gradient: Tensor, bend: Tensor) -> Tensor:
    """Compute the Newton step towards a maximum; zero where the objective is not concave.

    Args:
        gradient: First derivative of the objective, any shape.
        bend: Second derivative of the objective, same shape.

    Returns:
        The step, same shape, float64.
    """
    concave = bend < 0
    return torch.where(concave, -gradient / torch.where(concave, bend, -1), 0).to(torch.float64)
