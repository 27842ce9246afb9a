"""Phase errors of range-compressed pulses, as impairments for studies of autofocus."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, unit_phasor
from torchsar.scene.trials import finite, refuse_other_trials, refuse_unless, refuse_unless_finite, with_dims


def _turned(recording: Recording, phase_rad: Tensor) -> tuple[Recording, Mapping[str, Tensor]]:
    """The recording with every pulse multiplied by exp(j phase), and the truth `phase_rad`."""
    data = recording.signal.data
    phase = phase_rad.to(data.device).expand(data.shape[:-1])
    turned = data * unit_phasor(phase / (2 * math.pi), data.dtype)[..., None]
    return replace(recording, signal=recording.signal.with_data(turned)), {"phase_rad": phase}


def _level(x: Any) -> Any:
    """Whether a number, or each entry of a tensor, is finite and not negative."""
    return finite(x) & (x >= 0)


def _pulses(recording: Recording) -> int:
    """Number of pulses."""
    return recording.signal.data.shape[-2]


@dataclass(frozen=True)
class WhitePhase:
    """Impairment: an independent phase of each pulse, uniform within +-limit_rad.

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        limit_rad: Largest phase in radians.

    Raises:
        ValueError: If the limit is negative or not finite.
    """

    limit_rad: Tensor | float = math.pi

    def __post_init__(self) -> None:
        refuse_unless("limit_rad must be 0 rad or more", self.limit_rad, _level)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        share = draws.uniform("echo.phase.white", (_pulses(recording),))
        limit = with_dims(self.limit_rad, 1, share)
        return _turned(recording, 2 * limit * share - limit)


@dataclass(frozen=True)
class PhaseWalk:
    """Impairment: a random walk of the phase with normal steps from pulse to pulse.

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        step_rad: Standard deviation of a step in radians.

    Raises:
        ValueError: If the standard deviation is negative or not finite.
    """

    step_rad: Tensor | float = 1.0

    def __post_init__(self) -> None:
        refuse_unless("step_rad must be 0 rad or more", self.step_rad, _level)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        unit = draws.normal("echo.phase.walk", (_pulses(recording),))
        return _turned(recording, (with_dims(self.step_rad, 1, unit) * unit).cumsum(-1))


@dataclass(frozen=True)
class PhaseSinusoid:
    """Impairment: a sinusoidal phase with a random start, as of a vibration.

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        amplitude_rad: Amplitude in radians.
        cycles: Number of periods over the recording.

    Raises:
        ValueError: If a number is not finite.
    """

    amplitude_rad: Tensor | float = 10.0
    cycles: Tensor | float = 5.0

    def __post_init__(self) -> None:
        refuse_unless_finite("amplitude_rad of a phase sinusoid", self.amplitude_rad)
        refuse_unless_finite("cycles of a phase sinusoid", self.cycles)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        pulse = torch.arange(_pulses(recording), dtype=torch.float64)
        amplitude, cycles = (with_dims(v, 1, pulse) for v in (self.amplitude_rad, self.cycles))
        turns = cycles * pulse / len(pulse) + draws.uniform("echo.phase.sinusoid")[..., None]
        return _turned(recording, amplitude * torch.sin(2 * math.pi * turns))
