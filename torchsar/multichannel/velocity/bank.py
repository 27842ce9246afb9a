"""Bank of matched filters over velocities, to find a moving point without a starting value.

The data are deramped with the exact phase of each hypothesis; a point near the hypothesis then
becomes one tone in all channels. The channels measure the slant-range velocity only modulo lambda
PRF, but the cubic phase of the range history resolves this ambiguity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import host_values, level_of, per_trial, unit_phasor
from torchsar.core.fft import smooth_length
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.model import chosen, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening
from torchsar.radar import BistaticRadar


@dataclass(frozen=True)
class Search:
    """Extent and steps of a search over the velocities and the position of a point.

    >>> from torchsar import multichannel
    >>> search = multichannel.Search(u_r_m_s=12.0)
    >>> 2 * search.u_r_m_s / search.u_r_step_m_s  # steps of the slant-range speed
    8.0

    The default steps suit apertures of about 4.5 s at 300 m/s and 5 km.

    Args:
        u_r_m_s: Half width of the search in slant-range speed, about zero, in m/s.
        u_a_m_s: Half width of the search in along-track speed in m/s, 0 where this speed is known a
            priori.
        y0_m: Largest along-track distance of the point from the expected position (by default 0) in
            metres.
        u_r_step_m_s: Step of the slant-range speed in m/s.
        u_a_step_m_s: Step of the along-track speed in m/s.

    Raises:
        ValueError: If a half width is negative or not finite, or a step is not positive.
    """

    u_r_m_s: float = 21.6
    u_a_m_s: float = 20.0
    y0_m: float = 150.0
    # steps found by trial; at most 2 dB of the peak are lost between hypotheses, mostly by the step
    # of u_a
    u_r_step_m_s: float = 3.0
    u_a_step_m_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("u_r_m_s", "u_a_m_s", "y0_m"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"search.{name} must be 0 or a positive half width, got {getattr(self, name)}")
        if not (self.u_r_step_m_s > 0 and self.u_a_step_m_s > 0):
            raise ValueError(
                "u_r_step_m_s and u_a_step_m_s of a search must be positive, got "
                f"{self.u_r_step_m_s} and {self.u_a_step_m_s} m/s"
            )


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
    """Find the velocities and the position that explain most of the energy in each trial.

    A grid of velocities is tried. For each, the along-track position is read from the residual
    tone, within +-search.y0_m of zero. If the slow time `image_s` at which the point appears in an
    image is given, the position is sought about the one that the velocities and `image_s` imply.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        search: Extent and steps of the search.
        u_a_m_s: Middle of the search along track in m/s, shape (...,) or a number.
        range_m: Closest range in metres, None for the reference range of the radar.
        whitening: Clutter covariance, None for white noise.
        image_s: Slow time in seconds at which the point appears in an image, shape (...,), or None.

    Returns:
        The motion, and the energy that it explains by normalised correlation, shape (...,). Trials
        of zeros have zero velocity and energy.
    """
    n = data.shape[-1]
    time_s = radar.pulse_axis(n).values(data.device)
    prepared = (data if whitening is None else whitening.backed(data)).to(torch.complex128)
    level = level_of(prepared)
    prepared = (prepared / level).to(torch.complex64)
    best = PointMotion.of(radar, data, 0.0, u_a_m_s, 0.0, range_m)
    best = best.each(lambda value: value.expand(data.shape[:-2]))
    energy = torch.zeros(data.shape[:-2], dtype=torch.float64, device=data.device)
    # blocks of hypotheses take at most 64 MiB
    hypotheses, size = [], max(1, (64 << 20) // (32 * data.numel()))
    for u_r in _steps(search.u_r_m_s, search.u_r_step_m_s, data.device):
        for offsets in _steps(search.u_a_m_s, search.u_a_step_m_s, data.device).split(size):
            u_a = per_trial(u_a_m_s, 1, data) + offsets
            there = PointMotion.of(radar, data, u_r, u_a, 0.0, None if range_m is None else per_trial(range_m, 1, data))
            if image_s is not None:
                there = replace(there, y0_m=there.position_m(per_trial(image_s, 1, data)))
            hypotheses.append(there)
    # if the search is the same for all trials, only the pulses of its aperture are needed
    few = whitening is None and all(there.y0_m.ndim <= 1 for there in hypotheses)
    parts = (
        _illuminated([aperture.weight(radar, there, time_s) for there in hypotheses])
        if few
        else [slice(None)] * len(hypotheses)
    )
    # largest change of the residual tone with position; infinite inside vmap, where values cannot
    # be read
    rates = [(each.along_m_s / (radar.wavelength_m * each.range_m)).max() for each in hypotheses]
    fastest_hz_m = host_values(torch.stack(rates), math.inf)
    for there, pulses, fastest in zip(hypotheses, parts, fastest_hz_m, strict=True):
        found, position, along = _best_tone(
            prepared[..., pulses], radar, there, aperture, time_s[pulses], search.y0_m, fastest, whitening
        )
        better = found > energy
        energy = torch.where(better, found, energy)
        u_r = there.u_r_m_s.expand(found.shape)
        best = chosen(replace(best, u_r_m_s=u_r, u_a_m_s=along, y0_m=position), best, better)
    return best, energy * level[..., 0, 0].square()


def _steps(half: float, step: float, device: torch.device) -> Tensor:
    """Return an odd number of equal steps over +-half, or zero alone."""
    count = 2 * round(half / step) + 1
    return (
        torch.linspace(-half, half, count, dtype=torch.float64, device=device)
        if count > 1
        else torch.zeros(1, dtype=torch.float64, device=device)
    )


def _best_tone(
    prepared: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    time_s: Tensor,
    reach_m: float,
    fastest_hz_m: float,
    whitening: Whitening | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the greatest normalised correlation per trial, and its position y0 and speed u_a.

    fastest_hz_m: Largest change of the residual tone with position.
    """
    weight = aperture.weight(radar, motion, time_s)
    model = weight[..., None, :].to(prepared.dtype) * point_phasor(radar, motion, time_s, prepared.dtype)
    scale = radar.wavelength_m * motion.range_m[..., None]
    fastest = fastest_hz_m * reach_m
    tones, rate_hz = _decimated(model.conj() * prepared[..., None, :, :], radar.prf_hz, fastest)
    length = smooth_length(2 * tones.shape[-1])
    half = int(min(length // 2, fastest * length / rate_hz + 1))
    bins = torch.arange(-half, min(half + 1, length - half), device=prepared.device)
    spectrum = torch.fft.fft(tones, length)[..., bins]
    shift = bins.to(torch.float64) * (rate_hz / length) * scale / motion.along_m_s[..., None]
    # channels are added with the phases of a point; the slope is in cycles per metre of channel
    # position
    aligned = torch.zeros_like(spectrum[..., 0, :])
    for x, dx in zip(spectrum.unbind(-2), radar.channel_m, strict=True):
        aligned = aligned + x * unit_phasor(shift / scale * dx, x.dtype)
    energy = weight.square().sum(-1) * radar.channels
    if whitening is not None:
        # the energy of the middle model is used for all, because it hardly depends on the
        # along-track speed
        middle = model[..., model.shape[-3] // 2, :, :].to(torch.complex128)
        middle = middle.expand(*whitening.factor.shape[:-3], *middle.shape[-2:])
        energy = whitening.applied(middle).abs().square().sum((-2, -1))[..., None]
    power = aligned.abs().square().to(torch.float64) / energy.clamp_min(torch.finfo(torch.float32).tiny)[..., None]
    power = torch.where(shift.abs() <= reach_m, power, -torch.inf).flatten(-2)
    at = power.argmax(-1, keepdim=True)
    wide = torch.broadcast_to(motion.y0_m[..., None] + shift, aligned.shape).flatten(-2)
    along = torch.broadcast_to(motion.u_a_m_s[..., None], aligned.shape).flatten(-2)
    return (
        power.gather(-1, at)[..., 0],
        wide.expand(power.shape).gather(-1, at)[..., 0],
        along.expand(power.shape).gather(-1, at)[..., 0],
    )


def _illuminated(weights: list[Tensor]) -> list[slice]:
    """Return, for weights (..., pulse) of blocks of hypotheses, the slice of the illuminated pulses
    of each block.

    It reaches from the first to the last pulse with amplitude in any hypothesis of the block.
    """
    lit = torch.stack([(weight != 0).flatten(0, -2).any(0) for weight in weights]).to(torch.uint8)
    n = lit.shape[-1]
    # argmax returns the first of equal elements, so that a block without amplitude gets all pulses
    ends = host_values(torch.stack([lit.argmax(-1), n - lit.flip(-1).argmax(-1)], -1), 0)
    # inside vmap, where values cannot be read, blocks get all pulses too
    return [slice(first, end or n) for first, end in zip(ends[::2], ends[1::2], strict=True)]


def _decimated(tones: Tensor, prf_hz: float, highest_hz: float) -> tuple[Tensor, float]:
    """Sum as many neighbouring pulses as tones up to highest_hz allow, and return the sums and the
    new rate.
    """
    factor = max(1, int(prf_hz / (3 * highest_hz))) if highest_hz > 0 else 1
    if factor == 1:
        return tones, prf_hz
    whole = tones.shape[-1] // factor * factor
    return tones[..., :whole].unflatten(-1, (-1, factor)).sum(-1), prf_hz / factor
