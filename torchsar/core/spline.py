"""Cubic splines on a uniform grid, with their derivative and their integral."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv1d

# root of z^2 + 4 z + 1 inside the unit circle: the influence of a knot k steps away is z^k
_DECAY = math.sqrt(3.0) - 2.0
# half width of the truncated response in knots: |z|^32 = 5e-19 is below the precision of float64
_REACH = 32


@dataclass(frozen=True)
class UniformSpline:
    """Cubic spline through values at `start + i * step`, with not-a-knot conditions at both ends.

    The result is that of scipy.interpolate.CubicSpline with default settings. Two values give a
    straight line, three a parabola. Outside the grid the polynomials of the first and last interval
    continue. Differentiable in the values and in the times of evaluation.

    Args:
        values: Values at the knots, shape (..., n) with n >= 2, float64; leading dimensions are
            trials.
        start: Time of the first knot.
        step: Distance between knots, positive.

    Raises:
        TypeError: If the values are not float64.
        ValueError: If there are fewer than two values, the step is not positive, or start or step
            are not finite.
    """

    values: Tensor
    start: float
    step: float

    def __post_init__(self) -> None:
        if not isinstance(self.values, Tensor) or self.values.dtype != torch.float64:
            raise TypeError(
                "a spline needs float64 values, got "
                f"{getattr(self.values, 'dtype', type(self.values).__name__)}; convert them with "
                ".double()"
            )
        if self.values.ndim < 1 or self.values.shape[-1] < 2:
            raise ValueError(f"a spline needs at least two values (..., n), got shape {tuple(self.values.shape)}")
        if not (math.isfinite(self.start) and math.isfinite(self.step) and self.step > 0):
            raise ValueError(
                f"a spline needs a finite start and a positive step, got start={self.start}, step={self.step}"
            )

    def at(self, t: Tensor) -> Tensor:
        """Evaluate the spline at given times.

        Args:
            t: Times, any shape, float64, the same for all trials.

        Returns:
            Values, shape (..., *t.shape).
        """
        return self._polynomial(self._unit, t)

    def slope(self, t: Tensor) -> Tensor:
        """Evaluate the derivative of the spline at given times.

        Args:
            t: Times, any shape, float64, the same for all trials.

        Returns:
            Derivative in units of the values per unit of time, shape (..., *t.shape).
        """
        c0 = self._unit
        return self._polynomial([c0[1], 2 * c0[2], 3 * c0[3]], t) / self.step

    def integral(self, t: Tensor) -> Tensor:
        """Evaluate the integral of the spline from its first knot to given times.

        Args:
            t: Upper limits of the integral, any shape, float64, the same for all trials.

        Returns:
            Integral in units of the values times the unit of time, shape (..., *t.shape).
        """
        c = self._unit
        whole = c[0] + c[1] / 2 + c[2] / 3 + c[3] / 4
        before = torch.cat([torch.zeros_like(whole[..., :1]), whole.cumsum(-1)[..., :-1]], -1)
        return self._polynomial([before, c[0], c[1] / 2, c[2] / 3, c[3] / 4], t) * self.step

    def pieces(self) -> Tensor:
        """Return the polynomial coefficients of the spline in every interval between its n knots.

        Returns:
            Coefficients of the powers 0 to 3 of the time since the first knot of the interval,
            shape (..., n - 1, 4).
        """
        return torch.stack([c / self.step**power for power, c in enumerate(self._unit)], -1)

    @cached_property
    def _unit(self) -> list[Tensor]:
        """Coefficients (..., n - 1) of the powers 0..3 of the time in steps."""
        y, bend = self.values, second_differences(self.values)
        first, last = bend[..., :-1], bend[..., 1:]
        return [y[..., :-1], y[..., 1:] - y[..., :-1] - (2 * first + last) / 6, first / 2, (last - first) / 6]

    def _polynomial(self, powers: list[Tensor], t: Tensor) -> Tensor:
        """Evaluate polynomials by Horner's rule, each time in its interval."""
        position = (t.to(torch.float64) - self.start) / self.step
        piece = torch.floor(position.detach()).clamp(0, self.values.shape[-1] - 2)
        offset, index = position - piece, piece.to(torch.int64).flatten()
        total = torch.zeros_like(offset)
        for c in reversed(powers):
            total = total * offset + c.index_select(-1, index).reshape((*c.shape[:-1], *t.shape))
        return total


def second_differences(values: Tensor) -> Tensor:
    """Return the second derivatives at the knots of a not-a-knot spline with unit step.

    At the inner knots the second derivatives M of the spline through the values y solve M[i-1] + 4
    M[i] + M[i+1] = 6 (y[i-1] - 2 y[i] + y[i+1]). The not-a-knot condition makes M linear over the
    first three knots and over the last three. Then M[1] and M[n-2] are the second differences of y
    at these two knots. The equations for the knots between them are solved all at once: by
    convolution with the response of the infinite grid, z^|k| / (2 sqrt 3) at a distance of k knots
    with z = sqrt 3 - 2, plus two decaying terms that give M[1] and M[n-2] their values.

    Args:
        values: Values y at the knots, shape (..., n) with n >= 2, float64.

    Returns:
        Second derivatives, shape (..., n).
    """
    n = values.shape[-1]
    if n == 2:
        return torch.zeros_like(values)
    known = values[..., 2:] - 2 * values[..., 1:-1] + values[..., :-2]
    if n == 3:
        return known.expand_as(values)
    inner = _dirichlet(known)
    return torch.cat([2 * inner[..., :1] - inner[..., 1:2], inner, 2 * inner[..., -1:] - inner[..., -2:-1]], -1)


def _dirichlet(known: Tensor) -> Tensor:
    """Solve x[i-1] + 4 x[i] + x[i+1] = 6 known[i], with x equal to `known` at both ends."""
    m = known.shape[-1]
    away = torch.arange(-_REACH, _REACH + 1, dtype=torch.float64, device=known.device).abs()
    response = 6 * _power(away) / (2 * math.sqrt(3.0))
    endless = conv1d(known.reshape(-1, 1, m), response[None, None], padding=_REACH).reshape(known.shape)
    at = torch.arange(m, dtype=torch.float64, device=known.device)
    left, right, far = _power(at), _power(m - 1 - at), _DECAY ** (m - 1)
    first, last = known[..., :1] - endless[..., :1], known[..., -1:] - endless[..., -1:]
    scale = 1 / (1 - far * far)
    return endless + scale * ((first - far * last) * left + (last - far * first) * right)


def _power(k: Tensor) -> Tensor:
    """Power z^k of whole numbers k >= 0; z is negative."""
    return torch.where(k.remainder(2) == 0, 1.0, -1.0).to(k) * abs(_DECAY) ** k
