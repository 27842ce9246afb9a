"""Point scatterers and the scenes that consist of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.sea import gamma_texture, refuse_other_shape
from torchsar.scene.trials import (
    either,
    finite,
    finite_numbers,
    refuse_unless,
    refuse_unless_finite,
    refuse_unless_positive,
    stacked,
    with_dims,
)


@dataclass(frozen=True)
class Scatterers:
    """Point scatterers, relative to the middle of the recorded frame.

    >>> import torch
    >>> from torchsar import scene
    >>> place_m = torch.tensor([0.0, 5.0], dtype=torch.float64)
    >>> points = scene.Scatterers(place_m, place_m, amplitude=torch.tensor([1.0, 0.5j]))
    >>> points.amplitude.abs().tolist()
    [1.0, 0.5]

    The leading dimensions are trials. Tensors may require gradients.

    Args:
        azimuth_m: Azimuth in metres at which the beam centre crosses the scatterer, shape (...,
            target), float64.
        range_m: Range in metres at which the beam centre crosses the scatterer, shape (...,
            target), float64.
        amplitude: Amplitude, shape (..., target), complex.
        height_m: Height above the ground in metres, shape (..., target), float64; None for points
            on the ground. Only worlds seen from any path have heights.

    Raises:
        TypeError: If positions are not float64 or amplitudes not complex.
        ValueError: If the tensors differ in the number of targets.
    """

    azimuth_m: Tensor
    range_m: Tensor
    amplitude: Tensor
    height_m: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = {tuple(x.shape) for x in self.tensors}
        dtypes = [x.dtype for x in self.tensors]
        if any(dtype != torch.float64 for dtype in dtypes[:2]) or not dtypes[2].is_complex:
            raise TypeError(f"scatterers need float64 positions and complex amplitudes, got {dtypes}")
        if len({s[-1] for s in shapes}) != 1:
            raise ValueError(f"scatterers need as many ranges and amplitudes as azimuths, got shapes {sorted(shapes)}")

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Azimuth, range and amplitude."""
        return self.azimuth_m, self.range_m, self.amplitude

    def to(self, device: torch.device | str | None, heights: bool = False) -> Scatterers:
        """Return the scatterers on a device.

        Args:
            device: The device.
            heights: Whether the world has heights.

        Raises:
            ValueError: If there are none, or they have heights that the world does not have.
        """
        if not self.azimuth_m.shape[-1]:
            raise ValueError("the scene holds no scatterer; give it at least one")
        if self.height_m is not None and not heights:
            raise ValueError(
                "scatterers have heights, which only a world seen from any path has; give azimuths and ranges alone"
            )
        height = None if self.height_m is None else self.height_m.to(device)
        return Scatterers(*(x.to(device) for x in self.tensors), height_m=height)


def unit_phases(turns: Tensor) -> Tensor:
    """Return the complex numbers of magnitude one whose phases are given.

    Args:
        turns: Phases in cycles, any shape, float64.

    Returns:
        exp(2j pi turns) of the same shape, complex128.
    """
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


class Scene(Protocol):
    """Scene of point scatterers: the protocol that every scene of this package follows.

    >>> from torchsar import Draws, scene
    >>> class Corner(scene.Scene):
    ...     def scatterers(self, draws):
    ...         return scene.Points([0.0, 0.0, 1.0], [0.0, 1.0, 0.0]).scatterers(draws)
    >>> Corner().scatterers(Draws(seed=1)).range_m.tolist()
    [0.0, 1.0, 0.0]
    """

    def scatterers(self, draws: Draws) -> Scatterers:
        """Draw the scatterers.

        Args:
            draws: Random draws.

        Returns:
            Scatterers of shape (..., target).
        """
        ...


@dataclass(frozen=True)
@finite_numbers("points")
class Points(Scene):
    """Point scatterers at given positions, with given amplitudes.

    >>> from torchsar import Draws, scene
    >>> pair = scene.Points(azimuth_m=[0.0, 12.0], range_m=[0.0, 40.0], amplitude=[1.0, 0.5])
    >>> pair.scatterers(Draws(seed=1)).amplitude.tolist()
    [(1+0j), (0.5+0j)]

    Every parameter is a list with one entry per target; each entry is a number or one value per
    trial.

    Args:
        azimuth_m: Azimuths in metres, 0 at the middle pulse of a strip or at the origin of the
            ground.
        range_m: Ranges in metres, 0 in the middle of the recorded ranges of a strip, at the origin
            of the ground seen from any path, or in the centre of a turntable.
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

    def scatterers(self, draws: Draws) -> Scatterers:
        x, r = stacked(self.azimuth_m), stacked(self.range_m)
        level = torch.ones_like(x) if self.amplitude is None else stacked(self.amplitude)
        turns = draws.uniform("scene.points.phase", x.shape[-1:]) if self.random_phase else torch.zeros_like(x)
        x, r, level, turns = torch.broadcast_tensors(x, r, level, turns)
        return Scatterers(x, r, torch.polar(level, 2 * math.pi * turns))


def turned(place_m: Tensor, heading_deg: Tensor | float) -> Tensor:
    """Turn places from positive azimuth towards positive range.

    Args:
        place_m: Azimuth and range in metres, shape (point, 2), float64.
        heading_deg: Angle in degrees, or one per trial, shape (...,).

    Returns:
        Turned places in metres, shape (..., point, 2).
    """
    turn = either(heading_deg, math.radians, torch.deg2rad)
    cos, sin = either(turn, math.cos, torch.cos), either(turn, math.sin, torch.sin)
    return place_m @ stacked([cos, sin, -sin, cos]).unflatten(-1, (2, 2))


@dataclass(frozen=True, eq=False)
@finite_numbers("a point cloud")
class PointCloud(Scene):
    """Point scatterers at the places of an array, such as that of `torchsar.io.read_points`.

    >>> from torchsar import Draws, scene
    >>> cloud = scene.PointCloud([[0.0, 0.0], [3.0, 0.0]], heading_deg=90.0, range_m=5.0)
    >>> cloud.scatterers(Draws(seed=1)).range_m.round().tolist()
    [5.0, 8.0]

    The cloud is turned about its origin and then displaced. Unlike those of `Points`, its points
    have no names and are not measured one by one.

    Args:
        place_m: Azimuth (or cross range) and range in metres, and height above the ground if
            wanted: an array or a tensor of shape (point, 2) or (point, 3).
        amplitude: Amplitudes, real or complex, shape (point,); None for 1.
        azimuth_m: Azimuth in metres of the origin of the cloud.
        range_m: Range in metres of its origin.
        heading_deg: Angle in degrees by which it is turned, from positive azimuth towards positive
            range.
        fluctuation: Factor of the amplitudes that each trial draws: "phase" for a random phase of
            every point, "speckle" for circular Gaussian numbers of unit mean power, or "none".

    Raises:
        ValueError: If shapes do not agree, there is no point, a number is not finite, or the
            fluctuation is unknown.
    """

    place_m: Any
    amplitude: Any = None
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0
    heading_deg: Tensor | float = 0.0
    fluctuation: Literal["phase", "speckle", "none"] = "phase"

    def __post_init__(self) -> None:
        place = torch.as_tensor(self.place_m, dtype=torch.float64)
        level = torch.as_tensor(1.0 if self.amplitude is None else self.amplitude).to(torch.complex128)
        if (
            place.ndim != 2
            or not len(place)
            or place.shape[1] not in (2, 3)
            or level.shape not in ((), place.shape[:1])
        ):
            raise ValueError(
                "place_m of a point cloud must have the shape (point, 2) or (point, 3) and amplitude (point,), got "
                f"{tuple(place.shape)} and {tuple(level.shape)}"
            )
        if not bool(torch.isfinite(place).all() and torch.isfinite(level.abs()).all()):
            raise ValueError("place_m and amplitude of a point cloud must be finite; remove points with NaN or inf")
        if self.fluctuation not in ("phase", "speckle", "none"):
            raise ValueError(f"fluctuation must be 'phase', 'speckle' or 'none', got {self.fluctuation!r}")
        object.__setattr__(self, "place_m", place)
        object.__setattr__(self, "amplitude", level.expand(len(place)))

    @staticmethod
    def of_image(
        amplitude: Any, azimuth_extent_m: float, range_extent_m: float, floor_db: float = -40.0, **keys: Any
    ) -> PointCloud:
        """Make a point of every pixel of an image that is bright enough.

        >>> from torchsar import scene
        >>> scene.PointCloud.of_image([[0.0, 2.0], [0.0, 0.0]], 20.0, 40.0).place_m.tolist()
        [[-5.0, 10.0]]

        The simulation takes the time of as many targets.

        Args:
            amplitude: Image of amplitudes, real or complex, an array or a tensor of shape (azimuth,
                range).
            azimuth_extent_m: Azimuth extent of the image in metres; its middle is the origin.
            range_extent_m: Range extent of the image in metres; its middle is the origin.
            floor_db: Level in dB relative to the brightest pixel, at or below which a pixel is left
                out.
            **keys: Further arguments of the cloud.

        Returns:
            The cloud, with points in the middles of pixels.

        Raises:
            ValueError: If an extent is not positive, or the image has another number of dimensions,
                no pixel above zero, or NaN.
        """
        for name, extent in (("azimuth", azimuth_extent_m), ("range", range_extent_m)):
            refuse_unless_positive(f"{name}_extent_m of an image", extent)
        image = torch.as_tensor(amplitude)
        image = image.to(torch.complex128 if image.is_complex() else torch.float64)
        level = image.abs()
        bright = level > 10 ** (floor_db / 20) * level.max() if level.numel() else level
        if image.ndim != 2 or not bool(bright.any()):
            raise ValueError(
                "an image must have the shape (azimuth, range) and finite pixels, some of them not zero, got shape "
                f"{tuple(image.shape)} with a largest magnitude of {float(level.max()) if level.numel() else 0:g}"
            )
        at, shape = bright.nonzero(), level.new_tensor(image.shape)
        place = ((at + 0.5) / shape - 0.5) * level.new_tensor([azimuth_extent_m, range_extent_m])
        return PointCloud(place, image[bright], **keys)

    def scatterers(self, draws: Draws) -> Scatterers:
        place, count = turned(self.place_m[:, :2], self.heading_deg), self.place_m.shape[:1]
        x, r = (place[..., i] + with_dims(v, 1, place) for i, v in enumerate((self.azimuth_m, self.range_m)))
        amplitude = self.amplitude
        if self.fluctuation == "phase":
            amplitude = amplitude * unit_phases(draws.uniform("scene.cloud.phase", count))
        elif self.fluctuation == "speckle":
            amplitude = amplitude * draws.normal("scene.cloud.amplitude", count, torch.complex128)
        return Scatterers(x, r, amplitude, self.place_m[:, 2] if self.place_m.shape[1] == 3 else None)


@dataclass(frozen=True)
class _Rectangle(Scene):
    """Base of scenes of random scatterers in a rectangle."""

    count: int
    azimuth_extent_m: Tensor | float
    range_extent_m: Tensor | float
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0

    def __post_init__(self) -> None:
        sentence = "a random scene needs at least one scatterer and extents of 0 m or more"
        if self.count < 1:
            raise ValueError(f"{sentence}, got count={self.count}")
        for extent in (self.azimuth_extent_m, self.range_extent_m):
            refuse_unless(sentence, extent, lambda x: finite(x) & (x >= 0))
        for name in ("azimuth_m", "range_m"):
            refuse_unless_finite(f"{name} of random scatterers", getattr(self, name))

    def _shares(self, draws: Draws, purpose: str) -> list[Tensor]:
        """Draw azimuth and range of the scatterers as shares of the sides, (..., target) each."""
        return [draws.uniform(f"{purpose}.{name}", (self.count,)) for name in ("azimuth", "range")]

    def _places(self, shares: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Azimuth and range in metres at shares of the sides, (..., target) each."""
        middles, extents = (self.azimuth_m, self.range_m), (self.azimuth_extent_m, self.range_extent_m)
        x, r = (
            with_dims(middle, 1, share) + with_dims(extent, 1, share) * (share - 0.5)
            for middle, extent, share in zip(middles, extents, shares, strict=True)
        )
        return x, r


@dataclass(frozen=True)
@finite_numbers("random points")
class RandomPoints(_Rectangle):
    """Points at random positions in a rectangle, with random powers and phases.

    >>> from torchsar import Draws, scene
    >>> points = scene.RandomPoints(100, azimuth_extent_m=10.0, range_extent_m=20.0)
    >>> drawn = points.scatterers(Draws(seed=1, trials=range(3)))
    >>> drawn.range_m.shape, bool(drawn.range_m.abs().max() <= 10)
    (torch.Size([3, 100]), True)

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

    spread_db: Tensor | float = 0.0

    def scatterers(self, draws: Draws) -> Scatterers:
        share = draws.uniform("scene.random.level", (self.count,))
        level = 10 ** (-with_dims(self.spread_db, 1, share) * share / 20)
        phase = 2 * math.pi * draws.uniform("scene.random.phase", (self.count,))
        amplitude = torch.polar(*torch.broadcast_tensors(level, phase))
        return Scatterers(*self._places(self._shares(draws, "scene.random")), amplitude)


@dataclass(frozen=True)
class Speckle(_Rectangle):
    """Rectangle of fully developed speckle: circular Gaussian scatterers at random positions.

    >>> from torchsar import Draws, scene
    >>> field = scene.Speckle(1000, azimuth_extent_m=10.0, range_extent_m=20.0, level_db=20.0)
    >>> round(float(field.scatterers(Draws(seed=1)).amplitude.abs().square().sum()), -1)
    100.0

    About three scatterers or more per resolution cell are needed for the statistics of clutter.
    With a texture they form compound (K-distributed) clutter: the intensity I of a scatterer
    satisfies <I^2> / <I>^2 = 2 (1 + 1 / texture_shape), and so does that of an image whose
    resolution cells are smaller than those of the texture:

    >>> spiky = scene.Speckle(200_000, 100.0, 100.0, texture_shape=2.0, texture_cells=(100, 100))
    >>> intensity = spiky.scatterers(Draws(seed=1)).amplitude.abs().square()
    >>> round(float(intensity.square().mean() / intensity.mean().square()), 1)
    3.0

    Args:
        count: Number of scatterers, fixed for all trials.
        azimuth_extent_m: Azimuth side of the rectangle in metres.
        range_extent_m: Range side of the rectangle in metres.
        azimuth_m: Azimuth of its middle in metres.
        range_m: Range of its middle in metres.
        level_db: Mean power of all scatterers together in decibels relative to a scatterer of
            amplitude 1, within +-300 dB. With a texture it is the mean over random draws.
        texture_shape: Shape of the gamma distribution of the local mean power, 0.1 to 1000, small
            for spiky clutter; None or inf for pure speckle.
        texture_cells: Numbers of cells of one local mean power along the azimuth side and the range
            side of the rectangle, fixed for all trials.

    Raises:
        ValueError: If there is no scatterer or cell, an extent is negative or a number is out of
            range.

    Reference:
        Ward, Tough and Watts, Sea Clutter, IET 2013 (compound model).
    """

    level_db: Tensor | float = 0.0
    texture_shape: Tensor | float | None = None
    texture_cells: tuple[int, int] = (10, 10)

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unless("level_db must lie within +-300 dB", self.level_db, lambda x: abs(x) <= 300)
        refuse_other_shape("texture_shape of speckle", math.inf if self.texture_shape is None else self.texture_shape)
        if len(self.texture_cells) != 2 or not all(isinstance(n, int) and n >= 1 for n in self.texture_cells):
            raise ValueError(
                "texture_cells of speckle must be two whole numbers of 1 or more, along azimuth and range, got "
                f"{self.texture_cells}"
            )

    def scatterers(self, draws: Draws) -> Scatterers:
        unit = draws.normal("scene.speckle.amplitude", (self.count,), torch.complex128)
        scale = 10 ** (with_dims(self.level_db, 1, unit) / 20) / math.sqrt(self.count)
        shares = self._shares(draws, "scene.speckle")
        if self.texture_shape is None:
            return Scatterers(*self._places(shares), scale * unit)
        texture = gamma_texture(self.texture_shape, self.texture_cells, draws, "scene.speckle.texture", unit.device)
        row, column = ((share * n).long().clamp(max=n - 1) for share, n in zip(shares, self.texture_cells, strict=True))
        trials = np.broadcast_shapes(texture.shape[:-2], row.shape[:-1])
        cell = (row * self.texture_cells[1] + column).expand(*trials, -1)
        local = texture.flatten(-2).expand(*trials, -1).gather(-1, cell)
        return Scatterers(*self._places(shares), scale * unit * local.sqrt())


@dataclass(frozen=True)
class Together(Scene):
    """Several scenes in one.

    >>> from torchsar import Draws, scene
    >>> ground = scene.Speckle(100, azimuth_extent_m=10.0, range_extent_m=20.0)
    >>> both = scene.Together({"ground": ground, "target": scene.Points([0.0], [0.0])})
    >>> both.scatterers(Draws(seed=1)).amplitude.shape
    torch.Size([101])

    Args:
        parts: Scenes by name. The name of a scene decides which random numbers it draws.
    """

    parts: Mapping[str, Scene]

    def scatterers(self, draws: Draws) -> Scatterers:
        parts = [scene.scatterers(draws.part(name)) for name, scene in self.parts.items()]
        trials = np.broadcast_shapes(*(x.shape[:-1] for part in parts for x in part.tensors))
        height = None
        if any(part.height_m is not None for part in parts):
            height = joined([torch.zeros_like(p.range_m) if p.height_m is None else p.height_m for p in parts])
        three = (joined(kind, trials) for kind in zip(*(part.tensors for part in parts), strict=True))
        return Scatterers(*three, height_m=height)


def joined(parts: Sequence[Tensor], trials: Sequence[int] = ()) -> Tensor:
    """Join the targets of several scenes along the last dimension.

    Args:
        parts: A quantity in each scene, shape (..., target).
        trials: Shape of the trials, to which quantities that are equal in all trials are expanded
            even if no part differs between trials.

    Returns:
        The quantity in all scenes, shape (..., target).
    """
    trials = np.broadcast_shapes(tuple(trials), *(x.shape[:-1] for x in parts))
    return torch.cat([x.expand(*trials, -1) for x in parts], -1)
