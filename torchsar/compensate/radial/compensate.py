"""Exact compensation of a known radial motion in dechirped sweeps of a triangular-FMCW ladar."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import refuse_other_sweeps
from torchsar.compensate.radial.trajectory import sweep_motion
from torchsar.core import (
    Axis,
    checked_samples,
    cis,
    host_largest,
    host_value,
    host_values,
    linear_phasor,
    real_dtype,
    unit_phasor,
)
from torchsar.radar import TriangularLadar

# phases in turns that are lost in the rounding of a phasor, by precision
_NEGLIGIBLE_TURNS = {torch.float32: 1e-8, torch.float64: 1e-15}
_MANY_TURNS = 2.0  # phases beyond it need float64: the rounding of float32 grows with the phase


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
    wrong = ~torch.isfinite(velocity_m_s.detach())
    if host_value(wrong.any(), False):
        raise ValueError(
            f"compensate_motion: {int(wrong.sum())} velocities are NaN or "
            "Inf; use an estimate whose `ok` is True, or replace these velocities first"
        )
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
    # largest magnitude of each power; infinite inside vmap, where values cannot be read
    sizes = turns.detach().abs().reshape(-1, turns.shape[-1])
    largest = host_values(sizes.amax(0), math.inf) if turns.numel() else [math.inf] * turns.shape[-1]
    reach = [size * edge**k for k, size in enumerate(largest)]
    for k in range(len(reach) - 1, 1, -1):
        c = turns[..., k]
        if not turns.requires_grad and reach[k] <= _NEGLIGIBLE_TURNS[real]:
            continue
        # a term of many turns needs float64, a small one does not
        exact = real == torch.float64 or reach[k] > _MANY_TURNS
        term = c[..., None] * u**k if exact else (c * edge**k).to(real)[..., None] * (u / edge).pow(k).to(real)
        bend = term if bend is None else bend + term
    if bend is None:
        return total
    return total * (
        cis(2 * torch.pi * bend)
        if bend.dtype == real
        and (sum(reach[2:]) < 2 * _MANY_TURNS or host_largest(bend.detach().abs(), math.inf) < 2 * _MANY_TURNS)
        else unit_phasor(bend.to(torch.float64), dtype)
    )
