"""Cubic splines through values on a uniform grid: smooth curves between pulses, with slope and
integral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv1d

# the root of z^2 + 4 z + 1 inside the unit circle: what happens k knots away counts z^k
_DECAY = math.sqrt(3.0) - 2.0
_REACH = 32


@dataclass(frozen=True)
class UniformSpline:
    """The cubic spline through values at `start + i * step`, not-a-knot at both ends (as
    scipy.interpolate.CubicSpline by default).

    values: float64 (..., n), n >= 2; two make a line, three a parabola. Leading dims are trials,
    the grid is one for all. Outside the grid the end pieces go on. Differentiable in the values and
    in the times of evaluation. Raises TypeError for values that are not float64, ValueError for
    fewer than two of them or a step that is not positive.
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
        """Value at float64 times of any shape, which all trials share: (..., *t.shape)."""
        return self._polynomial(self._unit, t)

    def slope(self, t: Tensor) -> Tensor:
        """Derivative, in units of values per unit of time, (..., *t.shape)."""
        c0 = self._unit
        return self._polynomial([c0[1], 2 * c0[2], 3 * c0[3]], t) / self.step

    def integral(self, t: Tensor) -> Tensor:
        """Antiderivative that is zero at `start`, (..., *t.shape)."""
        c = self._unit
        whole = c[0] + c[1] / 2 + c[2] / 3 + c[3] / 4
        before = torch.cat([torch.zeros_like(whole[..., :1]), whole.cumsum(-1)[..., :-1]], -1)
        return self._polynomial([before, c[0], c[1] / 2, c[2] / 3, c[3] / 4], t) * self.step

    def pieces(self) -> Tensor:
        """Polynomial coefficients (..., n - 1, 4) of each interval, rising powers of the time since
        its first knot.
        """
        return torch.stack([c / self.step**power for power, c in enumerate(self._unit)], -1)

    @cached_property
    def _unit(self) -> list[Tensor]:
        """Coefficients (..., n - 1) of powers 0..3 of the time in steps."""
        y, bend = self.values, second_differences(self.values)
        first, last = bend[..., :-1], bend[..., 1:]
        return [y[..., :-1], y[..., 1:] - y[..., :-1] - (2 * first + last) / 6, first / 2, (last - first) / 6]

    def _polynomial(self, powers: list[Tensor], t: Tensor) -> Tensor:
        """Horner's rule on the interval of each time."""
        position = (t.to(torch.float64) - self.start) / self.step
        piece = torch.floor(position.detach()).clamp(0, self.values.shape[-1] - 2)
        offset, index = position - piece, piece.to(torch.int64).flatten()
        total = torch.zeros_like(offset)
        for c in reversed(powers):
            total = total * offset + c.index_select(-1, index).reshape((*c.shape[:-1], *t.shape))
        return total


def second_differences(values: Tensor) -> Tensor:
    """Second derivatives at the knots of the not-a-knot spline through values (..., n) one apart,
    (..., n).

    M[i-1] + 4 M[i] + M[i+1] = 6 (y[i-1] - 2 y[i] + y[i+1]) inside. With M linear through the first
    three knots, row 1 says M[1] = the second difference there, and so at the other end; between
    them the rows are solved at once by the decaying response of the endless grid, z^|k| / (2 sqrt
    3), and two decaying terms that meet the known ends.
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
    """x (..., m) with x[i-1] + 4 x[i] + x[i+1] = 6 known[i] between its ends, and equal to `known`
    at them; m >= 2.
    """
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
    """z^k of whole numbers k >= 0: z is negative."""
    return torch.where(k.remainder(2) == 0, 1.0, -1.0).to(k) * abs(_DECAY) ** k
