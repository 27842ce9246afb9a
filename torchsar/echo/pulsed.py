"""Raw echoes of pulsed radars, synthesised in range frequency by blocks of pulses and targets."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor


def echo_spectrum(
    delay_s: Tensor, carrier_turns: Tensor, weight: Tensor, n: int, step_hz: float, dtype: torch.dtype
) -> Tensor:
    """Sum over targets of weight * exp(-2j pi (carrier_turns + f delay)) on n frequencies f =
    (-n//2 ..) * step_hz.

    delay_s, carrier_turns: float64 (..., pulse, target); weight: complex (..., pulse, target) or
    broadcastable. Returns (..., pulse, n). exp(-2j pi f delay) separates into a coarse and a fine
    factor, so that the sum over targets is one batched matrix product: exact to the working
    precision, differentiable, and nothing of size targets x pulses x samples is ever formed.
    """
    m = 2 ** round(math.log2(max(n, 1)) / 2)
    turns = -delay_s * step_hz
    fine = linear_phasor(turns, 0, m, dtype)
    coarse = linear_phasor(m * turns, -(n // 2) / m, -(-n // m), dtype)
    coarse = coarse * (weight.to(dtype) * unit_phasor(-carrier_turns, dtype))[..., None]
    return (coarse.mT @ fine).flatten(-2)[..., :n]
