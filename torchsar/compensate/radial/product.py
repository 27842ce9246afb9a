"""Radial velocity in the product of the up sweep and the mirrored down sweep."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands
from torchsar.compensate.radial.measured import Intercept, Law, Measured
from torchsar.compensate.radial.newton import climbed, step_uphill
from torchsar.core import cis, power_of, take

# zero-padding of the transform and number of Newton steps, found by trial: enough to converge
_PAD, _NEWTON = 2, 3


def mirror_measured(bands: Bands, intercept: Intercept) -> Measured:
    """Measure the radial velocity as `mirror_product` does, in sweeps that are already filtered.

    Args:
        bands: Sweeps filtered to the range window, with two samples per bin.
        intercept: "known", "record" or "free", see `mirror_product`.

    Returns:
        The velocities.
    """
    velocity, info = mirror_velocity(bands, intercept)
    return Measured.of(velocity, bands, Law(3.0 if intercept == "free" else 0.75, intercept), **info)


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
    free = _slope(z, u, bands, 1 if intercept == "known" else _NEWTON)
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
    """The product with the phase of the velocity v removed."""
    return z * cis(-v[..., None].to(z.real.dtype) * _weights(u, bands).to(z.real.dtype))


def _slope(z: Tensor, u: Tensor, bands: Bands, steps: int) -> Tensor:
    """The velocity (..., pulse) of greatest |sum z exp(-j w v)|.

    The peak of a zero-padded transform, refined by Newton steps.
    """
    n, per = z.shape[-1], 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s
    power = power_of(torch.fft.fft(z.detach(), _PAD * n))
    # 6 bins about the removed shift, which is right to a bin or two
    reach = min(round(6 * _PAD * n / bands.time_s.shape[-1]), n // 2)
    best = torch.cat([power[..., -reach:], power[..., : reach + 1]], -1).argmax(-1) - reach
    # the vertex of the parabola through a peak and its neighbours
    low, mid, high = (take(power, (best + k) % power.shape[-1]) for k in (-1, 0, 1))
    bend = low - 2 * mid + high
    best = best + torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0)
    v = best.to(torch.float64) / (_PAD * n * (u[1] - u[0]) * per)
    return climbed(z, float(bands.radar.sweep_s / bands.time_s.shape[-1] * per), v, steps)


def _through_zero(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    """The velocity of greatest Re sum z exp(-j w v) near v.

    The phase of the product is then zero at the turning point.
    """
    w = _weights(u, bands).to(z.real.dtype)
    for _ in range(_NEWTON):
        turned = _turned(z, u, v, bands)
        v = v + step_uphill((turned.imag * w).sum(-1), -(turned.real * w * w).sum(-1))
    return v
