"""Scatterers and the scenes that are made of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws


@dataclass(frozen=True)
class Scatterers:
    """Point scatterers where the beam centre meets them, relative to the middle of the recorded
    frame.

    azimuth_m, range_m: float64 (..., target); amplitude: complex128 (..., target). Leading dims are
    trials. May require gradients.
    """

    azimuth_m: Tensor
    range_m: Tensor
    amplitude: Tensor

    def __post_init__(self) -> None:
        shapes = {tuple(x.shape) for x in (self.azimuth_m, self.range_m, self.amplitude)}
        if (
            self.azimuth_m.dtype != torch.float64
            or self.range_m.dtype != torch.float64
            or not self.amplitude.is_complex()
        ):
            raise TypeError(
                "scatterers need float64 positions and complex amplitudes, got "
                f"{self.azimuth_m.dtype}, {self.range_m.dtype}, {self.amplitude.dtype}"
            )
        if len({s[-1] for s in shapes}) != 1:
            raise ValueError(f"scatterers need as many ranges and amplitudes as azimuths, got shapes {sorted(shapes)}")


def _refuse_empty(count: int, *extents_m: float) -> None:
    if count < 1 or not all(math.isfinite(e) and e >= 0 for e in extents_m):
        raise ValueError(
            "a random scene needs at least one scatterer and extents of 0 m or more, got "
            f"count={count} and extents {extents_m}"
        )


class Scene(Protocol):
    """Anything that turns random draws into scatterers."""

    def scatterers(self, draws: Draws) -> Scatterers: ...


@dataclass(frozen=True)
class Points:
    """Explicit points.

    azimuth_m, range_m, amplitude: one entry a target; random_phase gives each trial its own phases.
    """

    azimuth_m: Sequence[float]
    range_m: Sequence[float]
    amplitude: Sequence[float] | None = None
    random_phase: bool = False

    def __post_init__(self) -> None:
        counts = [len(values) for values in (self.azimuth_m, self.range_m, self.amplitude) if values is not None]
        if len(set(counts)) != 1:
            raise ValueError(f"points need as many ranges (and amplitudes, where given) as azimuths, got {counts}")

    def scatterers(self, draws: Draws) -> Scatterers:
        x, r = (torch.tensor(list(v), dtype=torch.float64) for v in (self.azimuth_m, self.range_m))
        level = (
            torch.ones_like(x) if self.amplitude is None else torch.tensor(list(self.amplitude), dtype=torch.float64)
        )
        turns = draws.uniform("scene.points.phase", x.shape) if self.random_phase else torch.zeros_like(x)
        return Scatterers(
            x.expand(turns.shape), r.expand(turns.shape), torch.polar(level.expand(turns.shape), 2 * math.pi * turns)
        )


@dataclass(frozen=True)
class RandomPoints:
    """count points at random places of a rectangle about (azimuth_m, range_m), levels spread evenly
    over spread_db, random phases.
    """

    count: int
    azimuth_extent_m: float
    range_extent_m: float
    azimuth_m: float = 0.0
    range_m: float = 0.0
    spread_db: float = 0.0

    def __post_init__(self) -> None:
        _refuse_empty(self.count, self.azimuth_extent_m, self.range_extent_m)

    def scatterers(self, draws: Draws) -> Scatterers:
        x = self.azimuth_m + self.azimuth_extent_m * (draws.uniform("scene.random.azimuth", (self.count,)) - 0.5)
        r = self.range_m + self.range_extent_m * (draws.uniform("scene.random.range", (self.count,)) - 0.5)
        level = 10 ** (-self.spread_db * draws.uniform("scene.random.level", (self.count,)) / 20)
        return Scatterers(x, r, torch.polar(level, 2 * math.pi * draws.uniform("scene.random.phase", (self.count,))))


@dataclass(frozen=True)
class Speckle:
    """A rectangle of fully developed speckle: count circular Gaussian scatterers at random places,
    mean power level_db together.

    Give at least about three scatterers per resolution cell for the statistics of clutter.
    """

    count: int
    azimuth_extent_m: float
    range_extent_m: float
    azimuth_m: float = 0.0
    range_m: float = 0.0
    level_db: float = 0.0

    def __post_init__(self) -> None:
        _refuse_empty(self.count, self.azimuth_extent_m, self.range_extent_m)
        if not abs(self.level_db) <= 300:
            raise ValueError(f"level_db must lie within +-300 dB, got {self.level_db}")

    def scatterers(self, draws: Draws) -> Scatterers:
        x = self.azimuth_m + self.azimuth_extent_m * (draws.uniform("scene.speckle.azimuth", (self.count,)) - 0.5)
        r = self.range_m + self.range_extent_m * (draws.uniform("scene.speckle.range", (self.count,)) - 0.5)
        scale = 10 ** (self.level_db / 20) / math.sqrt(self.count)
        return Scatterers(x, r, scale * draws.normal("scene.speckle.amplitude", (self.count,), torch.complex128))


@dataclass(frozen=True)
class Together:
    """Several scenes at once; each draws its own random numbers, addressed by its name."""

    parts: dict[str, Scene]

    def scatterers(self, draws: Draws) -> Scatterers:
        all_parts = [scene.scatterers(draws.part(name)) for name, scene in self.parts.items()]
        trials = torch.broadcast_shapes(
            *(p.amplitude.shape[:-1] for p in all_parts), *(p.azimuth_m.shape[:-1] for p in all_parts)
        )  # what is not random is the same in all trials
        return Scatterers(
            *(
                torch.cat([getattr(p, field).expand(*trials, -1) for p in all_parts], -1)
                for field in ("azimuth_m", "range_m", "amplitude")
            )
        )
