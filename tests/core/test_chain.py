"""Chains: values per trial, given values, reruns with gradients, and errors."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tests.helpers import small_radar, small_recording
from torchsar.core import Axis, Chain, Draws, Estimate, Outcome, Signal, Stage, use
from torchsar.echo import simulate
from torchsar.focus import OmegaK
from torchsar.metrics import entropy
from torchsar.repair import LineIntegrity
from torchsar.scene import AlwaysLit, Points, StripmapWorld


class LagOneDoppler(Stage):
    """Minimal estimator of the Doppler centroid."""

    provides = ("doppler_hz",)

    def forward(self, signal: Signal) -> Estimate:
        x = signal.data
        lag = (x[..., 1:, :] * x[..., :-1, :].conj()).sum((-2, -1))
        value = torch.angle(lag).double() / (2 * torch.pi * signal.axis("pulse").step)
        return Estimate(
            {"doppler_hz": value},
            quality=torch.ones_like(value),
            outcome=Outcome.of(torch.ones_like(value, dtype=torch.bool), Outcome.NOISE),
        )


class GivenVelocity(Stage):
    """Estimator that returns a constant."""

    provides = ("velocity_m_s",)

    def forward(self, signal: Signal) -> Estimate:
        value = torch.full(signal.trials, 118.0, dtype=torch.float64)
        return Estimate(
            {"velocity_m_s": value},
            quality=torch.ones_like(value),
            outcome=Outcome.of(torch.ones_like(value, dtype=torch.bool), Outcome.NOISE),
        )


def squinted_chain(radar):
    return Chain(
        doppler=LagOneDoppler(),
        velocity=GivenVelocity(),
        focus=use(OmegaK(radar), doppler_hz="doppler", velocity_m_s="velocity"),
    )


def test_estimates_differ_by_trial_and_are_refined_with_autograd():
    radar = small_radar()
    velocity = torch.tensor([112.0, 120.0, 131.0], dtype=torch.float64)
    doppler = torch.tensor([-60.0, 10.0, 90.0], dtype=torch.float64)
    recording, _ = small_recording(
        448, 64, trials=3, velocity_m_s=velocity, doppler_hz=doppler, dwell_s=0.9, snr_db=40.0, dtype=torch.complex128
    )
    chain = squinted_chain(radar)
    trace = chain.trace(recording)
    assert trace.values["doppler.doppler_hz"].shape == (3,)
    # with three points and noise the lag-one estimate is only near the Doppler centroid
    assert float((trace.values["doppler.doppler_hz"] - doppler).abs().max()) < 40

    guess = torch.tensor([114.0, 118.0, 128.0], dtype=torch.float64, requires_grad=True)
    step = torch.full((3,), 4.0, dtype=torch.float64)
    # steps by the sign of the gradient, halved per trial where the cost rises
    for _ in range(14):
        cost = entropy(chain.rerun(trace, "focus", given={"velocity.velocity_m_s": guess}))
        (slope,) = torch.autograd.grad(cost.sum(), guess)
        moved = (guess - step * slope.sign()).detach().requires_grad_()
        better = entropy(chain.rerun(trace, "focus", given={"velocity.velocity_m_s": moved})) < cost
        step = torch.where(better, step, step / 2)
        guess = torch.where(better, moved, guess).detach().requires_grad_()
    assert float((guess.detach() - velocity).abs().max()) < 0.3


def test_state_dict_and_parameters_of_a_chain():
    chain = Chain(focus=OmegaK(small_radar(), velocity_m_s=nn.Parameter(torch.tensor(120.0, dtype=torch.float64))))
    assert set(chain.state_dict()) == {"stages.focus.velocity_m_s", "stages.focus.doppler_hz"}
    assert [name for name, _ in chain.named_parameters()] == ["stages.focus.velocity_m_s"]
    assert chain.to("cpu") is chain
    other = Chain(focus=OmegaK(small_radar(), velocity_m_s=nn.Parameter(torch.tensor(1.0, dtype=torch.float64))))
    other.load_state_dict(chain.state_dict())
    assert float(other.stages["focus"].velocity_m_s.detach()) == 120.0


def test_trace_holds_times_sizes_and_every_intermediate_result():
    recording, _ = small_recording()
    trace = squinted_chain(small_radar()).trace(recording)
    assert list(trace.outputs) == ["doppler", "velocity", "focus"]
    assert trace.bytes["focus"] == 128 * 96 * 8 and trace.seconds["focus"] > 0
    assert trace.signal.names == ("azimuth", "range")
    assert trace.inputs["focus"] is recording.signal


def test_an_estimator_whose_values_are_given_does_not_run():
    recording, _ = small_recording()
    chain = squinted_chain(small_radar())
    held = chain.trace(recording, given={"doppler.doppler_hz": torch.tensor(0.0, dtype=torch.float64)})
    assert "doppler" not in held.estimates and "velocity" in held.estimates


@pytest.mark.parametrize(
    ("build", "match"),
    [
        (
            lambda r: Chain(focus=use(OmegaK(r), doppler_hz="doppler")),
            r"'focus' uses 'doppler.doppler_hz'.*nothing yet",
        ),
        (
            lambda r: Chain(doppler=LagOneDoppler(), focus=use(OmegaK(r), speed="doppler.doppler_hz")),
            r"no value 'speed'.*doppler_hz",
        ),
        (
            lambda r: Chain(doppler=LagOneDoppler(), focus=use(OmegaK(r), doppler_hz="doppler.hz")),
            r"'doppler.hz'.*doppler.doppler_hz",
        ),
        (lambda r: Chain(), "at least one stage"),
    ],
)
def test_wrong_connections_raise_at_construction(build, match):
    with pytest.raises(ValueError, match=match):
        build(small_radar())


def test_errors_name_the_stage_and_its_input():
    recording, _ = small_recording()
    image = OmegaK(small_radar())(recording.signal)
    with pytest.raises(ValueError, match=r"OmegaK works on the axes \('pulse', 'range'\), got \('azimuth', 'range'\)"):
        Chain(a=OmegaK(small_radar()), b=OmegaK(small_radar()))(recording)
    with pytest.raises(TypeError, match="OmegaK works on a Signal"):
        OmegaK(small_radar())(image.data)
    with pytest.raises(KeyError, match="aux.pilot"):
        Chain(a=use(OmegaK(small_radar()), doppler_hz="aux.pilot"))(recording)


def test_gradients_flow_from_entropy_to_velocity_and_positions():
    """Scene, chain and metric in one differentiable batch, against finite differences."""
    radar = small_radar()
    chain = Chain(focus=OmegaK(radar, "flat"))

    def cost(azimuth, range_, velocity):
        class Movable(Points):
            def scatterers(self, draws):
                from torchsar.scene import Scatterers

                return Scatterers(azimuth, range_, torch.ones(2, 2, dtype=torch.complex128))

        world = StripmapWorld(Movable([], []), AlwaysLit())
        recording, _ = simulate(radar, world, 24, 40, Draws(0), dtype=torch.complex128)
        return entropy(chain(recording.signal, given={})) + entropy(
            OmegaK(radar, "flat")(recording.signal, velocity_m_s=velocity)
        )

    azimuth = torch.tensor([[0.4, -1.3], [0.1, 0.9]], dtype=torch.float64, requires_grad=True)
    range_ = torch.tensor([[1.0, -7.0], [3.0, 9.5]], dtype=torch.float64, requires_grad=True)
    velocity = torch.tensor([118.0, 123.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(cost, (azimuth, range_, velocity), eps=1e-5, atol=1e-6, rtol=1e-4)


def test_axis_rejects_a_step_of_zero():
    with pytest.raises(ValueError, match="positive step"):
        Axis("range", 3, 0.0, 0.0, "m")


class WithoutForward(nn.Module):
    """A module whose `forward` is a value."""

    @property
    def forward(self):
        raise KeyError("forward")


@pytest.mark.parametrize(
    ("stages", "error", "match"),
    [
        ({"a": OmegaK}, TypeError, "'a' must be a torch.nn.Module.* got the class OmegaK, not an instance"),
        ({"a": 3}, TypeError, "'a' must be a torch.nn.Module.* got int"),
        ({"a": WithoutForward()}, TypeError, "'a' must be a torch.nn.Module with a method `forward`.* got Without"),
        ({"forward": GivenVelocity()}, ValueError, "cannot be called 'forward'"),
        (
            {"lines": LineIntegrity()},
            ValueError,
            r"'lines' \(LineIntegrity\) needs the value 'line_number'.*a value of an earlier stage.*aux.NAME",
        ),
    ],
)
def test_members_that_are_not_stages_raise_at_construction(stages, error, match):
    with pytest.raises(error, match=match):
        Chain(**stages)


def test_use_rejects_a_constant():
    with pytest.raises(TypeError, match="doppler_hz=3.0: `use` connects values by name"):
        use(OmegaK(small_radar()), doppler_hz=3.0)


def test_a_given_value_with_an_unknown_name_raises() -> None:
    chain, (recording, _) = squinted_chain(small_radar()), small_recording()
    for run in (chain, chain.trace):
        with pytest.raises(KeyError, match="doppler.doppler_h'.*the chain has the values"):
            run(recording, given={"doppler.doppler_h": torch.tensor(0.0, dtype=torch.float64)})


def test_a_rerun_that_ends_before_it_starts_is_refused():
    chain = squinted_chain(small_radar())
    trace = chain.trace(small_recording(64, 32)[0])
    with pytest.raises(ValueError, match="'doppler' does not follow 'focus'"):
        chain.rerun(trace, "focus", stop="doppler")
