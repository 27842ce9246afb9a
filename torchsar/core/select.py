"""Choices made per trial: broadcasting, gathering and picking without leaving the batch."""

from __future__ import annotations

import torch
from torch import Tensor


def per_trial(value: Tensor | float, trailing: int, like: Tensor) -> Tensor:
    """A number or per-trial tensor (...,) as float64 with `trailing` unit dims behind, ready to
    broadcast against (..., a, b).
    """
    value = torch.as_tensor(value, dtype=torch.float64, device=like.device)
    return value[(...,) + (None,) * trailing]


def take(x: Tensor, index: Tensor, dim: int = -1) -> Tensor:
    """x[..., index, ...] along `dim` with one index per leading trial; index: shape of x without
    the dims from `dim` on.
    """
    dim = dim % x.ndim
    shape = index.shape + (1,) * (x.ndim - index.ndim)
    expanded = index.reshape(shape).expand(*x.shape[:dim], 1, *x.shape[dim + 1 :])
    return x.gather(dim, expanded).squeeze(dim)


def best_of(costs: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Per trial the candidate of least cost. costs, candidates: (candidate, ...).

    Returns (value, margin to the runner-up).
    """
    order = costs.argsort(dim=0)
    value = take(candidates.movedim(0, -1), order[0])
    if costs.shape[0] < 2:
        return value, torch.full_like(costs[0], torch.inf)
    ranked = costs.gather(0, order[:2])
    return value, ranked[1] - ranked[0]
