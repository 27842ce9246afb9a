"""One batch of trials of a turning target: simulate, run every method, compare with the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Draws, Recording, Trace, Truth
from torchsar.echo import Impairment, simulate_turntable
from torchsar.metrics.bounds import pulse_phase_bound_of_scene_rad, pulse_phase_bound_rad
from torchsar.radar import InverseRadar
from torchsar.scene import PhaseOnly, TurntableWorld
from torchsar.study.benches import Benches
from torchsar.study.build import build_impairments, precision
from torchsar.study.cases import check_judged, check_sweep
from torchsar.study.config import Config, Loaded
from torchsar.study.isal.build import build_radar, build_world
from torchsar.study.isal.judge import image_metrics, phase_metrics
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import IMAGE, not_an_image, saved_of, traced

ENDING = "azimuth_transform or target_image"
_SNR = "world.noise.snr_db"
_MOST_SCATTERERS, _MOST_PULSES = 1200, 800
_PEAK_BYTES = 8


@dataclass(frozen=True)
class Bench:
    """All that one case needs, built once in a process."""

    config: Config
    radar: InverseRadar
    world: TurntableWorld
    impairments: Mapping[str, Impairment]
    chains: Mapping[str, Chain]

    @cached_property
    def bound_ratio(self) -> float | None:
        return _bound_ratio(self)


@dataclass(frozen=True)
class Batch:
    """What one batch of trials gave: the recording, the truth, and the trace and the seconds per
    trial of every method.
    """

    recording: Recording
    truth: Truth
    traces: Mapping[str, Trace]
    seconds: Mapping[str, float]

    @property
    def phase_rad(self) -> Tensor:
        """The whole phase error of every pulse, (..., pulse)."""
        return whole_phase(self.truth)

    @property
    def present(self) -> Tensor | None:
        """Pulses that were received, (..., pulse), None where all were."""
        return received(self.truth)


def whole_phase(truth: Truth) -> Tensor:
    """The phase error of every pulse with those of the impairments, (..., pulse)."""
    return truth.values["phase_rad"] + sum(value for name, value in truth.values.items() if name.endswith(".phase_rad"))


def received(truth: Truth) -> Tensor | None:
    """Pulses that no impairment lost, (..., pulse), None where all were received."""
    lost = [value for name, value in truth.values.items() if name.endswith(".present")]
    return torch.stack(lost).all(0) if lost else None


class IsalTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config: {method: {metric: (rows,)}}, bounds of the residual
    phase, and images of the trials to keep.

    Metrics of a method: `residual_phase_rms_rad`, `strehl`, the predicted `residual_phase_std_rad`,
    `entropy_nats`, `contrast`, and `entropy_above_ideal_nats` where metrics.reference names a
    method of unimpaired input; `seconds` per trial; `ok`.
    """

    batched = (_SNR,)

    def check(self, grid: Mapping[str, Any]) -> None:
        """Refuse a grid over what a sweep does not use. Raises ConfigError."""
        check_sweep(self.loaded, grid, "world.start_phase")

    def build(self, loaded: Loaded) -> Bench:
        check_judged(loaded)
        radar = build_radar(loaded)
        chains = {name: chain.to(self.device) for name, chain in build_chains(loaded, radar=radar).items()}
        impairments = build_impairments(
            loaded.config.world.impairments, "world.impairments", loaded.file, TARGET_IMPAIRMENTS
        )
        return Bench(loaded.config, radar, build_world(loaded), impairments, chains)

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Of the largest tensors that a trial needs, from the axes: data, image, and what an
        iteration makes of them.
        """
        config = self.bench(fixed).config
        return _PEAK_BYTES * config.world.pulses * config.world.samples * precision(config).itemsize

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench({k: v for k, v in parameters.items() if k != _SNR})
        world = replace(bench.world, snr_db=parameters[_SNR]) if _SNR in parameters else bench.world
        batch = run_batch(bench, draws, self.device, world)
        found: dict[str, Any] = judged(bench, batch)
        save = bench.config.sweep.save
        return {**found, BOUNDS: _bounds(bench, batch), SAVED: saved_of(batch.traces, save.taps) if save.trials else {}}


def run_batch(bench: Bench, draws: Draws, device: str = "cpu", world: TurntableWorld | None = None) -> Batch:
    """Simulate the trials of the draws, of another world than the bench's where one is given, and
    run every method on them.
    """
    size = bench.config.world
    recording, truth = simulate_turntable(
        bench.radar,
        world or bench.world,
        size.pulses,
        size.samples,
        draws,
        bench.impairments,
        precision(bench.config),
        device,
    )
    assert truth.clean is not None
    traces, seconds = {}, {}
    count = max(1, recording.signal.trials.numel())
    for name, method in bench.config.processor.items():
        began = time.perf_counter()
        traces[name] = traced(bench.chains[name], truth.clean if method.input == "clean" else recording, name)
        seconds[name] = (time.perf_counter() - began) / count
    return Batch(recording, truth, traces, seconds)


def judged(bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
    """Metrics of every method, (trial,) each."""
    config, reference = bench.config, bench.config.metrics.reference
    ideal = None if reference is None else batch.traces[reference].signal
    if ideal is not None and ideal.names != IMAGE:
        raise ConfigError(f"metrics.reference names {reference!r}, {not_an_image(ideal, ENDING)}")
    found = {}
    for name, trace in batch.traces.items():
        clean = config.processor[name].input == "clean"
        truth = torch.zeros_like(batch.phase_rad) if clean else batch.phase_rad
        metrics = phase_metrics(bench.chains[name], trace, truth, batch.present)
        if trace.signal.names == IMAGE:
            metrics.update(image_metrics(trace.signal, None if name == reference else ideal))
        metrics["seconds"] = torch.full(truth.shape[:-1], batch.seconds[name], dtype=torch.float64)
        found[name] = metrics
    return found


def _bounds(bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
    """Of the residual phase: scene known, and amplitudes unknown; the latter's ratio to the former
    comes from one scene of the case, they differ by a percent.
    """
    std = batch.truth.values["noise_std"]
    if not bool((std > 0).all()):
        return {}
    assert batch.truth.clean is not None
    data = batch.truth.clean.signal.data
    power = (torch.view_as_real(data).double().square().sum(-1).mean((-2, -1)) - std.square()).clamp_min(1e-300)
    known = pulse_phase_bound_rad(power / std.square(), data.shape[-1])
    ratio = bench.bound_ratio
    return {
        "residual_phase_rms_rad": {
            "scene known": known,
            **({"amplitudes unknown (Cramer-Rao)": known * ratio} if ratio else {}),
        }
    }


def _bound_ratio(bench: Bench) -> float | None:
    """Bound of unknown amplitudes over that of a known scene, from the scene of an address of its
    own; None where it would take too long.
    """
    size, scene = bench.config.world, bench.world.scene.scatterers(Draws(bench.config.seed, "bound"))
    if (
        not isinstance(bench.world.fidelity, PhaseOnly)
        or scene.amplitude.shape[-1] > _MOST_SCATTERERS
        or not 2 < size.pulses <= _MOST_PULSES
    ):
        return None
    azimuth, response = _scene_matrices(bench, scene.azimuth_m, scene.range_m, size.pulses, size.samples)
    power = ((azimuth * scene.amplitude) @ response).abs().square().mean()
    return float(
        pulse_phase_bound_of_scene_rad(azimuth, response, scene.amplitude, 1.0)
        / pulse_phase_bound_rad(power, size.samples)
    )


def _scene_matrices(bench: Bench, x: Tensor, y: Tensor, n_pulse: int, n_range: int) -> tuple[Tensor, Tensor]:
    """Azimuth phasors (pulse, target) and range responses (target, range) of scatterers at the
    level of phases.
    """
    rate = bench.radar.rotation_rad_s if bench.world.rotation_rad_s is None else bench.world.rotation_rad_s
    theta = float(rate or 0.0) * (torch.arange(n_pulse, dtype=torch.float64) - n_pulse // 2) / bench.radar.prf_hz
    ways = x * torch.sin(theta)[:, None] + y * (torch.cos(theta)[:, None] - 1)
    azimuth = torch.polar(torch.ones_like(ways), -4 * math.pi / bench.radar.wavelength_m * ways)
    cells = torch.arange(n_range, dtype=torch.float64) - n_range // 2
    shifts, back = (
        -2 * math.pi / n_range * (y / bench.radar.range_step_m)[:, None] * cells,
        2 * math.pi / n_range * cells[:, None] * cells,
    )
    return azimuth, torch.polar(torch.ones_like(shifts), shifts) @ torch.polar(torch.ones_like(back), back) / n_range
