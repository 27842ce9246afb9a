"""Estimates of the radial motion of a triangular-sweep ladar compared with the truth.

Figures of the ladar simulation: range profiles, images, motion, and impulse responses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate.radial.trajectory import integrated_range
from torchsar.core import Axis, Chain, Signal, Trace, unit_phasor
from torchsar.metrics import impulse_response
from torchsar.metrics.cuts import impulse_cuts
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.radar.ladar import leading
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.trials.batch import Result, image_of, last_values, used_values

SWEEPS = ("ramp", "pulse", "fast_time")


@dataclass(frozen=True)
class Course:
    """The radial motion that a processing chain estimated, compared with the true motion.

    Args:
        pulse: Slow-time axis: starts of the sweep periods.
        velocity_m_s: Estimated velocity at the turning points of the sweeps, (..., pulse), receding
            positive; None where the chain estimates none.
        velocity_error_m_s: Estimated minus true velocity, (..., pulse); None where the chain
            estimates none.
        error_m: Estimated minus true change of range at the middles of the up sweeps in metres,
            (..., pulse).
        coarse_m: The same error if only the velocities are used and not the phases that the chain
            estimated for single pulses.
        lit: Periods in which the beam illuminates one of the strongest scatterers, bool (...,
            pulse).
    """

    pulse: Axis
    velocity_m_s: Tensor | None
    velocity_error_m_s: Tensor | None
    error_m: Tensor
    coarse_m: Tensor
    lit: Tensor

    @property
    def detrended_m(self) -> Tensor:
        """Range error in metres without its constant and slope, (..., pulse), zero where the beam
        illuminates none of the strongest scatterers.
        """
        mean, slope, k = self._line(self.error_m)
        return torch.where(self.lit, self.error_m - mean[..., None] - slope[..., None] * k, 0)

    @property
    def slope_m_s(self) -> Tensor:
        """Slope of the range error over slow time in m/s, (...,)."""
        return self._line(self.error_m)[1] / self.pulse.step

    @property
    def coarse_slope_m_s(self) -> Tensor:
        """Slope in m/s, (...,), of the range error that remains if only velocities are compensated.

        Targets are displaced in range by this slope: compensation of a velocity changes the beat
        frequency, while that of a phase per pulse does not.
        """
        return self._line(self.coarse_m)[1] / self.pulse.step

    @property
    def largest_m(self) -> Tensor:
        """Largest deviation of the range error in metres from its value in the first illuminated
        period, (...,).
        """
        at = self.lit.to(torch.int8).argmax(-1, keepdim=True).expand(*self.error_m.shape[:-1], 1)
        return torch.where(self.lit, (self.error_m - self.error_m.gather(-1, at)).abs(), 0).amax(-1)

    def rms(self, x: Tensor) -> Tensor:
        """Root mean square of x (..., pulse) over the illuminated pulses, (...,)."""
        return (torch.where(self.lit, x.square(), 0).sum(-1) / self._count).sqrt()

    def metrics(self, radar: TriangularLadar) -> dict[str, Tensor]:
        """Compute the errors of the estimated motion in each trial.

        Args:
            radar: The instrument; its wavelength converts range errors into phases.

        Returns:
            `velocity_rmse_m_s` (if a velocity was estimated), `range_error_max_m`,
            `range_error_detrended_rms_m` and `residual_phase_rms_rad`, (...,) each.
        """
        left = self.rms(self.detrended_m)
        error = self.velocity_error_m_s
        return {
            **({} if error is None else {"velocity_rmse_m_s": self.rms(error)}),
            "range_error_max_m": self.largest_m,
            "range_error_detrended_rms_m": left,
            "residual_phase_rms_rad": 4 * math.pi / radar.wavelength_m * left,
        }

    def first(self) -> Course:
        """The course of the first trial."""
        names = ("velocity_m_s", "velocity_error_m_s", "error_m", "coarse_m", "lit")
        parts = {name: getattr(self, name) for name in names}
        rows = {name: None if x is None else x.reshape(-1, x.shape[-1])[0].cpu() for name, x in parts.items()}
        return replace(self, **rows)

    @property
    def _count(self) -> Tensor:
        return self.lit.sum(-1).clamp_min(1)

    def _line(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Least-squares line through the lit pulses: mean, slope per pulse, and pulse numbers
        relative to the middle of the lit ones.
        """
        k = torch.arange(x.shape[-1], dtype=torch.float64, device=x.device).expand(self.lit.shape)
        k = k - (torch.where(self.lit, k, 0).sum(-1) / self._count)[..., None]
        mean = torch.where(self.lit, x, 0).sum(-1) / self._count
        slope = torch.where(self.lit, x * k, 0).sum(-1) / torch.where(self.lit, k.square(), 0).sum(-1).clamp_min(1)
        return mean, slope, k


def lit_periods(radar: TriangularLadar, pulse: Axis, azimuth_m: Tensor, range_m: Tensor) -> Tensor:
    """Find the sweep periods at whose turning point the beam illuminates a scatterer.

    Args:
        radar: Radar parameters.
        pulse: Slow-time axis: starts of the periods.
        azimuth_m: Positions of the scatterers along track in metres, (..., target).
        range_m: Ranges of the scatterers relative to the reference range in metres, (..., target).

    Returns:
        True for illuminated periods, bool (..., pulse).
    """
    turning = pulse.values(azimuth_m.device) + radar.period_s / 2
    across = radar.speed_m_s * turning[:, None] - azimuth_m[..., None, :]
    half = math.inf if radar.beam_rad is None else radar.beam_rad / 2
    return (across.abs() <= half * (radar.reference_range_m + range_m)[..., None, :]).any(-1)


def course_of(chain: Chain, trace: Trace, truth: Mapping[str, Tensor], radar: TriangularLadar, clean: bool) -> Course:
    """Compare the radial motion that a processing chain estimated with the true motion.

    Args:
        chain: The chain.
        trace: Its intermediate signals and estimates for a recording.
        truth: True values of that recording, as the simulation gives them.
        radar: Radar parameters.
        clean: Whether the chain ran on the recording without motion.

    Returns:
        Estimated motion and its errors, shape (..., pulse).

    Raises:
        ValueError: If no signal of the chain holds separated up and down sweeps.
    """
    pulse = _sweeps_axis(trace)
    velocity = _summed(chain, trace, "velocity_m_s")
    phase = _summed(chain, trace, "phase_rad", used_only=trace.signal.names != SWEEPS)
    up, true = (truth[name][..., : pulse.n] for name in ("range_error_up_m", "velocity_m_s"))
    up, true = (torch.zeros_like(x) if clean else x for x in (up, true))
    taken = _compensated(chain, trace)
    moved = torch.zeros_like(up)
    if taken is not None:
        moved = integrated_range(taken, radar, pulse, sweep_middles(radar, pulse, taken.device)[0])
    coarse = error = moved - up
    if phase is not None:
        per_m = 4 * math.pi / radar.wavelength_m
        error = _unwrapped(coarse * per_m + phase) / per_m
    shines = leading(truth["amplitude"].abs())
    # scatterers that are not among the strongest are treated as never lit
    azimuth = torch.where(shines, truth["azimuth_m"], math.inf)
    lit = lit_periods(radar, pulse, azimuth, truth["range_m"].expand(azimuth.shape)).expand(error.shape)
    return Course(pulse, velocity, None if velocity is None else velocity - true, error, coarse, lit)


def target_responses(
    image: Signal,
    positions_m: Mapping[str, tuple[Tensor, Tensor]],
    course: Course,
    radar: TriangularLadar,
    sidelobe_nulls: int,
    search_m: float,
) -> dict[str, dict[str, Tensor]]:
    """Measure the point responses of named targets in an image with residual motion.

    The slope over time of the range error (estimated minus true) displaces the targets. In azimuth
    they are displaced by s R / V, with the slope s in m/s, the range R and the along-track speed V.
    In range they are displaced by -s' fc / K, with the carrier fc, the chirp rate K and the slope
    s' that remains if only velocities are compensated. The responses are sought at the displaced
    positions.

    Args:
        image: Image (azimuth, range).
        positions_m: True azimuth and relative range in metres, (...,) each, by the name of the
            target.
        course: Residual motion.
        radar: Radar parameters.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a sinc of the same -3 dB width.
        search_m: Half width in metres of the search about the predicted position.

    Returns:
        Widths, side-lobe levels and positions as returned by `impulse_response`, by the name of the
        target; targets outside the image are left out.
    """
    found, finer = {}, finer_in_range(image)
    for name, (azimuth, range_) in positions_m.items():
        along = azimuth + course.slope_m_s * (radar.reference_range_m + range_) / max(radar.speed_m_s, 1e-30)
        beyond = range_ - course.coarse_slope_m_s * radar.carrier_hz / radar.chirp_rate_hz_s
        pairs = zip((azimuth, range_), image.axes, strict=True)
        if all(bool(((x >= axis.start) & (x <= axis.stop)).all()) for x, axis in pairs):
            at = [x.clamp(axis.start, axis.stop) for x, axis in zip((along, beyond), image.axes, strict=True)]
            given = {"sidelobe_nulls": sidelobe_nulls, "search_m": search_m, "centre_turns": (None, 0.0)}
            figures = impulse_response(finer, (at[0], at[1]), **given)  # pyright: ignore[reportArgumentType]
            found[name] = {key: value for key, value in figures.items() if key != "peak"}
    return found


def finer_in_range(image: Signal) -> Signal:
    """Interpolate an image to half the range step.

    The result is exact for range profiles that were not cropped. The spectrum of such profiles
    fills the whole sampled band; with half the step it has the guard band that measurements of
    point responses need.

    Args:
        image: Image (azimuth, range).

    Returns:
        Image with twice the range samples, complex128.
    """
    azimuth, range_ = image.axes
    n, data = range_.n, image.data.to(torch.complex128)
    cell = torch.arange(2 * n, dtype=torch.float64, device=data.device)
    half = (n - 1) / (2 * n)  # middle of the sweep, in cycles per range cell
    sweeps = torch.fft.ifft(data * unit_phasor(-half * cell[:n], torch.complex128))
    fine = torch.fft.fft(sweeps, 2 * n) * unit_phasor(half / 2 * cell, torch.complex128)
    return Signal(fine, (azimuth, Axis("range", 2 * n, range_.start, range_.step / 2, range_.unit)))


def _unwrapped(phase: Tensor) -> Tensor:
    """Unwrap phases (..., n), so that steps are within half a cycle; the first value is
    unchanged.
    """
    step = torch.diff(phase)
    step = step - 2 * math.pi * torch.round(step / (2 * math.pi))
    return torch.cat([phase[..., :1], phase[..., :1] + step.cumsum(-1)], -1)


def _sweeps_axis(trace: Trace) -> Axis:
    """Axis of the starts of the periods of the last separated sweeps."""
    found = [signal for signal in (*trace.inputs.values(), *trace.outputs.values()) if signal.names == SWEEPS]
    if not found:
        raise ValueError(
            f"the chain must have a signal with the axes {SWEEPS} of separated up and down sweeps, but has none; "
            "if the data are a continuous record, begin the chain with split_sweeps"
        )
    return found[-1].axis("pulse")


def _compensated(chain: Chain, trace: Trace) -> Tensor | None:
    """Velocity (..., pulse) that the stages of a chain removed. If none uses a velocity, it is the
    last estimate, provided that the chain ends with separated sweeps; otherwise it is None.
    """
    used = {key for uses in chain.uses.values() for key in uses}
    return _summed(chain, trace, "velocity_m_s") if "velocity_m_s" in used or trace.signal.names == SWEEPS else None


def _summed(chain: Chain, trace: Trace, name: str, used_only: bool = False) -> Tensor | None:
    """Sum of a value over the stages that use it.

    If no stage uses it, the sum is the last estimate of the value; None if there is none.
    """
    taken = used_values(chain, trace, name)
    if not taken and not used_only:
        taken = last_values(trace, name)
    return torch.stack(taken).sum(0) if taken else None


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
