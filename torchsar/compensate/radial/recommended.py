"""The recommended estimate of the radial motion: velocities by the mirror product, then the phase
of every pulse against the scene.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.gradient import Listed, pga
from torchsar.compensate.radial.bands import Bands, bands_of, refuse_other_sweeps
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.compensate import carrier_turns, polynomial_phasor
from torchsar.compensate.radial.mirror import Intercept, mirror_estimate, refuse_other_intercept
from torchsar.compensate.radial.polish import ENOUGH_STD_RAD, phase_polish
from torchsar.compensate.radial.trajectory import integrated_range, sweep_motion
from torchsar.core import Axis, Estimate
from torchsar.core.spline import UniformSpline
from torchsar.focus.triangular import deramp_azimuth, profile_axes
from torchsar.metrics.ladar_bounds import integrated_range_detrended_bound_m
from torchsar.radar import TriangularLadar, sweep_middles

_FAR_RAD, _FEW_PERIODS, _WINDOWS = 0.4, 32, Listed((31.0, 21.0, 15.0, 9.0, 9.0, 9.0))


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
    """The recommended estimate: value["velocity_m_s"] at the turning points and value["phase_rad"]
    at the middles of the up sweeps, (..., pulse) each.

    sweeps: (..., 2, pulse, N). `mirror_product` gives the velocities; their integral takes the
    motion out of the range cells of window_m (None: the whole band), deramped in azimuth;
    `phase_polish` finds what is left in each pulse, so that the error of the range does not grow
    with the length of the record. All on the few lines of the window: a window that holds the scene
    and little else costs less and stands more noise. The phase is to be removed after
    `compensate_motion` by the velocities; `range_error` adds both up. intercept, taper, azimuth_m:
    see `mirror_product`; iterations, tolerance_rad: see `phase_polish`.

    std: of both. ok: both can be trusted. quality: that of the velocities. Differentiable around
    the detached peak search. Raises TypeError or ValueError for other sweeps or windows.
    """
    refuse_other_sweeps(sweeps, radar, "radial_motion", pulse)
    refuse_other_intercept(intercept)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = bands_of(sweeps, radar, window_m, taper, oversampling=2)
        return polished(bands, mirror_estimate(bands, pulse, intercept, azimuth_m), pulse, iterations, tolerance_rad)

    return by_trials(estimator, sweeps, azimuth_m)


def polished(bands: Bands, coarse: Estimate, pulse: Axis, iterations: int, tolerance_rad: float) -> Estimate:
    """An estimate of velocities and the phases that they leave in the up sweeps of the bands that
    they come from.
    """
    cells = deramped_lines(bands, coarse["velocity_m_s"], pulse)
    fine = phase_polish(
        cells, start=_start(cells, coarse, bands.radar, pulse), iterations=iterations, tolerance_rad=tolerance_rad
    )
    std = (1 / torch.sqrt(2 * 10 ** (coarse.info["snr_db"] / 10))).clamp_max(math.pi)
    return Estimate(
        {**coarse.value, **fine.value},
        quality=coarse.quality,
        ok=coarse.ok & (std < ENOUGH_STD_RAD),
        std={**coarse.std, "phase_rad": std[..., None].expand_as(fine["phase_rad"])},
        info={**coarse.info, **fine.info},
    )


@torch.no_grad()
def _start(cells: Tensor, coarse: Estimate, radar: TriangularLadar, pulse: Axis) -> Tensor | None:
    """Phases (..., pulse) by PGA for trials whose velocities integrate to a random walk of more
    than half a radian (brief 000, section 7), zero for the others.
    """
    drift = (
        4
        * math.pi
        / radar.wavelength_m
        * integrated_range_detrended_bound_m(coarse.std["velocity_m_s"][..., 0], pulse.step, pulse.n)
    )
    far = coarse.ok & (drift > _FAR_RAD)
    if pulse.n < _FEW_PERIODS or not bool(far.any()):
        return None
    return torch.where(
        far[..., None], pga(cells.detach(), windows=_WINDOWS, iterations=len(_WINDOWS.cells))["phase_rad"], 0
    )


def deramped_lines(bands: Bands, velocity_m_s: Tensor, pulse: Axis) -> Tensor:
    """Range cells of the window (..., pulse, line) of the up sweeps, the motion and the azimuth
    phase of a scatterer at azimuth zero taken out.
    """
    radar, m = bands.radar, bands.time_s.shape[-1]
    turns = carrier_turns(sweep_motion(velocity_m_s, radar, pulse), radar)[..., 0, :, :]
    left = torch.cat(
        [turns[..., :1], turns[..., 1:2] - (bands.shift.to(torch.float64) / radar.sweep_s)[..., None], turns[..., 2:]],
        -1,
    )
    still = bands.up * polynomial_phasor(-left, radar.sweep_s / m, m, bands.up.dtype)
    lines = torch.arange(bands.first, bands.first + bands.lines, device=still.device)
    cells = torch.fft.fft(still)[..., lines % m] / m
    middle, _ = profile_axes(pulse, radar)
    range_ = Axis("range", bands.lines, bands.first * radar.range_step_m, radar.range_step_m, "m")
    return deramp_azimuth(cells, radar, middle, range_)


def range_error(estimate: Estimate, radar: TriangularLadar, pulse: Axis, at_s: Tensor) -> Tensor:
    """Range error (m) at slow times at_s, any shape, of any estimate of the radial motion: (...,
    *at_s.shape) float64.

    The integral of its velocities, zero at the first turning point, and lambda / (4 pi) times its
    phases of pulses where it has them, by cubic splines.
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
