"""Radial velocity from the product of the up sweep and the mirrored down sweep."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, bands_of, refuse_other_sweeps
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.newton import climbed, step_uphill
from torchsar.compensate.radial.verdict import velocity_estimate
from torchsar.core import Axis, Estimate, cis, take
from torchsar.radar import TriangularLadar

Intercept = Literal["known", "record", "free"]
_PAD, _NEWTON = 2, 3
# bins of 1 / T about the shift, which is known to a bin or two, in which the tone of the product is
# sought
_REACH = 6


def mirror_product(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    window_m: tuple[float, float] | None = None,
    intercept: Intercept = "known",
    taper: float = 1.0,
    azimuth_m: Tensor | float = 0.0,
) -> Estimate:
    """Radial velocity at the turning points, value["velocity_m_s"] (..., pulse), for any scene in
    range (brief 000, section 5a).

    sweeps: (..., 2, pulse, N). z(u) = up(u) conj(down(-u)) pairs equal optical frequencies: z =
    |scene(u)|^2 exp(-j 4 pi / c (fc + K u) (T - 2u) v), whatever lies in the window; acceleration
    cancels about the turning point, jerk is left. intercept: "known" uses that z is real at the
    turning point, which needs the trigger timing and lowers the variance four times; "free" takes
    the slope alone; "record" estimates one constant offset for the whole record, for timing that is
    not known but stands still. window_m: relative ranges (low, high), None for the whole band; it
    follows the Doppler shift. taper: see `bands_of`. azimuth_m: x of the scene's centre, whose
    geometric velocity is taken out.

    std: predicted from the measured SNR with the squaring loss. info: snr_db (post-compression),
    shift, intercept_rad (...,) with "record". Differentiable: the peak search is detached, Newton
    steps refine around it. Raises TypeError or ValueError for other sweeps or a window that is
    none.
    """
    refuse_other_sweeps(sweeps, radar, "mirror_product", pulse)
    refuse_other_intercept(intercept)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        return mirror_estimate(bands_of(sweeps, radar, window_m, taper, oversampling=2), pulse, intercept, azimuth_m)

    return by_trials(estimator, sweeps, azimuth_m)


def refuse_other_intercept(intercept: str) -> None:
    """Raise ValueError for what is no kind of intercept."""
    if intercept not in get_args(Intercept):
        raise ValueError(f"intercept must be 'known', 'record' or 'free', got {intercept!r}")


def mirror_estimate(bands: Bands, pulse: Axis, intercept: Intercept, azimuth_m: Tensor | float) -> Estimate:
    """The estimate from bands of two samples a line."""
    velocity, info = mirror_velocity(bands, intercept)
    return velocity_estimate(
        velocity,
        bands,
        pulse,
        factor=3.0 if intercept == "free" else 0.75,
        azimuth_m=azimuth_m,
        squared=True,
        info=info,
    )


def mirror_velocity(bands: Bands, intercept: Intercept) -> tuple[Tensor, dict[str, Tensor]]:
    """Velocity (..., pulse) float64 with the geometric one in it, and what else was found."""
    inner = bands.inner
    u = bands.time_s[inner]
    z = bands.product()[..., inner]
    z = z / z.detach().abs().mean(-1, keepdim=True).clamp_min(torch.finfo(z.real.dtype).tiny)
    z = z * _of_shift(bands, u, z)
    free = _slope(z, u, bands, 1 if intercept == "known" else _NEWTON)
    if intercept == "free":
        return bands.shift_m_s + free, {}
    if intercept == "known":
        return bands.shift_m_s + _through_zero(z, u, free, bands), {}
    offset = torch.angle((_turned(z, u, free, bands).sum(-1).to(torch.complex128)).sum(-1, keepdim=True))
    steady = z * cis(-offset[..., None]).to(z.dtype)
    return bands.shift_m_s + _through_zero(steady, u, free, bands), {"intercept_rad": offset[..., 0]}


def _of_shift(bands: Bands, u: Tensor, like: Tensor) -> Tensor:
    """What the shift of whole bins leaves in the product beyond its line: exp(2j pi s K u / fc (1 -
    2u / T)), see brief 000, erratum 8.
    """
    radar = bands.radar
    small = 2 * math.pi * radar.chirp_rate_hz_s * u / radar.carrier_hz * (1 - 2 * u / radar.sweep_s)
    return cis((bands.shift.to(torch.float64)[..., None] * small).to(like.real.dtype))


def _weights(u: Tensor, bands: Bands) -> Tensor:
    """rad per m/s that a velocity turns the product by, (m,): -4 pi / c (fc + K u) (T - 2u)."""
    radar = bands.radar
    return (
        -4 * math.pi / radar.wave_speed_m_s * (radar.carrier_hz + radar.chirp_rate_hz_s * u) * (radar.sweep_s - 2 * u)
    )


def _turned(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    return z * cis(-v[..., None].to(z.real.dtype) * _weights(u, bands).to(z.real.dtype))


def _slope(z: Tensor, u: Tensor, bands: Bands, steps: int) -> Tensor:
    """The velocity of greatest |sum z exp(-j w v)|, (..., pulse): the peak of a padded transform,
    then Newton steps.
    """
    n, per = z.shape[-1], 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s
    spectrum = torch.fft.fft(z.detach(), _PAD * n)
    power = spectrum.real.square() + spectrum.imag.square()
    reach = min(round(_REACH * _PAD * n / bands.time_s.shape[-1]), n // 2)
    best = torch.cat([power[..., -reach:], power[..., : reach + 1]], -1).argmax(-1) - reach
    best = best + _parabola(power, best)
    v = best.to(torch.float64) / (_PAD * n * float(u[1] - u[0]) * per)
    return climbed(z, 2 * math.pi * per * u, v, steps)


def _parabola(power: Tensor, best: Tensor) -> Tensor:
    n = power.shape[-1]
    low, mid, high = (take(power, (best + k) % n) for k in (-1, 0, 1))
    bend = low - 2 * mid + high
    return torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0)


def _through_zero(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    """The velocity of greatest Re sum z exp(-j w v) next to v: the line through zero phase at the
    turning point.
    """
    w = _weights(u, bands).to(z.real.dtype)
    for _ in range(_NEWTON):
        turned = _turned(z, u, v, bands)
        gradient = (turned.imag * w).sum(-1)
        bend = -(turned.real * w * w).sum(-1)
        v = v + step_uphill(gradient, bend)
    return v
