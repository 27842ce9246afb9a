"""Limits of ladar methods, what simplified echo models neglect, and how they compare."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_args

import torch
from torch import Tensor

from torchsar.compensate.radial import mirror_product, radial_motion, segmented_interference, spectrum_correlation
from torchsar.compensate.radial.mirror import Intercept
from torchsar.core import Draws, Estimate
from torchsar.focus.ladar_requirements import Limit, ladar_limits, ladar_requirements
from torchsar.focus.requirements import Requirement
from torchsar.metrics import error_db
from torchsar.metrics.radial_motion import leading, lit_periods
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    EverySample,
    Extremes,
    LinearInSweep,
    OnePerPeriod,
    OnePerSweep,
    Points,
    QuadraticInSweep,
    drawn_motion,
)
from torchsar.scene.ladar import Effect
from torchsar.scene.vibration import displacement_m
from torchsar.study.systems.sal.world import Ground
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.system import Noise

# derivatives of the motion are differences on so many times a period, on as many times as fit here
_TIMES_A_PERIOD, _MOST_TIMES = 16, 1 << 22
# limits that stop only methods with such a stage, whose key has that value
_CONCERNS = {
    "SNR after compression": ("segmented_interference", "unwrap", "gradient"),
    "spacing of scatterers": ("segmented_interference", "bins", "peak"),
    "speed of the mirror tone": ("", "", ""),  # estimators take the bulk of the velocity out first
}
# echo models, the cheapest first, with the rms of the phase that the level itself neglects over its
# largest value: a straight line against the middle, a parabola, a cubic that is zero at the ends
_LEVELS: Mapping[str, tuple[Any, float]] = {
    "one_per_period": (OnePerPeriod, 1 / math.sqrt(3)),
    "one_per_sweep": (OnePerSweep, 1 / math.sqrt(3)),
    "linear_in_sweep": (LinearInSweep, 1 / math.sqrt(5)),
    "quadratic_in_sweep": (QuadraticInSweep, math.sqrt(27 / 70)),
    "every_sample": (EverySample, 0.0),
}
# over a recording an omitted effect goes about evenly from one of its extremes to the other
_EVEN = 1 / math.sqrt(12)
_WITHOUT: tuple[tuple[Effect, ...], ...] = (("flight", "residual_video"), ("flight", "hyperbola"), ("flight",), ())


@dataclass(frozen=True)
class Moved:
    """What a scene and its motion reach: of scatterers that lead estimators, and of the motion.

    Args:
        azimuth_m, range_m: Positions of leading scatterers, (target,).
        reach_m: Least and largest relative range of all.
        peak: Largest amplitude.
        span_m: Extent of the displacement.
        extremes: Bounds for predictions.
    """

    azimuth_m: Tensor
    range_m: Tensor
    reach_m: tuple[float, float]
    peak: float
    span_m: float
    extremes: Extremes


def moved(bench: Bench) -> Moved:
    """From the first trial of a run.

    Raises:
        ValueError: If no scatterer can be seen, or one lies where no sweep can show it.
    """
    world, radar, draws = bench.world(), bench.radar, Draws(bench.config.seed, "run", [0])
    scene = world.of().scene.scatterers(draws)
    azimuth, ranges, level = (
        v.reshape(-1, v.shape[-1])[0] for v in (scene.azimuth_m, scene.range_m, scene.amplitude.abs())
    )
    low, high = world.gate_m or (-math.inf, math.inf)
    inside = (level > 0) & (ranges >= low) & (ranges <= high)
    leads = leading(torch.where(inside, level, 0))
    if not bool(leads.any()):
        raise ValueError(
            "world: no scatterer of the scene has an amplitude above 0 within the gate; give it one, or widen gate_m"
        )
    reach = float(ranges[inside].min()), float(ranges[inside].max())
    _refuse_positions(radar, *reach)
    n = min(max(8, world.periods * radar.keep_every * _TIMES_A_PERIOD), _MOST_TIMES)
    span_s = world.periods * radar.pulse_step_s
    time_s = torch.arange(n, dtype=torch.float64) * (span_s / n)
    course = [displacement_m(drawn_motion(world.motion, draws, span_s), time_s).reshape(-1, n)[0]]
    for order in range(3):
        slope = torch.gradient(course[-1], spacing=span_s / n)[0]
        course.append(slope[2:-2] if order else slope)  # differences of differences are odd at the ends
    across = radar.speed_m_s * world.periods * radar.pulse_step_s / 2 + float(azimuth.abs().max())
    largest = [float(x.abs().max()) for x in course[1:]]
    change = float(course[1].max() - course[1].min())
    extremes = Extremes(reach, across, largest[0], change, largest[1], largest[2])
    span_m = float(course[0].max() - course[0].min())
    return Moved(azimuth[leads], ranges[leads], reach, float(level[leads].max()), span_m, extremes)


def _refuse_positions(radar: TriangularLadar, near_m: float, far_m: float) -> None:
    """Raise ValueError for scatterers that no sweep can show, even at rest."""
    if near_m <= -radar.reference_range_m:
        raise ValueError(
            f"world: a scatterer at the relative range {near_m:g} m lies behind the ladar, whose reference range is "
            f"{radar.reference_range_m:g} m; ranges of scatterers are relative to it"
        )
    reach = radar.sample_rate_hz / 2 / radar.beat_hz(1.0)
    if max(-near_m, far_m) >= reach:
        raise ValueError(
            f"world: scatterers lie from {near_m:g} to {far_m:g} m, and beats of relative ranges beyond {reach:.4g} m "
            "alias; bring the reference range nearer, or sample faster"
        )


def limits(bench: Bench, seen: Moved) -> dict[Limit, list[str]]:
    """Limits, each with the methods that it stops."""
    world, radar, e = bench.world(), bench.radar, seen.extremes
    apart = torch.diff(torch.unique(seen.range_m))
    snr_db = world.noise.snr_db
    snr_db = None if snr_db is None else float(snr_db) + 20 * math.log10(seen.peak)
    lit = lit_periods(radar, radar.sweep_axes(world.periods)[1], seen.azimuth_m, seen.range_m)
    rows = ladar_limits(
        radar,
        world.periods,
        seen.reach_m,
        e.velocity_m_s,
        e.acceleration_m_s2,
        e.jerk_m_s3,
        snr_db,
        float(seen.azimuth_m.max() - seen.azimuth_m.min()),
        float(apart.min()) if len(apart) else None,
        float(lit.to(torch.float64).mean()),
    )
    return {row: [name for name in bench.chains if _concerns(row, name, bench)] for row in rows}


def _concerns(limit: Limit, name: str, bench: Bench) -> bool:
    method = bench.config.processor[name]
    if limit.name not in _CONCERNS or method.input == "clean":
        return method.input != "clean"
    stage, key, value = _CONCERNS[limit.name]
    return any(e["stage"] == stage and e.get(key, value) == value for e in (method.stages or {}).values())


def requirements(bench: Bench, seen: Moved) -> Sequence[Requirement]:
    """What echo and compensation may leave out."""
    e, world = seen.extremes, bench.world()
    motion = (e.velocity_m_s, e.acceleration_m_s2, seen.span_m)
    return ladar_requirements(bench.radar, world.periods, seen.reach_m, *motion)


def choices(bench: Bench, seen: Moved) -> list[Choice]:
    """Echo model, estimator of the velocity, and its settings."""
    models = [_model(name, without, bench.radar, seen.extremes) for name in _LEVELS for without in _shown(name)]
    estimators = {
        "segmented interference": segmented_interference,
        "correlation, upsampling 1": partial(spectrum_correlation, upsampling=1),
        "correlation, upsampling 20": partial(spectrum_correlation, upsampling=20),
        **{f"mirror product, intercept {x}": partial(mirror_product, intercept=x) for x in get_args(Intercept)},
        **{f"mirror product, taper {x:g}": partial(mirror_product, taper=x) for x in (0.5, 1.0)},
        "radial motion": radial_motion,
    }
    found = [Alternative(name, {"estimator": work}) for name, work in estimators.items()]
    return [
        Choice("echo model", "world.fidelity", models, partial(_echoes, bench, seen)),
        Choice("estimator of the velocity", "estimator", found, partial(_estimates, bench)),
    ]


def _shown(name: str) -> Sequence[tuple[Effect, ...]]:
    """Which effects a level is compared without."""
    return _WITHOUT[:3] if name == "linear_in_sweep" else _WITHOUT[2:] if name == "every_sample" else _WITHOUT[2:3]


def _model(name: str, without: tuple[Effect, ...], radar: TriangularLadar, extremes: Extremes) -> Alternative:
    """An echo model with the relative error of the echo that its neglected phases make."""
    level, shape = _LEVELS[name]
    phases = level(without).neglected_phase_rad(radar, extremes)
    square = sum((value * (shape if key == "level" else _EVEN)) ** 2 for key, value in phases.items())
    loss = {} if not phases else {"echo_error_db": 10 * math.log10(max(2 - 2 * math.exp(-square / 2), 1e-30))}
    title = name if without == ("flight",) else f"{name}, without {' and '.join(without) or 'nothing'}"
    return Alternative(title, {"kind": name, "without": list(without)}, loss, ", ".join(phases))


def _echoes(bench: Bench, seen: Moved) -> Measured:
    """Echoes of the farthest scatterer alone by each model, each with its own complex gain."""
    world, radar = bench.world(), bench.radar
    far = int((seen.range_m.abs() + seen.azimuth_m.abs()).argmax())
    point = {"edge": Points([float(seen.azimuth_m[far])], [float(seen.range_m[far])])}
    alone = replace(
        world, scene=point, noise=Noise(), impairments={}, record=None, sweep_error=None, log_amplitude=None
    )
    draws = Draws(bench.config.seed, "trade", [0])

    def made(one: Ground, keys: Mapping[str, Any], dtype: torch.dtype) -> Tensor:
        level = _LEVELS[keys["kind"]][0](tuple(keys["without"]))
        data = replace(one, fidelity=level).trials_of(radar, draws, dtype).recording.signal.data
        return data.flatten(1, 2)

    exact = made(alone, {"kind": "every_sample", "without": ()}, torch.complex128)

    def loss(one: Alternative, _: Tensor) -> dict[str, float]:
        echo = made(alone, one.keys, torch.complex128)
        gain = (echo.conj() * exact).sum() / echo.abs().square().sum()
        return {"echo_error_db": float(error_db(echo * gain, exact))}

    return Measured(lambda one: made(world, one.keys, bench.dtype), loss)


def _estimates(bench: Bench) -> Measured:
    """Estimators alone, in the window of the recommended method, on the config's own trials."""
    draws = Draws(bench.config.seed, "trade", range(bench.config.trade.trials))
    trials = bench.trials(draws)
    chain = bench.chains["recommended"]
    found = [name for name, stage in chain.stages.items() if "velocity_m_s" in getattr(stage, "provides", ())]
    if not found:
        raise ValueError("the recommended method estimates no velocity; there is nothing to compare")
    sweeps = chain.trace(trials.recording).inputs[found[0]]
    window, true = getattr(chain.stages[found[0]], "window_m", None), trials.truth["velocity_m_s"]
    pulse = sweeps.axis("pulse")

    def run(one: Alternative) -> Estimate:
        work: Callable[..., Estimate] = one.keys["estimator"]
        return work(sweeps.data, bench.radar, pulse, window_m=window)

    def error(estimate: Estimate) -> float:
        return float((estimate["velocity_m_s"] - true[..., : pulse.n]).square().mean().sqrt())

    best = error(radial_motion(sweeps.data, bench.radar, pulse, window_m=window))
    return Measured(run, lambda one, estimate: {"velocity_rmse_m_s": error(estimate) - best})
