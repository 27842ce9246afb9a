"""Newton steps that refine a peak around which a coarse search was detached."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import cis


def climbed(x: Tensor, weights: Tensor, value: Tensor, steps: int) -> Tensor:
    """The value v (...,) next to those given of greatest |sum_i x_i exp(-j w_i v)|, float64.

    x: (..., m) complex; weights: (m,), w in rad per unit of the value. Differentiable.
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
    """A Newton step where the objective bends down, nothing elsewhere; float64."""
    concave = bend < 0
    return torch.where(concave, -gradient / torch.where(concave, bend, -1), 0).to(torch.float64)
