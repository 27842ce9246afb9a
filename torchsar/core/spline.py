"""Cubic splines and orthogonal polynomials, with which estimators describe smooth curves.

A spline passes through values at even or uneven knots and can be integrated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv1d

# root of z^2 + 4 z + 1 inside the unit circle; a value acts on a point k knots away by z^k
_DECAY = math.sqrt(3.0) - 2.0
# half width of the truncated response in knots; |z|^32 = 5e-19 is below the precision of float64
_REACH = 32


@dataclass(frozen=True, eq=False)
class Spline:
    """Cubic spline through values at knots, with not-a-knot conditions at both ends.

    >>> import torch
    >>> from torchsar.core import Spline
    >>> t = torch.arange(5, dtype=torch.float64)
    >>> Spline(t**3, (0.0, 1.0)).at(torch.tensor([1.5], dtype=torch.float64))
    tensor([3.3750], dtype=torch.float64)

    The result is that of scipy.interpolate.CubicSpline with default settings. Two values give a
    straight line, three a parabola. Outside the knots the polynomials of the first and last
    interval continue. Differentiable in the values, the times of evaluation and uneven knots.

    Args:
        values: Values at the knots, shape (..., n) with n >= 2, float64; leading dimensions are
            trials.
        knots: Time of the first knot and positive distance of neighbours (start, step), which is
            faster; or the times of all knots, rising, shape (..., n), float64.

    Raises:
        TypeError: If values or knots are not float64, or the knots neither a tensor nor a tuple of
            two numbers.
        ValueError: If there are fewer than two values, the numbers of knots and values differ, the
            knots do not rise, or start or step are not finite.
    """

    values: Tensor
    knots: Tensor | tuple[float, float]

    def __post_init__(self) -> None:
        even = not isinstance(self.knots, Tensor)
        for name, x in {"values": self.values, "knots": self.values if even else self.knots}.items():
            if not isinstance(x, Tensor) or x.dtype != torch.float64:
                kind = getattr(x, "dtype", type(x).__name__)
                raise TypeError(f"a spline needs float64 {name}, got {kind}; convert them with .double()")
            shapes = tuple(self.values.shape), tuple(x.shape)
            if not all(shapes) or shapes[0][-1] != shapes[1][-1] or shapes[0][-1] < 2:
                raise ValueError(f"a spline needs at least two values (..., n) and as many {name}, got shapes {shapes}")
        if isinstance(self.knots, Tensor):
            if not bool((self.knots.detach().diff() > 0).all()):
                raise ValueError("the knots of a spline must rise; sort them and remove doubled ones")
        elif not isinstance(self.knots, tuple) or [isinstance(x, Real) for x in self.knots] != [True, True]:
            raise TypeError(
                f"a spline needs float64 knots in a tensor, or a tuple (start, step) of numbers, got {self.knots!r:.80}"
            )
        elif not all(map(math.isfinite, self.knots)) or not self.knots[1] > 0:
            raise ValueError(f"a spline needs a finite start and a positive step, got (start, step)={self.knots}")

    def at(self, t: Tensor) -> Tensor:
        """Evaluate the spline at given times.

        Args:
            t: Times, float64: of even knots any shape, the same for all trials; of uneven knots
                (..., m), whose leading dimensions broadcast with those of the trials.

        Returns:
            Values, shape (..., *t.shape) or (..., m).
        """
        return self._sum(self._unit, t)

    def integral(self, t: Tensor) -> Tensor:
        """Evaluate the integral of the spline from its first knot to given times.

        Args:
            t: Upper limits of the integral, as for `at`.

        Returns:
            Integral in units of the values times the unit of time, of the shape that `at` gives.
        """
        c = [self._steps * c / (power + 1) for power, c in enumerate(self._unit)]
        whole = c[0] + c[1] + c[2] + c[3]
        before = torch.cat([torch.zeros_like(whole[..., :1]), whole.cumsum(-1)[..., :-1]], -1)
        return self._sum([before, *c], t)

    def pieces(self) -> Tensor:
        """Return the polynomial coefficients of the spline in every interval between its n knots.

        Returns:
            Coefficients of the powers 0 to 3 of the time since the first knot of the interval,
            shape (..., n - 1, 4).
        """
        return torch.stack([c / self._steps**power for power, c in enumerate(self._unit)], -1)

    @property
    def _steps(self) -> Tensor | float:
        """Lengths of the intervals between the knots, or one length if the knots are even."""
        return self.knots.diff() if isinstance(self.knots, Tensor) else self.knots[1]

    @cached_property
    def _unit(self) -> list[Tensor]:
        """Coefficients of the powers 0 to 3 of the time in each interval, (..., n - 1) each.

        The time runs from 0 to 1 in every interval.
        """
        if isinstance(self.knots, Tensor):
            bend, square = _uneven_bend(self.values, self.knots), self.knots.diff().square()
            first, last = bend[..., :-1] * square, bend[..., 1:] * square
        else:
            bend = second_differences(self.values)
            first, last = bend[..., :-1], bend[..., 1:]
        y = self.values
        return [y[..., :-1], y[..., 1:] - y[..., :-1] - (2 * first + last) / 6, first / 2, (last - first) / 6]

    def _sum(self, powers: Sequence[Tensor], t: Tensor) -> Tensor:
        """Evaluate a piecewise polynomial by Horner's rule in the interval of each time."""
        if isinstance(self.knots, Tensor):
            # knots and times often have no trial dimensions even if the values have some
            few = np.broadcast_shapes(self.knots.shape[:-1], t.shape[:-1])
            knots, times = (x.expand(*few, -1).contiguous() for x in (self.knots, t))
            piece = torch.searchsorted(knots[..., 1:-1].detach().contiguous(), times.detach(), right=True)
            offset = (t - knots.gather(-1, piece)) / knots.diff().gather(-1, piece)
        else:
            position = (t.to(torch.float64) - self.knots[0]) / self.knots[1]
            piece = torch.floor(position.detach()).clamp(0, self.values.shape[-1] - 2).to(torch.int64)
            offset, few = position - piece, ()
        # torch.broadcast_shapes imports sympy at its first call, which takes half a second
        lead = np.broadcast_shapes(powers[-1].shape[:-1], few)
        total = torch.zeros_like(offset)
        for c in reversed(powers):
            if isinstance(self.knots, Tensor):
                taken = c.expand(*lead, -1).gather(-1, piece.expand(*lead, -1))
            else:
                taken = c.index_select(-1, piece.flatten()).reshape((*lead, *t.shape))
            total = total * offset + taken
        return total


def second_differences(values: Tensor) -> Tensor:
    """Return the second derivatives at the knots of a not-a-knot spline with unit step.

    At the inner knots the second derivatives M of the spline through the values y solve M[i-1] + 4
    M[i] + M[i+1] = 6 (y[i-1] - 2 y[i] + y[i+1]). The not-a-knot condition makes M linear over the
    first three knots and over the last three. Then M[1] and M[n-2] are the second differences of y
    at these two knots. The equations for the knots between them are solved at once by convolution
    with the response of the infinite grid. At a distance of k knots the response is z^|k| / (2 sqrt
    3) with z = sqrt 3 - 2. Two decaying terms are added, which give M[1] and M[n-2] their values.

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
    """Power z^k for whole numbers k >= 0 and the negative root z = `_DECAY`."""
    return torch.where(k.remainder(2) == 0, 1.0, -1.0).to(k) * abs(_DECAY) ** k


def _uneven_bend(values: Tensor, knots: Tensor) -> Tensor:
    """Second derivatives of the spline at uneven knots, (..., n)."""
    h = knots.diff()
    slope = values.diff() / h
    n = values.shape[-1]
    if n == 2:
        return torch.zeros_like(slope).expand(*slope.shape[:-1], 2)
    known = 6 * slope.diff()
    if n == 3:
        return (known / (3 * (h[..., :1] + h[..., 1:]))).expand(*known.shape[:-1], 3)
    # The not-a-knot condition makes the second derivative linear over the first three knots and
    # over the last three.
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

    Each step eliminates the neighbours of all unknowns at once, which doubles the distance between
    the unknowns that remain in one equation. The rows are diagonally dominant, so that no pivots
    are needed.
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
    """Shift by `step` along the last dimension: element i of the result is x[i - step], or zero."""
    pad = (step, 0) if step > 0 else (0, -step)
    kept = x[..., : x.shape[-1] - step] if step > 0 else x[..., -step:]
    return torch.nn.functional.pad(kept, pad)


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
