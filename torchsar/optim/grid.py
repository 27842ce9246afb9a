"""Search over a full grid: the cost of every combination of given values of the unknowns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from torchsar.optim.population import Population, Searched, check_counts, costs_of


def grid_search(
    objective: Population,
    axes: Sequence[Tensor],
    *,
    trials: Sequence[int] = (),
    limit: int = 100_000,
    block: int = 1024,
) -> Searched:
    """Evaluate a cost at all combinations of given values and return the best point per trial.

    Args:
        objective: Maps candidates (*trials, candidate, n) to costs (*trials, candidate); NaN counts
            as +inf.
        axes: One float tensor per unknown with the values to test, shape (m_i,) for the same values
            in all trials, or (*trials, m_i).
        trials: Shape of the trials; needed where no axis has trial dimensions.
        limit: Largest number of grid points accepted.
        block: Number of candidates in one call of the objective.

    Returns:
        Best point per trial. Of several points of equal cost it is the first in the order of the
        grid, in which the last unknown varies fastest. `history` holds all costs, shape (*trials,
        m_1, m_2, ...).

    Raises:
        TypeError: If an axis is not a real floating tensor.
        ValueError: If the grid has more than `limit` points, `block` is below 1, there are no axes,
            or an axis is empty or not finite.
    """
    axes = _checked(axes)
    shape = np.broadcast_shapes(tuple(trials), *(axis.shape[:-1] for axis in axes))
    sizes = [axis.shape[-1] for axis in axes]
    total = math.prod(sizes)
    if total > limit:
        raise ValueError(
            f"grid_search: {' x '.join(map(str, sizes))} values are {total} evaluations per "
            f"trial, above the limit of {limit}; use fewer values, or raise `limit`"
        )
    check_counts("grid_search", {"block": (block, 1)})
    axes = [axis.expand(*shape, axis.shape[-1]) for axis in axes]
    costs = torch.cat(
        [costs_of(objective, _points(axes, sizes, part), "grid_search") for part in _parts(total, block, axes[0])], -1
    )
    index = costs.argmin(-1)
    x = _points(axes, sizes, index[..., None])[..., 0, :]
    least = costs.gather(-1, index[..., None])[..., 0]
    evaluations = torch.full(shape, total, dtype=torch.int64, device=x.device)
    return Searched(x, least, evaluations, costs.unflatten(-1, sizes), torch.isfinite(least))


def _points(axes: list[Tensor], sizes: list[int], number: Tensor) -> Tensor:
    """Grid points (*trials, candidate, n) by their numbers, (*trials, candidate) or
    (candidate,).
    """
    columns = []
    for axis, size in zip(reversed(axes), reversed(sizes), strict=True):
        columns.append(axis.gather(-1, torch.remainder(number, size).expand(*axis.shape[:-1], number.shape[-1])))
        number = number // size
    return torch.stack(columns[::-1], -1)


def _parts(total: int, block: int, like: Tensor) -> Iterator[Tensor]:
    """Numbers of the grid points in blocks."""
    for first in range(0, total, block):
        yield torch.arange(first, min(first + block, total), device=like.device)


def _checked(axes: Sequence[Tensor]) -> list[Tensor]:
    """Detached axes; raises where one is not a finite real vector."""
    if not len(axes):
        raise ValueError("grid_search: got no axes; give the values of at least one unknown")
    for i, axis in enumerate(axes):
        if not isinstance(axis, Tensor) or not axis.is_floating_point():
            raise TypeError(
                f"grid_search: axis {i} must be a float32 or float64 tensor, got "
                f"{axis.dtype if isinstance(axis, Tensor) else type(axis).__name__}"
            )
        if axis.ndim == 0 or not axis.shape[-1]:
            raise ValueError(
                f"grid_search: axis {i} must have one value or more along its last dimension, got shape "
                f"{tuple(axis.shape)}"
            )
        wrong = int((~torch.isfinite(axis)).sum())
        if wrong:
            raise ValueError(f"grid_search: axis {i} must be finite, but {wrong} of its values are NaN or infinite")
    return [axis.detach() for axis in axes]
