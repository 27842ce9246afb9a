"""Raw echoes of pulsed radars by synthesis in range frequency."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor


def echo_spectrum(
    delay_s: Tensor, carrier_turns: Tensor, weight: Tensor, n: int, step_hz: float, dtype: torch.dtype
) -> Tensor:
    """Return the range spectrum of a sum of delayed echoes.

    The spectrum is the sum over targets of weight exp(-2j pi (carrier_turns + f delay_s)) at the
    frequencies f = i step_hz with i = -(n // 2), ..., n - n // 2 - 1. The phasor of f is the
    product of one on a coarse grid and one on a fine grid of frequencies, so that the sum over
    targets is a batched matrix product. This is exact to the working precision and needs no array
    of targets times pulses times samples. Differentiable.

    Args:
        delay_s: Delay in seconds, shape (..., pulse, target), float64.
        carrier_turns: Phase of the carrier in cycles, shape (..., pulse, target), float64.
        weight: Complex weight, broadcastable to (..., pulse, target).
        n: Number of frequencies.
        step_hz: Step of the frequencies in hertz.
        dtype: Complex dtype of the result.

    Returns:
        Spectrum in rising order of the frequency, shape (..., pulse, n).
    """
    m = 2 ** round(math.log2(max(n, 1)) / 2)
    turns = -delay_s * step_hz
    fine = linear_phasor(turns, 0, m, dtype)
    coarse = linear_phasor(m * turns, -(n // 2) / m, -(-n // m), dtype)
    coarse = coarse * (weight.to(dtype) * unit_phasor(-carrier_turns, dtype))[..., None]
    return (coarse.mT @ fine).flatten(-2)[..., :n]
