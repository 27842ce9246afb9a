"""Where a raw matrix holds narrowband interference: range spectra against a robust level.

The level of a cell is (gain of its line) x (shape of the clean spectrum). The shape is a median over lines followed by a running median
over frequency, so that neither an interferer on all lines nor one that stays at its frequency lifts it; a running median leaves
the steep edges of the pulse band where they are. Source: brief 004, item 3; Tsvetkov 2017.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# In units of the mean level. Speckle is exponential: exp(-30) leaves one false cell in 1e13. The clean RADARSAT-1 blocks stay below 24.
THRESHOLD = 30.0
# An interferer wider than this share of the band is not narrowband; half of it is what a running median can still look past.
LEVEL_SHARE = 1 / 16


@dataclass(frozen=True)
class Level:
    """Robust mean power spectral density of the clean part of each line: gain (..., pulse) times shape (..., range), FFT order."""

    gain: Tensor
    shape: Tensor

    def at(self, cell: Tensor) -> Tensor:
        """Density at one frequency cell a line. cell: int64 (..., pulse) -> (..., pulse)."""
        return self.gain * self.shape.gather(-1, cell % self.shape.shape[-1])

    def excess(self, power: Tensor) -> Tensor:
        """Power spectra (..., pulse, range) over the level; 0 where a line is empty."""
        level = self.gain[..., None] * self.shape[..., None, :]
        return torch.where(level > 0, power / torch.where(level > 0, level, 1), 0)


def blackman_harris(n: int, like: Tensor) -> Tensor:
    """Four-term Blackman-Harris taper of unit mean square, (n,): side lobes at -92 dB keep a strong tone within +-4 cells."""
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64, device=like.device) / n
    w = 0.35875 - 0.48829 * torch.cos(turn) + 0.14128 * torch.cos(2 * turn) - 0.01168 * torch.cos(3 * turn)
    return (w / w.square().mean().sqrt()).to(like.real.dtype)


def line_spectra(raw: Tensor, oversampling: int = 1) -> Tensor:
    """Tapered power spectral density of each line, FFT order, (..., pulse, range) -> (..., pulse, oversampling * range)."""
    n = raw.shape[-1]
    spectrum = torch.fft.fft(raw * blackman_harris(n, raw), oversampling * n)
    return (spectrum.real.square() + spectrum.imag.square()) / n


def running_median(x: Tensor, width: int) -> Tensor:
    """Circular running median along the last dim over about `width` samples, of which at most 33 are looked at."""
    stride = max(1, round(width / 32))
    half = min(16, max(1, (x.shape[-1] - 1) // (2 * stride)))
    taps = stride * torch.arange(-half, half + 1, device=x.device)
    index = (torch.arange(x.shape[-1], device=x.device)[:, None] + taps) % x.shape[-1]
    return x[..., index].median(-1).values


def clean_level(power: Tensor) -> Level:
    """The level of the clean part of power spectra (..., pulse, range), so that the excess of speckle has unit mean."""
    width = max(32, round(LEVEL_SHARE * power.shape[-1]))

    def shape_for(gain: Tensor) -> Tensor:
        relative = torch.where(gain[..., None] > 0, power / torch.where(gain > 0, gain, 1)[..., None], torch.nan)
        return running_median(relative.nanmedian(-2).values.nan_to_num(0.0), width)

    # first lines against their mean, then against the median over the part of the band that holds signal
    shape = shape_for(power.median(-1).values)
    lit = shape > 0.1 * shape.amax(-1, keepdim=True)
    inside = torch.where(lit[..., None, :], power / torch.where(lit, shape, 1)[..., None, :], torch.nan)
    gain = inside.nanmedian(-1).values.nan_to_num(0.0)
    return Level(gain, shape_for(gain) / math.log(2))
