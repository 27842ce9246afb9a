"""Expected amplitude of the echo of a moving point over slow time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core.arguments import names_arguments
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar


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


@names_arguments
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


@names_arguments
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


@dataclass(frozen=True)
class Kept:
    """Expected amplitude that is the same for all motions, float64 (..., pulse)."""

    amplitude: Tensor

    def weight(self, radar: BistaticRadar, motion: PointMotion, time_s: Tensor) -> Tensor:
        """Return the expected amplitude, see `Aperture.weight`."""
        return self.amplitude


def _abeam_s(motion: PointMotion) -> Tensor:
    """Return the time in seconds at which a point is at broadside."""
    return (motion.y0_m / motion.along_m_s).detach()
