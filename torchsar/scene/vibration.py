"""What moves a target along the line of sight, and what turns the phase of its pulses: lists of
effects, where an absent effect is absent.

Displacements count away from the radar (range grows), time from the first pulse. A displacement d
turns the phase by -4 pi d / lambda.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial

_UNIT_M = {"mm": 1e-3, "um": 1e-6}
_NUMBER = r"(\d+(?:\.\d+)?)"
_NAME = re.compile(rf"{_NUMBER}_{_NUMBER}_(-?\d+(?:\.\d+)?)")


def refuse_unless_finite(what: str, value: Tensor | float, least: float = -math.inf) -> None:
    """Raise ValueError unless every entry of a number or per-trial tensor is finite and at least
    `least`.
    """
    x = torch.as_tensor(value, dtype=torch.float64).detach()
    if not bool((torch.isfinite(x) & (x >= least)).all()):
        bound = "" if least == -math.inf else f" of {least:g} or more"
        raise ValueError(f"{what} must be a finite number{bound}, or one per trial, got {value}")


class Motion(Protocol):
    """Displacement of the whole target along the line of sight: float64 times of any shape (s) ->
    (*trials, *times) in m.
    """

    def displacement_m(self, time_s: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Sinusoid:
    """Vibration d(t) = A sin(2 pi f t + phase); each parameter a number or a per-trial tensor
    (...,).

    SINE, as the experiments of Ruan et al. 2013 need it: with a cosine 1_0.1_90 is nearly linear in
    time and hardly defocuses.
    """

    amplitude_m: Tensor | float
    frequency_hz: Tensor | float
    phase_deg: Tensor | float = 0.0

    def __post_init__(self) -> None:
        refuse_unless_finite("amplitude_m of a vibration", self.amplitude_m)
        refuse_unless_finite("frequency_hz of a vibration", self.frequency_hz, 0.0)
        refuse_unless_finite("phase_deg of a vibration", self.phase_deg)

    @classmethod
    def named(cls, name: str, *, unit: str) -> Sinusoid:
        """The vibration of a name amplitude_frequency_phase as the paper writes them, `1_0.1_90`:
        amplitude in `unit`, Hz, degrees.

        unit: "mm" or "um", never guessed: the published figures need mm, and mm contradicts the
        paper's own assumptions about the pulse. Raises ValueError for any other name or unit.
        """
        if unit not in _UNIT_M:
            raise ValueError(f"unit {unit!r} of a vibration's amplitude is unknown; choose 'mm' or 'um'")
        found = _NAME.fullmatch(name) if isinstance(name, str) else None
        if found is None:
            raise ValueError(
                f"vibration {name!r} is no name of the form amplitude_frequency_phase, such as '1_100_90' or '1_0.1_90'"
            )
        amplitude, frequency, phase = (float(part) for part in found.groups())
        return cls(amplitude * _UNIT_M[unit], frequency, phase)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """d at the times, (*trials, *times).

        The angle is formed in turns, as times of hours would lose it in radians.
        """
        amplitude, frequency, phase = (
            per_trial(v, time_s.ndim, time_s) for v in (self.amplitude_m, self.frequency_hz, self.phase_deg)
        )
        turns = frequency * time_s + phase / 360
        return amplitude * torch.sin(2 * math.pi * (turns - torch.round(turns.detach())))


@dataclass(frozen=True)
class Polynomial:
    """Translation d(t) = c1 t + c2 t^2 + ...

    from its coefficients (m/s, m/s^2, ...): velocity, half the acceleration, and so on.

    coefficients_m: each a number or a per-trial tensor (...,). There is no constant: the window
    stands where the target begins.
    """

    coefficients_m: Sequence[Tensor | float]

    def __post_init__(self) -> None:
        if not len(self.coefficients_m):
            raise ValueError(
                "a translation needs at least one coefficient, its velocity in m/s; leave the effect "
                "out where there is none"
            )
        for degree, value in enumerate(self.coefficients_m, start=1):
            refuse_unless_finite(f"coefficient {degree} of a translation", value)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """d at the times, (*trials, *times), by Horner's rule."""
        total = torch.zeros_like(time_s)
        for value in reversed(self.coefficients_m):
            total = (total + per_trial(value, time_s.ndim, time_s)) * time_s
        return total


def displacement_m(motion: Sequence[Motion], time_s: Tensor) -> Tensor:
    """Sum of a list of motions at float64 times of any shape, (*trials, *times); zeros for an empty
    list.
    """
    total = torch.zeros_like(time_s)
    for part in motion:
        total = total + part.displacement_m(time_s)
    return total


class PulsePhase(Protocol):
    """A phase that each pulse starts with: float64 (*trials, pulse) in rad."""

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor: ...


@dataclass(frozen=True)
class StartPhase:
    """Independent normal phase of each pulse, deviation sigma_rad (a number or per trial)."""

    sigma_rad: Tensor | float

    def __post_init__(self) -> None:
        refuse_unless_finite("sigma_rad of a start phase", self.sigma_rad, 0.0)

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        unit = draws.normal("scene.start_phase.normal", (n_pulse,))
        return per_trial(self.sigma_rad, 1, unit) * unit


@dataclass(frozen=True)
class UniformStartPhase:
    """Independent phase of each pulse, uniform in 0..2 pi: nothing is left between pulses."""

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        return draws.uniform("scene.start_phase.uniform", (n_pulse,), 0.0, 2 * math.pi)


def start_phase_rad(effects: Sequence[PulsePhase], draws: Draws, n_pulse: int) -> Tensor:
    """Sum of a list of start phases, (*trials, pulse); each draws from an address of its own, its
    place in the list.
    """
    total = torch.zeros(n_pulse, dtype=torch.float64)
    for place, effect in enumerate(effects):
        total = total + effect.phase_rad(draws.part(f"start_phase.{place}"), n_pulse)
    return total
