"""Expected amplitude of the echo of a moving point over slow time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar


class Aperture(Protocol):
    """Expected amplitude of a point over slow time, about the time at which it is at broadside."""

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude.

        Args:
            radar: Instrument.
            motion: Motion of the point, shape (...,).
            time_s: Slow time in seconds, float64 (pulse,).

        Returns:
            Amplitude, float64 (..., pulse).
        """
        ...


@dataclass(frozen=True)
class Dwell:
    """Constant amplitude for a duration centred on the time at broadside, zero outside.

    The edges depend on the position of the point, but estimators do not use them to find that
    position.

    Args:
        duration_s: Duration in seconds.

    Raises:
        ValueError: If the duration is not positive and finite.
    """

    duration_s: float

    def __post_init__(self) -> None:
        if not 0 < self.duration_s < float("inf"):
            raise ValueError(
                f"an aperture needs a positive, finite duration_s, got {self.duration_s}; ElementBeam() is unlimited"
            )

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return 1 within the duration and 0 outside, see `Aperture.weight`."""
        since = time_s - _abeam_s(motion)[..., None]
        return (since.abs() < self.duration_s / 2).to(torch.float64)


@dataclass(frozen=True)
class ElementBeam:
    """One-way pattern of the aperture of a channel, sinc(element sin(look) / lambda).

    Side lobes and their signs are included.
    """

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the amplitude pattern, see `Aperture.weight`; not differentiable in the motion."""
        along = motion.along_m_s.detach()[..., None] * time_s - motion.y0_m.detach()[..., None]
        across = motion.range_m.detach()[..., None] - motion.u_r_m_s.detach()[..., None] * time_s
        turns = radar.element_m * along / torch.sqrt(along.square() + across.square()) / radar.wavelength_m
        return torch.sinc(turns)


def _abeam_s(motion: PointMotion) -> Tensor:
    """Return the time in seconds at which a point is at broadside."""
    return (motion.y0_m / motion.along_m_s).detach()
