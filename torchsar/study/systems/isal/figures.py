"""Figures of the simulation of rotating targets: images of every case, and residual phases."""

from __future__ import annotations

import numpy as np
import torch

from torchsar import plot
from torchsar.metrics import residual_phase
from torchsar.metrics.image import rolled_to
from torchsar.study.output.pictures import Drawn, first_named
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.systems.isal.judge import whole_phase
from torchsar.study.trials.batch import Result

# residual phases with a smaller rms are drawn on a scale of their own
_NEAR_RAD = 0.3
# margin about the scatterers in images, in parts of their extent
_MARGIN = 0.15


def target(result: Result) -> Drawn:
    """Draw the scatterers of a simulated target."""
    truth = result.first.trials.truth
    if "cross_range_m" in truth:
        names = ("range_m", "cross_range_m", "amplitude")
        along, across, amplitude = (plot.array(truth[n].reshape(-1, truth[n].shape[-1])[0]) for n in names)
        caption = "Positions of the scatterers in the first trial. The area of a dot is proportional to the power."
        figure = plot.scatterers(along, across, np.abs(amplitude) ** 2, "range (m)", "cross range (m)")
        yield "target", "Target", caption, figure


def images(case: str, result: Result) -> Drawn:
    """Draw the images of all methods, the ideal one first."""
    shown = first_named(result.images)
    reference, first = next(iter(shown.items()))
    spans, truth = {}, result.first.trials.truth
    if "cross_range_m" in truth:
        for axis, name in (("azimuth", "cross_range_m"), ("range", "range_m")):
            at = truth[name].reshape(-1, truth[name].shape[-1])[0]
            spans[axis] = plot.span(at, _MARGIN * float(at.max() - at.min()))
    caption = (
        f"The first trial, in dB: 0.1 % of the samples of '{reference}' exceed 0 dB, the same level for all methods. "
        "Every image is shifted to the position of the first one, because autofocus leaves its position open."
    )
    rolled = {name: plot.within(rolled_to(image, first), spans) for name, image in shown.items()}
    figure = plot.images(rolled, dynamic_range_db=35.0)
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, figure


def phases(case: str, result: Result) -> Drawn:
    """Draw the true phase errors and the residual phases, small ones in a panel of their own."""
    true = whole_phase(result.first.trials)[0].cpu()
    pulses = np.arange(true.numel())
    inside = torch.remainder(true + torch.pi, 2 * torch.pi) - torch.pi
    found = {name: outcome.judged.view for name, outcome in result.first.outcomes.items() if not outcome.failed}
    left = {n: residual_phase(phase[0].cpu(), true) for n, phase in found.items() if n not in ("none", "ideal")}
    parts = [_panel("true phase error, wrapped", {"true": (pulses, plot.array(inside))})]
    for title, near in ((f"residual phase below {_NEAR_RAD} rad rms", True), ("residual phase, other methods", False)):
        kept = {n: x for n, x in left.items() if (float(x.square().mean().sqrt()) < _NEAR_RAD) == near}
        if kept:
            named = title if len(kept) > 1 else f"{title}: {next(iter(kept))}"
            parts.append(_panel(named, {name: (pulses, plot.array(x)) for name, x in kept.items()}))
    caption = (
        "The phase error of every pulse in the first trial, and estimate minus truth by method, without a constant and "
        "a linear phase, which do not change the focus. All phases are wrapped to the interval from -pi to pi."
    )
    yield f"phases_{word_of(case)}", titled("Phase errors", case), caption, plot.panels(parts)


def _panel(title: str, series: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, object]:
    return {"series": series, "xlabel": "pulse", "ylabel": "phase (rad)", "title": title}
