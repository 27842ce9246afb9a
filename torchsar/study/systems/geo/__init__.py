"""Moving point targets, recorded one at a time by a SAR with several azimuth channels and a far
transmitter: system `geo` (Remote Sens. 2020, 12, 1703).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar.core import Chain, Signal, Trace, per_trial
from torchsar.metrics import bistatic_bounds
from torchsar.multichannel.reconstruct import noise_and_clutter
from torchsar.radar import BistaticRadar
from torchsar.study.names.registry import MULTICHANNEL_IMPAIRMENTS
from torchsar.study.output.report import Drawn, comparisons
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded
from torchsar.study.systems.geo import choices
from torchsar.study.systems.geo.judge import (
    DRAW_CASE,
    UNKNOWNS,
    FocusedPoint,
    FoundMotion,
    by_target,
    ideal_responses,
    point_responses,
    shots,
)
from torchsar.study.systems.geo.world import TRUTHS, Points, bistatic_radar, compression_gain_db
from torchsar.study.trials.batch import IMAGE, OK, Batch, Found, Judged, Processed, Result, Trials, error_name
from torchsar.study.trials.bench import TRUTH, Bench
from torchsar.study.trials.system import Column, System


@dataclass(frozen=True)
class Judging:
    """Settings of the metrics.

    Args:
        orders: Largest order n of the replicas (false targets) that are measured. The replicas of
            order n lie n times the PRF in Doppler to either side of a target.
        published_targets: Published values by metric, target and method.
    """

    orders: int = 3
    published_targets: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.orders < 1:
            raise ValueError(f"metrics.orders must be at least 1, got {self.orders}")


class View(NamedTuple):
    """Data of a method that pictures need: images and spectra without noise, and their geometry."""

    image: Signal | None
    spectrum: Signal | None
    focused: FocusedPoint | None


class Geo(System):
    """Moving points, recorded by several channels."""

    name = "geo"
    about = "moving points, recorded by several channels along track from a far transmitter"
    Radar = staticmethod(bistatic_radar)
    World = Points
    Judging = Judging
    impairments = MULTICHANNEL_IMPAIRMENTS
    images = (("azimuth",), IMAGE)
    draw_case = DRAW_CASE
    truths = TRUTHS
    peak = 12.0
    tolerance = {"image_error_db": -20.0, "echo_error_db": -20.0, "mfta_db": -50.0, "width_change_percent": 1.0}
    exact = {
        "world.receive": {"kind": "exact_range"},
        "remove_transmit_range.order": {"order": None},
        "correct_migration.migration": {"migration": {"kind": "keystone", "whole_swath": True}},
    }
    definitions = {
        "snr": "power of the target over noise variance in one range-compressed sample of one channel, dB "
        "(snr_db). Raw, before compression, it is 10 log10(B tau_p) less (raw_scnr_db): 27 dB at 50 MHz and 10 "
        "us. A sample of azimuth-only data is one of the compressed peak line. scr_db: power of the target over that "
        "of the sea in such a sample",
        "targets": "every target is recorded and processed alone, with noise of its own; metrics of a method "
        "are means over its targets",
        "velocities": "u_r: closing slant-range speed towards the receiver's closest point; u_a: along track, "
        "positive with the receiver; y0: position along track at t = 0, the middle pulse",
        "responses": "irw, pslr, islr, mfta and noise-free positions are measured on the image of the CLEAN echo (same "
        "impairment, no noise, no sea), rebuilt and focused with the values that the method estimated "
        "from the NOISY one, because image noise would hide false targets below about -60 dB",
        "irw_azimuth_m": "3 dB width on the axis x = (V_R - u_a) t of the true target; theory 0.886 v / B, B "
        "the processed Doppler band within the target's",
        "pslr_azimuth_db": "largest side lobe over the peak; theory, a sinc: -13.26 dB",
        "islr_azimuth_db": "energy of 20 side lobes to either side over that of the main lobe; theory, a sinc: "
        "-9.92 dB",
        "mfta_db": "largest replica in the zones of +-1..metrics.orders pulse rates from the peak over the "
        "peak, as far as the image reaches",
        "u_r_error_m_s": "estimated minus true u_r, of methods that estimate it; u_a_error_m_s and y0_error_m likewise",
        "predicted": "u_r_std_m_s, u_a_std_m_s, y0_std_m: standard deviations that the estimator predicts",
        "position_error_m": "position along track at t = 0 from the measured peak after location correction by "
        "the method's own velocities, minus the truth",
        "range": "irw_range_m, pslr_range_db, islr_range_db on the axis c tau / 2, on which the width of a sinc is "
        "0.886 c / (2 B); range_error_m: of the receive path at t = 0",
        "condition_number": "of the band matrix at the velocities used; not given for mmse, which inverts no "
        "such matrix",
        "noise_gain_db": "noise of a rebuilt bin against ideal uniform sampling by as many channels, mean over bins",
        "theory": "a target that is rebuilt and focused without error",
        "bounds": "Cramer-Rao for known noise or clutter, complex amplitude and y0 unknown; u_a unknown too, or "
        "known, as named",
        "published": "values of Remote Sens. 2020, 12, 1703; its SCNR is taken as that before range compression",
    }
    target_columns = {
        "irw_azimuth_m": Column("width in azimuth, axis (V_R - u_a) t", "m"),
        "pslr_azimuth_db": Column("PSLR in azimuth", "dB"),
        "islr_azimuth_db": Column("ISLR in azimuth", "dB"),
        "mfta_db": Column("largest false target (MFTA)", "dB", drawn="mean"),
        "u_r_error_m_s": Column("error of the slant-range velocity", "m/s", drawn="rms"),
        "u_a_error_m_s": Column("error of the along-track velocity", "m/s", drawn="rms"),
        "position_error_m": Column("error of the position along track", "m", drawn="rms"),
        "irw_range_m": Column("width in range, axis c tau / 2", "m"),
        "pslr_range_db": Column("PSLR in range", "dB"),
        "islr_range_db": Column("ISLR in range", "dB"),
        "range_error_m": Column("error of the range", "m"),
        "condition_number": Column("condition number of the reconstruction"),
        "noise_gain_db": Column("noise gain of the reconstruction", "dB"),
        "u_r_std_m_s": Column("predicted error of the slant-range velocity", "m/s"),
        "u_a_std_m_s": Column("predicted error of the along-track velocity", "m/s"),
        "ok": Column("share of trials called reliable"),
    }
    columns = {**target_columns, "seconds": Column("time of a trial", "s")}

    def samples(self, world: Points, radar: BistaticRadar) -> int:
        return len(world.targets) * radar.channels * world.pulses * (world.samples or 1)

    def check_sweep(self, loaded: Loaded, grid: Mapping[str, Any]) -> None:
        targets = list((loaded.config.world or {})["targets"])
        if len(targets) > 1:
            raise ConfigError(
                f"{loaded.file}: world.targets must have a single target in a sweep, got {', '.join(targets)}; "
                "keep one of them"
            )

    def may_differ(self, path: str, world: Mapping[str, Any]) -> bool:
        """Return whether a number of the world, by dotted key, may differ between trials.

        The illumination of a sea may not, because it determines the number of cells of the sea.
        """
        lights_sea = "gate." if world["sea_gate"] is None else "sea_gate."
        shapes = world["sea"] is not None and path.startswith(lights_sea)
        return not shapes and super().may_differ(path, world)

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        chain, truth, world = bench.chains[name], trials.truth, bench.world()
        rows, view = trace.signal.trials, View(None, None, None)
        metrics = FoundMotion.by(trace.estimates).errors(truth)
        focused = FocusedPoint.of(chain, trace, bench.radar)
        if focused is not None:
            metrics |= {key: value.expand(rows) for key, value in focused.conditioning().items()}
        if focused is not None and trace.signal.names in self.images:
            clean = bench.config.processor[name].input == "clean" or trials.own.snr_db is None
            alone = trace if clean else chain.trace(trials.own.alone, _held(chain, trace))
            lit = trials.own.world.integration_s
            metrics |= point_responses(alone.signal, focused, truth, lit, bench.judging.orders)
            view = View(alone.signal, alone.outputs[focused.stage], focused)
        verdicts = {}
        if trace.estimates:
            found = [estimate.ok.expand(rows) for estimate in trace.estimates.values()]
            verdicts = {OK: torch.stack(found).all(0).reshape(trials.count, -1)}
        table = {key: value.reshape(trials.count, -1) for key, value in metrics.items()}
        whole = {key: value.double().nanmean(-1) for key, value in table.items()}
        each = {**table, **verdicts}
        targets = {t: {key: x[:, i] for key, x in each.items()} for i, t in enumerate(world.targets)}
        seen = {key: torch.isfinite(x.double()).all(0).tolist() for key, x in each.items()}
        missing = [t for i, t in enumerate(targets) if not all(of[i] for of in seen.values())]
        shown = {t: {key: x for key, x in row.items() if seen[key][i]} for i, (t, row) in enumerate(targets.items())}
        return Judged(whole, shown, missing, view)

    def found(self, bench: Bench, outcome: Processed, trials: Trials) -> dict[str, Found]:
        motion, n = FoundMotion.by(outcome.estimates), trials.count
        table: dict[str, Found] = {}
        for i, target in enumerate(bench.world().targets):
            for key, value in motion.value.items():
                std, codes = motion.std.get(key), motion.outcome[key].expand(value.shape)
                spread = None if std is None else std.reshape(n, -1)[:, i]
                table[f"{target}.{key}"] = Found(value.reshape(n, -1)[:, i], spread, codes.reshape(n, -1)[:, i])
        return table

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return Cramer-Rao bounds of velocities and position, for the quantities that the methods
        estimate; nothing for data without noise.
        """
        truth, world, radar = batch.trials.truth, bench.world(), bench.radar
        metrics = [outcome.metrics for outcome in batch.outcomes.values()]
        kinds: dict[str, tuple[str, ...]] = {}
        if any("u_a_error_m_s" in of for of in metrics):
            kinds["Cramer-Rao"] = UNKNOWNS
        if any("u_r_error_m_s" in of and "u_a_error_m_s" not in of for of in metrics):
            kinds["Cramer-Rao, u_a known"] = ("u_r_m_s", "y0_m")
        found: dict[str, dict[str, Tensor]] = {}
        if batch.trials.own.snr_db is None:
            return found
        snr = 10 ** (per_trial(batch.trials.own.snr_db, 0, truth["u_r_m_s"]) / 10)
        given = {
            "integration_s": batch.trials.own.world.integration_s,
            "covariance": _clutter(batch.trials.own.world, radar),
        }
        point = [truth[key] for key in TRUTHS]
        for title, unknown in kinds.items():
            bound = bistatic_bounds(radar, world.pulses, snr, *point, unknown=unknown, **given)
            for key, value in bound.items():
                found.setdefault(error_name(key), {})[title] = value.expand(truth["u_r_m_s"].shape)
        return {key: named for key, named in found.items() if any(key in of for of in metrics)}

    limits = staticmethod(choices.limits)  # pyright: ignore[reportAssignmentType]

    requirements = staticmethod(choices.requirements)  # pyright: ignore[reportAssignmentType]

    choices = staticmethod(choices.choices)  # pyright: ignore[reportAssignmentType]

    def theory(self, result: Result) -> Mapping[str, Mapping[str, float]]:
        """Return the metrics of the ideal response of each target; empty if the recommended method
        makes no image.
        """
        focused, truth = result.first_of("recommended").judged.view.focused, result.first.trials.truth
        own, world = result.first.trials.own, result.bench.world()
        if focused is None:
            return {}
        lit = (
            None if own.world.integration_s is None else float(torch.as_tensor(own.world.integration_s).reshape(-1)[0])
        )
        radar, known = result.bench.radar, (lit, focused.processed_hz, world.samples is not None)
        speeds = {t: [float(truth[f"{t}.{key}"][0]) for key in ("u_r_m_s", "u_a_m_s")] for t in world.targets}
        return {target: ideal_responses(radar, u_r, u_a, *known) for target, (u_r, u_a) in speeds.items()}

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        yield from self.case_pictures(results)
        yield partial(comparisons, by_target(results), self.target_columns)

    def pictured(self, result: Result) -> dict[str, Signal]:
        return {f"{name}/{target}": shot.image for name, of in shots(result).items() for target, shot in of.items()}

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        levels = metrics["definitions"]
        text = "Echoes are without noise."
        if "snr_db" in levels:
            text = (
                f"A target is {levels['snr_db']:.4g} dB above the noise in a range-compressed sample of one channel, "
                f"{levels['raw_scnr_db']:.4g} dB before compression."
            )
        yield "Signal to noise", text

    def extra_definitions(self, bench: Bench) -> Mapping[str, Any]:
        """Return the SNR in dB before and after range compression, and the coefficients k1, k2, ...
        of the range to the transmitter.
        """
        snr, gain = bench.world().snr_db(bench.radar), compression_gain_db(bench.radar)
        transmit = {f"transmit_range_k{i}": k for i, k in enumerate(bench.radar.transmit_range, 1)}
        levels = (
            {"compression_gain_db": gain} if snr is None else {"snr_db": float(snr), "raw_scnr_db": float(snr) - gain}
        )
        return {"orders": bench.judging.orders, **levels, **transmit}


def _held(chain: Chain, trace: Trace) -> dict[str, Any]:
    """Values that a chain was given or has estimated."""
    sources = {source for uses in chain.uses.values() for source in uses.values() if source.startswith(TRUTH)}
    return {**trace.estimates, **{source: trace.values[source] for source in sources}}


def _clutter(world: Points, radar: BistaticRadar) -> Tensor | None:
    """Covariance of white noise of unit variance and of the sea, across channels, for each Doppler
    bin.
    """
    if world.sea is None:
        return None
    gate = world.gate if world.sea_gate is None else world.sea_gate
    return noise_and_clutter(radar, getattr(gate, "duration_s", None), world.pulses, world.sea.power_db)


SYSTEM = Geo
