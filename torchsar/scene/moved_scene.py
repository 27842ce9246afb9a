"""What a moving scene shows of a ladar: leading scatterers, and bounds of ranges and motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar import TriangularLadar
from torchsar.radar.ladar import leading
from torchsar.scene.ladar import Extremes, refuse_unseen_ranges
from torchsar.scene.targets import Points, Scatterers
from torchsar.scene.vibration import Motion


@dataclass(frozen=True)
class Moved:
    """What one trial shows.

    Args:
        azimuth_m, range_m: Positions of scatterers that lead estimators, (target,).
        peak: Largest amplitude.
        motion: The drawn motions.
        extremes: Bounds of ranges and motion.
    """

    azimuth_m: Tensor
    range_m: Tensor
    peak: float
    motion: Sequence[Motion]
    extremes: Extremes

    @property
    def farthest(self) -> Points:
        """The leading scatterer farthest from the middle of the scene."""
        far = int((self.range_m.abs() + self.azimuth_m.abs()).argmax())
        return Points([float(self.azimuth_m[far])], [float(self.range_m[far])])

    @staticmethod
    def of(
        radar: TriangularLadar,
        scene: Scatterers,
        motion: Sequence[Motion],
        periods: int,
        gate_m: tuple[float, float] | None = None,
    ) -> Moved:
        """Find them for the first trial of a scene.

        Args:
            radar: Instrument.
            scene: Scatterers.
            motion: Drawn motions.
            periods: Number of sweep periods.
            gate_m: Least and largest range that is seen; None for all.

        Raises:
            ValueError: If no scatterer can be seen, or one lies where no sweep can show it.
        """
        azimuth, ranges, level = (
            v.reshape(-1, v.shape[-1])[0] for v in (scene.azimuth_m, scene.range_m, scene.amplitude.abs())
        )
        low, high = gate_m or (-math.inf, math.inf)
        inside = (level > 0) & (ranges >= low) & (ranges <= high)
        leads = leading(torch.where(inside, level, 0))
        if not bool(leads.any()):
            raise ValueError(
                "world: no scatterer of the scene has an amplitude above 0 within the gate; give it one, "
                "or widen gate_m"
            )
        reach = float(ranges[inside].min()), float(ranges[inside].max())
        refuse_unseen_ranges(radar, *reach)
        extremes = Extremes.of(radar, motion, periods, reach, float(azimuth.abs().max()))
        return Moved(azimuth[leads], ranges[leads], float(level[leads].max()), motion, extremes)
