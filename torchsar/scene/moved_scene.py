"""Strongest scatterers of a scene seen by a ladar, and bounds of its ranges and motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar import TriangularLadar
from torchsar.radar.ladar import leading
from torchsar.scene.ladar_range import Extremes
from torchsar.scene.targets import Points, Scatterers
from torchsar.scene.vibration import Motion


@dataclass(frozen=True)
class Moved:
    """Strongest scatterers and bounds of ranges and motion, of one trial of a ladar scene.

    Args:
        azimuth_m, range_m: Positions in metres of the strongest scatterers, those within 10 dB of
            the largest amplitude, shape (target,).
        peak: Largest amplitude.
        motion: Motions along the line of sight, random ones already drawn.
        extremes: Bounds of ranges and motion.
    """

    azimuth_m: Tensor
    range_m: Tensor
    peak: float
    motion: Sequence[Motion]
    extremes: Extremes

    @property
    def farthest(self) -> Points:
        """Of the strongest scatterers, the one farthest from the middle of the scene."""
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
        """Find the strongest scatterers and the bounds of the first trial of a scene.

        Args:
            radar: Ladar parameters.
            scene: Scatterers.
            motion: Drawn motions.
            periods: Number of sweep periods.
            gate_m: Smallest and largest range that is seen, relative to the reference range in
                metres; None for all ranges.

        Returns:
            Strongest scatterers within the gate, motions and bounds.

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
                "world: no scatterer of the scene within the gate has an amplitude above 0; add such a scatterer, "
                "or widen gate_m"
            )
        reach = float(ranges[inside].min()), float(ranges[inside].max())
        _refuse_unseen_ranges(radar, *reach)
        extremes = Extremes.of(radar, motion, periods, reach, float(azimuth.abs().max()))
        return Moved(azimuth[leads], ranges[leads], float(level[leads].max()), motion, extremes)


def _refuse_unseen_ranges(radar: TriangularLadar, near_m: float, far_m: float) -> None:
    """Raise ValueError if the relative ranges of scatterers in metres cannot be observed.

    A scatterer must be in front of the ladar, and its beat frequency must not be aliased.
    """
    if near_m <= -radar.reference_range_m:
        raise ValueError(
            f"world: a scatterer at the relative range {near_m:g} m lies behind the ladar, whose reference range is "
            f"{radar.reference_range_m:g} m; ranges of scatterers are relative to it"
        )
    reach = radar.sample_rate_hz / 2 / radar.beat_hz(1.0)
    if max(-near_m, far_m) >= reach:
        raise ValueError(
            f"world: relative ranges of scatterers must lie within +-{reach:.4g} m, since larger ranges have beat "
            f"frequencies that alias, got {near_m:g} to {far_m:g} m; bring the reference range nearer, or sample faster"
        )
