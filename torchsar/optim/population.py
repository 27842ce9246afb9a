"""What searches by a population share: their result, the box they keep to, and random numbers at
addresses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, take

Population = Callable[[Tensor], Tensor]  # (..., candidate, n) -> (..., candidate)


@dataclass(frozen=True)
class Searched:
    """What a search without gradients found, per trial (...,).

    x: (..., n) best point. cost: (...,) there. evaluations: (...,) int64 candidates whose cost was
    computed. history: costs on the way; each search says which. ok: (...,) bool, False where no
    candidate had a finite cost: x is then the first one and cost +inf.
    """

    x: Tensor
    cost: Tensor
    evaluations: Tensor
    history: Tensor
    ok: Tensor


@dataclass(frozen=True)
class Box:
    """Least and greatest values (*trials, n) of the unknowns, float64 or float32; equal ones hold
    an unknown fixed.
    """

    low: Tensor
    high: Tensor

    @staticmethod
    def of(low: Tensor, high: Tensor, who: str) -> Box:
        """Raises TypeError for what is no real floating tensor, ValueError for shapes that do not
        fit, bounds that are not finite, or low > high.
        """
        for name, bound in (("low", low), ("high", high)):
            if not isinstance(bound, Tensor) or not bound.is_floating_point():
                raise TypeError(
                    f"{who}: {name} must be a float32 or float64 tensor (..., n), got "
                    f"{bound.dtype if isinstance(bound, Tensor) else type(bound).__name__}"
                )
        if low.ndim == 0 or high.ndim == 0 or not low.shape[-1] or low.shape[-1] != high.shape[-1]:
            raise ValueError(
                f"{who}: low and high need the same number of unknowns in their last dim, got shapes "
                f"{tuple(low.shape)} and {tuple(high.shape)}"
            )
        low, high = torch.broadcast_tensors(low.detach(), high.detach())
        if not bool((torch.isfinite(low) & torch.isfinite(high) & (low <= high)).all()):
            raise ValueError(
                f"{who}: the box must be finite with low <= high in every unknown, got low "
                f"{low.flatten()[:8].tolist()} and high {high.flatten()[:8].tolist()}"
            )
        return Box(low, high)

    @property
    def trials(self) -> torch.Size:
        return self.low.shape[:-1]

    def at(self, part: Tensor) -> Tensor:
        """Points at 0..1 of the box. part: (*trials, candidate, n)."""
        return self.low[..., None, :] + part * (self.high - self.low)[..., None, :]

    def kept(self, x: Tensor) -> Tensor:
        """Candidates (*trials, candidate, n) with what lies outside moved onto the edge."""
        return torch.minimum(torch.maximum(x, self.low[..., None, :]), self.high[..., None, :])


@dataclass(frozen=True)
class Dice:
    """Random numbers for all trials of a box: of each trial's own address, or, where the draws know
    no trials, the same ones in every trial.
    """

    draws: Draws
    box: Box

    def __post_init__(self) -> None:
        count, trials = None if self.draws.trials is None else len(self.draws.trials), math.prod(self.box.trials)
        if count is not None and count != trials:
            raise ValueError(
                f"draws for {count} trials do not fit a box of {trials}; give Draws(seed, "
                f"trials=range({trials})), or Draws(seed) for the same numbers in every trial"
            )

    def uniform(self, purpose: str, shape: Sequence[int]) -> Tensor:
        """0..1, (*trials, *shape)."""
        return self._of_trials(self.draws.uniform(purpose, shape), shape)

    def normal(self, purpose: str, shape: Sequence[int]) -> Tensor:
        """Standard normal, (*trials, *shape)."""
        return self._of_trials(self.draws.normal(purpose, shape), shape)

    def _of_trials(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        x = x.to(dtype=self.box.low.dtype, device=self.box.low.device)
        return x.expand(*self.box.trials, *shape) if self.draws.trials is None else x.reshape(*self.box.trials, *shape)


def costs_of(objective: Population, x: Tensor, who: str) -> Tensor:
    """Costs (*trials, candidate) of candidates (*trials, candidate, n), +inf where one is not a
    number. Raises ValueError for an answer of another shape.
    """
    with torch.no_grad():
        cost = objective(x)
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        got = f"{cost.dtype} of shape {tuple(cost.shape)}" if isinstance(cost, Tensor) else type(cost).__name__
        raise ValueError(
            f"{who}: the objective returned {got} for candidates of shape {tuple(x.shape)}; "
            f"return one real cost each, shape {tuple(x.shape[:-1])}"
        )
    return torch.where(torch.isnan(cost), torch.inf, cost)


def ranked(x: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates and costs with the best first."""
    order = torch.argsort(cost, dim=-1, stable=True)
    return pick(x, order), cost.gather(-1, order)


def pick(x: Tensor, index: Tensor) -> Tensor:
    """Candidates of those numbers. x: (*trials, candidate, n); index: (*trials, m).

    Returns (*trials, m, n).
    """
    return x.gather(-2, index[..., None].expand(*index.shape, x.shape[-1]))


def best(x: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """The best candidate (*trials, n) and its cost."""
    index = cost.argmin(-1)
    return take(x, index, -2), take(cost, index)


def check_counts(who: str, least: dict[str, tuple[float, float]]) -> None:
    """{name: (value, least)}: ValueError where a value is below its least."""
    for name, (value, bound) in least.items():
        if not value >= bound:
            raise ValueError(f"{who}: {name} is {value}; choose at least {bound:g}")
