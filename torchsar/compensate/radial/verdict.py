"""Accuracy and reliability of an estimated radial velocity, from the measured SNR."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, filled
from torchsar.compensate.radial.newton import climbed
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Estimate, cis, settle

# SNR of a sweep after compression below which noise may exceed the peak in single periods and the
# gradient may slip: measured 1 slip in 1000 periods at 13 dB, none from 14 dB on; the measured SNR
# has an error of a decibel or two
LEAST_SNR_DB = 16.0
# Periods differ from the peaks of the product by so many standard deviations by chance; a larger
# difference of this share of wavelength over sweep length contradicts the velocities, if it occurs
# in more than a twentieth of the periods; zero-padding.
_SURE, _CONTRADICTION, _CHANCE, _PAD = 1.5, 0.06, 0.05, 2
# bias of these peaks in bins of the beat, which filters and noise-free interference leave; least
# share of an echo in its mean over the record, and over what noise alone would give
_BIAS, _DARK, _CLEAR = 0.003, 0.2, 3.0
LEAST_SQUARED_DB = 15.0  # the same for a product of sweeps, after the squaring loss, found by trial


def signal_and_noise(bands: Bands, residual_m_s: Tensor) -> tuple[Tensor, Tensor]:
    """Measure the mean power per sample of the scene and of the noise.

    After the motion is removed, the power that the up sweep and the mirrored down sweep have in
    common is taken as scene, and the rest as noise.

    Args:
        bands: Filtered sweeps.
        residual_m_s: Radial velocity minus that of the Doppler shift already removed from `bands`,
            in m/s, shape (..., pulse).

    Returns:
        The powers of scene and noise, shape (...,) each, float64.
    """
    inner = bands.inner
    up, down = bands.up.detach()[..., inner], bands.down.detach()[..., inner]
    turns = 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s * residual_m_s.detach()
    static = cis((-2 * math.pi * turns[..., None] * bands.time_s[inner]).to(up.real.dtype))
    weight = bands.lit.to(torch.float64)
    weight = weight / weight.sum(-1, keepdim=True).clamp_min(1)
    shared = ((up * down.conj() * static).mean(-1).abs().to(torch.float64) * weight).sum(-1)
    total = (
        sum(((x.real.square() + x.imag.square()).mean(-1).to(torch.float64) * weight).sum(-1) for x in (up, down)) / 2
    )
    # the magnitude of a mean of noise is not zero: what noise alone would give counts as no signal
    chance = total / math.sqrt(min(up.shape[-1], 2 * bands.noise_lines))
    signal = torch.where(shared > 1.5 * chance, shared, 0).clamp_max(total)
    return signal, total - signal


@torch.no_grad()
def _product_peaks(bands: Bands) -> tuple[Tensor, Tensor]:
    """Velocities in m/s of the peaks of the product of up and mirrored down sweeps, (..., pulse).

    The velocity of the Doppler shift already removed from the bands is not included. The peaks are
    searched over all velocities. Periods with an echo are marked True: what both sweeps share is
    then a fifth of the mean over the record or more, and three times what noise alone would share.
    """
    inner = bands.inner
    u = bands.time_s[inner]
    z = bands.up[..., inner] * bands.down[..., inner].conj()
    level = z.abs().mean(-1, keepdim=True)
    z = z / level.clamp_min(torch.finfo(z.real.dtype).tiny)
    spectrum = torch.fft.fft(z, _PAD * z.shape[-1])
    n = spectrum.shape[-1]
    bins = (spectrum.real.square() + spectrum.imag.square()).argmax(-1)
    bins = torch.where(bins >= n // 2, bins - n, bins)
    per = 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s
    peak = climbed(z, 2 * math.pi * per * u, bins.to(torch.float64) / (n * float(u[1] - u[0]) * per), 2)
    shared = spectrum.abs().amax(-1).to(torch.float64) * level[..., 0] / z.shape[-1]
    chance = level.to(torch.float64).mean(-2) / math.sqrt(min(z.shape[-1], 2 * bands.noise_lines))
    return peak, shared > torch.maximum(_DARK * shared.mean(-1, keepdim=True), _CLEAR * chance)


def _unexplained(difference: Tensor, lit: Tensor, std: Tensor) -> Tensor:
    """Rms of differences (..., pulse) in the lit periods, beyond what noise explains, (...,)."""
    weight = lit.to(torch.float64)
    square = (difference.square() * weight).sum(-1) / weight.sum(-1).clamp_min(1)
    return (square - (_SURE * std).square()).clamp_min(0).sqrt()


def velocity_estimate(
    velocity_m_s: Tensor,
    bands: Bands,
    pulse: Axis,
    *,
    factor: float,
    azimuth_m: Tensor | float,
    squared: bool = False,
    floor_m_s: float = 0.0,
    window_m: tuple[float, float] | None = None,
    info: dict[str, Tensor] | None = None,
) -> Estimate:
    """Complete a measured radial velocity to an estimate with its accuracy and reliability.

    The variance is factor * (lambda / 2)^2 / ((2 pi T)^2 g), plus the square of `floor_m_s`, where
    T is the length of a sweep and g the energy of a sweep over the noise variance of a sample. To
    this is added the part of the mean squared difference from the peaks of the product of up and
    mirrored down sweeps that noise does not explain: interference of scatterers, or aliased motion.
    Methods that use this product themselves (`squared`) are only judged by it.

    Args:
        velocity_m_s: Measured velocity at the turning points (ends of the up sweeps) in m/s, shape
            (..., pulse). It still includes the geometric velocity of a static scatterer, see
            `geometric_velocity_m_s`.
        bands: Filtered sweeps.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        factor: Factor of the variance, which depends on the method of measurement.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).
        squared: True for a method that multiplies sweeps with each other; the variance then
            includes the squaring loss at low SNR.
        floor_m_s: Standard deviation in m/s that remains however strong the signal.
        window_m: Lowest and highest range of the scene in metres, relative to the reference range,
            if `bands` holds a wider range.
        info: Further entries for `info` of the estimate.

    Returns:
        `velocity_m_s` of shape (..., pulse), receding positive, without the geometric velocity,
        with its standard deviation. In periods in which no scatterer is illuminated, the velocity
        is interpolated between the neighbouring periods. `quality` is the share of the power in the
        window that both sweeps have in common. `ok` is False where the SNR after compression is
        below 16 dB (with `squared`, where this SNR less the squaring loss is below 15 dB), where
        the product of up and mirrored down sweeps contradicts the velocities, where no scatterer is
        illuminated in any period, or where a velocity is not finite. `info` holds "snr_db", the SNR
        after compression, and "noise_m_s", the standard deviation that is due to noise, shape
        (...,) each; "shift", the Doppler shift removed from `bands` in whole bins, and "lit", False
        for periods in which no scatterer is illuminated, both of shape (..., pulse); and the
        entries given.
    """
    radar, tiny = bands.radar, torch.finfo(torch.float64).tiny
    velocity, finite = settle(filled(velocity_m_s, bands.lit), 0.0)
    signal, noise = signal_and_noise(bands, velocity - bands.shift_m_s)
    ratio = (signal / noise.clamp_min(tiny)).clamp(1e-6, 1e18)
    after = ratio * bands.noise_lines  # energy of a sweep over the noise variance of a sample
    loss = 1 + 1 / (2 * ratio) if squared else torch.ones_like(ratio)
    std = torch.hypot(
        radar.wavelength_m / 2 * torch.sqrt(factor * loss / after) / (2 * math.pi * radar.sweep_s),
        torch.tensor(floor_m_s, dtype=torch.float64, device=after.device),
    )
    snr_db = 10 * torch.log10(after)
    squared_db = snr_db - 10 * torch.log10(1 + 1 / (2 * ratio))
    enough = squared_db >= LEAST_SQUARED_DB if squared else snr_db >= LEAST_SNR_DB
    noise_std = std
    peaks, echo = _product_peaks(bands)
    clear = [x.clamp_min(tiny) for x in signal_and_noise(bands, peaks)]
    best = (clear[0] / clear[1]).clamp(1e-6, 1e18)
    best_after, best_loss = best * bands.noise_lines, 1 + 1 / (2 * best)
    free = radar.wavelength_m / 2 * torch.sqrt(3 * best_loss / best_after) / (2 * math.pi * radar.sweep_s)
    biased = (free.square() + (_BIAS * radar.wavelength_m / (2 * radar.sweep_s)) ** 2).sqrt()
    least = _CONTRADICTION * radar.wavelength_m / radar.sweep_s
    clear_enough = 10 * torch.log10(best_after / best_loss) >= LEAST_SQUARED_DB
    away = (velocity - bands.shift_m_s - peaks).detach()
    off = echo & (away.abs() > least)
    contradicted = clear_enough & (off.sum(-1) > _CHANCE * echo.sum(-1))
    excess = _unexplained(away, echo & ~off, torch.hypot(std, biased)).where(clear_enough, 0)
    if not squared:
        std = torch.hypot(std, excess)
    lit = signal > 0
    centre = (bands.first + bands.lines / 2) * radar.range_step_m if window_m is None else sum(window_m) / 2
    geometric = geometric_velocity_m_s(radar, pulse, azimuth_m, centre, velocity.device)
    return Estimate(
        {"velocity_m_s": velocity - geometric},
        quality=torch.where(lit, signal / (signal + noise).clamp_min(tiny), 0),
        ok=enough & finite.all(-1) & lit & bands.lit.any(-1) & ~contradicted,
        std={"velocity_m_s": std[..., None].expand_as(velocity)},
        info={"snr_db": snr_db, "noise_m_s": noise_std, "shift": bands.shift, "lit": bands.lit, **(info or {})},
    )
