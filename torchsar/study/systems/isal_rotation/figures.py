"""Figures of one rotating target: images in metres, detail of one end, cuts through points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.study.output.pictures import Drawn, comparisons, first_named
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.systems.isal import target
from torchsar.study.systems.isal_rotation.judge import CrossRangeCut
from torchsar.study.systems.isal_rotation.world import first_values
from torchsar.study.trials.batch import Result

# half the cross range of a picture over that of the target, for many scatterers and for a few
# points, beside which their responses are shown; the part of the half width that is enlarged
_MARGIN, _MARGIN_OF_POINTS, _END = 1.15, 1.5, 0.2
# targets of fewer scatterers are points, of which cuts show more than an enlarged picture
_MANY = 20
# half the extent of a cut in widths of the response, and the largest number of methods in a panel
# beside the ideal one
_WIDTHS, _BESIDE = 25, 4


def pictures(results: Mapping[str, Result], columns: Mapping[str, Any]) -> Iterator[Callable[[], Drawn]]:
    """Yield functions that draw the pictures, in the order of the report."""
    yield partial(target, next(iter(results.values())))
    yield partial(comparisons, results, columns)
    for case, result in results.items():
        for make in (_images, _end, _slices):
            yield partial(make, case, result)


def _scatterers(result: Result) -> list[Tensor]:
    """Range, cross range (m) and amplitude in the first trial."""
    return first_values(result.first.trials.truth, "range_m", "cross_range_m", "amplitude")


def _in_metres(result: Result) -> dict[str, Signal]:
    """Images of the first trial with cross range in metres, scaled by each method's own rate."""
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
    reach = (_MARGIN if len(across) >= _MANY else _MARGIN_OF_POINTS) * float(across.abs().max())
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, (-reach, reach), plot.span(along, margin))
    caption = (
        "The first trial; 0 dB is the peak of the first image. Cross range is scaled by the rotation rate that the "
        "method itself estimates, or by the true mean rate if it estimates none. The sign of cross range cannot be "
        "determined from the data."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, figure


def _end(case: str, result: Result) -> Drawn:
    """Draw the end of the target with the outermost scatterer, as in Figs 5 to 9 of the source."""
    along, across, _ = _scatterers(result)
    if len(across) < _MANY:
        return
    reach, side = float(across.abs().max()), across[across.abs().argmax()].sign()
    near = side * across >= (1 - _END) * reach
    images = _in_metres(result)
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, plot.span(across[near], 0.1 * _END * reach), plot.span(along[near], margin))
    caption = (
        "The outermost part of the target. An error of the rotation rate moves the scatterers along cross range; "
        "errors of k1 and k2 blur them. 0 dB is the peak of the first image."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield f"end_{word_of(case)}", titled("One end of the target, enlarged", case), caption, figure


def _parts(images: Mapping[str, Signal], across: tuple[float, float], along: tuple[float, float]) -> dict[str, Signal]:
    """The part of every image between two cross ranges and two ranges, in metres."""
    return {name: plot.within(image, {"cross range": across, "range": along}) for name, image in images.items()}


def _slices(case: str, result: Result) -> Drawn:
    """Draw cuts through the point targets."""
    views = {name: result.first_of(name).judged.view for name in first_named(result.images)}
    targets = dict.fromkeys(target for view in views.values() for target in view.cuts)
    parts = [
        part for one in targets for part in _panels(one, {n: v.cuts[one] for n, v in views.items() if one in v.cuts})
    ]
    if parts:
        caption = (
            "Cuts along cross range through each point target. The ideal response is in every panel; the other methods "
            "are spread over several panels if there are many. 0 dB is the peak of the ideal response."
        )
        yield f"slices_{word_of(case)}", titled("Responses of point targets", case), caption, plot.panels(parts)


def _panels(target: str, cuts: Mapping[str, CrossRangeCut]) -> list[dict[str, Any]]:
    """Panels of one target, each with the first method and an equal share of the others."""
    first, *others = cuts
    top, width = (float(cuts[first].figures[key][0]) for key in ("peak", "irw_azimuth_m"))
    count = math.ceil(len(others) / _BESIDE) or 1
    parts = []
    for number in range(count):
        series = {}
        for name in [first, *others[number::count]]:
            offset, inside = cuts[name].offset_m[0], cuts[name].inside[0]
            kept = inside & (offset.abs() <= _WIDTHS * width)
            series[name] = (1e3 * plot.array(offset[kept]), plot.decibel(cuts[name].line[0][kept], top))
        labels = {"xlabel": "cross range from the true position (mm)", "ylabel": "level (dB)", "title": target}
        parts.append({"series": series, **labels, "ylim": (-50.0, 3.0)})
    return parts
