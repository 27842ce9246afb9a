"""A genetic algorithm on real numbers, many trials at once: the published search of brief 003
(Remote Sens. 2025, 17, 3447, section 3.3).
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
    """Least cost inside a box by selection, blend crossover, Gaussian mutation and elitism.

    objective: (..., population, n) candidates -> (..., population) costs, of all trials at once;
    NaN counts as +inf. low, high: (..., n) per trial. The first population is uniform in the box;
    then `generations` times the `elites` best live on and population - elites children are made and
    evaluated, so a trial costs population + generations * (population - elites) evaluations (870 by
    default). history: (..., generations + 1) least cost so far.

    selection: "tournament" takes the best of `entrants` candidates drawn with replacement;
    "roulette" draws with a chance proportional to how far a candidate is below the worst finite
    cost. crossover: chance that a child is a blend, each unknown at a uniform place of the line
    through both parents, `blend` of their distance beyond either; otherwise it copies the first
    parent. mutation: chance per unknown of a Gaussian step of `spread` times the side of the box,
    which shrinks by `cooling` every generation. Children outside the box are moved onto its edge.

    draws: with trials, as many as the box has, or without: then all trials see the same numbers.
    Results depend on them alone, not on how trials are batched. The paper gives neither rates nor
    operators; these are ours (Goldberg 1989; Eshelman and Schaffer 1993, BLX-alpha). Raises
    TypeError or ValueError for a box, an answer of the objective or settings that make no sense.
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
        box = self.dice.box
        return box.at(self.dice.uniform("genetic first", (self.population, box.low.shape[-1])))

    def children(self, generation: int, x: Tensor, cost: Tensor) -> Tensor:
        """The next brood (..., brood, n) of ranked candidates x (..., population, n)."""
        at = f"genetic {generation}"
        box, n = self.dice.box, x.shape[-1]
        one, other = (pick(x, self._parents(f"{at} parent {i}", cost)) for i in range(2))
        place = self.dice.uniform(f"{at} blend", (self.brood, n)) * (1 + 2 * self.blend) - self.blend
        chance = self.dice.uniform(f"{at} chance", (self.brood, n + 1))
        child = torch.where(chance[..., :1] < self.crossover, one + place * (other - one), one)
        step = self.dice.normal(f"{at} mutation", (self.brood, n)) * (box.high - box.low)[..., None, :]
        child = child + torch.where(chance[..., 1:] < self.mutation, step * (self.spread * self.cooling**generation), 0)
        return box.kept(child)

    def _parents(self, purpose: str, cost: Tensor) -> Tensor:
        """Numbers (..., brood) of the parents chosen among candidates ranked by cost."""
        if self.selection == "tournament":
            drawn = self.dice.uniform(purpose, (self.brood, self.entrants))
            return (drawn.amin(-1) * self.population).to(torch.int64).clamp_max(self.population - 1)
        return _spun(cost, self.dice.uniform(purpose, (self.brood,)))


def _spun(cost: Tensor, drawn: Tensor) -> Tensor:
    """Roulette: numbers of candidates with chances proportional to the worst finite cost less their
    own; all alike where none differ.
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
        raise ValueError(f"genetic: {elites} elites leave no children in a population of {population}; choose fewer")
    if selection not in ("tournament", "roulette"):
        raise ValueError(f"genetic: selection {selection!r} is not known; choose 'tournament' or 'roulette'")
    if not (0 <= crossover <= 1 and 0 <= mutation <= 1 and 0 < cooling <= 1):
        raise ValueError(
            f"genetic: crossover {crossover} and mutation {mutation} are chances in 0..1, cooling "
            f"{cooling} a factor above 0 and at most 1"
        )
