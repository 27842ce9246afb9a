"""Stages of users: what they forget is one sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from torchsar.core import Axis, Chain, Estimate, Signal, Stage, use

AXES = Axis("pulse", 4, 0.0, 0.1, "s"), Axis("range", 3, 0.0, 1.0, "m")
SIGNAL = Signal(torch.ones(2, 4, 3, dtype=torch.complex64), AXES)


class Estimates(Stage):
    """Returns the estimate that a test makes."""

    provides = ("level",)

    def __init__(self, make: Callable[[], Estimate]) -> None:
        super().__init__()
        self.make = make

    def forward(self, signal: Signal) -> Estimate:
        return self.make()


@pytest.mark.parametrize("attribute", [2.0, torch.nn.Identity()], ids=["number", "module"])
def test_a_constructor_begins_with_that_of_the_base(attribute: object) -> None:
    class Forgets(Stage):
        def __init__(self) -> None:
            self.attribute = attribute

    with pytest.raises(TypeError, match=r"Forgets\.__init__ must call super\(\)\.__init__\(\) first"):
        Forgets()


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: Estimate({"level": torch.tensor(1.0)}), r"for the trials \(2,\) .* has the shape \(\)"),
        (lambda: Estimate({"level": torch.ones(3)}), r"for the trials \(2,\) .* has the shape \(3,\)"),
        (lambda: Estimate({"other": torch.ones(2)}), r"provides \('level',\), .* only \['other'\]"),
        (
            lambda: Estimate({"level": torch.ones(2)}, quality=torch.tensor([0.5, 7.0])),
            "lies from 0 to 1, got 0.5 to 7",
        ),
    ],
    ids=["no trial", "other trials", "other name", "quality"],
)
def test_an_estimate_fits_its_stage_and_the_trials(make: Callable[[], Estimate], said: str) -> None:
    with pytest.raises(ValueError, match=f"Estimates.*{said}"):
        Chain(level=Estimates(make))(SIGNAL)


def test_estimates_of_targets_and_of_further_trials_are_accepted() -> None:
    for shape in ((2,), (2, 5), (3, 2)):
        found = Estimates(lambda shape=shape: Estimate({"level": torch.ones(shape)}))(SIGNAL)
        assert found["level"].shape == shape


def test_a_wrong_argument_is_what_the_error_says() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'gain'"):
        Estimates(gain=2.0)  # pyright: ignore[reportCallIssue]


class Pairs(Stage):
    """Returns what a test makes."""

    def __init__(self, make: Callable[[Signal], Any]) -> None:
        super().__init__()
        self.make = make

    def forward(self, signal: Signal) -> Any:
        return self.make(signal)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda x: (x, x), r"\(Signal, Signal\)"),
        (lambda x: (x, None, 3), r"\(Signal, NoneType, int\)"),
        (lambda x: (x, (x,)), r"\(Signal, \(Signal\)\)"),
        (lambda x: {"level": 1}, r"\{level: int\}"),
    ],
)
def test_what_no_stage_returns_is_named(make: Callable[[Signal], Any], said: str) -> None:
    with pytest.raises(TypeError, match=rf"stage 'pair' \(Pairs\) returned {said}; a stage returns a Signal"):
        Chain(pair=Pairs(make))(SIGNAL)


class Mean(torch.nn.Module):
    """Estimator that is no stage."""

    provides = ("level",)

    def forward(self, signal):
        return Estimate({"level": signal.data.abs().mean(signal.dim("pulse")).mean(-1)})


class Uses(Stage):
    """Takes a level."""

    def forward(self, signal: Signal, level: torch.Tensor) -> Signal:
        return signal.with_data(signal.data * level[..., None, None])


def test_a_module_that_provides_values_gets_the_signal() -> None:
    data = torch.full((2, 4, 3), 2.0 + 0j, requires_grad=True)
    out = Chain(mean=Mean(), uses=use(Uses(), level="mean"))(Signal(data, AXES))
    out.data.real.sum().backward()
    assert out.data.real.unique().tolist() == [4.0]
    # the derivative of the level is not cut
    torch.testing.assert_close(data.grad, torch.full_like(data, 4.0))


def test_a_module_without_provides_is_named() -> None:
    silent = type("Silent", (torch.nn.Module,), {"forward": Mean.forward})
    with pytest.raises(ValueError, match=r"no earlier stage provides \(stage 'mean' lacks the attribute `provides`"):
        Chain(mean=silent(), uses=use(Uses(), level="mean"))
    with pytest.raises(TypeError, match="dim") as caught:
        Chain(mean=silent())(SIGNAL)
    assert caught.value.__notes__ == ["stage 'mean' (Silent), which is no Stage, was given a Tensor"]
