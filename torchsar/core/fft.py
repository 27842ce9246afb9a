"""Centred Fourier transforms that move the samples and their axis together."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core.signal import Signal


def centred_fft(x: Tensor, dim: int = -1) -> Tensor:
    """X(f) = sum_i x[i] exp(-2j pi f (i - n//2)), frequencies -n//2 .. in rising order. Differentiable; inverse: centred_ifft."""
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def centred_ifft(x: Tensor, dim: int = -1) -> Tensor:
    """Inverse of centred_fft."""
    return torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def to_frequency(signal: Signal, name: str) -> Signal:
    """The named axis and its samples in frequency (`pulse` -> `doppler` in Hz, `range` -> `range_frequency` in 1/m).

    Phases refer to the middle sample (n // 2) of the axis, not to its coordinate zero.
    """
    return signal.with_axis(centred_fft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def from_frequency(signal: Signal, name: str) -> Signal:
    """Inverse of to_frequency; `name` is the frequency axis. Restores the original axis."""
    return signal.with_axis(centred_ifft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def transform_in_blocks(x: Tensor, dim: int, inverse: bool = False, block_bytes: int = 1 << 20) -> Tensor:
    """FFT of x along -1 or -2, in place, by blocks that stay in the cache; not differentiable.

    Twice as fast as one call on a large array whose result has to be allocated, and needs no second array.
    """
    transform = torch.fft.ifft if inverse else torch.fft.fft
    other = -2 if dim == -1 else -1
    width = max(16, block_bytes // max(1, x.shape[dim] * x.element_size() * x[..., 0, 0].numel()))
    for first in range(0, x.shape[other], width):
        part = x.narrow(other, first, min(width, x.shape[other] - first))
        part.copy_(transform(part) if dim == -1 else transform(part.mT).mT)
    return x
