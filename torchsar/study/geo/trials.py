"""One batch of trials of moving targets before several channels: simulate, run every method,
compare with the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Draws, Estimate, Recording, Trace, per_trial
from torchsar.metrics.bistatic_bounds import bistatic_bounds
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import (
    ElementPattern,
    FlatBand,
    band_matrix,
    doppler_offsets,
    first_bin,
    shared_response,
)
from torchsar.radar import BistaticRadar
from torchsar.scene import BandLimited, Gate
from torchsar.study.benches import Benches
from torchsar.study.cases import check_sweep, refuse_recordings
from torchsar.study.config import Loaded, Method
from torchsar.study.geo.build import Echoes, Recorded, refuse_unfit, snr_db_of
from torchsar.study.geo.judge import IMAGES, Focused, Found, error_name, response_metrics, told_metrics
from torchsar.study.geo.sections import GeoConfig, Noise, compression_gain_db
from torchsar.study.methods import build_chains
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import saved_of, traced

_LEVELS = tuple(f"world.noise.{name}" for name in Noise.model_fields)
_PEAK_COPIES = 12
_CLUTTER_BANDS = 5


@dataclass(frozen=True)
class Bench:
    """All that one case needs, built once in a process."""

    config: GeoConfig
    echoes: Echoes
    chains: Mapping[str, Chain]


@dataclass(frozen=True)
class Outcome:
    """What one method gave in a batch: metrics (row,), the trace on the noisy recording, that of
    the clean one with the same estimates (None without an image), and how it was focused.
    """

    metrics: dict[str, Tensor]
    trace: Trace
    clean: Trace | None
    focused: Focused | None


@dataclass(frozen=True)
class Batch:
    """What one batch of rows gave: the truth, and the outcome of every method."""

    truth: Mapping[str, Tensor]
    outcomes: Mapping[str, Outcome]

    @property
    def metrics(self) -> dict[str, dict[str, Tensor]]:
        return {name: outcome.metrics for name, outcome in self.outcomes.items()}


class GeoTrials(Benches[Bench]):
    """`trial(parameters, draws)` of a config with one target: {method: {metric: (rows,)}},
    Cramer-Rao bounds of the errors, and signals of the trials to keep.

    Metrics of a method are those of `torchsar.study.geo.judge.DEFINITIONS`; of the image only where
    the chain makes one.
    """

    batched = _LEVELS

    def check(self, grid: Mapping[str, Any]) -> None:
        """Refuse a grid over what a sweep does not use. Raises ConfigError."""
        refuse_recordings(self.loaded)
        check_sweep(self.loaded, grid, "world.targets.p1.u_r_m_s")
        targets = list(self.loaded.config.world.targets)
        if len(targets) > 1:
            raise ConfigError(
                f"{self.loaded.file}: world.targets: a sweep follows one target, and there are "
                f"{', '.join(targets)}; keep one of them"
            )
        levels = [key for key in grid if key in _LEVELS]
        if len(levels) > 1:
            raise ConfigError(
                f"{self.loaded.file}: sweep: {levels[0]} and {levels[1]} both say how strong the "
                "target is; sweep over one of them"
            )

    def build(self, loaded: Loaded) -> Bench:
        refuse_unfit(loaded)
        echoes = Echoes.of(loaded)
        chains = {name: chain.to(self.device) for name, chain in build_chains(loaded, radar=echoes.radar).items()}
        assert isinstance(loaded.config, GeoConfig)
        return Bench(loaded.config, echoes, chains)

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Of the largest tensors that a trial needs: data, the rebuilt band, and what estimators
        make of them.
        """
        echoes = self.bench(fixed).echoes
        return (
            _PEAK_COPIES
            * echoes.dtype.itemsize
            * len(echoes.targets)
            * echoes.radar.channels
            * echoes.pulses
            * (echoes.samples or 1)
        )

    @torch.no_grad()
    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        bench = self.bench({k: v for k, v in parameters.items() if k not in _LEVELS})
        for key in set(parameters) & set(_LEVELS):
            bench = replace(bench, echoes=replace(bench.echoes, snr_db=_level(bench, key, parameters[key])))
        batch = run_batch(bench, draws, self.device)
        save = bench.config.sweep.save
        traces = {name: outcome.trace for name, outcome in batch.outcomes.items()}
        return {
            **batch.metrics,
            BOUNDS: error_bounds(bench, batch),
            SAVED: saved_of(traces, save.taps) if save.trials else {},
        }


def _level(bench: Bench, key: str, value: Tensor) -> Tensor:
    """SNR of a compressed sample from a swept level of any kind."""
    zero = Noise(**{key.rpartition(".")[2]: 0.0})
    above = snr_db_of(zero, compression_gain_db(bench.config), bench.echoes.sea)
    assert above is not None
    return value + above


def run_batch(bench: Bench, draws: Draws, device: str = "cpu") -> Batch:
    """Simulate the trials of the draws, every target alone, and run and judge every method.

    Rows are (trial, target), flattened.
    """
    recorded, outcomes = bench.echoes.recorded(draws, device), {}
    for name in bench.config.processor:
        outcomes[name] = _outcome(bench, name, recorded, outcomes)
    return Batch(recorded.truth, outcomes)


def _outcome(bench: Bench, name: str, recorded: Recorded, earlier: Mapping[str, Outcome]) -> Outcome:
    chain, clean_input = bench.chains[name], bench.config.processor[name].input == "clean"
    shared = _shared(bench.config, name, earlier)
    trace = traced(chain, recorded.unimpaired if clean_input else recorded.noisy, name, _held(shared.estimates))
    trace = replace(
        trace, estimates={**shared.estimates, **trace.estimates}, seconds={**trace.seconds, **shared.seconds}
    )
    seconds = sum(trace.seconds.values()) / trace.signal.trials.numel()
    metrics = Found.by(trace.estimates).metrics(recorded.truth)
    focused = Focused.of(chain, trace, bench.echoes.radar)
    clean = None
    if focused is not None:
        metrics.update({key: value.expand(trace.signal.trials) for key, value in focused.metrics().items()})
    if focused is not None and trace.signal.names in IMAGES:
        clean = trace if clean_input or bench.echoes.snr_db is None else _clean(chain, trace, recorded.clean)
        metrics.update(
            response_metrics(
                clean.signal, focused, recorded.truth, bench.echoes.integration_s, bench.config.metrics.orders
            )
        )
    metrics["seconds"] = torch.full(trace.signal.trials, seconds, dtype=torch.float64)
    return Outcome({**metrics, **told_metrics(trace)}, trace, clean, focused)


@dataclass(frozen=True)
class _Shared:
    """Estimates, by stage, that an earlier method has made already, and what each took."""

    estimates: Mapping[str, Estimate]
    seconds: Mapping[str, float]


def _shared(config: GeoConfig, name: str, earlier: Mapping[str, Outcome]) -> _Shared:
    """Of the method whose chain begins with the most of the same stages: a search is not made again
    for every reconstruction.
    """
    best: list[str] = []
    trace = None
    for other, outcome in earlier.items():
        common = _common(config.processor[name], config.processor[other])
        if len(common) > len(best):
            best, trace = common, outcome.trace
    made = {} if trace is None else {stage: trace.estimates[stage] for stage in best if stage in trace.estimates}
    return _Shared(made, {} if trace is None else {stage: trace.seconds[stage] for stage in made})


def _common(one: Method, other: Method) -> list[str]:
    """Names of the first stages that two methods have alike."""
    pairs = takewhile(lambda pair: pair[0] == pair[1], zip((one.stages or {}).items(), (other.stages or {}).items()))
    return [stage for (stage, _), _ in pairs] if one.input == other.input else []


def _held(estimates: Mapping[str, Estimate]) -> dict[str, Tensor]:
    return {f"{stage}.{key}": value for stage, estimate in estimates.items() for key, value in estimate.value.items()}


def _clean(chain: Chain, trace: Trace, clean: Recording) -> Trace:
    """The chain on the target alone, every value held that it found in the noisy recording."""
    return chain.trace(clean, _held(trace.estimates))


def error_bounds(bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
    """Cramer-Rao bounds of the errors, (row,) each, for the unknowns that any method has; nothing
    without noise.
    """
    echoes, truth = bench.echoes, batch.truth
    if echoes.snr_db is None:
        return {}
    rows = truth["u_r_m_s"].shape
    snr = 10 ** (per_trial(echoes.snr_db, 0, truth["u_r_m_s"]) / 10)
    covariance = (
        None
        if echoes.sea is None
        else clutter_covariance(echoes.radar, echoes.pulses, echoes.sea_gate, 10 ** (float(echoes.sea.power_db) / 10))
    )
    given: dict[str, Any] = {"integration_s": echoes.integration_s, "covariance": covariance}
    metrics = list(batch.metrics.values())
    kinds: dict[str, tuple[str, ...]] = (
        {"Cramer-Rao": ("u_r_m_s", "u_a_m_s", "y0_m")} if any("u_a_error_m_s" in of for of in metrics) else {}
    )
    if any("u_r_error_m_s" in of and "u_a_error_m_s" not in of for of in metrics):
        kinds["Cramer-Rao, u_a known"] = ("u_r_m_s", "y0_m")
    found: dict[str, dict[str, Tensor]] = {}
    for title, unknown in kinds.items():
        deviations = bistatic_bounds(
            echoes.radar,
            echoes.pulses,
            snr,
            truth["u_r_m_s"],
            truth["u_a_m_s"],
            truth["y0_m"],
            truth["range_m"],
            unknown=unknown,
            **given,
        )
        for key, value in deviations.items():
            found.setdefault(error_name(key), {})[title] = value.expand(rows)
    return {key: named for key, named in found.items() if any(key in of for of in metrics)}


def clutter_covariance(radar: BistaticRadar, n_pulse: int, gate: Gate, cnr: float) -> Tensor:
    """Of white noise of unit variance and a sea at rest of `cnr` times its power, across channels
    in each bin of the unitary FFT over pulses, FFT order, (n_pulse, channel, channel).
    """
    motion = PointMotion.of(radar, torch.zeros((), dtype=torch.float64))
    offset = doppler_offsets(n_pulse, _CLUTTER_BANDS, radar.prf_hz).view(_CLUTTER_BANDS, n_pulse).T
    band = (
        radar.speed_m_s**2 * gate.duration_s / (radar.wavelength_m * radar.reference_range_m)
        if isinstance(gate, BandLimited)
        else None
    )
    power = (ElementPattern() if band is None else FlatBand(band)).power(offset, radar, motion)
    power = power * (cnr * n_pulse / power.sum())
    response = shared_response(radar, motion, n_pulse, _CLUTTER_BANDS, torch.complex128).T[..., None] * band_matrix(
        radar, motion, _CLUTTER_BANDS
    )
    clutter = (response * power[:, None, :].to(response.dtype)) @ response.mH
    return torch.roll(clutter, first_bin(n_pulse, _CLUTTER_BANDS), 0) + torch.eye(radar.channels, dtype=response.dtype)
