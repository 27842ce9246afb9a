"""Moving targets of a receiver on a straight track, and how finely their ranges are followed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial
from torchsar.radar import BistaticRadar, receive_range
from torchsar.scene.vibration import refuse_unless_finite

Numbers = Sequence[float] | Tensor


@dataclass(frozen=True)
class Bend:
    """What real motion adds to uniform motion in the slant plane. float64 (..., target) each.

    transmit_m_s, transmit_m_s2: closing speed towards the transmitter and its growth; the range to
    it shrinks by s t + a t^2 / 2. along_m_s2: acceleration along track. second, third, fourth: b2
    t^2 + b3 t^3 + b4 t^4 (m^2) is added to (R0 - u_r t)^2 within the square of the range.
    """

    transmit_m_s: Tensor
    transmit_m_s2: Tensor
    along_m_s2: Tensor
    second: Tensor
    third: Tensor
    fourth: Tensor

    @staticmethod
    def none(like: Tensor) -> Bend:
        """Uniform motion in the slant plane, for joining with movers that have more."""
        return Bend(**{f.name: torch.zeros_like(like) for f in fields(Bend)})

    def each(self, change: Callable[[Tensor], Tensor]) -> Bend:
        """With every entry changed alike."""
        return Bend(**{f.name: change(getattr(self, f.name)) for f in fields(Bend)})

    def square_m2(self, time_s: Tensor) -> Tensor:
        """b2 t^2 + b3 t^3 + b4 t^4, (..., 1, pulse, target)."""
        t = time_s[:, None]
        second, third, fourth = (b[..., None, None, :] for b in (self.second, self.third, self.fourth))
        return t.square() * (second + t * (third + t * fourth))

    def transmit_m(self, time_s: Tensor) -> Tensor:
        """What the range to the transmitter grows by, (..., 1, pulse, target): negative for a
        closing target.
        """
        t = time_s[:, None]
        return -t * (self.transmit_m_s[..., None, None, :] + t / 2 * self.transmit_m_s2[..., None, None, :])


@dataclass(frozen=True)
class Movers:
    """Point targets and their motion at t = 0, the middle pulse.

    float64 (..., target), amplitude complex128; leading dims are trials. May require gradients.

    u_r_m_s: slant-range speed, closing positive; u_a_m_s: along track, positive with the receiver;
    y0_m: along-track place; range_m: of R0 beyond radar.reference_range_m. bend: None for uniform
    motion in the slant plane. Raises TypeError for other dtypes, ValueError for numbers of targets
    that disagree.
    """

    u_r_m_s: Tensor
    u_a_m_s: Tensor
    y0_m: Tensor
    range_m: Tensor
    amplitude: Tensor
    bend: Bend | None = None

    def __post_init__(self) -> None:
        real = (self.u_r_m_s, self.u_a_m_s, self.y0_m, self.range_m)
        if any(x.dtype != torch.float64 for x in real) or not self.amplitude.is_complex():
            raise TypeError(
                "movers need float64 speeds and places and complex amplitudes, got "
                f"{[x.dtype for x in (*real, self.amplitude)]}"
            )
        counts = [x.shape[-1] if x.ndim else 0 for x in (*real, self.amplitude)]
        if len(set(counts)) != 1:
            raise ValueError(
                f"movers need as many speeds, places and amplitudes as targets in the last dim, got {counts}"
            )

    def each(self, change: Callable[[Tensor], Tensor]) -> Movers:
        """With every entry changed alike: `movers.each(lambda x: x.to(device))`."""
        bend = None if self.bend is None else self.bend.each(change)
        return Movers(
            *(change(x) for x in (self.u_r_m_s, self.u_a_m_s, self.y0_m, self.range_m, self.amplitude)), bend=bend
        )

    def closest_m(self, radar: BistaticRadar) -> Tensor:
        """R0, (..., target)."""
        return radar.reference_range_m + self.range_m

    def place_m(self, time_s: Tensor) -> Tensor:
        """What the place along track has of the receiver's zero, without the part u_a t: y0 and
        what an acceleration adds, (..., 1, pulse, target).
        """
        y0 = self.y0_m[..., None, None, :]
        return y0 if self.bend is None else y0 + self.bend.along_m_s2[..., None, None, :] * time_s[:, None].square() / 2

    def along_m(self, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Way v t - y0 - dx_m of each channel past each target along track, (..., channel, pulse,
        target).
        """
        way = (radar.speed_m_s - self.u_a_m_s[..., None, None, :]) * time_s[:, None]
        return way - self.place_m(time_s) - radar.channels_at(time_s.device)[:, None, None]

    def excess_m(self, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """R_m(t) - R0, exact, (..., channel, pulse, target)."""
        u_r, u_a, closest = (x[..., None, None, :] for x in (self.u_r_m_s, self.u_a_m_s, self.closest_m(radar)))
        channel = radar.channels_at(time_s.device)[:, None, None]
        excess = receive_range(time_s[:, None], u_r, u_a, self.place_m(time_s), closest, radar.speed_m_s, channel)
        if self.bend is None:
            return excess
        range_m, square = closest + excess, self.bend.square_m2(time_s)
        return excess + square / (torch.sqrt(range_m.square() + square) + range_m)


class MovingScene(Protocol):
    """Anything that turns random draws into moving targets before a radar."""

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers: ...


def _numbers(values: Numbers) -> Tensor:
    """float64 of real numbers, complex128 of complex ones."""
    if isinstance(values, (int, float, complex)) or (isinstance(values, Tensor) and not values.ndim):
        raise ValueError(
            f"moving points take lists or tensors with one entry a target, got the number {values}; write [{values}]"
        )
    x = (
        values
        if isinstance(values, Tensor)
        else torch.tensor(
            list(values), dtype=torch.complex128 if any(isinstance(v, complex) for v in values) else torch.float64
        )
    )
    return x.to(torch.complex128 if x.is_complex() else torch.float64)


def _phases(turns: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


@dataclass(frozen=True)
class MovingPoints:
    """Explicit points in uniform motion: one entry a target, lists of numbers or tensors (...,
    target), which may differ between trials and require gradients.

    azimuth_m: place y0 along track at t = 0; range_m: of R0 beyond the reference range; amplitude:
    1 by default, complex where a complex tensor is given; random_phase gives each trial its own
    phases.
    """

    u_r_m_s: Numbers
    u_a_m_s: Numbers
    azimuth_m: Numbers
    range_m: Numbers
    amplitude: Numbers | None = None
    random_phase: bool = False

    def __post_init__(self) -> None:
        given = [(name, getattr(self, name)) for name in ("u_r_m_s", "u_a_m_s", "azimuth_m", "range_m", "amplitude")]
        named = {name: _numbers(values) for name, values in given if values is not None}
        for name, value in named.items():
            refuse_unless_finite(f"{name} of moving points", value.abs())
        counts = {name: value.shape[-1] if value.ndim else 0 for name, value in named.items()}
        if len(set(counts.values())) != 1:
            raise ValueError(
                f"moving points need one speed, place (and amplitude, where given) for each target, got {counts}"
            )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        real = [_numbers(v) for v in (self.u_r_m_s, self.u_a_m_s, self.azimuth_m, self.range_m)]
        level = torch.ones_like(real[0]) if self.amplitude is None else _numbers(self.amplitude)
        if self.random_phase:
            level = level * _phases(draws.uniform("scene.moving.phase", (level.shape[-1],))).to(level.device)
        return Movers(*torch.broadcast_tensors(*real, level.to(torch.complex128)))


@dataclass(frozen=True)
class Ship:
    """A body of `count` scatterers in common motion, spread at random over its length along track
    and dealt in turn to range_cells lines of range.

    Levels are equal and phases random, anew in each trial. level_db: mean power of a sample of one
    of its lines, over that of a point of amplitude 1. azimuth_m, range_m: its middle; cell_m:
    distance of the lines. Speeds and level may be tensors (...,), one number a trial.
    """

    u_r_m_s: Tensor | float
    u_a_m_s: Tensor | float
    azimuth_m: float = 0.0
    range_m: float = 0.0
    length_m: float = 100.0
    range_cells: int = 4
    count: int = 15
    cell_m: float = 6.0
    level_db: Tensor | float = 0.0

    def __post_init__(self) -> None:
        for name in ("u_r_m_s", "u_a_m_s", "azimuth_m", "range_m", "length_m", "cell_m", "level_db"):
            refuse_unless_finite(
                f"{name} of a ship", getattr(self, name), 0.0 if name in ("length_m", "cell_m") else -math.inf
            )
        if not 1 <= self.range_cells <= self.count:
            raise ValueError(
                "a ship needs at least one range cell and a scatterer for each, got "
                f"range_cells={self.range_cells} and count={self.count}"
            )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        y0 = self.azimuth_m + self.length_m * (draws.uniform("scene.ship.azimuth", (self.count,)) - 0.5)
        line = torch.arange(self.count, dtype=torch.float64) % self.range_cells - (self.range_cells - 1) / 2
        level = torch.sqrt(10 ** (per_trial(self.level_db, 1, y0) / 10) * self.range_cells / self.count)
        amplitude = level * _phases(draws.uniform("scene.ship.phase", (self.count,)))
        u_r, u_a = (per_trial(u, 1, y0) for u in (self.u_r_m_s, self.u_a_m_s))
        return Movers(*torch.broadcast_tensors(u_r, u_a, y0, self.range_m + line * self.cell_m, amplitude))


@dataclass(frozen=True)
class GroundMovers:
    """Points that move on the flat ground radar.height_m below the track, followed in three
    dimensions. One entry a target, lists or tensors (..., target).

    outward_m_s: speed across the track, positive away from it; along_m_s: along track, positive
    with the receiver; azimuth_m: place along track; ground_range_m: distance from the ground track;
    outward_m_s2, along_m_s2: constant accelerations. All at t = 0. towards_transmitter: (outward,
    along) parts of the unit vector from the scene to the transmitter; with it, motion changes the
    range to the transmitter too. The square of the range, (g + w t + a t^2 / 2)^2 + h^2 + along^2,
    is that of uniform motion in the slant plane with R0^2 = g^2 + h^2 and u_r = -g w / R0, and a
    `Bend` with b2 = w^2 + g a - u_r^2, b3 = w a, b4 = a^2 / 4: nothing is neglected.
    """

    outward_m_s: Numbers
    along_m_s: Numbers
    azimuth_m: Numbers
    ground_range_m: Numbers
    amplitude: Numbers | None = None
    outward_m_s2: Numbers | None = None
    along_m_s2: Numbers | None = None
    towards_transmitter: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("outward_m_s", "along_m_s", "azimuth_m", "ground_range_m", "outward_m_s2", "along_m_s2"):
            if getattr(self, name) is not None:
                refuse_unless_finite(f"{name} of ground movers", _numbers(getattr(self, name)))
        if not math.hypot(*self.towards_transmitter) <= 1:
            raise ValueError(
                "towards_transmitter holds two parts of a unit vector, got "
                f"{self.towards_transmitter}, which is longer than 1"
            )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        w, along, ground = (_numbers(v) for v in (self.outward_m_s, self.along_m_s, self.ground_range_m))
        a, along_a = (torch.zeros_like(w) if v is None else _numbers(v) for v in (self.outward_m_s2, self.along_m_s2))
        closest = torch.sqrt(ground.square() + radar.height_m**2)
        u_r = -ground * w / closest
        points = MovingPoints(u_r, along, self.azimuth_m, closest - radar.reference_range_m, self.amplitude).movers(
            radar, draws
        )
        out, on = self.towards_transmitter
        bend = Bend(
            out * w + on * along,
            out * a + on * along_a,
            along_a,
            w.square() + ground * a - u_r.square(),
            w * a,
            a.square() / 4,
        )
        return replace(points, bend=bend)


@dataclass(frozen=True)
class Fleet:
    """Several moving scenes at once; each draws its own random numbers, addressed by its name."""

    parts: Mapping[str, MovingScene]

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        parts = [scene.movers(radar, draws.part(name)) for name, scene in self.parts.items()]
        if not parts:
            raise ValueError("a fleet holds no scene; give it at least one, or no scene at all")
        names = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m", "amplitude")
        bends = None if all(p.bend is None for p in parts) else [p.bend or Bend.none(p.u_r_m_s) for p in parts]
        bend = (
            None
            if bends is None
            else Bend(**{f.name: _joined([getattr(b, f.name) for b in bends]) for f in fields(Bend)})
        )
        return Movers(*(_joined([getattr(p, name) for p in parts]) for name in names), bend=bend)


def _joined(parts: list[Tensor]) -> Tensor:
    """Targets of all parts in one dim; what is not random is the same in all trials."""
    trials = torch.broadcast_shapes(*(p.shape[:-1] for p in parts))
    return torch.cat([p.expand(*trials, -1) for p in parts], -1)


class ReceiveRange(Protocol):
    """How finely the range from targets to the receiver is followed."""

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor: ...

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor: ...


@dataclass(frozen=True)
class ExactRange:
    """The square root itself: the default and the yardstick, at the cost of any series."""

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """R_m(t) - radar.reference_range_m, float64 (..., channel, pulse, target)."""
        return movers.range_m[..., None, None, :] + movers.excess_m(time_s, radar)

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Nothing: zeros (...,)."""
        return torch.zeros(movers.range_m.shape[:-1], dtype=torch.float64, device=time_s.device)


@dataclass(frozen=True)
class TaylorRange:
    """The square root in powers of its excess, R0 (x / 2 - x^2 / 8 + ...) with x = R_m^2 / R0^2 -
    1, up to x^(order / 2).

    order 2 is the paper's parabola, Eqs. (3) and (5) with u_r^2 in the last numerator of (3) (brief
    001, erratum 5); order 4 adds x^2, and so on. Of the whole path and not only of the middle of an
    aperture; converges for R_m < 1.4 R0. Raises ValueError for odd orders.
    """

    order: int = 2

    def __post_init__(self) -> None:
        if self.order < 2 or self.order % 2:
            raise ValueError(
                f"order of a range series must be 2, 4, 6, ..., got {self.order}; each power of the excess is worth two"
            )

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """R_m(t) - radar.reference_range_m by the series, float64 (..., channel, pulse, target)."""
        closest = movers.closest_m(radar)[..., None, None, :]
        excess = movers.excess_m(time_s, radar) / closest
        x = excess * (excess + 2)
        total = torch.zeros_like(x)
        for n in range(self.order // 2, 0, -1):
            total = (total + _binomial(n)) * x
        return movers.range_m[..., None, None, :] + closest * total

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Largest phase (rad) that the series is wrong by at these times, over channels and
        targets, (...,).
        """
        missed = ExactRange().range_m(movers, time_s, radar) - self.range_m(movers, time_s, radar)
        return 2 * math.pi / radar.wavelength_m * missed.abs().amax((-3, -2, -1))


def _binomial(n: int) -> float:
    """Coefficient of x^n in sqrt(1 + x)."""
    value = 1.0
    for k in range(n):
        value *= (0.5 - k) / (k + 1)
    return value
