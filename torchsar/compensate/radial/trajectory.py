"""Range error by integration of radial velocities, and the velocity that straight flight causes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Axis, per_trial, refuse_non_finite_values
from torchsar.core.spline import UniformSpline
from torchsar.radar import TriangularLadar, sweep_middles


def turning_points(radar: TriangularLadar, pulse: Axis) -> Axis:
    """Compute the slow times at which the up sweeps end and the down sweeps begin.

    These turning points lie half a period after the starts of the periods.

    Args:
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.

    Returns:
        Axis of the turning points in seconds.
    """
    return Axis("pulse", pulse.n, pulse.start + radar.period_s / 2, pulse.step, "s")


def geometric_velocity_m_s(
    radar: TriangularLadar,
    pulse: Axis,
    azimuth_m: Tensor | float = 0.0,
    relative_range_m: float = 0.0,
    device: torch.device | str | None = None,
) -> Tensor:
    """Compute the radial velocity of a static scatterer that the straight flight causes.

    It is V (V t - x) / R at slow time t, with platform speed V and the azimuth x and range R of the
    scatterer. It is computed at the turning points between up and down sweeps. A velocity estimated
    from the echo contains it. If it were compensated like a motion error, the azimuth phase history
    would be removed.

    Args:
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        azimuth_m: Azimuth x of the scatterer in metres, a number or shape (...,).
        relative_range_m: Range R of the scatterer minus the reference range of the radar in metres.
        device: Device of the result.

    Returns:
        The velocity in m/s, receding positive, shape (..., pulse), float64.
    """
    t = turning_points(radar, pulse).values(device)
    along_m = radar.speed_m_s * t - per_trial(azimuth_m, 1, t)
    return radar.speed_m_s * along_m / (radar.reference_range_m + relative_range_m)


def integrated_range(velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis, at_s: Tensor) -> Tensor:
    """Integrate radial velocities to the range error at any slow time.

    The range error is the antiderivative of the cubic spline through the velocities, zero at the
    first turning point. A sum of rectangles would have errors of micrometres. Differentiable.

    Args:
        velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse).
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        at_s: Slow times in seconds, any shape.

    Returns:
        The range error in metres, shape (..., *at_s.shape), float64.
    """
    refuse_non_finite_values("integrated_range", velocity_m_s=velocity_m_s, at_s=at_s)
    grid = turning_points(radar, pulse)
    v = velocity_m_s.to(torch.float64)
    if pulse.n == 1:
        return v.reshape(*v.shape[:-1], *(1,) * at_s.ndim) * (at_s - grid.start)
    return UniformSpline(v, grid.start, grid.step).integral(at_s)


def sweep_motion(velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis) -> Tensor:
    """Compute the range error over both sweeps of every period as polynomials.

    The range error is the integral of the cubic spline through the velocities, zero at the first
    turning point. Over a sweep it is DR(u) = sum_k c_k u^k, with u the time from the middle of the
    sweep. The polynomials are exact: the knots of the spline are the turning points, so each sweep
    lies in one piece of the spline.

    Args:
        velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse).
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.

    Returns:
        Coefficients, shape (..., 2, pulse, 5), up before down, float64; c_k in m/s^k.
    """
    v, grid = velocity_m_s.to(torch.float64), turning_points(radar, pulse)
    middles = sweep_middles(radar, pulse, v.device)
    if pulse.n == 1:
        constant = v[..., None, :] * (middles - grid.start)
        return torch.nn.functional.pad(torch.stack([constant, v[..., None, :].expand_as(constant)], -1), (0, 3))
    spline = UniformSpline(v, grid.start, grid.step)
    pieces = spline.pieces()
    before = torch.cat([pieces[..., :1, :], pieces], -2)
    after = torch.cat([pieces, pieces[..., -1:, :]], -2)
    since = torch.full((pulse.n,), pulse.step - radar.sweep_s / 2, dtype=torch.float64, device=v.device)
    since[0] = -radar.sweep_s / 2
    until = torch.full((pulse.n,), radar.sweep_s / 2, dtype=torch.float64, device=v.device)
    until[-1] = pulse.step + radar.sweep_s / 2
    moved = torch.stack([_recentred(before, since), _recentred(after, until)], -3)
    order = torch.arange(1, 5, dtype=torch.float64, device=v.device)
    return torch.cat([spline.integral(middles)[..., None], moved / order], -1)


def _recentred(cubic: Tensor, at: Tensor) -> Tensor:
    """Coefficients about `at` (n,) of cubics (..., n, 4) given about zero."""
    terms = ([math.comb(j, k) * cubic[..., j] * at ** (j - k) for j in range(k, 4)] for k in range(4))
    return torch.stack([torch.stack(of_power).sum(0) for of_power in terms], -1)
