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

    The spectrum is the sum over targets of weight exp(-2j pi (carrier_turns + f delay)) at the
    frequencies f = (-n//2, ...) step_hz. The factor exp(-2j pi f delay) separates into a coarse and
    a fine factor, so that the sum over targets is one batched matrix product. This is exact to the
    working precision and differentiable, and no array of targets times pulses times samples is
    formed.

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
