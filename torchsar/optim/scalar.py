"""Minimisation of a function of one number per trial, for all trials at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.core import host_value, take

# function that maps one number per trial (...,) to one cost per trial (...,)
Cost = Callable[[Tensor], Tensor]


def grid_minimum(
    cost: Cost, centre: Tensor, reach: float, count: int, middle: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return, per trial, the point of lowest cost among equally spaced points in centre +- reach.

    Args:
        cost: Maps points (...,) to costs (...,).
        centre: Middle of the interval, shape (...,).
        reach: Half width of the interval.
        count: Number of points, at least 3.
        middle: Cost at the centre, shape (...,), where it is known; `count` must then be odd.

    Returns:
        The best point, shape (...,), and all costs, shape (..., count).

    Raises:
        ValueError: If `count` is below 3, or even although `middle` is given.
    """
    if count < 3 or (middle is not None and count % 2 == 0):
        odd = "" if middle is None else ", an odd number of them where the cost in the middle is given"
        raise ValueError(f"a grid search needs at least 3 points{odd}, got {count}")
    offsets = torch.linspace(-reach, reach, count, dtype=centre.dtype, device=centre.device)
    with torch.no_grad():
        known = {} if middle is None else {count // 2: middle}
        costs = torch.stack([known[i] if i in known else cost(centre + offset) for i, offset in enumerate(offsets)], -1)
    return centre + take(offsets.expand(costs.shape), costs.argmin(-1)), costs


def parabola_minimum(
    cost: Cost, start: Tensor, step: float, tolerance: float, rounds: int = 12
) -> tuple[Tensor, Tensor]:
    """Minimise a cost of one unknown per trial by successive parabolas, without gradients.

    Each round fits a parabola to the current point and to two points at the half width on either
    side, and moves to its vertex, by at most the half width. The half width shrinks to a quarter
    when the vertex lies inside. The result stays within start +- 2 step. A round takes three
    evaluations.

    Args:
        cost: Maps points (...,) to costs (...,).
        start: First point, shape (...,).
        step: First half width of the parabola, in the unit of the unknown.
        tolerance: A trial stops when its half width is at most this.
        rounds: Largest number of rounds.

    Returns:
        The position of the minimum, and the second derivative of the cost there (0 where no
        parabola had a minimum), each of shape (...,).
    """
    with torch.no_grad():
        x, half = start, torch.full_like(start, step)
        curvature = torch.zeros_like(start)
        active = torch.ones_like(start, dtype=torch.bool)
        for _ in range(rounds):
            low, middle, high = cost(x - half), cost(x), cost(x + half)
            bend = low - 2 * middle + high
            vertex = torch.where(
                bend > 0, 0.5 * (low - high) / torch.where(bend > 0, bend, 1), torch.sign(low - high)
            ).clamp(-1, 1)
            curvature = torch.where(active & (bend > 0), bend / half.square(), curvature)
            x = torch.where(active, torch.clamp(x + vertex * half, start - 2 * step, start + 2 * step), x)
            inside = vertex.abs() < 0.99
            half = torch.where(active & inside, half / 4, half)
            active = active & (half > tolerance)
            # inside vmap values cannot be read, so that no round is left out
            if not host_value(active.any(), True):
                break
    return x, curvature


def vertex(low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
    """Return where the parabola through three equally spaced values has its maximum.

    Args:
        low: Values before the middle, any shape.
        middle: Values in the middle, same shape.
        high: Values after the middle, same shape.

    Returns:
        Offset from the middle in steps, same shape; 0 where the parabola has no maximum.
    """
    bend = low - 2 * middle + high
    return torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0)
