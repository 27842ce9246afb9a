"""Alignment of the envelopes of pulses in range, ahead of any estimate of their phases (brief 002, section 9).

A shift counts towards greater range, against what the pulses have in common, in cells of the circular range window. It is to be removed:
`shift_range(data, -shift_cells)`. Envelopes are powers |s|^2 on a grid of half cells, where they are band-limited, so that shifts by any
fraction are exact, and each is divided by its own mean: neither the phase nor the gain of a pulse can change its shift.

Cells of a target of many scatterers are speckle: their power in a pulse is exponential about the mean T of all pulses, noise included. The
likelihood of a shift is then the correlation of |s|^2 with -1 / T, and not with T or |s|: it is what makes low SNR possible here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.stages import correct_pulse_phase
from torchsar.core import Estimate, Signal, Stage, block_bytes_of, legendre, linear_phasor, per_trial, real_dtype, refuse_non_finite, take
from torchsar.optim.descent import lbfgs

Match = Literal["likelihood", "amplitude"]
_FINE = 2  # samples a cell: |s|^2 has twice the band of s
_FLOOR = 1e-2  # of the mean power, least power of a cell that the likelihood believes
_BLOCKS = 16
_LEAST_RISE = 8.0


def shift_range(data: Tensor, shift_cells: Tensor | float) -> Tensor:
    """Every pulse moved by its shift towards greater range, circularly. data: (..., pulse, range) complex; shift_cells: (..., pulse), (pulse,) or a number.

    A linear phase about the centre of fast time (the middle of the band), so that the phase of an echo does not turn with its place. Unitary:
    shift_range(., -s) undoes shift_range(., s) exactly. Differentiable in both. Raises ValueError for any other shape of the shifts.
    """
    n = data.shape[-1]
    shift = torch.as_tensor(shift_cells, dtype=torch.float64, device=data.device)
    if shift.ndim and shift.shape[-1] != data.shape[-2]:
        raise ValueError(f"one shift per pulse is needed, (..., {data.shape[-2]}), got {tuple(shift.shape)}")
    phasor = torch.fft.ifftshift(linear_phasor(-shift / n, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)
