"""The warp of slow time by which a target that turns unevenly turns: angle = rate at the first
pulse * warp(time since the first pulse).

warp(t) = t + k1 t^2 / 2! + k2 t^3 / 3! + ..., so that k1 = acceleration / rate (1/s) and k2 = jerk
/ rate (1/s^2) are TRUE derivatives of the rate at the first pulse over that rate, not coefficients
of a polynomial: `coefficients_of` gives those (k1 / 2, k2 / 6; a factor of 2 or 6 is a silent
error). `k` is a tensor (..., order - 1), its last dim (k1, k2, ...); an empty one is even rotation.
Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.polynomial import legendre as series
from torch import Tensor


def warp(time_s: Tensor, k: Tensor) -> Tensor:
    """Warped time (s) at time_s since the first pulse.

    time_s: (m,) or (..., m); k: (..., order - 1). Returns (..., m). Differentiable.
    """
    return time_s * _horner(time_s, k, 2)


def warp_rate(time_s: Tensor, k: Tensor) -> Tensor:
    """Derivative of `warp`: rotation rate over the rate at the first pulse. Shapes as there."""
    return _horner(time_s, k, 1)


def _horner(time_s: Tensor, k: Tensor, first: int) -> Tensor:
    """1 + k1 t / first (1 + k2 / k1 t / (first + 1) ...), without the division: sum of k_i t^i
    (first - 1)! / (first - 1 + i)!.
    """
    trials = torch.broadcast_shapes(k.shape[:-1], time_s.shape[:-1])
    total, power = (
        torch.ones((*trials, time_s.shape[-1]), dtype=time_s.dtype, device=time_s.device),
        torch.ones_like(time_s),
    )
    for i in range(k.shape[-1]):
        power = power * time_s / (first + i)
        total = total + k[..., i, None] * power
    return total


def coefficients_of(k: Tensor) -> Tensor:
    """Coefficients of t^2, t^3, ... of the warp, k_i / (i + 1)!. (..., order - 1)."""
    return k / _factorials(k)


def k_of_coefficients(coefficients: Tensor) -> Tensor:
    """Inverse of `coefficients_of`."""
    return coefficients * _factorials(coefficients)


def _factorials(k: Tensor) -> Tensor:
    return torch.tensor([math.factorial(i + 2) for i in range(k.shape[-1])], dtype=k.dtype, device=k.device)


def least_rate(k: Tensor, duration_s: float, points: int = 513) -> Tensor:
    """Least derivative of the warp over 0..duration_s, (...,): at or below zero two times share an
    angle, and no image can be formed.
    """
    return warp_rate(torch.linspace(0, duration_s, points, dtype=torch.float64, device=k.device), k).amin(-1)


def shape_of(k: Tensor, duration_s: float) -> Tensor:
    """Legendre shape (q2, q3, ...) of the warp over 0..duration_s: warp = c1 (s + q2 P2(s) + q3
    P3(s) + ...) + const, s = 2 t / duration - 1.

    (..., order - 1) for any order. The shape is far better conditioned than k, whose errors pull
    against each other.
    """
    base, slopes = _legendre_of(k, duration_s)
    c = base + (k[..., None] * slopes).sum(-2)
    return c[..., 2:] / c[..., 1:2]


def k_of_shape(shape: Tensor, duration_s: float) -> Tensor:
    """Inverse of `shape_of`. Needs a warp that grows at the first pulse: 1 + sum q_j
    P_j'(-1) > 0.
    """
    order = shape.shape[-1] + 1
    half = duration_s / 2
    # rows: monomials in s + 1 = t / half of P1, P2, ...
    rows = _on(
        shape,
        np.stack(
            [
                _monomials(series.Legendre.basis(j).convert(kind=np.polynomial.Polynomial), order)
                for j in range(1, order + 1)
            ]
        ),
    )
    monomials = rows[0] + (shape[..., None] * rows[1:]).sum(-2)
    scale = torch.tensor(
        [math.factorial(j) / half**j for j in range(1, order + 1)], dtype=shape.dtype, device=shape.device
    )
    derivatives = monomials * scale
    return derivatives[..., 1:] / derivatives[..., :1]


def _monomials(polynomial: np.polynomial.Polynomial, order: int) -> np.ndarray:
    """Coefficients of (s + 1)^1..^order."""
    shifted = polynomial(np.polynomial.Polynomial([-1.0, 1.0])).coef
    return np.pad(shifted, (0, order + 1 - len(shifted)))[1:]


def _legendre_of(k: Tensor, duration_s: float) -> tuple[Tensor, Tensor]:
    """Legendre coefficients 0..order of t, and of t^(i+1) / (i+1)!

    for each k_i (order - 1, order + 1).
    """
    order, half = k.shape[-1] + 1, duration_s / 2

    def row(power: int) -> np.ndarray:
        found = series.poly2leg((np.polynomial.Polynomial([half, half]) ** power).coef) / math.factorial(power)
        return np.pad(found, (0, order + 1 - len(found)))

    return _on(k, row(1)), _on(
        k, np.stack([row(i + 2) for i in range(order - 1)]) if order > 1 else np.zeros((0, order + 1))
    )


def _on(like: Tensor, values: np.ndarray) -> Tensor:
    return torch.as_tensor(values, dtype=like.dtype, device=like.device)
