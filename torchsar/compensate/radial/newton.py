"""Newton steps that refine a peak after a coarse, detached search."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import cis


def climbed(x: Tensor, weights: Tensor, value: Tensor, steps: int) -> Tensor:
    """Refine the value v of greatest |sum_i x_i exp(-j w_i v)| by Newton steps.

    Differentiable.

    Args:
        x: Samples, shape (..., m), complex.
        weights: w in rad per unit of the value, shape (m,).
        value: Values to start from, shape (...,).
        steps: Number of Newton steps.

    Returns:
        The refined values, shape (...,), float64.
    """
    w = weights.to(x.real.dtype)
    for _ in range(steps):
        turned = x * cis((-value[..., None] * weights).to(w.dtype))
        s0, s1, s2 = turned.sum(-1), (turned * w).sum(-1), (turned * w * w).sum(-1)
        gradient = 2 * (s0.conj() * s1).imag
        bend = 2 * (s1.real.square() + s1.imag.square() - (s0.conj() * s2).real)
        value = value + step_uphill(gradient, bend)
    return value


def step_uphill(gradient: Tensor, bend: Tensor) -> Tensor:
    """Compute a Newton step where the objective is concave, and zero elsewhere.

    Args:
        gradient: First derivative.
        bend: Second derivative.

    Returns:
        The step, float64.
    """
    concave = bend < 0
    return torch.where(concave, -gradient / torch.where(concave, bend, -1), 0).to(torch.float64)
