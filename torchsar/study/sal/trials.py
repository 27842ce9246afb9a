"""One batch of trials of a triangular-sweep ladar: simulate, run every method, compare with the
truth.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.radial import SpectrumCorrelation
from torchsar.core import Chain, Draws, Recording, Signal, Trace, Truth
from torchsar.metrics import (
    range_per_sweep_bound_m,
    velocity_free_offset_bound_m_s,
    velocity_known_offset_bound_m_s,
    velocity_segmented_bound_m_s,
)
from torchsar.scene import Points, Together
from torchsar.study.benches import Benches
from torchsar.study.cases import check_judged, check_sweep, refuse_recordings
from torchsar.study.config import Config, Loaded
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.sal.build import Ladar, check_deramped, check_target, named_targets
from torchsar.study.sal.judge import Course, course_of, image_metrics, motion_metrics, target_metrics
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import IMAGE, not_an_image, saved_of, traced, verdict

PROFILES = ("pulse", "range")
ENDING = "azimuth_matched_filter"
_SNR = "world.noise.snr_db"
# the largest tensor of these chains over a recording in double precision
_PEAK = 1.25


@dataclass(frozen=True)
class Bench:
    """All that one case needs, built once in a process."""

    config: Config
    ladar: Ladar
    chains: Mapping[str, Chain]
    targets: Mapping[str, int]


@dataclass(frozen=True)
class Outcome:
    """What one method gave in a batch.

    metrics: (trial,) each; targets: the same of each point target; last: its last signal; profiles:
    the last range profiles before the image, None where it makes none; kept: what the store keeps.
    """

    metrics: dict[str, Tensor]
    targets: dict[str, dict[str, Tensor]]
    course: Course
    last: Signal
    profiles: Signal | None
    kept: dict[str, Tensor]


@dataclass(frozen=True)
class Batch:
    """What one batch of trials gave: the truth, and the outcome of every method."""

    truth: Truth
    outcomes: Mapping[str, Outcome]

    @property
    def metrics(self) -> dict[str, dict[str, Tensor]]:
        return {name: outcome.metrics for name, outcome in self.outcomes.items()}

    @property
    def targets(self) -> dict[str, dict[str, dict[str, Tensor]]]:
        return {name: outcome.targets for name, outcome in self.outcomes.items()}


class SalTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config: {method: {metric: (rows,)}}, bounds of scenes of one
    point, and arrays of the trials to keep.

    Metrics of a method are those of `torchsar.study.sal.judge.DEFINITIONS`; of the image and of
    responses only where the chain makes an image.
    """

    batched = (_SNR,)

    def check(self, grid: Mapping[str, Any]) -> None:
        """Refuse a grid over what a sweep does not use. Raises ConfigError."""
        refuse_recordings(self.loaded)
        check_sweep(self.loaded, grid, "world.motion")

    def build(self, loaded: Loaded) -> Bench:
        check_judged(loaded)
        ladar = Ladar.of(loaded)
        check_target(loaded, ladar.world)
        chains = {name: chain.to(self.device) for name, chain in build_chains(loaded, radar=ladar.radar).items()}
        check_deramped(loaded)
        return Bench(loaded.config, ladar, chains, named_targets(ladar.world))

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Of the largest tensor that a trial needs, from the axes: noise in double precision, or
        spectra that are upsampled over the whole band.
        """
        bench = self.bench(fixed)
        radar, record = bench.ladar.radar, bench.ladar.record
        block = (
            2 * radar.sweep_samples
            if record is None
            else round((record.block_s or (1 if radar.keep_every == 1 else 2) * radar.period_s) * radar.sample_rate_hz)
        )
        finest = max(
            (
                stage.upsampling / 2
                for chain in bench.chains.values()
                for stage in chain.stages.values()
                if isinstance(stage, SpectrumCorrelation) and stage.window_m is None
            ),
            default=0,
        )
        return int(
            max(_PEAK * block, finest * 2 * radar.sweep_samples) * bench.ladar.periods * torch.complex128.itemsize
        )

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench({k: v for k, v in parameters.items() if k != _SNR})
        if _SNR in parameters:
            bench = replace(
                bench, ladar=replace(bench.ladar, world=replace(bench.ladar.world, snr_db=parameters[_SNR]))
            )
        batch = run_batch(bench, draws, self.device)
        saved = (
            {name: outcome.kept for name, outcome in batch.outcomes.items()} if bench.config.sweep.save.trials else {}
        )
        return {**batch.metrics, BOUNDS: _bounds(bench, batch.truth), SAVED: saved}


def run_batch(bench: Bench, draws: Draws, device: str = "cpu") -> Batch:
    """Simulate the trials of the draws, and run and judge every method; traces are dropped one by
    one.
    """
    recording, truth = bench.ladar.recorded(draws, device)
    assert truth.clean is not None
    outcomes = {name: _outcome(bench, name, recording, truth) for name in bench.chains}
    reference = bench.config.metrics.reference
    if reference is not None and "entropy_nats" in outcomes[reference].metrics:
        ideal = outcomes[reference].metrics["entropy_nats"]
        for name, outcome in outcomes.items():
            if name != reference and "entropy_nats" in outcome.metrics:
                outcome.metrics["entropy_above_ideal_nats"] = outcome.metrics["entropy_nats"] - ideal
    elif reference is not None and any(outcome.last.names == IMAGE for outcome in outcomes.values()):
        raise ConfigError(f"metrics.reference names {reference!r}, {not_an_image(outcomes[reference].last, ENDING)}")
    return Batch(truth, outcomes)


def _outcome(bench: Bench, name: str, recording: Recording, truth: Truth) -> Outcome:
    """One method on one batch, judged."""
    chain, clean = bench.chains[name], bench.config.processor[name].input == "clean"
    assert truth.clean is not None
    began = time.perf_counter()
    trace = traced(chain, truth.clean if clean else recording, name)
    seconds = (time.perf_counter() - began) / max(1, recording.signal.trials.numel())
    course = course_of(chain, trace, truth, bench.ladar.radar, clean)
    metrics = motion_metrics(course, bench.ladar.radar)
    targets: dict[str, dict[str, Tensor]] = {}
    if trace.signal.names == IMAGE:
        metrics.update(image_metrics(trace.signal))
        targets = _responses(bench, trace.signal, course, truth)
        shown = targets.get(bench.config.metrics.target or "", {})
        metrics.update({key: value for key, value in shown.items() if key.startswith(("irw", "pslr", "islr"))})
    metrics["seconds"] = torch.full(metrics["range_error_max_m"].shape, seconds, dtype=torch.float64)
    metrics.update(verdict(trace.estimates, metrics["seconds"].shape))
    kept = saved_of({name: trace}, bench.config.sweep.save.taps)[name] if bench.config.sweep.save.trials else {}
    return Outcome(metrics, targets, course, trace.signal, _profiles(trace), kept)


def _responses(bench: Bench, image: Signal, course: Course, truth: Truth) -> dict[str, dict[str, Tensor]]:
    """Figures of the point targets of the batch."""
    trials, settings = image.trials, bench.config.metrics
    places = {
        target: tuple(truth.values[key][..., i].expand(trials) for key in ("azimuth_m", "range_m"))
        for target, i in bench.targets.items()
    }
    return target_metrics(image, places, course, bench.ladar.radar, settings.sidelobe_nulls, settings.search_m)  # pyright: ignore[reportArgumentType]


def _profiles(trace: Trace) -> Signal | None:
    found = [signal for signal in trace.outputs.values() if signal.names == PROFILES]
    return found[0] if found else None


def _bounds(bench: Bench, truth: Truth) -> dict[str, dict[str, Tensor]]:
    """Of scenes of one point, whose energy every estimator can use."""
    world, radar, std = bench.ladar.world, bench.ladar.radar, truth.values["noise_std"]
    assert isinstance(world.scene, Together)
    if (
        truth.values["range_m"].shape[-1] != 1
        or not all(isinstance(scene, Points) for scene in world.scene.parts.values())
        or not bool((std > 0).all())
    ):
        return {}
    snr = truth.values["amplitude"][..., 0].abs().square() / std.square()
    of_sweep = (snr, radar.sweep_samples, radar.wavelength_m)
    return {
        "velocity_rmse_m_s": {
            "segmented interference": velocity_segmented_bound_m_s(*of_sweep, radar.sweep_s),
            "unknown offsets": velocity_free_offset_bound_m_s(*of_sweep, radar.sweep_s),
            "known offset": velocity_known_offset_bound_m_s(*of_sweep, radar.sweep_s),
        },
        "range_error_detrended_rms_m": {"phase of one sweep": range_per_sweep_bound_m(*of_sweep)},
    }
