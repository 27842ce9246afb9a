"""True flights of antennas, their deviations from the nominal path, and what navigation records.

A flight is a nominal path plus motions in three axes; each motion is one of those that targets have
(`Sinusoid`, `Polynomial`, `VibrationSpectrum`, `MeasuredTrack`), or one of this module. Navigation
records the flight with errors of its own, which are what autofocus has to find.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, UniformSpline, per_trial
from torchsar.scene.fluctuation import MeasuredTrack, RandomMotion, drawn_motion
from torchsar.scene.trials import refuse_other_trials, refuse_unless_finite
from torchsar.scene.vibration import Motion, displacement_m


class NominalPath(Protocol):
    """Position of an antenna as a function of time, without motion errors."""

    def position_m(self, time_s: Tensor) -> Tensor:
        """Return the position.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Position in metres, shape (pulse, 3), float64.
        """
        ...


@dataclass(frozen=True)
class StraightPath:
    """Straight path of constant speed; a speed of zero is a fixed antenna.

    Args:
        start_m: Position at the first pulse in metres (x, y, z).
        velocity_m_s: Velocity in m/s (x, y, z).

    Raises:
        ValueError: If there are not three numbers, or one is not finite.
    """

    start_m: Sequence[float]
    velocity_m_s: Sequence[float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _refuse_unless_three("start_m of a straight path", self.start_m)
        _refuse_unless_three("velocity_m_s of a straight path", self.velocity_m_s)

    def position_m(self, time_s: Tensor) -> Tensor:
        """Return the position.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Position in metres, shape (pulse, 3), float64.
        """
        start, velocity = (time_s.new_tensor(list(v)) for v in (self.start_m, self.velocity_m_s))
        return start + time_s[:, None] * velocity


@dataclass(frozen=True)
class CircularPath:
    """Horizontal circle about the vertical axis through the origin, at constant speed.

    The azimuth is counted from axis x towards y.

    Args:
        radius_m: Radius in metres.
        height_m: Height z in metres.
        start_rad: Azimuth at the first pulse in rad.
        rate_rad_s: Change of the azimuth in rad/s.

    Raises:
        ValueError: If a number is not finite or the radius is negative.
    """

    radius_m: float
    height_m: float
    start_rad: float
    rate_rad_s: float

    def __post_init__(self) -> None:
        refuse_unless_finite("radius_m of a circular path", self.radius_m, 0.0)
        refuse_unless_finite("the numbers of a circular path", (self.height_m, self.start_rad, self.rate_rad_s))

    def position_m(self, time_s: Tensor) -> Tensor:
        """Return the position.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Position in metres, shape (pulse, 3), float64.
        """
        angle = self.start_rad + self.rate_rad_s * time_s
        x, y = self.radius_m * torch.cos(angle), self.radius_m * torch.sin(angle)
        return torch.stack([x, y, torch.full_like(x, self.height_m)], -1)


@dataclass(frozen=True)
class Offset:
    """Constant displacement.

    Args:
        metres: Displacement in metres.

    Raises:
        ValueError: If it is not finite.
    """

    metres: Tensor | float

    def __post_init__(self) -> None:
        refuse_unless_finite("metres of an offset", self.metres)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Return the displacement.

        Args:
            time_s: Times in seconds, any shape, float64.

        Returns:
            Displacement in metres, shape (*trials, *times).
        """
        return per_trial(self.metres, time_s.ndim, time_s) + torch.zeros_like(time_s)


@dataclass(frozen=True)
class Jitter:
    """Independent normally distributed displacements at equal steps, with a spline between them.

    With the pulse interval as step, every pulse has its own displacement.

    Args:
        rms_m: Root mean square of the displacement at the steps in metres.
        step_s: Time between independent displacements in seconds.

    Raises:
        ValueError: If the rms value is negative or not finite, or the step is not positive.
    """

    rms_m: Tensor | float
    step_s: float

    def __post_init__(self) -> None:
        refuse_unless_finite("rms_m of jitter", self.rms_m, 0.0)
        _refuse_unless_positive("step_s of jitter", self.step_s)

    def drawn(self, draws: Draws, span_s: float) -> MeasuredTrack:
        """Draw the displacements.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            The displacement in each trial.
        """
        time_s = _steps(span_s, self.step_s)
        unit = draws.normal("scene.flight.jitter", (len(time_s),))
        return MeasuredTrack(time_s, per_trial(self.rms_m, 1, unit) * unit)


@dataclass(frozen=True)
class RandomWalk:
    """Sum of independent normally distributed steps, zero at the first pulse.

    Its standard deviation after the time t is `m_per_root_s` sqrt(t). About the mean of a recording
    of length T, its rms value is `m_per_root_s` sqrt(T / 6).

    Args:
        m_per_root_s: Standard deviation after one second in metres.
        step_s: Time of a step in seconds.

    Raises:
        ValueError: If the standard deviation is negative or not finite, or the step is not
            positive.
    """

    m_per_root_s: Tensor | float
    step_s: float

    def __post_init__(self) -> None:
        refuse_unless_finite("m_per_root_s of a random walk", self.m_per_root_s, 0.0)
        _refuse_unless_positive("step_s of a random walk", self.step_s)

    def drawn(self, draws: Draws, span_s: float) -> MeasuredTrack:
        """Draw the steps.

        Args:
            draws: Source of random numbers.
            span_s: Length of the recording in seconds.

        Returns:
            The displacement in each trial.
        """
        time_s = _steps(span_s, self.step_s)
        unit = draws.normal("scene.flight.walk", (len(time_s) - 1,)).cumsum(-1) * math.sqrt(self.step_s)
        unit = torch.nn.functional.pad(unit, (1, 0))
        return MeasuredTrack(time_s, per_trial(self.m_per_root_s, 1, unit) * unit)


@dataclass(frozen=True)
class Sway:
    """Displacements in three axes, each a sum of motions.

    Args:
        x: Motions along axis x; an empty sequence for none.
        y: Motions along axis y.
        z: Motions along axis z.
    """

    x: Sequence[Motion | RandomMotion] = ()
    y: Sequence[Motion | RandomMotion] = ()
    z: Sequence[Motion | RandomMotion] = ()

    def displacement_m(self, draws: Draws, time_s: Tensor) -> Tensor:
        """Draw the displacement.

        Args:
            draws: Source of random numbers; each axis has its own.
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Displacement in metres, shape (*trials, pulse, 3), float64.

        Raises:
            ValueError: If a motion has another number of trials than the draws.
        """
        refuse_other_trials(self, draws)
        span_s = float(time_s[-1] - time_s[0])
        axes = [
            displacement_m(drawn_motion(motion, draws.part(axis), span_s), time_s)
            for axis, motion in (("x", self.x), ("y", self.y), ("z", self.z))
        ]
        return torch.stack(torch.broadcast_tensors(*axes), -1)


@dataclass(frozen=True)
class Flight:
    """True path of an antenna: a nominal path and what it deviates by.

    Args:
        nominal: Nominal path.
        motion: Deviation from it.
    """

    nominal: NominalPath
    motion: Sway = field(default_factory=Sway)

    def position_m(self, draws: Draws, time_s: Tensor) -> Tensor:
        """Draw the true positions.

        Args:
            draws: Source of random numbers.
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Positions in metres, shape (*trials, pulse, 3), float64.

        Raises:
            ValueError: If a motion has another number of trials than the draws.
        """
        return self.nominal.position_m(time_s) + self.motion.displacement_m(draws.part("motion"), time_s)


@dataclass(frozen=True)
class Navigation:
    """What navigation records of a flight: late positions with errors, in whole steps.

    Args:
        error: Errors that are added, such as `Offset` (bias), `Polynomial` (drift), `RandomWalk`.
        latency_s: Age of a recorded position in seconds: at the time t the position at t - latency
            is recorded.
        step_m: Step in metres to which positions are rounded; 0 for none.

    Raises:
        ValueError: If a number is not finite or the step is negative.
    """

    error: Sway = field(default_factory=Sway)
    latency_s: Tensor | float = 0.0
    step_m: Tensor | float = 0.0

    def __post_init__(self) -> None:
        refuse_unless_finite("latency_s of a navigation", self.latency_s)
        refuse_unless_finite("step_m of a navigation", self.step_m, 0.0)

    def recorded_m(self, draws: Draws, time_s: Tensor, position_m: Tensor) -> Tensor:
        """Record positions.

        Between pulses, and before the first, the true path is continued by a cubic spline.

        Args:
            draws: Source of random numbers.
            time_s: Times of the pulses in seconds, equally spaced, shape (pulse,), float64.
            position_m: True positions in metres, shape (..., pulse, 3), float64.

        Returns:
            Recorded positions in metres, shape (*trials, pulse, 3), float64.

        Raises:
            ValueError: If a number has another number of trials than the draws.
        """
        refuse_other_trials(self, draws)
        if bool((torch.as_tensor(self.latency_s) != 0).any()):
            position_m = _at(time_s, position_m, time_s - per_trial(self.latency_s, 1, time_s))
        recorded = position_m + self.error.displacement_m(draws.part("navigation"), time_s)
        quantum = per_trial(self.step_m, 2, time_s)
        whole = torch.round(recorded / torch.where(quantum > 0, quantum, 1)) * quantum
        return torch.where(quantum > 0, whole, recorded)


def _at(time_s: Tensor, position_m: Tensor, asked_s: Tensor) -> Tensor:
    """Positions (..., pulse, 3) at equally spaced times, interpolated at times (..., pulse)."""
    step_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    pieces = UniformSpline(position_m.mT.contiguous(), float(time_s[0]), step_s).pieces()  # (..., 3, piece, power)
    asked = (asked_s - time_s[0])[..., None, :]
    asked = asked.expand(*torch.broadcast_shapes(pieces.shape[:-2], asked.shape[:-1]), -1)
    piece = (asked / step_s).floor().clamp(0, len(time_s) - 2)
    at = piece.long()[..., None].expand(*piece.shape, 4)
    powers = pieces.expand(*asked.shape[:-1], *pieces.shape[-2:]).gather(-2, at)
    since = asked - piece * step_s
    return (((powers[..., 3] * since + powers[..., 2]) * since + powers[..., 1]) * since + powers[..., 0]).mT


def _steps(span_s: float, step_s: float) -> Tensor:
    """Times that cover a recording in equal steps, at least two of them."""
    return step_s * torch.arange(max(2, math.ceil(span_s / step_s - 1e-9) + 1), dtype=torch.float64)


def _refuse_unless_three(what: str, value: Sequence[float]) -> None:
    """Raise ValueError unless there are three finite numbers."""
    if len(value) != 3 or not all(math.isfinite(v) for v in value):
        raise ValueError(f"{what} must be three finite numbers x, y, z, got {list(value)}")


def _refuse_unless_positive(what: str, value: float) -> None:
    """Raise ValueError unless a number is positive and finite."""
    if not 0 < value < math.inf:
        raise ValueError(f"{what} must be a positive number, got {value}")
