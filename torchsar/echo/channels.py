"""Imbalance of receiver channels that record the lines in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording
from torchsar.echo.recorded import with_samples
from torchsar.scene.trials import finite_numbers, refuse_other_trials, stacked


@dataclass(frozen=True)
@finite_numbers("channels")
class ChannelImbalance:
    """Impairment: gain and phase of receiver channels that record the lines in turn.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"channels": echo.ChannelImbalance(gain=(1, 2), phase_rad=(0, 0))}
    >>> recording, _ = echo.simulate_turntable(isar, world, 4, 8, Draws(1), errors)
    >>> recording.signal.data[:, 4].abs().round(decimals=2)  # the range cell of the point
    tensor([1., 2., 1., 2.])

    Line i is multiplied by gain[c] exp(j phase_rad[c]) with c = i modulo the number of channels.
    Even and odd lines are two channels: `ChannelImbalance(gain=(1, 1.2), phase_rad=(0, math.pi /
    3))`. The truth holds `gain` and `phase_rad`, shape (..., channel), float64.

    Args:
        gain: Gain of each channel: numbers or values per trial, or one tensor of shape (...,
            channel).
        phase_rad: Phase of each channel in radians, in the same form.

    Raises:
        ValueError: If a number is not finite; when applied, if the numbers of gains and phases
            differ.
    """

    gain: Sequence[Tensor | float] | Tensor
    phase_rad: Sequence[Tensor | float] | Tensor

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data = recording.signal.data
        gain, phase = stacked(self.gain, data.device), stacked(self.phase_rad, data.device)
        if gain.shape[-1] != phase.shape[-1]:
            raise ValueError(
                f"channel imbalance needs as many gains as phases, got {gain.shape[-1]} and {phase.shape[-1]}"
            )
        factor = torch.polar(*torch.broadcast_tensors(gain, phase))
        channel = torch.arange(data.shape[-2], device=data.device) % gain.shape[-1]
        impaired = data * factor[..., channel, None].to(data.dtype)
        return with_samples(recording, impaired), {"gain": gain, "phase_rad": phase}
