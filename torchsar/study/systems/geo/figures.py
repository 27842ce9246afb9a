"""Figures of moving point targets: azimuth profiles, main lobes, contours and spectra."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Signal
from torchsar.metrics.cuts import about_peak, finer
from torchsar.study.output.report import Drawn
from torchsar.study.settings.sections import key_of
from torchsar.study.systems.geo.judge import PeakCuts
from torchsar.study.trials.batch import Result

# lowest drawn levels of profiles and of spectra
_LOW_DB, _SPECTRUM_DB = -90.0, -70.0


@dataclass(frozen=True)
class Shot:
    """One target, processed by one method, in the first trial.

    Args:
        image: Its image without noise.
        profile: Cut along azimuth through the peak, shape (azimuth,).
        along_m: Positions of the cut in metres on the axis x = (V_R - u_a) t, with the speeds along
            track V_R of the receiver and u_a of the target, shape (azimuth,).
        spectrum: Magnitude of the rebuilt spectrum over the Doppler frequency in Hz, which counts
            from the centre of the spectrum; root of the sum of powers over range.
    """

    image: Signal
    profile: Tensor
    along_m: Tensor
    spectrum: Signal


Shots = dict[str, dict[str, Shot]]


def shots(result: Result) -> Shots:
    """Return the image of every target by every method that makes images."""
    targets, truth, radar = list(result.bench.world().targets), result.first.trials.truth, result.bench.radar
    found: Shots = {}
    for name, outcome in result.first.outcomes.items():
        view = outcome.judged.view
        if outcome.failed or view.image is None:
            continue
        cuts = PeakCuts.of(view.image, radar.speed_m_s - truth["u_a_m_s"], radar.speed_m_s)
        number = torch.arange(view.image.axes[0].n, dtype=torch.float64)
        flat = view.spectrum.data.flatten(2) if "range" in view.spectrum.names else view.spectrum.data[..., None]
        spectra = flat.abs().square().sum(-1).sqrt()
        found[name] = {
            target: Shot(
                view.image.with_data(view.image.data[i]),
                cuts.azimuth[i],
                cuts.start_m[i] + cuts.step_m[i] * number,
                Signal(spectra[i].to(torch.complex64), view.spectrum.axes[:1]),
            )
            for i, target in enumerate(targets)
        }
    return found


def by_target(results: Mapping[str, Result]) -> dict[str, Any]:
    """Return the metrics of the methods, by case and target."""
    names = {(case, t): None for case, r in results.items() for of in r.targets.values() for t in of}
    rows = {}
    for case, target in names:
        found = {name: of[target] for name, of in results[case].targets.items() if target in of}
        rows[key_of(case, target)] = SimpleNamespace(metrics=found)
    return rows


def _pair(result: Result) -> Shots:
    """Images of the conventional and the recommended method, or of the first two methods if these
    are missing.
    """
    found = shots(result)
    chosen = [name for name in ("conventional", "recommended") if name in found] or list(found)[:2]
    return {name: found[name] for name in chosen}


def _panels(found: Shots, curve: Callable[[Shot], tuple[Any, Any]], xlabel: str, low: float) -> list[dict[str, Any]]:
    """Panels, one for each target, with a curve of levels in dB for each method."""
    return [
        {
            "title": target,
            "series": {name: curve(of[target]) for name, of in found.items()},
            "xlabel": xlabel,
            "ylabel": "level (dB)",
            "ylim": (low, 3.0),
        }
        for target in next(iter(found.values()), {})
    ]


def _profiles(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        return plot.array(shot.along_m), np.maximum(plot.decibel(shot.profile), _LOW_DB)

    radar = result.bench.radar
    replica_m = radar.prf_hz * radar.wavelength_m * radar.reference_range_m / radar.speed_m_s
    caption = (
        "Azimuth profiles through the peak of images without noise, in dB relative to their own peaks. False targets "
        f"lie at multiples of about {replica_m:.0f} m from the peak, one for each pulse rate; V_R is the speed of the "
        "receiver. Weak maxima between them, of targets with limited illumination, are ends of the Doppler band that "
        "lie outside of the rebuilt band."
    )
    figures = plot.panels(_panels(_pair(result), curve, "x = (V_R - u_a) t (m)", _LOW_DB))
    yield "profiles", "False targets", caption, figures


def _main_lobes(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        fine, first = finer(shot.profile, 8), int(shot.profile.abs().argmax())
        offset = float(shot.along_m[1] - shot.along_m[0]) * (np.arange(len(fine)) / 8 - first)
        near = np.abs(offset) <= 12.0
        return offset[near], plot.decibel(fine)[near]

    figures = plot.panels(_panels(shots(result), curve, "x from the peak (m)", -40.0))
    caption = "The same profiles about their peaks, for every method."
    yield "main_lobes", "Main lobes", caption, figures


def _contours(result: Result) -> Drawn:
    """Draw two-dimensional images around their peaks, if there are any."""
    found = _pair(result)
    images = {
        f"{target}, {name}": of[target].image for target in next(iter(found.values()), {}) for name, of in found.items()
    }
    cut = {title: _about_peak(image) for title, image in images.items() if "range" in image.names}
    if cut:
        caption = (
            "Interpolated images without noise about their peaks, range on the axis c tau / 2. Conventional images of "
            "moving targets are defocused and displaced."
        )
        yield "contours", "Contours", caption, plot.contours(cut)


def _about_peak(image: Signal) -> Signal:
    """Part of an image around its peak, +-6 m in azimuth and +-20 m in range on a grid of 161
    samples.

    The axes give offsets from the peak; those in range are halved.
    """
    part = about_peak(image, (6.0, 40.0), 161)
    range_ = part.axes[1]
    return Signal(part.data, (part.axes[0], replace(range_, start=range_.start / 2, step=range_.step / 2)))


def _spectra(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        return plot.array(shot.spectrum.axes[0].values()), np.maximum(plot.decibel(shot.spectrum.data), _SPECTRUM_DB)

    figures = plot.panels(_panels(_pair(result), curve, "Doppler from the centre (Hz)", _SPECTRUM_DB))
    caption = (
        "Rebuilt Doppler spectra of echoes without noise. Energy outside of the band of a target makes false ones."
    )
    yield "spectra", "Rebuilt spectra", caption, figures


DRAW_CASE = (_profiles, _main_lobes, _contours, _spectra)
