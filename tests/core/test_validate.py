"""When values of tensors are checked: at once, at the end of a chain or block, or not at all."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import torchsar
from tests.contract.pretended import pretended_device, to_device
from torchsar.core import (
    Axis,
    Chain,
    Signal,
    Stage,
    check_value,
    gathered_checks,
    host_value,
    linear_solve,
    refuse_non_finite,
    unit_phasor,
    untraced,
)

AXES = (Axis("pulse", 4, 0.0, 1.0, "s"), Axis("range", 3, 0.0, 1.0, "m"))


class Doubled(Stage):
    """A stage that counts its calls."""

    works_on = ("pulse", "range")

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, signal: Signal) -> Signal:
        self.calls += 1
        return signal.with_data(2 * signal.data)


class Spoilt(Doubled):
    """A stage whose result is infinite in the trial 1."""

    def forward(self, signal: Signal) -> Signal:
        data = super().forward(signal).data.clone()
        data[1, 2, 1] = torch.inf
        return signal.with_data(data)


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    yield
    torchsar.validate("eager")


def signal(trials: int = 2) -> Signal:
    return Signal(torch.ones(trials, 4, 3, dtype=torch.complex64), AXES)


def chain() -> tuple[Chain, Doubled]:
    last = Doubled()
    return Chain(first=Doubled(), spoils=Spoilt(), third=Doubled(), last=last), last


def there(x: Signal) -> Signal:
    return x.with_data(to_device(x.data))


def test_eager_checks_raise_at_the_stage() -> None:
    made, last = chain()
    with pytest.raises(ValueError, match=r"^Doubled: 1 of 24 .* index \(1, 2, 1\)"):
        made(signal())
    with pytest.raises(ValueError, match=r"^Doubled: 1 of 24 .* index \(1, 2, 1\)"), pretended_device():
        made(there(signal()))
    assert not last.calls


@pytest.mark.parametrize("place", [lambda x: x, there])
def test_deferred_checks_name_stage_and_trial_at_the_end_of_the_chain(place: Callable[[Signal], Signal]) -> None:
    made, last = chain()
    torchsar.validate("deferred")
    message = r"^stage 'third': Doubled: 1 of 24 .* index \(1, 2, 1\)"
    with pretended_device() as counts, pytest.raises(ValueError, match=message):
        made(place(signal()))
    assert last.calls == 1 and counts.waits.total() == (place is there)


def test_deferred_checks_of_a_chain_are_made_with_one_reading() -> None:
    made = Chain(**{f"stage_{i}": Doubled() for i in range(5)})
    expected: dict[torchsar.core.Validation, int] = {"eager": 5, "deferred": 1, "off": 0}
    for mode, waits in expected.items():
        torchsar.validate(mode)
        with pretended_device() as counts:
            made(there(signal()))
        assert counts.waits.total() == waits, mode


def test_a_number_on_the_host_makes_no_check_wait_for_the_device() -> None:
    with pretended_device() as counts, pytest.raises(ValueError, match="NaN"), gathered_checks():
        refuse_non_finite(to_device(torch.tensor([1.0, torch.nan])), "samples")
        assert host_value(torch.ones(()), 0.0) == 1.0
        assert not counts.waits.total()
        host_value(to_device(torch.ones(())), 0.0)


def test_checks_of_a_block_are_made_at_its_end() -> None:
    made, _ = chain()
    with (
        pretended_device() as counts,
        pytest.raises(ValueError, match="stage 'third'"),
        torchsar.validate("deferred"),
    ):
        for _ in range(3):
            made(there(signal()))
        assert not counts.waits.total()
    assert counts.waits.total() == 1
    with pytest.raises(ValueError, match="^Doubled"):  # eager again
        made(signal())


def test_an_error_that_a_bad_value_causes_does_not_hide_the_check() -> None:
    with pytest.raises(ValueError, match="NaN") as raised, torchsar.validate("deferred"):
        refuse_non_finite(torch.tensor([1.0, torch.nan]), "samples")
        raise IndexError("of a value that is not finite")
    assert isinstance(raised.value.__context__, IndexError)


def test_nothing_is_checked_about_values_but_shapes_and_dtypes_are() -> None:
    made, last = chain()
    with torchsar.validate("off"):
        assert (~torch.isfinite(made(signal()).data)).sum() == 1 and last.calls == 1
        with pytest.raises(TypeError, match="complex"):
            made(Signal(torch.ones(4, 3), AXES))
        with pytest.raises(ValueError, match="axes"):
            made(Signal(torch.ones(4, dtype=torch.complex64), AXES[:1]))


def test_deferred_checks_do_not_keep_the_samples() -> None:
    with torchsar.validate("deferred"):
        samples = np.ones(1000)
        kept = weakref.ref(samples)
        refuse_non_finite(torch.from_numpy(samples), "samples")
        del samples
        assert kept() is None


def test_deferred_checks_name_the_index_of_phases_and_matrices() -> None:
    turns = torch.zeros(3, 2, dtype=torch.float64)
    turns[2, 1] = 1e13
    with pytest.raises(ValueError, match=r"1e\+13 turns at index \(2, 1\)"), torchsar.validate("deferred"):
        unit_phasor(turns, torch.complex64)
    matrix = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    matrix[1] = 0
    with pytest.raises(RuntimeError, match=r"singular at index \(1,\)"), torchsar.validate("deferred"):
        linear_solve(matrix, torch.ones(3, 2, 1, dtype=torch.float64))


def test_modes_are_nested() -> None:
    def refused(x: float) -> None:
        raise ValueError("refused")

    with torchsar.validate("off"):
        check_value(torch.tensor(1.0), refused)
        with pytest.raises(ValueError, match="refused"), torchsar.validate("eager"):
            check_value(torch.tensor(1.0), refused)
        check_value(torch.tensor(1.0), refused)
    with pytest.raises(ValueError, match="refused"):
        check_value(torch.tensor(1.0), refused)
    with pytest.raises(ValueError, match="'eager', 'deferred' or 'off', got 'lazy'"):
        torchsar.validate("lazy")  # pyright: ignore[reportArgumentType]


class Scaled(nn.Module):
    """Multiplies by the largest sample, where it can be read, and has checked a constant before."""

    def __init__(self, check: Callable[[float], None]) -> None:
        super().__init__()
        self.held, self.check = torch.arange(3.0), check

    @gathered_checks()
    def forward(self, x: Tensor) -> Tensor:
        with untraced():
            check_value(self.held.sum(), self.check)
        return x * host_value(x.max(), 2.0)


@pytest.mark.parametrize("mode", ["eager", "deferred"])
def test_constants_are_checked_while_a_program_is_traced(mode: torchsar.core.Validation) -> None:
    seen: list[float] = []
    x = torch.tensor([1.0, 7.0])
    with torchsar.validate(mode):
        program = torch.export.export(Scaled(seen.append), (x,), strict=False)
    assert set(seen) == {3.0}
    torch.testing.assert_close(program.module()(x), 2 * x)


def test_estimates_do_not_depend_on_when_values_are_checked() -> None:
    x = torch.randn(2, 32, 24, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))

    def phase(mode: torchsar.core.Validation) -> Tensor:
        with torchsar.validate(mode):
            return torchsar.compensate.autofocus(x)["phase_rad"]

    expected = phase("eager")
    assert torch.equal(phase("deferred"), expected) and torch.equal(phase("off"), expected)
