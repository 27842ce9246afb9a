"""The full grid: every combination of given values, in blocks, the best per trial."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

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
    """Least cost over all combinations of values.

    objective as in `genetic`: (*trials, candidate, n) -> (*trials, candidate).

    axes: one tensor per unknown, real floating, (m_i,) for all trials or (*trials, m_i). trials:
    shape of the trials where no axis has it. The last unknown runs fastest; of equal costs the
    first counts. history: (*trials, m_1, m_2, ...) all costs. block: candidates per call. Raises
    ValueError for a grid of more than `limit` points, TypeError or ValueError for axes that are no
    finite real vectors.
    """
    axes = _checked(axes)
    shape = torch.broadcast_shapes(tuple(trials), *(axis.shape[:-1] for axis in axes))
    sizes = [axis.shape[-1] for axis in axes]
    total = math.prod(sizes)
    if total > limit:
        raise ValueError(
            f"grid_search: {' x '.join(map(str, sizes))} values are {total} evaluations per "
            f"trial, above the limit of {limit}; use fewer values, or raise the limit if the time "
            "is there"
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
    """Grid points (*trials, candidate, n) of the numbers (*trials, candidate), or (candidate,)."""
    columns = []
    for axis, size in zip(reversed(axes), reversed(sizes), strict=True):
        columns.append(axis.gather(-1, torch.remainder(number, size).expand(*axis.shape[:-1], number.shape[-1])))
        number = number // size
    return torch.stack(columns[::-1], -1)


def _parts(total: int, block: int, like: Tensor) -> Iterator[Tensor]:
    for first in range(0, total, block):
        yield torch.arange(first, min(first + block, total), device=like.device)


def _checked(axes: Sequence[Tensor]) -> list[Tensor]:
    if not len(axes):
        raise ValueError("grid_search: give the values of one unknown at least")
    for i, axis in enumerate(axes):
        if not isinstance(axis, Tensor) or not axis.is_floating_point():
            raise TypeError(
                f"grid_search: axis {i} must be a float32 or float64 tensor, got "
                f"{axis.dtype if isinstance(axis, Tensor) else type(axis).__name__}"
            )
        if axis.ndim == 0 or not axis.shape[-1] or not bool(torch.isfinite(axis).all()):
            raise ValueError(
                f"grid_search: axis {i} needs finite values in its last dim, got shape {tuple(axis.shape)}"
            )
    return [axis.detach() for axis in axes]
