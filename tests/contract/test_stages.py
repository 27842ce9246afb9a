"""What every stage promises: one family of tests over the table of stages."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
from torch import Tensor

import torchsar
from tests.helpers import assert_forward_equals_backward
from tests.table.functions import ENTRIES
from tests.table.numbers import BUILT
from tests.table.stages import CASES, RADAR, Case, entering, raw, results
from torchsar.compensate import (
    AlignEnvelopes,
    Autofocus,
    CorrectPulsePhase,
    DopplerCentroid,
    EffectiveVelocity,
    EqualisePulses,
    PhaseIncrement,
    PulseGain,
    ShiftRange,
)
from torchsar.core import Estimate, Signal, Stage, real_dtype
from torchsar.focus import OmegaK
from torchsar.repair import (
    CorrectImbalance,
    CorrectJitter,
    EstimateImbalance,
    LinearFill,
    LineIntegrity,
    PilotJitter,
)

IDS = [case.name for case in CASES]


def single(values: dict[str, Tensor], i: int) -> dict[str, Tensor]:
    return {name: value[i] for name, value in values.items()}


@dataclass(frozen=True)
class Called:
    """A stage that was stored, loaded and moved, its input, and what it returned."""

    stage: Stage
    signal: Signal
    values: dict[str, Tensor]
    results: dict[str, Tensor]
    left_alone: bool


@cache
def called(case: Case, dtype: torch.dtype = torch.complex128) -> Called:
    """A call with two trials, 60 dB apart, and a third one of zeros, which several tests share."""
    stage, signal = case.build(), entering(case, raw(2, dtype, n_range=case.n_range))
    signal = signal.with_data(torch.cat([signal.data, torch.zeros_like(signal.data[:1])]))
    values, before = case.values(signal), signal.data.clone()
    stage.load_state_dict(stage.state_dict())
    found = results(stage.to("cpu")(signal, **values))
    return Called(stage, signal, values, found, torch.equal(signal.data, before))


def assert_equal_trials(
    case: Case, found: dict[str, Tensor], wanted: dict[str, Tensor], std: dict[str, Tensor]
) -> None:
    """To the tolerance times the value or, if that is larger, times its predicted deviation.

    A quality lies between 0 and 1: how exact a quality of 1e-13 is says nothing.
    """
    for name, value in wanted.items():
        measured = value.dtype != torch.bool and value.numel() and name != "quality"
        scale = float(value.abs().max()) if measured else 1.0
        deviation = std.get(name, torch.zeros(())).nan_to_num(posinf=0.0)
        torch.testing.assert_close(
            found[name],
            value,
            atol=case.tolerance * max(scale, float(deviation.max()) if deviation.numel() else 0.0, 1e-30),
            rtol=0,
            msg=lambda m, n=name: f"{n}: {m}",
        )


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_batch_equals_singles(case: Case) -> None:
    """Beside a trial of another level and an empty one, as a batch of one trial, and alone."""
    of = called(case)
    for i in range(2):
        out = of.stage(of.signal.with_data(of.signal.data[i]), **single(of.values, i))
        alone, std = results(out), out.std if isinstance(out, Estimate) else {}
        assert_equal_trials(case, single(of.results, i), alone, std)
        if i == 0:
            first = of.signal.with_data(of.signal.data[:1])
            batch = results(of.stage(first, **{name: value[:1] for name, value in of.values.items()}))
            assert_equal_trials(case, single(batch, 0), alone, std)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_dtype_and_device_are_kept(case: Case, dtype: torch.dtype) -> None:
    of = called(case, dtype)
    if "data" in of.results:
        data = of.results["data"]
        assert data.dtype == (dtype if case.keeps_complex else real_dtype(dtype))
        assert data.device == of.signal.data.device


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_results_are_finite_also_of_an_empty_trial(case: Case, dtype: torch.dtype) -> None:
    assert all(torch.isfinite(value).all() for value in called(case, dtype).results.values())


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_state_moves_and_input_is_left_alone(case: Case) -> None:
    assert called(case).left_alone


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_forward_mode_equals_reverse_mode(case: Case) -> None:
    stage, signal = case.build(), entering(case, raw(2, n_pulse=18, n_range=32))
    if stage.differentiable == "no":
        return
    values = case.values(signal)
    floating = {n: x.requires_grad_() for n, x in values.items() if x.is_floating_point() or x.is_complex()}

    def outputs(data: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        out = results(stage(signal.with_data(data), **{**values, **dict(zip(floating, tensors, strict=True))}))
        return tuple(value for value in out.values() if value.is_floating_point() or value.is_complex())

    data = signal.data / signal.data.abs().flatten(1).amax(1)[(slice(None),) + (None,) * (signal.data.ndim - 1)]
    assert_forward_equals_backward(outputs, (data.requires_grad_(), *floating.values()))


@pytest.mark.parametrize("case", [c for c in CASES if c.vmap], ids=[c.name for c in CASES if c.vmap])
def test_vmap_equals_batch(case: Case) -> None:
    stage, signal = case.build(), entering(case, raw(3, n_range=case.n_range))
    values = case.values(signal)
    mapped = results(torch.vmap(lambda one, given: stage(one, **given))(signal, values))
    for name, value in results(stage(signal, **values)).items():
        scale = float(value.abs().max()) if value.dtype != torch.bool and value.numel() else 1.0
        torch.testing.assert_close(mapped[name], value, atol=case.tolerance * max(scale, 1e-30), rtol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_non_finite_input_is_refused(case: Case, bad: float) -> None:
    stage, signal = case.build(), entering(case, raw(2, n_range=case.n_range))
    data = signal.data.clone()
    position = (1, *(0,) * (data.ndim - 3), *(min(i, n - 1) for i, n in zip((3, 5), data.shape[1:][-2:])))
    data[position] = bad
    with pytest.raises(
        ValueError, match=r"1 of \d+ samples are NaN or Inf, the first at index " + re.escape(str(position))
    ):
        stage(signal.with_data(data), **case.values(signal))


def _estimators() -> set[type[Stage]]:
    """Every stage of the library that may return an Estimate."""
    for module in pkgutil.walk_packages(torchsar.__path__, "torchsar."):
        if not module.name.startswith(("torchsar.study", "torchsar.cli", "torchsar.plot")):
            importlib.import_module(module.name)
    waiting, found = [Stage], set()
    while waiting:
        stages = waiting.pop().__subclasses__()
        waiting += stages
        found |= {s for s in stages if "Estimate" in str(inspect.signature(s.forward).return_annotation)}
    return {s for s in found if s.__module__.startswith("torchsar.") and not s.__name__.startswith("_")}


def test_every_estimator_has_neutral_values_or_says_why_not() -> None:
    built = [entry.build() for entry in ENTRIES if entry.build] + [build() for build in BUILT]
    assert _estimators() - {type(stage) for stage in built} == set(), "give these a row in tests/table"
    for stage in built:
        assert set(stage.neutral) == set(stage.provides), type(stage).__name__
        reasons = [value for value in stage.neutral.values() if isinstance(value, str)]
        assert all(len(reason.split()) > 3 for reason in reasons), type(stage).__name__


def test_a_neutral_value_has_no_effect_or_is_nominal() -> None:
    """Correctors leave the signal unchanged when they get the neutral values."""
    pairs = [
        (Autofocus(), CorrectPulsePhase(), (48,)),
        (EstimateImbalance(), CorrectImbalance(), (2,)),
        (PilotJitter(), CorrectJitter(), (4,)),
        (AlignEnvelopes(), ShiftRange(), (48,)),
        (PulseGain(), EqualisePulses(), (48,)),
        (LineIntegrity(), LinearFill(RADAR), (48,)),
    ]
    signal = raw(2)
    for estimator, corrector, shape in pairs:
        known = {name for name in inspect.signature(corrector.forward).parameters if name in estimator.neutral}
        given = {
            name: torch.full((2,) if name == "period" else (2, *shape), value)
            for name, value in estimator.neutral.items()
            if name in known and not isinstance(value, str)
        }
        out = corrector(signal, **given)
        torch.testing.assert_close(out.data, signal.data, rtol=0, atol=1e-12 * float(signal.data.abs().max()))
    pointing = replace(RADAR, pointing_doppler_hz=-250.0)
    assert DopplerCentroid(pointing).neutral["doppler_hz"] == -250.0
    assert DopplerCentroid(pointing).neutral["ambiguity"] == -1.0
    assert PhaseIncrement(pointing).neutral["doppler_baseband_hz"] == 150.0
    assert EffectiveVelocity(OmegaK(RADAR)).neutral["velocity_m_s"] == RADAR.velocity_m_s
