"""The pictures of a run: images of every case, and what is left of the phase errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Signal
from torchsar.metrics import residual_phase
from torchsar.study.cases import word_of
from torchsar.study.pictures import Drawn, Picture, draw_all

_NEAR_RAD = 0.3
_COMPARED = {
    "entropy_above_ideal_nats": "entropy above the ideal image (nats)",
    "agreement_rad": "influence of the injected phases (rad)",
    "residual_phase_rms_rad": "residual phase (rad rms)",
}


@dataclass(frozen=True)
class CaseResult:
    """One case: metrics by method (trial,), and of the first trial images, phases estimated and
    true (pulse,), and the target: range and cross range (m) and amplitude of its scatterers, where
    it was simulated.
    """

    metrics: Mapping[str, Mapping[str, Tensor]]
    images: Mapping[str, Signal]
    phases: Mapping[str, Tensor]
    true_rad: Tensor
    target: tuple[Tensor, Tensor, Tensor] | None = None

    def truths(self) -> dict[str, Tensor]:
        return {"phase_rad": self.true_rad}

    def estimates(self) -> dict[str, dict[str, Tensor]]:
        return {name: {"phase_rad": phase} for name, phase in self.phases.items()}


def draw(results: Mapping[str, CaseResult], folder: Path) -> list[Picture]:
    """Every picture of a run, as PNG files in the folder, in the order of reading."""
    by_case = [partial(make, case, result) for case, result in results.items() for make in (_images, _phases)]
    return draw_all([partial(_target, next(iter(results.values()))), partial(_entropies, results), *by_case], folder)


def _target(result: CaseResult) -> Drawn:
    if result.target is not None:
        along, across, amplitude = (plot.array(v) for v in result.target)
        yield (
            "target",
            "Target",
            "Scatterers of the first scene; the area of a point is its power.",
            plot.places(along, across, np.abs(amplitude) ** 2, "range (m)", "cross range (m)"),
        )


def _entropies(results: Mapping[str, CaseResult]) -> Drawn:
    """Entropy above the ideal image (or above the method's own result without injected phases) by
    method and case.
    """
    for key, label in _COMPARED.items():
        methods = [
            name
            for name in next(iter(results.values())).metrics
            if name != "ideal" and any(key in result.metrics[name] for result in results.values())
        ]
        if not methods:
            continue
        x = list(results)
        means = {name: np.array([_mean(result.metrics[name], key) for result in results.values()]) for name in methods}
        parts = [
            {
                "title": "",
                "x": x,
                "series": {name: (y, np.stack([y, y], -1)) for name, y in means.items()},
                "bounds": {},
            }
        ]
        yield (
            key,
            label.split(" (")[0].capitalize(),
            f"Mean over trials of the {label}, by case and method.",
            plot.error_curves(parts, "case", label),
        )


def _mean(metrics: Mapping[str, Tensor], key: str) -> float:
    return float(metrics[key].mean()) if key in metrics else float("nan")


def _images(case: str, result: CaseResult) -> Drawn:
    title = "Images by every method" if case == "all" else f"Images by every method: {case}"
    reference = "ideal" if "ideal" in result.images else next(iter(result.images))
    shown = {
        reference: result.images[reference],
        **{name: image for name, image in result.images.items() if name != reference},
    }
    caption = (
        f"The first trial; all images on one scale, that of '{reference}', in dB. They are "
        "rolled along cross range to where that one lies, which is a matter of the phase's "
        "slope."
    )
    yield (
        f"images_{word_of(case)}",
        title,
        caption,
        plot.images(
            {name: _placed_as(image, shown[reference]) for name, image in shown.items()},
            dynamic_range_db=35.0,
            columns=3,
        ),
    )


def _phases(case: str, result: CaseResult) -> Drawn:
    pulses = np.arange(result.true_rad.numel())
    inside = torch.remainder(result.true_rad + torch.pi, 2 * torch.pi) - torch.pi
    left = {
        name: residual_phase(phase, result.true_rad)
        for name, phase in result.phases.items()
        if name not in ("none", "ideal")
    }
    parts = [
        {
            "series": {"true": (pulses, plot.array(inside))},
            "xlabel": "pulse",
            "ylabel": "rad",
            "title": "phase error put in, modulo a turn",
        }
    ]
    for title, near in (("what the best methods leave of it", True), ("what the others leave", False)):
        series = {
            name: (pulses, plot.array(phase))
            for name, phase in left.items()
            if (float(phase.square().mean().sqrt()) < _NEAR_RAD) == near
        }
        if series:
            parts.append({"series": series, "xlabel": "pulse", "ylabel": "rad", "title": title})
    title = "Phase errors" if case == "all" else f"Phase errors: {case}"
    yield (
        f"phases_{word_of(case)}",
        title,
        "Constant and linear terms are removed on the circle: they only turn and shift the image.",
        plot.panels(parts, columns=3),
    )


def _placed_as(image: Signal, reference: Signal) -> Signal:
    """The image rolled along cross range so that the centre of its energy lies where that of the
    reference does.
    """
    n = image.axes[0].n
    return image.with_data(image.data.roll(round((_centre(reference) - _centre(image)) * n), 0))


def _centre(image: Signal) -> float:
    """Circular centre of the energy along cross range, in parts of the image's height."""
    n = image.axes[0].n
    power = image.data.abs().double().square().sum(-1)
    return float(torch.angle(torch.polar(power, 2 * torch.pi * torch.arange(n, dtype=torch.float64) / n).sum())) / (
        2 * torch.pi
    )
