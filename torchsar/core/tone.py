"""The strongest tone of pulses: a constant of the receiver, leakage or a spur."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core.phase import linear_phasor


class Tone(NamedTuple):
    """Tone A exp(2j pi (f n + g k)) of the samples n of the pulses k, shape (...,) each.

    Args:
        amplitude: Amplitude A, complex.
        sample_cycles: Frequency f in cycles per sample, -0.5..0.5, float64.
        pulse_cycles: Frequency g in cycles per pulse, -0.5..0.5, float64.
        share: Share of the energy of the samples that the tone explains, 0..1.
        excess: Power of the cell (f, g) of the spectrum over the mean power of the cells of the
            same f, or of those of the same g if these have more. In noise it is about the
            logarithm of the number of cells; an echo fills all cells of one of both.
    """

    amplitude: Tensor
    sample_cycles: Tensor
    pulse_cycles: Tensor
    share: Tensor
    excess: Tensor

    def samples(self, n_pulse: int, n: int) -> Tensor:
        """The tone in n samples of each of n_pulse pulses, shape (..., n_pulse, n)."""
        dtype = self.amplitude.dtype
        pulse, sample = (
            linear_phasor(self.pulse_cycles, 0, n_pulse, dtype),
            linear_phasor(self.sample_cycles, 0, n, dtype),
        )
        return self.amplitude[..., None, None] * pulse[..., :, None] * sample[..., None, :]


def strongest_tone(x: Tensor, rounds: int = 0) -> Tone:
    """Find the strongest tone of pulses, with one frequency along samples and one along pulses.

    The frequency along samples is that whose power exceeds the mean of its neighbours most, in at
    most 128 of the pulses. The frequency along pulses is found in the spectrum at that frequency.

    Args:
        x: Samples, shape (..., pulse, sample), complex.
        rounds: Number of refinements of both frequencies, whose error is at first a quarter of a
            cell or less.

    Returns:
        The tone.
    """
    n_pulse, n = x.shape[-2:]
    lines = x[..., :: max(1, n_pulse // 128), :]
    power = torch.fft.fft(lines, 2 * n).abs().square().sum(-2)
    # mean power over eight cells on each side
    half = max(1, min(16, n - 1))
    total = pad(torch.cat([power[..., -half:], power, power[..., :half]], -1), (1, 0)).cumsum(-1)
    around = (total[..., 2 * half + 1 :] - total[..., : -2 * half - 1]) / (2 * half + 1)
    f = (power - around).argmax(-1).to(torch.float64) / (2 * n)
    along = (x @ linear_phasor(-f, 0, n, x.dtype)[..., None])[..., 0]
    spectrum = torch.fft.fft(along, 2 * n_pulse).abs().square()
    g = spectrum.argmax(-1).to(torch.float64) / (2 * n_pulse)
    across = (linear_phasor(-g, 0, n_pulse, x.dtype)[..., None, :] @ x)[..., 0, :]
    for _ in range(rounds):
        g = g + _offset(along * linear_phasor(-g, 0, n_pulse, x.dtype))
        across = (linear_phasor(-g, 0, n_pulse, x.dtype)[..., None, :] @ x)[..., 0, :]
        f = f + _offset(across * linear_phasor(-f, 0, n, x.dtype))
        along = (x @ linear_phasor(-f, 0, n, x.dtype)[..., None])[..., 0]
    amplitude = (along * linear_phasor(-g, 0, n_pulse, x.dtype)).sum(-1) / (n * n_pulse)
    energy, tiny = x.abs().square().sum((-2, -1)), torch.finfo(power.dtype).tiny
    peak = amplitude.abs().square() * (n * n_pulse)
    others = [row.abs().square().sum(-1) / m - peak / k for row, m, k in ((along, n, n_pulse), (across, n_pulse, n))]
    counts = (n_pulse - 1, n - 1)
    level = torch.maximum(*(rest.clamp_min(0) / max(1, count) for rest, count in zip(others, counts, strict=True)))
    f, g = (cycles - torch.round(cycles) for cycles in (f, g))
    return Tone(amplitude, f, g, peak / energy.clamp_min(tiny), peak / level.clamp_min(tiny))


def _offset(x: Tensor) -> Tensor:
    """Frequency (...,) in cycles per sample of nearly constant x (..., n), from both halves."""
    half = x.shape[-1] // 2
    turned = x[..., x.shape[-1] - half :].sum(-1) * x[..., :half].sum(-1).conj()
    return turned.angle().to(torch.float64) / (2 * math.pi * max(1, x.shape[-1] - half))
