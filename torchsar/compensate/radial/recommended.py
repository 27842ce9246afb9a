"""The recommended estimator of the radial motion of a triangular-FMCW ladar.

It estimates velocities by `mirror_product`, and then the residual phase of every pulse by
`phase_polish`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase import pga
from torchsar.compensate.pulse_phase.data import prepare, rotate, starting_phase
from torchsar.compensate.radial.assess import LEAST_PERIODS, assessed_motion, assessed_velocity
from torchsar.compensate.radial.bands import Bands, Spectra, filled
from torchsar.compensate.radial.blocks import Window, _SweepEstimator, by_trials
from torchsar.compensate.radial.measured import Intercept
from torchsar.compensate.radial.mirror import mirror_measured, refuse_other_intercept
from torchsar.compensate.radial.phases import Walk, linked_walk, scene_cells, sharpened
from torchsar.compensate.radial.trajectory import (
    carrier_turns,
    integrated_range,
    polynomial_phasor,
    sweep_motion,
)
from torchsar.core import (
    Axis,
    Estimate,
    differentiable,
    host_value,
    true_positions,
)
from torchsar.core.spline import Spline
from torchsar.focus.triangular import deramp_azimuth, profile_axes
from torchsar.metrics.ladar_bounds import integrated_range_detrended_bound_m
from torchsar.radar import TriangularLadar, sweep_middles


@differentiable("where ok")
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
    assess: bool = True,
) -> Estimate:
    """Estimate the radial motion from up and down sweeps; the recommended estimator.

    >>> import torch
    >>> from torchsar.compensate import radial_motion
    >>> from torchsar.radar import TriangularLadar
    >>> ladar = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 64, 128, dtype=torch.complex64)  # a point at the reference range
    >>> found = radial_motion(sweeps, ladar, ladar.sweep_axes(64)[1])
    >>> bool(found["velocity_m_s"].abs().max() < 0.01)
    True

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
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.
        assess: False leaves out the standard deviation and the outcome.

    Returns:
        `velocity_m_s` at the turning points (ends of the up sweeps), receding positive, and
        `phase_rad` at the middles of the up sweeps, shape (..., pulse) each. The phase is to be
        removed after `compensate_motion` with the velocities; it is zero where fewer than eight
        periods have an echo. `range_error` combines both to a range error. `quality` is that of
        the velocities. `assess=True` adds standard deviations and the outcome: that of
        `mirror_product`, or that of the phases if it has a greater code. It is `Outcome.INEXACT`
        where the standard deviation of the phases is 0.5 rad or more; `AMBIGUOUS` where no two
        starts of the likelihood reach the same phases in a dense scene, or where scatterers
        interfere and least entropy leads to other phases; and `TOO_FEW` for less than eight periods
        with an echo, or where scatterers interfere in a single range cell, which cannot be
        distinguished from motion.

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, the window or the intercept are invalid.
    """
    refuse_other_intercept(intercept)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = Spectra.of(sweeps, radar).bands(window_m, taper, oversampling=2)
        measured = mirror_measured(bands, intercept)
        coarse = measured.estimate(pulse, azimuth_m)
        cells = deramped_lines(bands, coarse["velocity_m_s"], pulse)
        found, walk = polished(cells, coarse, measured.enough, pulse, radar, iterations, tolerance_rad)
        if not assess:
            return found
        return assessed_motion(assessed_velocity(found, measured, pulse, sweeps), cells, walk)

    return by_trials("radial_motion", estimator, sweeps, radar, pulse, azimuth_m)


def polished(
    cells: Tensor,
    coarse: Estimate,
    enough: Tensor,
    pulse: Axis,
    radar: TriangularLadar,
    iterations: int,
    tolerance_rad: float,
) -> tuple[Estimate, Walk]:
    """Complete an estimate of radial velocities by the residual phase of each up sweep.

    Args:
        cells: Range cells after motion compensation and azimuth deramping, see `deramped_lines`.
        coarse: Estimate of the velocities.
        enough: Whether the SNR suffices for velocities without outliers, shape (...,).
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        radar: Ladar parameters.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.

    Returns:
        The estimate with the phases, and their deviation and agreement from `linked_walk`; the
        latter are those of noise where the scene is not dense.
    """
    pulses = prepare(cells, "radial_motion", empty=False)
    start = starting_phase(_start(cells, coarse, enough, radar, pulse), pulses, "radial_motion")
    phase, taken = sharpened(pulses.rows, start, iterations, tolerance_rad)
    image_cells, range_cells = scene_cells(rotate(pulses.rows.detach(), phase.detach()))
    shows = pulses.present.sum(-1) >= LEAST_PERIODS
    lit = coarse.info["lit"].reshape(-1, pulse.n)
    phase = _unwrapped(torch.where(shows[:, None], phase, 0).to(torch.float64), lit)
    std = (1 / torch.sqrt(2 * 10 ** (coarse.info["snr_db"].detach().flatten() / 10))).clamp_max(math.pi)
    walk = Walk(phase, std[:, None].expand_as(phase), torch.full_like(std, torch.nan))
    dense = enough.flatten() & (image_cells > 20) & (pulse.n >= 32)
    count = host_value(dense.sum(), 0)
    if count:
        at = true_positions(dense, count)
        step_rad = 4 * math.pi / radar.wavelength_m * pulse.step * coarse.info["noise_m_s"].detach().flatten()[at]
        linked = linked_walk(cells.reshape(-1, *cells.shape[-2:])[at], phase[at], step_rad)
        walk = Walk(*(all_.index_copy(0, at, some) for all_, some in zip(walk, linked, strict=True)))
    info = {"iterations": taken, "image_cells": image_cells, "range_cells": range_cells}
    return replace(
        coarse,
        value={**coarse.value, "phase_rad": walk.phase_rad.reshape(*pulses.trials, pulse.n)},
        info={**coarse.info, **{name: value.reshape(pulses.trials) for name, value in info.items()}},
    ), walk


def _unwrapped(phase: Tensor, lit: Tensor) -> Tensor:
    """Unwrap phases (..., pulse) in rad, and interpolate them between lit pulses."""
    at = torch.arange(phase.shape[-1], device=phase.device).expand(phase.shape)
    last = torch.where(lit, at, -1).cummax(-1).values
    held = phase.detach().gather(-1, torch.where(last < 0, lit.to(torch.int8).argmax(-1, keepdim=True), last))
    turns = torch.round(held.diff(dim=-1) / (2 * math.pi)).cumsum(-1)
    return filled(phase - 2 * math.pi * torch.nn.functional.pad(turns, (1, 0)), lit)


@torch.no_grad()
def _start(cells: Tensor, coarse: Estimate, enough: Tensor, radar: TriangularLadar, pulse: Axis) -> Tensor | None:
    """Estimate starting phases (..., pulse) by PGA where the velocities alone are too inaccurate.

    That is where integrating their noise predicts a phase error above 0.4 rad, found by trial;
    from about 1 rad on, `phase_polish` may end in an image of two peaks. Other trials get zeros.
    The result is None if no trial needs PGA, or for fewer than 32 periods, because the first PGA
    window is 31 cells wide.
    """
    walk_m = integrated_range_detrended_bound_m(coarse.info["noise_m_s"], pulse.step, pulse.n)
    far = enough & (4 * math.pi / radar.wavelength_m * walk_m > 0.4)
    if pulse.n < 32 or not bool(far.any()):
        return None
    # Widths of the PGA windows in Doppler cells, found by trial. They are narrow because a random
    # walk of the phase blurs by few cells only.
    windows = (31.0, 21.0, 15.0, 9.0, 9.0, 9.0)
    found = pga(cells.detach(), windows=windows, iterations=6, assess=False)
    return torch.where(far[..., None], found["phase_rad"], 0)


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
    # the linear term that is already removed is subtracted
    remaining = turns - torch.nn.functional.pad((bands.shift.to(torch.float64) / radar.sweep_s)[..., None], (1, 4))
    compensated = bands.up * polynomial_phasor(-remaining, radar.sweep_s / m, m, bands.up.dtype)
    lines = torch.arange(bands.first, bands.first + bands.lines, device=compensated.device)
    cells = torch.fft.fft(compensated)[..., lines % m] / m
    middle, _ = profile_axes(pulse, radar)
    range_ = Axis("range", bands.lines, bands.first * radar.range_step_m, radar.range_step_m, "m")
    return deramp_azimuth(cells, radar, middle, range_)


def range_error(estimate: Estimate, radar: TriangularLadar, pulse: Axis, at_s: Tensor) -> Tensor:
    """Compute the range error at any slow time from an estimate of the radial motion.

    >>> import torch
    >>> from torchsar import Estimate, compensate, radar
    >>> ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> found = Estimate({"velocity_m_s": torch.full((8,), 0.5, dtype=torch.float64)})
    >>> pulse, at_s = ladar.sweep_axes(8)[1], torch.tensor([0.0, 16e-6], dtype=torch.float64)
    >>> compensate.range_error(found, ladar, pulse, at_s).diff()  # metres in one period
    tensor([8.0000e-06], dtype=torch.float64)

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
            Spline(fine, (start, pulse.step)).at(at_s)
            if pulse.n > 1
            else fine.reshape(*fine.shape[:-1], *(1,) * at_s.ndim).expand(*fine.shape[:-1], *at_s.shape)
        )
    return total


class RadialMotion(_SweepEstimator):
    """Radial motion by the recommended estimator; see `radial_motion`.

    Provides `velocity_m_s`, which `CompensateMotion` can compensate, and the residual `phase_rad`,
    which `CorrectPulsePhase` can then remove.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        intercept: What is assumed of the phase of the product of up and mirrored down sweep at the
            turning point: "known", "record" or "free", see `mirror_product`.
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    provides = ("velocity_m_s", "phase_rad")
    neutral = {"velocity_m_s": 0.0, "phase_rad": 0.0}
    estimator = staticmethod(radial_motion)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
        iterations: int = 80,
        tolerance_rad: float = 0.005,
        assess: bool = True,
    ) -> None:
        super().__init__(
            radar,
            window_m,
            azimuth_m,
            assess,
            intercept=intercept,
            taper=taper,
            iterations=iterations,
            tolerance_rad=tolerance_rad,
        )
