"""Detection of narrowband interference in raw lines.

The power of each cell of the range spectrum is compared with its level, the power without
interference. The level is the larger of two estimates. The first is the gain of the line times a
clean spectrum that all lines share: a median over lines, followed by a local median over frequency.
The median over lines rejects interferers whose frequency changes from line to line; the local
median rejects narrowband interferers of constant frequency, and preserves the steep edges of the
pulse band. The second is the local median of the line's own spectrum. It is needed for lines
without an echo, whose spectrum has another shape than that of lines with an echo. Regularly spaced
targets also make narrow spectral peaks. A line is therefore treated only if the energy near its
peak lasts most of the line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import checked_samples, host_value, power_of, unit_level

# Power in units of the mean level above which a cell may contain interference. The power of speckle
# is exponential, so that exp(-30) gives one false cell in 1e13. In the clean RADARSAT-1 blocks, all
# cells are below 24.
THRESHOLD = 30.0
# Least median over mean power of the blocks of a line with which its energy counts as lasting. It
# is 1 for a tone, 0.7 for noise-like interference, and near 0 for chirps that sweep through the
# frequency. It is also the least share of the coherence that is expected of a tone.
LASTING = 0.35


@dataclass(frozen=True)
class Contamination:
    """Lines and range-frequency cells that may hold interference.

    Args:
        density: Robust estimate of the power spectral density without interference, in FFT order,
            for lines divided by the level of their trial (`torchsar.core.level_of`), shape (...,
            pulse, range).
        excess: Power spectra divided by the density, same shape.
        cells: Cells whose excess is above the threshold, same shape, bool.
        lines: Lines whose spectrum has a narrow peak above the threshold, shape (..., pulse), bool.
    """

    density: Tensor
    excess: Tensor
    cells: Tensor
    lines: Tensor


@torch.no_grad()
def find_contamination(raw: Tensor, threshold: float = THRESHOLD) -> Contamination:
    """Find range-frequency cells with more power than clutter has, and the lines that hold them.

    >>> import torch
    >>> raw = torch.randn(64, 256, dtype=torch.complex64)
    >>> raw[3] += 10 * torch.exp(2j * torch.pi * 0.2 * torch.arange(256))
    >>> find_contamination(raw).lines.nonzero()[:, 0].tolist()
    [3]

    Power is compared with a robust estimate of the clutter's spectrum. The lines found are only
    candidates: regularly spaced targets also make narrow spectral peaks, so the corrections test in
    addition that the energy of a peak lasts the whole line.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Contamination`, which marks cells (..., pulse, range) and lines (..., pulse).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    power = line_spectra(unit_level(checked_samples(raw, "find_contamination", "pulse, range")))
    density = _clean_density(power)
    excess = excess_of(power, density)
    return Contamination(density, excess, excess > threshold, stands_out(excess, threshold))


def anything(mask: Tensor) -> bool:
    """Return whether any entry of a mask is True.

    Args:
        mask: Any shape, bool.

    Returns:
        The answer; True inside torch.vmap, where values cannot be read.
    """
    return host_value(mask.any(), True)


def line_spectra(raw: Tensor, oversampling: int = 1) -> Tensor:
    """Compute the power spectral density of each line.

    The four-term Blackman-Harris taper, whose side lobes are at -92 dB, confines a strong tone to
    +-4 cells.

    Args:
        raw: Lines, shape (..., pulse, range), complex.
        oversampling: Number of frequency cells for each sample of a line.

    Returns:
        Densities in FFT order, shape (..., pulse, oversampling * range).
    """
    n = raw.shape[-1]
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64, device=raw.device) / n
    w = 0.35875 - 0.48829 * torch.cos(turn) + 0.14128 * torch.cos(2 * turn) - 0.01168 * torch.cos(3 * turn)
    taper = (w / w.square().mean().sqrt()).to(raw.real.dtype)
    return power_of(torch.fft.fft(raw * taper, oversampling * n)) / n


def excess_of(power: Tensor, density: Tensor) -> Tensor:
    """Divide power spectra by the density, cell by cell.

    Args:
        power: Power spectra, shape (..., pulse, range).
        density: Their density without interference, same shape.

    Returns:
        Quotients, same shape; 0 where a line is empty.
    """
    return torch.where(density > 0, power / torch.where(density > 0, density, 1), 0)


def _local_median(power: Tensor, width: int) -> Tensor:
    """Larger one of the medians of the two windows that contain a cell; windows overlap by half."""
    n = power.shape[-1]
    width = min(width, n)
    hop = max(1, width // 2)
    around_the_end = torch.cat([power[..., n - hop :], power, power[..., :width]], -1)
    windows = around_the_end.unfold(-1, width, hop)[..., : -(-n // hop) + 1, :].median(-1).values
    return torch.maximum(windows[..., :-1], windows[..., 1:]).repeat_interleave(hop, -1)[..., :n]


def _clean_density(power: Tensor) -> Tensor:
    """Mean power spectral density of spectra (..., pulse, range) without interference.

    The power of speckle divided by it has a mean of one.
    """
    # Width of the local median over the band, by choice. An interferer of half this width does not
    # raise the median, and a wider one is not narrowband.
    width = max(32, round(power.shape[-1] / 16))

    def shape_for(gain: Tensor) -> Tensor:
        relative = torch.where(gain[..., None] > 0, power / torch.where(gain > 0, gain, 1)[..., None], torch.nan)
        return _local_median(relative.nanmedian(-2).values.nan_to_num(0.0), width)

    # lines are divided by their median over the whole band, then over the part that contains signal
    shape = shape_for(power.median(-1).values)
    lit = shape > 0.1 * shape.amax(-1, keepdim=True)
    inside = torch.where(lit[..., None, :], power / torch.where(lit, shape, 1)[..., None, :], torch.nan)
    gain = inside.nanmedian(-1).values.nan_to_num(0.0)
    common = gain[..., None] * shape_for(gain)[..., None, :]
    return torch.maximum(common, _local_median(power, width)) / math.log(2)


def stands_out(excess: Tensor, threshold: float) -> Tensor:
    """Find lines that exceed the threshold in few parts of the band.

    Echoes of regularly spaced targets make many spectral peaks of similar strength over the whole
    pulse band, interferers only a few. The band is divided into 32 parts; a line is selected if at
    most a quarter of them contain a cell within 10 dB of its strongest cell.

    Args:
        excess: Power spectra over their density, shape (..., pulse, range).
        threshold: Least excess of the strongest cell.

    Returns:
        Lines, shape (..., pulse), bool.
    """
    n = excess.shape[-1]
    part = -(-n // 32)
    parts = pad(excess, (0, -n % part)).unflatten(-1, (-1, part)).amax(-1)
    peak = parts.amax(-1, keepdim=True)
    busy = parts > torch.maximum(0.1 * peak, torch.full_like(peak, threshold / 2))
    return (peak[..., 0] > threshold) & (busy.sum(-1) <= busy.shape[-1] // 4)


def block_sums(x: Tensor) -> Tensor:
    """Sum the samples of short blocks, which keeps frequencies near zero.

    Args:
        x: Samples, shape (..., n), complex.

    Returns:
        Sums, shape (..., block). A line of 64 samples or more has about 64 to 128 blocks.
    """
    n = x.shape[-1]
    length = 2 ** math.ceil(math.log2(max(1, n / 128))) if n >= 1024 else max(1, n // 64)
    return pad(x, (0, -n % length)).unflatten(-1, (-1, length)).sum(-1)
