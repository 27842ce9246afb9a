"""Doubtful estimates are used by default, failed ones are neutral, and traces say where."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsar.core import Alternate, Axis, Chain, Estimate, Outcome, Signal, Stage, Turn, use

F64 = torch.float64
OK = torch.tensor([True, False, True])
NOISE = Outcome.of(OK, Outcome.NOISE)
# one trial of every kind: ok, doubtful, failed
MIXED = torch.tensor([Outcome.OK, Outcome.MISFIT, Outcome.NOISE])


class Level(Stage):
    """Estimator of one number a pulse, with the outcomes of the constructor."""

    provides = ("level", "count")
    neutral = {"level": 0.0, "count": 1}

    def __init__(self, outcome: Tensor = NOISE) -> None:
        super().__init__()
        self.outcome = outcome

    def forward(self, signal: Signal, level: Tensor | None = None) -> Estimate:
        value = {"level": signal.data.real.mean(-1), "count": torch.full(signal.trials, 7)}
        return Estimate(value, outcome=self.outcome)


class Free(Level):
    """Estimator of a value that has no neutral one."""

    neutral = {"level": "every level is as likely", "count": 1}


class Subtract(Stage):
    """Corrector that subtracts the number from every pulse."""

    def forward(self, signal: Signal, level: Tensor, count: Tensor | None = None) -> Signal:
        return signal.with_data(signal.data - level[..., None])


class Double(Stage):
    """Stage that estimates and corrects at once."""

    provides = ("factor",)
    neutral = {"factor": 1.0}

    def __init__(self, outcome: Tensor = NOISE) -> None:
        super().__init__()
        self.outcome = outcome

    def forward(self, signal: Signal) -> tuple[Signal, Estimate]:
        return signal.with_data(2 * signal.data), Estimate({"factor": 2.0 * OK.double() + 1}, outcome=self.outcome)


def pulses(**kwargs: bool) -> Signal:
    data = torch.arange(24, dtype=F64).reshape(3, 4, 2).to(torch.complex128) + 1
    return Signal(data.requires_grad_(**kwargs), (Axis("pulse", 4, 0.0, 1.0, "s"), Axis("range", 2, 0.0, 1.0, "m")))


def test_a_value_that_is_not_ok_is_neutral_for_later_stages_and_the_trace_says_so() -> None:
    x = pulses()
    chain = Chain(level=Level(), correct=use(Subtract(), level="level", count="level"))
    trace, applied = chain.trace(x), Subtract()(x, Level()(x)["level"])
    assert torch.equal(trace.signal.data[OK], applied.data[OK]) and torch.equal(trace.signal.data[1], x.data[1])
    assert torch.equal(chain(x).data, trace.signal.data)
    assert torch.equal(trace.values["level.level"], Level()(x)["level"]), "the estimate itself is kept"
    assert torch.equal(trace.estimates["level"]["level"], trace.values["level.level"])
    assert {name: mask.tolist() for name, mask in trace.neutral.items()} == {
        "correct.level": [False, True, False],
        "correct.count": [False, True, False],
    }
    assert trace.arguments["correct"]["count"].tolist() == [7, 1, 7]
    assert trace.arguments["correct"]["count"].dtype == torch.int64


@pytest.mark.parametrize(
    ("in_doubt", "used", "doubtful"),
    [("apply", [True, True, False], [False, True, False]), ("neutral", [True, False, False], [False] * 3)],
)
def test_a_doubtful_value_is_used_unless_the_connection_says_otherwise(
    in_doubt: str, used: list[bool], doubtful: list[bool]
) -> None:
    x, keep = pulses(), torch.tensor(used)
    chain = Chain(level=Level(MIXED), correct=use(Subtract(), in_doubt=in_doubt, level="level"))
    trace, applied = chain.trace(x), Subtract()(x, Level()(x)["level"]).data
    assert torch.equal(trace.signal.data, torch.where(keep[:, None, None], applied, x.data))
    assert trace.neutral["correct.level"].tolist() == (~keep).tolist()
    assert trace.doubtful["correct.level"].tolist() == doubtful
    again = chain.retrace(trace, "correct")
    assert again.doubtful["correct.level"].tolist() == doubtful


@pytest.mark.parametrize(("in_doubt", "used"), [("apply", [True, True, False]), ("neutral", [True, False, False])])
def test_a_stage_that_estimates_and_corrects_does_so_in_doubt_too(in_doubt: str, used: list[bool]) -> None:
    x, keep = pulses(), torch.tensor(used)
    trace = Chain(twice=use(Double(MIXED), in_doubt=in_doubt)).trace(x)
    assert torch.equal(trace.signal.data, torch.where(keep[:, None, None], 2 * x.data, x.data))
    assert trace.neutral["twice"].tolist() == (~keep).tolist()
    assert trace.doubtful["twice"].tolist() == [False, in_doubt == "apply", False]


def test_gradients_flow_where_the_estimate_is_ok() -> None:
    x = pulses(requires_grad=True)
    chain = Chain(level=Level(), correct=use(Subtract(), level="level"))
    (slope,) = torch.autograd.grad(chain(x).data.real.sum(), x.data)
    # the mean is removed from a trial that is ok, so that its sum is constant
    assert slope[OK].abs().max() < 1e-12 and torch.equal(slope[1], torch.ones_like(slope[1]))


def test_a_stage_that_estimates_and_corrects_leaves_the_signal_unchanged_where_it_failed() -> None:
    x = pulses()
    trace = Chain(twice=Double()).trace(x)
    assert torch.equal(trace.signal.data[OK], 2 * x.data[OK]) and torch.equal(trace.signal.data[1], x.data[1])
    assert trace.neutral["twice"].tolist() == [False, True, False]


def test_a_value_that_is_given_takes_the_place_of_the_neutral_one() -> None:
    """Such as the start of a search, or what is known a priori."""
    x = pulses()
    first = Level(Outcome.OK.like(OK))
    chain = Chain(first=first, second=use(Level(), level="first"), correct=use(Subtract(), level="second"))
    assert torch.equal(chain(x).data, Subtract()(x, first(x)["level"]).data)


def test_without_a_neutral_value_the_estimate_is_used() -> None:
    x = pulses()
    trace = Chain(level=Free(), correct=use(Subtract(), level="level")).trace(x)
    assert torch.equal(trace.signal.data, Subtract()(x, Level()(x)["level"]).data) and not trace.neutral


def test_reruns_and_given_estimates_remain_in_doubt_and_given_values_do_not() -> None:
    x = pulses()
    chain = Chain(level=Level(), correct=use(Subtract(), level="level"), last=use(Subtract(), level="level"))
    trace = chain.trace(x)
    assert torch.equal(chain.rerun(trace, "correct").data, trace.signal.data)
    again = chain.retrace(chain.retrace(trace, "correct"), "last")
    assert torch.equal(again.signal.data, trace.signal.data) and again.arguments.keys() == trace.arguments.keys()
    assert torch.equal(chain(x, given={"level": trace.estimates["level"]}).data, trace.signal.data)
    value = trace.values["level.level"] + 0
    given = Subtract()(Subtract()(x, value), value).data
    assert torch.equal(chain.rerun(trace, "correct", given={"level.level": value}).data, given)
    assert torch.equal(chain(x, given={"level.level": value, "level.count": OK}).data, given)
    assert again.neutral.keys() == trace.neutral.keys()
    with pytest.raises(KeyError, match=r"unknown names \['lvel'\]"):
        chain(x, given={"lvel": trace.estimates["level"]})


def test_a_given_estimate_of_a_function_has_the_neutral_values_of_the_stage() -> None:
    """A function returns its Estimate without neutral values."""
    x, chain = pulses(), Chain(level=Level(), correct=use(Subtract(), level="level"))
    bare = Level()(x)
    bare = Estimate(bare.value, outcome=bare.outcome)
    assert torch.equal(chain(x, given={"level": bare}).data, chain(x).data)
    with pytest.raises(ValueError, match=r"'level' of the estimate 'level' must begin with the trial dimensions"):
        chain(x, given={"level": Estimate(bare.value, outcome=bare.outcome[:2])})
    with pytest.raises(TypeError, match="`given` must map names"):
        chain(x, given=[bare])  # pyright: ignore[reportArgumentType]


def test_vmap_agrees_with_the_batch() -> None:
    class Large(Level):
        def forward(self, signal: Signal, level: Tensor | None = None) -> Estimate:
            large = signal.data.real.amax((-2, -1))
            return replace(super().forward(signal), outcome=Outcome.of(large > 10, Outcome.NOISE), quality=large / 32)

    x, chain = pulses(), Chain(level=Large(), correct=use(Subtract(), level="level"))
    mapped = torch.vmap(lambda data: chain(x.with_data(data)).data)(x.data)
    assert torch.equal(mapped, chain(x).data) and torch.equal(mapped[0], x.data[0])


def test_an_alternation_has_the_neutral_values_of_its_estimators() -> None:
    stage = Alternate(2, level=Turn(Level(), Subtract()), other=Turn(Double()))
    assert stage.neutral == {"level": 0.0, "count": 1, "factor": 1.0}


@pytest.mark.parametrize(
    ("turns", "message"),
    [
        (
            {"a": Turn(Level(), Subtract()), "b": Turn(Subtract(), None)},
            "estimator 'b' .* return an Estimate, got Signal",
        ),
        ({"a": Turn(Level(), Level()), "b": Turn(Level())}, "corrector of 'a' .* return a Signal, got Estimate"),
        ({"a": Level(), "b": Turn(Level())}, "'a' must be a Turn"),
        ({"rounds": 1.5, "a": Turn(Level()), "b": Turn(Level())}, "whole number, got 1.5"),
    ],
)
def test_an_alternation_of_other_things_is_refused(turns: dict, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Alternate(**turns)(pulses())


def test_a_stage_is_connected_once() -> None:
    with pytest.raises(TypeError, match="connect all its parameters in one call"):
        use(use(Subtract(), level="level"), in_doubt="apply")


def test_only_two_answers_are_accepted() -> None:
    with pytest.raises(ValueError, match=r"in_doubt must be 'apply' .* or 'neutral' .*, got 'zero'"):
        use(Subtract(), in_doubt="zero", level="level")  # pyright: ignore[reportArgumentType]
