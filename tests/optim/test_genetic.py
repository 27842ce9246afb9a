"""Genetic algorithm: known minima, the box, counts, and results that do not depend on the batch."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import Tensor

from tests.optim.searches import CENTRE, F64, box, rastrigin, rotated, sphere
from torchsar.core import Draws
from torchsar.optim import genetic


@pytest.mark.parametrize("selection", ["tournament", "roulette"])
def test_finds_the_minimum_of_a_quadratic(selection: Literal["tournament", "roulette"]) -> None:
    found = genetic(sphere, *box(8), draws=Draws(1, trials=range(8)), selection=selection)
    assert found.ok.all()
    assert ((found.x - CENTRE).abs() < (0.02 if selection == "tournament" else 0.1)).all()


def test_finds_lower_costs_than_random_points_in_a_narrow_valley() -> None:
    draws = Draws(1, trials=range(20))
    found = genetic(rotated, *box(20), draws=draws)
    chance = rotated(draws.uniform("points", (870, 3), -5.0, 5.0)).amin(-1)
    assert found.cost.median() < 0.3 * chance.median()
    assert (found.cost < chance).float().mean() > 0.7


def test_leaves_local_minima() -> None:
    draws = Draws(2, trials=range(40))
    found = genetic(rastrigin, *box(40), draws=draws, population=60, generations=60)
    assert (found.cost < 0.9).sum() >= 24, "the next best minimum costs 1"
    still = genetic(rastrigin, *box(40), draws=draws, population=60, generations=60, mutation=0.0)
    assert (still.cost < 0.9).sum() < (found.cost < 0.9).sum()


def test_counts_evaluations_and_keeps_the_best() -> None:
    seen: list[int] = []

    def counted(x: Tensor) -> Tensor:
        seen.append(x.shape[-2])
        return sphere(x)

    found = genetic(counted, *box(3), draws=Draws(1), population=30, generations=30)
    assert sum(seen) == 870 and (found.evaluations == 870).all()
    assert found.history.shape == (3, 31)
    assert (found.history.diff(dim=-1) <= 0).all()
    assert torch.equal(found.history[..., -1], found.cost)
    torch.testing.assert_close(sphere(found.x), found.cost, atol=0, rtol=0)


def test_a_batch_equals_its_singles_and_chunks() -> None:
    low, high = box(4)
    low = low * torch.tensor([1, 0.5, 2, 0.1], dtype=F64)[:, None]
    whole = genetic(rotated, low, high, draws=Draws(3, trials=range(4)), generations=6)
    for part in ([0], [1, 2], [3]):
        alone = genetic(rotated, low[part], high[part], draws=Draws(3, trials=part), generations=6)
        torch.testing.assert_close(alone.x, whole.x[part], atol=1e-12, rtol=0)
        torch.testing.assert_close(alone.history, whole.history[part], atol=1e-12, rtol=1e-12)
    assert not torch.equal(whole.x[0], whole.x[1])


def test_draws_without_trials_are_the_same_in_every_trial() -> None:
    shared = genetic(sphere, *box(2, 3), draws=Draws(5), generations=4)
    alone = genetic(sphere, *box(), draws=Draws(5), generations=4)
    assert shared.x.shape == (2, 3, 3) and alone.x.shape == (3,)
    torch.testing.assert_close(shared.x, alone.x.expand(2, 3, 3), atol=1e-12, rtol=0)


def test_candidates_stay_in_the_box_and_fixed_unknowns_stay_fixed() -> None:
    low, high = torch.tensor([1.0, -2.0, 0.5], dtype=F64), torch.tensor([2.0, 3.0, 0.5], dtype=F64)

    def watched(x: Tensor) -> Tensor:
        assert (x >= low).all() and (x <= high).all()
        return sphere(x)

    found = genetic(watched, low, high, draws=Draws(1), spread=1.0, mutation=1.0)
    torch.testing.assert_close(found.x, torch.tensor([1.0, -0.7, 0.5], dtype=F64), atol=0.1, rtol=0)
    assert found.x[0] == 1.0 and found.x[2] == 0.5


def test_candidates_with_nan_costs_are_rejected() -> None:
    def half(x: Tensor) -> Tensor:
        return torch.where(x[..., 0] > 0, torch.nan, sphere(x))

    found = genetic(half, *box(2), draws=Draws(1, trials=range(2)), selection="roulette")
    assert found.ok.all() and (found.x[:, 0] <= 0).all()
    nowhere = genetic(lambda x: torch.full_like(x[..., 0], torch.nan), *box(2), draws=Draws(1), generations=2)
    assert not nowhere.ok.any() and torch.isfinite(nowhere.x).all()


def test_float32_is_kept() -> None:
    low, high = box(2)
    found = genetic(sphere, low.float(), high.float(), draws=Draws(1), generations=3)
    assert found.x.dtype == torch.float32


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"population": 1}, "population is 1"),
        ({"elites": 30}, "elites must be fewer than population=30"),
        ({"elites": 0}, "elites is 0"),
        ({"selection": "rank"}, "'tournament' or 'roulette'"),
        ({"crossover": 1.5}, "must be probabilities in 0..1"),
        ({"draws": Draws(1, trials=range(5))}, "draws for 5 trials"),
    ],
)
def test_invalid_settings_raise(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        genetic(sphere, *box(2), **{"draws": Draws(1), **options})


def test_invalid_boxes_and_objectives_raise() -> None:
    low, high = box(2)
    with pytest.raises(ValueError, match="low <= high"):
        genetic(sphere, high, low, draws=Draws(1))
    with pytest.raises(ValueError, match="finite"):
        genetic(sphere, low, high * torch.inf, draws=Draws(1))
    with pytest.raises(TypeError, match="float64 tensor"):
        genetic(sphere, low.long(), high, draws=Draws(1))
    with pytest.raises(ValueError, match="same number of unknowns"):
        genetic(sphere, low, high[..., :2], draws=Draws(1))
    with pytest.raises(ValueError, match="one real cost for each candidate"):
        genetic(lambda x: x, low, high, draws=Draws(1))
