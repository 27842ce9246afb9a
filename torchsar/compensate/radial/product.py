"""Velocity of greatest likelihood in the product of the up sweep and the mirrored down sweep.

Peaks are found in transforms and refined by Newton steps. Gradients pass through the steps, but not
through the search.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands
from torchsar.compensate.radial.measured import Intercept
from torchsar.core import (
    cis,
    linear_phasor,
    power_of,
    take,
)
from torchsar.optim.scalar import vertex


def mirror_velocity(bands: Bands, intercept: Intercept) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute the velocity of `mirror_product`, with the geometric velocity still included.

    The geometric velocity is that of a static scatterer seen from the straight flight path.

    Args:
        bands: Filtered sweeps with two samples per bin.
        intercept: "known", "record" or "free", see `mirror_product`.

    Returns:
        The velocity in m/s, receding positive, shape (..., pulse), float64, and the entries that
        the estimate adds to its info.
    """
    inner = bands.inner
    u = bands.time_s[inner]
    z = bands.product()[..., inner]
    z = z / z.detach().abs().mean(-1, keepdim=True).clamp_min(torch.finfo(z.real.dtype).tiny)
    free = _slope(z, u, bands, 1 if intercept == "known" else 3)
    if intercept == "free":
        return bands.shift_m_s + free, {}
    if intercept == "known":
        return bands.shift_m_s + _through_zero(z, u, free, bands), {}
    offset = torch.angle((_turned(z, u, free, bands).sum(-1).to(torch.complex128)).sum(-1, keepdim=True))
    steady = z * cis(-offset[..., None]).to(z.dtype)
    return bands.shift_m_s + _through_zero(steady, u, free, bands), {"intercept_rad": offset[..., 0]}


def _weights(u: Tensor, bands: Bands) -> Tensor:
    """Derivative of the phase of the product with velocity, (m,): -4 pi / c (fc + K u) (T - 2u)."""
    radar = bands.radar
    return (
        -4 * math.pi / radar.wave_speed_m_s * (radar.carrier_hz + radar.chirp_rate_hz_s * u) * (radar.sweep_s - 2 * u)
    )


def _turned(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    """Remove the phase of the velocity v from the product."""
    return z * cis(-v[..., None].to(z.real.dtype) * _weights(u, bands).to(z.real.dtype))


def _slope(z: Tensor, u: Tensor, bands: Bands, steps: int) -> Tensor:
    """The velocity (..., pulse) of greatest |sum z exp(-j w v)|: the peak of a zero-padded
    transform, refined by Newton steps.
    """
    n, per = z.shape[-1], 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s
    power = power_of(torch.fft.fft(z.detach(), 2 * n))
    # the search covers 6 bins on either side, because the removed shift is correct to a bin or two
    reach = min(round(6 * 2 * n / bands.time_s.shape[-1]), n // 2)
    best = torch.cat([power[..., -reach:], power[..., : reach + 1]], -1).argmax(-1) - reach
    best = best + vertex(*(take(power, (best + k) % power.shape[-1]) for k in (-1, 0, 1)))
    v = best.to(torch.float64) / (2 * n * (u[1] - u[0]) * per)
    return climbed(z, float(bands.radar.sweep_s / bands.time_s.shape[-1] * per), v, steps)


def _through_zero(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    """Refine the velocity v to the one of greatest Re sum z exp(-j w v), with w of `_weights`.

    This is the likeliest velocity if the phase of z is zero at the turning point, where w = 0.
    """
    w = _weights(u, bands).to(z.real.dtype)
    for _ in range(3):  # three steps, enough to converge by trial
        turned = _turned(z, u, v, bands)
        v = v + step_uphill((turned.imag * w).sum(-1), -(turned.real * w * w).sum(-1))
    return v


def climbed(x: Tensor, turns: float, value: Tensor, steps: int) -> Tensor:
    """Refine, by Newton steps, the value v for which |sum_i x_i exp(-2j pi turns i v)| is greatest.

    Differentiable.

    Args:
        x: Samples x_i, shape (..., m), complex.
        turns: Change of phase from sample to sample, in turns per unit of v.
        value: Values of v to start from, shape (...,).
        steps: Number of Newton steps.

    Returns:
        The refined values, shape (...,), float64.
    """
    n = x.shape[-1]
    middle = (n - 1) / 2
    w = (torch.arange(n, dtype=torch.float64, device=x.device) - middle) * (2 * math.pi * turns)
    powers = torch.stack([torch.ones_like(w), w, w * w], -1).to(x.dtype)
    for _ in range(steps):
        turned = x * linear_phasor(-turns * value, -middle, n, x.dtype)
        s0, s1, s2 = (turned @ powers).unbind(-1)
        gradient = 2 * (s0.conj() * s1).imag
        bend = 2 * (power_of(s1) - (s0.conj() * s2).real)
        value = value + step_uphill(gradient, bend)
    return value


def step_uphill(gradient: Tensor, bend: Tensor) -> Tensor:
    """Compute the Newton step towards a maximum; zero where the objective is not concave.

    Args:
        gradient: First derivative of the objective, any shape.
        bend: Second derivative of the objective, same shape.

    Returns:
        The step, same shape, float64.
    """
    concave = bend < 0
    return torch.where(concave, -gradient / torch.where(concave, bend, -1), 0).to(torch.float64)
