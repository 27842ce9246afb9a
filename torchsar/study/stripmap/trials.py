"""One batch of trials of a stripmap config: simulate, run every method, compare with the truth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.doppler import wrap_hz
from torchsar.core import Chain, Draws, Recording, Signal, Trace, Truth
from torchsar.echo import Impairment, apply_impairments, simulate, target_energy
from torchsar.metrics import contrast, correlation, entropy, error_db
from torchsar.metrics.bounds import reference_doppler_std_hz, tone_frequency_bound_hz, velocity_bound_m_s
from torchsar.radar import StripmapRadar
from torchsar.scene import Points, RandomPoints, StripmapWorld, Together
from torchsar.study.benches import Benches
from torchsar.study.build import build_impairments, precision
from torchsar.study.config import Config, Loaded
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.record import OK
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.settings.errors import ConfigError
from torchsar.study.stripmap.build import build_radar, build_world, squint_doppler_hz
from torchsar.study.stripmap.judge import window

_UNIT = re.compile(r"_(hz|m_s|m|s|rad|deg|db)$")
_PEAK_BYTES = 2  # the largest tensor of these chains is about twice the raw matrix


@dataclass(frozen=True)
class Bench:
    """All that one case needs, built once in a process: values that differ between trials come with
    each batch.
    """

    config: Config
    radar: StripmapRadar
    world: StripmapWorld
    impairments: Mapping[str, Impairment]
    chains: Mapping[str, Chain]


def _velocity(bench: Bench, value: Tensor) -> StripmapWorld:
    return replace(bench.world, velocity_m_s=value)


def _doppler(bench: Bench, value: Tensor) -> StripmapWorld:
    return replace(bench.world, doppler_hz=value)


def _squint(bench: Bench, value: Tensor) -> StripmapWorld:
    return replace(bench.world, doppler_hz=squint_doppler_hz(bench.radar, value, bench.world.velocity_m_s))


def _snr(bench: Bench, value: Tensor) -> StripmapWorld:
    return replace(bench.world, snr_db=value)


# Keys that are per-trial tensors of the world, in the order in which they are set: a squint needs
# the velocity.
BATCHED = {
    "world.velocity_m_s": _velocity,
    "world.doppler_hz": _doppler,
    "world.squint_deg": _squint,
    "world.noise.snr_db": _snr,
}


class StripmapTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config: {method: {metric: (rows,)}}, bounds, and images of
    the trials to keep.

    Metrics of a method: every scalar estimate under its name (`doppler_hz`); its error against the
    truth (`doppler_error_hz`, and `doppler_baseband_error_hz` within half a PRF); of an image
    entropy, contrast, and error and correlation against the reference method. `ok` where all
    estimators of the method are. Built chains are kept in the process and do not travel to workers.
    """

    batched = tuple(BATCHED)

    def check(self, grid: Mapping[str, Any]) -> None:
        """Refuse a grid that contradicts itself. Raises ConfigError."""
        if "world.doppler_hz" in grid and "world.squint_deg" in grid:
            raise ConfigError(
                f"{self.loaded.file}: sweep: world.doppler_hz and world.squint_deg both say where the "
                "beam looks; sweep one of them"
            )

    def build(self, loaded: Loaded) -> Bench:
        radar, world = build_radar(loaded), loaded.config.world
        assert world is not None
        impairments = build_impairments(world.impairments, "world.impairments", loaded.file)
        chains = {name: chain.to(self.device) for name, chain in build_chains(loaded, radar=radar).items()}
        return Bench(loaded.config, radar, build_world(loaded), impairments, chains)

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Of the largest tensor that a trial needs, from the axes."""
        config = self.bench(fixed).config
        assert config.world is not None
        return _PEAK_BYTES * config.world.lines * config.world.samples * precision(config).itemsize

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench({k: v for k, v in parameters.items() if k not in BATCHED})
        for key, change in BATCHED.items():
            if key in parameters:
                bench = replace(bench, world=change(bench, parameters[key]))
        size = bench.config.world
        assert size is not None
        recording, truth = simulate(
            bench.radar,
            bench.world,
            size.lines,
            size.samples,
            draws,
            bench.impairments,
            precision(bench.config),
            self.device,
        )
        assert truth.clean is not None
        clean, _ = apply_impairments(truth.clean, {}, draws)
        traces = _traces(bench, recording, clean)
        found: dict[str, Any] = {name: _judged(bench, name, traces, truth) for name in bench.chains}
        return {**found, BOUNDS: _bounds(bench, truth, size.lines), SAVED: _saved(bench, traces)}


def _traces(bench: Bench, recording: Recording, clean: Recording) -> dict[str, tuple[Signal, Trace | None]]:
    """Last signal of every method, and its trace where it ran from the start."""
    found: dict[str, tuple[Signal, Trace | None]] = {}
    for name, method in bench.config.processor.items():
        if method.rerun is None:
            trace = bench.chains[name].trace(clean if method.input == "clean" else recording)
            found[name] = trace.signal, trace
        else:
            source = found[method.rerun.method][1]
            assert source is not None
            given = {
                key: torch.tensor(value, dtype=torch.float64, device=recording.signal.data.device)
                for key, value in method.rerun.given.items()
            }
            found[name] = bench.chains[name].rerun(source, method.rerun.start, given=given), None
    return found


def _judged(
    bench: Bench, name: str, traces: Mapping[str, tuple[Signal, Trace | None]], truth: Truth
) -> dict[str, Tensor]:
    signal, trace = traces[name]
    metrics = {} if trace is None else estimation_metrics(trace, truth, bench.radar.prf_hz)
    if signal.names == ("azimuth", "range"):
        part = window(signal, bench.radar, bench.config.metrics.margin)
        image = signal.crop(**part)
        metrics.update(entropy_nats=entropy(image), contrast=contrast(image))
        reference = bench.config.metrics.reference
        if reference is not None and reference != name:
            pair = [s.crop(**part).to(torch.complex128) for s in (signal, traces[reference][0])]
            metrics.update(image_error_db=error_db(*pair), image_correlation=correlation(*pair))
    return metrics


def estimation_metrics(trace: Trace, truth: Truth, prf_hz: float) -> dict[str, Tensor]:
    """Scalar estimates by name, their errors, and `ok`; a name that two stages give is the later
    one's.
    """
    trials = trace.signal.trials
    values = {key: v for estimate in trace.estimates.values() for key, v in estimate.value.items() if v.shape == trials}
    metrics = dict(values)
    for key, value in values.items():
        if key in truth.values and truth.values[key].numel() in (1, trials.numel()):
            metrics[error_name(key)] = value - truth.values[key].to(value)
    doppler = values.get("doppler_hz", values.get("doppler_baseband_hz"))
    if doppler is not None:
        metrics["doppler_baseband_error_hz"] = wrap_hz(doppler - truth.values["doppler_hz"].to(doppler), prf_hz)
    verdicts = [estimate.ok.expand(trials) for estimate in trace.estimates.values()]
    return {**metrics, OK: torch.stack(verdicts).all(0)} if verdicts else metrics


def error_name(name: str) -> str:
    """'doppler_hz' -> 'doppler_error_hz'."""
    return _UNIT.sub(r"_error_\1", name) if _UNIT.search(name) else f"{name}_error"


def _bounds(bench: Bench, truth: Truth, lines: int) -> dict[str, dict[str, Tensor]]:
    """Of scenes made of points alone: clutter has no q of its own."""
    world, radar, std = bench.world, bench.radar, truth.values["noise_std"]
    parts = world.scene.parts.values() if isinstance(world.scene, Together) else [world.scene]
    if not all(isinstance(scene, (Points, RandomPoints)) for scene in parts) or not bool((std > 0).all()):
        return {}
    q = target_energy(truth, world, radar, lines).sum(-1) / std.square()
    range_m = truth.values["closest_range_m"].mean(-1)
    seconds = radar.aperture_s(float(range_m.mean()))
    velocity = truth.values["velocity_m_s"].to(q)
    doppler = {
        "Cramer-Rao bound of a point of known place": tone_frequency_bound_hz(q, seconds),
        "1/(T sqrt q), Tsvetkov 2017": reference_doppler_std_hz(q, seconds),
    }
    bound = velocity_bound_m_s(q, seconds, velocity, radar.wavelength_m, range_m)
    return {
        "doppler_error_hz": doppler,
        "doppler_baseband_error_hz": doppler,
        "velocity_error_m_s": {"Cramer-Rao bound": bound},
    }


def _saved(bench: Bench, traces: Mapping[str, tuple[Signal, Trace | None]]) -> dict[str, dict[str, Tensor]]:
    """The last signal of every method, and the outputs of the stages that `sweep.save.taps`
    names.
    """
    save = bench.config.sweep.save
    if not save.trials:
        return {}
    found = {}
    for name, (signal, trace) in traces.items():
        taps = (
            {} if trace is None else {stage: trace.outputs[stage].data for stage in save.taps if stage in trace.outputs}
        )
        found[name] = {"last": signal.data, **taps}
    return found
