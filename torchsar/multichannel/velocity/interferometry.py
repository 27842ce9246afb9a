"""Along-track interferometry: slant-range velocity from the Doppler of a deramped point, corrected
by the direction that the phase across the channels gives.

Source: brief 001, Velocity (ATI): a tone F and a phase slope -2 pi dx dy / (lambda R0) over the
channels' places; u_r <- u_r + lambda F - v dy / R0, y0 <- y0 + dy.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import Found, covariance_of, estimate_of, phase_slopes, point_phasor
from torchsar.radar import BistaticRadar

_PAD = 4
_TINY = torch.finfo(torch.float64).tiny
DETECTED_DB = 19.0


def interferometry(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, passes: int = 4
) -> Estimate:
    """u_r and y0 of one point per trial; u_a stays that of the start.

    data: complex (..., channel, pulse), transmit range removed.

    The first pass takes all pulses, later ones the aperture about the place found. u_r is known
    modulo lambda PRF and comes within half of that about the start. ok: the tone stands above the
    threshold of 19 dB over all samples (brief 001). std: of the estimator's own phases, from the
    noise that is left. Raises ValueError for one channel.
    """
    if radar.channels < 2:
        raise ValueError(
            "interferometry needs two channels or more: one channel cannot tell a place from a "
            "velocity; use the reconstruction with velocities that are told"
        )
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    motion, data = start, data.to(torch.complex128)
    for number in range(passes):
        weight = torch.ones_like(time_s) if number == 0 else aperture.weight(radar, motion, time_s)
        motion = _improved(data, radar, motion, weight, time_s)
    found = _judged(data, radar, motion, aperture.weight(radar, motion, time_s), time_s)
    snr = found.snr_db
    return estimate_of(found, snr >= DETECTED_DB, _quality(snr))


def _quality(snr_db: Tensor) -> Tensor:
    """0..1: half at the threshold."""
    return torch.sigmoid((snr_db - DETECTED_DB) / 3)


def _improved(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> PointMotion:
    """One pass: tone, phase slope, and the motion that they mean."""
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    tone_hz = tone_frequency(deramped, radar.prf_hz)
    turn = torch.exp(-2j * math.pi * tone_hz[..., None] * time_s)
    across = _slope((deramped * turn[..., None, :]).sum(-1), radar.channels_at(data.device))
    dy = -across * radar.wavelength_m * motion.range_m / (2 * math.pi)
    # tone = du_r / lambda + v dy / (lambda R0), slope = -2 pi dy / (lambda R0)
    du = radar.wavelength_m * tone_hz - motion.along_m_s * dy / motion.range_m
    return replace(motion, u_r_m_s=motion.u_r_m_s + du, y0_m=motion.y0_m + dy)


def tone_frequency(tones: Tensor, rate_hz: float) -> Tensor:
    """Frequency (Hz) at which the power summed over channels is greatest, (..., channel, sample) ->
    (...,): padded FFT and a parabola.
    """
    n = tones.shape[-1]
    length = smooth_length(_PAD * n)
    power = torch.fft.fft(tones, length).abs().square().sum(-2)
    at = power.argmax(-1, keepdim=True)
    low, middle, high = (power.gather(-1, (at + shift) % length)[..., 0] for shift in (-1, 0, 1))
    bend = (low - 2 * middle + high).clamp_max(-_TINY)
    fine = (0.5 * (low - high) / bend).clamp(-0.5, 0.5)
    place = at[..., 0] + fine
    return torch.remainder(place + length / 2, length).sub(length / 2) * (rate_hz / length)


def _slope(values: Tensor, place_m: Tensor) -> Tensor:
    """Phase slope (rad/m) of complex values (..., channel) over their places, by the phases of
    neighbours in place, weighted by power and spacing.
    """
    order = place_m.argsort()
    values, place_m = values[..., order], place_m[order]
    step = values[..., 1:] * values[..., :-1].conj()
    first = torch.angle((step / place_m.diff()).sum(-1)) if len(set(place_m.diff().tolist())) == 1 else None
    if first is not None:
        rough = first / place_m.diff()[0]
    else:
        weight = step.abs() * place_m.diff()
        rough = (torch.angle(step) * weight).sum(-1) / (weight * place_m.diff()).sum(-1).clamp_min(_TINY)
    return rough + _straight(values * torch.exp(-1j * rough[..., None] * place_m), place_m)


def _straight(values: Tensor, place_m: Tensor) -> Tensor:
    """Slope of phases that are small already, by weighted least squares about their mean."""
    phase = torch.angle(values * values.sum(-1, keepdim=True).conj())
    weight = values.abs()
    total = weight.sum(-1, keepdim=True).clamp_min(_TINY)
    centred = place_m - (weight * place_m).sum(-1, keepdim=True) / total
    return (weight * centred * phase).sum(-1) / (weight * centred.square()).sum(-1).clamp_min(_TINY)


def _judged(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> Found:
    """What the motion explains, and deviations of u_r and y0 by tone and slope."""
    weight = weight[..., None, :]
    shines = (weight != 0).expand(data.shape)
    energy_of_weight = weight.square().expand(data.shape).sum((-2, -1)).clamp_min(_TINY)
    amplitude = (weight * data * point_phasor(radar, motion, time_s, data.dtype).conj()).sum(
        (-2, -1)
    ) / energy_of_weight
    energy = amplitude.abs().square() * energy_of_weight
    noise = ((data.abs().square() * shines).sum((-2, -1)) - energy).clamp_min(0) / shines.sum((-2, -1)).clamp_min(1)
    slopes = phase_slopes(radar, motion, time_s, ("u_r_m_s", "y0_m")) * weight[..., None, :, :]
    total = (weight.square()[..., None, :, :] * torch.ones_like(slopes)).sum((-2, -1), keepdim=True).clamp_min(_TINY)
    flat = (
        slopes - weight[..., None, :, :] * (slopes * weight[..., None, :, :]).sum((-2, -1), keepdim=True) / total
    ).flatten(-2)
    normal = amplitude.abs().square()[..., None, None] * (flat @ flat.mT)
    return Found(motion, amplitude, noise, covariance_of(normal, noise), energy, ("u_r_m_s", "y0_m"))
