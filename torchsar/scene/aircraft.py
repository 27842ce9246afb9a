"""Targets of inverse synthetic aperture ladar: an aircraft model, and rows of scatterers.

The cross range x of a scatterer is its `azimuth_m`. A scatterer with positive x recedes from the
radar as the rotation angle theta grows from zero: its echo phase is
exp(-4j pi x sin(theta) / lambda).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.targets import Scatterers, Scene, turned, unit_phases
from torchsar.scene.trials import finite_numbers, refuse_unless, with_dims

# Half of the outline from nose to tail, and the fin from above.
# Each point is the position along the fuselage in lengths of the aircraft and across it in half
# wing spans. The shape is chosen here, because the publication gives no coordinates.
_SIDE = (
    (0.50, 0.000),
    (0.47, 0.060),
    (0.40, 0.115),
    (0.13, 0.130),
    (-0.10, 1.000),
    (-0.18, 1.000),
    (-0.09, 0.130),
    (-0.36, 0.100),
    (-0.45, 0.360),
    (-0.50, 0.360),
    (-0.46, 0.060),
    (-0.49, 0.000),
)
_FIN = ((-0.36, 0.0), (-0.48, 0.0))


def along_line(corners: Tensor, spacing_m: float) -> Tensor:
    """Return points at equal distances along a line with corners.

    Args:
        corners: Corners of the line in metres, shape (corner, 2), float64.
        spacing_m: Distance between neighbouring points in metres.

    Returns:
        Points from the first corner on in metres, shape (point, 2), float64.
    """
    ends = torch.linalg.vector_norm(corners.diff(dim=0), dim=-1).cumsum(0)
    reach = torch.arange(0.0, float(ends[-1]), spacing_m, dtype=torch.float64)
    part = torch.searchsorted(ends, reach, right=True).clamp_max(len(ends) - 1)
    starts = torch.cat([torch.zeros(1, dtype=torch.float64), ends])[part]
    share = (reach - starts) / (ends[part] - starts)
    return corners[part] + share[:, None] * (corners[part + 1] - corners[part])


@dataclass(frozen=True)
@finite_numbers("an aircraft", spacing_m="positive", length_m="positive", width_m="positive")
class Aircraft(Scene):
    """Outline of an aircraft with swept wings, tail plane and fin, about 600 scatterers.

    >>> from torchsar import Draws, scene
    >>> points = scene.Aircraft(length_m=0.2).scatterers(Draws(seed=1, trials=range(3)))
    >>> points.amplitude.shape, round(float(points.azimuth_m.max()), 2)
    (torch.Size([3, 625]), 0.1)

    The fuselage lies along cross range; ranges count from the middle of the window. The publication
    gives no coordinates of its target; this model reproduces the pattern of the published image
    entropies. Each trial draws circular Gaussian amplitudes (Rayleigh magnitude, uniform phase,
    unit mean power) and displaces every scatterer by up to half a spacing in both directions, so
    that no scatterer lies on a grid.

    Args:
        spacing_m: Distance of scatterers along the outline in metres, fixed for all trials, since
            it decides their number.
        length_m: Length of the fuselage in metres, fixed for all trials.
        width_m: Wing span in metres, fixed for all trials.
        heading_deg: Rotation of the nose from positive cross range towards positive range in
            degrees.

    Raises:
        ValueError: If a length is not positive or the heading is not finite.

    Reference:
        Ruan et al. 2013, Table 1 (entropies).
    """

    spacing_m: float = 1.2e-3
    length_m: float = 0.19
    width_m: float = 0.15
    heading_deg: Tensor | float = 0.0

    def outline(self) -> Tensor:
        """Return the scatterers before their random displacement.

        Returns:
            Cross range and range in metres, shape (..., target, 2), float64.
        """
        scale = torch.tensor([self.length_m, self.width_m / 2], dtype=torch.float64)
        side, fin = (torch.tensor(line, dtype=torch.float64) for line in (_SIDE, _FIN))
        lines = (side, side * torch.tensor([1.0, -1.0], dtype=torch.float64), fin)
        points = torch.cat([along_line(scale * line, self.spacing_m) for line in lines])
        return turned(points, self.heading_deg)

    def scatterers(self, draws: Draws) -> Scatterers:
        points = self.outline()
        shape = tuple(points.shape[-2:])
        moved = points + self.spacing_m * (draws.uniform("scene.aircraft.place", shape) - 0.5)
        amplitude = draws.normal("scene.aircraft.amplitude", shape[:1], torch.complex128)
        return Scatterers(moved[..., 0], moved[..., 1], amplitude)


@dataclass(frozen=True)
@finite_numbers("spread rows", width=None, extent_m="positive", range_step_m="positive")
class SpreadRows(Scene):
    """Occupied range cells with several scatterers of unit amplitude in each.

    >>> from torchsar import Draws, scene
    >>> rows = scene.SpreadRows(2, 3, width=0.5, extent_m=8.0, range_step_m=0.5, range_cells=8)
    >>> rows.scatterers(Draws(seed=1)).range_m.tolist()
    [-1.0, -1.0, -1.0, 1.0, 1.0, 1.0]

    The occupied cells are spread evenly over the window and lie on its grid, where sample
    range_cells // 2 is range zero; all other cells are empty. Phases and cross ranges are random.

    Args:
        rows: Number of occupied range cells.
        per_row: Number of scatterers in each of them.
        width: Fraction of the unambiguous cross-range extent that the positions fill, 0 to 1.
        extent_m: Unambiguous cross-range extent in metres, lambda PRF / (2 omega).
        range_step_m: Length of a range cell in metres.
        range_cells: Number of range cells of the window.

    Raises:
        ValueError: If a count, the width or a length is out of range.
    """

    rows: int
    per_row: int
    width: Tensor | float
    extent_m: Tensor | float
    range_step_m: Tensor | float
    range_cells: int = 256

    def __post_init__(self) -> None:
        if not (1 <= self.rows <= self.range_cells and self.per_row >= 1):
            raise ValueError(
                f"rows must lie in 1..{self.range_cells}, the number of range cells, and per_row, the scatterers of "
                f"a row, must be at least 1, got rows={self.rows}, per_row={self.per_row}"
            )
        refuse_unless("width of spread rows must be in 0..1", self.width, lambda x: (x >= 0) & (x <= 1))

    def scatterers(self, draws: Draws) -> Scatterers:
        cell = (
            (torch.arange(self.rows, dtype=torch.float64) + 0.5) * self.range_cells / self.rows
        ).floor() - self.range_cells // 2
        shape = (self.rows, self.per_row)
        width, extent, step = (with_dims(v, 2, cell) for v in (self.width, self.extent_m, self.range_step_m))
        x = width * extent * (draws.uniform("scene.rows.azimuth", shape) - 0.5)
        amplitude = unit_phases(draws.uniform("scene.rows.phase", shape))
        return Scatterers(*(v.flatten(-2) for v in torch.broadcast_tensors(x, cell[:, None] * step, amplitude)))
