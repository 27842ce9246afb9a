"""One batch of trials of an unevenly turning target: simulate, run every method, compare with the
truth.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.rotation.unknowns import k_name
from torchsar.core import Chain, Draws, Signal, Trace, Truth
from torchsar.focus.matched_fourier import MatchedFourier
from torchsar.metrics.rotation_bounds import rotation_bounds
from torchsar.study.benches import Benches
from torchsar.study.cases import check_judged, check_sweep, refuse_recordings
from torchsar.study.config import Config, Loaded
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.rotation.build import Turntable, named_targets
from torchsar.study.rotation.judge import (
    Cut,
    Turned,
    cut_through,
    image_metrics,
    in_metres,
    k_metric,
    rotation_metrics,
    told_metrics,
)
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import IMAGE, image_of, not_an_image, saved_of, traced

ENDING = "matched_fourier"
_SNR = "world.noise.snr_db"
_PEAK_BYTES = 12


@dataclass(frozen=True)
class Bench:
    """All that one case needs, built once in a process."""

    config: Config
    table: Turntable
    chains: Mapping[str, Chain]

    @cached_property
    def targets(self) -> dict[str, int]:
        return named_targets(self.table.world)


@dataclass(frozen=True)
class Outcome:
    """What one method gave in a batch.

    metrics: (trial,) each; found: the rotation it estimated; cuts: of each point target, of each
    trial.
    """

    metrics: dict[str, Tensor]
    found: Turned
    trace: Trace
    cuts: Mapping[str, list[Cut]]


@dataclass(frozen=True)
class Batch:
    """What one batch of trials gave: the truth, and the outcome of every method."""

    truth: Truth
    outcomes: Mapping[str, Outcome]

    @property
    def metrics(self) -> dict[str, dict[str, Tensor]]:
        return {name: outcome.metrics for name, outcome in self.outcomes.items()}


class RotationTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config: {method: {metric: (rows,)}}, Cramer-Rao bounds of the
    errors, and images of the trials to keep.

    Metrics of a method are those of `torchsar.study.rotation.judge.DEFINITIONS`; of the image only
    where the chain makes one.
    """

    batched = (_SNR,)

    def check(self, grid: Mapping[str, Any]) -> None:
        """Refuse a grid over what a sweep does not use. Raises ConfigError."""
        refuse_recordings(self.loaded)
        check_sweep(self.loaded, grid, "world.rotation")

    def build(self, loaded: Loaded) -> Bench:
        check_judged(loaded)
        table = Turntable.of(loaded)
        chains = {name: chain.to(self.device) for name, chain in build_chains(loaded, radar=table.radar).items()}
        return Bench(loaded.config, table, chains)

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Of the largest tensors that a trial needs, from the axes: data, image of twice the lines,
        and what an estimator makes of them.
        """
        table = self.bench(fixed).table
        return _PEAK_BYTES * table.pulses * table.samples * table.dtype.itemsize

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench({k: v for k, v in parameters.items() if k != _SNR})
        if _SNR in parameters:
            bench = replace(
                bench, table=replace(bench.table, world=replace(bench.table.world, snr_db=parameters[_SNR]))
            )
        batch = run_batch(bench, draws, self.device)
        save = bench.config.sweep.save
        traces = {name: outcome.trace for name, outcome in batch.outcomes.items()}
        return {
            **batch.metrics,
            BOUNDS: error_bounds(bench.table, batch.truth, _any_centre(bench)),
            SAVED: saved_of(traces, save.taps) if save.trials else {},
        }


def run_batch(bench: Bench, draws: Draws, device: str = "cpu", cuts: bool = False) -> Batch:
    """Simulate the trials of the draws, and run and judge every method; cuts: through point targets
    as well.
    """
    recording, truth = bench.table.recorded(draws, device)
    assert truth.clean is not None
    outcomes: dict[str, Outcome] = {}
    count = max(1, recording.signal.trials.numel())
    for name, method in bench.config.processor.items():
        began = time.perf_counter()
        trace = traced(bench.chains[name], truth.clean if method.input == "clean" else recording, name)
        outcomes[name] = _judged(bench, name, trace, truth, (time.perf_counter() - began) / count, cuts)
    _compare(bench, outcomes)
    return Batch(truth, outcomes)


def _judged(bench: Bench, name: str, trace: Trace, truth: Truth, seconds: float, cuts: bool) -> Outcome:
    table, found = bench.table, Turned.by(bench.chains[name], trace.estimates)
    metrics = rotation_metrics(found, truth.values, true_k(table), table.duration_s, table.radar.rotation_rad_s)
    if trace.signal.names == IMAGE:
        metrics.update(image_metrics(trace.signal))
    metrics["seconds"] = torch.full(trace.signal.trials, seconds, dtype=torch.float64)
    metrics.update(told_metrics(trace))
    through = _cuts(bench, name, trace.signal, found, truth) if cuts and trace.signal.names == IMAGE else {}
    return Outcome(metrics, found, trace, through)


def _compare(bench: Bench, outcomes: Mapping[str, Outcome]) -> None:
    """Entropies above that of the reference. Raises ConfigError for one that is no image."""
    reference = bench.config.metrics.reference
    if reference is None:
        return
    ideal = outcomes[reference].metrics.get("entropy_nats")
    for name, outcome in outcomes.items():
        if ideal is None and outcome.trace.signal.names == IMAGE:
            raise ConfigError(
                f"metrics.reference names {reference!r}, {not_an_image(outcomes[reference].trace.signal, ENDING)}"
            )
        if ideal is not None and name != reference and "entropy_nats" in outcome.metrics:
            outcome.metrics["entropy_above_ideal_nats"] = outcome.metrics["entropy_nats"] - ideal


def true_k(table: Turntable) -> tuple[float, ...]:
    """k of the world, which a config gives as numbers."""
    return tuple(float(k) for k in table.rotation.k)


def scale_rate(found: Turned, table: Turntable, truth: Truth, trial: int) -> float:
    """Mean rate (rad/s) by which the image of a trial is drawn in metres: the method's own, the
    radar's, else the true one.
    """
    own = found.rate(table.duration_s)
    own = float(own.reshape(-1)[trial]) if own is not None else float("nan")
    told = table.radar.rotation_rad_s or float(truth.values["rotation_rad_s"].reshape(-1)[trial])
    return own if own > 0 else told


def _cuts(bench: Bench, name: str, image: Signal, found: Turned, truth: Truth) -> dict[str, list[Cut]]:
    """Cuts through all point targets of all trials."""
    lines = [stage.oversampling for stage in bench.chains[name].stages.values() if isinstance(stage, MatchedFourier)]
    turns = 0.5 / lines[-1] if lines else 0.0
    rows = range(max(1, image.trials.numel()))
    images = [
        in_metres(image_of(image, i), bench.table.radar.wavelength_m, scale_rate(found, bench.table, truth, i))
        for i in rows
    ]

    def one(target: int, row: int) -> Cut:
        x, y = (
            truth.values[key].expand(*image.trials, -1).reshape(-1, truth.values[key].shape[-1])[row, target]
            for key in ("cross_range_m", "range_m")
        )
        return cut_through(images[row], float(x), float(y), bench.config.metrics.search_m, turns)

    return {target: [one(i, row) for row in rows] for target, i in bench.targets.items()}


def target_figures(batch: Batch, reference: str | None) -> dict[str, dict[str, dict[str, Tensor]]]:
    """By method and target: peak_db against the reference (else against 1), irw_azimuth_m and
    pslr_azimuth_db, (trial,) each.
    """
    rows = {
        name: {target: [cut.figures for cut in cuts] for target, cuts in outcome.cuts.items()}
        for name, outcome in batch.outcomes.items()
    }
    out: dict[str, dict[str, dict[str, Tensor]]] = {}
    for name, targets in rows.items():
        out[name] = {}
        for target, figures in targets.items():
            level = (
                _column(rows[reference][target], "peak")
                if reference is not None and target in rows[reference]
                else torch.ones((), dtype=torch.float64)
            )
            peak_db = 20 * torch.log10((_column(figures, "peak") / level).clamp_min(1e-15))
            out[name][target] = {
                "peak_db": peak_db,
                **{key: _column(figures, key) for key in ("irw_azimuth_m", "pslr_azimuth_db")},
            }
    return out


def _column(figures: list[dict[str, float]], key: str) -> Tensor:
    return torch.tensor([figure[key] for figure in figures], dtype=torch.float64)


def _any_centre(bench: Bench) -> bool:
    """Whether any estimator of the config looks for the range centre deviation."""
    return any(
        getattr(stage, "yc_m", 0.0) is None and "yc_m" in getattr(stage, "provides", ())
        for chain in bench.chains.values()
        for stage in chain.stages.values()
    )


def error_bounds(table: Turntable, truth: Truth, free_centre: bool) -> dict[str, dict[str, Tensor]]:
    """Cramer-Rao bounds of the errors in their own units, (trial,) each; nothing without noise."""
    std, values = truth.values["noise_std"], truth.values
    if not bool((std > 0).all()):
        return {}
    deviations = rotation_bounds(
        values["cross_range_m"],
        values["range_m"],
        values["amplitude"],
        std,
        values["omega_rad_s"],
        values["warp_k"],
        values["yc_m"],
        wavelength_m=table.radar.wavelength_m,
        prf_hz=table.radar.prf_hz,
        n_pulse=table.pulses,
        free_centre=free_centre,
    )
    percent = 100 / values["omega_rad_s"]
    found = {"omega_error_percent": deviations["omega_rad_s"] * percent}
    for i in range(1, len(true_k(table)) + 1):
        name, scale = k_metric(i, true_k(table))
        found[name] = deviations[k_name(i)] * scale
    if "yc_m" in deviations:
        found["yc_error_m"] = deviations["yc_m"]
    return {name: {"Cramer-Rao": value.expand(values["omega_rad_s"].shape)} for name, value in found.items()}
