"""Along-track velocity of a moving point by the power of its deramped tone: autofocus for one known
phase history, no reconstruction needed.

Source: brief 001, Velocity (u_a): tone power over a grid, coarse to fine. It never inverts a band
matrix, so that speeds at which channels sample the same places do it no harm.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.interferometry import DETECTED_DB
from torchsar.multichannel.velocity.model import energy_ratio_db, point_phasor
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny


def along_track_velocity(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    half_m_s: float = 20.0,
    step_m_s: float = 0.5,
    fine: int = 3,
) -> Estimate:
    """u_a within +-half_m_s of the start, u_r and y0 being those of the start.

    data: complex (..., channel, pulse), transmit range removed.

    A grid of step_m_s, then `fine` grids of five, each a fifth as wide, and a parabola. std: from
    the curvature of the likelihood of the tone. ok: not at the end of the search, and the tone
    stands above the threshold. What is measured is the curvature of the phase: an acceleration
    along the line of sight looks the same (brief 001: 0.05 m/s^2 as 0.42 m/s).
    """
    if not half_m_s > 0:
        raise ValueError(
            f"half_m_s of a search along track must be positive, got {half_m_s}; where u_a is "
            "known there is nothing to search"
        )
    # refuses a search up to the receiver's speed
    PointMotion.of(radar, data, 0.0, start.u_a_m_s + half_m_s)
    data = data.to(torch.complex128)
    centre = start.u_a_m_s.expand(data.shape[:-2])
    count = 2 * max(1, round(half_m_s / step_m_s)) + 1
    offsets = torch.linspace(-half_m_s, half_m_s, count, dtype=torch.float64, device=data.device)
    step = 2 * half_m_s / (count - 1)
    top = _best(data, radar, start, aperture, centre, offsets)
    ended = top.edge
    for _ in range(fine):
        step = 2 * step / 5
        top = _best(
            data,
            radar,
            start,
            aperture,
            top.u_a_m_s,
            step * torch.arange(-2, 3, dtype=torch.float64, device=data.device),
        )
    found = torch.where(top.energy > 0, top.u_a_m_s.clamp(centre - half_m_s, centre + half_m_s), centre)
    return _judged(data, radar, replace(start, u_a_m_s=found), aperture, top.energy, top.curvature, ended)


class _Top(NamedTuple):
    """Of tone energies over a grid, per trial: where they peak, how high, how sharply, and whether
    that is an end of the grid.
    """

    u_a_m_s: Tensor
    energy: Tensor
    curvature: Tensor
    edge: Tensor


def _best(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, centre: Tensor, offsets: Tensor
) -> _Top:
    """By the greatest of the grid centre + offsets (even steps) and a parabola through its
    neighbours.
    """
    power = torch.stack(
        [tone_power(data, radar, replace(start, u_a_m_s=centre + offset), aperture) for offset in offsets]
    )
    at, step = power.argmax(0), offsets[1] - offsets[0]
    inner = at.clamp(1, len(offsets) - 2)
    low, middle, high = (power.gather(0, (inner + shift)[None])[0] for shift in (-1, 0, 1))
    bend = (low - 2 * middle + high).clamp_max(-_TINY)
    edge = at != inner
    peak = offsets[inner] + step * (0.5 * (low - high) / bend).clamp(-1, 1)
    return _Top(centre + torch.where(edge, offsets[at], peak), middle, -bend / step.square(), edge)


def tone_power(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """Greatest energy of a tone in the deramped data, summed over channels, (...,): energy of the
    point where the curvature is right.
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    spectrum = torch.fft.fft(deramped, smooth_length(4 * data.shape[-1])).abs().square().sum(-2)
    return spectrum.amax(-1) / weight.square().sum(-1).clamp_min(_TINY)


def _judged(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    energy: Tensor,
    bend: Tensor,
    ended: Tensor,
) -> Estimate:
    weight = aperture.weight(radar, motion, radar.pulse_axis(data.shape[-1]).values(data.device))[..., None, :]
    shines = (weight != 0).expand(data.shape)
    noise = ((data.abs().square() * shines).sum((-2, -1)) - energy).clamp_min(0) / shines.sum((-2, -1)).clamp_min(1)
    snr = energy_ratio_db(energy, noise)
    value = {"u_a_m_s": motion.u_a_m_s}
    ok = (snr >= DETECTED_DB) & ~ended
    std = torch.where(energy > 0, torch.sqrt(noise / bend.clamp_min(_TINY)), torch.inf)
    return Estimate(
        value, torch.sigmoid((snr - DETECTED_DB) / 3), ok, {"u_a_m_s": std}, {"snr_db": snr, "at_the_end": ended}
    )


def motion_from(
    radar: BistaticRadar, data: Tensor, u_r_m_s: Number, u_a_m_s: Number, y0_m: Number, range_m: Number | None
) -> PointMotion:
    """A motion of the data's trials from values that a chain may connect."""
    return PointMotion.of(radar, data, u_r_m_s, u_a_m_s, y0_m, range_m).each(
        lambda value: value.expand(data.shape[:-2])
    )
