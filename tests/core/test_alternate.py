"""Alternation of estimators: what each receives, what is returned, and invalid arguments."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from torchsar.core import Alternate, Axis, Chain, Estimate, Outcome, Signal, Stage, Turn, use

F64 = torch.float64


class Mean(Stage):
    """Estimator of a constant that is added to all samples; records its arguments."""

    provides = ("mean",)

    def __init__(self, ok: bool = True, quality: float = 0.5) -> None:
        super().__init__()
        self.ok, self.quality, self.received = ok, quality, []

    def forward(self, signal: Signal, mean: Tensor | None = None, slope: Tensor | None = None) -> Estimate:
        self.received.append((signal.data.clone(), mean, slope))
        found = signal.data.real.mean((-2, -1)).to(F64)
        return Estimate(
            {"mean": found},
            {"mean": 0 * found + 0.1},
            torch.full_like(found, self.quality),
            Outcome.of(torch.full(found.shape, self.ok), Outcome.NOISE),
            info={"steps": 0 * found + 3},
        )


class Slope(Stage):
    """Estimator of a slope over pulses, which a constant in the data biases."""

    provides = ("slope",)

    def forward(self, signal: Signal) -> Estimate:
        pulse = torch.arange(signal.data.shape[-2], dtype=F64)
        found = (signal.data.real.mean(-1) * pulse).sum(-1) / pulse.square().sum()
        return Estimate(
            {"slope": found},
            quality=torch.full_like(found, 0.9),
            outcome=Outcome.of(torch.ones(found.shape, dtype=torch.bool), Outcome.NOISE),
        )


class WithoutMean(Stage):
    """Corrector that subtracts the constant."""

    def forward(self, signal: Signal, mean: Tensor) -> Signal:
        return signal.with_data(signal.data - mean[..., None, None])


class WithoutSlope(Stage):
    """Corrector that subtracts the slope."""

    def forward(self, signal: Signal, slope: Tensor) -> Signal:
        return signal.with_data(
            signal.data - slope[..., None, None] * torch.arange(signal.data.shape[-2], dtype=F64)[:, None]
        )


class Dependent(Stage):
    """Estimator that needs the value of another one."""

    provides = ("copy",)

    def forward(self, signal: Signal, slope: Tensor) -> Estimate:
        return Estimate({"copy": slope}, quality=slope, outcome=Outcome.of(slope > 0, Outcome.NOISE))


def lines(mean: Tensor, slope: Tensor) -> Signal:
    """Signal with the sample mean + slope m in pulse m."""
    pulse = torch.arange(6, dtype=F64)
    data = (mean[..., None] + slope[..., None] * pulse)[..., None].expand(*mean.shape, 6, 4)
    return Signal(
        data.to(torch.complex128).contiguous(), (Axis("pulse", 6, 0.0, 1.0, "s"), Axis("range", 4, 0.0, 1.0, "m"))
    )


MEAN, SLOPE = torch.tensor([1.0, -2.0, 5.0], dtype=F64), torch.tensor([0.5, 0.0, -3.0], dtype=F64)


def both(rounds: int, mean: Mean | None = None) -> Alternate:
    """Alternation between `Mean` and `Slope`."""
    return Alternate(rounds, mean=Turn(mean or Mean(), WithoutMean()), slope=Turn(Slope(), WithoutSlope()))


def test_alternation_converges_to_the_joint_least_squares_solution() -> None:
    """The alternation is a block relaxation of least squares, which converges to both values."""
    signal = lines(MEAN, SLOPE)
    one, many = both(1)(signal), both(60)(signal)
    assert (one["mean"] - MEAN).abs().max() > 1
    torch.testing.assert_close(many["mean"], MEAN, atol=1e-6, rtol=0)
    torch.testing.assert_close(many["slope"], SLOPE, atol=1e-6, rtol=0)


def test_estimators_receive_the_original_signal_with_the_latest_corrections() -> None:
    mean, signal = Mean(), lines(MEAN, SLOPE)
    found = both(3, mean)(signal)
    assert len(mean.received) == 3
    first, second, third = mean.received
    assert torch.equal(first[0], signal.data) and first[1] is None and first[2] is None
    torch.testing.assert_close(second[0], WithoutSlope()(signal, second[2]).data, rtol=0, atol=0)
    assert second[1] is not None and third[1] is not None and not torch.equal(second[1], third[1])
    assert not torch.equal(third[2], found["slope"]), "the last turn of the last round comes after"
    assert torch.equal(signal.data, lines(MEAN, SLOPE).data)


def test_a_turn_without_a_corrector_does_not_change_the_signal() -> None:
    mean, signal = Mean(), lines(MEAN, SLOPE)
    Alternate(2, mean=Turn(mean, WithoutMean()), slope=Turn(Slope()))(signal)
    assert all(torch.equal(data, signal.data) for data, _, _ in mean.received) and mean.received[1][2] is not None


def test_the_result_has_all_values_and_the_lowest_quality() -> None:
    stage = both(2, Mean(ok=False, quality=0.2))
    assert stage.provides == ("mean", "slope")
    found = stage(lines(MEAN, SLOPE))
    assert set(found.value) == {"mean", "slope"} and set(found.std) == {"mean"} and set(found.info) == {"mean.steps"}
    assert found.outcome.tolist() == [Outcome.NOISE] * 3 and found.quality.tolist() == [0.2] * 3


def test_an_estimate_from_a_doubtful_value_is_doubtful() -> None:
    class Late(Slope):
        """Estimator that is doubtful before a given run."""

        def __init__(self, first: int) -> None:
            super().__init__()
            self.first, self.runs = first, 0

        def forward(self, signal: Signal) -> Estimate:
            self.runs += 1
            of = Outcome.OK if self.runs >= self.first else Outcome.MISFIT
            return replace(super().forward(signal), outcome=of.like(signal.data[..., 0, 0]))

    for rounds, first, ok in ((3, 1, True), (3, 2, True), (3, 3, False), (3, 4, False), (1, 1, True)):
        late = Turn(Late(first), WithoutSlope())
        found = Alternate(rounds, mean=Turn(Mean(), WithoutMean()), slope=late)(lines(MEAN, SLOPE))
        assert found.outcome.tolist() == [Outcome.OK if ok else Outcome.MISFIT] * 3


def test_a_batch_equals_its_singles() -> None:
    together = both(4)(lines(MEAN, SLOPE))
    for i in range(3):
        alone = both(4)(lines(MEAN[i], SLOPE[i]))
        for name in alone.value:
            assert torch.equal(together[name][i], alone[name])


def test_in_a_chain() -> None:
    chain = Chain(fit=both(60), out=use(WithoutMean(), mean="fit"))
    trace = chain.trace(lines(MEAN, SLOPE))
    torch.testing.assert_close(trace.signal.data, lines(0 * MEAN, SLOPE).data, atol=1e-5, rtol=0)


def test_estimators_are_submodules() -> None:
    stage = Alternate(1, linear=Turn(Holding(2.0)), mean=Turn(Mean(), WithoutMean()))
    assert list(stage.state_dict()) == ["estimators.linear.gain"]
    assert isinstance(stage.to("cpu"), nn.Module)


class Holding(Mean):
    """Estimator with a buffer."""

    def __init__(self, gain: float) -> None:
        super().__init__()
        self.hold("gain", gain)


def test_invalid_alternations_raise() -> None:
    with pytest.raises(ValueError, match=r"at least two estimators and one round, got \['mean'\] and rounds=3"):
        Alternate(mean=Turn(Mean()))
    with pytest.raises(ValueError, match="rounds=0"):
        both(0)
    with pytest.raises(
        ValueError,
        match=r"the estimator 'dependent' needs the values \['slope'\] in the first round, "
        "but the estimators before it provide nothing",
    ):
        Alternate(dependent=Turn(Dependent()), slope=Turn(Slope()))
    with pytest.raises(
        ValueError,
        match=r"the corrector of the estimator 'slope' needs the values \['mean'\], "
        "which this estimator does not provide",
    ):
        Alternate(slope=Turn(Slope(), WithoutMean()), mean=Turn(Mean()))
    assert Alternate(slope=Turn(Slope()), dependent=Turn(Dependent())).provides == ("slope", "copy")
