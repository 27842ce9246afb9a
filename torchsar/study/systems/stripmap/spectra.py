"""Power spectra of one recording, for pictures and quick looks."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal

# lines that are transformed at once: a few megabytes of complex samples
_LINES = 256


def azimuth_spectrum(signal: Signal, bins: int = 256) -> tuple[Tensor, Tensor]:
    """Estimate the azimuth power spectrum of a recording, averaged over range.

    The spectrum is also averaged over segments of `bins` pulses, each weighted by a Hann window.

    Args:
        signal: Signal of one trial with the axes (pulse, range).
        bins: Number of pulses of a segment, and of Doppler bins of the result.

    Returns:
        Baseband Doppler frequency in Hz and power relative to its maximum, (bins,) each, float64.
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
    """Compute the range power spectrum of a recording, summed over all pulses.

    Args:
        signal: Signal of one trial with the axes (pulse, range).

    Returns:
        Power with zero frequency in the middle, (range,), float64.
    """
    power = torch.zeros(signal.axes[-1].n, dtype=torch.float64)
    for block in signal.data.split(_LINES):
        power += torch.fft.fft(block).abs().square().sum(0).double().cpu()
    return torch.fft.fftshift(power)


def phase_increments(signal: Signal, blocks: int = 64) -> tuple[Tensor, Tensor]:
    """Compute the mean phase increment from pulse to pulse in successive blocks of a recording.

    Args:
        signal: Signal of one trial with the axes (pulse, range).
        blocks: Number of blocks; increments are averaged over the pulses and range cells of each.

    Returns:
        Slow time of the blocks in seconds and phase increments in radians, (block,) each, float64.
    """
    pulse = signal.axes[-2]
    blocks = min(blocks, max(1, (pulse.n - 1) // 2))
    product = (signal.data[:-1].conj() * signal.data[1:]).sum(-1).to(torch.complex128).cpu()
    index = torch.arange(pulse.n - 1, dtype=torch.float64).tensor_split(blocks)
    centres = torch.stack([pulse.start + pulse.step * (part.mean() + 0.5) for part in index])
    return centres, torch.stack([torch.angle(part.sum()) for part in product.tensor_split(blocks)])
