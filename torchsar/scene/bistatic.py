"""Targets, clutter and noise of a scene that a distant satellite illuminates and an airborne
receiver records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from torchsar.radar import BistaticRadar, Orbit
from torchsar.radar.bistatic import polynomial_range
from torchsar.radar.orbit import orbit_range
from torchsar.scene.moving import ExactRange, Movers, MovingScene, ReceiveRange
from torchsar.scene.sea import Sea
from torchsar.scene.trials import positive, refuse_unless, refuse_unless_finite, stacked, with_dims


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
class BandLimited:
    """Gate that passes each target for a limited time, equal in all channels.

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

    def __post_init__(self) -> None:
        refuse_unless("duration_s of a band-limited gate must be a positive number", self.duration_s, positive)

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the gain, one where |t - y0 / v| < duration_s / 2 and zero elsewhere.

        t is the slow time, y0 the along-track position of the target at t = 0, and v the
        along-track speed of the receiver relative to the target.

        Args:
            movers: Targets.
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            Shape (..., 1, pulse, target), float64.
        """
        abreast = movers.y0_m.detach() / (radar.speed_m_s - movers.u_a_m_s.detach())
        duration = with_dims(self.duration_s, 3, time_s)
        return ((time_s[:, None] - abreast[..., None, None, :]).abs() < duration / 2).to(torch.float64)


@dataclass(frozen=True)
class Pattern:
    """One-way pattern of a uniformly illuminated antenna element over the whole record.

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

    def __post_init__(self) -> None:
        if self.element_m is not None:
            sentence = "element_m of a pattern must be a positive length, or None for that of the radar"
            refuse_unless(sentence, self.element_m, positive)

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Return the amplitude gain of the receive pattern.

        Args:
            movers: Targets.
            time_s: Slow time in seconds, shape (pulse,), float64.
            radar: Radar parameters.

        Returns:
            Shape (..., channel, pulse, target), float64.
        """
        closest = movers.closest_m(radar)[..., None, None, :]
        sine = movers.along_m(time_s, radar) / (closest + movers.excess_m(time_s, radar))
        element = radar.element_m if self.element_m is None else with_dims(self.element_m, 3, time_s)
        return torch.sinc(element / radar.wavelength_m * sine)


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
class PolynomialTransmit:
    """Polynomial range from the transmitter, R_T(t) - R_T(0) = k1 t + k2 t^2 + ...

    Args:
        coefficients: k1, k2, ... in m/s, m/s^2, ...; each a number or one value per trial.
        order: Number of terms that are used, all by default.

    Raises:
        ValueError: If a coefficient is not finite or the order exceeds their number.
    """

    coefficients: Sequence[Tensor | float]
    order: int | None = None

    def __post_init__(self) -> None:
        for degree, value in enumerate(self.coefficients, start=1):
            refuse_unless_finite(f"coefficient {degree} of a transmit range", value)
        if self.order is not None and not 0 <= self.order <= len(self.coefficients):
            raise ValueError(
                f"order, the number of coefficients of the transmit range that are used, must lie in "
                f"0..{len(self.coefficients)}, got {self.order}"
            )

    def range_m(self, time_s: Tensor) -> Tensor:
        """Return the change of the range to the transmitter since slow time zero.

        Args:
            time_s: Slow time in seconds, any shape, float64.

        Returns:
            Change R_T(t) - R_T(0) of the range R_T in metres, shape (*trials, *times), float64.
        """
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
class OrbitTransmit:
    """Exact range from a satellite to a point of the scene that rotates with the Earth.

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
        refuse_unless_finite("point_m of a transmit range", self.point_m)
        refuse_unless_finite("epoch_s of a transmit range", self.epoch_s)

    def range_m(self, time_s: Tensor) -> Tensor:
        """Return the change of the range to the transmitter since slow time zero.

        Args:
            time_s: Slow time in seconds, shape (pulse,), float64.

        Returns:
            Change R_T(t) - R_T(0) of the range R_T in metres, shape (..., pulse), float64.
        """
        return orbit_range(self.orbit, stacked(self.point_m, time_s.device), self.epoch_s, time_s)


@dataclass(frozen=True)
class BistaticWorld:
    """Moving targets, their receive gain, the sea beneath them and the noise.

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
        if self.scene is not None and not hasattr(self.scene, "movers"):
            raise TypeError(
                f"scene must be an object with movers, such as MovingPoints or Ship, or None, got {self.scene!r}"
            )
        if isinstance(self.gate, type) or not hasattr(self.gate, "weight"):
            raise TypeError(f"gate must be BandLimited(duration_s) or Pattern(), got {self.gate!r}")
        if isinstance(self.receive, type) or not hasattr(self.receive, "range_m"):
            raise TypeError(f"receive must be ExactRange() or TaylorRange(order), got {self.receive!r}")
        if self.scene is None and self.sea is None:
            raise ValueError("a world without moving targets and without a sea is empty; give it a scene or a sea")
        refuse_unless_finite("snr_db", self.snr_db)
