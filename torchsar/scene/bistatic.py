"""Everything that is true about a scene lit by a far satellite and seen by an airborne receiver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from torchsar.radar import BistaticRadar, Orbit, orbit_range, polynomial_range
from torchsar.scene.moving import ExactRange, Movers, MovingScene, ReceiveRange
from torchsar.scene.sea import Sea
from torchsar.scene.vibration import refuse_unless_finite


class Gate(Protocol):
    """What the receiver sees of a target, by time or by direction."""

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor: ...


@dataclass(frozen=True)
class BandLimited:
    """Each target is seen for duration_s about the time y0 / v at which it is abreast, alike in all
    channels: its band is limited.
    """

    duration_s: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration_s) and self.duration_s > 0):
            raise ValueError(f"duration_s of a band-limited gate must be a positive number, got {self.duration_s}")

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """1 where |t - y0 / v| < duration_s / 2, else 0: float64 (..., 1, pulse, target)."""
        abreast = movers.y0_m.detach() / (radar.speed_m_s - movers.u_a_m_s.detach())
        return ((time_s[:, None] - abreast[..., None, None, :]).abs() < self.duration_s / 2).to(torch.float64)


@dataclass(frozen=True)
class Pattern:
    """One-way pattern of a uniformly lit element, sin(pi q) / (pi q) with q = element_m sin(look) /
    wavelength, seen over the whole record.

    sin(look) = (v t - y0 - dx_m) / R_m. element_m: None for that of the radar.
    """

    element_m: float | None = None

    def __post_init__(self) -> None:
        if self.element_m is not None and not 0 < self.element_m < math.inf:
            raise ValueError(
                f"element_m of a pattern must be a positive length, or None for that of the radar, got {self.element_m}"
            )

    def weight(self, movers: Movers, time_s: Tensor, radar: BistaticRadar) -> Tensor:
        """Amplitude gain of the receive pattern, float64 (..., channel, pulse, target)."""
        closest = movers.closest_m(radar)[..., None, None, :]
        sine = movers.along_m(time_s, radar) / (closest + movers.excess_m(time_s, radar))
        return torch.sinc((self.element_m or radar.element_m) / radar.wavelength_m * sine)


class TransmitRange(Protocol):
    """How the range from the transmitter to the scene changes."""

    def range_m(self, time_s: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class PolynomialTransmit:
    """R_T(t) - R_T(0) = k1 t + k2 t^2 + ..., of which `order` terms are kept, all by default."""

    coefficients: Sequence[float]
    order: int | None = None

    def __post_init__(self) -> None:
        refuse_unless_finite(
            "coefficients of a transmit range", torch.tensor(list(self.coefficients), dtype=torch.float64)
        )
        if self.order is not None and not 0 <= self.order <= len(self.coefficients):
            raise ValueError(
                f"order of a transmit range must lie in 0..{len(self.coefficients)}, the number of "
                f"its coefficients, got {self.order}"
            )

    def range_m(self, time_s: Tensor) -> Tensor:
        """R_T(t) - R_T(0) (m), float64, shape of time_s."""
        return polynomial_range(self.coefficients[: self.order], time_s)

    def neglected_phase_rad(self, radar: BistaticRadar, duration_s: float) -> float:
        """Largest phase (rad) of the dropped terms within duration_s about t = 0."""
        kept = len(self.coefficients) if self.order is None else self.order
        half = duration_s / 2
        return (
            2
            * math.pi
            / radar.wavelength_m
            * sum(abs(k) * half ** (kept + 1 + i) for i, k in enumerate(self.coefficients[kept:]))
        )


@dataclass(frozen=True)
class OrbitTransmit:
    """The exact range from a satellite to a point of the scene, which turns with the Earth.

    point_m: the point at the epoch in the inertial frame (m), as of `radar.seen_point`; epoch_s:
    time of the orbit at slow time zero.
    """

    orbit: Orbit
    point_m: Sequence[float]
    epoch_s: float = 0.0

    def __post_init__(self) -> None:
        if len(self.point_m) != 3:
            raise ValueError(f"point_m needs three coordinates in the inertial frame (m), got {len(self.point_m)}")

    def range_m(self, time_s: Tensor) -> Tensor:
        """R_T(t) - R_T(0) (m), float64, shape of time_s, behind the trial dims of the orbit."""
        return orbit_range(
            self.orbit, torch.as_tensor(self.point_m, dtype=torch.float64, device=time_s.device), self.epoch_s, time_s
        )


@dataclass(frozen=True)
class BistaticWorld:
    """Moving targets, what the receiver sees of them, the sea under them, and the noise.

    scene: None for no moving target. gate: `BandLimited` or `Pattern`. sea: such as `KSea`, None
    for none. snr_db: power of a target of amplitude 1 over noise variance in a sample of one
    channel after range compression, at the peak line of the target (in one pulse of raw echoes it
    is B tau_p less), a number or per-trial tensor (...,); None for no noise. receive: how finely
    ranges are followed. transmit: the true range to the transmitter; None for that of the
    ephemeris.
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
        if self.snr_db is not None:
            refuse_unless_finite("snr_db", self.snr_db)
