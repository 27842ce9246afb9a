"""Interferers with a bandwidth of their own: a Wiener estimate of a narrowband random process,
subtracted.

A stretch of lines shares one spectrum of the interferer, estimated as the excess of their averaged
range spectra. The line is then the sum of a stationary process with that spectrum and of white
clutter, and the conditional mean of the process is subtracted. The finite length of a line is part
of the model (a process on 2 n periodic samples seen through n of them), so the skirts that a strong
interferer throws over the whole spectrum, which no notch removes, go with it. Cost: the degrees of
freedom of the band, about one for each 1 / line duration of bandwidth and a few for the edges.
Source: brief 004, item 3.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.repair.interference_detect import LEVEL_SHARE, THRESHOLD, Level, line_spectra, stands_out
from torchsar.repair.interference_tone import anything, block_sums, window_sums

STRETCH_LINES = 32


def lasts_the_line(lines: Tensor, cell: Tensor) -> Tensor:
    """Whether the energy near one cell a line is there most of the time, (..., pulse, range), (...,
    pulse) -> (..., pulse) bool.

    Noise-like interference has a median of 0.7 of its mean power, a tone of 1; a few passing chirps
    one near 0.
    """
    n = lines.shape[-1]
    turns = (cell.to(torch.float64) / n)[..., None] * torch.arange(n, dtype=torch.float64, device=lines.device)
    angle = (2 * torch.pi * (turns - torch.round(turns))).to(lines.real.dtype)
    power = block_sums(lines * torch.polar(torch.ones_like(angle), -angle)).abs().square()
    return power.median(-1).values > 0.35 * power.mean(-1)


def find_band(lines: Tensor, level: Level, threshold: float = THRESHOLD) -> tuple[Tensor, Tensor]:
    """Lines with an interferer that lasts, and its strongest cell (n-point FFT).

    lines: (..., pulse, range); both (..., pulse).

    The verdict that it lasts is the majority's among the strong lines nearby: of a noise-like
    interferer one line may look intermittent.
    """
    excess = level.excess(line_spectra(lines.detach()))
    strong, cell = stands_out(excess, threshold), excess.argmax(-1)
    if not anything(strong):
        return strong, cell
    near = window_sums(STRETCH_LINES // 2)
    votes = near((strong & lasts_the_line(lines.detach(), cell)).to(torch.float64))
    return strong & (votes > 0.5 * near(strong.to(torch.float64))), cell


def subtract_band(lines: Tensor, touched: Tensor, level: Level) -> Tensor:
    """Lines (..., pulse, range) without the interferer near the strongest cell of each stretch of
    lines.

    touched: (..., pulse), from find_band. Untouched lines pass unchanged. Differentiable in lines
    (the spectrum of the interferer is held).
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
    """Spectrum over the level at half cells, mean over the touched lines of a stretch.

    (..., stretch, line, n) -> (..., stretch, 2 n).
    """
    density = pad(level.density, (0, 0, 0, -level.density.shape[-2] % STRETCH_LINES)).unflatten(-2, (-1, STRETCH_LINES))
    total = torch.zeros(*x.shape[:-2], 2 * x.shape[-1], dtype=x.real.dtype, device=x.device)
    # one line of every stretch at a time: a fraction of the memory of all at once
    for k in range(STRETCH_LINES):
        fine = density[..., k, :].repeat_interleave(2, -1)
        usable = on[..., k, None] & (fine > 0)
        total = total + torch.where(usable, line_spectra(x[..., k, :], 2) / torch.where(usable, fine, 1), 0)
    return total / on.sum(-1).clamp_min(1)[..., None]


def _window(excess: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """First half cell of the band about the strongest one, and interferer over clutter in it:
    (...,) and (..., m).

    Half cells below the level (ratio below 1 after a short average) are no part of the interferer.
    """
    m = 2 * max(8, round(n * LEVEL_SHARE / 2))
    smooth = torch.nn.functional.avg_pool1d(pad(excess.flatten(0, -2)[:, None], (2, 2), mode="circular"), 5, 1)[
        :, 0
    ].reshape(excess.shape)
    first = (smooth.argmax(-1) - m // 2) % excess.shape[-1]
    index = (first[..., None] + torch.arange(m, device=excess.device)) % excess.shape[-1]
    ratio = smooth.gather(-1, index) - 1
    return first, torch.where(ratio > 1, ratio, 0)


def _process(x: Tensor, first: Tensor, ratio: Tensor) -> Tensor:
    """Conditional mean of a process with spectrum `ratio` (over white clutter) on m half cells from
    `first`, given lines x.

    x: (..., stretch, line, n); first: (..., stretch); ratio: (..., stretch, m). The prior is C = F
    diag(ratio) F^H with F of the 2 n-point inverse DFT, and C (C + 1)^-1 x = F q (1 + q F^H F q)^-1
    q F^H x with q^2 = ratio: an m x m solve per stretch.
    """
    n, m = x.shape[-1], ratio.shape[-1]
    index = (first[..., None] + torch.arange(m, device=x.device)) % (2 * n)
    index = index[..., None, :].expand(*x.shape[:-1], m)
    # the solve is small and its condition is the interferer's power over the clutter's: always in
    # double precision
    root, wide = torch.sqrt(ratio.to(torch.float64)), torch.complex128
    seen = torch.fft.fft(x, 2 * n, norm="ortho").gather(-1, index).to(wide) * root[..., None, :]
    lag = torch.arange(m, device=x.device)
    overlap = torch.fft.ifft(pad(torch.ones(n, dtype=wide, device=x.device), (0, n)))[
        (lag[None, :] - lag[:, None]) % (2 * n)
    ]
    system = root[..., :, None] * overlap * root[..., None, :] + torch.eye(m, dtype=wide, device=x.device)
    solved = torch.cholesky_solve(seen.mT, torch.linalg.cholesky(system)).mT * root[..., None, :]
    spectrum = torch.zeros(*x.shape[:-1], 2 * n, dtype=x.dtype, device=x.device).scatter(-1, index, solved.to(x.dtype))
    return torch.fft.ifft(spectrum, norm="ortho")[..., :n]
