"""Figures of the ladar simulation: range profiles, images, motion, and impulse responses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.metrics.cuts import impulse_cuts
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.systems.sal.judge import Course, finer_in_range
from torchsar.study.trials.batch import Result, image_of

# dynamic range of images and profiles, in which images out of focus are visible beside sharp ones
_RANGE_DB = 40.0
Lines = Mapping[str, tuple[Axis, Tensor]]


def _courses(result: Result) -> dict[str, Course]:
    """Estimated and remaining motion of every method in the first trial."""
    outcomes = result.first.outcomes
    return {name: outcome.judged.view.first() for name, outcome in outcomes.items() if not outcome.failed}


def target(result: Result) -> Drawn:
    along, range_, amplitude = map(plot.array, result.first.trials.first("azimuth_m", "range_m", "amplitude"))
    caption = (
        "Scatterers of the first trial; the area of a point is proportional to its amplitude. The axes differ in scale."
    )
    figure = plot.scatterers(range_, along, np.abs(amplitude), "range (m)", "azimuth (m)", aspect="auto")
    yield "target", "Target", caption, figure


def _about_scene(signal: Signal, result: Result) -> Signal:
    """Part of an image or of profiles around the scatterers.

    It allows for shifts by residual motion: in range by its velocity, and in azimuth by its slope,
    if the image is in focus.
    """
    azimuth, range_m = result.first.trials.first("azimuth_m", "range_m")
    radar = result.bench.radar
    focused = [c for c in _courses(result).values() if float(c.rms(c.detrended_m)) < radar.wavelength_m / 8]
    slopes = torch.stack([c.slope_m_s.cpu().reshape(()) for c in focused]) if focused else torch.zeros(1).to(azimuth)
    far = (radar.reference_range_m + range_m) / max(radar.speed_m_s, 1e-30)
    azimuth = torch.cat([azimuth, (azimuth + slopes[:, None] * far).flatten()])
    velocity = result.first.trials.truth["velocity_m_s"]
    shift = velocity[:1].cpu() * radar.carrier_hz / radar.chirp_rate_hz_s
    shifted = torch.cat([range_m + shift.min().clamp(max=0.0), range_m + shift.max().clamp(min=0.0)])
    # margins of 24 samples in azimuth, of 6 cells in range, and of a tenth of the extent of the
    # scene
    return plot.within(
        signal,
        {
            "azimuth": plot.span(azimuth, 24 * signal.axes[0].step + 0.1 * float(np.ptp(azimuth.numpy()))),
            "range": plot.span(shifted, 6 * radar.range_step_m + 0.1 * float(np.ptp(range_m.numpy()))),
        },
    )


def _profiles(result: Result) -> Drawn:
    found: dict[str, Signal] = {}
    for name, outcome in result.first.outcomes.items():
        outputs = {} if outcome.trace is None else outcome.trace.outputs
        signal = next((image_of(s) for s in outputs.values() if s.names == ("pulse", "range")), None)
        if signal is not None and not any(_look_alike(s.data, signal.data) for s in found.values()):
            found[name] = signal
    shown = {name: in_milliseconds(_about_scene(s, result)) for name, s in first_named(found).items()}
    if shown:
        caption = (
            "Range profiles of the up sweeps of the first trial, in dB relative to the peak of the first panel. Of "
            "methods whose profiles look alike the first is shown. A radial velocity v shifts the beat frequency by "
            "2 v / lambda, and thus the range."
        )
        figure = plot.images(shown, dynamic_range_db=_RANGE_DB, percentile=100)
        yield "profiles", "Range profiles over slow time", caption, figure


def _look_alike(one: Tensor, other: Tensor) -> bool:
    limit = 10 ** (-_RANGE_DB / 20) * float(one.abs().max())
    return one.shape == other.shape and torch.allclose(one.abs(), other.abs(), rtol=0.0, atol=limit)


def in_milliseconds(signal: Signal) -> Signal:
    """Return range profiles (pulse, range) with slow time in milliseconds."""
    pulse = signal.axes[0]
    return Signal(signal.data, (Axis("slow time", pulse.n, 1e3 * pulse.start, 1e3 * pulse.step, "ms"), signal.axes[1]))


def _images(result: Result) -> Drawn:
    finer = {name: finer_in_range(finer_in_range(image)) for name, image in first_named(result.images).items()}
    cut = {name: _about_scene(image, result) for name, image in finer.items()}
    top = float(next(iter(cut.values())).data.abs().max())
    shown = {f"{n}, peak {round(float(plot.decibel(s.data.abs().max(), top)))} dB": s for n, s in cut.items()}
    caption = (
        "Images of the first trial, interpolated to a quarter of the range step, in dB relative to the peak of the "
        "first image. The titles give the peak of each image: out of focus it is low, and the image is dark. A "
        "constant slope of the range error shifts an image along azimuth without loss of focus."
    )
    figure = plot.images(shown, dynamic_range_db=_RANGE_DB, percentile=100)
    yield "images", "Images by every method", caption, figure


def _motion(result: Result) -> Drawn:
    """Draw velocity, its error, and the remaining range error. Errors of similar size have a common
    panel.
    """
    courses = {name: course for name, course in _courses(result).items() if name != "ideal"}
    estimating = {name: course for name, course in courses.items() if course.velocity_m_s is not None}
    if not estimating:
        return
    pulse, true = next(iter(estimating.values())).pulse, result.first.trials.truth["velocity_m_s"]
    errors = {n: (c.pulse, 1e3 * _lit_only(c, c.velocity_error_m_s)) for n, c in estimating.items()}
    order = sorted(errors, key=lambda name: -float(errors[name][1].square().nanmean()))
    worst = {n: (estimating[n].pulse, _lit_only(estimating[n], estimating[n].velocity_m_s)) for n in order[:2]}
    parts = [
        _panel("radial velocity", "m/s", {"true": (pulse, true.reshape(-1, true.shape[-1])[0][: pulse.n]), **worst})
    ]
    parts += _by_size("estimated minus true velocity", "mm/s", errors)
    left = {name: (c.pulse, 1e6 * _lit_only(c, c.detrended_m)) for name, c in courses.items()}
    parts += _by_size("remaining range error", "um", left)
    caption = (
        "First trial: the radial velocity, true and by the two least accurate methods; errors of the estimated "
        "velocity; range errors after compensation. Methods with errors of similar size share a panel. Periods in "
        "which no scatterer is illuminated are left out, and so are constant and slope of range errors, which affect "
        "only the phase and the position of an image. A quarter of the wavelength is "
        f"{1e6 * result.bench.radar.wavelength_m / 4:.2g} um."
    )
    yield "motion", "Radial motion and its errors", caption, plot.panels(parts)


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
    """Panels of methods whose largest values are of similar size, the smallest first."""
    groups = plot.alike(lines)
    return [_panel(title if len(group) > 1 else f"{title}: {next(iter(group))}", unit, group) for group in groups]


def _slices(result: Result) -> Drawn:
    """Draw cuts through the response of metrics.target. A panel contains four methods and the ideal
    one.
    """
    target, images = result.bench.judging.target, result.images
    figures = {n: o.judged.targets[target] for n, o in result.first.outcomes.items() if target in o.judged.targets}
    at = {n: [float(f[f"position_{axis}_m"][0]) for axis in ("azimuth", "range")] for n, f in figures.items()}
    cuts = {name: impulse_cuts(images[name], (where[0], where[1])) for name, where in at.items()}
    left = {name: float(result.metrics[name]["residual_phase_rms_rad"][0]) for name in cuts if name != "ideal"}
    others, parts = sorted(left, key=lambda name: left[name]), []
    for first in range(0, len(others), 4):
        names = [*(["ideal"] if "ideal" in cuts else []), *others[first : first + 4]]
        for axis in ("azimuth", "range"):
            reach = float(cuts[names[0]][axis][0].abs().max())
            series = {n: _within(reach, *cuts[n][axis]) for n in names}
            label = f"{axis} from the response (m)"
            parts.append(
                {"series": series, "xlabel": label, "ylabel": "level (dB)", "title": axis, "ylim": (-40.0, 2.0)}
            )
    if parts:
        caption = (
            "Azimuth and range cuts through the strongest response near the predicted position, with ten side lobes on "
            "either side, in dB relative to the peak of each curve. Methods are sorted by the remaining motion, the "
            "best first; where much of it remains there is no distinct response."
        )
        yield "slices", f"Response of {target}", caption, plot.panels(parts)


def _within(reach: float, offset_m: Tensor, response: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Part of a cut within `reach`, which all cuts of the panel cover, in dB."""
    near = offset_m.abs() <= reach
    return plot.array(offset_m[near]), plot.decibel(response[near])


DRAW_CASE = (_images, _profiles, _motion, _slices)
