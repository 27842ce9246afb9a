"""Satellite model of box, two gridded panels, dish and boom.

Targets of inverse synthetic aperture ladar: an aircraft model, and rows of scatterers.

The cross range x of a scatterer is its `azimuth_m`. A scatterer with positive x recedes from the
radar as the rotation angle theta grows from zero: its echo phase is
exp(-4j pi x sin(theta) / lambda).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.targets import Scatterers, Scene, turned, unit_phases
from torchsar.scene.trials import either, finite_numbers, refuse_unless, stacked, with_dims

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


# Each part has `corners`, their positions (corner, 3), equal in all trials, and `points`, positions
# (..., n, 3) from uniform random numbers u (..., n, 3), both in the coordinates of the body.
#
# The proportions of the body are chosen here; only the position of the panel tip at 6.43 m is
# published. The three axes before the tilt are: along the panels, along the line of sight away from
# the radar, and perpendicular to both. The whole model is scaled to the given extents.
_BUS = (0.7, 1.3, 1.2)  # half lengths of the sides
_PANEL = (0.8, 6.43, 1.9)  # inner and outer end along the panels, and half width of a panel
# position along the panels, position of vertex and of feed along the line of sight, radius of the
# rim, and depth
_DISH = (0.2, -1.5, -3.1, 1.2, 0.8)
# root, tip, and half of the crossbar
_BOOM = ((-0.3, 1.3, 0.3), (-0.5, 3.5, 0.3), (0.45, 0.0, 0.0))
# fraction of the scatterers in each part, by choice
_SHARES = {"bus": 0.26, "panel_left": 0.29, "panel_right": 0.29, "dish": 0.08, "boom": 0.08}


def _table(rows: object) -> Tensor:
    """Make a float64 tensor of nested sequences of numbers."""
    return torch.tensor(rows, dtype=torch.float64)


def _spread(u: Tensor) -> Tensor:
    """Numbers in 0..1, one at a random position in each of n equal intervals, (..., n).

    Points at such positions do not form clusters.
    """
    n = u.shape[-1]
    return (torch.arange(n, dtype=u.dtype, device=u.device) + u) / n


def _on_lines(starts: Tensor, ends: Tensor, share: Tensor) -> Tensor:
    """Points on lines (line, 3), at given fractions (..., n) of their total length, (..., n, 3)."""
    length = torch.linalg.vector_norm(ends - starts, dim=-1)
    reach = share * length.sum()
    past = length.cumsum(0)
    line = torch.searchsorted(past, reach.contiguous(), right=True).clamp_max(len(length) - 1)
    along = (reach - (past - length)[line]) / length[line]
    return torch.lerp(starts[line], ends[line], along.clamp(0, 1)[..., None])


class _Bus:
    """Faces of a box; the number of points on a face is proportional to its area."""

    def corners(self) -> Tensor:
        return _table(_BUS) * _table(list(itertools.product((-1.0, 1.0), repeat=3)))

    def points(self, u: Tensor) -> Tensor:
        half, n = _table(_BUS), u.shape[-2]
        area = half.prod() / half
        face = torch.searchsorted(
            area.repeat_interleave(2).cumsum(0) / (2 * area.sum()), (torch.arange(n, dtype=torch.float64) + 0.5) / n
        )
        flat = torch.arange(3) == (face // 2)[:, None]
        return half * torch.where(flat, (2 * (face % 2) - 1.0)[:, None], 2 * u - 1)


@dataclass(frozen=True)
class _Panel:
    """Lines of a flat grid on one side (-1 or 1) of the bus."""

    side: float

    def _at(self, along: Tensor, chord: Tensor) -> Tensor:
        """Points at fractions of the length of the panel and of its half width."""
        first, last, half = _PANEL
        return torch.stack([self.side * (first + (last - first) * along), torch.zeros_like(along), half * chord], -1)

    def corners(self) -> Tensor:
        return self._at(_table([0, 0, 1, 1]), _table([-1, 1, -1, 1]))

    def points(self, u: Tensor) -> Tensor:
        # a grid of 4 cells along the panel and 8 across it
        ribs, strings = (torch.linspace(at, 1, n, dtype=torch.float64) for at, n in ((0, 5), (-1, 9)))
        one_rib, one_string = torch.ones_like(ribs), torch.ones_like(strings)
        starts = torch.cat([self._at(ribs, -one_rib), self._at(0 * one_string, strings)])
        ends = torch.cat([self._at(ribs, one_rib), self._at(one_string, strings)])
        return _on_lines(starts, ends, _spread(u[..., 0]))


class _Dish:
    """Paraboloid that opens towards the radar; its corners are the feed and two points of
    the rim.
    """

    def corners(self) -> Tensor:
        along, vertex, feed, radius, depth = _DISH
        return _table([(along, feed, 0), (along, vertex - depth, -radius), (along, vertex - depth, radius)])

    def points(self, u: Tensor) -> Tensor:
        along, vertex, _, radius, depth = _DISH
        out, turn = _spread(u[..., 0]), 2 * math.pi * u[..., 1]
        reach = radius * torch.sqrt(out)
        return torch.stack([along + reach * torch.cos(turn), vertex - depth * out, reach * torch.sin(turn)], -1)


class _Boom:
    """Rod that points away from the radar, with a crossbar at its end."""

    def corners(self) -> Tensor:
        return _table([_BOOM[1]])

    def points(self, u: Tensor) -> Tensor:
        root, tip, arm = _table(_BOOM)
        return _on_lines(torch.stack([root, tip - arm]), torch.stack([tip, tip + arm]), _spread(u[..., 0]))


# -1 and 1 are the signs of the cross range of the two panels
_PARTS: Mapping[str, _Bus | _Panel | _Dish | _Boom] = {
    "bus": _Bus(),
    "panel_left": _Panel(-1.0),
    "panel_right": _Panel(1.0),
    "dish": _Dish(),
    "boom": _Boom(),
}


@dataclass(frozen=True)
@finite_numbers("a satellite", half_width_m="positive", half_depth_m="positive", corner_level="positive")
class Satellite(Scene):
    """Satellite of random scatterers: box, two gridded panels, dish and boom.

    >>> from torchsar import Draws, scene
    >>> satellite = scene.Satellite(count=100)
    >>> points = satellite.scatterers(Draws(seed=1))
    >>> round(float(points.azimuth_m.max()), 2), satellite.parts()["dish"]
    (6.43, slice(84, 92, None))

    The box has 26 % of the scatterers, each panel 29 %, dish and boom 8 % each. The panels lie
    along cross range, and the body is tilted about this direction. Its projection to cross range
    and range is scaled to exactly the given extents.

    The corners of box and panels, the feed of the dish, two points of its rim and the end of the
    boom are scatterers at fixed positions, here all called corners. The panel tips lie at
    +-half_width_m. The positions of all other scatterers are drawn in each trial. Their amplitude
    is 0.4 + 0.6 r, where r is Rayleigh distributed with unit scale. The phases of all scatterers
    are uniform in 0 to 2 pi. The Reference gives no coordinates of its satellite; this model stands
    in for it.

    Args:
        count: Number of scatterers, at least 60, fixed for all trials.
        half_width_m: Half the extent in cross range in metres.
        half_depth_m: Half the extent in range in metres.
        tilt_rad: Tilt of the body about the direction of its panels in radians.
        corner_level: Amplitude of the corners.

    Raises:
        ValueError: If there are too few scatterers, an extent or the amplitude is not positive, or
            the tilt exceeds pi / 4.

    Reference:
        Remote Sens. 2025, 17, 3447 (satellite with a panel tip at 6.43 m).
    """

    count: int = 600
    half_width_m: Tensor | float = 6.43
    half_depth_m: Tensor | float = 3.4
    tilt_rad: Tensor | float = 0.42
    corner_level: Tensor | float = 1.5

    def __post_init__(self) -> None:
        if self.count < 60:  # with 60 or more, each part has more points than corners
            raise ValueError(
                f"a satellite needs at least 60 scatterers to have all of its parts, got count={self.count}"
            )
        refuse_unless(
            "tilt_rad of a satellite must lie within +-pi/4",
            self.tilt_rad,
            lambda x: abs(x) <= math.pi / 4,
            "beyond, its panels would reach farther in range than dish and boom",
        )

    def parts(self) -> dict[str, slice]:
        """Return which scatterers belong to each part; the corners of a part come first.

        Returns:
            Slices of the scatterers by the name of the part.
        """
        shares = itertools.accumulate(_SHARES.values())
        ends = [round(share * self.count) for share in shares]
        return {name: slice(first, last) for name, first, last in zip(_SHARES, [0, *ends], ends)}

    def corners(self) -> Tensor:
        """Return which scatterers are corners, which lie at the same positions in all trials.

        Returns:
            True for corners, shape (target,), bool.
        """
        found = torch.zeros(self.count, dtype=torch.bool)
        for name, members in self.parts().items():
            found[members.start : members.start + len(_PARTS[name].corners())] = True
        return found

    def _projected(self, body: Tensor) -> Tensor:
        """Project body points (..., 3) to cross range and range before scaling, (..., 2)."""
        cos, sin = (
            with_dims(either(self.tilt_rad, *functions), 1, body)
            for functions in ((math.cos, torch.cos), (math.sin, torch.sin))
        )
        return torch.stack(torch.broadcast_tensors(body[..., 0], cos * body[..., 1] - sin * body[..., 2]), -1)

    def _fitted(self, projected: Tensor) -> Tensor:
        """Scale projected points to positions in metres (..., 2), so that the corners reach the
        given extents.
        """
        corners = self._projected(torch.cat([part.corners() for part in _PARTS.values()]))
        low, high = corners.amin(-2, keepdim=True), corners.amax(-2, keepdim=True)
        half = stacked([self.half_width_m, self.half_depth_m])[..., None, :]
        return (((projected - low) - (high - projected)) / (high - low)).clamp(-1, 1) * half

    def scatterers(self, draws: Draws) -> Scatterers:
        u = draws.uniform("scene.satellite.place", (self.count, 3))
        members = self.parts().items()
        body = torch.cat([_part_points(_PARTS[name], u[..., part, :]) for name, part in members], -2)
        positions = self._fitted(self._projected(body))
        rayleigh = torch.sqrt(-2 * torch.log1p(-draws.uniform("scene.satellite.level", (self.count,))))
        level = torch.where(self.corners(), with_dims(self.corner_level, 1, rayleigh), 0.4 + 0.6 * rayleigh)
        phase = 2 * math.pi * draws.uniform("scene.satellite.phase", (self.count,))
        return Scatterers(positions[..., 0], positions[..., 1], torch.polar(*torch.broadcast_tensors(level, phase)))


def _part_points(part: _Bus | _Panel | _Dish | _Boom, u: Tensor) -> Tensor:
    """Corners of a part, followed by points for the remaining random numbers, (..., n, 3)."""
    corners = part.corners()
    return torch.cat([corners.expand(*u.shape[:-2], -1, -1), part.points(u[..., len(corners) :, :])], -2)
