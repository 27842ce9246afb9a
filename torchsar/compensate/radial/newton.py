"""Newton steps that refine the position of a peak after a coarse search.

Gradients pass through the steps, but not through the search.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import cis, power_of


def climbed(x: Tensor, weights: Tensor, value: Tensor, steps: int) -> Tensor:
    """Refine, by Newton steps, the value v for which |sum_i x_i exp(-j w_i v)| is greatest.

    Differentiable.

    Args:
        x: Samples x_i, shape (..., m), complex.
        weights: w_i in rad per unit of v, shape (m,).
        value: Values of v to start from, shape (...,).
        steps: Number of Newton steps.

    Returns:
        The refined values, shape (...,), float64.
    """
    w = weights.to(x.real.dtype)
    for _ in range(steps):
        turned = x * cis((-value[..., None] * weights).to(w.dtype))
        s0, s1, s2 = turned.sum(-1), (turned * w).sum(-1), (turned * w * w).sum(-1)
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
