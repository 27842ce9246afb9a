"""Chains that begin with the world and end with metrics."""

from __future__ import annotations

import inspect

import pytest
import torch

from tests.helpers import small_radar, small_recording
from torchsar import echo, metrics, radar, scene
from torchsar.core import Chain, Draws, Signal, Stage, use


class Scale(Stage):
    """Everything times two."""

    def forward(self, signal: Signal) -> Signal:
        return signal.with_data(2 * signal.data)


def ending(**stages: torch.nn.Module) -> Chain:
    """A chain that begins with a simulated echo of a turntable."""
    isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    world = scene.TurntableWorld(scene.Points([0.0, 4.0], [0.0, 1.0]), snr_db=20.0)
    return Chain(echo=echo.Simulate(isar, world, 16, 16), **stages)


def test_a_chain_simulates_impairs_and_measures_as_the_functions_do() -> None:
    draws = Draws(3, trials=range(2))
    chain = ending(
        shaken=echo.Impair(echo.WhitePhase()),
        lost=echo.Impair(echo.LostPulses(count=2)),
        contrast=metrics.Measure(metrics.contrast),
    )
    trace = chain.trace(draws=draws)
    first: echo.Simulate = chain.stages["echo"]  # pyright: ignore[reportAssignmentType]
    errors = {"shaken": echo.WhitePhase(), "lost": echo.LostPulses(count=2)}
    recording, truth = echo.simulate_turntable(first.radar, first.world, 16, 16, draws, errors)
    assert torch.equal(trace.signal.data, recording.signal.data)
    assert torch.equal(trace.values["aux.line_number"], recording.aux["line_number"])
    assert trace.truth is not None
    assert trace.truth.values.keys() == truth.values.keys()
    assert all(torch.equal(value, trace.truth.values[name]) for name, value in truth.values.items())
    assert torch.equal(trace.truth.clean.signal.data, truth.clean.signal.data)
    assert torch.equal(trace.metrics["contrast"], metrics.contrast(recording.signal))
    assert torch.equal(chain(draws=draws).data, recording.signal.data)
    assert "contrast" in str(trace)


def test_a_trace_with_an_end_can_be_rerun_after_its_beginning() -> None:
    chain = ending(gain=Scale(), contrast=metrics.Measure(metrics.contrast))
    trace = chain.trace(draws=Draws(1))
    again = chain.retrace(trace, "contrast")
    assert torch.equal(again.metrics["contrast"], trace.metrics["contrast"])
    assert again.truth is not None
    with pytest.raises(ValueError, match="'echo' makes the recording"):
        chain.rerun(trace, "echo")


def test_a_user_stage_may_measure_several_numbers() -> None:
    class Peak(torch.nn.Module):
        def forward(self, signal: Signal) -> dict[str, torch.Tensor]:
            return {"level": signal.data.abs().amax((-2, -1)), "place": signal.data.abs().flatten(-2).argmax(-1)}

    found = ending(peak=Peak()).trace(draws=Draws(1, trials=range(3))).metrics
    assert {name: value.shape for name, value in found.items()} == {"peak.level": (3,), "peak.place": (3,)}


def test_misuse_of_the_ends_is_explained() -> None:
    chain, recording = ending(), small_recording()[0]
    with pytest.raises(ValueError, match="'echo' needs random draws.*draws=Draws"):
        chain()
    with pytest.raises(TypeError, match="without a recording"):
        chain(recording, draws=Draws(1))
    with pytest.raises(TypeError, match=r"begins with a simulation \(echo.Simulate\)"):
        Chain(gain=Scale())(draws=Draws(1))
    with pytest.raises(TypeError, match="begin with echo.Simulate"):
        Chain(lost=echo.Impair(echo.LostPulses(count=1)))(draws=Draws(1))
    with pytest.raises(TypeError, match="StripmapWorld.*got Points.*by="):
        echo.Simulate(small_radar(), scene.Points([0.0], [0.0]), 8)
    with pytest.raises(ValueError, match="no value 'snr' to connect.*snr_db"):
        Chain(echo=use(echo.Simulate(small_radar(), scene.StripmapWorld(scene.Points([0.0], [0.0])), 8), snr="given.x"))


def test_a_stage_of_a_function_holds_connects_and_saves_its_parameters() -> None:
    def scale(data: torch.Tensor, factor: torch.Tensor, power: torch.Tensor | float = 1.0) -> torch.Tensor:
        """Scale samples."""
        return data * factor[..., None, None] ** power

    made = Stage.of(scale)
    assert (made.__name__, made.__doc__) == ("Scale", "Stage of `scale`.\n\nScale samples.")
    assert str(inspect.signature(made)) == "(power: 'torch.Tensor | float' = 1.0)"
    assert inspect.signature(made.forward).return_annotation is Signal
    signal, three = small_recording()[0].signal, torch.tensor(3.0)
    held = made(torch.nn.Parameter(torch.tensor(2.0)))
    assert [name for name, _ in held.named_parameters()] == ["power"]
    torch.testing.assert_close(held(signal, factor=three).data, 9 * signal.data)
    assert list(made(torch.tensor(2.0)).state_dict()) == ["power"]
    chain = Chain(louder=use(made(), factor="given.factor", power="given.power"))
    given = {"given.factor": three, "given.power": torch.tensor(2.0)}
    torch.testing.assert_close(chain(signal, given).data, 9 * signal.data)
    with pytest.raises(ValueError, match="needs the value 'factor'"):
        Chain(louder=made(power=2.0))
    with pytest.raises(TypeError, match="unexpected keyword argument 'gain'"):
        made(gain=2.0)
    with pytest.raises(ValueError, match=r"works on the axes \('azimuth',\)"):
        Stage.of(scale, works_on=("azimuth",))()(signal, factor=three)


def test_a_measure_without_its_image_says_how_it_is_called() -> None:
    with pytest.raises(ValueError, match=r"'im'; connect it .*the signal itself is a first parameter called image or "):
        Chain(peak=metrics.Measure(lambda im: im.data.abs().amax()))
