"""Figures of one batch of trials: velocity and range error against the truth, images against the
scatterers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.radial import integrated_range
from torchsar.core import Axis, Chain, Signal, Trace, Truth, unit_phasor
from torchsar.metrics import contrast, entropy, impulse_response
from torchsar.radar import TriangularLadar, sweep_middles

SWEEPS = ("ramp", "pulse", "fast_time")
_LEADING = 10 ** (-10 / 20)
DEFINITIONS: dict[str, Any] = {
    "snr": (
        "per sample before any compression, of a scatterer of amplitude 1 against the variance of the complex noise, dB"
    ),
    "velocity_rmse_m_s": (
        "rms over periods with a lit scatterer (within 10 dB of the strongest) of the "
        "estimated minus the true radial velocity of the motion at the turning points, "
        "receding positive"
    ),
    "range_error": "estimated minus true motion at the middles of the up sweeps: integral of the velocity that was "
    "compensated plus lambda / (4 pi) times the phases that "
    "were taken out of pulses, known modulo a turn and unwrapped along pulses against the truth",
    "range_error_max_m": "largest distance of the range error from its value at the first lit pulse, over lit pulses",
    "range_error_detrended_rms_m": (
        "rms over lit pulses of the range error without constant and slope, which only turn and shift the image"
    ),
    "residual_phase_rms_rad": "4 pi / lambda times range_error_detrended_rms_m",
    "entropy_nats": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats",
    "entropy_above_ideal_nats": "entropy less that of the same scene and noise without motion",
    "contrast": "standard deviation over mean of the AMPLITUDE |I|",
    "irw": "-3 dB width of the impulse response, m",
    "pslr": "strongest side lobe over the main lobe, dB",
    "islr": "energy of the side lobes over that of the main lobe (null to null), dB",
    "place": (
        "responses are sought about the true place, shifted by what is left of the motion: "
        "its mean velocity v shifts azimuth by v R / V and range by 2 v / (lambda K) beat "
        "hertz"
    ),
    "ok": "whether the method itself trusts its estimate",
    "seconds": "wall time of the chain of the method per trial",
    "published": (
        "figures of Remote Sens. 2024, 16, 793; its entropies depend on the size of the "
        "image and the noise, only their order compares"
    ),
}


@dataclass(frozen=True)
class Course:
    """What a method says of the motion.

    velocity_m_s: (..., pulse) at the turning points, None where it estimates none; pulse: starts of
    the periods; error_m: (..., pulse) range error at the middles of the up sweeps; coarse_m: the
    same without the phases taken out of pulses; lit: bool (..., pulse).
    """

    pulse: Axis
    velocity_m_s: Tensor | None
    velocity_error_m_s: Tensor | None
    error_m: Tensor
    coarse_m: Tensor
    lit: Tensor

    @property
    def detrended_m(self) -> Tensor:
        """Range error without constant and slope, (..., pulse), zero where nothing is lit."""
        mean, slope, k = self._line(self.error_m)
        return torch.where(self.lit, self.error_m - mean[..., None] - slope[..., None] * k, 0)

    @property
    def slope_m_s(self) -> Tensor:
        """Slope of the range error over slow time, (...,)."""
        return self._line(self.error_m)[1] / self.pulse.step

    @property
    def coarse_slope_m_s(self) -> Tensor:
        """Slope of what velocities alone leave, (...,): phases of pulses move no envelope."""
        return self._line(self.coarse_m)[1] / self.pulse.step

    @property
    def largest_m(self) -> Tensor:
        """Largest distance of the range error from its first lit value, (...,)."""
        first = self.error_m.gather(
            -1, self.lit.to(torch.int8).argmax(-1, keepdim=True).expand(*self.error_m.shape[:-1], 1)
        )
        return torch.where(self.lit, (self.error_m - first).abs(), 0).amax(-1)

    def rms(self, x: Tensor) -> Tensor:
        """Root mean square over the lit pulses of x (..., pulse)."""
        return (torch.where(self.lit, x.square(), 0).sum(-1) / self._count).sqrt()

    @property
    def _count(self) -> Tensor:
        return self.lit.sum(-1).clamp_min(1)

    def _line(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Least-squares line through the lit pulses: mean, slope per pulse, and the pulses counted
        from the middle of the lit ones.
        """
        k = torch.arange(x.shape[-1], dtype=torch.float64, device=x.device).expand(self.lit.shape)
        k = k - (torch.where(self.lit, k, 0).sum(-1) / self._count)[..., None]
        mean = torch.where(self.lit, x, 0).sum(-1) / self._count
        slope = torch.where(self.lit, x * k, 0).sum(-1) / torch.where(self.lit, k.square(), 0).sum(-1).clamp_min(1)
        return mean, slope, k


def leading(level: Tensor) -> Tensor:
    """Scatterers within 10 dB of the strongest, bool; those far below it do not lead an estimator.

    level: (..., target) amplitudes.
    """
    return (level >= _LEADING * level.amax(-1, keepdim=True)) & (level > 0)


def lit_periods(radar: TriangularLadar, pulse: Axis, azimuth_m: Tensor, range_m: Tensor) -> Tensor:
    """Whether the beam lights any of the scatterers (..., target) at the turning points, bool (...,
    pulse).
    """
    across = radar.speed_m_s * (pulse.values(azimuth_m.device) + radar.period_s / 2)[:, None] - azimuth_m[..., None, :]
    half = math.inf if radar.beam_rad is None else radar.beam_rad / 2
    return (across.abs() <= half * (radar.reference_range_m + range_m)[..., None, :]).any(-1)


def _unwrapped(phase: Tensor) -> Tensor:
    """Phases (..., n) with steps within half a turn, beginning where they begin."""
    step = torch.diff(phase)
    step = step - 2 * math.pi * torch.round(step / (2 * math.pi))
    return torch.cat([phase[..., :1], phase[..., :1] + step.cumsum(-1)], -1)


def course_of(chain: Chain, trace: Trace, truth: Truth, radar: TriangularLadar, clean: bool) -> Course:
    """Motion as a chain found it beside the true one; clean: it ran on the recording without
    motion.
    """
    pulse = _sweeps_axis(trace)
    velocity = _summed(chain, trace, "velocity_m_s")
    phase = _summed(chain, trace, "phase_rad", used_only=trace.signal.names != SWEEPS)
    up, true = (
        torch.zeros_like(x) if clean else x
        for x in (truth.values[name][..., : pulse.n] for name in ("range_error_up_m", "velocity_m_s"))
    )
    taken = _compensated(chain, trace)
    moved = (
        torch.zeros_like(up) if taken is None else integrated_range(taken, radar, pulse, sweep_middles(radar, pulse)[0])
    )
    coarse = moved - up
    error = coarse
    if phase is not None:
        per_m = 4 * math.pi / radar.wavelength_m
        error = _unwrapped(coarse * per_m + phase) / per_m
    return Course(
        pulse,
        velocity,
        None if velocity is None else velocity - true,
        error,
        coarse,
        _lit(truth, radar, pulse).expand(error.shape),
    )


def _lit(truth: Truth, radar: TriangularLadar, pulse: Axis) -> Tensor:
    """Periods in which a leading scatterer is lit: velocity is undefined in others, (...,
    pulse).
    """
    shines = leading(truth.values["amplitude"].abs())
    azimuth = torch.where(shines, truth.values["azimuth_m"], math.inf)  # never in the beam
    return lit_periods(radar, pulse, azimuth, truth.values["range_m"].expand(azimuth.shape))


def _sweeps_axis(trace: Trace) -> Axis:
    """Starts of the periods of the last separated sweeps."""
    found = [signal for signal in (*trace.inputs.values(), *trace.outputs.values()) if signal.names == SWEEPS]
    if not found:
        raise ValueError(
            f"the method never has separated sweeps {SWEEPS}; begin its chain with split_sweeps "
            "where the world has a record"
        )
    return found[-1].axis("pulse")


def _compensated(chain: Chain, trace: Trace) -> Tensor | None:
    """Velocity that was taken out, or for a chain without an image what would be, (..., pulse)."""
    if "velocity_m_s" in {key for uses in chain.uses.values() for key in uses} or trace.signal.names == SWEEPS:
        return _summed(chain, trace, "velocity_m_s")
    return None


def _summed(chain: Chain, trace: Trace, name: str, used_only: bool = False) -> Tensor | None:
    """Sum over the stages that use a value of what they are given; without any the last estimate of
    it, None where there is none.
    """
    taken = [
        trace.values[uses[name]].to(torch.float64)
        for stage, uses in chain.uses.items()
        if name in uses and stage in trace.outputs
    ]
    if not taken and not used_only:
        taken = [
            estimate.value[name].to(torch.float64) for estimate in trace.estimates.values() if name in estimate.value
        ][-1:]
    return torch.stack(taken).sum(0) if taken else None


def motion_metrics(course: Course, radar: TriangularLadar) -> dict[str, Tensor]:
    """Figures of the motion, (...,) each."""
    detrended = course.rms(course.detrended_m)
    found = {
        "range_error_max_m": course.largest_m,
        "range_error_detrended_rms_m": detrended,
        "residual_phase_rms_rad": 4 * math.pi / radar.wavelength_m * detrended,
    }
    if course.velocity_error_m_s is None:
        return found
    return {"velocity_rmse_m_s": course.rms(course.velocity_error_m_s), **found}


def image_metrics(image: Signal) -> dict[str, Tensor]:
    """Entropy of the intensity and contrast of the amplitude."""
    return {"entropy_nats": entropy(image), "contrast": contrast(image, of="amplitude")}


def target_metrics(
    image: Signal,
    places: Mapping[str, tuple[Tensor, Tensor]],
    course: Course,
    radar: TriangularLadar,
    nulls: int,
    search_m: float,
) -> dict[str, dict[str, Tensor]]:
    """Response of every named target inside the image, by name; places: azimuth and relative range
    (m), (...,) each.

    What is left of the motion moves a target: echo phases 4 pi DR / lambda with the slope -e' of DR
    shift azimuth by -e' R / V, beats by 2 e' / lambda.
    """
    found, finer = {}, finer_in_range(image)
    for name, (azimuth, range_) in places.items():
        along = azimuth + course.slope_m_s * (radar.reference_range_m + range_) / max(radar.speed_m_s, 1e-30)
        beyond = range_ - course.coarse_slope_m_s * radar.carrier_hz / radar.chirp_rate_hz_s
        if all(_inside(place, axis) for place, axis in zip((azimuth, range_), image.axes)):
            at = tuple(place.clamp(axis.start, axis.stop) for place, axis in zip((along, beyond), image.axes))
            figures = impulse_response(
                finer, (at[0], at[1]), sidelobe_nulls=nulls, search_m=search_m, centre_turns=(None, 0.0)
            )
            found[name] = {key: value for key, value in figures.items() if key != "peak"}
    return found


def finer_in_range(image: Signal) -> Signal:
    """The image on half the range step: full-band profiles have no guard band, which slices need
    (brief 000, section 8 A). Exact for uncropped profiles.
    """
    azimuth, range_ = image.axes
    n, data = range_.n, image.data.to(torch.complex128)
    cell = torch.arange(2 * n, dtype=torch.float64, device=data.device)
    half = (n - 1) / (2 * n)  # the middle of the sweep, in turns a cell
    sweeps = torch.fft.ifft(data * unit_phasor(-half * cell[:n], torch.complex128))
    fine = torch.fft.fft(sweeps, 2 * n) * unit_phasor(half / 2 * cell, torch.complex128)
    return Signal(fine, (azimuth, Axis("range", 2 * n, range_.start, range_.step / 2, range_.unit)))


def _inside(place: Tensor, axis: Axis) -> bool:
    return bool(((place >= axis.start) & (place <= axis.stop)).all())
