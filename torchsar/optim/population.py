"""Parts shared by the searches without gradients: result, bounds, random numbers and costs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, take

# objective of a population: maps candidates (..., candidate, n) to costs (..., candidate)
Population = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Searched:
    """Result of a search without gradients, per trial.

    Args:
        x: Best point, shape (..., n). Where `ok` is False it is the first candidate.
        cost: Cost at `x`, shape (...,); +inf where `ok` is False.
        evaluations: Candidates whose cost was computed, shape (...,), int64.
        history: Costs during the search; the function that searches documents its shape.
        ok: False where no candidate had a finite cost, shape (...,), bool.
    """

    x: Tensor
    cost: Tensor
    evaluations: Tensor
    history: Tensor
    ok: Tensor


@dataclass(frozen=True)
class Box:
    """Lower and upper bounds of the unknowns per trial; equal values fix an unknown.

    Args:
        low: Least values, shape (*trials, n), float32 or float64.
        high: Greatest values, same shape.
    """

    low: Tensor
    high: Tensor

    @staticmethod
    def of(low: Tensor, high: Tensor, who: str) -> Box:
        """Build the bounds from tensors that broadcast against each other.

        Args:
            low: Least values, shape (..., n).
            high: Greatest values, shape (..., n).
            who: Name of the search, used in error messages.

        Returns:
            Bounds of equal shape (*trials, n).

        Raises:
            TypeError: If a bound is not a real floating tensor.
            ValueError: If the bounds differ in the number of unknowns or have none, a bound is not
                finite, or low > high.
        """
        for name, bound in (("low", low), ("high", high)):
            if not isinstance(bound, Tensor) or not bound.is_floating_point():
                raise TypeError(
                    f"{who}: {name} must be a float32 or float64 tensor (..., n), got "
                    f"{bound.dtype if isinstance(bound, Tensor) else type(bound).__name__}"
                )
        if low.ndim == 0 or high.ndim == 0 or not low.shape[-1] or low.shape[-1] != high.shape[-1]:
            raise ValueError(
                f"{who}: low and high need the same number of unknowns, 1 or more, in their last dim, got shapes "
                f"{tuple(low.shape)} and {tuple(high.shape)}"
            )
        low, high = torch.broadcast_tensors(low.detach(), high.detach())
        if not bool((torch.isfinite(low) & torch.isfinite(high) & (low <= high)).all()):
            raise ValueError(
                f"{who}: the search bounds must be finite with low <= high in every unknown, got low "
                f"{low.flatten()[:8].tolist()} and high {high.flatten()[:8].tolist()}"
            )
        return Box(low, high)

    @property
    def trials(self) -> torch.Size:
        """Shape of the trial dimensions of the bounds."""
        return self.low.shape[:-1]

    def at(self, part: Tensor) -> Tensor:
        """Map relative coordinates, 0 at `low` and 1 at `high`, to points.

        Args:
            part: Coordinates, shape (*trials, candidate, n).

        Returns:
            Points, same shape.
        """
        return self.low[..., None, :] + part * (self.high - self.low)[..., None, :]

    def kept(self, x: Tensor) -> Tensor:
        """Limit candidates to the bounds: set each unknown beyond a bound to that bound.

        Args:
            x: Candidates, shape (*trials, candidate, n).

        Returns:
            Limited candidates, same shape.
        """
        return torch.minimum(torch.maximum(x, self.low[..., None, :]), self.high[..., None, :])


@dataclass(frozen=True)
class Dice:
    """Source of random numbers for all trials of a search, in the dtype of its bounds.

    Args:
        draws: Source of the random numbers. Each trial of the search gets the numbers of one trial
            of this source. If `draws.trials` is None, all trials get the same numbers.
        box: Bounds of the search, which give the trials, dtype and device.

    Raises:
        ValueError: If `draws` has another number of trials than the bounds.
    """

    draws: Draws
    box: Box

    def __post_init__(self) -> None:
        count, trials = None if self.draws.trials is None else len(self.draws.trials), math.prod(self.box.trials)
        if count is not None and count != trials:
            raise ValueError(
                f"draws for {count} trials do not fit search bounds for {trials} trials; give Draws(seed, "
                f"trials=range({trials})), or Draws(seed) for the same numbers in every trial"
            )

    def uniform(self, purpose: str, shape: Sequence[int]) -> Tensor:
        """Draw uniform random numbers in 0..1 for all trials.

        Args:
            purpose: Name of the numbers; different names give independent numbers.
            shape: Shape of the numbers of one trial.

        Returns:
            Numbers of shape (*trials, *shape).
        """
        return self._of_trials(self.draws.uniform(purpose, shape), shape)

    def normal(self, purpose: str, shape: Sequence[int]) -> Tensor:
        """Draw standard normal random numbers for all trials.

        Args:
            purpose: Name of the numbers; different names give independent numbers.
            shape: Shape of the numbers of one trial.

        Returns:
            Numbers of shape (*trials, *shape).
        """
        return self._of_trials(self.draws.normal(purpose, shape), shape)

    def _of_trials(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        """Numbers in the dtype and shape of the bounds."""
        x = x.to(dtype=self.box.low.dtype, device=self.box.low.device)
        return x.expand(*self.box.trials, *shape) if self.draws.trials is None else x.reshape(*self.box.trials, *shape)


def costs_of(objective: Population, x: Tensor, who: str) -> Tensor:
    """Evaluate the objective for all candidates, without gradients; a cost of NaN becomes +inf.

    Args:
        objective: Maps candidates (*trials, candidate, n) to costs (*trials, candidate).
        x: Candidates, shape (*trials, candidate, n).
        who: Name of the search, used in error messages.

    Returns:
        Costs, shape (*trials, candidate).

    Raises:
        ValueError: If the objective does not return one real cost per candidate.
    """
    with torch.no_grad():
        cost = objective(x)
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        got = f"{cost.dtype} of shape {tuple(cost.shape)}" if isinstance(cost, Tensor) else type(cost).__name__
        raise ValueError(
            f"{who}: the objective returned {got} for candidates of shape {tuple(x.shape)}; "
            f"return one real cost for each candidate, shape {tuple(x.shape[:-1])}"
        )
    return torch.where(torch.isnan(cost), torch.inf, cost)


def ranked(x: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """Sort candidates by cost, the best first.

    Args:
        x: Candidates, shape (*trials, candidate, n).
        cost: Their costs, shape (*trials, candidate).

    Returns:
        Candidates and their costs, of the same shapes, in rising order of the cost.
    """
    order = torch.argsort(cost, dim=-1, stable=True)
    return pick(x, order), cost.gather(-1, order)


def pick(x: Tensor, index: Tensor) -> Tensor:
    """Select candidates by index.

    Args:
        x: Candidates, shape (*trials, candidate, n).
        index: Indices, shape (*trials, m), int64.

    Returns:
        Candidates, shape (*trials, m, n).
    """
    return x.gather(-2, index[..., None].expand(*index.shape, x.shape[-1]))


def best(x: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """Return the candidate of lowest cost in each trial, and its cost.

    Args:
        x: Candidates, shape (*trials, candidate, n).
        cost: Their costs, shape (*trials, candidate).

    Returns:
        The candidate, shape (*trials, n), and its cost, shape (*trials,).
    """
    index = cost.argmin(-1)
    return take(x, index, -2), take(cost, index)


def check_counts(who: str, least: dict[str, tuple[float, float]]) -> None:
    """Check that the settings of a search reach their minimum values.

    Args:
        who: Name of the search, used in error messages.
        least: Pairs (value, minimum value) by the name of the parameter.

    Raises:
        ValueError: If a value is below its minimum value.
    """
    for name, (value, bound) in least.items():
        if not value >= bound:
            raise ValueError(f"{who}: {name} is {value}; choose at least {bound:g}")
