"""Along-track interferometry: slant-range velocity from the Doppler of a deramped point.

The channels are deramped with the phase history of an assumed motion, and two quantities are
measured. The first is the phase slope across the channels: an error dy of the along-track position
gives the phase -2 pi dx dy / (lambda R0) in the channel at the along-track position dx. The second
is the frequency F of the residual tone. The updates are y0 <- y0 + dy for the along-track position
and u_r <- u_r + lambda F - v dy / R0 for the slant-range speed. R0 is the closest range, and v the
along-track speed of the receiver relative to the point.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.check import checked_channels
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.ambiguity import warned_of_ambiguity
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import Found, covariance_of, estimate_of, phase_slopes, point_phasor
from torchsar.radar import BistaticRadar

# Zero padding: the parabola then errs by at most 0.004 of a Doppler cell, without padding by 0.23.
_PAD = 4
# Variance over that of the joint least-squares fit, since tone and slope are measured in turn: 1.3
# squared in u_r and y0, from -10 to 60 dB per sample, with direct echoes and simulated ones.
_LOSS = 1.7
_TINY = torch.finfo(torch.float64).tiny  # keeps divisions by zero finite
# Detection threshold over all samples, -15 dB per sample with three channels and 810 pulses: below
# it the strongest tone is often one of noise.
DETECTED_DB = 19.0


def interferometry(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    passes: int = 4,
    check_ambiguity: bool = True,
) -> Estimate:
    """Estimate slant-range speed and position of one point per trial by along-track interferometry.

    The first pass weights all pulses equally. Later passes weight them by the expected amplitude of
    a point at the position found so far. The slant-range speed u_r is measured modulo lambda PRF
    and returned within lambda PRF / 2 of the start. The along-track speed u_a keeps the value of
    the start.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Instrument with at least two channels.
        start: Starting motion, shape (...,).
        aperture: Expected amplitude over slow time.
        passes: Number of passes, each of which starts from the result of the previous one.
        check_ambiguity: Whether to check that the velocity is not wrong by lambda * PRF, in about
            10 ms per trial. Where it is wrong, a warning is given and `ok` is False.

    Returns:
        `u_r_m_s` (closing positive), `u_a_m_s` and `y0_m` of shape (...,). Standard deviations of
        u_r and y0 follow from the residual noise. `info` holds `snr_db` (over all samples) and
        `noise_power` (per sample), and with `check_ambiguity` also `pulse_rates`, the number of
        PRFs to add to the Doppler (-1, 0 or 1). `ok` is False where `snr_db` is below 19 or
        `pulse_rates` is not zero.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if the radar has a single channel.
    """
    data = checked_channels(data, radar, "interferometry")
    if radar.channels < 2:
        raise ValueError(
            "interferometry needs two channels or more, got 1: one channel cannot separate position and "
            "velocity; use data of more channels"
        )
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    motion, data = start, data.to(torch.complex128)
    for number in range(passes):
        weight = torch.ones_like(time_s) if number == 0 else aperture.weight(radar, motion, time_s)
        motion = _improved(data, radar, motion, weight, time_s)
    found = _fit_at(data, radar, motion, aperture.weight(radar, motion, time_s), time_s)
    snr = found.snr_db
    estimate = estimate_of(found, snr >= DETECTED_DB, _quality(snr))
    return warned_of_ambiguity(estimate, data, radar, motion, aperture) if check_ambiguity else estimate


def _quality(snr_db: Tensor) -> Tensor:
    """Map the SNR to 0..1, with one half at the threshold."""
    return torch.sigmoid((snr_db - DETECTED_DB) / 3)


def _improved(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> PointMotion:
    """Take one pass: estimate tone and phase slope, and update the motion."""
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    tone_hz = tone_frequency(deramped, radar.prf_hz)
    turn = torch.exp(-2j * math.pi * tone_hz[..., None] * time_s)
    across = _slope((deramped * turn[..., None, :]).sum(-1), radar.channels_at(data.device))
    dy = -across * radar.wavelength_m * motion.range_m / (2 * math.pi)
    # tone = du_r / lambda + v dy / (lambda R0), slope = -2 pi dy / (lambda R0)
    du = radar.wavelength_m * tone_hz - motion.along_m_s * dy / motion.range_m
    return replace(motion, u_r_m_s=motion.u_r_m_s + du, y0_m=motion.y0_m + dy)


def tone_frequency(tones: Tensor, rate_hz: float) -> Tensor:
    """Estimate the frequency of the tone of most power, summed over channels.

    A zero-padded FFT is followed by a parabola through its maximum.

    Args:
        tones: Samples, shape (..., channel, sample), complex.
        rate_hz: Sampling rate in Hz.

    Returns:
        Frequency in Hz within +-rate / 2, shape (...,).
    """
    n = tones.shape[-1]
    length = smooth_length(_PAD * n)
    power = torch.fft.fft(tones, length).abs().square().sum(-2)
    at = power.argmax(-1, keepdim=True)
    low, middle, high = (power.gather(-1, (at + shift) % length)[..., 0] for shift in (-1, 0, 1))
    bend = (low - 2 * middle + high).clamp_max(-_TINY)
    fine = (0.5 * (low - high) / bend).clamp(-0.5, 0.5)
    position = at[..., 0] + fine
    return torch.remainder(position + length / 2, length).sub(length / 2) * (rate_hz / length)


def _slope(values: Tensor, position_m: Tensor) -> Tensor:
    """Return the phase slope in rad/m of values (..., channel) over the channel positions."""
    order = position_m.argsort()
    values, position_m = values[..., order], position_m[order]
    step = values[..., 1:] * values[..., :-1].conj()
    first = torch.angle((step / position_m.diff()).sum(-1)) if len(set(position_m.diff().tolist())) == 1 else None
    if first is not None:
        rough = first / position_m.diff()[0]
    else:
        weight = step.abs() * position_m.diff()
        rough = (torch.angle(step) * weight).sum(-1) / (weight * position_m.diff()).sum(-1).clamp_min(_TINY)
    return rough + _straight(values * torch.exp(-1j * rough[..., None] * position_m), position_m)


def _straight(values: Tensor, position_m: Tensor) -> Tensor:
    """Return the slope of small phases by weighted least squares about their mean."""
    phase = torch.angle(values * values.sum(-1, keepdim=True).conj())
    weight = values.abs()
    total = weight.sum(-1, keepdim=True).clamp_min(_TINY)
    centred = position_m - (weight * position_m).sum(-1, keepdim=True) / total
    return (weight * centred * phase).sum(-1) / (weight * centred.square()).sum(-1).clamp_min(_TINY)


def _fit_at(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> Found:
    """Return the fit at a motion, with covariances of u_r and y0 from tone and slope."""
    weight = weight[..., None, :]
    illuminated = (weight != 0).expand(data.shape)
    energy_of_weight = weight.square().expand(data.shape).sum((-2, -1)).clamp_min(_TINY)
    amplitude = (weight * data * point_phasor(radar, motion, time_s, data.dtype).conj()).sum(
        (-2, -1)
    ) / energy_of_weight
    energy = amplitude.abs().square() * energy_of_weight
    noise = ((data.abs().square() * illuminated).sum((-2, -1)) - energy).clamp_min(0) / illuminated.sum(
        (-2, -1)
    ).clamp_min(1)
    slopes = phase_slopes(radar, motion, time_s, ("u_r_m_s", "y0_m")) * weight[..., None, :, :]
    total = (weight.square()[..., None, :, :] * torch.ones_like(slopes)).sum((-2, -1), keepdim=True).clamp_min(_TINY)
    flat = (
        slopes - weight[..., None, :, :] * (slopes * weight[..., None, :, :]).sum((-2, -1), keepdim=True) / total
    ).flatten(-2)
    normal = amplitude.abs().square()[..., None, None] * (flat @ flat.mT)
    return Found(motion, amplitude, noise, _LOSS * covariance_of(normal, noise), energy, ("u_r_m_s", "y0_m"))
