"""Power spectra of one recording, for pictures and quick looks."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal

# lines that are transformed at once: a few megabytes of complex samples
_LINES = 256


def azimuth_spectrum(signal: Signal, bins: int = 256) -> tuple[Tensor, Tensor]:
    """Mean azimuth power spectrum over range.

    Averaged over segments of `bins` lines under a raised-cosine window.

    Args:
        signal: Signal without trial dims, axes (pulse, range).
        bins: Lines of a segment.

    Returns:
        Baseband Doppler in Hz and power over its maximum, (bins,) each, float64.
    """
    data, pulse = signal.data, signal.axes[-2]
    bins = min(bins, pulse.n)
    window = torch.hann_window(bins, dtype=data.real.dtype, device=data.device)[:, None]
    power = torch.zeros(bins, dtype=torch.float64)
    for segment in data[: pulse.n // bins * bins].unflatten(0, (-1, bins)):
        power += torch.fft.fft(segment * window, dim=0).abs().square().sum(-1).double().cpu()
    frequency = torch.fft.fftshift(torch.fft.fftfreq(bins, pulse.step, dtype=torch.float64))
    return frequency, torch.fft.fftshift(power) / power.max().clamp_min(1e-300)


def range_spectrum(signal: Signal) -> Tensor:
    """Range power spectrum summed over all lines.

    Args:
        signal: Signal without trial dims, axes (pulse, range).

    Returns:
        Power with zero frequency in the middle, (range,), float64.
    """
    power = torch.zeros(signal.axes[-1].n, dtype=torch.float64)
    for block in signal.data.split(_LINES):
        power += torch.fft.fft(block).abs().square().sum(0).double().cpu()
    return torch.fft.fftshift(power)


def phase_increments(signal: Signal, blocks: int = 64) -> tuple[Tensor, Tensor]:
    """Mean phase increments between adjacent lines along a strip.

    Args:
        signal: Signal without trial dims, axes (pulse, range).
        blocks: Blocks of lines over which the increments are averaged.

    Returns:
        Slow time of the blocks in s and the increments in rad, (block,) each, float64.
    """
    pulse = signal.axes[-2]
    blocks = min(blocks, max(1, (pulse.n - 1) // 2))
    product = (signal.data[:-1].conj() * signal.data[1:]).sum(-1).to(torch.complex128).cpu()
    index = torch.arange(pulse.n - 1, dtype=torch.float64).tensor_split(blocks)
    centres = torch.stack([pulse.start + pulse.step * (part.mean() + 0.5) for part in index])
    return centres, torch.stack([torch.angle(part.sum()) for part in product.tensor_split(blocks)])
