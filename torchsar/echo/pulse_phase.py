"""Phase errors of range-compressed pulses, as impairments for studies of autofocus."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, unit_phasor
from torchsar.echo.recorded import with_samples
from torchsar.scene.trials import finite_numbers, refuse_other_trials, with_dims


def _turned(recording: Recording, phase_rad: Tensor) -> tuple[Recording, Mapping[str, Tensor]]:
    """Multiply every pulse of a recording by exp(j phase), and return the recording with the true
    value `phase_rad`.
    """
    data = recording.signal.data
    phase = phase_rad.to(data.device).expand(data.shape[:-1])
    turned = data * unit_phasor(phase / (2 * math.pi), data.dtype)[..., None]
    return with_samples(recording, turned), {"phase_rad": phase}


@dataclass(frozen=True)
@finite_numbers("a white phase", limit_rad=0.0)
class WhitePhase:
    """Impairment: an independent phase of each pulse, uniform within +-limit_rad.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"phase": echo.WhitePhase(limit_rad=0.5)}
    >>> recording, _ = echo.simulate_turntable(isar, world, 64, 8, Draws(1), errors)
    >>> recording.signal.data[:, 4].angle().abs().max().round(decimals=1)  # the cell of the point
    tensor(0.5000)

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        limit_rad: Largest phase in radians.

    Raises:
        ValueError: If the limit is negative or not finite.
    """

    limit_rad: Tensor | float = math.pi

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        share = draws.uniform("echo.phase.white", (recording.signal.axis("pulse").n,))
        limit = with_dims(self.limit_rad, 1, share)
        return _turned(recording, 2 * limit * share - limit)


@dataclass(frozen=True)
@finite_numbers("a phase walk", step_rad=0.0)
class PhaseWalk:
    """Impairment: a random walk of the phase with normal steps from pulse to pulse.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"phase": echo.PhaseWalk(step_rad=0.5)}
    >>> _, truth = echo.simulate_turntable(isar, world, 1024, 8, Draws(1), errors)
    >>> truth.values["phase.phase_rad"].diff().std().round(decimals=1)
    tensor(0.5000, dtype=torch.float64)

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        step_rad: Standard deviation of a step in radians.

    Raises:
        ValueError: If the standard deviation is negative or not finite.
    """

    step_rad: Tensor | float = 1.0

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        unit = draws.normal("echo.phase.walk", (recording.signal.axis("pulse").n,))
        return _turned(recording, (with_dims(self.step_rad, 1, unit) * unit).cumsum(-1))


@dataclass(frozen=True)
@finite_numbers("a phase sinusoid")
class PhaseSinusoid:
    """Impairment: a sinusoidal phase with a random start, as of a vibration.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"phase": echo.PhaseSinusoid(amplitude_rad=2.0)}
    >>> _, truth = echo.simulate_turntable(isar, world, 64, 8, Draws(1), errors)
    >>> truth.values["phase.phase_rad"].max().round(decimals=1)
    tensor(2., dtype=torch.float64)

    The truth holds `phase_rad`, shape (..., pulse), float64.

    Args:
        amplitude_rad: Amplitude in radians.
        cycles: Number of periods over the recording.

    Raises:
        ValueError: If a number is not finite.
    """

    amplitude_rad: Tensor | float = 10.0
    cycles: Tensor | float = 5.0

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        pulse = torch.arange(recording.signal.axis("pulse").n, dtype=torch.float64)
        amplitude, cycles = (with_dims(v, 1, pulse) for v in (self.amplitude_rad, self.cycles))
        turns = cycles * pulse / len(pulse) + draws.uniform("echo.phase.sinusoid")[..., None]
        return _turned(recording, amplitude * torch.sin(2 * math.pi * turns))
