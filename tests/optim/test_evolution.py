"""Differential evolution: known minima, and results that do not depend on the batch."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from tests.optim.searches import CENTRE, F64, box, rastrigin, rotated, sphere
from torchsar.core import Draws
from torchsar.optim import differential_evolution

Strategy = Literal["rand1bin", "best1bin"]


@pytest.mark.parametrize("strategy", ["rand1bin", "best1bin"])
def test_finds_the_minimum_of_quadratics(strategy: Strategy) -> None:
    draws = Draws(1, trials=range(6))
    assert ((differential_evolution(sphere, *box(6), draws=draws, strategy=strategy).x - CENTRE).abs() < 0.05).all()
    found = differential_evolution(rotated, *box(6), draws=draws, strategy=strategy, generations=120)
    assert (found.cost < 1e-4).all()


def test_leaves_local_minima() -> None:
    found = differential_evolution(
        rastrigin, *box(8), draws=Draws(1, trials=range(8)), generations=150, weight=0.5, crossover=0.3
    )
    assert (found.cost < 1e-2).all()


def test_counts_evaluations_and_keeps_the_best() -> None:
    found = differential_evolution(sphere, *box(2), draws=Draws(1))
    assert (found.evaluations == 888).all() and found.history.shape == (2, 37)
    assert (found.history.diff(dim=-1) <= 0).all()
    torch.testing.assert_close(sphere(found.x), found.cost, atol=0, rtol=0)


@pytest.mark.parametrize("strategy", ["rand1bin", "best1bin"])
def test_a_batch_equals_its_singles(strategy: Strategy) -> None:
    low, high = box(3)
    whole = differential_evolution(
        rotated, low, high, draws=Draws(3, trials=range(3)), generations=8, strategy=strategy
    )
    for i in range(3):
        one = slice(i, i + 1)
        alone = differential_evolution(
            rotated, low[one], high[one], draws=Draws(3, trials=[i]), generations=8, strategy=strategy
        )
        torch.testing.assert_close(alone.x[0], whole.x[i], atol=1e-12, rtol=0)


def test_candidates_stay_in_the_box() -> None:
    low, high = torch.tensor([1.0, -2.0, -2.0], dtype=F64), torch.tensor([2.0, 3.0, 3.0], dtype=F64)
    found = differential_evolution(sphere, low, high, draws=Draws(1))
    assert found.x[0] == 1.0
    nowhere = differential_evolution(
        lambda x: torch.full_like(x[..., 0], torch.nan), low, high, draws=Draws(1), generations=2
    )
    assert not nowhere.ok.any() and torch.isfinite(nowhere.x).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"population": 3}, "population is 3"),
        ({"strategy": "rand2"}, "'rand1bin' or 'best1bin'"),
        ({"weight": 0.0}, "weight must be above 0 .* got weight=0"),
        ({"crossover": -0.1}, "crossover must be a probability in 0..1"),
    ],
)
def test_invalid_settings_raise(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        differential_evolution(sphere, *box(2), draws=Draws(1), **options)
