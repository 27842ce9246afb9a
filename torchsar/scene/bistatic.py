"""Targets, clutter and noise of a scene that a distant satellite illuminates and an airborne
receiver records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from inspect import signature
from typing import Protocol

import torch
from torch import Tensor

from torchsar.radar import BistaticRadar, Orbit
from torchsar.radar.bistatic import polynomial_range
from torchsar.radar.orbit import orbit_range
from torchsar.scene.movers import Movers, MovingScene
from torchsar.scene.sea import Sea
from torchsar.scene.trials import finite_numbers, stacked, with_dims


class Gate(Protocol):
    """Receive gain of targets as a function of time or direction."""

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the amplitude gain.

        Args:
            movers: Targets.
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            Gain of shape (..., 1 or channel, pulse, target), float64.
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a band-limited gate", duration_s="positive")
class BandLimited(Gate):
    """Gate that passes each target for a limited time, equal in all channels.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> target = scene.MovingPoints([0.0], [0.0], [0.0], [0.0]).movers(airborne, Draws(seed=1))
    >>> time_s = airborne.pulse_axis(100).values()
    >>> int(scene.BandLimited(duration_s=0.25).weight(target, time_s, airborne).sum())  # pulses
    25

    The interval is centred on the time y0 / v of the closest approach along track, so that the
    Doppler band of the target is limited. y0 is the along-track position of the target at slow time
    zero and v the along-track speed of the receiver relative to the target.

    Args:
        duration_s: Length of the interval in seconds. It must be equal in all trials if the world
            has a sea.

    Raises:
        ValueError: If the duration is not positive.
    """

    duration_s: Tensor | float

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        abreast = movers.y0_m.detach() / (radar.speed_m_s - movers.u_a_m_s.detach())
        duration = with_dims(self.duration_s, 3, time_s)
        return ((time_s[:, None] - abreast[..., None, None, :]).abs() < duration / 2).to(torch.float64)


@dataclass(frozen=True)
@finite_numbers("a pattern", element_m="positive")
class Pattern(Gate):
    """One-way pattern of a uniformly illuminated antenna element over the whole record.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> pair = scene.MovingPoints([0.0, 0.0], [0.0, 0.0], azimuth_m=[0.0, 50.0], range_m=[0.0, 0.0])
    >>> time_s, movers = airborne.pulse_axis(1).values(), pair.movers(airborne, Draws(seed=1))
    >>> scene.Pattern().weight(movers, time_s, airborne)[1, 0].round(decimals=2).tolist()
    [1.0, 0.89]

    The amplitude gain is sin(pi q) / (pi q) with q = element_m sin(look) / wavelength and
    sin(look) = (v t - y0 - dx_m) / R_m. Here t is the slow time, v the along-track speed of the
    receiver relative to the target, y0 the along-track position of the target at t = 0, dx_m the
    along-track position of channel m and R_m its range to the target.

    Args:
        element_m: Length of the element in metres, None for that of the radar. It must be equal in
            all trials if the world has a sea.

    Raises:
        ValueError: If the length is not positive.
    """

    element_m: Tensor | float | None = None

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        closest = movers.closest_m(radar)[..., None, None, :]
        sine = movers.along_m(time_s, radar) / (closest + movers.excess_m(time_s, radar))
        element = radar.element_m if self.element_m is None else with_dims(self.element_m, 3, time_s)
        return torch.sinc(element / radar.wavelength_m * sine)


class ReceiveRange(Protocol):
    """Model of the range from targets to the receiver."""

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the range relative to the reference range.

        Args:
            movers: Targets.
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            Range in metres, shape (..., channel, pulse, target), float64.
        """
        ...

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the largest phase that the model neglects.

        Args:
            movers: Targets.
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            Phase in radians, shape (...,).
        """
        ...


@dataclass(frozen=True)
class ExactRange(ReceiveRange):
    """Exact range by the square root: the default, as fast as any series.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> target = scene.MovingPoints([10.0], [0.0], [0.0], [0.0]).movers(airborne, Draws(seed=1))
    >>> time_s = airborne.pulse_axis(200).values()[::50]  # -1 s to 0.5 s
    >>> scene.ExactRange().range_m(target, time_s, airborne)[1, :, 0].round(decimals=1).tolist()
    [11.0, 5.2, 0.0, -4.7]
    """

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        return movers.range_m[..., None, None, :] + movers.excess_m(time_s, radar)

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        return torch.zeros(movers.range_m.shape[:-1], dtype=torch.float64, device=time_s.device)


@dataclass(frozen=True)
class TaylorRange(ReceiveRange):
    """Power series of the range to the receiver about the closest range.

    >>> from torchsar import Draws, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> target = scene.MovingPoints([0.0], [0.0], [0.0], [0.0]).movers(airborne, Draws(seed=1))
    >>> time_s, orders = airborne.pulse_axis(600).values(), map(scene.TaylorRange, (2, 4))
    >>> [round(float(m.neglected_phase_rad(target, time_s, airborne)), 1) for m in orders]
    [1.7, 0.0]

    For the range R_m to channel m and the closest range R0 the series is
    R_m - R0 = R0 (x / 2 - x^2 / 8 + ...) with x = R_m^2 / R0^2 - 1. The same series holds for the
    whole range history, and it converges for R_m < 1.4 R0. Order 2 is the parabola of the
    publication, with u_r^2 instead of the misprinted u_a^2 in the last numerator of Eq. (3).

    Args:
        order: Twice the highest power of x that is kept: 2, 4, 6, ...

    Raises:
        ValueError: If the order is odd or below 2.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (3), (5).
    """

    order: int = 2

    def __post_init__(self) -> None:
        if self.order < 2 or self.order % 2:
            raise ValueError(
                f"order of a range series must be 2, 4, 6, ..., got {self.order}; give twice the number of terms"
            )

    def range_m(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        closest = movers.closest_m(radar)[..., None, None, :]
        excess = movers.excess_m(time_s, radar) / closest
        x = excess * (excess + 2)
        # coefficients of x, x^2, ... in the power series of sqrt(1 + x)
        factors = [1.0]
        for n in range(self.order // 2):
            factors.append(factors[-1] * ((0.5 - n) / (n + 1)))
        total = torch.zeros_like(x)
        for factor in reversed(factors[1:]):
            total = (total + factor) * x
        return movers.range_m[..., None, None, :] + closest * total

    def neglected_phase_rad(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        missed = ExactRange().range_m(movers, time_s, radar) - self.range_m(movers, time_s, radar)
        return 2 * math.pi / radar.wavelength_m * missed.abs().amax((-3, -2, -1))


class TransmitRange(Protocol):
    """True range from the transmitter to the scene as a function of time."""

    def range_m(self, time_s: Tensor) -> Tensor:
        """Return the change of the range to the transmitter since slow time zero.

        Args:
            time_s: Slow time in seconds, any shape, float64.

        Returns:
            Change R_T(t) - R_T(0) of the range R_T in metres, shape (*trials, *times), float64.
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a transmit range")
class PolynomialTransmit(TransmitRange):
    """Polynomial range from the transmitter, R_T(t) - R_T(0) = k1 t + k2 t^2 + ...

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    >>> scene.PolynomialTransmit([100.0, 2.0]).range_m(time_s).tolist()
    [0.0, 102.0, 208.0]

    Args:
        coefficients: k1, k2, ... in m/s, m/s^2, ...; each a number or one value per trial.
        order: Number of terms that are used, all by default.

    Raises:
        ValueError: If a coefficient is not finite or the order exceeds their number.
    """

    coefficients: Sequence[Tensor | float]
    order: int | None = None

    def __post_init__(self) -> None:
        if self.order is not None and not 0 <= self.order <= len(self.coefficients):
            raise ValueError(
                f"order, the number of coefficients of the transmit range that are used, must lie in "
                f"0..{len(self.coefficients)}, got {self.order}"
            )

    def range_m(self, time_s: Tensor) -> Tensor:
        kept = [with_dims(k, time_s.ndim, time_s) for k in self.coefficients[: self.order]]
        return polynomial_range(kept, time_s)

    def neglected_phase_rad(self, radar: BistaticRadar, duration_s: float) -> float:
        """Return the largest phase of the polynomial terms beyond the chosen order.

        Args:
            radar: Radar parameters.
            duration_s: Length in seconds of the interval, centred on slow time zero, in which the
                phase is considered.

        Returns:
            Phase in radians, the largest of all trials.
        """
        kept = len(self.coefficients) if self.order is None else self.order
        half = duration_s / 2
        dropped = sum(abs(k) * half ** (kept + 1 + i) for i, k in enumerate(self.coefficients[kept:]))
        return 2 * math.pi / radar.wavelength_m * float(torch.as_tensor(dropped, dtype=torch.float64).max())


@dataclass(frozen=True)
@finite_numbers("a transmit range")
class OrbitTransmit(TransmitRange):
    """Exact range from a satellite to a point of the scene that rotates with the Earth.

    >>> import torch
    >>> from torchsar import radar, scene
    >>> overhead = scene.OrbitTransmit(radar.Orbit(7000e3), point_m=(6371e3, 0.0, 0.0))
    >>> overhead.range_m(torch.tensor([0.0, 10.0, 20.0], dtype=torch.float64)).round().tolist()
    [0.0, 3571.0, 14165.0]

    Args:
        orbit: Orbit of the satellite.
        point_m: Position of the point at the time `epoch_s`: three coordinates in the inertial
            frame in metres, such as `torchsar.radar.seen_point` gives.
        epoch_s: Time on the time axis of the orbit at which the slow time is zero, in seconds.

    Raises:
        ValueError: If there are not three finite coordinates, or the epoch is not finite.
    """

    orbit: Orbit
    point_m: Sequence[Tensor | float]
    epoch_s: Tensor | float = 0.0

    def __post_init__(self) -> None:
        if len(self.point_m) != 3:
            raise ValueError(
                f"point_m must be three coordinates (m) in the inertial frame, got {len(self.point_m)} of them"
            )

    def range_m(self, time_s: Tensor) -> Tensor:
        return orbit_range(self.orbit, stacked(self.point_m, time_s.device), self.epoch_s, time_s)


@dataclass(frozen=True)
@finite_numbers()
class BistaticWorld:
    """Moving targets, their receive gain, the sea beneath them and the noise.

    >>> from torchsar import Draws, echo, radar, scene
    >>> airborne = radar.BistaticRadar(10e9, radar.LinearFM(20e6, 5e-6), 24e6, 100.0, 100.0, 5000.0)
    >>> ship = scene.Ship(u_r_m_s=5.0, u_a_m_s=0.0)
    >>> world = scene.BistaticWorld(ship, scene.BandLimited(duration_s=0.5), snr_db=20.0)
    >>> echo.simulate_bistatic(airborne, world, 64, 32, Draws(seed=1))[0].signal.data.shape
    torch.Size([3, 64, 32])

    Args:
        scene: Moving targets, None for none.
        gate: Receive gain, `BandLimited` or `Pattern`.
        sea: Stationary surface such as `KSea`, None for none.
        snr_db: Power of a target of amplitude 1 over the noise variance in decibels, in one sample
            of one channel after range compression at the peak of the target. Before compression it
            is lower by 10 log10(B tau_p), with the bandwidth B and the duration tau_p of the pulse.
            None for no noise.
        receive: Model of the range to the receiver, `ExactRange` or `TaylorRange`.
        transmit: True range to the transmitter, None for that of radar.transmit_range.

    Raises:
        TypeError: If the scene, the gate or the range model has the wrong type.
        ValueError: If there is neither a scene nor a sea, or snr_db is not finite.
    """

    scene: MovingScene | None
    gate: Gate
    sea: Sea | None = None
    snr_db: Tensor | float | None = None
    receive: ReceiveRange = field(default_factory=ExactRange)
    transmit: TransmitRange | None = None

    def __post_init__(self) -> None:
        gain = getattr(self.gate, "weight", None)
        taken = signature(gain).parameters if callable(gain) and not isinstance(self.gate, type) else ()
        if not {"movers", "time_s", "radar"} <= set(taken):
            raise TypeError(
                "gate must be an object with weight(movers, time_s, radar), such as BandLimited(duration_s) "
                f"or Pattern(), got {self.gate!r}"
            )
        if self.scene is None and self.sea is None:
            raise ValueError("a world without moving targets and without a sea is empty; give it a scene or a sea")
