"""True flights of antennas, their deviations from the nominal path, and what navigation records.

A flight is a nominal path plus motions in three axes. Each motion is one of those that targets have
or one of this module: `Polynomial`, `Sinusoid`, `VibrationSpectrum` (band-limited sway, or
vibration), `Jitter`, `RandomWalk`, `Offset`, `MeasuredTrack`. Navigation records the flight with
errors of its own, which are what autofocus has to find: a bias is an `Offset`, a drift a
`Polynomial`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, Spline, per_trial
from torchsar.radar.navigation import resample_path
from torchsar.radar.track import Track
from torchsar.scene.motion import MeasuredTrack, Motion, RandomMotion, displacement_m, drawn_motion
from torchsar.scene.trials import finite_numbers, refuse_other_trials, refuse_unless

# largest latency and largest interval of navigation records in seconds, by choice
_LONGEST_S = 0.5


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
@finite_numbers("a straight path")
class StraightPath(NominalPath):
    """Straight path of constant speed; a speed of zero is a fixed antenna.

    >>> import torch
    >>> from torchsar import scene
    >>> path = scene.StraightPath(start_m=(-1000.0, -50.0, 500.0), velocity_m_s=(0.0, 50.0, 0.0))
    >>> path.position_m(torch.tensor([0.0, 1.0], dtype=torch.float64)).tolist()
    [[-1000.0, -50.0, 500.0], [-1000.0, 0.0, 500.0]]

    Args:
        start_m: Position at the first pulse in metres (x, y, z).
        velocity_m_s: Velocity in m/s (x, y, z).

    Raises:
        ValueError: If there are not three numbers, or one is not finite.
    """

    start_m: Sequence[float]
    velocity_m_s: Sequence[float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not len(self.start_m) == len(self.velocity_m_s) == 3:
            raise ValueError(
                f"start_m and velocity_m_s of a straight path must be three numbers x, y, z, got {list(self.start_m)} "
                f"and {list(self.velocity_m_s)}"
            )

    def position_m(self, time_s: Tensor) -> Tensor:
        start, velocity = (time_s.new_tensor(list(v)) for v in (self.start_m, self.velocity_m_s))
        return start + time_s[:, None] * velocity


@dataclass(frozen=True)
@finite_numbers("a circular path", radius_m=0.0)
class CircularPath(NominalPath):
    """Horizontal circle about the vertical axis through the origin, at constant speed.

    >>> import torch
    >>> from torchsar import scene
    >>> circle = scene.CircularPath(1000.0, height_m=500.0, start_rad=0.0, rate_rad_s=0.1)
    >>> circle.position_m(torch.tensor([0.0, 10.0], dtype=torch.float64)).round().tolist()
    [[1000.0, 0.0, 500.0], [540.0, 841.0, 500.0]]

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

    def position_m(self, time_s: Tensor) -> Tensor:
        angle = self.start_rad + self.rate_rad_s * time_s
        x, y = self.radius_m * torch.cos(angle), self.radius_m * torch.sin(angle)
        return torch.stack([x, y, torch.full_like(x, self.height_m)], -1)


@dataclass(frozen=True, eq=False)
class RecordedPath(NominalPath):
    """Path of a motion log, between whose records cubic splines interpolate.

    >>> import torch
    >>> from torchsar import radar, scene
    >>> time_s = torch.arange(10.0, 16.0).double()
    >>> position_m = torch.stack([0 * time_s - 900.0, 50 * time_s, 0 * time_s + 500.0], -1)
    >>> path = scene.RecordedPath(radar.Track(time_s, position_m))
    >>> path.position_m(torch.tensor([0.0, 0.5], dtype=torch.float64)).tolist()
    [[-900.0, 500.0, 500.0], [-900.0, 525.0, 500.0]]

    Args:
        track: Recorded positions, as `radar.read_track` returns them.
        start_s: Time of the first pulse on the clock of the log in seconds; None for that of the
            first record.

    Raises:
        TypeError: If there is no track.
        ValueError: From `position_m`, if pulses lie beyond the log, or it has gaps or jumps, see
            `resample_path`.
    """

    track: Any  # a Track, the same for all trials
    start_s: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.track, Track):
            raise TypeError(f"a RecordedPath needs a Track, as radar.read_track returns it, got {self.track!r:.80}")

    def position_m(self, time_s: Tensor) -> Tensor:
        clock, place = (x.to(time_s.device) for x in (self.track.time_s, self.track.position_m))
        return resample_path(clock, place, time_s + (float(clock[0]) if self.start_s is None else self.start_s))


@dataclass(frozen=True)
@finite_numbers("an offset")
class Offset(Motion):
    """Constant displacement.

    >>> import torch
    >>> from torchsar import scene
    >>> scene.Offset(0.5).displacement_m(torch.tensor([0.0, 1.0])).tolist()
    [0.5, 0.5]

    Args:
        metres: Displacement in metres.

    Raises:
        ValueError: If it is not finite.
    """

    metres: Tensor | float

    def displacement_m(self, time_s: Tensor) -> Tensor:
        return per_trial(self.metres, time_s.ndim, time_s) + torch.zeros_like(time_s)


@dataclass(frozen=True)
@finite_numbers("jitter", rms_m=0.0, step_s="positive")
class Jitter(RandomMotion):
    """Independent normally distributed displacements at equal steps, with a spline between them.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> drawn = scene.Jitter(rms_m=0.02, step_s=0.01).drawn(Draws(seed=1), span_s=10.0)
    >>> round(float(drawn.displacement_m(torch.arange(0, 10, 0.01, dtype=torch.float64)).std()), 2)
    0.02

    With the pulse interval as step, every pulse has its own displacement.

    Args:
        rms_m: Root mean square of the displacement at the steps in metres.
        step_s: Time between independent displacements in seconds.

    Raises:
        ValueError: If the rms value is negative or not finite, or the step is not positive.
    """

    rms_m: Tensor | float
    step_s: float

    def drawn(self, draws: Draws, span_s: float) -> MeasuredTrack:
        time_s = _steps(span_s, self.step_s)
        unit = draws.normal("scene.flight.jitter", (len(time_s),))
        return MeasuredTrack(time_s, per_trial(self.rms_m, 1, unit) * unit)


@dataclass(frozen=True)
@finite_numbers("a random walk", m_per_root_s=0.0, step_s="positive")
class RandomWalk(RandomMotion):
    """Sum of independent normally distributed steps, zero at the first pulse.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> drawn = scene.RandomWalk(0.1, step_s=0.1).drawn(Draws(1, trials=range(400)), span_s=4.0)
    >>> drawn.displacement_m(torch.tensor([0.0, 4.0])).std(0).round(decimals=1).tolist()
    [0.0, 0.2]

    Its standard deviation at the time t is `m_per_root_s` sqrt(t). About the mean of a recording of
    length T, its rms value is `m_per_root_s` sqrt(T / 6).

    Args:
        m_per_root_s: Standard deviation after one second in metres.
        step_s: Time of a step in seconds.

    Raises:
        ValueError: If the standard deviation is negative or not finite, or the step is not
            positive.
    """

    m_per_root_s: Tensor | float
    step_s: float

    def drawn(self, draws: Draws, span_s: float) -> MeasuredTrack:
        time_s = _steps(span_s, self.step_s)
        unit = draws.normal("scene.flight.walk", (len(time_s),)).cumsum(-1) * math.sqrt(self.step_s)
        unit = unit - unit[..., int(time_s.abs().argmin()), None]
        return MeasuredTrack(time_s, per_trial(self.m_per_root_s, 1, unit) * unit)


@dataclass(frozen=True)
class Sway:
    """Displacements in three axes, each a sum of motions.

    >>> import torch
    >>> from torchsar import scene
    >>> sway = scene.Sway(y=[scene.Polynomial([0.1])], z=[scene.Offset(0.5)])
    >>> sway.displacement_m(torch.tensor([0.0, 10.0], dtype=torch.float64)).tolist()
    [[0.0, 0.0, 0.5], [0.0, 1.0, 0.5]]

    Args:
        x: Motions along axis x; an empty sequence for none.
        y: Motions along axis y.
        z: Motions along axis z.
    """

    x: Sequence[Motion | RandomMotion] = ()
    y: Sequence[Motion | RandomMotion] = ()
    z: Sequence[Motion | RandomMotion] = ()

    def drawn(self, draws: Draws, span_s: float) -> Sway:
        """Draw the random motions.

        Args:
            draws: Source of random numbers; each axis has its own.
            span_s: Time from the first to the last pulse in seconds.

        Returns:
            The displacement in each trial, known from one second before the first pulse to one
            second after the last.

        Raises:
            ValueError: If the time is not positive and finite, or a motion has another number of
                trials than the draws.
        """
        refuse_other_trials(self, draws)
        if not 0 < span_s < math.inf:
            raise ValueError(f"a flight needs pulses at two times or more, got a span of {span_s:g} s")
        return Sway(*(drawn_motion(getattr(self, axis), draws.part(axis), span_s) for axis in "xyz"))

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Return the displacement; random motions must have been drawn.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Displacement in metres, shape (*trials, pulse, 3), float64.

        Raises:
            ValueError: If a random motion has not been drawn.
        """
        for part in (*self.x, *self.y, *self.z):
            if isinstance(part, RandomMotion):
                raise ValueError(f"a {type(part).__name__} is random; call drawn(draws, span_s) first")
        axes = [displacement_m(motion, time_s) for motion in (self.x, self.y, self.z)]  # type: ignore[arg-type]
        return torch.stack(torch.broadcast_tensors(*axes), -1)


@dataclass(frozen=True)
class Flight:
    """True path of an antenna: a nominal path and what it deviates by.

    >>> import torch
    >>> from torchsar import scene
    >>> path = scene.StraightPath(start_m=(-1000.0, -50.0, 500.0), velocity_m_s=(0.0, 50.0, 0.0))
    >>> flight = scene.Flight(path, scene.Sway(z=[scene.Polynomial([0.5])]))  # it climbs
    >>> flight.position_m(torch.tensor([0.0, 1.0], dtype=torch.float64)).tolist()
    [[-1000.0, -50.0, 500.0], [-1000.0, 0.0, 500.5]]

    Args:
        nominal: Nominal path, an object with the method `position_m` of `NominalPath`.
        motion: Deviation from it.

    Raises:
        TypeError: If they are objects of another kind.
    """

    nominal: NominalPath
    motion: Sway = field(default_factory=Sway)

    def drawn(self, draws: Draws, span_s: float) -> Flight:
        """Draw the random motions.

        Args:
            draws: Source of random numbers.
            span_s: Time from the first to the last pulse in seconds.

        Returns:
            The path in each trial.
        """
        return replace(self, motion=self.motion.drawn(draws.part("motion"), span_s))

    def position_m(self, time_s: Tensor) -> Tensor:
        """Return the true positions; random motions must have been drawn.

        Args:
            time_s: Times since the first pulse in seconds, shape (pulse,), float64.

        Returns:
            Positions in metres, shape (*trials, pulse, 3), float64.

        Raises:
            ValueError: If a random motion has not been drawn.
        """
        return self.nominal.position_m(time_s) + self.motion.displacement_m(time_s)


@dataclass(frozen=True)
@finite_numbers("a navigation", latency_s=None, step_m=0.0, rate_hz=1 / _LONGEST_S)
class Navigation:
    """What navigation records of a flight: late positions with errors, in whole steps.

    >>> import torch
    >>> from torchsar import Draws, scene
    >>> path = scene.StraightPath(start_m=(-1000.0, -50.0, 500.0), velocity_m_s=(0.0, 50.0, 0.0))
    >>> late = scene.Navigation(scene.Sway(z=[scene.Offset(0.5)]), latency_s=0.25)
    >>> late.recorded_m(Draws(seed=1), torch.tensor([0.0, 1.0], dtype=torch.float64), path).tolist()
    [[-1000.0, -62.5, 500.5], [-1000.0, -12.5, 500.5]]

    Args:
        error: Errors that are added, such as `Offset` (bias), `Polynomial` (drift), `RandomWalk`.
        latency_s: Age of a recorded position in seconds: at the time t the position at t - latency
            is recorded; at most 0.5 s in magnitude.
        step_m: Step in metres to which positions are rounded; 0 for none.
        rate_hz: Rate of the records in hertz, at least 2 Hz, from which positions at the pulses are
            interpolated by splines; None for a record at every pulse.

    Raises:
        ValueError: If a number is not finite, the latency is too long, the step is negative, or
            the rate is too low.
    """

    error: Sway = field(default_factory=Sway)
    latency_s: Tensor | float = 0.0
    step_m: Tensor | float = 0.0
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        refuse_unless(
            f"latency_s of a navigation must be a number of at most {_LONGEST_S:g} s in magnitude, or one per trial",
            self.latency_s,
            lambda x: abs(x) <= _LONGEST_S,
        )

    def recorded_m(self, draws: Draws, time_s: Tensor, path: NominalPath) -> Tensor:
        """Return the positions that are known at the pulses.

        Args:
            draws: Source of random numbers.
            time_s: Times of the pulses since the first one in seconds, rising, shape (pulse,),
                float64.
            path: True path, such as a `Flight` that has been drawn.

        Returns:
            Recorded positions in metres, interpolated at the pulses, shape (*trials, pulse, 3),
            float64.

        Raises:
            ValueError: If there are fewer than five records, or a number has another number of
                trials than the draws.
        """
        refuse_other_trials(self, draws)
        span_s = float(time_s[-1] - time_s[0])
        error = self.error.drawn(draws.part("navigation"), span_s)
        if self.rate_hz is None:
            return self._records_m(error, time_s, path)
        n = math.ceil(span_s * self.rate_hz - 1e-9) + 1
        if n < 5:
            raise ValueError(
                f"navigation needs at least 5 records, got {n} at rate_hz={self.rate_hz:g} in {span_s:g} s"
            )
        at = time_s[0] + torch.arange(n, dtype=torch.float64, device=time_s.device) / self.rate_hz
        return resample_path(at, self._records_m(error, at, path), time_s, jump_m=math.inf)

    def _records_m(self, error: Sway, time_s: Tensor, path: NominalPath) -> Tensor:
        """Navigation records at times (record,): positions (*trials, record, 3)."""
        recorded = self._late_m(time_s, path) + error.displacement_m(time_s)
        quantum = per_trial(self.step_m, 2, time_s)
        whole = torch.round(recorded / torch.where(quantum > 0, quantum, 1)) * quantum
        return torch.where(quantum > 0, whole, recorded)

    def _late_m(self, time_s: Tensor, path: NominalPath) -> Tensor:
        """True positions at the given times minus the latency, (*trials, record, 3)."""
        latency = torch.as_tensor(self.latency_s, dtype=torch.float64, device=time_s.device)
        if not latency.ndim:
            return path.position_m(time_s - latency)
        # Motions are evaluated at times that are the same for all trials, and interpolated at the
        # delayed times. The interval is that of jitter from pulse to pulse. A trial therefore does
        # not depend on the latencies of other trials.
        step_s = float(time_s.diff().min())
        before, after = (math.ceil(s / step_s) for s in (_LONGEST_S, float(time_s[-1] - time_s[0]) + _LONGEST_S))
        at = time_s[0] + step_s * torch.arange(-before, after + 1, dtype=torch.float64, device=time_s.device)
        asked = time_s - latency[..., None]
        return Spline(path.position_m(at).mT, at).at(asked[..., None, :]).mT


def _steps(span_s: float, step_s: float) -> Tensor:
    """Times in equal steps from one second before the first pulse to one second after the last.

    Zero is one of the times. The interval contains all records, including those with latency and
    those between pulses.
    """
    before, after = (math.ceil(time_s / step_s - 1e-9) for time_s in (1.0, span_s + 1.0))
    return step_s * torch.arange(-before, after + 1, dtype=torch.float64)
