"""Cubic splines through values at uneven knots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class UnevenSpline:
    """Cubic spline through values at rising knots, with not-a-knot conditions at both ends.

    The result is that of scipy.interpolate.CubicSpline with default settings. Two values give a
    straight line, three a parabola. Outside the knots the polynomials of the first and last
    interval continue. `UniformSpline` is faster where knots are equally spaced. Differentiable in
    the knots, the values and the times of evaluation. Leading dimensions are trials; those of
    knots, values and times broadcast.

    Args:
        knots: Times of the values, rising, shape (..., n) with n >= 2, float64.
        values: Values at the knots, shape (..., n), float64.

    Raises:
        TypeError: If a tensor is not float64.
        ValueError: If there are fewer than two knots, the numbers of knots and values differ, or
            the knots do not rise.
    """

    knots: Tensor
    values: Tensor

    def __post_init__(self) -> None:
        for name, value in {"knots": self.knots, "values": self.values}.items():
            if not isinstance(value, Tensor) or value.dtype != torch.float64:
                kind = getattr(value, "dtype", type(value).__name__)
                raise TypeError(f"a spline needs float64 {name}, got {kind}; convert them with .double()")
        shapes = tuple(self.knots.shape), tuple(self.values.shape)
        if not all(shapes) or shapes[0][-1] != shapes[1][-1] or shapes[0][-1] < 2:
            raise ValueError(f"a spline needs as many values (..., n) as knots (..., n), at least two, got {shapes}")
        if not bool((self.knots.detach().diff() > 0).all()):
            raise ValueError("the knots of a spline must rise; sort them and remove doubled ones")

    def at(self, t: Tensor) -> Tensor:
        """Evaluate the spline at given times.

        Args:
            t: Times, shape (..., m), float64.

        Returns:
            Values, shape (..., m).
        """
        bend = self._bend
        lead = torch.broadcast_shapes(bend.shape[:-1], t.shape[:-1])
        # knots and times alone have fewer trials than the values, often none
        few = torch.broadcast_shapes(self.knots.shape[:-1], t.shape[:-1])
        inner, asked = (x.detach().expand(*few, -1).contiguous() for x in (self.knots[..., 1:-1], t))
        piece = torch.searchsorted(inner, asked, right=True).expand(*lead, -1)
        (t0, t1), (y0, y1), (m0, m1) = (
            (x.expand(*lead, -1).gather(-1, piece), x.expand(*lead, -1).gather(-1, piece + 1))
            for x in (self.knots, self.values, bend)
        )
        h, since = t1 - t0, t - t0
        slope = (y1 - y0) / h - h * (2 * m0 + m1) / 6
        return y0 + since * (slope + since * (m0 / 2 + since * (m1 - m0) / (6 * h)))

    @cached_property
    def _bend(self) -> Tensor:
        """Second derivatives at the knots, shape (..., n)."""
        h = self.knots.diff()
        slope = self.values.diff() / h
        n = self.values.shape[-1]
        if n == 2:
            return torch.zeros_like(slope).expand(*slope.shape[:-1], 2)
        known = 6 * slope.diff()
        if n == 3:
            return (known / (3 * (h[..., :1] + h[..., 1:]))).expand(*known.shape[:-1], 3)
        # not-a-knot: the second derivative is linear over the first and over the last three knots
        (h0, h1), (g1, g0) = h[..., :2].split(1, -1), h[..., -2:].split(1, -1)
        below = torch.cat([torch.zeros_like(h0), h[..., 1:-2], g1 - g0 * g0 / g1], -1)
        above = torch.cat([h1 - h0 * h0 / h1, h[..., 2:-1], torch.zeros_like(g0)], -1)
        more = torch.cat([h0 * (1 + h0 / h1), torch.zeros_like(h[..., 1:-2]), g0 * (1 + g0 / g1)], -1)
        inner = _tridiagonal(below, 2 * (h[..., :-1] + h[..., 1:]) + more, above, known)
        first = inner[..., :1] + (inner[..., :1] - inner[..., 1:2]) * h0 / h1
        last = inner[..., -1:] + (inner[..., -1:] - inner[..., -2:-1]) * g0 / g1
        return torch.cat([first, inner, last], -1)


def _tridiagonal(below: Tensor, main: Tensor, above: Tensor, known: Tensor) -> Tensor:
    """Solve below[i] x[i-1] + main[i] x[i] + above[i] x[i+1] = known[i] by cyclic reduction.

    Each step eliminates the neighbours of all unknowns at once, which doubles the distance of those
    that are left. Rows are diagonally dominant, so that no pivots are needed.
    """
    below, above, x = below / main, above / main, known / main
    step = 1
    while step < known.shape[-1]:
        below0, above0, x0 = (_moved(v, step) for v in (below, above, x))
        below1, above1, x1 = (_moved(v, -step) for v in (below, above, x))
        main = 1 - below * above0 - above * below1
        x = (x - below * x0 - above * x1) / main
        below, above = -below * below0 / main, -above * above1 / main
        step *= 2
    return x


def _moved(x: Tensor, step: int) -> Tensor:
    """x[i - step] at each i of the last dimension, zero where there is none."""
    pad = (step, 0) if step > 0 else (0, -step)
    kept = x[..., : x.shape[-1] - step] if step > 0 else x[..., -step:]
    return torch.nn.functional.pad(kept, pad)
