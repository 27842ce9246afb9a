"""Derivatives of every stage and function are true, or refused with a warning."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.table.functions import ENTRIES, Entry, named, samples, tile_plan
from tests.table.numbers import NUMBERS
from tests.table.stages import CASES, Case, entering, raw
from torchsar.compensate import autofocus
from torchsar.core import DerivativeWarning, Estimate, Stage
from torchsar.metrics import entropy
from torchsar.optim import implicit

Results = dict[str, Tensor]


def declared(name: str, built: Stage | None = None) -> str:
    """What a stage, or a function with this name in the table, says of its derivatives."""
    if built is not None:
        return built.differentiable
    package, *inside = name.split(":")[0].split(".")
    module = importlib.import_module(".".join(["torchsar", package, *inside[:-1]]))
    return getattr(getattr(module, inside[-1], None), "differentiable", "yes")


def values_of(out: Any) -> Results:
    """The results that have derivatives: samples and estimated values."""
    found = {name: x for name, x in named(out).items() if x.is_floating_point() or x.is_complex()}
    return {name: x for name, x in found.items() if name != "quality" and not name.startswith("std_")}


def inner(a: Tensor, b: Tensor, trials: int) -> Tensor:
    """Real inner product of each trial; that of tensors without trials counts for all of them."""
    product = (a.conj() * b).real
    return product.reshape(trials, -1).sum(-1) if a.ndim and len(a) == trials else product.sum().expand(trials)


def assert_derivatives(
    call: Callable[..., Any], given: Mapping[str, Tensor], trials: int, tolerance: float, step: float
) -> None:
    """Compare derivatives in a random direction with differences, in each trial that is ok."""
    source = torch.Generator().manual_seed(5)

    def alike(x: Tensor) -> Tensor:
        return torch.randn(x.shape, dtype=x.dtype, generator=source)

    chosen = {name: x for name, x in given.items() if x.is_floating_point() or x.is_complex()}
    leaves = {name: x.clone().requires_grad_() for name, x in chosen.items()}
    directions = {name: alike(x) * x.abs().clamp_max(1) for name, x in chosen.items()}
    out = call(**{**given, **leaves})
    # without samples there is nothing of which a derivative would tell
    ok = torch.stack([inner(x, x, trials) for x in chosen.values()]).any(0)
    for part in out if isinstance(out, tuple) else (out,):
        ok = ok & part.ok.reshape(trials, -1).all(-1) if isinstance(part, Estimate) else ok
    with torch.no_grad():
        low, high = (
            values_of(call(**{**given, **{name: x + side * step * directions[name] for name, x in chosen.items()}}))
            for side in (-1, 1)
        )
    for name, x in values_of(out).items():
        weight = alike(x)
        wanted, got = inner(weight, (high[name] - low[name]) / (2 * step), trials), torch.zeros(trials)
        if x.requires_grad:
            cost = (x.conj() * weight).real.sum()
            slopes = torch.autograd.grad(cost, leaves.values(), retain_graph=True, materialize_grads=True)
            assert all(torch.isfinite(slope).all() for slope in slopes), name
            got = torch.stack(list(map(inner, slopes, directions.values(), [trials] * len(slopes)))).sum(0)
        rounding = (1e-3 + 100 * torch.finfo(x.dtype).eps / step) * float(x.detach().abs().max()) + 1e-12
        scale = torch.maximum(wanted.abs(), got.abs()).clamp_min(rounding)
        wrong = ok & ((got - wanted).abs() > tolerance * scale)
        assert not wrong.any(), f"{name}: {got.tolist()} for {wanted.tolist()}, ok {ok.tolist()}"


def assert_refused(call: Callable[..., Any], given: Mapping[str, Tensor]) -> None:
    leaves = {n: x.clone().requires_grad_() if x.is_floating_point() or x.is_complex() else x for n, x in given.items()}
    with pytest.warns(DerivativeWarning, match="has no derivatives"):
        out = call(**leaves)
    assert not any(x.requires_grad for x in named(out).values())


def check(kind: str, call: Callable[..., Any], given: Mapping[str, Tensor], trials: int, coarse: float = 1.0) -> None:
    if kind == "no":
        assert_refused(call, given)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert_derivatives(call, given, trials, 1e-2 if kind == "where ok" or coarse > 1 else 1e-3, 1e-5 * coarse)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_stages(case: Case) -> None:
    """By the signal and by all values, beside a trial of zeros."""
    stage, signal = case.build(), entering(case, raw(2, n_range=case.n_range))
    scale = signal.data.abs().flatten(1).amax(1)[(slice(None),) + (None,) * (signal.data.ndim - 1)]
    data = torch.cat([signal.data / scale, torch.zeros_like(signal.data[:1])])
    signal = signal.with_data(data)
    values = case.values(signal)
    check(
        stage.differentiable, lambda data, **given: stage(signal.with_data(data), **given), {"data": data, **values}, 3
    )


# StoredOmegaK takes complex64 only: tests/focus/test_stored_omega_k.py
FUNCTIONS = [
    e for e in ENTRIES if not e.kind.startswith("case ") and e.name.count(".") < 2 and e.name != "StoredOmegaK"
]


@pytest.mark.parametrize("entry", FUNCTIONS, ids=[entry.name for entry in FUNCTIONS])
def test_functions(entry: Entry) -> None:
    kind = declared(entry.name, entry.build() if entry.build else None)
    check(
        kind, lambda data: entry.call(data), {"data": samples(entry.kind, 2, torch.complex128)}, 1 if entry.joint else 2
    )


@pytest.mark.parametrize("name", [name for name in NUMBERS if name.count(".") == 1])
def test_functions_of_numbers(name: str) -> None:
    """By each argument that may be a tensor."""
    call, given = NUMBERS[name]
    for key in given:
        x = torch.as_tensor(given[key])
        if not x.is_complex():
            x = x.to(torch.float64)
        try:
            out = call(**{**given, key: x.clone().requires_grad_(not x.is_complex())})
        except (TypeError, ValueError):
            continue  # a number
        single = any(y.dtype in (torch.float32, torch.complex64) for y in values_of(out).values())
        check(declared(name), lambda x, key=key: call(**{**given, key: x}), {"x": x}, 1, 1e3 if single else 1)


def test_torch_func_differentiates_images_of_moved_tiles() -> None:
    x, plan = samples("raw", 2, torch.complex128), tile_plan(48, 64)
    place, reference = plan.antennas.transmitter_m, plan.antennas.reference_m

    def cost(offset: Tensor, history: Tensor) -> Tensor:
        return entropy(plan.moved(place + offset, None, reference).image(history))

    offset = torch.zeros_like(place).requires_grad_()
    (wanted,) = torch.autograd.grad(cost(offset, x[0]), offset)
    torch.testing.assert_close(torch.func.grad(cost)(offset.detach(), x[0]), wanted)
    with pytest.raises(RuntimeError, match="vmap cannot map plans of tiles.* leading dimension"):
        torch.vmap(cost)(torch.zeros(2, *place.shape, dtype=torch.float64), x)


def test_vmap_refuses_estimators_of_phases_in_one_sentence() -> None:
    with pytest.raises(RuntimeError, match="vmap cannot map estimators of phases.* leading dimensions"):
        torch.vmap(lambda x: autofocus(x)["phase_rad"])(samples("raw", 2, torch.complex128))


def test_minima_refuse_torch_func_in_one_sentence() -> None:
    data = torch.tensor([4.0, 9.0], dtype=torch.float64)

    def root(data: Tensor) -> Tensor:
        return implicit(lambda x, d: (x[..., 0].square() - d).square(), data.detach().sqrt()[:, None], data).sum()

    with pytest.raises(RuntimeError, match="use torch.autograd.grad"):
        torch.func.grad(root)(data)
