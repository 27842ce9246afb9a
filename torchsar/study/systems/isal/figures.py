"""The pictures of a run of turning targets: images of every case, and what is left of the phases."""

from __future__ import annotations

import numpy as np
import torch

from torchsar import plot
from torchsar.core import Signal
from torchsar.metrics import residual_phase
from torchsar.study.output.pictures import Drawn
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.systems.isal.judge import whole_phase
from torchsar.study.trials.batch import Result

# methods with less than this are drawn on a scale of their own
_NEAR_RAD = 0.3


def target(result: Result) -> Drawn:
    """The scatterers, where they were simulated."""
    truth = result.first.trials.truth
    if "cross_range_m" in truth:
        names = ("range_m", "cross_range_m", "amplitude")
        along, across, amplitude = (plot.array(truth[n].reshape(-1, truth[n].shape[-1])[0]) for n in names)
        caption = "Scatterers of the first scene; the area of a point is its power."
        figure = plot.places(along, across, np.abs(amplitude) ** 2, "range (m)", "cross range (m)")
        yield "target", "Target", caption, figure


def images(case: str, result: Result) -> Drawn:
    """Images of all methods, the ideal one first."""
    shown = first_ideal(result.images)
    reference, first = next(iter(shown.items()))
    caption = (
        f"The first trial; all images on one scale, that of '{reference}', in dB. They are rolled along cross range to "
    )
    caption += "where that one lies, which is a matter of the phase's slope."
    rolled = {name: _rolled_to(image, first) for name, image in shown.items()}
    figure = plot.images(rolled, dynamic_range_db=35.0, columns=3)
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, figure


def first_ideal(images: dict[str, Signal]) -> dict[str, Signal]:
    """Images with that of the method `ideal` in front, where there is one."""
    first = "ideal" if "ideal" in images else next(iter(images))
    return {first: images[first], **{name: image for name, image in images.items() if name != first}}


def phases(case: str, result: Result) -> Drawn:
    """The phase errors, and what methods leave of them, those with small errors apart."""
    true = whole_phase(result.first.trials)[0].cpu()
    pulses = np.arange(true.numel())
    inside = torch.remainder(true + torch.pi, 2 * torch.pi) - torch.pi
    found = {name: outcome.judged.view for name, outcome in result.first.outcomes.items() if not outcome.failed}
    left = {n: residual_phase(phase[0].cpu(), true) for n, phase in found.items() if n not in ("none", "ideal")}
    parts = [_panel("phase error put in, modulo a turn", {"true": (pulses, plot.array(inside))})]
    for title, near in (("what the best methods leave of it", True), ("what the others leave", False)):
        kept = {n: x for n, x in left.items() if (float(x.square().mean().sqrt()) < _NEAR_RAD) == near}
        if kept:
            parts.append(_panel(title, {name: (pulses, plot.array(x)) for name, x in kept.items()}))
    caption = "Constant and linear terms are removed on the circle: they only turn and shift the image."
    yield f"phases_{word_of(case)}", titled("Phase errors", case), caption, plot.panels(parts, columns=3)


def _panel(title: str, series: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, object]:
    return {"series": series, "xlabel": "pulse", "ylabel": "rad", "title": title}


def _rolled_to(image: Signal, reference: Signal) -> Signal:
    """The image rolled along cross range until the centre of its energy is the reference's."""
    shift = round((_centre(reference) - _centre(image)) * image.axes[0].n)
    return image.with_data(image.data.roll(shift, 0))


def _centre(image: Signal) -> float:
    """Circular centre of the energy along cross range, in parts of the image's height."""
    n, power = image.axes[0].n, image.data.abs().double().square().sum(-1)
    turns = torch.arange(n, dtype=torch.float64, device=power.device) / n
    return float(torch.angle(torch.polar(power, 2 * torch.pi * turns).sum())) / (2 * torch.pi)
