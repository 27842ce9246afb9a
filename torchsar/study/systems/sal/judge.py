"""Estimates of the radial motion of a triangular-sweep ladar compared with the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.radial.trajectory import integrated_range
from torchsar.core import Axis, Chain, Signal, Trace, unit_phasor
from torchsar.metrics.impulse import impulse_response
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.radar.ladar import leading
from torchsar.study.trials.batch import last_values, used_values

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
