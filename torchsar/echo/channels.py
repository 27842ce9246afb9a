"""Receiver channels that record the lines in turn and are not alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording


@dataclass(frozen=True)
class ChannelImbalance:
    """Line i is multiplied by gain[c] exp(j phase_rad[c]), c = i mod the number of channels.

    gain, phase_rad: one number per channel, or tensors (..., C) with one row per trial. Even and
    odd lines as two channels: `ChannelImbalance(gain=(1, 1.2), phase_rad=(0, math.pi / 3))`.
    """

    gain: Sequence[float] | Tensor
    phase_rad: Sequence[float] | Tensor

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        data = recording.signal.data
        gain, phase = (torch.as_tensor(x, dtype=torch.float64, device=data.device) for x in (self.gain, self.phase_rad))
        if gain.shape[-1] != phase.shape[-1]:
            raise ValueError(
                f"channel imbalance needs as many gains as phases, got {gain.shape[-1]} and {phase.shape[-1]}"
            )
        factor = torch.polar(*torch.broadcast_tensors(gain, phase))
        channel = torch.arange(data.shape[-2], device=data.device) % gain.shape[-1]
        impaired = data * factor[..., channel, None].to(data.dtype)
        return replace(recording, signal=recording.signal.with_data(impaired)), {"gain": gain, "phase_rad": phase}
