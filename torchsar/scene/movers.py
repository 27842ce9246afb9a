"""Moving targets of a receiver on a straight track."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range
from torchsar.scene.targets import joined, unit_phases
from torchsar.scene.trials import finite_numbers, refuse_unless, refuse_unless_finite, with_dims

Numbers = Sequence[Tensor | float] | Tensor


@dataclass(frozen=True)
class Bend:
    """Deviation of a real motion from uniform motion in the slant plane.

    At the slow time t the range to the transmitter is shorter by s t + a t^2 / 2 than that of a
    point at rest. The squared range to the receiver exceeds that of uniform motion in the slant
    plane by b2 t^2 + b3 t^3 + b4 t^4. All tensors have the shape (..., target) and the dtype
    float64.

    Args:
        transmit_m_s: Closing speed s towards the transmitter in m/s.
        transmit_m_s2: Closing acceleration a towards the transmitter in m/s^2.
        along_m_s2: Along-track acceleration in m/s^2.
        second: Coefficient b2 in m^2/s^2.
        third: Coefficient b3 in m^2/s^3.
        fourth: Coefficient b4 in m^2/s^4.
    """

    transmit_m_s: Tensor
    transmit_m_s2: Tensor
    along_m_s2: Tensor
    second: Tensor
    third: Tensor
    fourth: Tensor

    @staticmethod
    def none(like: Tensor) -> Bend:
        """Return deviations of zero, those of targets in uniform motion.

        Args:
            like: Tensor of shape (..., target), whose shape, dtype and device are taken.

        Returns:
            Deviation of zero for each target.
        """
        return Bend(*(torch.zeros_like(like) for _ in fields(Bend)))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The coefficients in the order of the constructor's parameters."""
        return tuple(vars(self).values())

    def square_m2(self, time_s: Tensor) -> Tensor:
        """Return the term that the deviation adds to the squared range to the receiver.

        Args:
            time_s: Slow time t in seconds, shape (pulse,), float64.

        Returns:
            second t^2 + third t^3 + fourth t^4 in square metres, shape (..., 1, pulse, target).
        """
        t = time_s[:, None]
        second, third, fourth = (b[..., None, None, :] for b in (self.second, self.third, self.fourth))
        return t.square() * (second + t * (third + t * fourth))

    def transmit_m(self, time_s: Tensor) -> Tensor:
        """Return the change of the range to the transmitter due to the motion of the target.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.

        Returns:
            Change in metres, negative for a closing target, shape (..., 1, pulse, target).
        """
        t = time_s[:, None]
        return -t * (self.transmit_m_s[..., None, None, :] + t / 2 * self.transmit_m_s2[..., None, None, :])


@dataclass(frozen=True)
class Movers:
    """Point targets and their motion.

    Positions and speeds are those at slow time zero, the middle pulse. All tensors have the shape
    (..., target), the leading dimensions being trials, and may require gradients.

    Args:
        u_r_m_s: Slant-range speed in m/s, closing positive, float64.
        u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver,
            float64.
        y0_m: Along-track position in metres, float64.
        range_m: Closest range R0 (distance from the track at slow time zero) minus the reference
            range of the radar, in metres, float64.
        amplitude: Amplitude, complex128.
        bend: Deviation from uniform motion in the slant plane, None for none.

    Raises:
        TypeError: If speeds or positions are not float64, or amplitudes not complex.
        ValueError: If the tensors differ in the number of targets.
    """

    u_r_m_s: Tensor
    u_a_m_s: Tensor
    y0_m: Tensor
    range_m: Tensor
    amplitude: Tensor
    bend: Bend | None = None

    def __post_init__(self) -> None:
        dtypes = [x.dtype for x in self.tensors]
        if any(dtype != torch.float64 for dtype in dtypes[:4]) or not dtypes[4].is_complex:
            raise TypeError(f"movers need float64 speeds and positions and complex amplitudes, got {dtypes}")
        counts = [x.shape[-1] if x.ndim else 0 for x in self.tensors]
        if len(set(counts)) != 1:
            raise ValueError(
                "speeds, positions and amplitudes of movers must have the same number of targets (last dim), got "
                f"{counts}"
            )

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """Speeds, position, range and amplitude of the targets."""
        return self.u_r_m_s, self.u_a_m_s, self.y0_m, self.range_m, self.amplitude

    def each(self, change: Callable[[Tensor], Tensor]) -> Movers:
        """Apply a function to every tensor of the targets, such as a move to another device.

        Args:
            change: Function of a tensor of shape (..., target).

        Returns:
            Targets that consist of the changed tensors.
        """
        bend = None if self.bend is None else Bend(*map(change, self.bend.tensors))
        return Movers(*map(change, self.tensors), bend=bend)

    def closest_m(self, radar: BistaticRadar) -> Tensor:
        """Return the closest range R0.

        Args:
            radar: Radar parameters.

        Returns:
            Range in metres, shape (..., target).
        """
        return radar.reference_range_m + self.range_m

    def position_m(self, time_s: Tensor) -> Tensor:
        """Return the along-track position without the displacement by the along-track speed.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.

        Returns:
            Position at slow time zero plus the displacement by an along-track acceleration in
            metres, shape (..., 1, pulse, target).
        """
        y0 = self.y0_m[..., None, None, :]
        return y0 if self.bend is None else y0 + self.bend.along_m_s2[..., None, None, :] * time_s[:, None].square() / 2

    def along_m(self, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the along-track distance of each channel from each target.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            v t - y0 - dx_m in metres, shape (..., channel, pulse, target): v is the along-track
            speed of the receiver relative to the target, y0 the along-track position of the target
            (`position_m`) and dx_m that of channel m.
        """
        travelled = (radar.speed_m_s - self.u_a_m_s[..., None, None, :]) * time_s[:, None]
        return travelled - self.position_m(time_s) - radar.channels_at(time_s.device)[:, None, None]

    def excess_m(self, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return how much the exact range to the receiver exceeds the closest range.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            R_m(t) - R0 in metres for the range R_m of channel m and the closest range R0, shape
            (..., channel, pulse, target).
        """
        u_r, u_a, closest = (x[..., None, None, :] for x in (self.u_r_m_s, self.u_a_m_s, self.closest_m(radar)))
        channel = radar.channels_at(time_s.device)[:, None, None]
        excess = receive_range(time_s[:, None], u_r, u_a, self.position_m(time_s), closest, radar.speed_m_s, channel)
        if self.bend is None:
            return excess
        range_m, square = closest + excess, self.bend.square_m2(time_s)
        return excess + square / (torch.sqrt(range_m.square() + square) + range_m)


class MovingScene(Protocol):
    """Scene that gives moving targets."""

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        """Draw the targets.

        Args:
            radar: Radar parameters.
            draws: Source of random numbers.

        Returns:
            Targets, shape (..., target).
        """
        ...


def _numbers(values: Numbers) -> Tensor:
    """Convert real numbers to a float64 tensor and complex ones to complex128, (..., target)."""
    if isinstance(values, (int, float, complex)) or (isinstance(values, Tensor) and not values.ndim):
        raise ValueError(
            f"moving points take lists or tensors with one entry per target, got the number {values}; write [{values}]"
        )
    if isinstance(values, Tensor):
        return values.to(torch.complex128 if values.is_complex() else torch.float64)
    dtype = torch.complex128 if any(isinstance(v, complex) for v in values) else torch.float64
    if not any(isinstance(v, Tensor) for v in values):
        return torch.tensor(list(values), dtype=dtype)
    entries = [torch.as_tensor(v) for v in values]
    dtype = torch.complex128 if any(v.is_complex() for v in entries) else torch.float64
    return torch.stack(torch.broadcast_tensors(*(v.to(dtype) for v in entries)), -1)


@dataclass(frozen=True)
class MovingPoints(MovingScene):
    """Points with given positions, in uniform motion.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> pair = scene.MovingPoints([5.0, 0.0], [0.0, 0.0], azimuth_m=[0.0, 0.0], range_m=[0.0, 30.0])
    >>> pair.movers(airborne, Draws(seed=1)).closest_m(airborne).tolist()
    [5000.0, 5030.0]

    Each parameter is a list with one entry per target (numbers, or one value per trial) or a tensor
    of shape (..., target), which may require gradients.

    Args:
        u_r_m_s: Slant-range speeds in m/s, closing positive.
        u_a_m_s: Along-track speeds in m/s, positive in the flight direction of the receiver.
        azimuth_m: Along-track positions at slow time zero in metres.
        range_m: Closest ranges (distances from the track at slow time zero) minus the reference
            range of the radar, in metres.
        amplitude: Amplitudes, one by default; they may be complex.
        random_phase: Whether each trial draws phases.

    Raises:
        ValueError: If a number is not finite, or the lists differ in length.
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
                f"moving points need one speed, position (and amplitude, where given) for each target, got {counts}"
            )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        real = [_numbers(v) for v in (self.u_r_m_s, self.u_a_m_s, self.azimuth_m, self.range_m)]
        level = torch.ones_like(real[0]) if self.amplitude is None else _numbers(self.amplitude)
        if self.random_phase:
            level = level * unit_phases(draws.uniform("scene.moving.phase", (level.shape[-1],))).to(level.device)
        return Movers(*torch.broadcast_tensors(*real, level.to(torch.complex128)))


@dataclass(frozen=True)
@finite_numbers("a ship", length_m=0.0, cell_m=0.0)
class Ship(MovingScene):
    """Extended target: scatterers of common motion at random positions along track.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> ship = scene.Ship(u_r_m_s=5.0, u_a_m_s=0.0, range_cells=3, count=6)
    >>> ship.movers(airborne, Draws(seed=1)).range_m.tolist()
    [-6.0, 0.0, 6.0, -6.0, 0.0, 6.0]

    The scatterers are dealt out to several range cells in turn. All scatterers have the same
    amplitude; each trial draws their along-track positions and phases.

    Args:
        u_r_m_s: Slant-range speed in m/s, closing positive.
        u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver.
        azimuth_m: Along-track position of the middle of the ship at slow time zero in metres.
        range_m: Closest range of the middle of the ship minus the reference range of the radar in
            metres.
        length_m: Length along track in metres.
        range_cells: Number of range cells, fixed for all trials.
        count: Number of scatterers, fixed for all trials.
        cell_m: Distance between neighbouring range cells in metres.
        level_db: Mean power of a sample in one range cell of the ship relative to that of a point
            of amplitude 1 in decibels.

    Raises:
        ValueError: If a number is not finite, a length is negative, or there are fewer scatterers
            than range cells.
    """

    u_r_m_s: Tensor | float
    u_a_m_s: Tensor | float
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0
    length_m: Tensor | float = 100.0
    range_cells: int = 4
    count: int = 15
    cell_m: Tensor | float = 6.0
    level_db: Tensor | float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.range_cells <= self.count:
            raise ValueError(
                "a ship needs at least one range cell and a scatterer for each, got "
                f"range_cells={self.range_cells} and count={self.count}"
            )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        share = draws.uniform("scene.ship.azimuth", (self.count,))
        middle, length, range_m, cell = (
            with_dims(v, 1, share) for v in (self.azimuth_m, self.length_m, self.range_m, self.cell_m)
        )
        y0 = middle + length * (share - 0.5)
        line = torch.arange(self.count, dtype=torch.float64) % self.range_cells - (self.range_cells - 1) / 2
        level = torch.sqrt(10 ** (per_trial(self.level_db, 1, y0) / 10) * self.range_cells / self.count)
        amplitude = level * unit_phases(draws.uniform("scene.ship.phase", (self.count,)))
        u_r, u_a = (per_trial(u, 1, y0) for u in (self.u_r_m_s, self.u_a_m_s))
        return Movers(*torch.broadcast_tensors(u_r, u_a, y0, range_m + line * cell, amplitude))


@dataclass(frozen=True)
class GroundMovers(MovingScene):
    """Points that move on flat ground, followed exactly in three dimensions.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> car = scene.GroundMovers([10.0], [0.0], azimuth_m=[0.0], ground_range_m=[4000.0])
    >>> car.movers(airborne, Draws(seed=1)).u_r_m_s.tolist()  # of a receiver 3000 m high
    [-8.0]

    The ground lies the height h = radar.height_m below the track of the receiver. At slow time t, a
    point with the ground range g, the outward speed w and the outward acceleration a (all at t = 0)
    has the squared range (g + w t + a t^2 / 2)^2 + h^2 + y^2 to the receiver, where y is their
    along-track distance.

    For uniform motion in the slant plane, with the closest range R0, R0^2 = g^2 + h^2, and the
    closing speed u_r = -g w / R0, the squared range is (R0 - u_r t)^2 + y^2. The true squared range
    is larger by b2 t^2 + b3 t^3 + b4 t^4 with b2 = w^2 + g a - u_r^2, b3 = w a and b4 = a^2 / 4;
    these terms are added.

    Each parameter is a list with one entry per target (numbers, or one value per trial) or a tensor
    of shape (..., target). All values are those at slow time zero.

    Args:
        outward_m_s: Speeds across the track in m/s, positive away from it.
        along_m_s: Speeds along track in m/s, positive in the flight direction of the receiver.
        azimuth_m: Along-track positions in metres.
        ground_range_m: Distances from the ground track of the receiver in metres.
        amplitude: Amplitudes, one by default; they may be complex.
        outward_m_s2: Constant accelerations across the track in m/s^2, zero by default.
        along_m_s2: Constant accelerations along track in m/s^2, zero by default.
        towards_transmitter: Outward and along-track component of the unit vector from the scene to
            the transmitter; by default both are zero, and the motion does not change the range to
            the transmitter.

    Raises:
        ValueError: If a number is not finite, the lists differ in length, or the vector of the two
            components is longer than 1.
    """

    outward_m_s: Numbers
    along_m_s: Numbers
    azimuth_m: Numbers
    ground_range_m: Numbers
    amplitude: Numbers | None = None
    outward_m_s2: Numbers | None = None
    along_m_s2: Numbers | None = None
    towards_transmitter: tuple[Tensor | float, Tensor | float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("outward_m_s", "along_m_s", "azimuth_m", "ground_range_m", "outward_m_s2", "along_m_s2"):
            if getattr(self, name) is not None:
                refuse_unless_finite(f"{name} of ground movers", _numbers(getattr(self, name)))
        out, along = (torch.as_tensor(v, dtype=torch.float64) for v in self.towards_transmitter)
        refuse_unless(
            "towards_transmitter must be two components of a unit vector, of a length of at most 1",
            torch.hypot(*torch.broadcast_tensors(out, along)),
            lambda length: length <= 1,
            "divide by the length of the three-dimensional vector",
        )

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        w, along, ground = (_numbers(v) for v in (self.outward_m_s, self.along_m_s, self.ground_range_m))
        a, along_a = (torch.zeros_like(w) if v is None else _numbers(v) for v in (self.outward_m_s2, self.along_m_s2))
        closest = torch.sqrt(ground.square() + radar.height_m**2)
        u_r = -ground * w / closest
        points = MovingPoints(u_r, along, self.azimuth_m, closest - radar.reference_range_m, self.amplitude)
        out, on = (with_dims(v, 1, w) for v in self.towards_transmitter)
        to_transmitter = (out * w + on * along, out * a + on * along_a)
        to_receiver = (w.square() + ground * a - u_r.square(), w * a, a.square() / 4)
        return replace(points.movers(radar, draws), bend=Bend(*to_transmitter, along_a, *to_receiver))


@dataclass(frozen=True)
class Fleet(MovingScene):
    """Several moving scenes in one.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> ship, boat = scene.Ship(5.0, 0.0, count=15), scene.MovingPoints([3.0], [0.0], [50.0], [0.0])
    >>> scene.Fleet({"ship": ship, "boat": boat}).movers(airborne, Draws(seed=1)).u_r_m_s.shape
    torch.Size([16])

    Args:
        parts: Scenes by name; the random numbers of each scene depend on its name.

    Raises:
        ValueError: When movers are made, if there is no scene.
    """

    parts: Mapping[str, MovingScene]

    def movers(self, radar: BistaticRadar, draws: Draws) -> Movers:
        parts = [scene.movers(radar, draws.part(name)) for name, scene in self.parts.items()]
        if not parts:
            raise ValueError("a fleet needs at least one scene; add a scene to `parts`, or leave the fleet out")
        bend = None
        if any(part.bend is not None for part in parts):
            bends = [part.bend or Bend.none(part.u_r_m_s) for part in parts]
            bend = Bend(*map(joined, zip(*(one.tensors for one in bends), strict=True)))
        return Movers(*map(joined, zip(*(part.tensors for part in parts), strict=True)), bend=bend)
