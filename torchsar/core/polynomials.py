"""Orthogonal polynomials, with which estimators describe smooth curves."""

from __future__ import annotations

import torch
from torch import Tensor


def legendre(u: Tensor, order: int) -> Tensor:
    """Evaluate the Legendre polynomials of degree 0 to `order`.

    >>> import torch
    >>> from torchsar.core import legendre
    >>> legendre(torch.tensor([0.0, 1.0]), order=2).tolist()
    [[1.0, 0.0, -0.5], [1.0, 1.0, 1.0]]

    The mean square of the polynomial of degree d over -1..1 is 1 / (2 d + 1). Differentiable.

    Args:
        u: Positions in -1..1, any shape, float.
        order: Highest degree.

    Returns:
        Values, shape (*u.shape, order + 1).
    """
    terms = [torch.ones_like(u), u]
    for k in range(1, order):
        terms.append(((2 * k + 1) * u * terms[k] - k * terms[k - 1]) / (k + 1))
    return torch.stack(terms[: order + 1], -1)
