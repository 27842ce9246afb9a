"""From radial velocities at turning points to the range error at any time, and the geometry that an
estimate contains.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Axis, per_trial
from torchsar.core.spline import UniformSpline
from torchsar.radar import TriangularLadar, sweep_middles


def turning_points(radar: TriangularLadar, pulse: Axis) -> Axis:
    """Slow times of the turning points, half a period after the starts of the periods."""
    return Axis("pulse", pulse.n, pulse.start + radar.period_s / 2, pulse.step, "s")


def geometric_velocity_m_s(
    radar: TriangularLadar,
    pulse: Axis,
    azimuth_m: Tensor | float = 0.0,
    relative_range_m: float = 0.0,
    device: torch.device | str | None = None,
) -> Tensor:
    """Radial velocity V (V t - x) / R at the turning points of a scatterer that does not move,
    (..., pulse) float64 (brief 000, erratum 14).

    azimuth_m: x, a number or one per trial. An estimate from the echo contains it; taken out as
    motion it would remove the azimuth phase history.
    """
    t = turning_points(radar, pulse).values(device)
    x = per_trial(azimuth_m, 1, t)
    return radar.speed_m_s * (radar.speed_m_s * t - x) / (radar.reference_range_m + relative_range_m)


def integrated_range(velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis, at_s: Tensor) -> Tensor:
    """Range error DR (m) at slow times at_s, any shape: the antiderivative of the cubic spline
    through velocities (..., pulse) at turning points.

    Zero at the first turning point; (..., *at_s.shape) float64. A sum of rectangles instead is
    wrong by micrometres (brief 000, section 5.5). Differentiable.
    """
    grid = turning_points(radar, pulse)
    v = velocity_m_s.to(torch.float64)
    if pulse.n == 1:
        return v.reshape(*v.shape[:-1], *(1,) * at_s.ndim) * (at_s - grid.start)
    return UniformSpline(v, grid.start, grid.step).integral(at_s)


def sweep_motion(velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis) -> Tensor:
    """Coefficients (..., 2, pulse, 5) of DR(u) = sum_k c_k u^k over the up and the down sweep of
    every period, u from the middle of the sweep.

    Exact for the spline: its knots are the turning points, so that each sweep lies in one piece.
    velocity_m_s: (..., pulse) at the turning points.
    """
    v = velocity_m_s.to(torch.float64)
    middles = sweep_middles(radar, pulse, v.device)
    if pulse.n == 1:
        place = v[..., None, :] * (middles - turning_points(radar, pulse).start)
        zero = torch.zeros_like(place)
        return torch.stack([place, v[..., None, :].expand_as(place), zero, zero, zero], -1)
    grid = turning_points(radar, pulse)
    spline = UniformSpline(v, grid.start, grid.step)
    pieces = spline.pieces()
    before = torch.cat([pieces[..., :1, :], pieces], -2)
    after = torch.cat([pieces, pieces[..., -1:, :]], -2)
    since = torch.full((pulse.n,), pulse.step - radar.sweep_s / 2, dtype=torch.float64, device=v.device)
    since[0] = -radar.sweep_s / 2
    until = torch.full((pulse.n,), radar.sweep_s / 2, dtype=torch.float64, device=v.device)
    until[-1] = pulse.step + radar.sweep_s / 2
    moved = torch.stack([_recentred(before, since), _recentred(after, until)], -3)
    place = spline.integral(middles)
    order = torch.arange(1, 5, dtype=torch.float64, device=v.device)
    return torch.cat([place[..., None], moved / order], -1)


def _recentred(cubic: Tensor, at: Tensor) -> Tensor:
    """Coefficients about `at` (n,) of cubics (..., n, 4) given about zero."""
    columns = []
    for k in range(4):
        terms = [math.comb(j, k) * cubic[..., j] * at ** (j - k) for j in range(k, 4)]
        columns.append(torch.stack(terms).sum(0))
    return torch.stack(columns, -1)
