"""Interference that is wider than a tone, subtracted as a narrowband random process.

A group of 32 successive lines shares one spectrum of the interferer: the excess of their averaged
range spectra over clutter. Each line is modelled as a stationary process with that spectrum plus
white clutter, and the conditional mean of the process is subtracted. The model accounts for the
finite length of a line: its n samples are a part of a process with the period 2 n. The spectral
leakage of a strong interferer is therefore subtracted as well, which a notch filter cannot do.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

from torchsar.core import cholesky_factor, power_of
from torchsar.repair.contamination import LASTING, anything, block_sums, excess_of, line_spectra, stands_out
from torchsar.repair.tones import Tone, window_sums

# lines that have one spectrum in common, by choice: more lines estimate it better, fewer follow a
# changing interferer
_GROUP = 32


def find_band(lines: Tensor, density: Tensor, threshold: float) -> Tensor:
    """Find lines with interference that lasts the whole line.

    A single line of noise-like interference may look intermittent. A line therefore counts only if
    the interference lasts in most of the neighbouring lines that exceed the threshold.

    Args:
        lines: Lines of unit level, shape (..., pulse, range), complex.
        density: Their power spectral density without interference, same shape.
        threshold: Least excess of the strongest cell.

    Returns:
        Lines, shape (..., pulse), bool.
    """
    lines = lines.detach()
    excess = excess_of(line_spectra(lines), density)
    strong = stands_out(excess, threshold)
    if not anything(strong):
        return strong
    frequency = excess.argmax(-1).to(torch.float64) / lines.shape[-1]
    carrier = Tone(frequency, torch.zeros_like(frequency), strong, frequency).phasor(lines)
    power = power_of(block_sums(lines * carrier.conj()))
    lasts = power.median(-1).values > LASTING * power.mean(-1)
    votes, of_all = (window_sums(x.to(torch.float64), _GROUP // 2) for x in (strong & lasts, strong))
    return strong & (votes > 0.5 * of_all)


def subtract_band(lines: Tensor, touched: Tensor, density: Tensor) -> Tensor:
    """Subtract the interference near the strongest cell of each group of 32 lines.

    Differentiable in the lines, with the spectrum of the interference held fixed.

    Args:
        lines: Lines of unit level, shape (..., pulse, range), complex.
        touched: Lines that are changed, shape (..., pulse), bool.
        density: Power spectral density without interference, shape (..., pulse, range).

    Returns:
        Lines of the same shape.
    """
    n_pulse, n = lines.shape[-2:]
    fill = -n_pulse % _GROUP
    x, floor = (pad(part, (0, 0, 0, fill)).unflatten(-2, (-1, _GROUP)) for part in (lines, density))
    on = pad(touched, (0, fill)).unflatten(-1, (-1, _GROUP))
    # Spectrum over density at half cells, averaged over the marked lines of a group. The loop over
    # the lines of a group takes a fraction of the memory of all lines at once.
    total = torch.zeros(*x.shape[:-2], 2 * n, dtype=x.real.dtype, device=x.device)
    for k in range(_GROUP):
        fine = floor[..., k, :].repeat_interleave(2, -1)
        total = total + on[..., k, None] * excess_of(line_spectra(x[..., k, :].detach(), 2), fine)
    excess = total / on.sum(-1).clamp_min(1)[..., None]
    # the band around the strongest half cell, and the ratio of interferer to clutter there
    m = 2 * max(8, round(n / 32))
    smooth = avg_pool1d(pad(excess.flatten(0, -2)[:, None], (2, 2), mode="circular"), 5, 1)[:, 0].reshape(excess.shape)
    first = (smooth.argmax(-1) - m // 2) % (2 * n)
    index = (first[..., None] + torch.arange(m, device=x.device)) % (2 * n)
    ratio = smooth.gather(-1, index) - 1
    wave = _process(x, index, torch.where(ratio > 1, ratio, 0)) * on[..., None]
    return lines - wave.flatten(-3, -2)[..., :n_pulse, :]


def _process(x: Tensor, index: Tensor, ratio: Tensor) -> Tensor:
    """Conditional mean of a process on m half cells, given lines x.

    x: (..., group, line, n); index and ratio: (..., group, m), half cells and their spectrum over
    white clutter. The prior covariance is C = F diag(ratio) F^H with F from the inverse DFT of 2 n
    points. The mean is C (C + 1)^-1 x = F q (1 + q F^H F q)^-1 q F^H x with q^2 = ratio, which
    needs one m x m solution per group.
    """
    n, m = x.shape[-1], ratio.shape[-1]
    index = index[..., None, :].expand(*x.shape[:-1], m)
    # double precision, because the condition of the small system is the ratio of the power of the
    # interferer to that of the clutter
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
