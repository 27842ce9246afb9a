"""Expected amplitude of the echo of a moving point over slow time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.velocity.model import point_phasor
from torchsar.radar import BistaticRadar

# Parts of the aperture whose amplitudes are compared, by choice, and the largest ratio of their
# energy to that of the whole: two points of which one is 10 dB weaker have 1.1, a point that is
# illuminated for half of the aperture has 2.
_PARTS, _MOST_RATIO = 8, 1.5


class Aperture(Protocol):
    """Expected amplitude of the echo of a point over slow time.

    It is centred on the time at which the point is at broadside.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude of the echo of a point in each pulse.

        Args:
            radar: Radar parameters.
            motion: Motion of the point, shape (...,).
            time_s: Slow time in seconds, float64 (pulse,).

        Returns:
            Amplitude, float64 (..., pulse).
        """
        ...


@dataclass(frozen=True)
class Dwell:
    """Expected amplitude 1 for a duration centred on the time at broadside, 0 outside.

    The time at broadside follows from the motion of the point, without a gradient. Estimators
    therefore do not fit the ends of the interval to the data.

    Args:
        duration_s: Duration in seconds.

    Raises:
        ValueError: If the duration is not positive and finite.
    """

    duration_s: float

    def __post_init__(self) -> None:
        if not 0 < self.duration_s < float("inf"):
            raise ValueError(
                f"a dwell needs a positive, finite duration_s, got {self.duration_s}; use ElementBeam() for no limit"
            )

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return 1 within the duration and 0 outside, see `Aperture.weight`."""
        since = time_s - _abeam_s(motion)[..., None]
        return (since.abs() < self.duration_s / 2).to(torch.float64)


@dataclass(frozen=True)
class ElementBeam:
    """Expected amplitude by the one-way antenna pattern of a channel.

    The pattern is sinc(L sin(look) / lambda) with the length L = `radar.element_m` of the aperture
    of a channel and the look angle from broadside. Side lobes and their signs are included.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the pattern over slow time, see `Aperture.weight`.

        Not differentiable in the motion.
        """
        along = motion.along_m_s.detach()[..., None] * time_s - motion.y0_m.detach()[..., None]
        across = motion.range_m.detach()[..., None] - motion.u_r_m_s.detach()[..., None] * time_s
        turns = radar.element_m * along / torch.sqrt(along.square() + across.square()) / radar.wavelength_m
        return torch.sinc(turns)


def fits_aperture(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture, noise_power: Tensor
) -> Tensor:
    """Check that the amplitude of a point follows the expected one over slow time.

    The deramped echo is added up in eight parts of the aperture. If each part has an amplitude of
    its own, more energy is explained; a point that is illuminated for a quarter of the aperture
    explains four times as much. A tone that remains, of a small error of the velocity, does not
    count.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        aperture: Expected amplitude over slow time.
        noise_power: Noise power per sample, shape (...,).

    Returns:
        True where the parts explain less than 1.5 times the energy of the whole, apart from noise,
        bool (...,).
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)
    still = (data.to(torch.complex128) * point_phasor(radar, motion, time_s, torch.complex128).conj()).sum(-2)
    energy = weight.square() * radar.channels
    share = energy.cumsum(-1) / energy.sum(-1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    part = (_PARTS * (share - 0.5 / still.shape[-1])).long().clamp(0, _PARTS - 1)
    spectrum = torch.fft.fft(weight * still, 4 * still.shape[-1])
    at = spectrum.abs().argmax(-1, keepdim=True) / (4 * still.shape[-1])
    tone = torch.exp(-2j * math.pi * at * torch.arange(still.shape[-1], device=data.device))
    sums = torch.zeros(*still.shape[:-1], _PARTS, dtype=still.dtype, device=still.device)
    sums = sums.scatter_add(-1, part, weight * still * tone)
    norm = torch.zeros_like(sums.real).scatter_add(-1, part, energy.expand(still.shape))
    parts = (sums.abs().square() / norm.clamp_min(torch.finfo(torch.float64).tiny)).sum(-1)
    whole = sums.sum(-1).abs().square() / norm.sum(-1).clamp_min(torch.finfo(torch.float64).tiny)
    return parts - _PARTS * noise_power < _MOST_RATIO * whole


def _abeam_s(motion: PointMotion) -> Tensor:
    """Return the time in seconds at which a point is at broadside."""
    return (motion.y0_m / motion.along_m_s).detach()
