"""Errors of estimates carried to pixels and metrics, against derivatives and repeated noise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsar import compensate, echo, focus, metrics, multichannel, radar, scene
from torchsar.core import Axis, Chain, Draws, Estimate, Outcome, Signal, Stage, Trace, use

PULSES, CELLS = 16, 8


def chain(**more: torch.nn.Module) -> Chain:
    """Phases of pulses and their correction, a transform, and the entropy."""
    return Chain(
        phase=compensate.Sca(),
        correct=use(compensate.CorrectPulsePhase(), phase_rad="phase"),
        image=focus.AzimuthTransform(radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)),
        entropy=metrics.Measure(metrics.entropy),
        **more,
    )


def traced(estimate: Estimate, trials: tuple[int, ...] = (2,), **more: torch.nn.Module) -> tuple[Chain, Trace]:
    """The chain and its trace with these phases, on random samples."""
    axes = Axis("pulse", PULSES, -0.8, 0.1, "s"), Axis("range", CELLS, 0.0, 0.15, "m")
    data = Draws(1).normal("data", (*trials, PULSES, CELLS), torch.complex128)
    made = chain(**more)
    return made, made.trace(Signal(data, axes), given={"phase": estimate})


def phases(std: float = 1e-4, factor: Tensor | None = None) -> Estimate:
    """Phases of two trials whose errors have other sizes at each pulse."""
    value = Draws(2).normal("phase", (2, PULSES))
    sizes = std * (1 + torch.arange(PULSES, dtype=torch.float64) / PULSES).expand(2, PULSES)
    return Estimate(
        {"phase_rad": value},
        {"phase_rad": sizes},
        torch.ones(2),
        factor={} if factor is None else {"phase_rad": factor},
    )


def by_derivatives(made: Chain, trace: Trace, errors: Tensor) -> tuple[Tensor, Tensor]:
    """Deviations of pixels and entropy by forward derivatives along (error, trial, pulse)."""

    def run(phase: Tensor) -> tuple[Tensor, Tensor]:
        again = made.retrace(trace, "correct", {"phase.phase_rad": phase})
        return again.signal.data.abs(), again.metrics["entropy"]

    slopes = [torch.func.jvp(run, (trace.estimates["phase"]["phase_rad"],), (error,))[1] for error in errors]
    return tuple(torch.stack(each).square().sum(0).sqrt() for each in zip(*slopes, strict=True))  # pyright: ignore


def test_correlated_errors_agree_with_forward_derivatives() -> None:
    factor = 1e-4 * Draws(3).normal("factor", (2, PULSES, 3))
    std = {"phase_rad": factor.square().sum(-1).sqrt()}
    found = Estimate(dict(phases().value), std, torch.ones(2), factor={"phase_rad": factor})
    made, trace = traced(found)
    spread, (pixels, entropy) = made.spread(trace), by_derivatives(made, trace, factor.movedim(-1, 0))
    assert torch.allclose(spread.pixels, pixels, rtol=1e-3)
    assert torch.allclose(spread.metrics["entropy"], entropy, rtol=1e-3)


@pytest.mark.parametrize(("pairs", "share"), [(PULSES, 1e-3), (PULSES // 2, 0.35)])
def test_independent_errors_agree_with_forward_derivatives(pairs: int, share: float) -> None:
    """With a pair for each error they agree, with half as many as random signs allow."""
    made, trace = traced(phases())
    errors = torch.diag_embed(trace.estimates["phase"].std["phase_rad"]).movedim(-1, 0)
    spread, (pixels, entropy) = made.spread(trace, pairs=pairs), by_derivatives(made, trace, errors)
    assert float((spread.pixels / pixels - 1).square().mean().sqrt()) < share
    assert torch.allclose(spread.metrics["entropy"], entropy, rtol=2 * share)


def test_a_trial_alone_has_the_spread_that_it_has_in_a_batch() -> None:
    made, trace = traced(phases(0.1))
    one = phases(0.1)
    alone = Estimate({k: x[1] for k, x in one.value.items()}, {k: x[1] for k, x in one.std.items()}, torch.ones(()))
    single = made.trace(trace.inputs["phase"][1], given={"phase": alone})
    assert torch.allclose(made.spread(trace).pixels[1], made.spread(single).pixels)


def test_an_unknown_error_is_infinite_and_a_failed_estimate_has_none() -> None:
    std = {"phase_rad": torch.full((2, PULSES), math.inf, dtype=torch.float64)}
    outcome = torch.tensor([Outcome.OK, Outcome.NOISE])
    made, trace = traced(Estimate(dict(phases().value), std, torch.ones(2), outcome))
    spread = made.spread(trace)
    assert bool(spread.pixels[0].isinf().all()) and bool((spread.pixels[1] == 0).all())
    assert spread.metrics["entropy"].tolist() == [math.inf, 0.0]


class Scale(Stage):
    """Multiplies by a positive gain, and refuses others as stages do with a velocity."""

    works_on = ("azimuth", "range")

    def forward(self, signal: Signal, gain: Tensor) -> Signal:
        if not bool((gain > 0).all()):
            raise ValueError("gain must be positive in every trial")
        return signal.with_data(signal.data * gain[:, None, None])


@pytest.mark.parametrize("code", [Outcome.INEXACT, Outcome.MISFIT, Outcome.NOISE])
def test_a_trial_with_a_doubtful_estimate_is_infinite_and_leaves_the_others_unchanged(code: Outcome) -> None:
    data = Draws(1).normal("data", (3, PULSES, CELLS), torch.complex128)
    signal = Signal(data, (Axis("azimuth", PULSES, 0.0, 0.1, "m"), Axis("range", CELLS, 0.0, 0.15, "m")))

    def estimate(std: float, outcome: Outcome) -> Estimate:
        codes = torch.tensor([Outcome.OK, outcome, Outcome.OK])
        return Estimate({"gain": torch.full((3,), 2.0)}, {"gain": torch.tensor([0.1, std, 0.2])}, outcome=codes)

    def spread(estimate: Estimate, in_doubt: str = "apply") -> tuple[Tensor, Tensor]:
        made = Chain(
            found=Given(estimate),
            scaled=use(Scale(), gain="found.gain", in_doubt=in_doubt),
            sum=metrics.Measure(lambda signal: signal.data.abs().sum((-2, -1))),
        )
        found = made.spread(made.trace(signal))
        return found.pixels, found.metrics["sum"]

    plain, bad = spread(estimate(0.1, Outcome.OK)), spread(estimate(1e6, code))
    held = replace(estimate(1e6, code), neutral={"gain": 1.0})
    neutral = spread(held, "neutral")
    for good, one, kept in zip(plain, bad, neutral, strict=True):
        assert torch.equal(one[::2], good[::2]) and torch.equal(kept[::2], good[::2])
        # without a neutral value that of a failed estimate is used too
        assert bool(one[1].isinf().all()) and bool((kept[1] == 0).all())
    used = bool(spread(held)[0][1].isinf().all())
    assert used == code.is_doubtful


class Given(Stage):
    """Returns the same estimate for each signal."""

    works_on, provides = ("azimuth", "range"), ("gain",)

    def __init__(self, estimate: Estimate) -> None:
        super().__init__()
        self.estimate = estimate

    def forward(self, signal: Signal) -> Estimate:
        return self.estimate


class Aligned(Stage):
    """Estimates a gain and applies it at once."""

    works_on, provides = ("azimuth", "range"), ("gain",)

    def forward(self, signal: Signal) -> tuple[Signal, Estimate]:
        gain = torch.ones(signal.trials, dtype=torch.float64)
        return signal.with_data(2 * signal.data), Estimate({"gain": gain}, {"gain": 0.1 * gain})


def test_what_cannot_be_carried_is_one_sentence() -> None:
    made, trace = traced(phases(), align=Aligned())
    with pytest.raises(ValueError, match="stage 'align' both estimates and corrects"):
        made.spread(trace)
    alone, plain = traced(phases())
    again = made.spread(trace, of=["phase"])
    assert torch.allclose(again.pixels, 2 * alone.spread(plain).pixels)
    with pytest.raises(ValueError, match=r"names the estimates \['nothing'\], the trace has \['align', 'phase'\]"):
        made.spread(trace, of=["nothing"])
    for pairs in (0, -1, 2.5):
        with pytest.raises(ValueError, match=f"`pairs` must be a whole number of at least 1, got {pairs}"):
            made.spread(trace, of=["phase"], pairs=pairs)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"got the text 'phase'; write \['phase'\]"):
        made.spread(trace, of="phase")
    bare, without = traced(Estimate(dict(phases().value), quality=torch.ones(2)))
    with pytest.raises(ValueError, match=r"they use \['phase.phase_rad'\], and the estimates have .*'phase': \[\]"):
        bare.spread(without)
    with pytest.raises(ValueError, match=r"factor 'phase_rad' of an Estimate has the shape \(2, 3\)"):
        phases(factor=torch.ones(2, 3))


def share_within(trace: Trace, true: Trace, made: Chain, name: str = "") -> float:
    """Share of reliable trials (and pixels) whose change by the errors is within one deviation."""
    spread = made.spread(trace)
    found, wanted, std = (
        (trace.metrics[name], true.metrics[name], spread.metrics[name])
        if name
        else (trace.signal.data.abs(), true.signal.data.abs(), spread.pixels)
    )
    return float(((found - wanted).abs() <= std)[std.isfinite()].double().mean())


def levels(trials: int, snr_db: float) -> dict[str, Tensor]:
    return {"given.snr_db": torch.full((trials,), snr_db, dtype=torch.float64)}


@pytest.mark.slow
def test_one_sigma_covers_the_images_of_a_ladar_with_estimated_radial_motion() -> None:
    """The errors of velocities are independent from period to period."""
    sal = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 4e6, 60.0, 3000.0)
    points, vibration = scene.Points([0.0], [0.1]), [scene.Polynomial([0.1, 10.0])]

    def world(snr_db: Tensor) -> scene.LadarWorld:
        return scene.LadarWorld(points, vibration, snr_db=snr_db)

    def place_m(image: Signal) -> Tensor:
        power = image.data.abs() ** 4
        cells = image.axes[1].start + image.axes[1].step * torch.arange(image.axes[1].n)
        return (power * cells).sum((-2, -1)) / power.sum((-2, -1))

    made = Chain(
        echo=use(echo.Simulate(sal, world, 32, dtype=torch.complex128), snr_db="given.snr_db"),
        velocity=compensate.MirrorProduct(sal),
        still=use(compensate.CompensateMotion(sal), velocity_m_s="velocity"),
        profiles=focus.CompressSweeps(sal),
        deramp=focus.DerampAzimuth(sal),
        image=focus.AzimuthMatchedFilter(sal, beam_rad=1e-4),
        place_m=metrics.Measure(place_m),
    )
    trace = made.trace(draws=Draws(1, trials=range(200)), given=levels(200, 15.0))
    assert trace.truth is not None
    velocity = trace.truth.values["velocity_m_s"].expand(200, -1)
    true = made.retrace(trace, "still", {"velocity.velocity_m_s": velocity})
    error = trace.estimates["velocity"]["velocity_m_s"] - velocity
    assert abs(float((error[:, 1:] * error[:, :-1]).mean() / error.square().mean())) < 0.1
    for name in ("", "place_m"):
        assert 0.6 < share_within(trace, true, made, name) < 0.75, name


@pytest.mark.slow
def test_one_sigma_covers_the_images_of_a_turntable_after_autofocus() -> None:
    """The errors of phases are independent from pulse to pulse."""
    ladar = radar.InverseRadar(193.4e12, 150e9, 2000.0, rotation_rad_s=0.005)
    places = Draws(1).uniform("places", (2, 24), -0.5, 0.5)

    def world(snr_db: Tensor) -> scene.TurntableWorld:
        return scene.TurntableWorld(scene.Points(list(0.08 * places[0]), list(0.03 * places[1])), snr_db=snr_db)

    made = Chain(
        echo=use(echo.Simulate(ladar, world, 64, 48, dtype=torch.complex128), snr_db="given.snr_db"),
        start=echo.Impair(echo.WhitePhase(0.5)),
        phase=compensate.Autofocus(),
        correct=use(compensate.CorrectPulsePhase(), phase_rad="phase"),
        image=focus.AzimuthTransform(ladar),
        background_db=metrics.Measure(lambda image: 10 * image.data[:, :8].abs().square().mean((-2, -1)).log10()),
    )
    trace = made.trace(draws=Draws(1, trials=range(200)), given=levels(200, 0.0))
    assert trace.truth is not None
    true_rad, found = trace.truth.values["phase_rad"] + trace.values["truth.start.phase_rad"], trace.estimates["phase"]
    error = metrics.residual_phase(found["phase_rad"], true_rad)
    true = made.retrace(trace, "correct", {"phase.phase_rad": found["phase_rad"] - error})
    assert abs(float((error[:, 1:] * error[:, :-1]).mean() / error.square().mean())) < 0.1
    for name in ("", "background_db"):
        assert 0.6 < share_within(trace, true, made, name) < 0.75, name


@pytest.mark.slow
def test_one_sigma_covers_the_profiles_and_places_of_a_moving_point() -> None:
    """The errors of the speed and of the position are those of one line of the Doppler history."""
    pair = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    motion = dict.fromkeys(("u_r_m_s", "u_a_m_s", "y0_m"), "velocity")

    def world(snr_db: Tensor) -> scene.BistaticWorld:
        return scene.BistaticWorld(
            scene.MovingPoints([4.0], [2.0], [0.0], [0.0]), scene.BandLimited(1.0), snr_db=snr_db
        )

    def place(image: Signal, u_r_m_s: Tensor) -> dict[str, Tensor]:
        found = metrics.azimuth_response(image.data, image.axes[0].step, image.axes[0].start)
        return {"apparent": found["position_m"], "true": found["position_m"] - 5000.0 / 300.0 * u_r_m_s}

    made = Chain(
        echo=use(echo.Simulate(pair, world, 200, dtype=torch.complex128), snr_db="given.snr_db"),
        velocity=use(multichannel.LikelihoodVelocity(pair, multichannel.Dwell(1.0)), u_r_m_s="given.u_r_m_s"),
        bands=use(multichannel.Reconstruct(pair), **motion),
        image=use(multichannel.FocusAzimuth(pair, bandwidth_hz=300.0), **motion),
        place=use(metrics.Measure(place), u_r_m_s="velocity"),
    )
    start = {"given.u_r_m_s": torch.full((400,), 4.01, dtype=torch.float64)}
    trace = made.trace(draws=Draws(1, trials=range(400)), given=levels(400, 25.0) | start)
    assert trace.truth is not None
    values = {f"velocity.{name}": trace.truth.values[name].expand(400, 1)[:, 0] for name in motion}
    true = made.retrace(trace, "bands", values)
    errors = torch.stack([trace.values[name] - value for name, value in values.items()])
    assert abs(float(torch.corrcoef(errors)[0, 2])) > 0.99
    for name in ("", "place.apparent", "place.true"):
        assert 0.6 < share_within(trace, true, made, name) < 0.75, name
