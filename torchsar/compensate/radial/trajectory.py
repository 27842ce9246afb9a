"""Range error by integration of radial velocities, and its exact compensation in sweeps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import SWEEPS, refuse_other_sweeps
from torchsar.core import (
    Axis,
    Signal,
    Stage,
    checked_samples,
    cis,
    host_largest,
    host_values,
    linear_phasor,
    per_trial,
    real_dtype,
    refuse_non_finite,
    refuse_non_finite_values,
    unit_phasor,
)
from torchsar.core.spline import Spline
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
    return Spline(v, (grid.start, grid.step)).integral(at_s)


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
    spline = Spline(v, (grid.start, grid.step))
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
    """Coefficients of cubics (..., n, 4) about the points `at` (n,), from those about zero."""
    terms = ([math.comb(j, k) * cubic[..., j] * at ** (j - k) for j in range(k, 4)] for k in range(4))
    return torch.stack([torch.stack(of_power).sum(0) for of_power in terms], -1)


def compensate_motion(
    sweeps: Tensor, velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis, carrier_only: bool = False
) -> Tensor:
    """Remove a radial motion from dechirped sweeps.

    Every sample is multiplied by exp(-j 4 pi f(u) DR(u) / c) for the dechirp sign "lo_conj_echo" of
    the radar, and by the conjugate for "echo_conj_lo". Here u is the time from the middle of the
    sweep, c the propagation speed, and DR(u) the range error, which is the integral of the
    velocity. The optical frequency f(u) is fc + K u in up sweeps and fc - K u in down sweeps, with
    carrier frequency fc and chirp rate K. This removes the phase of the carrier, the motion of the
    envelope, and the effect of acceleration inside the sweeps. Differentiable.

    Args:
        sweeps: Sweeps of N samples, up before down, in the dechirp sign of the radar, shape
            (..., 2, pulse, N), complex.
        velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s, receding
            positive, shape (..., pulse).
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        carrier_only: True takes fc in place of f(u), as the equations of the reference are printed.
            The envelopes then remain displaced by the motion.

    Returns:
        The compensated sweeps, shape (..., 2, pulse, N), complex.

    Raises:
        TypeError: If the sweeps are not complex, or the velocity is not a real tensor.
        ValueError: If there are no samples, or if the sweeps or the velocity have another shape or
            are not finite.

    Reference:
        Remote Sens. 2024, 16, 793, Eqs. (21) and (23), completed by the term K u.
    """
    sweeps = checked_samples(sweeps, "compensate_motion", "ramp, pulse, fast time", finite=False)
    refuse_other_sweeps(sweeps, radar, "compensate_motion", pulse)
    if not isinstance(velocity_m_s, Tensor) or velocity_m_s.is_complex():
        raise TypeError(
            "compensate_motion: velocity_m_s must be a tensor of real velocities (m/s), got "
            f"{getattr(velocity_m_s, 'dtype', type(velocity_m_s).__name__)}"
        )
    if velocity_m_s.ndim < 1 or velocity_m_s.shape[-1] != sweeps.shape[-2]:
        raise ValueError(
            "compensate_motion: velocity_m_s must hold one velocity per period, shape (..., "
            f"{sweeps.shape[-2]}), got shape {tuple(velocity_m_s.shape)}"
        )
    advice = "use an estimate whose `ok` is True, or replace these velocities first"
    refuse_non_finite(velocity_m_s, "compensate_motion", advice, "velocities")
    n, sign = sweeps.shape[-1], -1 if radar.dechirp_sign == "lo_conj_echo" else 1
    turns = sign * carrier_turns(sweep_motion(velocity_m_s, radar, pulse), radar, carrier_only)
    return sweeps * polynomial_phasor(turns, radar.sweep_s / n, n, sweeps.dtype)


def carrier_turns(motion: Tensor, radar: TriangularLadar, carrier_only: bool = False) -> Tensor:
    """Compute the phase that a range error DR(u) causes in both sweeps, as polynomials in u.

    The phase is 2 f(u) DR(u) / c in turns, with u the time from the middle of the sweep and f(u) =
    fc + K u in up sweeps and fc - K u in down sweeps (carrier frequency fc, chirp rate K).

    Args:
        motion: Coefficients of DR(u) by power of u, in m/s^k, shape (..., 2, pulse, 5), see
            `sweep_motion`.
        radar: Ladar parameters.
        carrier_only: True takes fc in place of f(u).

    Returns:
        Coefficients by power of u, in turns/s^k, shape (..., 2, pulse, 6).
    """
    turns = torch.nn.functional.pad(motion * (2 * radar.carrier_hz / radar.wave_speed_m_s), (0, 1))
    if carrier_only:
        return turns
    sign = torch.arange(1, -2, -2, dtype=torch.float64, device=motion.device)
    slope = sign[:, None, None] * (2 * radar.chirp_rate_hz_s / radar.wave_speed_m_s)
    return turns + torch.nn.functional.pad(motion * slope, (1, 0))


def polynomial_phasor(turns: Tensor, step_s: float, n: int, dtype: torch.dtype) -> Tensor:
    """Compute exp(2j pi sum_k turns[..., k] u^k) at the times u_i = (i - (n - 1) / 2) step_s.

    The constant and the linear term are formed from short tables in float64. Higher terms of more
    than two turns are formed in float64 too, smaller ones in the precision of `dtype`; negligible
    ones are skipped.

    Args:
        turns: Coefficients by power of u, in turns/s^k, shape (..., power), float64.
        step_s: Sample spacing in seconds.
        n: Number of samples.
        dtype: Complex type of the result.

    Returns:
        The phasor, shape (..., n), complex.
    """
    start = -(n - 1) / 2
    total = unit_phasor(turns[..., 0], dtype)[..., None] * linear_phasor(turns[..., 1] * step_s, start, n, dtype)
    real = real_dtype(dtype)
    u = (start + torch.arange(n, dtype=torch.float64, device=turns.device)) * step_s
    edge = abs(start) * step_s
    bend: Tensor | None = None
    # largest magnitude of each power of u; infinite inside vmap, where values cannot be read
    sizes = turns.detach().abs().reshape(-1, turns.shape[-1])
    largest = host_values(sizes.amax(0), math.inf) if turns.numel() else [math.inf] * turns.shape[-1]
    reach = [size * edge**k for k, size in enumerate(largest)]
    for k in range(len(reach) - 1, 1, -1):
        c = turns[..., k]
        # a term this small is lost in the rounding of a phasor
        if not turns.requires_grad and reach[k] <= (1e-8 if real == torch.float32 else 1e-15):
            continue
        # a term of more than two turns needs float64: the rounding of float32 grows with the phase
        exact = real == torch.float64 or reach[k] > 2
        term = c[..., None] * u**k if exact else (c * edge**k).to(real)[..., None] * (u / edge).pow(k).to(real)
        bend = term if bend is None else bend + term
    if bend is None:
        return total
    small = bend.dtype == real and (sum(reach[2:]) < 4 or host_largest(bend.detach().abs(), math.inf) < 4)
    return total * (cis(2 * torch.pi * bend) if small else unit_phasor(bend.to(torch.float64), dtype))


class CompensateMotion(Stage):
    """Stage that compensates the radial motion `velocity_m_s`; see `compensate_motion`.

    >>> from torchsar import Draws, compensate, echo, radar, scene
    >>> ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> world = scene.LadarWorld(scene.Points([0.0], [0.0]), [scene.Polynomial([0.1])])
    >>> recording, truth = echo.simulate_ladar(ladar, world, 8, Draws(1))
    >>> still = compensate.CompensateMotion(ladar)(recording.signal, truth.values["velocity_m_s"])
    >>> [x.data.mean().abs().round(decimals=1) for x in (recording.signal, still)]
    [tensor(0.), tensor(1.)]

    The velocity usually comes from an earlier stage such as `MirrorProduct`.

    Args:
        radar: Ladar parameters.
        carrier_only: True compensates the phase of the carrier only; the envelopes then remain
            displaced by the motion.
    """

    works_on = SWEEPS

    def __init__(self, radar: TriangularLadar, carrier_only: bool = False) -> None:
        super().__init__()
        self.radar, self.carrier_only = radar, carrier_only

    def forward(self, signal: Signal, velocity_m_s: Tensor) -> Signal:
        """Remove the radial motion from sweeps of axes (ramp, pulse, fast_time).

        Args:
            signal: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
            velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s,
                receding positive, shape (..., pulse).

        Returns:
            The compensated sweeps.
        """
        return signal.with_data(
            compensate_motion(signal.data, velocity_m_s, self.radar, signal.axis("pulse"), self.carrier_only)
        )
