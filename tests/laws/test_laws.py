"""Linearity, shifts, phases and scales, adjoints, energy, and the order of trials, on random data.

A few examples run; `TORCHSAR_LAW_EXAMPLES=1000` runs as many of each law, of random seeds.
"""

from __future__ import annotations

import cmath
import math
import os

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.extremes.judge import Results, trial
from tests.laws.table import (
    ALL,
    ESTIMATORS,
    LINEAR,
    PAIRS,
    TO_SAMPLES,
    Pair,
    axes,
    called,
    draw,
)
from tests.table.functions import Entry

EXAMPLES = int(os.environ.get("TORCHSAR_LAW_EXAMPLES", "0"))
SEEDS = st.integers(0, 2**31 - 1)
ANGLES = st.floats(-math.pi, math.pi)
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def few(examples: int) -> settings:
    """Examples of a law: `examples` that never change, or as many as the environment asks for."""
    return settings(
        max_examples=EXAMPLES or examples,
        derandomize=not EXAMPLES,
        deadline=None,
        database=None,
        suppress_health_check=(HealthCheck.too_slow,),
    )


def gap(a: Tensor, b: Tensor, turns: bool = False) -> float:
    """Largest difference over the largest value of b; of phases in rad modulo a turn."""
    assert a.shape == b.shape and a.dtype == b.dtype
    if not b.numel() or not (b.is_floating_point() or b.is_complex()):
        return float(not torch.equal(a, b))
    off = torch.remainder(a - b + math.pi, 2 * math.pi) - math.pi if turns else a - b
    size = float(torch.where(torch.isfinite(b.abs()), b.abs(), 0).max())
    return float(torch.where((a == b) | (a.isnan() & b.isnan()), 0, off.abs()).max()) / max(size, 1e-300)


def unlike(found: Results, wanted: Results, tolerance: float) -> list[str]:
    """Names of results of one trial that differ; those of a trial that is not ok do not count."""
    if "ok" in wanted and wanted["ok"].ndim == 0:
        if bool(found["ok"]) != bool(wanted["ok"]):
            return ["ok"]
        if not bool(wanted["ok"]):
            return []
    return [n for n, b in wanted.items() if not gap(found[n], b, n.startswith("phase_rad")) <= tolerance]


def by_name(entry: Entry) -> str:
    return entry.name


def test_laws_are_said_of_rows_that_they_can_hold_for() -> None:
    for entry in ALL:
        laws = entry.laws
        shifts = {axis for axis in ("pulse", "range") if getattr(laws, axis)}
        samples, linear = entry in TO_SAMPLES, entry in LINEAR
        assert samples or not (laws.linear or shifts or laws.energy), f"{entry.name} gives no samples that grow"
        assert linear or not (shifts or laws.energy), f"{entry.name} is not linear: shifts and energy are not tested"
        assert shifts <= set(axes(entry)), f"{entry.name} works on the axes {axes(entry)}"


@pytest.mark.parametrize("entry", LINEAR, ids=by_name)
@few(1)
@given(seed=SEEDS, angle=ANGLES, level=st.floats(-3, 3))
def test_linear(entry: Entry, seed: int, angle: float, level: float) -> None:
    """f(a x + y) = a f(x) + f(y) for complex numbers a, and the energy that is in the table."""
    a, x, y = 10**level * cmath.exp(1j * angle), draw(entry, seed), draw(entry, seed + 1)
    of_x, of_y, of_both = (called(entry, z)["data"] for z in (x, y, a * x + y))
    # differences relative to the larger of the terms, which may cancel
    largest = max(abs(a) * float(of_x.abs().max()), float(of_y.abs().max()), 1e-300)
    gone = float((of_both - a * of_x - of_y).abs().max())
    assert gone <= 1e-9 * largest, "not linear: give the reason in `linear` of the laws of the row, or its `degree`"
    if entry.laws.energy:
        grown = float(of_x.abs().square().sum() / x.abs().square().sum())
        assert grown == pytest.approx(entry.laws.energy, rel=1e-9), "not the `energy` of the laws of the row"


SHIFTED = [(entry, axis) for axis in ("pulse", "range") for entry in LINEAR if axis in axes(entry)]


@pytest.mark.parametrize(("entry", "axis"), SHIFTED, ids=[f"{entry.name} {axis}" for entry, axis in SHIFTED])
@few(1)
@given(seed=SEEDS, cells=st.sampled_from((1, 3, 5, 7)))
def test_shift(entry: Entry, axis: str, seed: int, cells: int) -> None:
    """A circular shift of the samples shifts the result, unless the table says why not."""
    dim = axes(entry).index(axis) - len(axes(entry))
    x = draw(entry, seed)
    found, plain = called(entry, x.roll(cells, dim))["data"], called(entry, x)["data"]
    same = gap(found, plain.roll(cells, dim)) <= 1e-9
    assert same == (not getattr(entry.laws, axis)), (
        f"a shift along {axis}, contrary to `laws`: the result shifts: {same}"
    )


@few(8)
@given(entry=st.sampled_from([e for e in ESTIMATORS if e.laws.range_free]), seed=SEEDS, cells=st.integers(1, 31))
def test_range_shift_of_estimators(entry: Entry, seed: int, cells: int) -> None:
    dim = axes(entry).index("range") - len(axes(entry)) if "range" in axes(entry) else -1
    x = draw(entry, seed)
    found, plain = called(entry, x.roll(cells, dim)), called(entry, x)
    assert not unlike(trial(found, 0, 1), trial(plain, 0, 1), 1e-6), entry.name


@few(12)
@given(
    entry=st.sampled_from([e for e in ALL if not e.laws.phase and e not in LINEAR]),
    seed=SEEDS,
    angle=ANGLES,
    level=st.floats(-3, 3),
)
def test_phase_and_scale(entry: Entry, seed: int, angle: float, level: float) -> None:
    """Results that grow with the samples follow their scale and phase, the others neither."""
    x, size = draw(entry, seed), 10**level
    found, plain = called(entry, size * cmath.exp(1j * angle) * x), called(entry, x)
    wanted = {}
    for name, value in plain.items():
        degree = entry.degree.get(name, 1 if name == "data" else 0)
        if degree is None or name in entry.laws.steps:
            continue
        follows = degree and (value.is_floating_point() or value.is_complex())
        factor = size**degree if follows else 1
        turn = cmath.exp(1j * angle) if value.is_complex() and degree == 1 else 1
        wanted[name] = value * factor * turn if follows else value
    assert not unlike(trial(found, 0, 1), trial(wanted, 0, 1), 1e-6), entry.name


@few(12)
@given(entry=st.sampled_from(ALL), seed=SEEDS, order=st.permutations(range(4)), size=st.integers(1, 4))
def test_order_and_size_of_batches(entry: Entry, seed: int, order: list[int], size: int) -> None:
    """Trials in another order and in a smaller batch give what they gave."""
    if entry.name == "StoredOmegaK":
        return
    x = torch.cat([draw(entry, seed + i) * 10.0**i for i in range(4)])
    together, some = called(entry, x), called(entry, x[order[:size]])
    for i, k in enumerate(order[:size]):
        assert not unlike(trial(some, i, size), trial(together, k, 4), 1e-6), entry.name


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair.name)
@few(2)
@given(seed=SEEDS)
def test_adjoint(pair: Pair, seed: int) -> None:
    """<A x, y> = <x, A' y>."""
    source = torch.Generator().manual_seed(seed)
    x, y = (torch.randn(3, *shape, dtype=torch.complex128, generator=source) for shape in (pair.given, pair.made))
    y = pair.forward(y) if pair.in_range else y
    left = (pair.forward(x) * y.conj()).flatten(1).sum(-1)
    right = (x * pair.adjoint(y).conj()).flatten(1).sum(-1)
    size = pair.forward(x).norm() * y.norm()
    assert float((left - right).abs().max()) <= pair.tolerance * float(size)
