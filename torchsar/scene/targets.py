"""Point scatterers and the scenes that consist of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.trials import finite, refuse_unless, refuse_unless_finite, stacked, with_dims


@dataclass(frozen=True)
class Scatterers:
    """Point scatterers, relative to the middle of the recorded frame.

    The leading dimensions are trials. Tensors may require gradients.

    Args:
        azimuth_m: Azimuth in metres at which the beam centre crosses the scatterer, shape (...,
            target), float64.
        range_m: Range in metres at which the beam centre crosses the scatterer, shape (...,
            target), float64.
        amplitude: Amplitude, shape (..., target), complex.

    Raises:
        TypeError: If positions are not float64 or amplitudes not complex.
        ValueError: If the tensors differ in the number of targets.
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


def _refuse_empty(count: int, *extents_m: Tensor | float) -> None:
    """Raise ValueError for a scene without scatterers or with negative extents."""
    sentence = "a random scene needs at least one scatterer and extents of 0 m or more"
    if count < 1:
        raise ValueError(f"{sentence}, got count={count}")
    for extent in extents_m:
        refuse_unless(sentence, extent, lambda x: finite(x) & (x >= 0))


class Scene(Protocol):
    """Scene that gives scatterers."""

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw the scatterers.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., target).
        """
        ...


@dataclass(frozen=True)
class Points:
    """Given points.

    Every parameter is a list with one entry per target; each entry is a number or one value per
    trial.

    Args:
        azimuth_m: Azimuths in metres.
        range_m: Ranges in metres.
        amplitude: Amplitudes; by default all are 1.
        random_phase: Whether each trial draws a random phase for every point.

    Raises:
        ValueError: If the lists differ in length or a number is not finite.
    """

    azimuth_m: Sequence[Tensor | float]
    range_m: Sequence[Tensor | float]
    amplitude: Sequence[Tensor | float] | None = None
    random_phase: bool = False

    def __post_init__(self) -> None:
        counts = [len(values) for values in (self.azimuth_m, self.range_m, self.amplitude) if values is not None]
        if len(set(counts)) != 1:
            raise ValueError(
                f"points need as many ranges (and amplitudes, where given) as azimuths, got lists of lengths {counts}"
            )
        for name in ("azimuth_m", "range_m", "amplitude"):
            refuse_unless_finite(f"{name} of points", getattr(self, name))

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw the phases of the points.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., target).
        """
        x, r = stacked(self.azimuth_m), stacked(self.range_m)
        level = torch.ones_like(x) if self.amplitude is None else stacked(self.amplitude)
        turns = draws.uniform("scene.points.phase", x.shape[-1:]) if self.random_phase else torch.zeros_like(x)
        if not x.shape == r.shape == level.shape == turns.shape:
            x, r, level, turns = torch.broadcast_tensors(x, r, level, turns)
        return Scatterers(x, r, torch.polar(level, 2 * math.pi * turns))


@dataclass(frozen=True)
class RandomPoints:
    """Points at random positions in a rectangle, with random powers and phases.

    Args:
        count: Number of scatterers, fixed for all trials.
        azimuth_extent_m: Azimuth side of the rectangle in metres.
        range_extent_m: Range side of the rectangle in metres.
        azimuth_m: Azimuth of its middle in metres.
        range_m: Range of its middle in metres.
        spread_db: Width of the distribution of powers, which are uniform between -spread_db and 0
            in decibels relative to amplitude 1.

    Raises:
        ValueError: If there is no scatterer, an extent is negative or a number is not finite.
    """

    count: int
    azimuth_extent_m: Tensor | float
    range_extent_m: Tensor | float
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0
    spread_db: Tensor | float = 0.0

    def __post_init__(self) -> None:
        _refuse_empty(self.count, self.azimuth_extent_m, self.range_extent_m)
        for name in ("azimuth_m", "range_m", "spread_db"):
            refuse_unless_finite(f"{name} of random points", getattr(self, name))

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw positions, levels and phases.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., count).
        """
        x, r = _in_rectangle(self, draws, "scene.random")
        share = draws.uniform("scene.random.level", (self.count,))
        level = 10 ** (-with_dims(self.spread_db, 1, share) * share / 20)
        phase = 2 * math.pi * draws.uniform("scene.random.phase", (self.count,))
        return Scatterers(x, r, torch.polar(*torch.broadcast_tensors(level, phase)))


@dataclass(frozen=True)
class Speckle:
    """Rectangle of fully developed speckle: circular Gaussian scatterers at random positions.

    About three scatterers or more per resolution cell are needed for the statistics of clutter.

    Args:
        count: Number of scatterers, fixed for all trials.
        azimuth_extent_m: Azimuth side of the rectangle in metres.
        range_extent_m: Range side of the rectangle in metres.
        azimuth_m: Azimuth of its middle in metres.
        range_m: Range of its middle in metres.
        level_db: Mean power of all scatterers together in decibels relative to a scatterer of
            amplitude 1, within +-300 dB.

    Raises:
        ValueError: If there is no scatterer, an extent is negative or a number is out of range.
    """

    count: int
    azimuth_extent_m: Tensor | float
    range_extent_m: Tensor | float
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0
    level_db: Tensor | float = 0.0

    def __post_init__(self) -> None:
        _refuse_empty(self.count, self.azimuth_extent_m, self.range_extent_m)
        for name in ("azimuth_m", "range_m"):
            refuse_unless_finite(f"{name} of speckle", getattr(self, name))
        refuse_unless("level_db must lie within +-300 dB", self.level_db, lambda x: abs(x) <= 300)

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw positions and amplitudes.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., count).
        """
        x, r = _in_rectangle(self, draws, "scene.speckle")
        unit = draws.normal("scene.speckle.amplitude", (self.count,), torch.complex128)
        scale = 10 ** (with_dims(self.level_db, 1, unit) / 20) / math.sqrt(self.count)
        return Scatterers(x, r, scale * unit)


def _in_rectangle(scene: RandomPoints | Speckle, draws: Draws, purpose: str) -> tuple[Tensor, Tensor]:
    """Random azimuth and range of scatterers in the rectangle of a scene, (..., target) each."""
    shares = [draws.uniform(f"{purpose}.{name}", (scene.count,)) for name in ("azimuth", "range")]
    middles, extents = (scene.azimuth_m, scene.range_m), (scene.azimuth_extent_m, scene.range_extent_m)
    x, r = (
        with_dims(middle, 1, share) + with_dims(extent, 1, share) * (share - 0.5)
        for middle, extent, share in zip(middles, extents, shares, strict=True)
    )
    return x, r


@dataclass(frozen=True)
class Together:
    """Several scenes in one.

    Args:
        parts: Scenes by name. The name of a scene decides which random numbers it draws.
    """

    parts: Mapping[str, Scene]

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw the scatterers of all parts, in their order.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., target).
        """
        all_parts = [scene.scatterers(draws.part(name)) for name, scene in self.parts.items()]
        trials = np.broadcast_shapes(
            *(p.amplitude.shape[:-1] for p in all_parts), *(p.azimuth_m.shape[:-1] for p in all_parts)
        )  # parts without random numbers are equal in all trials
        return Scatterers(
            *(
                torch.cat([getattr(p, field).expand(*trials, -1) for p in all_parts], -1)
                for field in ("azimuth_m", "range_m", "amplitude")
            )
        )
