"""Detection of narrowband interference: range spectra of raw lines against a robust level.

The level of a frequency cell is its power without interference. The larger of two estimates is
used. The first is the gain of the line times a clean spectrum that all lines share: a median over
lines, followed by a running median over frequency. The median over lines rejects interferers whose
frequency changes from line to line. The running median rejects narrowband interferers of constant
frequency, and preserves the steep edges of the pulse band. The second estimate is the median over
neighbouring cells of the line's own spectrum. It is needed for lines without an echo, whose
spectrum has another shape than that of lines with an echo.

Reference:
    Tsvetkov 2017, Fig. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import power_of

# In units of the mean level. Speckle is exponential: exp(-30) leaves one false cell in 1e13. The
# clean RADARSAT-1 blocks stay below 24.
THRESHOLD = 30.0
# Width of the running median over the band, by choice: an interferer of half of it does not raise
# the median; one that is wider than this is not narrowband.
LEVEL_SHARE = 1 / 16


@dataclass(frozen=True)
class Level:
    """Robust mean power spectral density that each line has without interference.

    Args:
        density: Power of each frequency cell in FFT order, shape (..., pulse, range).
    """

    density: Tensor

    def at(self, cell: Tensor) -> Tensor:
        """Return the power spectral density without interference at one frequency cell per line.

        Args:
            cell: Index of one FFT cell for each line, shape (..., pulse), int64.

        Returns:
            Density, shape (..., pulse).
        """
        return self.density.gather(-1, (cell % self.density.shape[-1])[..., None])[..., 0]

    def excess(self, power: Tensor) -> Tensor:
        """Return power spectra divided by the level, cell by cell.

        Args:
            power: Power spectra in FFT order, shape (..., pulse, range).

        Returns:
            Power ratios of the same shape; 0 where a line is empty.
        """
        return torch.where(self.density > 0, power / torch.where(self.density > 0, self.density, 1), 0)

    def lines(self, index: Tensor) -> Level:
        """Return the level of selected lines.

        Args:
            index: Indices of the lines, shape (..., count), int64.

        Returns:
            Level of these lines in the order of the indices.
        """
        return Level(self.density.gather(-2, index[..., None].expand(*index.shape, self.density.shape[-1])))


def blackman_harris(n: int, like: Tensor) -> Tensor:
    """Return the four-term Blackman-Harris taper with unit mean square.

    Its side lobes of -92 dB confine a strong tone to +-4 cells.

    Args:
        n: Number of samples.
        like: Tensor that gives device and precision.

    Returns:
        Shape (n,), real.
    """
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64, device=like.device) / n
    w = 0.35875 - 0.48829 * torch.cos(turn) + 0.14128 * torch.cos(2 * turn) - 0.01168 * torch.cos(3 * turn)
    return (w / w.square().mean().sqrt()).to(like.real.dtype)


def line_spectra(raw: Tensor, oversampling: int = 1) -> Tensor:
    """Compute the tapered power spectral density of each line.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        oversampling: FFT length over the number of samples of a line.

    Returns:
        Density in FFT order, shape (..., pulse, oversampling * range).
    """
    n = raw.shape[-1]
    spectrum = torch.fft.fft(raw * blackman_harris(n, raw), oversampling * n)
    return power_of(spectrum) / n


def running_median(x: Tensor, width: int) -> Tensor:
    """Compute a circular running median along the last dimension.

    Each median is taken from at most 33 samples that are spread evenly over the window.

    Args:
        x: Shape (..., n), real.
        width: Approximate width of the window in samples.

    Returns:
        Same shape.
    """
    stride = max(1, round(width / 32))
    half = min(16, max(1, (x.shape[-1] - 1) // (2 * stride)))
    taps = stride * torch.arange(-half, half + 1, device=x.device)
    index = (torch.arange(x.shape[-1], device=x.device)[:, None] + taps) % x.shape[-1]
    return x[..., index].median(-1).values


def local_median(power: Tensor, width: int) -> Tensor:
    """Return for each cell the larger of the medians of the two windows that contain it.

    Successive windows overlap by half, so that every cell lies in two of them.

    Args:
        power: Power spectrum, taken as circular, shape (..., n).
        width: Width of the windows in cells.

    Returns:
        Medians, same shape.
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
    """Estimate the mean power spectral density that power spectra have without interference.

    Args:
        power: Power spectra in FFT order, shape (..., pulse, range).

    Returns:
        Level; the power of speckle divided by it has unit mean.
    """
    width = max(32, round(LEVEL_SHARE * power.shape[-1]))

    def shape_for(gain: Tensor) -> Tensor:
        relative = torch.where(gain[..., None] > 0, power / torch.where(gain > 0, gain, 1)[..., None], torch.nan)
        return running_median(relative.nanmedian(-2).values.nan_to_num(0.0), width)

    # lines relative to their median over the whole band, then over the part that holds signal
    shape = shape_for(power.median(-1).values)
    lit = shape > 0.1 * shape.amax(-1, keepdim=True)
    inside = torch.where(lit[..., None, :], power / torch.where(lit, shape, 1)[..., None, :], torch.nan)
    gain = inside.nanmedian(-1).values.nan_to_num(0.0)
    common = gain[..., None] * shape_for(gain)[..., None, :]
    return Level(torch.maximum(common, local_median(power, width)) / math.log(2))


def stands_out(excess: Tensor, threshold: float = THRESHOLD) -> Tensor:
    """Find lines that exceed the threshold in few parts of the band.

    Echoes of regularly spaced targets make many spectral peaks of similar strength over the whole
    pulse band, interferers only a few. The band is divided into 32 parts; a line is selected if at
    most a quarter of them contain a cell within 10 dB of its strongest cell.

    Args:
        excess: Power spectra divided by the level of clutter, shape (..., pulse, range).
        threshold: Smallest excess of the strongest cell of a selected line.

    Returns:
        True for selected lines, shape (..., pulse), bool.
    """
    n = excess.shape[-1]
    part = -(-n // 32)
    parts = torch.nn.functional.pad(excess, (0, -n % part)).unflatten(-1, (-1, part)).amax(-1)
    peak = parts.amax(-1, keepdim=True)
    busy = parts > torch.maximum(0.1 * peak, torch.full_like(peak, threshold / 2))
    return (peak[..., 0] > threshold) & (busy.sum(-1) <= busy.shape[-1] // 4)
