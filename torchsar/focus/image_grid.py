"""Grid of the pixels of an image in space."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.radar.antenna_path import refuse_unusable

# largest accepted difference of the inner products of the axes from 1 and 0, by choice; axes
# computed in single precision are accepted
_UNIT = 1e-6
# largest number of pixels of an image, by choice: 17 GB in single precision
_MOST_PIXELS = 2**31


def level_plane(
    range_axis_rad: float,
    azimuth_m: float,
    range_m: float,
    height_m: float,
    device: torch.device | str | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the axes of a level plane, and a point of it in local Cartesian coordinates.

    Args:
        range_axis_rad: Angle of the range axis from x towards y in rad; the azimuth axis lies a
            right angle further.
        azimuth_m: Position of the point along the azimuth axis in metres.
        range_m: Position of the point along the range axis in metres.
        height_m: Height z of the plane in metres.
        device: Device of the results.

    Returns:
        The azimuth and the range axis, unit vectors (2, 3), and the point in metres, (3,), float64.
    """
    sin, cos = math.sin(range_axis_rad), math.cos(range_axis_rad)
    point = (range_m * cos - azimuth_m * sin, azimuth_m * cos + range_m * sin, float(height_m))
    axes = [[-sin, cos, 0.0], [cos, sin, 0.0]]
    made = [torch.tensor(x, dtype=torch.float64, device=device) for x in (axes, point)]
    return made[0], made[1]


@dataclass(frozen=True, eq=False)
class ImageGrid:
    """Pixels of a plane or of the ground above it, in local Cartesian coordinates.

    >>> import torch
    >>> from torchsar import focus
    >>> origin_m, axes = torch.zeros(3).double(), torch.eye(2, 3).double()
    >>> grid = focus.ImageGrid(origin_m, axes, counts=(3, 4), step_m=0.5)
    >>> grid.pixels_m().shape, grid.pixels_m()[2, 3].tolist()
    (torch.Size([3, 4, 3]), [1.0, 1.5, 0.0])

    Pixel (i, j) lies at origin_m + step_m (i axes[0] + j axes[1]) + height_m[i, j] n, where n =
    axes[0] x axes[1] is the normal. Images are differentiable in the heights.

    Args:
        origin_m: Position of pixel (0, 0) in metres, float64 (3,).
        axes: Unit vectors along which the first and the second index grow, perpendicular to each
            other, float64 (2, 3).
        counts: Number of pixels along either axis, at most 2^31 together.
        step_m: Pixel spacing in metres.
        height_m: Heights of the pixels above the plane in metres, float64 (i, j); None for 0.

    Raises:
        TypeError: If the heights are not float64.
        ValueError: If a shape is wrong, the axes are not perpendicular unit vectors, a count is
            below 1, there are too many pixels, the spacing is not positive and finite, or a height
            is not finite.
    """

    origin_m: Tensor
    axes: Tensor
    counts: tuple[int, int]
    step_m: float
    height_m: Tensor | None = None

    def __post_init__(self) -> None:
        origin, axes = (torch.as_tensor(v, dtype=torch.float64) for v in (self.origin_m, self.axes))
        if origin.shape != (3,) or axes.shape != (2, 3) or not bool(torch.isfinite(origin).all()):
            raise ValueError(
                "an image grid needs a finite origin_m of shape (3,) and axes of shape (2, 3), got "
                f"{tuple(origin.shape)} and {tuple(axes.shape)}"
            )
        products = axes @ axes.mT
        if not float((products - torch.eye(2, dtype=torch.float64, device=axes.device)).abs().max()) <= _UNIT:
            raise ValueError(
                "the axes of an image grid must be perpendicular unit vectors, got products of "
                f"{[[round(v, 6) for v in row] for row in products.tolist()]}; divide them by their lengths"
            )
        counts = tuple(self.counts)
        if len(counts) != 2 or not all(isinstance(n, int) and n >= 1 for n in counts):
            raise ValueError(f"an image grid needs two counts of at least 1 pixel, got {self.counts}")
        if counts[0] * counts[1] > _MOST_PIXELS:
            raise ValueError(
                f"an image of {counts[0]} x {counts[1]} pixels is too large, at most {_MOST_PIXELS:g} are accepted; "
                "choose a coarser spacing or a smaller extent"
            )
        if not 0 < float(self.step_m) < float("inf"):
            raise ValueError(f"the pixel spacing step_m must be positive and finite, got {self.step_m} m")
        if self.height_m is not None:
            refuse_unusable(height_m=self.height_m)
            if self.height_m.shape != counts:
                raise ValueError(
                    f"height_m of an image grid must have the shape of its counts {counts}, got "
                    f"{tuple(self.height_m.shape)}"
                )
        for name, value in {"origin_m": origin, "axes": axes, "counts": counts, "step_m": float(self.step_m)}.items():
            object.__setattr__(self, name, value)

    def pixels_m(self, rows: slice = slice(None), columns: slice = slice(None)) -> Tensor:
        """Return positions of pixels in metres, float64 (i, j, 3).

        Args:
            rows: Pixels along the first axis.
            columns: Pixels along the second axis.
        """
        i, j = (
            torch.arange(n, dtype=torch.float64, device=self.origin_m.device)[part, None]
            for n, part in zip(self.counts, (rows, columns), strict=True)
        )
        plane = self.origin_m + self.step_m * ((i * self.axes[0])[:, None] + j * self.axes[1])
        return plane if self.height_m is None else plane + self.height_m[rows, columns, None] * self.normal

    @property
    def normal(self) -> Tensor:
        """Unit vector along which heights are positive, float64 (3,)."""
        return torch.linalg.cross(*self.axes)

    def transposed(self) -> ImageGrid:
        """Return the same pixels with the two indices exchanged.

        The normal is then reversed, and the heights change their sign.
        """
        height = None if self.height_m is None else -self.height_m.mT
        return replace(self, axes=self.axes.flip(0), counts=self.counts[::-1], height_m=height)
