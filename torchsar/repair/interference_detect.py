"""Where a raw matrix holds narrowband interference: range spectra against a robust level.

The level of a cell is the larger of two. One is the gain of its line times the shape of the clean
spectrum, a median over lines followed by a running median over frequency, so that neither an
interferer on all lines nor one that stays at its frequency lifts it; a running median leaves the
steep edges of the pulse band where they are. The other is the median over the neighbourhood in the
line's own spectrum: lines without echo have another shape than lines with. Source: brief 004, item
3; Tsvetkov 2017.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# In units of the mean level. Speckle is exponential: exp(-30) leaves one false cell in 1e13. The
# clean RADARSAT-1 blocks stay below 24.
THRESHOLD = 30.0
# An interferer wider than this share of the band is not narrowband; half of it is what a running
# median can still look past.
LEVEL_SHARE = 1 / 16


@dataclass(frozen=True)
class Level:
    """Robust mean power spectral density of the clean part of each line, (..., pulse, range) in FFT
    order.
    """

    density: Tensor

    def at(self, cell: Tensor) -> Tensor:
        """Density at one frequency cell a line. cell: int64 (..., pulse) -> (..., pulse)."""
        return self.density.gather(-1, (cell % self.density.shape[-1])[..., None])[..., 0]

    def excess(self, power: Tensor) -> Tensor:
        """Power spectra (..., pulse, range) over the level; 0 where a line is empty."""
        return torch.where(self.density > 0, power / torch.where(self.density > 0, self.density, 1), 0)

    def lines(self, index: Tensor) -> Level:
        """The level of some lines. index: int64 (..., count)."""
        return Level(self.density.gather(-2, index[..., None].expand(*index.shape, self.density.shape[-1])))


def blackman_harris(n: int, like: Tensor) -> Tensor:
    """Four-term Blackman-Harris taper of unit mean square, (n,): side lobes at -92 dB keep a strong
    tone within +-4 cells.
    """
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64, device=like.device) / n
    w = 0.35875 - 0.48829 * torch.cos(turn) + 0.14128 * torch.cos(2 * turn) - 0.01168 * torch.cos(3 * turn)
    return (w / w.square().mean().sqrt()).to(like.real.dtype)


def line_spectra(raw: Tensor, oversampling: int = 1) -> Tensor:
    """Tapered power spectral density of each line, FFT order, (..., pulse, range) -> (..., pulse,
    oversampling * range).
    """
    n = raw.shape[-1]
    spectrum = torch.fft.fft(raw * blackman_harris(n, raw), oversampling * n)
    return (spectrum.real.square() + spectrum.imag.square()) / n


def running_median(x: Tensor, width: int) -> Tensor:
    """Circular running median along the last dim over about `width` samples, of which at most 33
    are looked at.
    """
    stride = max(1, round(width / 32))
    half = min(16, max(1, (x.shape[-1] - 1) // (2 * stride)))
    taps = stride * torch.arange(-half, half + 1, device=x.device)
    index = (torch.arange(x.shape[-1], device=x.device)[:, None] + taps) % x.shape[-1]
    return x[..., index].median(-1).values


def local_median(power: Tensor, width: int) -> Tensor:
    """The larger median of the two half-overlapping windows that hold each cell of a circular
    spectrum. Same shape as power.
    """
    n = power.shape[-1]
    width = min(width, n)
    hop = max(1, width // 2)
    count = -(-n // hop)
    around_the_end = torch.cat([power[..., n - hop :], power, power[..., :width]], -1)
    windows = around_the_end.unfold(-1, width, hop)[..., : count + 1, :].median(-1).values
    pair = torch.maximum(windows[..., :-1], windows[..., 1:])
    return pair.repeat_interleave(hop, -1)[..., :n]


def clean_level(power: Tensor) -> Level:
    """The level of the clean part of power spectra (..., pulse, range), so that the excess of
    speckle has unit mean.
    """
    width = max(32, round(LEVEL_SHARE * power.shape[-1]))

    def shape_for(gain: Tensor) -> Tensor:
        relative = torch.where(gain[..., None] > 0, power / torch.where(gain > 0, gain, 1)[..., None], torch.nan)
        return running_median(relative.nanmedian(-2).values.nan_to_num(0.0), width)

    # first lines against their mean, then against the median over the part of the band that holds
    # signal
    shape = shape_for(power.median(-1).values)
    lit = shape > 0.1 * shape.amax(-1, keepdim=True)
    inside = torch.where(lit[..., None, :], power / torch.where(lit, shape, 1)[..., None, :], torch.nan)
    gain = inside.nanmedian(-1).values.nan_to_num(0.0)
    common = gain[..., None] * shape_for(gain)[..., None, :]
    return Level(torch.maximum(common, local_median(power, width)) / math.log(2))


def stands_out(excess: Tensor, threshold: float = THRESHOLD) -> Tensor:
    """Lines with cells above the threshold in few places, (..., pulse, range) -> (..., pulse) bool.

    Echoes of regularly spaced targets make combs of spectral lines, all about as strong, over the
    whole pulse band. Interferers are few: a line qualifies where at most a quarter of 32 parts of
    the band come within 10 dB of its strongest cell.
    """
    n = excess.shape[-1]
    part = -(-n // 32)
    parts = torch.nn.functional.pad(excess, (0, -n % part)).unflatten(-1, (-1, part)).amax(-1)
    peak = parts.amax(-1, keepdim=True)
    busy = parts > torch.maximum(0.1 * peak, torch.full_like(peak, threshold / 2))
    return (peak[..., 0] > threshold) & (busy.sum(-1) <= busy.shape[-1] // 4)
