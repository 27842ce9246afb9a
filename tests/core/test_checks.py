"""When values of tensors are checked: at once on a CPU, at the end of a stage elsewhere."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

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


def signal(trials: int = 2) -> Signal:
    return Signal(torch.ones(trials, 4, 3, dtype=torch.complex64), AXES)


def chain() -> tuple[Chain, Doubled]:
    last = Doubled()
    return Chain(first=Doubled(), spoils=Spoilt(), third=Doubled(), last=last), last


def there(x: Signal) -> Signal:
    return x.with_data(to_device(x.data))


def test_checks_raise_at_the_stage() -> None:
    made, last = chain()
    with pytest.raises(ValueError, match=r"^Doubled: 1 of 24 .* index \(1, 2, 1\)"):
        made(signal())
    with pytest.raises(ValueError, match=r"^Doubled: 1 of 24 .* index \(1, 2, 1\)"), pretended_device():
        made(there(signal()))
    assert not last.calls


def test_the_checks_of_a_stage_are_made_with_one_reading() -> None:
    made = Chain(**{f"stage_{i}": Doubled() for i in range(5)})
    with pretended_device() as counts:
        made(there(signal()))
    assert counts.waits.total() == 5


def test_bad_samples_are_counted_without_a_list_of_them() -> None:
    bad = torch.full((300, 400), torch.nan, dtype=torch.complex64)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"120000 of 120000 samples are NaN or Inf, the first at index \(0, 0\)"):
        refuse_non_finite(bad, "image")
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    bad[:] = 1
    bad[7, 2:] = torch.inf
    with pytest.raises(ValueError, match=r"398 of 120000 .* index \(2, 7\)"):
        refuse_non_finite(bad.mT, "image")
    with pytest.raises(ValueError, match=r"1 of 1 .* index \(\)"):
        refuse_non_finite(torch.tensor(torch.nan), "gain")


def test_a_singular_matrix_is_named_by_its_index() -> None:
    matrix = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    matrix[1] = 0
    with pytest.raises(RuntimeError, match=r"singular at index \(1,\)"):
        linear_solve(matrix, torch.ones(3, 2, 1, dtype=torch.float64))


def test_a_number_on_the_host_makes_no_check_wait_for_the_device() -> None:
    with pretended_device() as counts, pytest.raises(ValueError, match="NaN"), gathered_checks():
        refuse_non_finite(to_device(torch.tensor([1.0, torch.nan])), "samples")
        assert host_value(torch.ones(()), 0.0) == 1.0
        assert not counts.waits.total()
        host_value(to_device(torch.ones(())), 0.0)


def test_an_error_that_a_bad_value_causes_does_not_hide_the_check() -> None:
    with pytest.raises(ValueError, match="NaN") as raised, pretended_device(), gathered_checks():
        refuse_non_finite(to_device(torch.tensor([1.0, torch.nan])), "samples")
        raise IndexError("of a value that is not finite")
    assert isinstance(raised.value.__context__, IndexError)


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


def test_constants_are_checked_while_a_program_is_traced() -> None:
    seen: list[float] = []
    x = torch.tensor([1.0, 7.0])
    program = torch.export.export(Scaled(seen.append), (x,), strict=False)
    assert set(seen) == {3.0}
    torch.testing.assert_close(program.module()(x), 2 * x)
