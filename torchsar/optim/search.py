"""Searches without gradients, for all trials at once: a grid, and populations of candidates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, differentiable, take

# objective of a population; it maps candidates (..., candidate, n) to costs (..., candidate)
Population = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Searched:
    """Result of a search without gradients, per trial.

    >>> import torch
    >>> from torchsar.optim import grid_search
    >>> values = torch.linspace(-1, 1, 5)
    >>> found = grid_search(lambda x: (x - 0.5).square().sum(-1), [values, values])
    >>> float(found.cost), int(found.evaluations), found.history.shape
    (0.0, 25, torch.Size([5, 5]))

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


@differentiable("no")
def grid_search(
    objective: Population,
    axes: Sequence[Tensor],
    *,
    trials: Sequence[int] = (),
    limit: int = 100_000,
    block: int = 1024,
) -> Searched:
    """Evaluate a cost at all combinations of given values and return the best point per trial.

    >>> import torch
    >>> from torchsar.optim import grid_search
    >>> values = torch.linspace(-1, 1, 5)
    >>> grid_search(lambda x: (x - 0.4).square().sum(-1), [values, values]).x
    tensor([0.5000, 0.5000])

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
            f"trial, above the limit of {limit}; use fewer values"
        )
    _check_counts("grid_search", block=(block, 1))
    axes = [axis.expand(*shape, axis.shape[-1]) for axis in axes]
    numbers = torch.arange(total, device=axes[0].device).split(block)
    costs = torch.cat([_costs(objective, _points(axes, sizes, part), "grid_search") for part in numbers], -1)
    index = costs.argmin(-1)
    x = _points(axes, sizes, index[..., None])[..., 0, :]
    least = costs.gather(-1, index[..., None])[..., 0]
    evaluations = torch.full(shape, total, dtype=torch.int64, device=x.device)
    return Searched(x, least, evaluations, costs.unflatten(-1, sizes), torch.isfinite(least))


@differentiable("no")
def genetic(
    objective: Population,
    low: Tensor,
    high: Tensor,
    *,
    population: int = 30,
    generations: int = 30,
    draws: Draws,
    elites: int = 2,
    selection: Literal["tournament", "roulette"] = "tournament",
    entrants: int = 2,
    crossover: float = 0.9,
    blend: float = 0.3,
    mutation: float = 0.2,
    spread: float = 0.1,
    cooling: float = 0.9,
) -> Searched:
    """Minimise a cost within bounds by a genetic algorithm.

    >>> import torch
    >>> from torchsar.core import Draws
    >>> from torchsar.optim import genetic
    >>> low, high = -torch.ones(2), torch.ones(2)
    >>> found = genetic(lambda x: x.square().sum(-1), low, high, draws=Draws(1))
    >>> bool(found.cost < 1e-3)
    True

    It uses selection, blend crossover, Gaussian mutation and elitism. The candidates of the first
    population are drawn uniformly within the bounds. In each generation the `elites` best
    candidates survive, and population - elites children are made and evaluated. An unknown of a
    child beyond a bound is set to that bound. A trial takes population + generations *
    (population - elites) evaluations, 870 by default.

    Args:
        objective: Maps candidates (..., population, n) to costs (..., population) for all trials;
            NaN counts as +inf.
        low: Least values of the unknowns, shape (..., n).
        high: Greatest values of the unknowns, shape (..., n).
        population: Number of candidates.
        generations: Number of generations.
        draws: Source of random numbers for as many trials as the bounds have. If `draws.trials` is
            None, all trials use the same numbers. Results do not depend on how trials are batched.
        elites: Number of best candidates that survive a generation.
        selection: "tournament" takes the best of `entrants` candidates drawn with replacement;
            "roulette" draws with a probability proportional to how far the cost of a candidate lies
            below the worst finite cost.
        entrants: Number of candidates of a tournament.
        crossover: Probability that a child is a blend of its two parents; otherwise it is a copy of
            the first parent.
        blend: In a blend each unknown is drawn uniformly between the values of the two parents, an
            interval extended on both sides by this fraction of its length.
        mutation: Probability per unknown of a Gaussian step.
        spread: Standard deviation of that step, relative to high - low.
        cooling: Factor by which the spread changes from one generation to the next, above 0 and at
            most 1.

    Returns:
        Best point per trial. `history` is the least cost so far, shape (..., generations + 1).

    Raises:
        TypeError: If a bound is not a real floating tensor.
        ValueError: If the bounds, a setting or the shape of the costs is not valid.

    Reference:
        Remote Sens. 2025, 17, 3447, section 3.3, which specifies neither the probabilities nor the
        operators; those used here follow Goldberg 1989, and Eshelman and Schaffer 1993
        (BLX-alpha).
    """
    who = "genetic"
    space = _Space.of(low, high, draws, who)
    _check_counts(
        who,
        population=(population, 2),
        generations=(generations, 0),
        elites=(elites, 1),
        entrants=(entrants, 1),
        blend=(blend, 0),
        spread=(spread, 0),
    )
    if not elites < population:
        raise ValueError(
            f"genetic: elites must be fewer than population={population}, so that children are made, got {elites}"
        )
    if selection not in ("tournament", "roulette"):
        raise ValueError(f"genetic: selection {selection!r} is not known; choose 'tournament' or 'roulette'")
    if not (0 <= crossover <= 1 and 0 <= mutation <= 1 and 0 < cooling <= 1):
        raise ValueError(
            "genetic: crossover and mutation must be probabilities in 0..1, and cooling a factor above 0 and at "
            f"most 1, got crossover={crossover}, mutation={mutation} and cooling={cooling}"
        )
    brood, n = population - elites, low.shape[-1]

    def parents(purpose: str, cost: Tensor) -> Tensor:
        """Select the indices (..., brood) of the parents among candidates in order of
        their costs.
        """
        if selection == "roulette":
            return _spun(cost, space.uniform(purpose, brood))
        drawn = space.uniform(purpose, brood, entrants)
        return (drawn.amin(-1) * population).to(torch.int64).clamp_max(population - 1)

    def ranked(x: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
        order = torch.argsort(cost, dim=-1, stable=True)
        return _pick(x, order), cost.gather(-1, order)

    x = space.at(space.uniform("genetic first", population, n))
    x, cost = ranked(x, _costs(objective, x, who))
    history = [cost[..., 0]]
    for generation in range(generations):
        purpose = f"genetic {generation}"
        one, other = (_pick(x, parents(f"{purpose} parent {i}", cost)) for i in range(2))
        share = space.uniform(f"{purpose} blend", brood, n) * (1 + 2 * blend) - blend
        chance = space.uniform(f"{purpose} chance", brood, n + 1)
        child = torch.where(chance[..., :1] < crossover, one + share * (other - one), one)
        step = space.normal(f"{purpose} mutation", brood, n) * (space.high - space.low)
        child = child + torch.where(chance[..., 1:] < mutation, step * (spread * cooling**generation), 0)
        child = space.kept(child)
        costs = torch.cat([cost[..., :elites], _costs(objective, child, who)], -1)
        x, cost = ranked(torch.cat([x[..., :elites, :], child], -2), costs)
        history.append(torch.minimum(history[-1], cost[..., 0]))
    return _found(x, cost, history, population + generations * brood)


@differentiable("no")
def differential_evolution(
    objective: Population,
    low: Tensor,
    high: Tensor,
    *,
    population: int = 24,
    generations: int = 36,
    draws: Draws,
    strategy: Literal["rand1bin", "best1bin"] = "rand1bin",
    weight: float = 0.7,
    crossover: float = 0.9,
) -> Searched:
    """Minimise a cost within bounds by differential evolution.

    >>> import torch
    >>> from torchsar.core import Draws
    >>> from torchsar.optim import differential_evolution
    >>> low, high = -torch.ones(2), torch.ones(2)
    >>> found = differential_evolution(lambda x: x.square().sum(-1), low, high, draws=Draws(1))
    >>> bool(found.cost < 1e-3)
    True

    In each generation every candidate competes with a challenger, and the better of the two is
    kept. The challenger takes each unknown from base + weight * (one - other) with the probability
    `crossover`, but at least one unknown, and the rest from the candidate; base, one and other are
    three further candidates. An unknown beyond a bound is set to that bound. A trial takes
    population * (generations + 1) evaluations, 888 by default.

    Args:
        objective: Maps candidates (..., population, n) to costs (..., population) for all trials;
            NaN counts as +inf.
        low: Least values of the unknowns, shape (..., n).
        high: Greatest values of the unknowns, shape (..., n).
        population: Number of candidates, at least 4.
        generations: Number of generations.
        draws: Source of random numbers for as many trials as the bounds have. If `draws.trials` is
            None, all trials use the same numbers. Results do not depend on how trials are batched.
        strategy: "rand1bin" draws the base at random, "best1bin" takes the best candidate.
        weight: Factor on the difference of two candidates, above 0 and at most 2.
        crossover: Probability that an unknown of the challenger is not that of the candidate.

    Returns:
        Best point per trial. `history` is the least cost of each generation, shape (...,
        generations + 1).

    Raises:
        TypeError: If a bound is not a real floating tensor.
        ValueError: If the bounds, a setting or the shape of the costs is not valid.

    Reference:
        Storn and Price 1997, DE/rand/1/bin and DE/best/1/bin.
    """
    who = "differential_evolution"
    space, n = _Space.of(low, high, draws, who), low.shape[-1]
    _check_counts(who, population=(population, 4), generations=(generations, 0))
    if strategy not in ("rand1bin", "best1bin"):
        raise ValueError(f"{who}: strategy {strategy!r} is not known; choose 'rand1bin' or 'best1bin'")
    if not (0 < weight <= 2 and 0 <= crossover <= 1):
        raise ValueError(
            f"{who}: weight must be above 0 and at most 2, and crossover must be a probability in 0..1, "
            f"got weight={weight} and crossover={crossover}"
        )
    x = space.at(space.uniform("evolution first", population, n))
    cost = _costs(objective, x, who)
    history = [cost.amin(-1)]
    for generation in range(generations):
        purpose = f"evolution {generation}"
        # for each candidate, three others that are all different
        order = space.uniform(f"{purpose} partners", population, population).clone()
        order.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
        base, one, other = (_pick(x, index) for index in order.argsort(-1)[..., :3].unbind(-1))
        if strategy == "best1bin":
            base = take(x, cost.argmin(-1), -2)[..., None, :]
        mutant = space.kept(base + weight * (one - other))
        chance = space.uniform(f"{purpose} chance", population, n + 1)
        forced = torch.arange(n, device=x.device) == (chance[..., n:] * n).to(torch.int64)
        rival = torch.where((chance[..., :n] < crossover) | forced, mutant, x)
        value = _costs(objective, rival, who)
        better = value <= cost
        x, cost = torch.where(better[..., None], rival, x), torch.where(better, value, cost)
        history.append(cost.amin(-1))
    return _found(x, cost, history, population * (generations + 1))


@dataclass(frozen=True)
class _Space:
    """Bounds of the unknowns, (*trials, 1, n) each, and the random numbers of a search between
    them.
    """

    low: Tensor
    high: Tensor
    draws: Draws

    @staticmethod
    def of(low: Tensor, high: Tensor, draws: Draws, who: str) -> _Space:
        """Make the space after a check of the bounds (..., n), which may broadcast, and of the
        trials.
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
        count, trials = None if draws.trials is None else len(draws.trials), math.prod(low.shape[:-1])
        if count is not None and count != trials:
            raise ValueError(
                f"draws for {count} trials do not fit search bounds for {trials} trials; give Draws(seed, "
                f"trials=range({trials})), or Draws(seed) for the same numbers in every trial"
            )
        return _Space(low[..., None, :], high[..., None, :], draws)

    def at(self, part: Tensor) -> Tensor:
        """Points (*trials, candidate, n) at relative coordinates: 0 is the lower bound, 1 the upper
        one.
        """
        return self.low + part * (self.high - self.low)

    def kept(self, x: Tensor) -> Tensor:
        """Set each unknown of the candidates that exceeds a bound to that bound."""
        return torch.minimum(torch.maximum(x, self.low), self.high)

    def uniform(self, purpose: str, *shape: int) -> Tensor:
        """Uniform random numbers in 0..1, (*trials, *shape)."""
        return self._of_trials(self.draws.uniform(purpose, shape))

    def normal(self, purpose: str, *shape: int) -> Tensor:
        """Standard normal random numbers, (*trials, *shape)."""
        return self._of_trials(self.draws.normal(purpose, shape))

    def _of_trials(self, x: Tensor) -> Tensor:
        """Convert random numbers to the dtype and the trials of the bounds.

        All trials have the same numbers if the draws have no trials.
        """
        trials, x = self.low.shape[:-2], x.to(dtype=self.low.dtype, device=self.low.device)
        return x.expand(*trials, *x.shape) if self.draws.trials is None else x.reshape(*trials, *x.shape[1:])


def _costs(objective: Population, x: Tensor, who: str) -> Tensor:
    """Compute the costs (*trials, candidate) of candidates without gradients; NaN becomes +inf."""
    with torch.no_grad():
        cost = objective(x)
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        got = f"{cost.dtype} of shape {tuple(cost.shape)}" if isinstance(cost, Tensor) else type(cost).__name__
        raise ValueError(
            f"{who}: the objective returned {got} for candidates of shape {tuple(x.shape)}; "
            f"return one real cost for each candidate, shape {tuple(x.shape[:-1])}"
        )
    return torch.where(torch.isnan(cost), torch.inf, cost)


def _found(x: Tensor, cost: Tensor, history: list[Tensor], evaluations: int) -> Searched:
    """Make the result of a search: the best of the last candidates."""
    index = cost.argmin(-1)
    least = take(cost, index)
    count = torch.full(least.shape, evaluations, dtype=torch.int64, device=x.device)
    return Searched(take(x, index, -2), least, count, torch.stack(history, -1), torch.isfinite(least))


def _pick(x: Tensor, index: Tensor) -> Tensor:
    """Select candidates (*trials, m, n) by their indices (*trials, m)."""
    return x.gather(-2, index[..., None].expand(*index.shape, x.shape[-1]))


def _check_counts(who: str, **least: tuple[float, float]) -> None:
    """Raise ValueError if a setting is below its minimum; each argument is (value, minimum)."""
    for name, (value, bound) in least.items():
        if not value >= bound:
            raise ValueError(f"{who}: {name} is {value}; choose at least {bound:g}")


def _spun(cost: Tensor, drawn: Tensor) -> Tensor:
    """Select indices by roulette.

    The probability of a candidate is proportional to the worst finite cost minus its own cost. All
    probabilities are equal if all costs are equal.
    """
    worst = torch.where(torch.isfinite(cost), cost, -torch.inf).amax(-1, keepdim=True)
    share = torch.where(torch.isfinite(cost), worst - cost, 0)
    share = torch.where(share.sum(-1, keepdim=True) > 0, share, 1)
    wheel = share.cumsum(-1)
    return torch.searchsorted(
        wheel.contiguous(), (drawn.to(wheel.dtype) * wheel[..., -1:]).contiguous(), right=True
    ).clamp_max(cost.shape[-1] - 1)


def _points(axes: list[Tensor], sizes: list[int], number: Tensor) -> Tensor:
    """Compute grid points (*trials, candidate, n) from their numbers, (*trials, candidate) or
    (candidate,).
    """
    columns = []
    for axis, size in zip(reversed(axes), reversed(sizes), strict=True):
        columns.append(axis.gather(-1, torch.remainder(number, size).expand(*axis.shape[:-1], number.shape[-1])))
        number = number // size
    return torch.stack(columns[::-1], -1)


def _checked(axes: Sequence[Tensor]) -> list[Tensor]:
    """Detach the axes of a grid; raise an error if one is not a finite real vector."""
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
