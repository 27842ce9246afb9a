"""A bank of matched filters over velocities: where a moving point may be, without a start.

Data are taken against the exact phase of each hypothesis; what is left of a point near it is one
tone in all channels. The cubic phase of the range history, and not only the direction that the
channels measure, tells slant-range velocities that differ by whole pulse rates (brief 001: modulo
lambda PRF otherwise).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import per_trial, unit_phasor
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import chosen, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.radar import BistaticRadar

_BLOCK_BYTES = 64 << 20
_TINY = torch.finfo(torch.float32).tiny


@dataclass(frozen=True)
class Search:
    """What a bank covers: steps of velocities (m/s) and half widths about zero, and how far (m)
    along track from the middle a point may lie.

    u_r_m_s: half width; u_a_m_s: half width, 0 where the along-track speed is told. Steps suit
    apertures of about 4.5 s at 300 m/s and 5 km.
    """

    u_r_m_s: float = 21.6
    u_a_m_s: float = 20.0
    y0_m: float = 150.0
    u_r_step_m_s: float = 3.0
    u_a_step_m_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("u_r_m_s", "u_a_m_s", "y0_m"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"search.{name} must be 0 or a positive half width, got {getattr(self, name)}")
        if not (self.u_r_step_m_s > 0 and self.u_a_step_m_s > 0):
            raise ValueError(f"steps of a search must be positive, got {self.u_r_step_m_s} and {self.u_a_step_m_s} m/s")


def bank_search(
    data: Tensor,
    radar: BistaticRadar,
    aperture: Aperture,
    search: Search,
    u_a_m_s: Tensor | float = 0.0,
    range_m: Number | None = None,
    whitening: Whitening | None = None,
    image_s: Number | None = None,
) -> tuple[PointMotion, Tensor]:
    """The hypothesis that explains most, per trial, and the energy that it explains (...,) by the
    normalised correlation: zero velocity for trials of zeros.

    data: complex (..., channel, pulse). u_a_m_s: (...,) middle of the search along track. The place
    along track is read from the tone left, within +-search.y0_m of zero, or of where a point of
    each velocity lies that appears at the slow time image_s (...,) in an image: what a detection
    knows.
    """
    n = data.shape[-1]
    time_s = radar.pulse_axis(n).values(data.device)
    taken = (data if whitening is None else whitening.backed(data)).to(torch.complex128)
    level = taken.abs().amax((-2, -1), keepdim=True)
    taken = (taken / torch.where(level > 0, level, 1.0)).to(torch.complex64)
    best = PointMotion.of(radar, data, 0.0, u_a_m_s, 0.0, range_m)
    best = best.each(lambda value: value.expand(data.shape[:-2]))
    energy = torch.zeros(data.shape[:-2], dtype=torch.float64, device=data.device)
    for u_r in _steps(search.u_r_m_s, search.u_r_step_m_s, data.device):
        for offsets in _blocks(_steps(search.u_a_m_s, search.u_a_step_m_s, data.device), data):
            u_a = torch.as_tensor(u_a_m_s, dtype=torch.float64, device=data.device)[..., None] + offsets
            there = PointMotion.of(radar, data, u_r, u_a, 0.0, None if range_m is None else per_trial(range_m, 1, data))
            if image_s is not None:
                there = replace(there, y0_m=there.place_m(per_trial(image_s, 1, data)))
            # what all trials search alike needs the pulses of its aperture alone
            lit = (
                _lit(aperture.weight(radar, there, time_s))
                if there.y0_m.ndim <= 1 and whitening is None
                else slice(None)
            )
            found, place, along = _best_tone(
                taken[..., lit], radar, there, aperture, time_s[lit], search.y0_m, whitening
            )
            better = found > energy
            energy = torch.where(better, found, energy)
            best = chosen(replace(best, u_r_m_s=u_r.expand(found.shape), u_a_m_s=along, y0_m=place), best, better)
    return best, energy * level[..., 0, 0].square()


def tone_energy(data: Tensor, radar: BistaticRadar, motions: PointMotion, aperture: Aperture, reach_m: float) -> Tensor:
    """The greatest energy (...,) that any of the motions (..., hypothesis) explains of data (...,
    channel, pulse), its place along track within reach_m of where the motion has it.
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    motions, taken = (
        motions.each(lambda value: torch.broadcast_to(value, motions.u_a_m_s.shape)),
        data.to(torch.complex64),
    )
    size = max(1, _BLOCK_BYTES // (32 * data.numel()))
    parts = [slice(at, at + size) for at in range(0, motions.u_a_m_s.shape[-1], size)]
    return torch.stack(
        [
            _best_tone(
                taken, radar, motions.each(lambda value, part=part: value[..., part]), aperture, time_s, reach_m, None
            )[0]
            for part in parts
        ]
    ).amax(0)


def _steps(half: float, step: float, device: torch.device) -> Tensor:
    count = 2 * round(half / step) + 1
    return (
        torch.linspace(-half, half, count, dtype=torch.float64, device=device)
        if count > 1
        else torch.zeros(1, dtype=torch.float64, device=device)
    )


def _blocks(offsets: Tensor, data: Tensor) -> Iterator[Tensor]:
    """So many offsets at once as the data of all trials leave room for."""
    size = max(1, _BLOCK_BYTES // (32 * data.numel()))
    yield from offsets.split(size)


def _best_tone(
    taken: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    time_s: Tensor,
    reach_m: float,
    whitening: Whitening | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Of motions (..., hypothesis) the greatest normalised correlation per trial (...,), the place
    y0 that its tone means, and its u_a.
    """
    model = aperture.weight(radar, motion, time_s)[..., None, :].to(taken.dtype) * point_phasor(
        radar, motion, time_s, taken.dtype
    )
    slowest = float(motion.along_m_s.max()) * reach_m / (radar.wavelength_m * radar.reference_range_m)
    tones, rate_hz = _decimated(model.conj() * taken[..., None, :, :], radar.prf_hz, slowest)
    length = smooth_length(2 * tones.shape[-1])
    spectrum = torch.fft.fftshift(torch.fft.fft(tones, length), dim=-1)
    tone_hz = (torch.arange(length, dtype=torch.float64, device=taken.device) - length // 2) * (rate_hz / length)
    shift = tone_hz * radar.wavelength_m * radar.reference_range_m / motion.along_m_s[..., None]
    aligned = _aligned(spectrum, radar, shift)
    power = (
        aligned.abs().square().to(torch.float64) / _norm(model, whitening).to(torch.float64).clamp_min(_TINY)[..., None]
    )
    power = torch.where(shift.abs() <= reach_m, power, -torch.inf).flatten(-2)
    at = power.argmax(-1, keepdim=True)
    wide = torch.broadcast_to(motion.y0_m[..., None] + shift, (*aligned.shape[:-1], length)).flatten(-2)
    along = torch.broadcast_to(motion.u_a_m_s[..., None], aligned.shape).flatten(-2)
    return (
        power.gather(-1, at)[..., 0],
        wide.expand(power.shape).gather(-1, at)[..., 0],
        along.expand(power.shape).gather(-1, at)[..., 0],
    )


def _lit(weight: Tensor) -> slice:
    """From the first to the last pulse (..., pulse) at which any hypothesis shines."""
    shines = (weight != 0).flatten(0, -2).any(0).nonzero()[:, 0]
    return slice(int(shines[0]), int(shines[-1]) + 1) if len(shines) else slice(None)


def _decimated(tones: Tensor, prf_hz: float, highest_hz: float) -> tuple[Tensor, float]:
    """Sums of neighbouring pulses, as many as leave tones up to highest_hz with most of their
    energy, and the rate of the sums.
    """
    factor = max(1, int(prf_hz / (3 * highest_hz))) if highest_hz > 0 else 1
    if factor == 1:
        return tones, prf_hz
    whole = tones.shape[-1] // factor * factor
    return tones[..., :whole].unflatten(-1, (-1, factor)).sum(-1), prf_hz / factor


def _aligned(spectrum: Tensor, radar: BistaticRadar, place: Tensor) -> Tensor:
    """Channels (..., channel, bin) added with the phases of a point at `place` (..., bin), against
    those of the model at zero.
    """
    slope = place / (radar.wavelength_m * radar.reference_range_m)
    total = torch.zeros_like(spectrum[..., 0, :])
    for i, dx in enumerate(radar.channel_m):
        total = total + spectrum[..., i, :] * unit_phasor(slope * dx, spectrum.dtype)
    return total


def _norm(model: Tensor, whitening: Whitening | None) -> Tensor:
    """Energy of the models in the metric of the data, (..., hypothesis or 1): of white noise
    exactly, in clutter that of the middle one, as it hardly depends on the speed along track.
    """
    if whitening is None:
        return model.abs().square().sum((-2, -1))
    middle = model[..., model.shape[-3] // 2, :, :].to(torch.complex128)
    return (
        whitening.applied(middle.expand(*whitening.factor.shape[:-3], *middle.shape[-2:]))
        .abs()
        .square()
        .sum((-2, -1))[..., None]
    )
