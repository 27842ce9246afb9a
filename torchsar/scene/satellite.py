"""A procedural satellite: box, two gridded panels, dish and boom, as scatterers that every trial
draws anew.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.scene.targets import Scatterers
from torchsar.scene.vibration import refuse_unless_finite

# body axes before the tilt: along the panels, along the line of sight (away from the radar), across
# both. Only proportions count: the whole is
# fitted to the extents asked for.
_BUS = (0.7, 1.3, 1.2)
_PANEL = (0.8, 6.43, 1.9)  # first and last place along the panels, half chord
_BAYS, _STRINGS = 4, 8  # cells of a panel's grid along and across
_DISH = (
    0.2,
    -1.5,
    1.2,
    0.8,
)  # place along the panels, place of the vertex on the line of sight, radius of the rim, depth
_FEED = -3.1
_BOOM = ((-0.3, 1.3, 0.3), (-0.5, 3.5, 0.3))
_CROSSBAR = 0.45
_SHARES = {"bus": 0.26, "panel_left": 0.29, "panel_right": 0.29, "dish": 0.08, "boom": 0.08}
_LEAST = 60


class _Part(Protocol):
    """A part of the body: corners, which all trials share, and the points that uniform numbers
    (..., n, 3) become.
    """

    def corners(self) -> Tensor: ...

    def points(self, u: Tensor) -> Tensor: ...


def _table(rows: object) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _spread(u: Tensor) -> Tensor:
    """One number in 0..1 for each of n points, (..., n): a random place in each of n equal cells,
    so that nothing clumps.
    """
    n = u.shape[-1]
    return (torch.arange(n, dtype=u.dtype, device=u.device) + u) / n


def _on_lines(starts: Tensor, ends: Tensor, share: Tensor) -> Tensor:
    """Points at shares (..., n) of the total length of lines from starts (line, 3) to ends (line,
    3), (..., n, 3).
    """
    length = torch.linalg.vector_norm(ends - starts, dim=-1)
    reach = share * length.sum()
    past = length.cumsum(0)
    line = torch.searchsorted(past, reach.contiguous(), right=True).clamp_max(len(length) - 1)
    along = (reach - (past - length)[line]) / length[line]
    return torch.lerp(starts[line], ends[line], along.clamp(0, 1)[..., None])


class _Bus:
    """The faces of a box, each with points by its area."""

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
    """The lines of a flat grid on one side (-1 or 1) of the bus; all of its outer edge is
    the tip.
    """

    side: float

    def _at(self, along: Tensor, chord: Tensor) -> Tensor:
        first, last, half = _PANEL
        return torch.stack([self.side * (first + (last - first) * along), torch.zeros_like(along), half * chord], -1)

    def corners(self) -> Tensor:
        return self._at(_table([0, 0, 1, 1]), _table([-1, 1, -1, 1]))

    def points(self, u: Tensor) -> Tensor:
        ribs, strings = (
            torch.linspace(0, 1, _BAYS + 1, dtype=torch.float64),
            torch.linspace(-1, 1, _STRINGS + 1, dtype=torch.float64),
        )
        one_rib, one_string = torch.ones_like(ribs), torch.ones_like(strings)
        starts = torch.cat([self._at(ribs, -one_rib), self._at(0 * one_string, strings)])
        ends = torch.cat([self._at(ribs, one_rib), self._at(one_string, strings)])
        return _on_lines(starts, ends, _spread(u[..., 0]))


class _Dish:
    """A paraboloid that opens towards the radar, the ends of its rim, and its feed."""

    def corners(self) -> Tensor:
        place, vertex, radius, depth = _DISH
        return _table([(place, _FEED, 0), (place, vertex - depth, -radius), (place, vertex - depth, radius)])

    def points(self, u: Tensor) -> Tensor:
        place, vertex, radius, depth = _DISH
        out, turn = _spread(u[..., 0]), 2 * math.pi * u[..., 1]
        reach = radius * torch.sqrt(out)
        return torch.stack([place + reach * torch.cos(turn), vertex - depth * out, reach * torch.sin(turn)], -1)


class _Boom:
    """A rod away from the radar with a crossbar at its end."""

    def corners(self) -> Tensor:
        return _table([_BOOM[1]])

    def points(self, u: Tensor) -> Tensor:
        root, tip = _table(_BOOM)
        arm = _table((_CROSSBAR, 0, 0))
        return _on_lines(torch.stack([root, tip - arm]), torch.stack([tip, tip + arm]), _spread(u[..., 0]))


_PARTS: Mapping[str, _Part] = {
    "bus": _Bus(),
    "panel_left": _Panel(-1.0),
    "panel_right": _Panel(1.0),
    "dish": _Dish(),
    "boom": _Boom(),
}


@dataclass(frozen=True)
class Satellite:
    """A satellite of `count` scatterers: the faces of its box hold 26 %, two gridded panels 29 %
    each, a dish and a boom 8 % each.

    The stand-in for the model of Remote Sens. 2025, 17, 3447, whose points are not published.
    Panels lie along cross range; the body is tilted by tilt_rad about them, projected to cross
    range and range, and fitted to +-half_width_m and +-half_depth_m exactly. Tips, corners of box
    and panels, rim and feed of the dish and the end of the boom are scatterers of amplitude
    corner_level at places that all trials share; the tips lie exactly at +-half_width_m. All others
    move from trial to trial and have amplitudes 0.4 + 0.6 r, r Rayleigh of unit scale. Phases are
    uniform. azimuth_m is cross range.
    """

    count: int = 600
    half_width_m: float = 6.43
    half_depth_m: float = 3.4
    tilt_rad: float = 0.42
    corner_level: float = 1.5

    def __post_init__(self) -> None:
        if self.count < _LEAST:
            raise ValueError(
                f"a satellite needs at least {_LEAST} scatterers to have all of its parts, got count={self.count}"
            )
        for name in ("half_width_m", "half_depth_m", "corner_level"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} of a satellite must be a positive number, got {getattr(self, name)}")
        refuse_unless_finite("tilt_rad of a satellite", self.tilt_rad)
        if abs(self.tilt_rad) > math.pi / 4:
            raise ValueError(
                f"tilt_rad of a satellite must lie within +-pi/4, got {self.tilt_rad}; beyond, its "
                "panels would reach farther in range than dish and boom"
            )

    def parts(self) -> dict[str, slice]:
        """Which of the scatterers belong to each part; the corners of a part come first."""
        shares = itertools.accumulate(_SHARES.values())
        ends = [round(share * self.count) for share in shares]
        return {name: slice(first, last) for name, first, last in zip(_SHARES, [0, *ends], ends)}

    def corners(self) -> Tensor:
        """Which of the scatterers are corners, (target,) bool."""
        found = torch.zeros(self.count, dtype=torch.bool)
        for name, members in self.parts().items():
            found[members.start : members.start + len(_PARTS[name].corners())] = True
        return found

    def _seen(self, body: Tensor) -> Tensor:
        """Body points (..., 3) as cross range and range before they are fitted to the extents,
        (..., 2).
        """
        return torch.stack(
            [body[..., 0], math.cos(self.tilt_rad) * body[..., 1] - math.sin(self.tilt_rad) * body[..., 2]], -1
        )

    def _fitted(self, seen: Tensor) -> Tensor:
        """Places (..., 2) in m: what the corners reach becomes the extents, which no other point
        passes.
        """
        corners = self._seen(torch.cat([part.corners() for part in _PARTS.values()]))
        low, high = corners.amin(0), corners.amax(0)
        return (((seen - low) - (high - seen)) / (high - low)).clamp(-1, 1) * _table(
            [self.half_width_m, self.half_depth_m]
        )

    def scatterers(self, draws: Draws) -> Scatterers:
        u = draws.uniform("scene.satellite.place", (self.count, 3))
        places = self._fitted(
            self._seen(
                torch.cat(
                    [_part_points(_PARTS[name], u[..., members, :]) for name, members in self.parts().items()], -2
                )
            )
        )
        rayleigh = torch.sqrt(-2 * torch.log1p(-draws.uniform("scene.satellite.level", (self.count,))))
        level = torch.where(self.corners(), self.corner_level, 0.4 + 0.6 * rayleigh)
        return Scatterers(
            places[..., 0],
            places[..., 1],
            torch.polar(level, 2 * math.pi * draws.uniform("scene.satellite.phase", (self.count,))),
        )


def _part_points(part: _Part, u: Tensor) -> Tensor:
    """Corners of a part, then as many of its points as numbers are left, (..., n, 3)."""
    corners = part.corners()
    return torch.cat([corners.expand(*u.shape[:-2], -1, -1), part.points(u[..., len(corners) :, :])], -2)
