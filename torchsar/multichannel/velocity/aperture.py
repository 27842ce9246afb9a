"""Which pulses of a moving point count, and how much: the amplitude that its echo is expected to
have over slow time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar


class Aperture(Protocol):
    """Expected amplitude (..., pulse) of a point over slow time (pulse,), about the time at which
    it is abeam.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Dwell:
    """Equal amplitude for duration_s about the time abeam, none beyond.

    How its edges move with the place is never used to find the place.
    """

    duration_s: float

    def __post_init__(self) -> None:
        if not 0 < self.duration_s < float("inf"):
            raise ValueError(
                f"an aperture needs a positive, finite duration_s, got {self.duration_s}; ElementBeam() has no ends"
            )

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        since = time_s - _abeam_s(motion)[..., None]
        return (since.abs() < self.duration_s / 2).to(torch.float64)


@dataclass(frozen=True)
class ElementBeam:
    """The one-way pattern of a channel's aperture, sinc(element sin(look) / lambda), side lobes and
    their signs included.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        along = motion.along_m_s.detach()[..., None] * time_s - motion.y0_m.detach()[..., None]
        across = motion.range_m.detach()[..., None] - motion.u_r_m_s.detach()[..., None] * time_s
        place = radar.element_m * along / torch.sqrt(along.square() + across.square()) / radar.wavelength_m
        return torch.sinc(place)


def _abeam_s(motion: PointMotion) -> Tensor:
    return (motion.y0_m / motion.along_m_s).detach()
