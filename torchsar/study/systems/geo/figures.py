"""The pictures of a run of moving points: profiles with false targets, main lobes, images, spectra."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.metrics.moving_point import PeakCuts
from torchsar.study.output.pictures import Drawn, comparisons
from torchsar.study.settings.cases import key_of, titled, word_of
from torchsar.study.trials.batch import Result

# what is shown of profiles: metres about the peak, and the lowest levels
_NEAR_M, _LOW_DB, _SPECTRUM_DB = 12.0, -90.0, -70.0
# half extents of contour plots in azimuth and range, and their samples
_ALONG_M, _ACROSS_M, _SAMPLES = 6.0, 20.0, 161
_FINER = 8


@dataclass(frozen=True)
class Shot:
    """One target by one method in the first trial.

    Args:
        image: Its image without noise.
        profile: Cut along azimuth through the peak.
        along_m: Positions of the cut on x = (V_R - u_a) t of the target.
        spectrum: Rebuilt spectrum over Doppler from its centre.
    """

    image: Signal
    profile: Tensor
    along_m: Tensor
    spectrum: Signal


def shots(result: Result) -> dict[str, dict[str, Shot]]:
    """Every target by every method that makes images."""
    targets, truth, radar = list(result.bench.world().targets), result.first.trials.truth, result.bench.radar
    found: dict[str, dict[str, Shot]] = {}
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


def pictures(results: Mapping[str, Result], columns: Mapping[str, Any]) -> Iterator[Callable[[], Drawn]]:
    """Makers of all pictures."""
    yield partial(comparisons, by_target(results), columns)
    for case, result in results.items():
        for make in (_profiles, _main_lobes, _contours, _spectra):
            yield partial(make, case, result)


def by_target(results: Mapping[str, Result]) -> dict[str, Any]:
    """Figures of the methods, by case and target."""
    names = {(case, t): None for case, r in results.items() for of in r.targets.values() for t in of}
    rows = {}
    for case, target in names:
        found = {name: of[target] for name, of in results[case].targets.items() if target in of}
        rows[key_of(case, target)] = SimpleNamespace(metrics=found)
    return rows


def _pair(result: Result) -> dict[str, dict[str, Shot]]:
    """The conventional method beside the recommended one, or what there is of them."""
    found = shots(result)
    chosen = [name for name in ("conventional", "recommended") if name in found] or list(found)[:2]
    return {name: found[name] for name in chosen}


def _targets(found: Mapping[str, Mapping[str, Shot]]) -> Sequence[str]:
    return list(next(iter(found.values()), {}))


def _panel(title: str, xlabel: str, series: Mapping[str, Any], low: float) -> dict[str, Any]:
    return {"series": series, "xlabel": xlabel, "ylabel": "dB", "title": title, "ylim": (low, 3.0)}


def _profiles(case: str, result: Result) -> Drawn:
    found, parts = _pair(result), []
    for target in _targets(found):
        series = {}
        for name, of in found.items():
            level = plot.decibel(of[target].profile, float(of[target].profile.abs().max()))
            series[name] = (plot.array(of[target].along_m), np.maximum(level, _LOW_DB))
        parts.append(_panel(target, "x = (V_R - u_a) t (m)", series, _LOW_DB))
    if parts:
        caption = (
            "Azimuth profiles through the peak of images without noise, each in dB of its own peak. False targets lie "
        )
        caption += (
            "about 720 m a pulse rate from it at the parameters of the source; the humps near 1330 m of a target cut "
        )
        caption += "by a gate are tails of its band, beyond the rebuilt one, folded back from the ends of the gate."
        yield f"profiles_{word_of(case)}", titled("False targets", case), caption, plot.panels(parts, columns=2)


def _main_lobes(case: str, result: Result) -> Drawn:
    found, parts = shots(result), []
    for target in _targets(found):
        series = {}
        for name, of in found.items():
            shot = of[target]
            peak = float(shot.along_m[int(shot.profile.abs().argmax())])
            offset, level = _finer(shot)
            near = np.abs(offset - peak) <= _NEAR_M
            series[name] = (offset[near] - peak, level[near])
        parts.append(_panel(target, "x from the peak (m)", series, -40.0))
    if parts:
        caption = "The same profiles about their peaks, by every method."
        yield f"main_lobes_{word_of(case)}", titled("Main lobes", case), caption, plot.panels(parts, columns=2)


def _finer(shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """The profile eight times as finely sampled, dB of its peak."""
    n = len(shot.profile)
    spectrum = torch.fft.fftshift(torch.fft.fft(shot.profile.to(torch.complex128)))
    before = (_FINER * n) // 2 - n // 2
    wide = torch.nn.functional.pad(spectrum, (before, (_FINER - 1) * n - before))
    fine, step = torch.fft.ifft(torch.fft.ifftshift(wide)), float(shot.along_m[1] - shot.along_m[0]) / _FINER
    return float(shot.along_m[0]) + step * np.arange(len(fine)), plot.decibel(fine)


def _contours(case: str, result: Result) -> Drawn:
    """About the peaks of two-dimensional images."""
    found = _pair(result)
    images = {f"{target}, {name}": of[target].image for target in _targets(found) for name, of in found.items()}
    cut = {title: _about_peak(image) for title, image in images.items() if "range" in image.names}
    if cut:
        caption = (
            "About the peak of images without noise, range on the axis c tau / 2; interpolated. Conventional images of "
        )
        caption += "fast targets are defocused and lie elsewhere."
        yield f"contours_{word_of(case)}", titled("Contours", case), caption, plot.contours(cut, columns=4)


def _about_peak(image: Signal) -> Signal:
    """The part about the peak, on a finer grid; offsets from the peak, range halved."""
    azimuth, across = image.axes
    row, line = divmod(int(image.data.abs().argmax()), across.n)
    kernels, axes = [], []
    halves = ((azimuth, row, _ALONG_M, 1.0), (across, line, 2 * _ACROSS_M, 0.5))
    for axis, peak, reach, scale in halves:
        offset = torch.linspace(-reach, reach, _SAMPLES, dtype=torch.float64)
        places = peak + offset / axis.step
        kernels.append(torch.sinc(places[:, None] - torch.arange(axis.n, dtype=torch.float64)).to(torch.complex128))
        axes.append(Axis(axis.name, _SAMPLES, -reach * scale, 2 * reach * scale / (_SAMPLES - 1), "m"))
    return Signal(kernels[0] @ image.data.to(torch.complex128) @ kernels[1].mT, tuple(axes))


def _spectra(case: str, result: Result) -> Drawn:
    found, parts = _pair(result), []
    for target in _targets(found):
        series = {}
        for name, of in found.items():
            spectrum = of[target].spectrum
            level = np.maximum(plot.decibel(spectrum.data), _SPECTRUM_DB)
            series[name] = (plot.array(spectrum.axes[0].values()), level)
        parts.append(_panel(target, "Doppler from the centre (Hz)", series, _SPECTRUM_DB))
    if parts:
        caption = "Rebuilt Doppler spectra of echoes without noise. Energy out of its band makes false targets."
        yield f"spectra_{word_of(case)}", titled("Rebuilt spectra", case), caption, plot.panels(parts, columns=2)
