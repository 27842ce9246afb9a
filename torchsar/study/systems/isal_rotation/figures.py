"""The pictures of a run of a rotating target: images in metres, one end, cuts through points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.metrics.rotation import CrossRangeCut
from torchsar.study.output.pictures import Drawn, comparisons, first_named
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.systems.isal.figures import target
from torchsar.study.systems.isal_rotation.world import first_values
from torchsar.study.trials.batch import Result

# scatterers stand this much inside the picture; the end that is enlarged, in parts of the target
_MARGIN, _END_HALF, _END_REACH = 1.15, 0.08, 0.02
# targets of fewer scatterers show as points, whose cuts say more than an enlarged picture
_MANY = 20


def pictures(results: Mapping[str, Result], columns: Mapping[str, Any]) -> Iterator[Callable[[], Drawn]]:
    """Makers of all pictures."""
    yield partial(target, next(iter(results.values())))
    yield partial(comparisons, results, columns)
    for case, result in results.items():
        for make in (_images, _end, _slices):
            yield partial(make, case, result)


def _scatterers(result: Result) -> list[Tensor]:
    """Range, cross range (m) and amplitude in the first trial."""
    return first_values(result.first.trials.truth, "range_m", "cross_range_m", "amplitude")


def _in_metres(result: Result) -> dict[str, Signal]:
    """Images of the first trial with cross range in metres, by each method's own rate."""
    found = {}
    for name, image in first_named(result.images).items():
        azimuth, range_ = image.axes
        rate = float(result.first_of(name).judged.view.rate[0])
        scale = result.bench.radar.wavelength_m / (2 * rate) if azimuth.unit == "Hz" else 1.0
        cross = Axis("cross range", azimuth.n, azimuth.start * scale, azimuth.step * scale, "m")
        found[name] = Signal(image.data, (cross, range_))
    return found


def _images(case: str, result: Result) -> Drawn:
    along, across, _ = _scatterers(result)
    images = _in_metres(result)
    reach, cell = _MARGIN * float(across.abs().max()), next(iter(images.values())).axes[1].step
    spans = {"cross range": (-reach, reach), "range": (float(along.min()) - 2 * cell, float(along.max()) + 2 * cell)}
    shown = {name: plot.within(image, spans) for name, image in images.items()}
    caption = (
        "The first trial, all on one scale, that of the first, in dB. Cross range by each method's own rate, by the "
        "true mean rate where it finds none; it may be mirrored."
    )
    figure = plot.images(shown, dynamic_range_db=35.0)
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, figure


def _end(case: str, result: Result) -> Drawn:
    """What lies about the outermost scatterer, as in Figs 5 to 9 of the source."""
    along, across, amplitude = _scatterers(result)
    if len(across) < _MANY:
        return
    reach = float(across.abs().max())
    tip = int(torch.where(across.abs() >= (1 - _END_REACH) * reach, amplitude.abs(), 0).argmax())
    x, y, half = float(across[tip]), float(along[tip]), _END_HALF * reach
    images = _in_metres(result)
    beside = max(4 * next(iter(images.values())).axes[1].step, _END_HALF * float(along.abs().max()))
    spans = {"cross range": (x - half, x + half), "range": (y - beside, y + beside)}
    shown = {name: plot.within(image, spans) for name, image in images.items()}
    caption = (
        f"About the scatterer at {x:.2f} m of cross range and {y:.2f} m of range. An error of the rate moves it, one "
        "of k1 and k2 smears it."
    )
    figure = plot.images(shown, dynamic_range_db=35.0, percentile=100)
    yield f"end_{word_of(case)}", titled("One end of the target, enlarged", case), caption, figure


def _slices(case: str, result: Result) -> Drawn:
    """Cuts through the point targets, four methods a panel beside the ideal one."""
    views = {name: result.first_of(name).judged.view for name in first_named(result.images)}
    targets = dict.fromkeys(target for view in views.values() for target in view.cuts)
    parts = [
        part for one in targets for part in _panels(one, {n: v.cuts[one] for n, v in views.items() if one in v.cuts})
    ]
    if parts:
        caption = (
            "Cuts through the range cell of each point target, offsets from the true position; 0 dB is the peak of the "
            "first method."
        )
        yield f"slices_{word_of(case)}", titled("Responses of point targets", case), caption, plot.panels(parts)


def _panels(target: str, cuts: Mapping[str, CrossRangeCut]) -> list[dict[str, Any]]:
    first, *others = cuts
    top, width = (float(cuts[first].figures[key][0]) for key in ("peak", "irw_azimuth_m"))
    parts = []
    for begin in range(0, max(1, len(others)), 4):
        series = {}
        for name in [first, *others[begin : begin + 4]]:
            offset, inside = cuts[name].offset_m[0], cuts[name].inside[0]
            kept = inside & (offset.abs() <= 25 * width)
            series[name] = (plot.array(offset[kept]), plot.decibel(cuts[name].line[0][kept], top))
        xlabel = "cross range from the true position (m)"
        parts.append(
            {"series": series, "xlabel": xlabel, "ylabel": "level (dB)", "title": target, "ylim": (-50.0, 3.0)}
        )
    return parts
