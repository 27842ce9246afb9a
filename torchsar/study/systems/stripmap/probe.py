"""Point targets at the edges of a strip, on which simplified processing is compared."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Truth
from torchsar.echo import simulate
from torchsar.focus.patches import HALF, PointPatches
from torchsar.focus.requirements import Requirement, full_swath_m, requirements
from torchsar.radar import StripmapRadar
from torchsar.scene import Points, StripmapWorld


@dataclass(frozen=True)
class StripProbe:
    """Point targets at both edges and in the middle of the swath, without noise or impairments.

    Args:
        radar: The instrument.
        world: The points, seen with the true Doppler and velocity.
        size: Lines and samples.
        edges_m: Ranges of the points from the middle of the fully compressed part of a line.
    """

    radar: StripmapRadar
    world: StripmapWorld
    size: tuple[int, int]
    edges_m: tuple[float, ...] = (0.0,)

    def between_edges(self) -> StripProbe:
        """The probe with points at both edges and in the middle of the fully focused swath."""
        radar, size = self.radar, self.size
        margin = (HALF + 1) * radar.range_step_m
        near, far = full_swath_m(radar, radar.raw_axes(*size), *self.motion, self.dwell_s)
        middle = radar.near_range_m + max(0, size[1] - radar.pulse_samples) / 2 * radar.range_step_m
        edges = (min(0.0, near - middle + margin), 0.0, max(0.0, far - middle - margin))
        return replace(self, world=replace(self.world, scene=Points([0.0] * 3, [*edges])), edges_m=edges)

    @property
    def dwell_s(self) -> float:
        """Time for which targets are lit."""
        radar = self.radar
        known = getattr(self.world.beam, "dwell_s", None) or radar.integration_s
        return float(known or radar.aperture_s(radar.near_range_m))

    @property
    def motion(self) -> tuple[float, float]:
        """Doppler of the beam centre (Hz) and velocity (m/s), of the first trial."""
        world, radar = self.world, self.radar
        doppler = (radar.pointing_doppler_hz or 0.0) if world.doppler_hz is None else world.doppler_hz
        velocity = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
        return _first(doppler), _first(velocity)

    def recorded(self, dtype: torch.dtype, **changes: Any) -> tuple[Recording, Truth]:
        """Simulate the recording, with changes of the world, and its truth."""
        return simulate(self.radar, replace(self.world, **changes), *self.size, Draws(0), dtype=dtype)

    def seen(self) -> tuple[Signal, PointPatches, tuple[Tensor, Tensor]]:
        """Raw data in double precision, the patches about the points, Doppler and velocity."""
        recording, truth = self.recorded(torch.complex128)
        of = truth.values
        known = (of["doppler_hz"], of["velocity_m_s"])
        at = (of["zero_doppler_s"], of["closest_range_m"])
        return recording.signal, PointPatches.about(self.radar, self.size, *at, *known), known

    def rows(self) -> tuple[Requirement, ...]:
        """What each simplification neglects for this size, Doppler and velocity."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an aliased aperture is one of the limits
            return requirements(self.radar, self.radar.raw_axes(*self.size), *self.motion)


def _first(x: Tensor | float) -> float:
    return float(torch.as_tensor(x).reshape(-1)[0])
