"""Velocities of a moving point from its deramped tone: along-track autofocus and interferometry.

Along-track autofocus deramps the data with the phase history of each candidate of the along-track
speed; the right speed leaves the strongest tone. This is azimuth autofocus with a known form of the
phase history. The Doppler bands are not reconstructed. The method therefore also works at speeds at
which the channels sample the same positions, so that a reconstruction is singular.

Along-track interferometry deramps the channels with the phase history of an assumed motion, and
measures two quantities. The first is the phase slope across the channels: an error dy of the
along-track position gives the phase -2 pi dx dy / (lambda R0) in the channel at the along-track
position dx. The second is the frequency F of the residual tone. The updates are y0 <- y0 + dy for
the along-track position and u_r <- u_r + lambda F - v dy / R0 for the slant-range speed. R0 is the
closest range, and v the along-track speed of the receiver relative to the point.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.2, which prescribes autofocus for the along-track speed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, differentiable, unit_phasor
from torchsar.core.fft import smooth_length
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import checked_channels
from torchsar.multichannel.velocity.aperture import Aperture, Kept, seen_aperture
from torchsar.multichannel.velocity.assess import outcome_of_point
from torchsar.multichannel.velocity.model import (
    TINY,
    Found,
    centred_slopes,
    chosen,
    covariance_in,
    estimate_of,
    noise_beside,
    point_phasor,
    quality_of,
)
from torchsar.radar import BistaticRadar


def along_track_velocity(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    half_m_s: float = 20.0,
    step_m_s: float = 0.5,
    fine: int = 3,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the along-track speed u_a of a point of known slant-range speed and position.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, PointMotion
    >>> from torchsar.multichannel.velocity.along_track import along_track_velocity
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.zeros(3, 90, dtype=torch.complex64)
    >>> along_track_velocity(data, radar, PointMotion.of(radar, data.real), Dwell(0.5)).failed
    tensor(True)

    A grid with the step `step_m_s` is followed by `fine` grids of five points, each with 2/5 of the
    previous step. In every grid, a parabola through the maximum refines the speed.

    What is measured is the curvature of the phase. An acceleration along the line of sight
    therefore acts as a speed: 0.05 m/s^2 act as 0.42 m/s for a receiver at 300 m/s and a range of
    5 km.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        start: Motion about which u_a is searched, shape (...,). Its slant-range speed and
            along-track position are kept.
        aperture: Expected amplitude over slow time.
        half_m_s: Half width of the search in m/s.
        step_m_s: Step of the first grid in m/s.
        fine: Number of finer grids.
        assess: Whether standard deviation and outcome are assessed.

    Returns:
        `u_a_m_s` of shape (...,), positive in the flight direction of the receiver. Where the point
        is lit in a part of the aperture only, this part is used, see `seen_aperture`. The
        assessment adds the standard deviation, which follows from the curvature of the likelihood,
        and `snr_db`, the SNR over all samples, in `info`. Outcomes: those of `outcome_of_point`,
        and `OUTSIDE_SEARCH` where the maximum lies at an end of the search.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if `half_m_s` is not positive, or the search reaches the speed of the
            receiver.
    """
    data = checked_channels(data, radar, "along_track_velocity")
    if not half_m_s > 0:
        raise ValueError(
            f"half_m_s of a search along track must be positive, got {half_m_s}; omit the stage where u_a_m_s is known"
        )
    # this call raises ValueError for a search that reaches the speed of the receiver
    PointMotion.of(radar, data, 0.0, start.u_a_m_s + half_m_s)
    data = data.to(torch.complex128)
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    centre = start.u_a_m_s.expand(data.shape[:-2])
    count = 2 * max(1, round(half_m_s / step_m_s)) + 1
    offsets = torch.linspace(-half_m_s, half_m_s, count, dtype=torch.float64, device=data.device)
    step = 2 * half_m_s / (count - 1)
    u_a, energy, curvature, ended = _best(data, radar, start, aperture, centre, offsets)
    aperture, uneven = seen_aperture(data, radar, replace(start, u_a_m_s=u_a), aperture)
    if bool(uneven.any()):
        u_a, energy, curvature, ended = _best(data, radar, start, aperture, centre, offsets)
    # the ends of the aperture would move with u_a from pulse to pulse; from here on they are fixed
    seen = Kept(aperture.weight(radar, replace(start, u_a_m_s=u_a), time_s))
    for _ in range(fine):
        step = 2 * step / 5
        offsets = step * torch.arange(-2, 3, dtype=torch.float64, device=data.device)
        u_a, energy, curvature, _ = _best(data, radar, start, seen, u_a, offsets)
    found = torch.where(energy > 0, u_a.clamp(centre - half_m_s, centre + half_m_s), centre)
    if not assess:
        return Estimate({"u_a_m_s": found})
    return _assessed(data, radar, replace(start, u_a_m_s=found), seen, energy, curvature, ended)


def _best(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, centre: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the maximum over the grid centre + offsets, refined by a parabola.

    Returns its position, height and curvature, and whether it lies at an end of the grid.
    """
    power = torch.stack(
        [tone_power(data, radar, replace(start, u_a_m_s=centre + offset), aperture) for offset in offsets]
    )
    at, step = power.argmax(0), offsets[1] - offsets[0]
    inner = at.clamp(1, len(offsets) - 2)
    low, middle, high = (power.gather(0, (inner + shift)[None])[0] for shift in (-1, 0, 1))
    curvature = (low - 2 * middle + high).clamp_max(-TINY)
    edge = at != inner
    peak = offsets[inner] + step * (0.5 * (low - high) / curvature).clamp(-1, 1)
    return centre + torch.where(edge, offsets[at], peak), middle, -curvature / step.square(), edge


def tone_power(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """Return the energy of the strongest tone in the deramped data, summed over channels.

    If the motion gives the right curvature of the phase, this is the energy of the echo of the
    point.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        Energy, shape (...,).
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    spectrum = torch.fft.fft(deramped, smooth_length(4 * data.shape[-1])).abs().square().sum(-2)
    return spectrum.amax(-1) / weight.square().sum(-1).clamp_min(TINY)


def _assessed(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    energy: Tensor,
    curvature: Tensor,
    ended: Tensor,
) -> Estimate:
    """Assess the maximum, and form an estimate with standard deviation and outcome."""
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)[..., None, :]
    lit = (weight != 0).expand(data.shape)
    noise = ((data.abs().square() * lit).sum((-2, -1)) - energy).clamp_min(0) / lit.sum((-2, -1)).clamp_min(1)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj()
    tone_hz = tone_frequency(deramped * weight, radar.prf_hz)
    still = deramped * unit_phasor(-tone_hz[..., None, None] * time_s, data.dtype)
    # each channel has an amplitude of its own
    amplitude = (still * weight).sum(-1, keepdim=True) / weight.square().sum(-1, keepdim=True).clamp_min(TINY)
    beside = noise_beside(still - amplitude * weight, weight, amplitude, radar.channels + 2)
    spread = beside.diagonal(dim1=-2, dim2=-1).mean(-1) / curvature.clamp_min(TINY)
    variance = torch.where(energy > 0, spread, torch.inf)
    found = Found(motion, energy.sqrt(), noise, variance[..., None, None], energy, ("u_a_m_s",))
    outcome, _ = outcome_of_point(data, radar, found, aperture, [(Outcome.OUTSIDE_SEARCH, ended)])
    std, info = {"u_a_m_s": variance.sqrt()}, {"snr_db": found.snr_db}
    return Estimate({"u_a_m_s": motion.u_a_m_s}, std, quality_of(found.snr_db), outcome, info)


@differentiable("where ok")
def interferometry(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    passes: int = 4,
    check_ambiguity: bool = True,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate slant-range speed and position of one point per trial by along-track interferometry.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, PointMotion, interferometry
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.ones(1, 3, 180, dtype=torch.complex128)  # a point that moves with the receiver
    >>> interferometry(data, radar, PointMotion.of(radar, data), Dwell(1.0), assess=False).ok
    tensor([True])

    The first pass weights all pulses equally. Later passes weight them by the expected amplitude of
    a point at the position found so far. The slant-range speed u_r is measured modulo lambda PRF
    and returned within lambda PRF / 2 of the start. Only the cubic phase shows a speed beyond it,
    which a short aperture does not show at a low SNR: pass `check_ambiguity=False` where the start
    is known to be so near. The along-track speed u_a keeps the value of the start. Where the point
    is lit in a part of the aperture only, this part is used, see `seen_aperture`.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Instrument with at least two channels.
        start: Starting motion, shape (...,).
        aperture: Expected amplitude over slow time.
        passes: Number of passes, each of which starts from the result of the previous one.
        check_ambiguity: Whether the assessment asks if the velocity may be wrong by lambda PRF. A
            warning is given where it is.
        assess: Whether the outcome is assessed.

    Returns:
        `u_r_m_s` (closing positive), `u_a_m_s` and `y0_m` of shape (...,). Standard deviations of
        u_r and y0 follow from the residual noise. `info` holds `snr_db` (over all samples) and
        `noise_power` (per sample), and with `check_ambiguity` also `pulse_rates`, the number of
        PRFs to add to the Doppler (-1, 0 or 1). Outcomes: those of `outcome_of_point`.

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
    data = data.to(torch.complex128)
    found, aperture = interfered(data, radar, start, aperture, passes)
    if not assess:
        return estimate_of(found)
    everywhere = torch.ones_like(found.energy, dtype=torch.bool)
    inside = (lambda _: everywhere) if check_ambiguity else None
    return estimate_of(found, *outcome_of_point(data, radar, found, aperture, inside=inside, assumed=True))


def interfered(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, passes: int = 4
) -> tuple[Found, Aperture]:
    """Return the fit of `interferometry`, and the aperture in which the point is seen.

    Args:
        data: Channels, shape (..., channel, pulse), complex128.
        radar: Radar parameters.
        start: Starting motion, shape (...,).
        aperture: Expected amplitude over slow time.
        passes: Number of passes.

    Returns:
        The fit and the aperture.
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    motion = _begun(data, radar, start, time_s)
    aperture, _ = seen_aperture(data, radar, motion, aperture)
    for _ in range(passes - 1):
        motion = _improved(data, radar, motion, aperture.weight(radar, motion, time_s), time_s)
    return _fit_at(data, radar, motion, aperture.weight(radar, motion, time_s), time_s), aperture


def _begun(data: Tensor, radar: BistaticRadar, start: PointMotion, time_s: Tensor) -> PointMotion:
    """Find the slant-range speed for the first pass, at which the strongest tone is sharpest.

    The cubic phase of a point grows with its speed, and would favour weaker points of less speed.
    """
    span, even = radar.ambiguous_velocity_m_s, torch.ones_like(time_s)
    best = start.each(lambda value: value.expand(data.shape[:-2]))
    most = torch.zeros(data.shape[:-2], dtype=torch.float64, device=data.device)
    # nine starts, by choice: at 3 m/s from the nearest one, the cubic phase lowers the tone by at
    # most 1 dB
    for offset in torch.linspace(-span / 2, span / 2, 9, dtype=torch.float64, device=data.device):
        there = replace(best, u_r_m_s=(start.u_r_m_s + offset).expand(most.shape))
        deramped = data * point_phasor(radar, there, time_s, data.dtype).conj()
        power = torch.fft.fft(deramped, smooth_length(2 * data.shape[-1])).abs().square().sum(-2).amax(-1)
        best, most = chosen(there, best, power > most), torch.maximum(power, most)
    found = _improved(data, radar, best, even, time_s)
    beyond = torch.round((found.u_r_m_s - start.u_r_m_s) / span)
    return replace(found, u_r_m_s=found.u_r_m_s - span * beyond)


def _improved(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> PointMotion:
    """Make one pass: estimate tone and phase slope, and update the motion."""
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    tone_hz = tone_frequency(deramped, radar.prf_hz)
    turn = torch.exp(-2j * math.pi * tone_hz[..., None] * time_s)
    across = _slope((deramped * turn[..., None, :]).sum(-1), radar.channels_at(data.device))
    dy = -across * radar.wavelength_m * motion.range_m / (2 * math.pi)
    # the tone is du_r / lambda + v dy / (lambda R0), the slope -2 pi dy / (lambda R0)
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
    # padded four times, the parabola has an error of at most 0.004 of a Doppler cell, unpadded one
    # of 0.23
    length = smooth_length(4 * tones.shape[-1])
    power = torch.fft.fft(tones, length).abs().square().sum(-2)
    at = power.argmax(-1, keepdim=True)
    low, middle, high = (power.gather(-1, (at + shift) % length)[..., 0] for shift in (-1, 0, 1))
    bend = (low - 2 * middle + high).clamp_max(-TINY)
    fine = (0.5 * (low - high) / bend).clamp(-0.5, 0.5)
    return torch.remainder(at[..., 0] + fine + length / 2, length).sub(length / 2) * (rate_hz / length)


def _slope(values: Tensor, position_m: Tensor) -> Tensor:
    """Return the phase slope in rad/m of values (..., channel) over the channel positions."""
    order = position_m.argsort()
    values, position_m = values[..., order], position_m[order]
    step, gap_m = values[..., 1:] * values[..., :-1].conj(), position_m.diff()
    if len(set(gap_m.tolist())) == 1:
        rough = torch.angle((step / gap_m).sum(-1)) / gap_m[0]
    else:
        weight = step.abs() * gap_m
        rough = (torch.angle(step) * weight).sum(-1) / (weight * gap_m).sum(-1).clamp_min(TINY)
    # the remaining phases are small, so that weighted least squares about their mean suffice
    values = values * torch.exp(-1j * rough[..., None] * position_m)
    phase = torch.angle(values * values.sum(-1, keepdim=True).conj())
    weight = values.abs()
    total = weight.sum(-1, keepdim=True)
    centred = position_m - (weight * position_m).sum(-1, keepdim=True) / torch.where(total > 0, total, 1)
    spread = (weight * centred.square()).sum(-1)
    return rough + (weight * centred * phase).sum(-1) / torch.where(spread > 0, spread, 1)


def _fit_at(data: Tensor, radar: BistaticRadar, motion: PointMotion, weight: Tensor, time_s: Tensor) -> Found:
    """Return the fit at a motion, with covariances of u_r and y0 from tone and slope."""
    weight = weight[..., None, :]
    illuminated = (weight != 0).expand(data.shape)
    energy_of_weight = weight.square().expand(data.shape).sum((-2, -1)).clamp_min(TINY)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj()
    amplitude = (weight * deramped).sum((-2, -1)) / energy_of_weight
    energy = amplitude.abs().square() * energy_of_weight
    noise = ((data.abs().square() * illuminated).sum((-2, -1)) - energy).clamp_min(0) / illuminated.sum(
        (-2, -1)
    ).clamp_min(1)
    level = amplitude[..., None, None]
    beside = noise_beside(deramped - level * weight, weight, level, 3)
    # derivatives of tone and phase slope with respect to u_r and y0; other effects of u_r and y0
    # are not used
    v, near = (x[..., None, None] for x in (motion.along_m_s, motion.range_m))
    by_y0 = (v * time_s - radar.channels_at(time_s.device)[:, None]) / near
    slopes = 2 * math.pi / radar.wavelength_m * torch.stack([time_s.expand_as(by_y0), by_y0], -3)
    slopes = centred_slopes(slopes, weight)
    return Found(motion, amplitude, noise, covariance_in(beside, slopes, amplitude), energy, ("u_r_m_s", "y0_m"))
