"""Motions of a target along the line of sight, and start phases of pulses.

A simulation takes motions and start phases as lists; an empty list stands for no such effect.
Displacements are positive away from the radar; a displacement d changes the phase by
-4 pi d / lambda. Time counts from the first pulse.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial
from torchsar.scene.trials import finite_numbers, refuse_unless_finite

# form amplitude_frequency_phase, such as 1_0.1_90
_NAME = re.compile(r"(\d+(?:\.\d+)?)_(\d+(?:\.\d+)?)_(-?\d+(?:\.\d+)?)")


class Motion(Protocol):
    """Displacement of the whole target along the line of sight.

    >>> import torch
    >>> from torchsar import scene
    >>> class Step(scene.Motion):
    ...     def displacement_m(self, time_s):
    ...         return 0.5 * (time_s > 1)
    >>> Step().displacement_m(torch.tensor([0.5, 1.5])).tolist()
    [0.0, 0.5]
    """

    def displacement_m(self, time_s: Tensor) -> Tensor:
        """Return the displacement.

        Args:
            time_s: Time since the first pulse in seconds, any shape, float64.

        Returns:
            Displacement in metres, receding positive, shape (*trials, *times).
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a vibration", frequency_hz=0.0)
class Sinusoid(Motion):
    """Sinusoidal vibration, d(t) = A sin(2 pi f t + phase).

    >>> import torch
    >>> from torchsar import scene
    >>> shake = scene.Sinusoid(amplitude_m=0.002, frequency_hz=0.25)
    >>> shake.displacement_m(torch.tensor([0.0, 1.0], dtype=torch.float64)).tolist()
    [0.0, 0.002]

    This SINE reproduces the results of the Reference. With a cosine, the vibration `1_0.1_90` of
    the Reference (amplitude 1, 0.1 Hz, 90 degrees) would be nearly linear in time and hardly
    defocus.

    Args:
        amplitude_m: Amplitude A in metres.
        frequency_hz: Frequency f in hertz.
        phase_deg: Phase at the first pulse in degrees.

    Raises:
        ValueError: If a number is not finite or the frequency is negative.

    Reference:
        Ruan et al. 2013, Table 1.
    """

    amplitude_m: Tensor | float
    frequency_hz: Tensor | float
    phase_deg: Tensor | float = 0.0

    @classmethod
    def named(cls, name: str, *, unit: Literal["mm", "um"]) -> Sinusoid:
        """Return the sinusoidal vibration of a name amplitude_frequency_phase, such as `1_0.1_90`.

        Args:
            name: Amplitude in `unit`, frequency in hertz and phase in degrees.
            unit: Unit of the amplitude, "mm" or "um". The figures of the Reference agree with mm,
                although a vibration of 1 mm at 100 Hz then adds 4 rad within a pulse, which the
                Reference neglects.

        Returns:
            The vibration.

        Raises:
            ValueError: If the name or the unit has another form.

        Reference:
            Ruan et al. 2013, Table 1.
        """
        metres = {"mm": 1e-3, "um": 1e-6}
        if unit not in metres:
            raise ValueError(f"unit {unit!r} of a vibration's amplitude is unknown; choose 'mm' or 'um'")
        found = _NAME.fullmatch(name) if isinstance(name, str) else None
        if found is None:
            raise ValueError(
                f"vibration {name!r} does not have the form amplitude_frequency_phase (amplitude in {unit}, frequency "
                "in Hz, phase in degrees), such as '1_100_90' or '1_0.1_90'"
            )
        amplitude, frequency, phase = (float(part) for part in found.groups())
        return cls(amplitude * metres[unit], frequency, phase)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        amplitude, frequency, phase = (
            per_trial(v, time_s.ndim, time_s) for v in (self.amplitude_m, self.frequency_hz, self.phase_deg)
        )
        turns = frequency * time_s + phase / 360
        return amplitude * torch.sin(2 * math.pi * (turns - torch.round(turns.detach())))


@dataclass(frozen=True)
@finite_numbers("a translation", coefficients_m=None)
class Polynomial(Motion):
    """Translation d(t) = c1 t + c2 t^2 + ...

    >>> import torch
    >>> from torchsar import scene
    >>> time_s = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    >>> scene.Polynomial([1.0, 0.5]).displacement_m(time_s).tolist()
    [0.0, 1.5, 4.0]

    There is no constant term: the range window is centred on the initial position.

    Args:
        coefficients_m: c1, c2, ... in m/s, m/s^2, ...: velocity, half the acceleration, and so on;
            each a number or one value per trial.

    Raises:
        ValueError: If there is no coefficient, or one is not finite.
    """

    coefficients_m: Sequence[Tensor | float]

    def __post_init__(self) -> None:
        if not len(self.coefficients_m):
            raise ValueError(
                "a translation needs at least one coefficient, its velocity in m/s; leave the motion "
                "out if there is no translation"
            )
        for degree, value in enumerate(self.coefficients_m, start=1):
            refuse_unless_finite(f"coefficient {degree} of a translation", value)

    def displacement_m(self, time_s: Tensor) -> Tensor:
        total = torch.zeros_like(time_s)
        for value in reversed(self.coefficients_m):
            total = (total + per_trial(value, time_s.ndim, time_s)) * time_s
        return total


def displacement_m(motion: Sequence[Motion], time_s: Tensor) -> Tensor:
    """Return the total displacement of several motions.

    Args:
        motion: Motions; an empty sequence gives zero displacement.
        time_s: Time since the first pulse in seconds, any shape, float64.

    Returns:
        Displacement in metres, receding positive, shape (*trials, *times).
    """
    return sum((part.displacement_m(time_s) for part in motion), torch.zeros_like(time_s))


class PulsePhase(Protocol):
    """Start phase of the pulses."""

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        """Draw the phases.

        Args:
            draws: Random draws.
            n_pulse: Number of pulses.

        Returns:
            Phase in radians, shape (*trials, pulse), float64.
        """
        ...


@dataclass(frozen=True)
@finite_numbers("a start phase", sigma_rad=0.0)
class StartPhase(PulsePhase):
    """Independent normally distributed phase of each pulse.

    >>> from torchsar import Draws, scene
    >>> phase_rad = scene.StartPhase(sigma_rad=0.5).phase_rad(Draws(seed=1), n_pulse=1000)
    >>> phase_rad.shape, round(float(phase_rad.std()), 1)
    (torch.Size([1000]), 0.5)

    Args:
        sigma_rad: Standard deviation in radians.

    Raises:
        ValueError: If the standard deviation is negative or not finite.
    """

    sigma_rad: Tensor | float

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        unit = draws.normal("scene.start_phase.normal", (n_pulse,))
        return per_trial(self.sigma_rad, 1, unit) * unit


@dataclass(frozen=True)
class UniformStartPhase(PulsePhase):
    """Independent phase of each pulse, uniform in 0 to 2 pi: pulses are incoherent.

    >>> from torchsar import Draws, scene
    >>> phase_rad = scene.UniformStartPhase().phase_rad(Draws(seed=1), n_pulse=1000)
    >>> [round(float(bound), 1) for bound in phase_rad.aminmax()]
    [0.0, 6.3]
    """

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        return draws.uniform("scene.start_phase.uniform", (n_pulse,), 0.0, 2 * math.pi)


def start_phase_rad(effects: Sequence[PulsePhase], draws: Draws, n_pulse: int) -> Tensor:
    """Draw the start phases of several effects and return their sum.

    Args:
        effects: Effects. The position of an effect in the list decides which random numbers it
            draws.
        draws: Random draws.
        n_pulse: Number of pulses.

    Returns:
        Phase in radians, shape (*trials, pulse), float64.
    """
    drawn = (effect.phase_rad(draws.part(f"start_phase.{at}"), n_pulse) for at, effect in enumerate(effects))
    return sum(drawn, torch.zeros(n_pulse, dtype=torch.float64))
