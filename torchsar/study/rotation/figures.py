"""The pictures of a run: the target, figures by case, images in metres with an enlarged tip, cuts
through point targets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate.rotation.unknowns import k_name
from torchsar.core import Signal
from torchsar.study.cases import word_of
from torchsar.study.pictures import Drawn, Picture, draw_all
from torchsar.study.rotation.judge import Cut, Turned, in_metres
from torchsar.study.rotation.trials import Batch, Bench, scale_rate, target_figures
from torchsar.study.tracing import image_of

_MARGIN = 1.15
_TIP_SHARE, _TIP_REACH = 0.08, 0.02
_COMPARED = {
    "entropy_nats": "entropy (nats)",
    "omega_error_percent": "error of the rate (%)",
    "k1_error_percent": "error of k1 (%)",
    "k2_error_percent": "error of k2 (%)",
    "k1_error_per_s": "error of k1 (1/s)",
    "k2_error_per_s2": "error of k2 (1/s^2)",
}
Metrics = Mapping[str, Mapping[str, Tensor]]


@dataclass(frozen=True)
class CaseResult:
    """One case: metrics (trial,) by method, and of each point target; what the methods found, by
    name with std and ok, and the truth, by trial; of the first trial images in metres, cuts and
    scatterers: range and cross range (m), amplitude.
    """

    metrics: Metrics
    targets: Mapping[str, Metrics]
    found: Mapping[str, Mapping[str, Mapping[str, Any]]]
    truth: Mapping[str, Tensor]
    images: Mapping[str, Signal]
    cuts: Mapping[str, Mapping[str, Cut]]
    scatterers: tuple[Tensor, Tensor, Tensor]

    @staticmethod
    def of(bench: Bench, batch: Batch) -> CaseResult:
        """Of one batch of trials."""
        truth, wavelength = batch.truth.values, bench.table.radar.wavelength_m
        images = {
            name: in_metres(image_of(o.trace.signal), wavelength, scale_rate(o.found, bench.table, batch.truth, 0))
            for name, o in batch.outcomes.items()
        }
        cuts = {
            name: {target: of_trials[0] for target, of_trials in outcome.cuts.items()}
            for name, outcome in batch.outcomes.items()
        }
        scalars = {
            "omega_rad_s": truth["omega_rad_s"],
            "yc_m": truth["yc_m"],
            **{k_name(i + 1): k for i, k in enumerate(truth["warp_k"].unbind(-1))},
        }
        along, across, amplitude = (
            truth[name].reshape(-1, truth[name].shape[-1])[0] for name in ("range_m", "cross_range_m", "amplitude")
        )
        found = {name: _estimates(outcome.found, outcome.metrics) for name, outcome in batch.outcomes.items()}
        return CaseResult(
            batch.metrics,
            target_figures(batch, bench.config.metrics.reference),
            found,
            scalars,
            images,
            cuts,
            (along, across, amplitude),
        )

    @staticmethod
    def joined(parts: Sequence[CaseResult]) -> CaseResult:
        """All trials of a case, and the pictures of the first."""
        first = parts[0]
        metrics = {name: _joined([part.metrics[name] for part in parts]) for name in first.metrics}
        targets = {
            name: {target: _joined([part.targets[name][target] for part in parts]) for target in of}
            for name, of in first.targets.items()
        }
        found = {
            name: {key: _listed([part.found[name][key] for part in parts]) for key in of}
            for name, of in first.found.items()
        }
        return replace(
            first, metrics=metrics, targets=targets, found=found, truth=_joined([part.truth for part in parts])
        )

    def truths(self) -> Mapping[str, Tensor]:
        return self.truth

    def estimates(self) -> dict[str, dict[str, Tensor]]:
        """Rotations by method and name."""
        return {
            name: {key: torch.tensor(entry["value"], dtype=torch.float64) for key, entry in values.items()}
            for name, values in self.found.items()
            if values
        }


def _estimates(found: Turned, metrics: Mapping[str, Tensor]) -> dict[str, dict[str, Any]]:
    """The scalars that metrics.json names, each with predicted deviation and verdict, lists over
    trials.
    """
    named = {
        name: (value, found.std.get(name))
        for name, value in (("omega_rad_s", found.omega_rad_s), ("yc_m", found.yc_m))
        if value is not None
    }
    if found.warp_k is not None:
        std = found.std.get("warp_k")
        named.update(
            {k_name(i + 1): (k, None if std is None else std[..., i]) for i, k in enumerate(found.warp_k.unbind(-1))}
        )
    trials = metrics["seconds"].shape
    ok = metrics["ok"].reshape(-1).tolist() if "ok" in metrics else None
    return {
        name: {
            "value": value.expand(trials).reshape(-1).tolist(),
            "std": None if s is None else s.expand(trials).reshape(-1).tolist(),
            "ok": ok,
        }
        for name, (value, s) in named.items()
    }


def _joined(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {key: torch.cat([part[key].reshape(-1) for part in parts]) for key in parts[0]}


def _listed(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Lists over trials one after the other; what one batch does not give, none does."""
    return {key: None if parts[0][key] is None else [x for part in parts for x in part[key]] for key in parts[0]}


def draw(results: Mapping[str, CaseResult], folder: Path) -> list[Picture]:
    """Every picture of a run, as PNG files in the folder, in the order of reading."""
    by_case = [partial(make, case, result) for case, result in results.items() for make in (_images, _tips, _slices)]
    return draw_all([partial(_target, next(iter(results.values()))), partial(_comparison, results), *by_case], folder)


def _titled(title: str, case: str) -> str:
    return title if case == "all" else f"{title}: {case}"


def _target(result: CaseResult) -> Drawn:
    along, across, amplitude = (plot.array(v) for v in result.scatterers)
    yield (
        "target",
        "Target",
        "Scatterers of the first scene; the area of a point is its power.",
        plot.places(along, across, np.abs(amplitude) ** 2, "range (m)", "cross range (m)", aspect="auto"),
    )


def _comparison(results: Mapping[str, CaseResult]) -> Drawn:
    """Figures of all methods, by case where there are several, else by method."""
    for key, label in _COMPARED.items():
        names = [
            name
            for name in next(iter(results.values())).metrics
            if any(key in result.metrics[name] for result in results.values())
        ]
        if not names:
            continue
        means = {name: np.array([_mean(result.metrics[name], key) for result in results.values()]) for name in names}
        x, series = list(results), {name: (y, np.stack([y, y], -1)) for name, y in means.items()}
        if len(x) == 1:
            y = np.array([means[name][0] for name in names])
            x, series = names, {next(iter(results)): (y, np.stack([y, y], -1))}
        parts = [{"title": "", "x": x, "series": series, "bounds": {}}]
        log = key != "entropy_nats" and any(bool((y > 0).any()) for y, _ in series.values())
        said = "rms over trials of the" if key != "entropy_nats" else "mean over trials of the"
        yield (
            key,
            label.split(" (")[0].capitalize(),
            f"{said.capitalize()} {label}, by method{'' if len(results) == 1 else ' and case'}.",
            plot.error_curves(parts, "", label, log_y=log),
        )


def _mean(metrics: Mapping[str, Tensor], key: str) -> float:
    """Mean of an entropy, root mean square of an error."""
    if key not in metrics:
        return math.nan
    return float(metrics[key].mean()) if key == "entropy_nats" else float(metrics[key].square().mean().sqrt())


def _first_named(result: CaseResult) -> dict[str, Signal]:
    """Images with that of the reference in front."""
    first = "ideal" if "ideal" in result.images else next(iter(result.images))
    return {first: result.images[first], **{name: image for name, image in result.images.items() if name != first}}


def _within(image: Signal, low: tuple[float, float], high: tuple[float, float]) -> Signal:
    """The part of an image between two places (cross range, range), at least two lines and
    cells.
    """
    bounds = {}
    for axis, a, b in zip(image.axes, low, high):
        first, last = (round(float(axis.index_of(v))) for v in (a, b))
        first = min(max(first, 0), axis.n - 2)
        bounds[axis.name] = (first, min(max(last + 1, first + 2), axis.n))
    return image.crop(**bounds)


def _images(case: str, result: CaseResult) -> Drawn:
    along, across, _ = result.scatterers
    reach = _MARGIN * float(across.abs().max())
    cell = result.images[next(iter(result.images))].axes[1].step
    low, high = (-reach, float(along.min()) - 2 * cell), (reach, float(along.max()) + 2 * cell)
    shown = {name: _within(image, low, high) for name, image in _first_named(result).items()}
    caption = (
        "The first trial, all on one scale, that of the first, in dB. Cross range by each "
        "method's own rate, by the true mean rate where it finds none; it may be mirrored."
    )
    yield (
        f"images_{word_of(case)}",
        _titled("Images by every method", case),
        caption,
        plot.images(shown, dynamic_range_db=35.0, columns=4),
    )


def _tips(case: str, result: CaseResult) -> Drawn:
    """What lies about the outermost scatterer, as in Figs 5 to 9 of the source."""
    along, across, amplitude = result.scatterers
    if len(across) < 20:
        return
    reach = float(across.abs().max())
    outer = across.abs() >= (1 - _TIP_REACH) * reach
    tip = int(torch.where(outer, amplitude.abs(), 0).argmax())
    x, y = float(across[tip]), float(along[tip])
    half = _TIP_SHARE * reach
    cell = result.images[next(iter(result.images))].axes[1].step
    beside = max(4 * cell, _TIP_SHARE * float(along.abs().max()))
    shown = {
        name: _within(image, (x - half, y - beside), (x + half, y + beside))
        for name, image in _first_named(result).items()
    }
    caption = (
        f"About the scatterer at {x:.2f} m of cross range and {y:.2f} m of range. An error of "
        "the rate moves it, one of k1 and k2 smears it."
    )
    yield (
        f"tip_{word_of(case)}",
        _titled("The tip, enlarged", case),
        caption,
        plot.images(shown, dynamic_range_db=35.0, columns=4, percentile=100),
    )


def _slices(case: str, result: CaseResult) -> Drawn:
    """Cuts through the point targets, four methods a panel beside the ideal."""
    names = list(_first_named(result))
    parts = []
    for target in result.cuts[names[0]]:
        parts += _slice_panels(target, {name: result.cuts[name][target] for name in names})
    if parts:
        caption = (
            "Cuts through the range cell of each point target, offsets from the true place; 0 dB "
            "is the peak of the first method."
        )
        yield (
            f"slices_{word_of(case)}",
            _titled("Responses of point targets", case),
            caption,
            plot.panels(parts, columns=2),
        )


def _slice_panels(target: str, cuts: Mapping[str, Cut]) -> list[dict[str, Any]]:
    first, *others = cuts
    top = float(cuts[first].line.abs().max())
    near = 25 * cuts[first].figures["irw_azimuth_m"]
    parts = []
    for begin in range(0, max(1, len(others)), 4):
        series = {}
        for name in [first, *others[begin : begin + 4]]:
            cut = cuts[name]
            kept = cut.offset_m.abs() <= near
            series[name] = (plot.array(cut.offset_m[kept]), plot.decibel(cut.line[kept], top))
        parts.append(
            {
                "series": series,
                "xlabel": "cross range from the true place (m)",
                "ylabel": "dB",
                "title": target,
                "ylim": (-50.0, 3.0),
            }
        )
    return parts
