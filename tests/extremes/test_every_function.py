"""Every public function and stage at the extremes: a right result, or one sentence; never a raw
error of a library, never silently wrong, never a silent NaN.

`TORCHSAR_RANDOM_CASES=10000` runs so many random cases, beginning with the seed
`TORCHSAR_RANDOM_SEED`; without it a small number runs.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.extremes.judge import DTYPES, VIEWS, differences, nan_in, outcome, random_case, trial
from tests.table import stages as contract
from tests.table.functions import ENTRIES, Entry, dims, samples
from tests.table.numbers import NUMBERS, REASONS
from torchsar import compensate, core, metrics, repair
from torchsar.core import Stage
from torchsar.multichannel.velocity.stages import strongest_line

PACKAGES = ["core", "radar", "scene", "echo", "repair", "compensate", "multichannel", "focus", "metrics", "io", "optim"]
RANDOM_CASES = int(os.environ.get("TORCHSAR_RANDOM_CASES", "60"))
FIRST_SEED = int(os.environ.get("TORCHSAR_RANDOM_SEED", "0"))
BATCHES = [entry for entry in ENTRIES if not entry.kind.startswith("one ") and not entry.joint]
# a power of two near 1e30: scaling by it has no rounding error
LEVEL = 2.0**100
# settle and level_of replace NaN on purpose; the Doppler of an impossible frame is NaN, as it says
MAY_DIFFER = ("core.settle", "core.level_of", "compensate.doppler_at")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def ids(entries: list[Entry]) -> list[str]:
    return [entry.name for entry in entries]


def test_no_public_function_or_stage_is_missing() -> None:
    listed = {entry.name.split(":")[0] for entry in ENTRIES} | set(NUMBERS) | set(REASONS)
    missing = []
    for package in PACKAGES:
        module = importlib.import_module(f"torchsar.{package}")
        for name in module.__all__:
            value = getattr(module, name)
            stage = inspect.isclass(value) and issubclass(value, Stage)
            if (stage or inspect.isfunction(value)) and not {name if stage else "", f"{package}.{name}"} & listed:
                missing.append(f"{package}.{name}")
    assert not missing, (
        f"{missing} need a row each: a stage in tests/table/stages.py (the row of its function too, if Stage.of makes "
        "it of one), a function of samples in functions.py, one of numbers, or a reason why it has none, in numbers.py"
    )


def test_reasons_stand_for_public_names_without_a_row() -> None:
    rows = {entry.name.split(":")[0] for entry in ENTRIES} | set(NUMBERS)
    assert not set(REASONS) & rows
    for name in (*REASONS, *(row for row in rows if "." in row)):
        package, _, own = name.rpartition(".")
        module = importlib.import_module(f"torchsar.{package}")
        assert hasattr(module, own), name
        assert name not in REASONS or own in module.__all__, f"{name} is not public and needs no reason"


@pytest.mark.parametrize("entry", BATCHES, ids=ids(BATCHES))
def test_levels_and_zeros_in_one_batch(entry: Entry) -> None:
    """Trials of 1, 1e30 and 1e-30, and one of zeros: none changes another."""
    one = samples(entry.kind, 2, torch.complex64)[:1]
    found = outcome(lambda: entry.call(torch.cat([one, one * LEVEL, one / LEVEL, torch.zeros_like(one)])))
    if isinstance(found, str):
        assert entry.refuses_levels, found
        return
    assert entry.nan_ok or not nan_in(found), f"NaN in {nan_in(found)} of trials of finite samples"
    alone = trial(found, 0, 4)
    for i, level in ((1, LEVEL), (2, 1 / LEVEL)):
        wrong = differences(trial(found, i, 4), alone, entry, level)
        assert not wrong, f"{wrong}, at {level:.0e} of the level; `degree` of the row says how a result grows with it"
    if "ok" in found and not entry.zero_ok:
        assert not bool(found["ok"][3].any())


@pytest.mark.parametrize("entry", BATCHES, ids=ids(BATCHES))
def test_views_and_nan(entry: Entry) -> None:
    """Lazily conjugated and strided samples of two trials, the second with a NaN."""
    x = samples(entry.kind, 2, torch.complex64).clone()
    x[1].view(-1)[0] = torch.tensor(complex(math.nan, math.nan))
    for view in ("conj", "transposed"):
        found = outcome(lambda view=view: entry.call(VIEWS[view](x)))
        if isinstance(found, str):
            assert "NaN" in found or "finite" in found or "matched to" in found
            continue
        spoiled = trial(found, 1, 2)
        assert nan_in(spoiled) or not bool(spoiled.get("ok", torch.tensor(True)).any())
        assert not nan_in(trial(found, 0, 2)), "a NaN in one trial changes another"


@pytest.mark.parametrize("entry", ENTRIES, ids=ids(ENTRIES))
def test_sizes_and_types(entry: Entry) -> None:
    """No trials, no samples, one sample along each dimension, and numbers of other types."""
    whole = samples(entry.kind, 1, torch.complex64)
    inputs = [whole[:0], whole[..., :0], *(whole.narrow(dim, 0, 1) for dim in range(-dims(entry.kind), 0))]
    for x in inputs:
        found = outcome(lambda x=x: entry.call(x))
        assert isinstance(found, str) or not nan_in(found), f"NaN in {nan_in(found)} of samples {tuple(x.shape)}"
    for dtype in DTYPES:
        outcome(lambda dtype=dtype: entry.call(whole.to(dtype) if dtype.is_complex else whole.real.to(dtype)))


VALUED = [case for case in contract.CASES if case.values is not contract.Case.values]


@pytest.mark.parametrize("case", VALUED, ids=[case.name for case in VALUED])
def test_nan_in_a_value_is_refused(case: contract.Case) -> None:
    """The message names the value."""
    signal = contract.entering(case, contract.raw(2, n_range=case.n_range))
    values = case.values(signal)
    for name, value in values.items():
        if value.is_floating_point():
            bad = value.clone()
            bad[-1].view(-1)[0] = math.nan
            with pytest.raises(ValueError, match=f"{name}: 1 of .* are NaN or Inf"):
                case.build()(signal, **{**values, name: bad})


@pytest.mark.parametrize(
    "call",
    [
        lambda x, bad: repair.correct_imbalance(x, bad[:2], torch.zeros(2)),
        lambda x, bad: repair.correct_imbalance(x, torch.ones(2), bad[:2]),
        lambda x, bad: repair.correct_jitter(x, bad[:4]),
        lambda x, bad: repair.correct_response(x, bad, None, 0.8),
        lambda x, bad: repair.correct_response(x, torch.zeros(33), bad[:33], 0.8),
        lambda x, bad: compensate.correct_pulse_phase(x, bad),
        lambda x, bad: compensate.equalise_pulses(x, bad),
        lambda x, bad: compensate.shift_range(x, bad),
    ],
)
def test_nan_is_refused_by_correctors(call: Callable[[Tensor, Tensor], Tensor]) -> None:
    bad = torch.ones(48)
    bad[1] = math.nan
    with pytest.raises(ValueError, match="1 of .* are NaN or Inf, the first at index"):
        call(torch.ones(48, 64, dtype=torch.complex64), bad)


def test_single_precision_does_not_choose_another_line() -> None:
    """Squares of 1e30 overflow in float32: the strongest line was then any line, and ok."""
    data = torch.randn(3, 8, 5, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    data[..., 3] *= 10
    for level in (1e-30, 1.0, 1e30):
        assert int(strongest_line(data * level)[1]) == 3


def test_subnormal_samples_have_a_finite_level() -> None:
    """Division by a subnormal level gave Inf and NaN, and raw errors of linear algebra."""
    data = torch.randn(2, 16, 24, dtype=torch.complex64, generator=torch.Generator().manual_seed(1)) * 1e-42
    assert torch.isfinite(torch.view_as_real(data / core.level_of(data))).all()
    assert not bool(compensate.link_phases(data).ok.any())


def test_sparse_samples_are_refused() -> None:
    with pytest.raises(TypeError, match=r"dense samples .* call to_dense\(\) first"):
        compensate.autofocus(torch.ones(16, 24, dtype=torch.complex64).to_sparse())


def test_contrast_of_nan_is_nan() -> None:
    image = torch.ones(2, 4, 4)
    image[1, 0, 0] = math.nan
    assert metrics.contrast(image).isnan().tolist() == [False, True]


def extreme(value: object, number: float) -> object:
    """The number in the form of the value."""
    if isinstance(value, Tensor):
        return torch.full_like(value, number)
    return tuple(number for _ in value) if isinstance(value, tuple) else number


@pytest.mark.parametrize("name", NUMBERS)
def test_extreme_numbers(name: str) -> None:
    """Finite numbers never give NaN, and NaN never gives numbers."""
    call, given = NUMBERS[name]
    assert not isinstance(outcome(lambda: call(**given)), str)
    for key, value in given.items():
        for number in (0.0, -1.0, 1e-30, 1e-6, 1.0, 1e9, 1e30, math.inf, math.nan):
            found = outcome(lambda k=key, v=value, x=number: call(**{**given, k: extreme(v, x)}))
            if isinstance(found, str) or math.isinf(number):
                continue
            shown = bool(nan_in(found))
            assert shown == math.isnan(number) or not found or name in MAY_DIFFER, (key, number)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_random_cases(part: int) -> None:
    seeds = range(FIRST_SEED + part, FIRST_SEED + RANDOM_CASES, 4)
    wrong = [found for found in (random_case(ENTRIES, seed) for seed in seeds) if found]
    assert not wrong, "\n".join(wrong)
