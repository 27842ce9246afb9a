"""Warped slow time of a target with non-uniform rotation.

The rotation angle of the target is the rotation rate at the first pulse times warp(t), where t is
the time since the first pulse and warp(t) = t + k1 t^2 / 2! + k2 t^3 / 3! + ... is the warped time.
The relative derivatives k1 = acceleration / rate (1/s), k2 = jerk / rate (1/s^2), ... are the
derivatives of the rotation rate at the first pulse, divided by that rate. The coefficients of the
polynomial are k1 / 2, k2 / 6, ... (see `coefficients_of`). A tensor `k` of shape (..., order - 1)
holds k1, k2, ...; an empty tensor means uniform rotation.

Reference:
    Remote Sens. 2025, 17, 3447, Eqs. (1)-(3).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.polynomial import legendre as series
from torch import Tensor


def warp(time_s: Tensor, k: Tensor) -> Tensor:
    """Compute the warped time t + k1 t^2 / 2! + k2 t^3 / 3! + ... of a rotating target.

    The rotation angle is the rotation rate at the first pulse times the warped time.
    Differentiable.

    Args:
        time_s: Time t since the first pulse in seconds, shape (m,) or (..., m).
        k: Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
            1/s, 1/s^2, ..., shape (..., order - 1).

    Returns:
        Warped time in seconds, shape (..., m).
    """
    return time_s * _horner(time_s, k, 2)


def warp_rate(time_s: Tensor, k: Tensor) -> Tensor:
    """Compute the rotation rate of a target relative to its rate at the first pulse.

    It is the derivative 1 + k1 t + k2 t^2 / 2! + ... of the warped time. Differentiable.

    Args:
        time_s: Time t since the first pulse in seconds, shape (m,) or (..., m).
        k: Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
            1/s, 1/s^2, ..., shape (..., order - 1).

    Returns:
        Ratio of rotation rates, without unit, shape (..., m).
    """
    return _horner(time_s, k, 1)


def _horner(time_s: Tensor, k: Tensor, first: int) -> Tensor:
    """Sum over i of k_i t^i (first - 1)! / (first - 1 + i)!, with k_0 = 1."""
    trials = np.broadcast_shapes(k.shape[:-1], time_s.shape[:-1])
    total, power = (
        torch.ones((*trials, time_s.shape[-1]), dtype=time_s.dtype, device=time_s.device),
        torch.ones_like(time_s),
    )
    for i in range(k.shape[-1]):
        power = power * time_s / (first + i)
        total = total + k[..., i, None] * power
    return total


def coefficients_of(k: Tensor) -> Tensor:
    """Convert relative derivatives of a rotation rate to the coefficients of the warped time.

    Args:
        k: Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
            1/s, 1/s^2, ..., shape (..., order - 1).

    Returns:
        Coefficients k_i / (i + 1)! of t^2, t^3, ... in the warped time, same shape and units.
    """
    return k / k.new_tensor([math.factorial(i + 2) for i in range(k.shape[-1])])


def least_rate(k: Tensor, duration_s: float, points: int = 513) -> Tensor:
    """Return the lowest rotation rate during the observation relative to that at the first pulse.

    Where it is zero or negative, the target stops or turns back, so that different times have the
    same angle and no image can be formed.

    Args:
        k: Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
            1/s, 1/s^2, ..., shape (..., order - 1).
        duration_s: Duration of the observation in seconds.
        points: Number of times at which the rate is evaluated.

    Returns:
        Lowest ratio of the rotation rate to that at the first pulse, shape (...,).
    """
    return warp_rate(torch.linspace(0, duration_s, points, dtype=torch.float64, device=k.device), k).amin(-1)


def shape_of(k: Tensor, duration_s: float) -> Tensor:
    """Convert relative derivatives of a rotation rate to Legendre coefficients of the warped time.

    The warped time is c0 + c1 (s + q2 P2(s) + q3 P3(s) + ...), with constants c0 and c1, the
    Legendre polynomials P2, P3, ... and s = 2 t / duration - 1. The coefficients q are better
    suited to a search than the relative derivatives k, whose estimation errors are strongly
    correlated.

    Args:
        k: Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
            1/s, 1/s^2, ..., shape (..., order - 1).
        duration_s: Duration of the observation in seconds.

    Returns:
        Legendre coefficients q2, q3, ..., without unit, same shape.
    """
    base, slopes = _legendre_of(k, duration_s)
    c = base + (k[..., None] * slopes).sum(-2)
    return c[..., 2:] / c[..., 1:2]


def k_of_shape(shape: Tensor, duration_s: float) -> Tensor:
    """Convert Legendre coefficients of the warped time to relative derivatives of the rate.

    This is the inverse of `shape_of`. The warped time is c0 + c1 (s + q2 P2(s) + q3 P3(s) + ...),
    with constants c0 and c1, the Legendre polynomials P_j and s = 2 t / duration - 1. It must rise
    at the first pulse (s = -1), that is, 1 + sum_j q_j P_j'(-1) > 0 with the derivatives P_j' of
    the polynomials.

    Args:
        shape: Legendre coefficients q2, q3, ..., without unit, shape (..., order - 1).
        duration_s: Duration of the observation in seconds.

    Returns:
        Derivatives k1, k2, ... of the rotation rate at the first pulse divided by that rate, in
        1/s, 1/s^2, ..., same shape.
    """
    order = shape.shape[-1] + 1
    half = duration_s / 2
    # each row: coefficients of one polynomial P1, P2, ... in powers of s + 1 = t / half
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
    """Coefficients of a polynomial for the powers (s + 1)^1 to (s + 1)^order."""
    shifted = polynomial(np.polynomial.Polynomial([-1.0, 1.0])).coef
    return np.pad(shifted, (0, order + 1 - len(shifted)))[1:]


def _legendre_of(k: Tensor, duration_s: float) -> tuple[Tensor, Tensor]:
    """Legendre coefficients of degree 0 to `order` of t, and of t^(i + 1) / (i + 1)! for
    each k_i.
    """
    order, half = k.shape[-1] + 1, duration_s / 2

    def row(power: int) -> np.ndarray:
        found = series.poly2leg((np.polynomial.Polynomial([half, half]) ** power).coef) / math.factorial(power)
        return np.pad(found, (0, order + 1 - len(found)))

    return _on(k, row(1)), _on(
        k, np.stack([row(i + 2) for i in range(order - 1)]) if order > 1 else np.zeros((0, order + 1))
    )


def _on(like: Tensor, values: np.ndarray) -> Tensor:
    """Convert values to a tensor with the dtype and the device of another one."""
    return torch.as_tensor(values, dtype=like.dtype, device=like.device)


def cut_warp(k: Tensor, order: int, duration_s: float) -> Tensor:
    """Approximate a warped time by one of lower order, in least squares over the observation.

    The warped time is t + k1 t^2 / 2! + k2 t^3 / 3! + ...; the approximation keeps its first
    Legendre terms and is scaled to a rate of one at the first pulse.

    Args:
        k: Relative derivatives k1, k2, ... of the rotation rate in 1/s, 1/s^2, ..., shape (..., m).
        order: Highest power of time in the approximation, 1 or more.
        duration_s: Duration of the observation in seconds.

    Returns:
        Relative derivatives of the approximation, shape (..., order - 1); `k` itself where it has
        fewer than `order` entries.
    """
    if order > k.shape[-1]:
        return k
    return k_of_shape(shape_of(k, duration_s)[..., : order - 1], duration_s) if order > 1 else k[..., :0]
