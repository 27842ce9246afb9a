"""Radial velocity from the product of the up sweep and the mirrored down sweep."""

from __future__ import annotations

import math
from typing import get_args

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, bands_of, refuse_other_sweeps
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.newton import climbed, step_uphill
from torchsar.compensate.radial.verdict import Intercept, velocity_estimate
from torchsar.core import Axis, Estimate, cis, power_of, take
from torchsar.radar import TriangularLadar

_PAD = 2  # zero-padding of the transform, enough for the Newton steps to converge
_NEWTON = 3  # Newton steps, found by trial: enough to converge from the parabola
_REACH = 6  # bins about the removed shift that are searched; the shift is right to a bin or two


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
    """Estimate the radial velocity from the product of the up sweep and the mirrored down sweep.

    Let u be the time from the middle of a sweep, fc the carrier frequency and K the chirp rate. The
    product z(u) = up(u) conj(down(-u)) combines two samples of equal optical frequency fc + K u.
    Therefore z(u) = |scene(u)|^2 exp(-j 4 pi / c (fc + K u) (T - 2u) v), with the radial velocity
    v, the length T of a sweep and the propagation speed c, whatever scatterers lie in the window.
    The two samples lie symmetrically about the turning point, the end of the up sweep, so that
    acceleration cancels; jerk remains. Differentiable, except for the peak search, whose result
    Newton steps refine.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band. The window follows the Doppler shift.
        intercept: What is assumed of the phase of z at the turning point, u = T / 2. "known" takes
            it as zero; this requires accurate trigger timing and lowers the variance by a factor of
            four. "free" assumes nothing and uses only the slope of the phase. "record" estimates
            one constant phase for the whole record, for an unknown but constant timing error.
        taper: Share of the window that its edges take, see `bands_of`.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,). The radial
            velocity that the straight flight causes there is subtracted, see
            `geometric_velocity_m_s`.

    Returns:
        `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps), receding
        positive. In periods without an echo, or whose echo has faded, it is interpolated. The
        velocity is that of the centre of power of the echo: a centre at another azimuth than
        `azimuth_m` adds a nearly constant velocity, which displaces the image and is not part of
        the standard deviation. The standard deviation is measured: noise and the interference of
        scatterers of random phases change the power of the echo as much as its phase, so that the
        changes of power between both sweeps give it. Where many scatterers have equal phases, the
        error may be four times as large. `ok` is False where the SNR after
        compression, less the squaring loss, is below 15 dB, where the standard deviation exceeds
        0.035 lambda / T, where the peaks of the product over all velocities contradict the result,
        or no scatterer is illuminated in any period. `info` holds "snr_db" (after compression) and
        "noise_m_s" (standard deviation that noise explains), shape (...,); "shift" (Doppler shift
        in whole bins) and "lit" (True in periods with an echo), shape (..., pulse); and, with
        intercept "record", "intercept_rad", the estimated phase, shape (...,).

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, the window or the intercept are invalid.
    """
    refuse_other_sweeps(sweeps, radar, "mirror_product", pulse)
    refuse_other_intercept(intercept)

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        return mirror_estimate(bands_of(sweeps, radar, window_m, taper, oversampling=2), pulse, intercept, azimuth_m)

    return by_trials(estimator, sweeps, azimuth_m)


def refuse_other_intercept(intercept: str) -> None:
    """Check the option `intercept` of `mirror_product`.

    Args:
        intercept: The value given.

    Raises:
        ValueError: If the value is not "known", "record" or "free".
    """
    if intercept not in get_args(Intercept):
        raise ValueError(f"intercept must be 'known', 'record' or 'free', got {intercept!r}")


def mirror_estimate(bands: Bands, pulse: Axis, intercept: Intercept, azimuth_m: Tensor | float) -> Estimate:
    """Estimate the radial velocity as `mirror_product` does, from sweeps that are already filtered.

    Args:
        bands: Sweeps filtered to the range window and resampled to two samples per frequency bin of
            the window.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        intercept: "known", "record" or "free", see `mirror_product`.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).

    Returns:
        The `Estimate` that the function `mirror_product` returns.
    """
    velocity, info = mirror_velocity(bands, intercept)
    return velocity_estimate(
        velocity,
        bands,
        pulse,
        factor=3.0 if intercept == "free" else 0.75,
        azimuth_m=azimuth_m,
        intercept=intercept,
        info=info,
    )


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
    spectrum = torch.fft.fft(z.detach(), _PAD * n)
    power = power_of(spectrum)
    reach = min(round(_REACH * _PAD * n / bands.time_s.shape[-1]), n // 2)
    best = torch.cat([power[..., -reach:], power[..., : reach + 1]], -1).argmax(-1) - reach
    best = best + _parabola(power, best)
    v = best.to(torch.float64) / (_PAD * n * (u[1] - u[0]) * per)
    return climbed(z, 2 * math.pi * per * u, v, steps)


def _parabola(power: Tensor, best: Tensor) -> Tensor:
    """Offset of the vertex of the parabola through a peak and its neighbours, in bins."""
    n = power.shape[-1]
    low, mid, high = (take(power, (best + k) % n) for k in (-1, 0, 1))
    bend = low - 2 * mid + high
    return torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0)


def _through_zero(z: Tensor, u: Tensor, v: Tensor, bands: Bands) -> Tensor:
    """The velocity of greatest Re sum z exp(-j w v) near v.

    The phase of the product is then zero at the turning point.
    """
    w = _weights(u, bands).to(z.real.dtype)
    for _ in range(_NEWTON):
        turned = _turned(z, u, v, bands)
        gradient = (turned.imag * w).sum(-1)
        bend = -(turned.real * w * w).sum(-1)
        v = v + step_uphill(gradient, bend)
    return v
