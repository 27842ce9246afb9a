"""Differential evolution for many trials at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.optim.population import Box, Dice, Population, Searched, best, check_counts, costs_of, pick

Strategy = Literal["rand1bin", "best1bin"]


def differential_evolution(
    objective: Population,
    low: Tensor,
    high: Tensor,
    *,
    population: int = 24,
    generations: int = 36,
    draws: Draws,
    strategy: Strategy = "rand1bin",
    weight: float = 0.7,
    crossover: float = 0.9,
) -> Searched:
    """Minimise a cost within bounds by differential evolution.

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
    box = Box.of(low, high, "differential_evolution")
    _check(population, generations, strategy, weight, crossover)
    rule = _Rule(Dice(draws, box), population, strategy, weight, crossover)
    x = rule.first()
    cost = costs_of(objective, x, "differential_evolution")
    history = [cost.amin(-1)]
    for generation in range(generations):
        rival = rule.challengers(generation, x, cost)
        value = costs_of(objective, rival, "differential_evolution")
        better = value <= cost
        x, cost = torch.where(better[..., None], rival, x), torch.where(better, value, cost)
        history.append(cost.amin(-1))
    found, least = best(x, cost)
    evaluations = torch.full(box.trials, population * (generations + 1), dtype=torch.int64, device=x.device)
    return Searched(found, least, evaluations, torch.stack(history, -1), torch.isfinite(least))


@dataclass(frozen=True)
class _Rule:
    """Settings and random numbers of differential evolution."""

    dice: Dice
    population: int
    strategy: Strategy
    weight: float
    crossover: float

    def first(self) -> Tensor:
        """First population, uniform within the bounds."""
        box = self.dice.box
        return box.at(self.dice.uniform("evolution first", (self.population, box.low.shape[-1])))

    def challengers(self, generation: int, x: Tensor, cost: Tensor) -> Tensor:
        """Challengers of all candidates in one generation."""
        at, n = f"evolution {generation}", x.shape[-1]
        base, one, other = (pick(x, index) for index in self._partners(f"{at} partners"))
        if self.strategy == "best1bin":
            base = best(x, cost)[0][..., None, :]
        mutant = self.dice.box.kept(base + self.weight * (one - other))
        chance = self.dice.uniform(f"{at} chance", (self.population, n + 1))
        forced = torch.arange(n, device=x.device) == (chance[..., n:] * n).to(torch.int64)
        return torch.where((chance[..., :n] < self.crossover) | forced, mutant, x)

    def _partners(self, purpose: str) -> tuple[Tensor, Tensor, Tensor]:
        """Three candidates (..., population) for each, different from it and from each other."""
        order = self.dice.uniform(purpose, (self.population, self.population)).clone()
        order.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
        first = order.argsort(-1)[..., :3]
        return first[..., 0], first[..., 1], first[..., 2]


def _check(population: int, generations: int, strategy: str, weight: float, crossover: float) -> None:
    """Raise ValueError for invalid settings."""
    check_counts("differential_evolution", {"population": (population, 4), "generations": (generations, 0)})
    if strategy not in ("rand1bin", "best1bin"):
        raise ValueError(f"differential_evolution: strategy {strategy!r} is not known; choose 'rand1bin' or 'best1bin'")
    if not (0 < weight <= 2 and 0 <= crossover <= 1):
        raise ValueError(
            "differential_evolution: weight must be above 0 and at most 2, and crossover must be a probability in "
            f"0..1, got weight={weight} and crossover={crossover}"
        )
