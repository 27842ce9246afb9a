"""Metrics of one method on strips: errors of estimates, images, responses of point targets."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchsar.core import Chain, Signal, Trace, wrapped
from torchsar.focus import ClosestRange
from torchsar.focus.skew import common_lines
from torchsar.metrics import contrast, correlation, entropy, error_db, impulse_response
from torchsar.study.systems.stripmap.image import Margin, Used, window
from torchsar.study.trials.batch import IMAGE, Judged, Processed, Trials
from torchsar.study.trials.bench import Bench

_UNIT = re.compile(r"_(hz|m_s|m|s|rad|deg|db)$")
_FIGURES = ("irw_azimuth_m", "irw_range_m", "pslr_azimuth_db", "pslr_range_db", "islr_azimuth_db", "islr_range_db")


@dataclass(frozen=True)
class Judging:
    """Settings of the metrics.

    Args:
        margin: Edges of the image that the metrics leave out; None for lines without a full
            aperture and samples without a full pulse.
        reference: Name of the method with which images and peaks are compared.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a rectangular band.
        found_within_m: Largest distance in metres between the peak and the true position of a
            target that counts as found.
        found_above_db: Lowest peak of a target that counts as found, in dB relative to the
            reference.
        published: Published values by metric, case and method.
    """

    margin: Margin | None = None
    reference: str | None = None
    sidelobe_nulls: int = 10
    found_within_m: float = 10.0
    found_above_db: float = -6.0
    published: Mapping[str, Mapping[str, Mapping[str, float | str]]] = field(default_factory=dict)


def judge(bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
    """Return the metrics of one method, with those of point targets if `detail` is true."""
    chain, n = bench.chains[name], trials.count
    metrics = estimation_metrics(trace, trials, bench.radar.prf_hz)
    if trace.signal.names != IMAGE:
        return Judged(metrics)
    used = Used.by(chain, trace, bench.radar, n)
    if not trace.signal.data.is_complex():  # the metrics of images and responses are those before detection
        return Judged({**metrics, **used.metrics(bench.radar)}, view=used)
    image = trace.signal.isel(**window(trace.signal, bench.radar, bench.judging.margin))
    metrics.update(used.metrics(bench.radar), entropy_nats=entropy(image).expand(n), contrast=contrast(image).expand(n))
    if not detail:
        return Judged(metrics, view=used)
    targets, outside = _targets(bench, chain, trace.signal, used, trials)
    return Judged(metrics, targets, outside, used)


def estimation_metrics(trace: Trace, trials: Trials, prf_hz: float) -> dict[str, Tensor]:
    """Return the scalar estimates of a chain by name, and their errors.

    If two stages estimate values of the same name, the value of the later stage is used.
    """
    n, truth = trials.count, trials.truth
    found = {key: v for estimate in trace.estimates.values() for key, v in estimate.value.items()}
    values = {key: v.double().expand(n) for key, v in found.items() if v.shape == trace.signal.trials}
    metrics = dict(values)
    for key, value in values.items():
        if key in truth and truth[key].numel() in (1, n):
            metrics[error_name(key)] = value - truth[key].to(value)
    doppler = values.get("doppler_hz", values.get("doppler_baseband_hz"))
    if doppler is not None and "doppler_hz" in truth:
        metrics["doppler_baseband_error_hz"] = wrapped(doppler - truth["doppler_hz"].to(doppler), prf_hz)
    return metrics


def error_name(name: str) -> str:
    """'doppler_hz' -> 'doppler_error_hz'."""
    return _UNIT.sub(r"_error_\1", name) if _UNIT.search(name) else f"{name}_error"


def compare(bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
    """Return the metrics of a method, with image error and correlation relative to the reference
    method, and with statistics over its point targets.
    """
    judged = over_targets(bench, outcome.judged, None if ideal is None else ideal.judged)
    one, other = outcome.signal, None if ideal is None else ideal.signal
    if one is None or other is None or one is other or not one.names == other.names == IMAGE:
        return judged
    if not (one.data.is_complex() and other.data.is_complex()):
        return judged
    pair = [
        image.isel(**window(image, bench.radar, bench.judging.margin)).to(torch.complex128)  # sums over many pixels
        for image in common_lines(one, other)
    ]
    count = len(judged.metrics["seconds"])
    found = {"image_error_db": error_db(*pair), "image_correlation": correlation(*pair)}
    return replace(judged, metrics={**judged.metrics, **{name: value.expand(count) for name, value in found.items()}})


def positions(chain: Chain, used: Used, bench: Bench, trials: Trials) -> tuple[Tensor, Tensor]:
    """Return the expected azimuth and range (m) of the point targets in an image, each of shape
    (trial, target).
    """
    index = torch.tensor(list(bench.world().named_points.values()))
    zero, closest, velocity = (trials.truth[key] for key in ("zero_doppler_s", "closest_range_m", "velocity_m_s"))
    zero, closest = (x[..., index].expand(trials.count, -1) for x in (zero, closest))
    azimuth, slant = bench.radar.image_position(
        zero, closest, used.frame_hz[:, None], velocity.expand(trials.count)[:, None]
    )
    flat = any(isinstance(stage, ClosestRange) for stage in chain.stages.values())
    return azimuth, closest if flat else slant


def _targets(
    bench: Bench, chain: Chain, image: Signal, used: Used, trials: Trials
) -> tuple[dict[str, dict[str, Tensor]], list[str]]:
    """Metrics of every point target inside the image, and the names of those outside."""
    names = [] if bench.recording is not None else list(bench.world().named_points)
    if not names:
        return {}, []
    expected = positions(chain, used, bench, trials)
    inside = torch.stack([(x >= a.start) & (x <= a.stop) for x, a in zip(expected, image.axes)]).all(0).all(0)
    kept = [name for name, within in zip(names, inside.tolist()) if within]
    outside = [name for name in names if name not in kept]
    if not kept:
        return {}, outside
    at = tuple(x[:, inside] if image.trials else x[0, inside] for x in expected)
    figures = impulse_response(image, (at[0], at[1]), sidelobe_nulls=bench.judging.sidelobe_nulls)
    figures = {key: value.reshape(trials.count, -1) for key, value in figures.items()}
    table = {key: figures[key] for key in _FIGURES}
    for axis, x in zip(("azimuth", "range"), expected):
        table[f"position_error_{axis}_m"] = figures[f"position_{axis}_m"] - x[:, inside]
    table["peak_db"] = 20 * torch.log10(figures["peak"].abs().clamp_min(1e-300))
    return {name: {key: value[:, i] for key, value in table.items()} for i, name in enumerate(kept)}, outside


def over_targets(bench: Bench, judged: Judged, ideal: Judged | None) -> Judged:
    """Return the metrics of a method over its point targets: peaks relative to the reference
    method, the number of targets found, and medians over those found.
    """
    settings, targets = bench.judging, {}
    for name, row in judged.targets.items():
        level = 0.0 if ideal is None or name not in ideal.targets else ideal.targets[name]["peak_db"]
        peak = row["peak_db"] - level
        away = torch.hypot(row["position_error_azimuth_m"], row["position_error_range_m"])
        seen = (away <= settings.found_within_m) & ((peak >= settings.found_above_db) | (ideal is None))
        targets[name] = {**row, "peak_db": peak, "found": seen.double()}
    if not targets:
        return judged
    found = torch.stack([row["found"] for row in targets.values()])  # (target, trial)
    metrics = {"targets": torch.full_like(found[0], len(targets)), "targets_found": found.sum(0)}
    for key in (*_FIGURES, "position_error_azimuth_m", "position_error_range_m"):
        values = torch.stack([row[key] for row in targets.values()])
        kept = torch.where(found > 0, values, torch.nan)
        if key in _FIGURES:
            metrics[key] = kept.nanmedian(0).values
        else:
            metrics[key.replace("_m", "_rms_m")] = kept.square().nanmean(0).sqrt()
    return Judged({**judged.metrics, **metrics}, targets, judged.outside, judged.view)
