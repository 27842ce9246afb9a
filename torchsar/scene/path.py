"""Range histories and beams of a straight path, as interchangeable fidelity objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.radar import StripmapRadar


class Path(Protocol):
    """Range from closest approach: (slow time since closest approach, closest range, velocity) ->
    slant range, all float64.
    """

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor: ...

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float: ...


@dataclass(frozen=True)
class Hyperbola:
    """Exact straight path, r(t) = sqrt(r0^2 + v^2 t^2); the range is frozen during a pulse.

    Neglects the motion inside the pulse: the Doppler 2 v_r / lambda displaces an up-chirp by a
    constant delay and turns its phase.
    """

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor:
        x2 = (velocity_m_s * since_s).square()
        return closest_m + x2 / (torch.sqrt(closest_m.square() + x2) + closest_m)

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float:
        """Largest phase, at the ends of the pulse, of the Doppler that is not constant over the
        aperture: pi f_d T with f_d at since_s.
        """
        closing = radar.velocity_m_s**2 * since_s / math.hypot(range_m, radar.velocity_m_s * since_s)
        return 2 * math.pi * closing / radar.wavelength_m * radar.pulse.duration_s


@dataclass(frozen=True)
class Parabola:
    """Second-order range history r0 + v^2 t^2 / (2 r0) (Tsvetkov 2017, Eq. 2).

    Neglects the fourth order, see neglected_phase_rad.
    """

    def range_m(self, since_s: Tensor, closest_m: Tensor, velocity_m_s: Tensor) -> Tensor:
        return closest_m + (velocity_m_s * since_s).square() / (2 * closest_m)

    def neglected_phase_rad(self, radar: StripmapRadar, range_m: float, since_s: float) -> float:
        """4 pi / lambda times the difference to the hyperbola at since_s from closest approach,
        about pi x^4 / (2 lambda r^3).
        """
        x2 = (radar.velocity_m_s * since_s) ** 2
        exact = x2 / (math.sqrt(range_m**2 + x2) + range_m)
        return 4 * math.pi / radar.wavelength_m * (x2 / (2 * range_m) - exact)


class Beam(Protocol):
    """Two-way illumination of a target: (slow time since the beam centre crossed it, its Doppler
    relative to the centre) -> weight.
    """

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class AlwaysLit:
    """Every target is seen by every pulse."""

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        return torch.ones_like(since_s)


@dataclass(frozen=True)
class Dwell:
    """A target is seen for dwell_s about the crossing of the beam centre, with constant gain: the
    synthetic aperture of the paper.
    """

    dwell_s: float

    def __post_init__(self) -> None:
        if not self.dwell_s > 0:
            raise ValueError(f"dwell_s must be a positive number of seconds, got {self.dwell_s}")

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        return (since_s.abs() <= self.dwell_s / 2).to(since_s.dtype)


@dataclass(frozen=True)
class Antenna:
    """Uniform aperture of length_m: two-way gain sinc^2(length * (Doppler offset) / (2 v)), side
    lobes included.
    """

    length_m: float

    def __post_init__(self) -> None:
        if not self.length_m > 0:
            raise ValueError(f"length_m must be a positive number of metres, got {self.length_m}")

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        return torch.sinc(self.length_m * doppler_offset_hz / (2 * velocity_m_s)).square()
