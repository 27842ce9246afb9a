"""Figures of one rotating target: images in metres, detail of one end, cuts through points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.systems.isal_rotation.judge import CrossRangeCut
from torchsar.study.trials.batch import Result

# A target of fewer scatterers consists of points. Cuts through these show more than an enlarged
# picture.
_MANY = 20


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


def _images(result: Result) -> Drawn:
    along, across = result.first.trials.first("range_m", "cross_range_m")
    images = _in_metres(result)
    # more than the cross range of the target, so that the responses of points are visible
    reach = (1.15 if len(across) >= _MANY else 1.5) * float(across.abs().max())
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, (-reach, reach), plot.span(along, margin))
    caption = (
        "The first trial; 0 dB is the peak of the first image. Cross range is scaled by the rotation rate that the "
        "method itself estimates, or by the true mean rate if it estimates none. The sign of cross range cannot be "
        "determined from the data."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield "images", "Images by every method", caption, figure


def _end(result: Result, part: float = 0.2) -> Drawn:
    """Draw the end of the target with the outermost scatterer, as in Figs 5 to 9 of the source: the
    part `part` of its half width.
    """
    along, across = result.first.trials.first("range_m", "cross_range_m")
    if len(across) < _MANY:
        return
    reach, side = float(across.abs().max()), across[across.abs().argmax()].sign()
    near = side * across >= (1 - part) * reach
    images = _in_metres(result)
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, plot.span(across[near], 0.1 * part * reach), plot.span(along[near], margin))
    caption = (
        "The outermost part of the target. An error of the rotation rate moves the scatterers along cross range; "
        "errors of k1 and k2 blur them. 0 dB is the peak of the first image."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield "end", "One end of the target, enlarged", caption, figure


def _parts(images: Mapping[str, Signal], across: tuple[float, float], along: tuple[float, float]) -> dict[str, Signal]:
    """The part of every image between two cross ranges and two ranges, in metres."""
    return {name: plot.within(image, {"cross range": across, "range": along}) for name, image in images.items()}


def _slices(result: Result) -> Drawn:
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
        yield "slices", "Responses of point targets", caption, plot.panels(parts)


def _panels(target: str, cuts: Mapping[str, CrossRangeCut], beside: int = 4) -> list[dict[str, Any]]:
    """Panels of one target, over 25 widths of the response to either side.

    Each panel has the first method and an equal share of the others, at most `beside`.
    """
    first, *others = cuts
    top, width = (float(cuts[first].figures[key][0]) for key in ("peak", "irw_azimuth_m"))
    count = math.ceil(len(others) / beside) or 1
    parts = []
    for number in range(count):
        series = {}
        for name in [first, *others[number::count]]:
            offset, inside = cuts[name].offset_m[0], cuts[name].inside[0]
            kept = inside & (offset.abs() <= 25 * width)
            series[name] = (1e3 * plot.array(offset[kept]), plot.decibel(cuts[name].line[0][kept], top))
        labels = {"xlabel": "cross range from the true position (mm)", "ylabel": "level (dB)", "title": target}
        parts.append({"series": series, **labels, "ylim": (-50.0, 3.0)})
    return parts


DRAW_CASE = (_images, _end, _slices)
