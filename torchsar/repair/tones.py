"""Tones in raw lines by maximum likelihood.

A tone is A exp(2j pi (f t + r t^2 / 2)) over the whole line, with t in samples from the middle of
the line. Each line has its own complex amplitude A, frequency f (cycles per sample) and linear
drift r (cycles per sample^2). To refine f and r, a line is demodulated with their first estimates
and projected on the Legendre polynomials of degree 0, 1 and 2 over t. At the maximum of the
likelihood the coefficients of degree 1 and 2 are in phase with that of degree 0; parts in
quadrature give the Gauss-Newton steps of f and r. Every real parameter that is fitted to a line
also removes half a frequency cell of its clutter. Therefore f and r are averaged over neighbouring
lines wherever the tone drifts smoothly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import power_of, unit_phasor
from torchsar.repair.contamination import LASTING, anything, block_sums, excess_of, line_spectra, stands_out
from torchsar.repair.response import unit_legendre


@dataclass(frozen=True)
class Tone:
    """One tone per line, (..., pulse) each.

    Args:
        frequency: Frequency at the middle of the line in cycles per sample, float64.
        rate: Drift of the frequency in cycles per sample^2, float64.
        present: Lines that hold the tone, bool.
        noise_rad: Predicted standard deviation, in radians, of each coefficient of an expansion of
            the phase in orthonormal Legendre polynomials, float64.
    """

    frequency: Tensor
    rate: Tensor
    present: Tensor
    noise_rad: Tensor

    def phasor(self, like: Tensor) -> Tensor:
        """Samples of the tone with unit amplitude, with phase zero at the middle of the line."""
        n = like.shape[-1]
        t = torch.arange(n, dtype=torch.float64, device=like.device) - (n - 1) / 2
        return unit_phasor((self.frequency[..., None] + self.rate[..., None] * (t / 2)) * t, like.dtype)

    def waveform(self, lines: Tensor) -> Tensor:
        """The tone with the amplitude of least squares in each line; 0 where there is none."""
        unit = self.phasor(lines)
        return (lines * unit.conj()).mean(-1, keepdim=True) * unit * self.present[..., None]


def _of_phase(n: int) -> tuple[float, float]:
    """Frequency and drift that one radian of the first and of the second Legendre polynomial adds
    to a tone of n samples.
    """
    return math.sqrt(3) / (math.pi * n), 6 * math.sqrt(5) / (math.pi * n * n)


def _coarse_offset(blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Frequency offset, and change of the frequency within a line, for which a demodulated tone has
    the highest spectral peak.

    Both are in cells of 1 / n cycles per sample, (...,) each.
    """
    count = blocks.shape[-1]
    u = torch.linspace(-0.5, 0.5, count, dtype=torch.float64, device=blocks.device)
    offset = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device=blocks.device) / 2
    best = torch.full(blocks.shape[:-1], -1.0, dtype=blocks.real.dtype, device=blocks.device)
    cells = sweep = torch.zeros_like(best, dtype=torch.float64)
    # drifts of up to 48 cells and errors of up to 12 cells, by choice, because the time grows with
    # both
    for cells_per_line in sorted(range(-48, 49, 2), key=abs):
        chirp = unit_phasor(-0.5 * cells_per_line * u.square(), blocks.dtype)
        # the strongest cell of a drifting tone may be any cell that it passes
        near = offset.abs() <= 12 + abs(cells_per_line) / 2
        value, index = (torch.fft.fft(blocks * chirp, 2 * count).abs() * near).max(-1)
        # a drift is accepted only if it collects clearly more energy, because it is one more
        # parameter
        better = value > best * (1.0 if cells_per_line == 0 else 1.02)
        best, cells = torch.where(better, value, best), torch.where(better, offset[index], cells)
        sweep = torch.where(better, float(cells_per_line), sweep)
    return cells, sweep


def _fit_tone(lines: Tensor, cell: Tensor, present: Tensor, density: Tensor) -> Tone:
    """Tone near a frequency cell (..., pulse) of each line by maximum likelihood, present only
    where it lasts the whole line, for a density (..., pulse) of the clutter.
    """
    n = lines.shape[-1]
    signed = torch.where(cell > n // 2, cell - n, cell).to(torch.float64)
    zero = torch.zeros_like(signed)
    tone = Tone(signed / n, zero, present, zero)
    offset, sweep = _coarse_offset(block_sums(lines * tone.phasor(lines).conj()))
    tone = replace(tone, frequency=tone.frequency + offset / n, rate=sweep / (n * n))
    for steps in (6, 3, 1):
        tone, blocks = _refined(lines, tone, steps)
    energy = power_of(blocks.sum(-1)) / n
    tiny, count = torch.finfo(energy.dtype).tiny, blocks.shape[-1]
    noise = torch.sqrt(density / (2 * energy.clamp_min(tiny))).to(torch.float64)
    # A chirp has a given frequency in few blocks only, whereas a tone fills all of them. A tone
    # with z = energy / density is expected to have the coherent share z / (z + count) of the
    # energy.
    coherent = power_of(blocks.sum(-1)) / (count * power_of(blocks).sum(-1).clamp_min(tiny))
    z = energy / density.clamp_min(tiny)
    return replace(tone, present=present & (coherent > LASTING * z / (z + count)), noise_rad=noise)


def _refined(lines: Tensor, tone: Tone, steps: int) -> tuple[Tone, Tensor]:
    """Refine a tone by Gauss-Newton steps on the block sums of one demodulation, and return the
    tone and those sums.
    """
    blocks = block_sums(lines * tone.phasor(lines).conj())
    count, n = blocks.shape[-1], lines.shape[-1]
    middle = (2 * torch.arange(count, dtype=torch.float64, device=lines.device) + 1) / count - 1
    basis = unit_legendre(middle, 2)[1:]
    phase = torch.zeros(*tone.present.shape, 2, dtype=torch.float64, device=lines.device)
    for _ in range(steps):
        here = blocks * unit_phasor(-(phase @ basis) / (2 * math.pi), blocks.dtype)
        carrier = here.sum(-1, keepdim=True)
        power = power_of(carrier).clamp_min(torch.finfo(blocks.real.dtype).tiny)
        step = (here @ basis.mT.to(here.dtype) * carrier.conj()).imag / power
        phase = phase + step.clamp(-0.7, 0.7)
    frequency, rate = _of_phase(n)
    return replace(
        tone, frequency=tone.frequency + frequency * phase[..., 0], rate=tone.rate + rate * phase[..., 1]
    ), blocks


@torch.no_grad()
def find_tones(lines: Tensor, density: Tensor, position: Tensor, most: int, threshold: float) -> list[Tone]:
    """Find the tones in lines: the strongest first, then the strongest in what remains, and so on.

    A line keeps its tones only if their subtraction removes nine tenths of the energy around them;
    otherwise the energy is that of a wider interferer. At first three tenths are enough, since
    other tones may be near. In each cell, twice the mean power of clutter may remain in addition.
    Frequencies and drifts are averaged over neighbouring lines.

    Args:
        lines: Lines of unit level, shape (..., pulse, range), complex.
        density: Their power spectral density without interference, same shape.
        position: Positions of the lines in the recording, shape (..., pulse), float64.
        most: Largest number of tones of a line.
        threshold: Least excess of the strongest cell.

    Returns:
        Tones, of which each line may hold some.
    """
    rest, found, n = lines, [], lines.shape[-1]
    blocked = torch.zeros(lines.shape, dtype=torch.bool, device=lines.device)
    before = excess = excess_of(line_spectra(rest), density)
    for _ in range(most):
        visible = excess.masked_fill(blocked, 0)
        strong = stands_out(visible, threshold)
        if not anything(strong):
            break
        peak = visible.argmax(-1)
        level = density.gather(-1, peak[..., None])[..., 0]
        tone = _fit_tone(rest, peak, strong, level)
        without = rest - tone.waveform(rest)
        after = excess_of(line_spectra(without), density)
        cell = torch.round(tone.frequency * n).to(torch.int64) % n
        distance = (torch.arange(n, device=lines.device) - cell[..., None]) % n
        near = (distance <= n // 32) | (distance >= n - n // 32)
        clutter, reached = 2 * near.sum(-1), (before * near).sum(-1)
        present = tone.present & ((after * near).sum(-1) < 0.7 * (excess * near).sum(-1) + clutter)
        rest, excess = torch.where(present[..., None], without, rest), torch.where(present[..., None], after, excess)
        blocked = blocked | near & (strong & ~present)[..., None]
        found.append((replace(tone, present=present), near, 0.1 * reached + clutter))
    tones = [replace(tone, present=tone.present & ((excess * near).sum(-1) < left)) for tone, near, left in found]
    return _refit(lines, [tone for tone in tones if anything(tone.present)], position)


def _refit(lines: Tensor, tones: list[Tone], position: Tensor) -> list[Tone]:
    """Fit the tones again where a line holds several of them, each to the line without the others.

    Frequencies and drifts are averaged over neighbouring lines.
    """
    n, tones = lines.shape[-1], list(tones)
    shared = sum((tone.present.int() for tone in tones), torch.zeros_like(position)) > 1
    for _ in range(2 if anything(shared) else 0):
        waves = waveforms(lines, tones)
        for k, tone in enumerate(tones):
            alone = lines - sum(wave for j, wave in enumerate(waves) if j != k)
            again = _refined(alone, tone, 2)[0]
            frequency = torch.where(shared, again.frequency, tone.frequency)
            tones[k] = replace(tone, frequency=frequency, rate=torch.where(shared, again.rate, tone.rate))
            waves[k] = tones[k].waveform(alone)
    for k, tone in enumerate(tones):
        stds = (scale * tone.noise_rad for scale in _of_phase(n))
        frequency, rate = (
            _smooth_track(x, std, tone.present, position)
            for x, std in zip((tone.frequency, tone.rate), stds, strict=True)
        )
        tones[k] = replace(tone, frequency=frequency, rate=rate)
    return tones


def waveforms(lines: Tensor, tones: list[Tone]) -> list[Tensor]:
    """Compute the waveform of each tone, with amplitudes that fit the lines jointly.

    The tones are fitted in turn, each to the lines from which the other tones are subtracted.

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        tones: The tones.

    Returns:
        For each tone its samples, shape (..., pulse, range).
    """
    waves = [torch.zeros_like(lines) for _ in tones]
    for _ in range(3 if len(tones) > 1 else 1):
        for k, tone in enumerate(tones):
            waves[k] = tone.waveform(lines - sum(wave for j, wave in enumerate(waves) if j != k))
    return waves


def _smooth_track(value: Tensor, std: Tensor, present: Tensor, position: Tensor) -> Tensor:
    """Smooth one value per line by local straight-line fits where these fit within the noise.

    The window of the fits grows threefold in each step. Each line keeps the fit with the widest
    window whose residuals are no larger than predicted. If there is none, as where a tone jumps
    from line to line, it keeps its own value. All arguments have the shape (..., pulse).
    """
    weight = torch.where(present, 1 / std.square().clamp_min(1e-60), 0.0)
    weight = weight / weight.amax(-1, keepdim=True).clamp_min(1e-300)
    unit = position / position.amax(-1, keepdim=True).clamp_min(1)
    chosen, half = value, 2
    while half < value.shape[-1]:
        line, support = _local_line(value, weight, unit, half)
        misfit = torch.where(present, (value - line) / std.clamp_min(1e-30), 0.0).square()
        count = window_sums(present.to(value.dtype), half)
        spread = window_sums(misfit, half) / (count - 2).clamp_min(1)
        wider = half < present.sum(-1, keepdim=True)
        expected = (spread < 1 + 3 * torch.sqrt(2 / count.clamp_min(1))) & (misfit < 16)
        chosen = torch.where(present & support & wider & (count >= 5) & expected, line, chosen)
        half *= 3
    return chosen


def window_sums(x: Tensor, half: int) -> Tensor:
    """Sum over a sliding window of lines, which is cut at the ends.

    Args:
        x: One value per line, shape (..., pulse).
        half: Number of lines on either side of the middle one.

    Returns:
        Sums, same shape.
    """
    total = pad(x, (half + 1, half)).cumsum(-1)
    return total[..., 2 * half + 1 :] - total[..., : x.shape[-1]]


def _local_line(value: Tensor, weight: Tensor, i: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """Weighted straight-line fit in a sliding window, and where it is determined."""
    anchor = (weight * value).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-300)
    y = torch.where(weight > 0, value - anchor, 0.0)
    parts = weight, weight * i, weight * i * i, weight * y, weight * i * y
    s0, s1, s2, sy, s1y = (window_sums(part, half) for part in parts)
    determinant = s0 * s2 - s1 * s1
    support = determinant > 1e-12 * s0 * s2.clamp_min(1e-300)
    slope = torch.where(support, (s0 * s1y - s1 * sy) / torch.where(support, determinant, 1), 0.0)
    mean = sy / torch.where(support, s0, 1)
    return anchor + mean + slope * (i - s1 / torch.where(support, s0, 1)), support
