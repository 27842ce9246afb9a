"""Accuracy and reliability of an estimated radial velocity, from the measured SNR."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, filled
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Estimate, cis, settle

# SNR of a sweep after compression below which noise may exceed the peak in single periods and the
# gradient may slip: measured 1 slip in 1000 periods at 13 dB, none from 14 dB on
LEAST_SNR_DB = 14.0
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
    T is the length of a sweep and g the energy of a sweep over the noise variance of a sample.

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
        below 14 dB (with `squared`, where this SNR less the squaring loss is below 15 dB), where no
        scatterer is illuminated in any period, or where a velocity is not finite. `info` holds
        "snr_db", the SNR after compression, shape (...,); "shift", the Doppler shift removed from
        `bands` in whole bins, and "lit", False for periods in which no scatterer is illuminated,
        both of shape (..., pulse); and the entries given.
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
    enough = snr_db - 10 * torch.log10(loss) >= LEAST_SQUARED_DB if squared else snr_db >= LEAST_SNR_DB
    lit = signal > 0
    centre = (bands.first + bands.lines / 2) * radar.range_step_m if window_m is None else sum(window_m) / 2
    geometric = geometric_velocity_m_s(radar, pulse, azimuth_m, centre, velocity.device)
    return Estimate(
        {"velocity_m_s": velocity - geometric},
        quality=torch.where(lit, signal / (signal + noise).clamp_min(tiny), 0),
        ok=enough & finite.all(-1) & lit & bands.lit.any(-1),
        std={"velocity_m_s": std[..., None].expand_as(velocity)},
        info={"snr_db": snr_db, "shift": bands.shift, "lit": bands.lit, **(info or {})},
    )
