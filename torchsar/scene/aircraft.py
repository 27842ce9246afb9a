"""Targets of inverse synthetic aperture ladar: a model aircraft, and rows of scatterers that
estimators can be taken apart with.

Cross range is azimuth_m of the scatterers, positive on the side that turns away from the radar
first (echo phase exp(-4j pi x sin(theta) / lambda)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.targets import Scatterers

# one half of the silhouette from nose to tail: along the fuselage in lengths, across it in half
# spans
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


def _mirrored(line: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    return tuple((x, -y) for x, y in line)


def along_line(corners: Tensor, spacing_m: float) -> Tensor:
    """Points spacing_m apart along a line of corners (corner, 2), from its first corner on, (point,
    2) float64.
    """
    ends = torch.linalg.vector_norm(corners.diff(dim=0), dim=-1).cumsum(0)
    reach = torch.arange(0.0, float(ends[-1]), spacing_m, dtype=torch.float64)
    part = torch.searchsorted(ends, reach, right=True).clamp_max(len(ends) - 1)
    starts = torch.cat([torch.zeros(1, dtype=torch.float64), ends])[part]
    share = (reach - starts) / (ends[part] - starts)
    return corners[part] + share[:, None] * (corners[part + 1] - corners[part])


@dataclass(frozen=True)
class Aircraft:
    """Outline of an aircraft with swept wings, tail plane and fin, fuselage along cross range,
    about 600 scatterers.

    The published target has no coordinates; this one reproduces its pattern of entropies. length_m:
    along the fuselage; width_m: span; spacing_m: of scatterers along the outline; heading_deg turns
    the nose from +cross range towards +range. Each trial draws its own circular Gaussian amplitudes
    (Rayleigh modulus, uniform phase, unit mean power) and moves every scatterer by up to half a
    spacing in both directions, so that none sits on a grid. azimuth_m is cross range, range_m
    counts from the middle of the window.
    """

    spacing_m: float = 1.2e-3
    length_m: float = 0.19
    width_m: float = 0.15
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in ("spacing_m", "length_m", "width_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(
                    f"{name} of an aircraft must be a positive number of metres, got {getattr(self, name)}"
                )
        if not math.isfinite(self.heading_deg):
            raise ValueError(f"heading_deg of an aircraft must be a finite number, got {self.heading_deg}")

    def outline(self) -> Tensor:
        """Scatterers before they are moved, (target, 2) float64: cross range and range."""
        scale = torch.tensor([self.length_m, self.width_m / 2], dtype=torch.float64)
        lines = (_SIDE, _mirrored(_SIDE), _FIN)
        points = torch.cat(
            [along_line(scale * torch.tensor(line, dtype=torch.float64), self.spacing_m) for line in lines]
        )
        turn = math.radians(self.heading_deg)
        return points @ torch.tensor(
            [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]], dtype=torch.float64
        )

    def scatterers(self, draws: Draws) -> Scatterers:
        points = self.outline()
        moved = points + self.spacing_m * (draws.uniform("scene.aircraft.place", tuple(points.shape)) - 0.5)
        return Scatterers(
            moved[..., 0], moved[..., 1], draws.normal("scene.aircraft.amplitude", (len(points),), torch.complex128)
        )


@dataclass(frozen=True)
class SpreadRows:
    """`rows` occupied range cells, each with `per_row` scatterers of unit amplitude, random phase
    and random cross range.

    The cells are spread evenly over the range_cells of the window and lie on its grid (sample
    range_cells // 2 is range 0), so that no other row holds anything. width: share of the
    unambiguous cross-range extent extent_m, lambda PRF / (2 omega), that the places fill.
    """

    rows: int
    per_row: int
    width: float
    extent_m: float
    range_step_m: float
    range_cells: int = 256

    def __post_init__(self) -> None:
        if not (1 <= self.rows <= self.range_cells and self.per_row >= 1):
            raise ValueError(
                f"spread rows need 1 to range_cells={self.range_cells} rows with at least one "
                f"scatterer each, got rows={self.rows}, per_row={self.per_row}"
            )
        if not (0 <= self.width <= 1 and all(math.isfinite(v) and v > 0 for v in (self.extent_m, self.range_step_m))):
            raise ValueError(
                "spread rows need a width in 0..1 and a positive extent_m and range_step_m, got "
                f"{self.width}, {self.extent_m}, {self.range_step_m}"
            )

    def scatterers(self, draws: Draws) -> Scatterers:
        cell = (
            (torch.arange(self.rows, dtype=torch.float64) + 0.5) * self.range_cells / self.rows
        ).floor() - self.range_cells // 2
        shape = (self.rows, self.per_row)
        x = self.width * self.extent_m * (draws.uniform("scene.rows.azimuth", shape) - 0.5)
        turns = draws.uniform("scene.rows.phase", shape)
        y = (cell[:, None] * self.range_step_m).expand(x.shape)
        return Scatterers(*(v.flatten(-2) for v in (x, y, torch.polar(torch.ones_like(turns), 2 * math.pi * turns))))
