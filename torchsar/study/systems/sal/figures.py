"""The pictures of a run of a ladar: range profiles, images, the motion and what is left of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.metrics.cuts import impulse_cuts
from torchsar.metrics.radial_motion import Course, finer_in_range
from torchsar.study.output.pictures import Drawn, comparisons, first_named
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.trials.batch import Result, image_of

# about the scatterers pictures show so many samples in azimuth and cells in range, and this part of
# the extent of the scene
_SAMPLES, _CELLS, _PART = 24, 6, 0.1
# level below which images show nothing: side lobes of responses without a window lie above it
_LOW_DB = 30.0
Lines = Mapping[str, tuple[Axis, Tensor]]


def pictures(results: Mapping[str, Result], columns: Mapping[str, Any]) -> Iterator[Callable[[], Drawn]]:
    """Makers of all pictures."""
    yield partial(_target, next(iter(results.values())))
    yield partial(comparisons, results, columns)
    for case, result in results.items():
        for make in (_profiles, _images, _motion, _slices):
            yield partial(make, case, result)


def _scatterers(result: Result) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth, relative range (m) and amplitude in the first trial."""
    truth = result.first.trials.truth
    values = (truth[name] for name in ("azimuth_m", "range_m", "amplitude"))
    azimuth, range_m, amplitude = (x.reshape(-1, x.shape[-1])[0].cpu() for x in values)
    return azimuth, range_m, amplitude


def _courses(result: Result) -> dict[str, Course]:
    """What methods found of the motion in the first trial."""
    views = {name: outcome.judged.view for name, outcome in result.first.outcomes.items() if not outcome.failed}
    return {name: view.first() for name, view in views.items()}


def _target(result: Result) -> Drawn:
    along, range_, amplitude = (plot.array(x) for x in _scatterers(result))
    caption = "Scatterers of the first scene, ranges relative to the reference; the area of a point is its power."
    figure = plot.places(range_, along, np.abs(amplitude) ** 2, "relative range (m)", "azimuth (m)")
    yield "target", "Target", caption, figure


def _about_scene(signal: Signal, result: Result) -> Signal:
    """The part of an image or of profiles about the scatterers, and where residual motion shifts
    them: in range by its velocity, in azimuth by its slope, if the image is in focus.
    """
    azimuth, range_m, _ = _scatterers(result)
    focused = [
        c for c in _courses(result).values() if float(c.rms(c.detrended_m)) < result.bench.radar.wavelength_m / 8
    ]
    slopes = torch.stack([c.slope_m_s.cpu().reshape(()) for c in focused]) if focused else torch.zeros(1).to(azimuth)
    far = (result.bench.radar.reference_range_m + range_m) / max(result.bench.radar.speed_m_s, 1e-30)
    azimuth = torch.cat([azimuth, (azimuth + slopes[:, None] * far).flatten()])
    radar, velocity = result.bench.radar, result.first.trials.truth["velocity_m_s"]
    shift = velocity[:1].cpu() * radar.carrier_hz / radar.chirp_rate_hz_s
    shifted = torch.cat([range_m + shift.min().clamp(max=0.0), range_m + shift.max().clamp(min=0.0)])
    along = _SAMPLES * signal.axes[0].step + _PART * float(azimuth.max() - azimuth.min())
    across = _CELLS * radar.range_step_m + _PART * float(range_m.max() - range_m.min())
    return plot.within(signal, {"azimuth": plot.span(azimuth, along), "range": plot.span(shifted, across)})


def _profiles(case: str, result: Result) -> Drawn:
    found: dict[str, Signal] = {}
    for name, outcome in result.first.outcomes.items():
        outputs = {} if outcome.trace is None else outcome.trace.outputs
        signal = next((image_of(s) for s in outputs.values() if s.names == ("pulse", "range")), None)
        known = [s for s in found.values() if signal is not None and s.data.shape == signal.data.shape]
        if signal is not None and not any(torch.equal(s.data, signal.data) for s in known):
            found[name] = signal
    shown = {name: _in_milliseconds(_about_scene(s, result)) for name, s in first_named(found).items()}
    if shown:
        caption = (
            "Range profiles of the up sweeps of the first trial, of methods that differ before any correction of pulse "
            "phases, in dB of the peak of the first panel. Motion shifts the beat frequency by 2 v / lambda."
        )
        figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
        yield f"profiles_{word_of(case)}", titled("Range profiles over slow time", case), caption, figure


def _in_milliseconds(signal: Signal) -> Signal:
    pulse = signal.axes[0]
    return Signal(signal.data, (Axis("slow time", pulse.n, 1e3 * pulse.start, 1e3 * pulse.step, "ms"), signal.axes[1]))


def _images(case: str, result: Result) -> Drawn:
    finer = {name: finer_in_range(finer_in_range(image)) for name, image in first_named(result.images).items()}
    shown = {name: _about_scene(image, result) for name, image in finer.items()}
    caption = (
        "The first trial on a quarter of the range step; all images on one scale, that of the first, in dB. A slope of "
        "the range error shifts an image along azimuth, which is no error of focus."
    )
    figure = plot.images(shown, dynamic_range_db=_LOW_DB, percentile=100)
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, figure


def _motion(case: str, result: Result) -> Drawn:
    """Velocity, its error, and the range error that is left; methods of like size together."""
    courses = {name: course for name, course in _courses(result).items() if name != "ideal"}
    estimating = {name: course for name, course in courses.items() if course.velocity_m_s is not None}
    if not estimating:
        return
    pulse, true = next(iter(estimating.values())).pulse, result.first.trials.truth["velocity_m_s"]
    order = sorted(estimating, key=lambda name: -float(_rms(estimating[name])))
    worst = {n: (estimating[n].pulse, _lit_only(estimating[n], estimating[n].velocity_m_s)) for n in order[:2]}
    parts = [
        _panel("radial velocity", "m/s", {"true": (pulse, true.reshape(-1, true.shape[-1])[0][: pulse.n]), **worst})
    ]
    errors = {n: (c.pulse, 1e3 * _lit_only(c, c.velocity_error_m_s)) for n, c in estimating.items()}
    parts += _by_size("estimated minus true velocity", "mm/s", errors)
    left = {name: (c.pulse, 1e6 * _lit_only(c, c.detrended_m)) for name, c in courses.items()}
    parts += _by_size("range error left", "um", left)
    quarter = 1e6 * result.bench.radar.wavelength_m / 4
    caption = (
        "Estimates of the first trial against the truth, methods of like error together; periods without a lit "
        "scatterer are left out. Range errors without constant and slope, which only turn and shift the image. A "
        f"quarter of the wavelength is {quarter:.2g} um."
    )
    yield f"motion_{word_of(case)}", titled("Motion and what is left of it", case), caption, plot.panels(parts)


def _rms(course: Course) -> Tensor:
    assert course.velocity_error_m_s is not None
    return course.rms(course.velocity_error_m_s)


def _lit_only(course: Course, x: Tensor | None) -> Tensor:
    assert x is not None
    return torch.where(course.lit, x, torch.nan)


def _panel(title: str, unit: str, lines: Lines) -> dict[str, object]:
    series = {name: (1e3 * plot.array(axis.values()), plot.array(y)) for name, (axis, y) in lines.items()}
    return {
        "series": series,
        "xlabel": "slow time (ms)",
        "ylabel": f"{title.partition(':')[0]} ({unit})",
        "title": title,
    }


def _by_size(title: str, unit: str, lines: Lines) -> list[dict[str, object]]:
    """Panels of methods whose largest values are alike, the smallest first."""
    groups = plot.alike(lines)
    return [_panel(title if len(group) > 1 else f"{title}: {next(iter(group))}", unit, group) for group in groups]


def _slices(case: str, result: Result) -> Drawn:
    """Cuts through the response of metrics.target, four methods a panel beside the ideal."""
    target, images = result.bench.judging.target, result.images
    figures = {n: o.judged.targets[target] for n, o in result.first.outcomes.items() if target in o.judged.targets}
    at = {n: [float(f[f"position_{axis}_m"][0]) for axis in ("azimuth", "range")] for n, f in figures.items()}
    cuts = {name: impulse_cuts(images[name], (where[0], where[1])) for name, where in at.items()}
    left = {name: float(result.metrics[name]["residual_phase_rms_rad"][0]) for name in cuts if name != "ideal"}
    others, parts = sorted(left, key=lambda name: left[name]), []
    for first in range(0, len(others), 4):
        names = [*(["ideal"] if "ideal" in cuts else []), *others[first : first + 4]]
        for axis in ("azimuth", "range"):
            series = {n: (plot.array(cuts[n][axis][0]), plot.decibel(plot.array(cuts[n][axis][1]))) for n in names}
            shown = {"xlabel": f"{axis} from the peak (m)", "ylabel": "level (dB)", "title": axis, "ylim": (-40.0, 2.0)}
            parts.append({"series": series, **shown})
    if parts:
        caption = (
            "Slices through the strongest response near the predicted one, over ten side lobes to either side; 0 dB is "
            "each curve's own peak. Methods by what they leave of the motion, the best first."
        )
        yield f"slices_{word_of(case)}", titled(f"Response of {target}", case), caption, plot.panels(parts)
