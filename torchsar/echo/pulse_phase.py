"""Phase errors put into range-compressed pulses, simulated or recorded: impairments that an
autofocus has to find again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, unit_phasor


def _turned(recording: Recording, phase_rad: Tensor) -> tuple[Recording, Mapping[str, Tensor]]:
    """The recording with every pulse turned by exp(j phase), and the truth `phase_rad` (..., pulse)
    float64.
    """
    data = recording.signal.data
    phase = phase_rad.to(data.device).expand(data.shape[:-1])
    turned = data * unit_phasor(phase / (2 * math.pi), data.dtype)[..., None]
    return replace(recording, signal=recording.signal.with_data(turned)), {"phase_rad": phase}


def _pulses(recording: Recording) -> int:
    return recording.signal.data.shape[-2]


@dataclass(frozen=True)
class WhitePhase:
    """An independent phase of each pulse: uniform within +- limit_rad."""

    limit_rad: float = math.pi

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit_rad) and self.limit_rad >= 0):
            raise ValueError(f"limit_rad must be 0 rad or more, got {self.limit_rad}")

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        return _turned(
            recording, draws.uniform("echo.phase.white", (_pulses(recording),), -self.limit_rad, self.limit_rad)
        )


@dataclass(frozen=True)
class PhaseWalk:
    """A random walk from pulse to pulse with normal steps of deviation step_rad."""

    step_rad: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.step_rad) and self.step_rad >= 0):
            raise ValueError(f"step_rad must be 0 rad or more, got {self.step_rad}")

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        return _turned(recording, (self.step_rad * draws.normal("echo.phase.walk", (_pulses(recording),))).cumsum(-1))


@dataclass(frozen=True)
class PhaseSinusoid:
    """A vibration of amplitude_rad and `cycles` periods over the recording, at a random start."""

    amplitude_rad: float = 10.0
    cycles: float = 5.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.amplitude_rad) and math.isfinite(self.cycles)):
            raise ValueError(
                f"amplitude_rad and cycles must be finite numbers, got {self.amplitude_rad} and {self.cycles}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        n = _pulses(recording)
        turns = self.cycles * torch.arange(n, dtype=torch.float64) / n + draws.uniform("echo.phase.sinusoid")[..., None]
        return _turned(recording, self.amplitude_rad * torch.sin(2 * math.pi * turns))
