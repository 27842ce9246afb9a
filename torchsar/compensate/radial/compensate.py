"""Taking a known radial motion out of dechirped sweeps, exactly."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import refuse_other_sweeps
from torchsar.compensate.radial.trajectory import sweep_motion
from torchsar.core import Axis, cis, linear_phasor, real_dtype, unit_phasor
from torchsar.radar import TriangularLadar

_NEGLIGIBLE_TURNS, _MANY_TURNS = {torch.float32: 1e-8, torch.float64: 1e-15}, 2.0


def compensate_motion(
    sweeps: Tensor, velocity_m_s: Tensor, radar: TriangularLadar, pulse: Axis, carrier_only: bool = False
) -> Tensor:
    """Sweeps times exp(-+ j 4 pi f(u) DR / c) at every sample, f(u) = fc +- K u, DR the integral of
    the velocity (brief 000, erratum 11).

    sweeps: (..., 2, pulse, N), up before down, in the radar's dechirp sign; velocity_m_s: (...,
    pulse) at the turning points. Takes out the phase of the carrier, the motion of the envelope,
    and acceleration inside sweeps. carrier_only: fc in place of f(u), the form that the paper
    prints, which leaves the envelopes where motion took them. Differentiable. Raises TypeError or
    ValueError for other sweeps or a velocity of another shape.
    """
    refuse_other_sweeps(sweeps, radar, "compensate_motion", pulse)
    refuse_other_velocity(velocity_m_s, sweeps, "compensate_motion")
    coefficients = sweep_motion(velocity_m_s, radar, pulse)
    n = sweeps.shape[-1]
    turns = carrier_turns(coefficients, radar, carrier_only)
    if radar.dechirp_sign == "lo_conj_echo":
        turns = -turns
    return sweeps * polynomial_phasor(turns, radar.sweep_s / n, n, sweeps.dtype)


def refuse_other_velocity(velocity_m_s: Tensor, sweeps: Tensor, what: str) -> None:
    """Raise ValueError unless there is one finite velocity a period."""
    if not isinstance(velocity_m_s, Tensor) or velocity_m_s.is_complex():
        raise TypeError(
            f"{what} needs a tensor of real velocities (m/s), got "
            f"{getattr(velocity_m_s, 'dtype', type(velocity_m_s).__name__)}"
        )
    if velocity_m_s.ndim < 1 or velocity_m_s.shape[-1] != sweeps.shape[-2]:
        raise ValueError(
            f"{what} needs one velocity a period (..., {sweeps.shape[-2]}), got shape {tuple(velocity_m_s.shape)}"
        )
    try:
        finite = bool(torch.isfinite(velocity_m_s.detach()).all())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not finite:
        raise ValueError(
            f"{what}: {int((~torch.isfinite(velocity_m_s.detach())).sum())} velocities are NaN or "
            "Inf; take an estimate whose `ok` is true, or settle them first"
        )


def carrier_turns(motion: Tensor, radar: TriangularLadar, carrier_only: bool = False) -> Tensor:
    """Turns 2 f(u) DR(u) / c as polynomials in u, (..., 2, pulse, 6), from the motion (..., 2,
    pulse, 5) of `sweep_motion`.
    """
    per_m = 2 * radar.carrier_hz / radar.wave_speed_m_s
    turns = torch.nn.functional.pad(motion * per_m, (0, 1))
    if carrier_only:
        return turns
    slope = torch.tensor([1.0, -1.0], dtype=torch.float64, device=motion.device)[:, None, None] * (
        2 * radar.chirp_rate_hz_s / radar.wave_speed_m_s
    )
    return turns + torch.nn.functional.pad(motion * slope, (1, 0))


def polynomial_phasor(turns: Tensor, step_s: float, n: int, dtype: torch.dtype) -> Tensor:
    """exp(2j pi sum_k turns[..., k] u^k) at u_i = (i - (n - 1) / 2) step_s, (..., n).

    turns: float64 (..., k).

    Constant and slope by short float64 tables; what bends is small, and is turned in the working
    precision, if it is there at all.
    """
    start = -(n - 1) / 2
    total = unit_phasor(turns[..., 0], dtype)[..., None] * linear_phasor(turns[..., 1] * step_s, start, n, dtype)
    real = real_dtype(dtype)
    u = (start + torch.arange(n, dtype=torch.float64, device=turns.device)) * step_s
    edge = abs(start) * step_s
    bend: Tensor | None = None
    for k in range(turns.shape[-1] - 1, 1, -1):
        c = turns[..., k]
        if not turns.requires_grad and _largest(c) * edge**k <= _NEGLIGIBLE_TURNS[real]:
            continue
        # a bend of many turns needs float64; a small one does not
        exact = real == torch.float64 or _largest(c) * edge**k > _MANY_TURNS
        term = c[..., None] * u**k if exact else (c * edge**k).to(real)[..., None] * (u / edge).pow(k).to(real)
        bend = term if bend is None else bend + term
    if bend is None:
        return total
    return total * (
        cis(2 * torch.pi * bend)
        if bend.dtype == real and _largest(bend) < 2 * _MANY_TURNS
        else unit_phasor(bend.to(torch.float64), dtype)
    )


def _largest(x: Tensor) -> float:
    """Largest magnitude, infinite inside vmap, where a value cannot be looked at."""
    try:
        return float(x.detach().abs().max())
    except RuntimeError:
        return torch.inf
