"""Limits of ladar methods, errors of echo models, and comparisons of models and estimators."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, get_args

import torch
from torch import Tensor

from torchsar.compensate import mirror_product, radial_motion, segmented_interference, spectrum_correlation
from torchsar.compensate.radial.measured import Intercept
from torchsar.core import Draws, Estimate
from torchsar.echo.ladar import range_model_error_db
from torchsar.focus import AzimuthMatchedFilter, ladar_limits, ladar_requirements
from torchsar.focus.requirements import Limit, Requirement
from torchsar.metrics import error_after_gain_db
from torchsar.scene.ladar_range import Moved
from torchsar.scene.motion import drawn_motion
from torchsar.study.names.registry import SWEEP_FIDELITIES
from torchsar.study.systems.sal.judge import lit_periods
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, DirectlySummed, Measured, beside_direct_sum, ladar_strip
from torchsar.study.trials.system import Noise

# Stage, key and value that a method must have for the limit to concern it.
_CONCERNS = {
    "SNR after compression": ("segmented_interference", "unwrap", "gradient"),
    "spacing of scatterers": ("segmented_interference", "bins", "peak"),
    # The limit on the speed concerns no stage, so the empty names match none. Estimators remove
    # most of the velocity of the mirror first.
    "speed of the mirror tone": ("", "", ""),
}
# echo models, the cheapest first: level of detail, effect that is left out, row of the requirements
_MODELS = (
    ("one_per_period", "", "one range per period"),
    ("one_per_sweep", "", "one range per sweep"),
    ("linear_in_sweep", "flight", ""),
    ("linear_in_sweep", "", "Doppler linear in the sweep"),
    ("quadratic_in_sweep", "flight", ""),
    ("quadratic_in_sweep", "", ""),
    ("every_sample", "residual_video", "no residual video phase"),
    ("every_sample", "hyperbola", "parabola for hyperbola"),
    ("every_sample", "flight", "flight time ignored"),
    ("every_sample", "", ""),
)


def _moved(bench: Bench) -> Moved:
    """Return the strongest scatterers within the range gate, and the motion, of the first trial.

    Raises:
        ValueError: If no scatterer lies within the gate, or one within it lies behind the ladar or
            has a beat frequency that aliases.
    """
    return bench.memo("moved", lambda: _first_moved(bench))


def _first_moved(bench: Bench) -> Moved:
    world, radar, draws = bench.world(), bench.radar, bench.draws("run", [0])
    motion = drawn_motion(world.motion, draws, world.periods * radar.pulse_step_s)
    return Moved.of(radar, world.of().scene.scatterers(draws), motion, world.periods, world.gate_m)


def limits(bench: Bench) -> dict[Limit, list[str]]:
    """Return the limits of methods in this scene, with the methods that each concerns."""
    world, radar, seen = bench.world(), bench.radar, _moved(bench)
    e = seen.extremes
    apart = torch.diff(torch.unique(seen.range_m))
    snr_db = world.noise.snr_db
    snr_db = None if snr_db is None else float(snr_db) + 20 * math.log10(seen.peak)
    lit = lit_periods(radar, radar.sweep_axes(world.periods)[1], seen.azimuth_m, seen.range_m)
    rows = ladar_limits(
        radar,
        world.periods,
        e.range_m,
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


def requirements(bench: Bench) -> Sequence[Requirement]:
    """Return the errors of simplified echo models and of motion compensation in this scene."""
    e = _moved(bench).extremes
    motion = (e.velocity_m_s, e.acceleration_m_s2, e.displacement_m)
    return ladar_requirements(bench.radar, bench.world().periods, e.range_m, *motion)


def choices(bench: Bench) -> list[Choice]:
    """Return the choices between alternatives: echo model, and estimator of the velocity."""
    estimators = {
        "segmented interference": segmented_interference,
        "correlation, upsampling 1": partial(spectrum_correlation, upsampling=1),
        "correlation, upsampling 20": partial(spectrum_correlation, upsampling=20),
        **{f"mirror product, intercept {x}": partial(mirror_product, intercept=x) for x in get_args(Intercept)},
        **{f"mirror product, taper {x:g}": partial(mirror_product, taper=x) for x in (0.5, 1.0)},
        "radial motion": radial_motion,
    }
    found = [Alternative(name, {"estimator": work}) for name, work in estimators.items()]
    # models with one range per sweep are not possible for a continuous record
    possible = [entry for entry in _MODELS if bench.world().record is None or not entry[0].startswith("one_per")]
    seen = _moved(bench)
    models = [_model(bench, seen, *entry) for entry in possible]
    filters = [n for n, s in bench.chains["recommended"].stages.items() if isinstance(s, AzimuthMatchedFilter)]
    images = [beside_direct_sum(partial(_summed, bench, n), "migration while a point is seen") for n in filters[-1:]]
    return [
        Choice("echo model", "world.fidelity", models, partial(_echoes, bench, seen)),
        Choice("estimator of the velocity", "estimator", found, partial(_estimates, bench)),
        *images,
    ]


def _fidelity(keys: Mapping[str, Any]) -> Any:
    return SWEEP_FIDELITIES.entries[keys["kind"]](tuple(keys["without"]))


def _model(bench: Bench, seen: Moved, kind: str, without: str, row: str) -> Alternative:
    """An echo model with its predicted error for the farthest scatterer."""
    keys = {"kind": kind, "without": [without] if without else []}
    about = (seen.farthest.scatterers(Draws(0)), bench.radar, bench.world().periods, seen.motion)
    exact = keys == bench.system.exact["world.fidelity"]
    loss = {} if exact else {"echo_error_db": range_model_error_db(*about, _fidelity(keys))}
    return Alternative(f"{kind}, without {without}" if without else kind, keys, loss, without, row)


def _echoes(bench: Bench, seen: Moved) -> Measured:
    """Measure the echoes of the farthest scatterer by each model, each with its best
    complex gain.
    """
    world, nothing = bench.world(), {"impairments": {}, "record": None, "sweep_error": None, "log_amplitude": None}
    alone = replace(world, scene={"edge": seen.farthest}, noise=Noise(), **nothing)
    draws = bench.draws("run", [0])  # random draws of the trial for which the predictions are made

    def made(of: Any, keys: Mapping[str, Any], dtype: torch.dtype) -> Tensor:
        trials = replace(of, fidelity=_fidelity(keys)).trials_of(bench.radar, draws, dtype)
        return trials.recording.signal.data.flatten(1, 2)

    exact = made(alone, bench.system.exact["world.fidelity"], torch.complex128)

    return Measured(
        lambda one: made(world, one.keys, bench.dtype),
        lambda one, _: {"echo_error_db": float(error_after_gain_db(made(alone, one.keys, torch.complex128), exact))},
    )


def _estimates(bench: Bench) -> Measured:
    """Measure single estimators, in the range window of the recommended method, on the trials of
    the config.
    """
    trials = bench.trials(bench.draws("trade", range(bench.config.trade.trials)))
    chain = bench.chains["recommended"]
    found = [name for name, stage in chain.stages.items() if "velocity_m_s" in getattr(stage, "provides", ())]
    if not found:
        raise ValueError(
            "processor.recommended estimates no velocity, which the comparison of velocity estimators needs; add a "
            "stage that estimates velocity_m_s"
        )
    sweeps = chain.trace(trials.recording).inputs[found[0]]
    window, true = getattr(chain.stages[found[0]], "window_m", None), trials.truth["velocity_m_s"]
    pulse = sweeps.axis("pulse")

    def error(estimate: Estimate) -> float:
        return float((estimate["velocity_m_s"] - true[..., : pulse.n]).square().mean().sqrt())

    best = error(radial_motion(sweeps.data, bench.radar, pulse, window_m=window))
    return Measured(
        lambda one: one.keys["estimator"](sweeps.data, bench.radar, pulse, window_m=window),
        lambda one, estimate: {"velocity_rmse_m_s": error(estimate) - best},
    )


def _summed(bench: Bench, name: str) -> DirectlySummed:
    """Image of white noise by an azimuth filter of the recommended method, on the axes of
    its data.
    """
    draws, chain = bench.draws(), bench.chains["recommended"]
    data = chain.trace(bench.trials(bench.draws("trade", [0])).recording).inputs[name]
    beam = getattr(chain.stages[name], "beam_rad", None) or bench.radar.beam_rad
    return ladar_strip(bench.radar, data.axes[-2], data.axes[-1], beam, draws, bench.dtype)
