"""Interference with a bandwidth: Wiener estimate of a narrowband random process, subtracted.

A group of successive lines shares one spectrum of the interferer: the excess of their averaged
range spectra over clutter. Each line is modelled as a stationary process with that spectrum plus
white clutter, and the conditional mean of the process is subtracted. The model accounts for the
finite length of a line: its n samples are a part of a process with the period 2 n. The spectral
leakage of a strong interferer is therefore subtracted as well, which a notch filter cannot do.
Clutter inside the band is lost with the interference: for lines of duration T, a band of width B
costs about B T frequency cells, and a few more at the band edges.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import cholesky_factor
from torchsar.repair.interference_detect import LEVEL_SHARE, THRESHOLD, Level, line_spectra, stands_out
from torchsar.repair.interference_tone import anything, block_sums, window_sums

# Lines that share one spectrum, by choice: more lines estimate it better, fewer follow a changing
# interferer.
STRETCH_LINES = 32


def lasts_the_line(lines: Tensor, cell: Tensor) -> Tensor:
    """Return whether the energy near one frequency cell is present during most of the line.

    The line is demodulated to the cell and divided into short blocks. The ratio of the median to
    the mean power of the blocks is 0.7 for noise-like interference, 1 for a tone, and near 0 for a
    few chirps that sweep through the frequency of the cell. It must exceed 0.35.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        cell: Index of one FFT cell for each line, shape (..., pulse), int64.

    Returns:
        True where the energy lasts, shape (..., pulse), bool.
    """
    n = lines.shape[-1]
    turns = (cell.to(torch.float64) / n)[..., None] * torch.arange(n, dtype=torch.float64, device=lines.device)
    angle = (2 * torch.pi * (turns - torch.round(turns))).to(lines.real.dtype)
    power = block_sums(lines * torch.polar(torch.ones_like(angle), -angle)).abs().square()
    return power.median(-1).values > 0.35 * power.mean(-1)


def find_band(lines: Tensor, level: Level, threshold: float = THRESHOLD) -> tuple[Tensor, Tensor]:
    """Find lines with interference that lasts the whole line.

    A single line of noise-like interference may look intermittent. A line therefore counts only if
    the interference lasts in most of the neighbouring lines that exceed the threshold.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        level: Robust estimate of the power spectral density without interference.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        Lines with interference, shape (..., pulse), bool, and the index of the strongest FFT cell
        of each line, shape (..., pulse), int64.
    """
    excess = level.excess(line_spectra(lines.detach()))
    strong, cell = stands_out(excess, threshold), excess.argmax(-1)
    if not anything(strong):
        return strong, cell
    near = window_sums(STRETCH_LINES // 2)
    votes = near((strong & lasts_the_line(lines.detach(), cell)).to(torch.float64))
    return strong & (votes > 0.5 * near(strong.to(torch.float64))), cell


def subtract_band(lines: Tensor, touched: Tensor, level: Level) -> Tensor:
    """Subtract the interference near the strongest frequency cell of each group of 32 lines.

    Differentiable in the lines, with the spectrum of the interference held fixed.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        touched: Lines with interference, as found by `find_band`, shape (..., pulse), bool; the
            other lines are unchanged.
        level: Robust estimate of the power spectral density without interference.

    Returns:
        Lines of the same shape.
    """
    n_pulse = lines.shape[-2]
    fill = -n_pulse % STRETCH_LINES
    x = pad(lines, (0, 0, 0, fill)).unflatten(-2, (-1, STRETCH_LINES))
    on = pad(touched, (0, fill)).unflatten(-1, (-1, STRETCH_LINES))
    excess = _mean_excess(x.detach(), on, level)
    first, ratio = _window(excess, lines.shape[-1])
    wave = _process(x, first, ratio) * on[..., None]
    return lines - wave.flatten(-3, -2)[..., :n_pulse, :]


def _mean_excess(x: Tensor, on: Tensor, level: Level) -> Tensor:
    """Spectrum over the level at half cells, mean of the marked lines of a group, (..., 2 n)."""
    density = pad(level.density, (0, 0, 0, -level.density.shape[-2] % STRETCH_LINES)).unflatten(-2, (-1, STRETCH_LINES))
    total = torch.zeros(*x.shape[:-2], 2 * x.shape[-1], dtype=x.real.dtype, device=x.device)
    # one line of every group at a time: a fraction of the memory of all at once
    for k in range(STRETCH_LINES):
        fine = density[..., k, :].repeat_interleave(2, -1)
        usable = on[..., k, None] & (fine > 0)
        total = total + torch.where(usable, line_spectra(x[..., k, :], 2) / torch.where(usable, fine, 1), 0)
    return total / on.sum(-1).clamp_min(1)[..., None]


def _window(excess: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """First half cell of the band around the strongest one, and interferer over clutter."""
    m = 2 * max(8, round(n * LEVEL_SHARE / 2))
    smooth = torch.nn.functional.avg_pool1d(pad(excess.flatten(0, -2)[:, None], (2, 2), mode="circular"), 5, 1)[
        :, 0
    ].reshape(excess.shape)
    first = (smooth.argmax(-1) - m // 2) % excess.shape[-1]
    index = (first[..., None] + torch.arange(m, device=excess.device)) % excess.shape[-1]
    ratio = smooth.gather(-1, index) - 1
    return first, torch.where(ratio > 1, ratio, 0)


def _process(x: Tensor, first: Tensor, ratio: Tensor) -> Tensor:
    """Conditional mean of a process on m half cells from `first`, given lines x.

    x: (..., group, line, n); first: (..., group); ratio: (..., group, m), spectrum over white
    clutter. The prior covariance is C = F diag(ratio) F^H with F from the inverse DFT of 2 n
    points, and C (C + 1)^-1 x = F q (1 + q F^H F q)^-1 q F^H x with q^2 = ratio: an m x m solve per
    group.
    """
    n, m = x.shape[-1], ratio.shape[-1]
    index = (first[..., None] + torch.arange(m, device=x.device)) % (2 * n)
    index = index[..., None, :].expand(*x.shape[:-1], m)
    # in double precision: the condition of the small system is the power of the interferer over
    # that of the clutter
    root, wide = torch.sqrt(ratio.to(torch.float64)), torch.complex128
    projected = torch.fft.fft(x, 2 * n, norm="ortho").gather(-1, index).to(wide) * root[..., None, :]
    lag = torch.arange(m, device=x.device)
    overlap = torch.fft.ifft(pad(torch.ones(n, dtype=wide, device=x.device), (0, n)))[
        (lag[None, :] - lag[:, None]) % (2 * n)
    ]
    system = root[..., :, None] * overlap * root[..., None, :] + torch.eye(m, dtype=wide, device=x.device)
    solved = torch.cholesky_solve(projected.mT, cholesky_factor(system)).mT * root[..., None, :]
    spectrum = torch.zeros(*x.shape[:-1], 2 * n, dtype=x.dtype, device=x.device).scatter(-1, index, solved.to(x.dtype))
    return torch.fft.ifft(spectrum, norm="ortho")[..., :n]
