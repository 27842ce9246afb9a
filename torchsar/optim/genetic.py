"""Genetic algorithm on real numbers for many trials at once.

Reference:
    Remote Sens. 2025, 17, 3447, section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.optim.population import Box, Dice, Population, Searched, check_counts, costs_of, pick, ranked

Selection = Literal["tournament", "roulette"]


def genetic(
    objective: Population,
    low: Tensor,
    high: Tensor,
    *,
    population: int = 30,
    generations: int = 30,
    draws: Draws,
    elites: int = 2,
    selection: Selection = "tournament",
    entrants: int = 2,
    crossover: float = 0.9,
    blend: float = 0.3,
    mutation: float = 0.2,
    spread: float = 0.1,
    cooling: float = 0.9,
) -> Searched:
    """Minimise a cost within bounds by a genetic algorithm.

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
    box = Box.of(low, high, "genetic")
    _check(population, generations, elites, selection, entrants, crossover, blend, mutation, spread, cooling)
    breed = _Breed(
        Dice(draws, box),
        population,
        population - elites,
        selection,
        entrants,
        crossover,
        blend,
        mutation,
        spread,
        cooling,
    )
    x = breed.first()
    x, cost = ranked(x, costs_of(objective, x, "genetic"))
    history = [cost[..., 0]]
    for generation in range(generations):
        children = breed.children(generation, x, cost)
        born = costs_of(objective, children, "genetic")
        x, cost = ranked(torch.cat([x[..., :elites, :], children], -2), torch.cat([cost[..., :elites], born], -1))
        history.append(torch.minimum(history[-1], cost[..., 0]))
    evaluations = torch.full(
        box.trials, population + generations * (population - elites), dtype=torch.int64, device=x.device
    )
    return Searched(x[..., 0, :], cost[..., 0], evaluations, torch.stack(history, -1), torch.isfinite(cost[..., 0]))


@dataclass(frozen=True)
class _Breed:
    """Settings and random numbers of the genetic algorithm."""

    dice: Dice
    population: int
    brood: int
    selection: Selection
    entrants: int
    crossover: float
    blend: float
    mutation: float
    spread: float
    cooling: float

    def first(self) -> Tensor:
        """First population, uniform within the bounds."""
        box = self.dice.box
        return box.at(self.dice.uniform("genetic first", (self.population, box.low.shape[-1])))

    def children(self, generation: int, x: Tensor, cost: Tensor) -> Tensor:
        """Make the children of one generation by selection, crossover and mutation.

        Args:
            generation: Number of the generation, from 0 on.
            x: Candidates in rising order of their costs, shape (..., population, n).
            cost: Costs of the candidates, shape (..., population).

        Returns:
            Children within the bounds, shape (..., brood, n).
        """
        at = f"genetic {generation}"
        box, n = self.dice.box, x.shape[-1]
        one, other = (pick(x, self._parents(f"{at} parent {i}", cost)) for i in range(2))
        share = self.dice.uniform(f"{at} blend", (self.brood, n)) * (1 + 2 * self.blend) - self.blend
        chance = self.dice.uniform(f"{at} chance", (self.brood, n + 1))
        child = torch.where(chance[..., :1] < self.crossover, one + share * (other - one), one)
        step = self.dice.normal(f"{at} mutation", (self.brood, n)) * (box.high - box.low)[..., None, :]
        child = child + torch.where(chance[..., 1:] < self.mutation, step * (self.spread * self.cooling**generation), 0)
        return box.kept(child)

    def _parents(self, purpose: str, cost: Tensor) -> Tensor:
        """Indices (..., brood) of the parents among candidates ranked by cost."""
        if self.selection == "tournament":
            drawn = self.dice.uniform(purpose, (self.brood, self.entrants))
            return (drawn.amin(-1) * self.population).to(torch.int64).clamp_max(self.population - 1)
        return _spun(cost, self.dice.uniform(purpose, (self.brood,)))


def _spun(cost: Tensor, drawn: Tensor) -> Tensor:
    """Roulette: indices with probabilities proportional to the worst finite cost minus the own
    cost; equal probabilities where no costs differ.
    """
    worst = torch.where(torch.isfinite(cost), cost, -torch.inf).amax(-1, keepdim=True)
    share = torch.where(torch.isfinite(cost), worst - cost, 0)
    share = torch.where(share.sum(-1, keepdim=True) > 0, share, 1)
    wheel = share.cumsum(-1)
    return torch.searchsorted(
        wheel.contiguous(), (drawn.to(wheel.dtype) * wheel[..., -1:]).contiguous(), right=True
    ).clamp_max(cost.shape[-1] - 1)


def _check(
    population: int,
    generations: int,
    elites: int,
    selection: str,
    entrants: int,
    crossover: float,
    blend: float,
    mutation: float,
    spread: float,
    cooling: float,
) -> None:
    """Raise ValueError for invalid settings."""
    check_counts(
        "genetic",
        {
            "population": (population, 2),
            "generations": (generations, 0),
            "elites": (elites, 1),
            "entrants": (entrants, 1),
            "blend": (blend, 0),
            "spread": (spread, 0),
        },
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
