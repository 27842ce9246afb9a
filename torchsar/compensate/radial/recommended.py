"""The recommended estimator of the radial motion of a triangular-FMCW ladar.

It estimates velocities by `mirror_product`, and then the residual phase of every pulse by
`phase_polish`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase import Listed, pga
from torchsar.compensate.pulse_phase.data import or_one, prepare, rotate, starting_phase
from torchsar.compensate.pulse_phase.homogeneous import LEAST_LOOKS, describe, occupied_band
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, fixed_point
from torchsar.compensate.radial.bands import Bands, bands_of, filled, refuse_other_sweeps
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.compensate import carrier_turns, polynomial_phasor
from torchsar.compensate.radial.dense import linked_walk, phase_difference
from torchsar.compensate.radial.mirror import Intercept, mirror_estimate, refuse_other_intercept
from torchsar.compensate.radial.polish import ENOUGH_STD_RAD, scene_cells, sharpened
from torchsar.compensate.radial.trajectory import integrated_range, sweep_motion
from torchsar.core import Axis, Estimate, Outcome, host_values, power_of, true_positions
from torchsar.core.spline import UniformSpline
from torchsar.focus.triangular import deramp_azimuth, profile_axes
from torchsar.metrics.ladar_bounds import integrated_range_detrended_bound_m
from torchsar.radar import TriangularLadar, sweep_middles

# random walk of the integrated velocities beyond which the polish is started from PGA, found by
# trial: beyond a radian the polish alone may end in an image of two peaks
_FAR_RAD = 0.4
# scenes of more effective image cells are dense
_DENSE_CELLS = 20.0
# phases that exceed the expected random walk by this factor, besides 0.4 rad, are not due to noise
_UNEXPECTED = 3.0
# effective range cells below which a scene is a single range cell, and relative modulation of the
# power of its pulses, besides so many standard deviations of noise, that shows several scatterers
_ONE_CELL, _MODULATION, _SURE = 1.5, 0.1, 4.0
# least entropy, as in `autofocus`: a second estimate for the verdict; twice its rms difference was
# 0.11 to 0.15 rad where both were right, and 0.43 and more where both were wrong at -10 dB
_SHARPEN, _ENOUGH_APART_RAD = Run(LogAbove(2.5), AlongPulses(), 60, 1.8, 0.01), 0.35
# fewer periods have so few Doppler cells that sharpness hardly depends on the phases: with three to
# five periods the iterations often do not converge, with eight they do
_LEAST_PERIODS = 8
_FEW_PERIODS = 32  # fewer periods are not started from PGA, whose first window is as wide
# windows of PGA in Doppler cells, found by trial: a random walk blurs by few cells
_WINDOWS = Listed((31.0, 21.0, 15.0, 9.0, 9.0, 9.0))


def radial_motion(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    window_m: tuple[float, float] | None = None,
    intercept: Intercept = "known",
    taper: float = 1.0,
    azimuth_m: Tensor | float = 0.0,
    iterations: int = 80,
    tolerance_rad: float = 0.005,
) -> Estimate:
    """Estimate the radial motion from up and down sweeps; the recommended estimator.

    `mirror_product` estimates the velocities. The range cells of the window are compensated with
    the integral of the velocities and deramped in azimuth. `phase_polish` then estimates the
    residual phase of each pulse, so that the range error does not grow with the length of the
    record. In dense scenes, whose energy fills more than 20 cells of the image, phases of maximum
    likelihood replace those that sharpen the image, because sharpness prefers wrong phases there;
    this takes some seconds per trial. All steps use only the bins of the window: a window that
    holds the scene and little else saves time and allows a lower SNR. Differentiable, except for
    the peak searches and the choice between results.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        intercept: What is assumed of the phase of the product of up and mirrored down sweep at the
            turning point: "known", "record" or "free", see `mirror_product`.
        taper: Share of the window that its edges take, see `bands_of`.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.

    Returns:
        `velocity_m_s` at the turning points (ends of the up sweeps), receding positive, and
        `phase_rad` at the middles of the up sweeps, shape (..., pulse) each, with standard
        deviations. The phase is to be removed after `compensate_motion` with the velocities.
        `range_error` combines both to a range error. `quality` is that of the velocities. `ok` is
        False where `ok` of `mirror_product` is False, the phase has a standard deviation of 0.5 rad
        or more, or fewer than eight periods have an echo; the phase is then zero. From 32 periods
        on, it is also False where linked phases of a dense scene are not confirmed; where the power
        of the pulses is modulated or the phases exceed the random walk that noise explains by far,
        and least entropy leads to other phases; and where a single range cell has a modulated
        power, because the interference of scatterers then cannot be distinguished from motion.

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, the window or the intercept are invalid.
    """
    refuse_other_sweeps(sweeps, radar, "radial_motion", pulse)
    refuse_other_intercept(intercept)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = bands_of(sweeps, radar, window_m, taper, oversampling=2)
        return polished(bands, mirror_estimate(bands, pulse, intercept, azimuth_m), pulse, iterations, tolerance_rad)

    return by_trials(estimator, sweeps, azimuth_m)


def polished(bands: Bands, coarse: Estimate, pulse: Axis, iterations: int, tolerance_rad: float) -> Estimate:
    """Complete an estimate of radial velocities by the residual phase of each up sweep.

    The motion is compensated with the velocities first; then the phases that remain are estimated
    as by `phase_polish`.

    Args:
        bands: Filtered sweeps from which the velocities were estimated.
        coarse: Estimate of the velocities.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.

    Returns:
        The `Estimate` that the function `radial_motion` returns.
    """
    cells = deramped_lines(bands, coarse["velocity_m_s"], pulse)
    per_velocity = 4 * math.pi / bands.radar.wavelength_m * pulse.step
    pulses = prepare(cells, "radial_motion", empty=False)
    start = starting_phase(_start(cells, coarse, bands.radar, pulse), pulses, "radial_motion")
    phase, taken = sharpened(pulses.rows, start, iterations, tolerance_rad)
    found = scene_cells(rotate(pulses.rows.detach(), phase.detach()))
    image_cells, range_cells = (count.reshape(pulses.trials) for count in found)
    enough = pulses.present.sum(-1) >= _LEAST_PERIODS
    phase = torch.where(enough[:, None], phase, 0).to(torch.float64).reshape(*pulses.trials, pulses.n)
    phase = _unwrapped(phase, coarse.info["lit"])
    std = (1 / torch.sqrt(2 * 10 ** (coarse.info["snr_db"] / 10))).clamp_max(math.pi)
    return _judged(
        cells,
        per_velocity,
        Estimate(
            {**coarse.value, "phase_rad": phase},
            {**coarse.std, "phase_rad": std[..., None].expand_as(phase)},
            coarse.quality,
            Outcome.of(coarse.ok & (std < ENOUGH_STD_RAD) & enough.reshape(pulses.trials), Outcome.NOISE),
            info={
                **coarse.info,
                "iterations": taken.reshape(pulses.trials),
                "image_cells": image_cells,
                "range_cells": range_cells,
            },
        ),
    )


def _judged(cells: Tensor, per_velocity: float, sharpest: Estimate) -> Estimate:
    """The estimate with the verdict on its phases, and with linked phases where the scene is dense.

    An error of the velocity in m/s times `per_velocity` is the step of the phase in rad between
    periods. Each trial that is ok so far belongs to one of four cases:

    - Few periods: the estimate is kept.
    - A single range cell whose power is modulated: the interference of scatterers cannot be
      distinguished from motion, and the estimate is not ok.
    - A dense scene: `linked_walk` gives the phases and the verdict.
    - Other scenes: where the power of the pulses is modulated, or the phases exceed the random walk
      of the velocities by far, `_confirmed` gives the verdict; else the estimate is kept.
    """
    n = cells.shape[-2]
    if n < _FEW_PERIODS:
        return sharpest
    lines = cells.reshape(-1, *cells.shape[-2:])
    phase, std = sharpest["phase_rad"].reshape(-1, n), sharpest.std["phase_rad"].reshape(-1, n)
    lit, ok = sharpest.info["lit"].reshape(-1, n), sharpest.ok.flatten()
    range_cells, image_cells = (sharpest.info[name].flatten() for name in ("range_cells", "image_cells"))
    step_rad = per_velocity * sharpest.info["noise_m_s"].detach().flatten()
    modulated = _modulation(lines.detach(), lit) > _MODULATION + _SURE * math.sqrt(2) * std[:, 0].detach()
    walk_rad = _UNEXPECTED * step_rad * math.sqrt(n / 15) + _FAR_RAD
    ok = ok & ~(modulated & (range_cells < _ONE_CELL))
    dense = ok & (image_cells > _DENSE_CELLS)
    doubtful = ok & ~dense & (modulated | (_rms_without_line(phase.detach(), lit) > walk_rad))
    n_dense, n_doubtful = host_values(torch.stack([dense.sum(), doubtful.sum()]), 0)
    if n_dense:
        at = true_positions(dense, n_dense)
        linked = linked_walk(lines[at], phase[at], step_rad[at])
        phase = phase.index_copy(0, at, linked["phase_rad"].to(phase.dtype))
        std = std.index_copy(0, at, linked.std["phase_rad"].to(std.dtype))
        ok = ok.index_put((at,), linked.ok)
    if n_doubtful:
        at = true_positions(doubtful, n_doubtful)
        confirmed, apart = _confirmed(lines[at], phase[at].detach(), lit[at], range_cells[at])
        std = std.index_put((at,), (std[at].square() + apart[:, None].square()).sqrt())
        ok = ok.index_put((at,), confirmed)
    shape = sharpest["phase_rad"].shape
    return replace(
        sharpest,
        value={**sharpest.value, "phase_rad": phase.reshape(shape)},
        std={**sharpest.std, "phase_rad": std.reshape(shape)},
        ok=ok.reshape(sharpest.ok.shape),
    )


@torch.no_grad()
def _confirmed(lines: Tensor, phase: Tensor, lit: Tensor, range_cells: Tensor) -> tuple[Tensor, Tensor]:
    """Whether least entropy confirms phases, and twice the rms difference in rad, (trial,) each.

    The pulses must also be coherent with the phases, which is measured over range cells of similar
    power.
    """
    pulses = prepare(lines, "radial_motion")
    other = fixed_point(pulses.rows, pair_phase(pulses.rows, pulses.present), _SHARPEN)[0]
    coherent = describe(pulses.rows, phase.to(other.dtype), occupied_band(torch.fft.fft(pulses.rows, dim=-2))).ratio > 0
    apart = 2 * phase_difference(phase, other.to(phase.dtype), lit)
    return (coherent | (range_cells < LEAST_LOOKS)) & (apart < _ENOUGH_APART_RAD), apart


def _modulation(lines: Tensor, lit: Tensor) -> Tensor:
    """Standard deviation over mean of the power of the lit pulses, (trial,).

    lines: (trial, pulse, range); lit: (trial, pulse), bool.
    """
    power = power_of(lines).sum(-1, dtype=torch.float64)
    count, tiny = lit.sum(-1, keepdim=True).clamp_min(1), torch.finfo(torch.float64).tiny
    mean = (power * lit).sum(-1, keepdim=True) / count
    square = ((power / mean.clamp_min(tiny) - 1).square() * lit).sum(-1) / count[:, 0]
    return square.sqrt()


def _unwrapped(phase: Tensor, lit: Tensor) -> Tensor:
    """Phases (..., pulse) in rad without steps of whole turns, interpolated between lit pulses."""
    at = torch.arange(phase.shape[-1], device=phase.device).expand(phase.shape)
    last = torch.where(lit, at, -1).cummax(-1).values
    held = phase.detach().gather(-1, torch.where(last < 0, lit.to(torch.int8).argmax(-1, keepdim=True), last))
    turns = torch.round(held.diff(dim=-1) / (2 * math.pi)).cumsum(-1)
    return filled(phase - 2 * math.pi * torch.nn.functional.pad(turns, (1, 0)), lit)


def _rms_without_line(phase: Tensor, lit: Tensor) -> Tensor:
    """Rms over the lit pulses of phases (trial, pulse) in rad without a straight line, (trial,)."""
    pulse = torch.linspace(-1, 1, phase.shape[-1], dtype=phase.dtype, device=phase.device)
    share = lit / lit.sum(-1, keepdim=True).clamp_min(1)
    pulse = pulse - (pulse * share).sum(-1, keepdim=True)
    rest = phase - (phase * share).sum(-1, keepdim=True)
    slope = (rest * pulse * share).sum(-1, keepdim=True) / or_one((pulse.square() * share).sum(-1, keepdim=True))
    return ((rest - slope * pulse).square() * share).sum(-1).sqrt()


@torch.no_grad()
def _start(cells: Tensor, coarse: Estimate, radar: TriangularLadar, pulse: Axis) -> Tensor | None:
    """Phases (..., pulse) by PGA for trials whose velocities integrate to more than 0.4 rad.

    The bound is that of the random walk of integrated velocities. Zero for the other trials.
    """
    drift = (
        4
        * math.pi
        / radar.wavelength_m
        * integrated_range_detrended_bound_m(coarse.info["noise_m_s"], pulse.step, pulse.n)
    )
    far = coarse.ok & (drift > _FAR_RAD)
    if pulse.n < _FEW_PERIODS or not bool(far.any()):
        return None
    return torch.where(
        far[..., None], pga(cells.detach(), windows=_WINDOWS, iterations=len(_WINDOWS.cells))["phase_rad"], 0
    )


def deramped_lines(bands: Bands, velocity_m_s: Tensor, pulse: Axis) -> Tensor:
    """Compute the range cells of the up sweeps, with the motion and the azimuth phase removed.

    The azimuth phase removed is that of a scatterer at azimuth zero (deramping), so that scatterers
    become tones over the pulses.

    Args:
        bands: Filtered sweeps.
        velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse).
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.

    Returns:
        Range cells of the window of `bands`, shape (..., pulse, range), complex.
    """
    radar, m = bands.radar, bands.time_s.shape[-1]
    turns = carrier_turns(sweep_motion(velocity_m_s, radar, pulse), radar)[..., 0, :, :]
    remaining = torch.cat(
        [turns[..., :1], turns[..., 1:2] - (bands.shift.to(torch.float64) / radar.sweep_s)[..., None], turns[..., 2:]],
        -1,
    )
    compensated = bands.up * polynomial_phasor(-remaining, radar.sweep_s / m, m, bands.up.dtype)
    lines = torch.arange(bands.first, bands.first + bands.lines, device=compensated.device)
    cells = torch.fft.fft(compensated)[..., lines % m] / m
    middle, _ = profile_axes(pulse, radar)
    range_ = Axis("range", bands.lines, bands.first * radar.range_step_m, radar.range_step_m, "m")
    return deramp_azimuth(cells, radar, middle, range_)


def range_error(estimate: Estimate, radar: TriangularLadar, pulse: Axis, at_s: Tensor) -> Tensor:
    """Compute the range error at any slow time from an estimate of the radial motion.

    The range error is the integral of the velocities, zero at the first turning point (end of the
    first up sweep), plus lambda / (4 pi) times the phases of the pulses if the estimate has phases.
    Both parts are interpolated by cubic splines.

    Args:
        estimate: Estimate that holds `velocity_m_s`, `phase_rad` or both, such as that of
            `radial_motion`.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        at_s: Slow times in seconds, any shape.

    Returns:
        The range error in metres, shape (..., *at_s.shape), float64.
    """
    total = torch.zeros((), dtype=torch.float64, device=at_s.device)
    if "velocity_m_s" in estimate.value:
        total = total + integrated_range(estimate["velocity_m_s"], radar, pulse, at_s)
    if "phase_rad" in estimate.value:
        fine = estimate["phase_rad"].to(torch.float64) * (radar.wavelength_m / (4 * math.pi))
        start = float(sweep_middles(radar, pulse)[0, 0])
        total = total + (
            UniformSpline(fine, start, pulse.step).at(at_s)
            if pulse.n > 1
            else fine.reshape(*fine.shape[:-1], *(1,) * at_s.ndim).expand(*fine.shape[:-1], *at_s.shape)
        )
    return total
