"""Tones in raw lines: estimated by maximum likelihood and subtracted.

A tone is A exp(2j pi (f t + r t^2 / 2)) over the whole line, with t in samples from the middle of
the line. Each line has its own complex amplitude A, frequency f (cycles per sample) and linear
drift r (cycles per sample^2). To refine f and r, a line is demodulated with their first estimates
and projected on the Legendre polynomials of degree 0, 1 and 2 over t. At the maximum of the
likelihood the coefficients of degree 1 and 2 are in phase with that of degree 0. Parts in
quadrature give the Gauss-Newton steps of f and r. Every real parameter that is fitted to a line
also removes half a frequency cell of its clutter. Therefore f and r are averaged over neighbouring
lines wherever the tone drifts smoothly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import host_value, power_of, unit_phasor
from torchsar.repair.interference_detect import THRESHOLD, Level, line_spectra, stands_out

# Largest drift within a line and largest error of the initial frequency that are searched, in
# frequency cells either way, by choice: the cost of the search grows with the drift.
_SWEEP_CELLS = 48
_OFFSET_CELLS = 12
# Gauss-Newton steps after the coarse search, by choice.
_STEPS = 6


@dataclass(frozen=True)
class Tone:
    """One tone per line.

    Args:
        frequency: Frequency at the middle of the line in cycles per sample, shape (..., pulse),
            float64.
        rate: Drift of the frequency in cycles per sample^2, shape (..., pulse), float64.
        present: Lines that hold the tone, shape (..., pulse), bool.
        noise_rad: Predicted standard deviation, in radians, of each coefficient of an expansion of
            the phase in orthonormal Legendre polynomials, shape (..., pulse), float64.
    """

    frequency: Tensor
    rate: Tensor
    present: Tensor
    noise_rad: Tensor

    def phasor(self, n: int, dtype: torch.dtype) -> Tensor:
        """Return the samples of the tone with unit amplitude.

        Args:
            n: Number of samples of a line.
            dtype: complex64 or complex128.

        Returns:
            Complex samples with phase zero at the middle of the line, shape (..., pulse, n).
        """
        t = torch.arange(n, dtype=torch.float64, device=self.frequency.device) - (n - 1) / 2
        return unit_phasor((self.frequency[..., None] + self.rate[..., None] * (t / 2)) * t, dtype)

    def cell(self, n: int) -> Tensor:
        """Return the index of the FFT cell nearest to the tone, shape (..., pulse), int64."""
        return torch.round(self.frequency * n).to(torch.int64) % n

    def waveform(self, lines: Tensor) -> Tensor:
        """Return the tone with the complex amplitude that fits each line by least squares.

        Differentiable in the lines.

        Args:
            lines: Raw lines, shape (..., pulse, n), complex.

        Returns:
            Samples of the tone, same shape; zero in lines that do not hold it.
        """
        unit = self.phasor(lines.shape[-1], lines.dtype)
        amplitude = (lines * unit.conj()).mean(-1, keepdim=True)
        return amplitude * unit * self.present[..., None]


def orthonormal_quadratics(n: int, like: Tensor) -> Tensor:
    """Return the orthonormal polynomials of degree 0 to 2 over the samples of a line.

    Args:
        n: Number of samples.
        like: Tensor that gives device and precision.

    Returns:
        Polynomials of unit mean square over the samples, shape (n, 3), real.
    """
    u = torch.linspace(-1, 1, n, dtype=torch.float64, device=like.device)
    basis = [torch.ones_like(u)]
    for power in (1, 2):
        p = u**power
        p = p - sum((p * q).mean() * q for q in basis)
        basis.append(p / p.square().mean().sqrt())
    return torch.stack(basis, -1).to(like.real.dtype)


def block_sums(x: Tensor) -> Tensor:
    """Sum the samples of short blocks, which keeps only frequencies near zero.

    A line of 64 samples or more is divided into about 64 to 128 blocks.

    Args:
        x: Demodulated lines, shape (..., n), complex.

    Returns:
        Sums, shape (..., block).
    """
    n = x.shape[-1]
    length = 2 ** math.ceil(math.log2(max(1, n / 128))) if n >= 1024 else max(1, n // 64)
    return torch.nn.functional.pad(x, (0, -n % length)).unflatten(-1, (-1, length)).sum(-1)


def coarse_offset(blocks: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Search for the frequency offset and the drift that give a tone the highest spectral peak.

    The tone has been demodulated with a first estimate of its frequency.

    Args:
        blocks: Sums of `block_sums`, shape (..., block), complex.
        n: Number of samples of a line.

    Returns:
        Frequency offset in cells of 1 / n cycles per sample, and change of the frequency from the
        beginning to the end of the line in cells, shape (...,) each, float64.
    """
    count = blocks.shape[-1]
    u = torch.linspace(-0.5, 0.5, count, dtype=torch.float64, device=blocks.device)
    offset = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device=blocks.device) / 2
    best = torch.full(blocks.shape[:-1], -1.0, dtype=blocks.real.dtype, device=blocks.device)
    cells, sweep = torch.zeros_like(best, dtype=torch.float64), torch.zeros_like(best, dtype=torch.float64)
    for cells_per_line in sorted(range(-_SWEEP_CELLS, _SWEEP_CELLS + 1, 2), key=abs):
        chirp = unit_phasor(-0.5 * cells_per_line * u.square(), blocks.dtype)
        # the strongest cell of a drifting tone may be any cell that it passes
        near = offset.abs() <= _OFFSET_CELLS + abs(cells_per_line) / 2
        value, index = (torch.fft.fft(blocks * chirp, 2 * count).abs() * near).max(-1)
        # a drift counts only if it collects clearly more energy: it costs a parameter
        better = value > best * (1.0 if cells_per_line == 0 else 1.02)
        best, cells = torch.where(better, value, best), torch.where(better, offset[index], cells)
        sweep = torch.where(better, float(cells_per_line), sweep)
    return cells, sweep


def phase_step(blocks: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Compute one Gauss-Newton step of the phase of a demodulated tone.

    Args:
        blocks: Sums of `block_sums`, shape (..., block), complex.
        basis: Polynomials of `orthonormal_quadratics`, shape (block, 3).

    Returns:
        Steps of the first and second Legendre coefficient of the phase in radians, limited to
        +-0.7, shape (...,) each, float64.
    """
    a = blocks @ basis.to(blocks.dtype)
    carrier = a[..., 0]
    power = power_of(carrier).clamp_min(torch.finfo(carrier.real.dtype).tiny)
    steps = (a[..., 1:] * carrier.conj()[..., None]).imag / power[..., None]
    steps = steps.clamp(-0.7, 0.7).to(torch.float64)
    return steps[..., 0], steps[..., 1]


def _to_frequency(first_rad: Tensor, n: int) -> Tensor:
    """First coefficient of the phase as a frequency in cycles per sample."""
    return math.sqrt(3) * first_rad / (math.pi * n)


def _to_rate(second_rad: Tensor, n: int) -> Tensor:
    """Second coefficient of the phase as a drift in cycles per sample^2."""
    return 6 * math.sqrt(5) * second_rad / (math.pi * n * n)


def fit_tone(lines: Tensor, cell: Tensor, present: Tensor, level: Level) -> Tone:
    """Fit a tone by maximum likelihood to each line, near a given frequency cell.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        cell: Index of one FFT cell for each line, shape (..., pulse), int64.
        present: Lines that may hold a tone, shape (..., pulse), bool.
        level: Robust estimate of the power spectral density without interference.

    Returns:
        One tone for each line, marked as present only where it lasts the whole line.
    """
    n = lines.shape[-1]
    signed = torch.where(cell > n // 2, cell - n, cell).to(torch.float64)
    zero = torch.zeros_like(signed)
    tone = Tone(signed / n, zero, present, zero)
    offset, sweep = coarse_offset(block_sums(lines * tone.phasor(n, lines.dtype).conj()), n)
    tone = replace(tone, frequency=tone.frequency + offset / n, rate=sweep / (n * n))
    for inner in (_STEPS, 3, 1):
        tone, blocks = _refine(lines, tone, inner)
    density = level.at(tone.cell(n))
    energy = blocks.sum(-1).abs().square() / n
    noise = torch.sqrt(density / (2 * energy.clamp_min(torch.finfo(energy.dtype).tiny))).to(torch.float64)
    return replace(tone, present=present & is_steady(blocks, energy, density), noise_rad=noise)


def _refine(lines: Tensor, tone: Tone, steps: int) -> tuple[Tone, Tensor]:
    """Gauss-Newton steps on the block sums of one demodulation; also returns those sums."""
    n = lines.shape[-1]
    blocks = block_sums(lines * tone.phasor(n, lines.dtype).conj())
    basis = orthonormal_quadratics(blocks.shape[-1], lines)
    first = second = torch.zeros_like(tone.frequency)
    for _ in range(steps):
        turns = (first[..., None] * basis[:, 1] + second[..., None] * basis[:, 2]) / (2 * math.pi)
        step = phase_step(blocks * unit_phasor(-turns, blocks.dtype), basis)
        first, second = first + step[0], second + step[1]
    return replace(
        tone, frequency=tone.frequency + _to_frequency(first, n), rate=tone.rate + _to_rate(second, n)
    ), blocks


def is_steady(blocks: Tensor, energy: Tensor, density: Tensor) -> Tensor:
    """Return whether a spectral line comes from a tone that lasts the whole line.

    Echoes of regularly spaced targets make spectral lines too, but a chirp has a given frequency in
    few blocks only, whereas a tone fills all B blocks. The coherent share of the energy is |sum of
    blocks|^2 / (B sum |block|^2). A tone has an expected share of z / (z + B), where z = energy /
    density; at least 0.35 times this share is required.

    Args:
        blocks: Sums of `block_sums`, shape (..., block), complex.
        energy: |sum of all blocks|^2 over the number of samples of the line, shape (...,).
        density: Power spectral density of clutter at the tone, shape (...,).

    Returns:
        True where the tone lasts, shape (...,), bool.
    """
    n_blocks = blocks.shape[-1]
    coherent = blocks.sum(-1).abs().square() / (
        n_blocks * blocks.abs().square().sum(-1).clamp_min(torch.finfo(density.dtype).tiny)
    )
    z = energy / density.clamp_min(torch.finfo(density.dtype).tiny)
    return coherent > 0.35 * z / (z + n_blocks)


def pooled(tone: Tone, n: int, position: Tensor) -> Tone:
    """Average frequency and drift over neighbouring lines where the tone drifts smoothly.

    Where the tone jumps from line to line, every line keeps its own values; see `smooth_track`.

    Args:
        tone: Tone whose frequency and drift were estimated from each line alone.
        n: Number of samples of a line.
        position: Line numbers, shape (..., pulse), float64.

    Returns:
        Tone with averaged frequency and drift.
    """
    frequency = smooth_track(tone.frequency, _to_frequency(tone.noise_rad, n), tone.present, position)
    return replace(
        tone, frequency=frequency, rate=smooth_track(tone.rate, _to_rate(tone.noise_rad, n), tone.present, position)
    )


def smooth_track(value: Tensor, std: Tensor, present: Tensor, position: Tensor) -> Tensor:
    """Smooth one value per line by local straight-line fits where these fit within the noise.

    The window of the fits grows threefold in each step. Each line keeps the fit with the widest
    window whose residuals are no larger than predicted; without any, it keeps its own value.

    Args:
        value: One value per line, such as a frequency, shape (..., pulse), float64.
        std: Predicted standard deviation of the values, shape (..., pulse), float64.
        present: Lines whose values are used, shape (..., pulse), bool.
        position: Line numbers, shape (..., pulse), float64.

    Returns:
        Smoothed values of the same shape.
    """
    weight = torch.where(present, 1 / std.square().clamp_min(1e-60), 0.0)
    weight = weight / weight.amax(-1, keepdim=True).clamp_min(1e-300)
    unit = position / position.amax(-1, keepdim=True).clamp_min(1)
    chosen, half = value, 2
    while half < value.shape[-1]:
        box = window_sums(half)
        line, support = _local_line(value, weight, unit, box)
        misfit = torch.where(present, (value - line) / std.clamp_min(1e-30), 0.0).square()
        count = box(present.to(value.dtype))
        spread = box(misfit) / (count - 2).clamp_min(1)
        wider = half < present.sum(-1, keepdim=True)
        agrees = (
            present
            & support
            & wider
            & (count >= 5)
            & (spread < 1 + 3 * torch.sqrt(2 / count.clamp_min(1)))
            & (misfit < 16)
        )
        chosen = torch.where(agrees, line, chosen)
        half *= 3
    return chosen


def window_sums(half: int) -> Callable[[Tensor], Tensor]:
    """Return a function that sums over a sliding window of 2 half + 1 lines.

    At the ends the window is cut.

    Args:
        half: Half width of the window in lines.

    Returns:
        Function that maps values, shape (..., line), to sums of the same shape.
    """

    def sums(x: Tensor) -> Tensor:
        total = torch.nn.functional.pad(x, (half + 1, half)).cumsum(-1)
        return total[..., 2 * half + 1 :] - total[..., : x.shape[-1]]

    return sums


def _local_line(value: Tensor, weight: Tensor, i: Tensor, box: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Weighted straight-line fit in a sliding window, and where it is determined."""
    anchor = (weight * value).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-300)
    y = torch.where(weight > 0, value - anchor, 0.0)
    s0, s1, s2, sy, s1y = (box(part) for part in (weight, weight * i, weight * i * i, weight * y, weight * i * y))
    determinant = s0 * s2 - s1 * s1
    support = determinant > 1e-12 * s0 * s2.clamp_min(1e-300)
    slope = torch.where(support, (s0 * s1y - s1 * sy) / torch.where(support, determinant, 1), 0.0)
    mean = sy / torch.where(support, s0, 1)
    return anchor + mean + slope * (i - s1 / torch.where(support, s0, 1)), support


def find_tones(
    lines: Tensor, level: Level, position: Tensor | None = None, most: int = 4, threshold: float = THRESHOLD
) -> list[Tone]:
    """Find tones in lines: the strongest first, then the strongest in what remains, and so on.

    A line keeps its tones only if their subtraction removes nine tenths of the energy around them;
    otherwise the energy is that of a wider interferer.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        level: Robust estimate of the power spectral density without interference.
        position: Line numbers, shape (..., pulse); None if the lines are successive.
        most: Largest number of tones that are sought in a line.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        Up to `most` tones, each with one value per line, shape (..., pulse).
    """
    rest, tones, n = lines.detach(), [], lines.shape[-1]
    blocked = torch.zeros(lines.shape, dtype=torch.bool, device=lines.device)
    excess = level.excess(line_spectra(rest))
    for _ in range(most):
        open_ = excess.masked_fill(blocked, 0)
        strong = stands_out(open_, threshold)
        if not anything(strong):
            break
        tone = fit_tone(rest, open_.argmax(-1), strong, level)
        without = rest - tone.waveform(rest)
        after, near = level.excess(line_spectra(without)), around(tone.cell(n), n)
        # a tone that leaves most of the energy around it is part of wider interference
        useful = tone.present & accounts_for(excess, after, near, 0.7)
        rest, excess = torch.where(useful[..., None], without, rest), torch.where(useful[..., None], after, excess)
        blocked = blocked | near & (strong & ~useful)[..., None]
        tones.append(replace(tone, present=useful))
    at = torch.arange(lines.shape[-2], device=lines.device).expand(lines.shape[:-1]) if position is None else position
    return refit(lines.detach(), explaining(lines.detach(), rest, tones, level), at.to(torch.float64))


def accounts_for(before: Tensor, after: Tensor, near: Tensor, share: float) -> Tensor:
    """Return whether the subtraction of tones left little energy in the frequency cells near them.

    In each cell, twice the mean power of clutter may remain in addition to the given share.

    Args:
        before: Power spectra before subtraction, divided by the level of clutter, shape (...,
            pulse, range).
        after: The same after subtraction.
        near: Cells near the tones, shape (..., pulse, range), bool.
        share: Largest share of the energy in these cells that may remain.

    Returns:
        True where little energy is left, shape (..., pulse), bool.
    """
    return (after * near).sum(-1) < share * (before * near).sum(-1) + 2 * near.sum(-1)


def explaining(lines: Tensor, rest: Tensor, tones: list[Tone], level: Level) -> list[Tone]:
    """Mark a tone as absent in lines where more than a tenth of the energy around it is left.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        rest: Lines after the subtraction of all tones, same shape.
        tones: Tones of the lines.
        level: Robust estimate of the power spectral density without interference.

    Returns:
        The tones that are present in at least one line.
    """
    if not tones:
        return tones
    n = lines.shape[-1]
    before, after = (level.excess(line_spectra(x)) for x in (lines, rest))
    kept = [
        replace(tone, present=tone.present & accounts_for(before, after, around(tone.cell(n), n), 0.1))
        for tone in tones
    ]
    return [tone for tone in kept if anything(tone.present)]


def refit(lines: Tensor, tones: list[Tone], position: Tensor, rounds: int = 2) -> list[Tone]:
    """Fit each tone again, in lines from which the other tones are subtracted.

    Then the frequency and the drift of each tone are averaged over neighbouring lines; see
    `pooled`.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        tones: Tones of the lines.
        position: Line numbers, shape (..., pulse), float64.
        rounds: Number of passes over all tones, if a line holds more than one.

    Returns:
        Tones in the same order.
    """
    n, tones = lines.shape[-1], list(tones)
    if not tones:
        return tones
    shared = torch.stack([tone.present for tone in tones]).sum(0) > 1
    for _ in range(rounds if anything(shared) else 0):
        waves = subtract_each(lines, tones)
        for k, tone in enumerate(tones):
            alone = lines - sum(wave for j, wave in enumerate(waves) if j != k)
            again = _refine(alone, tone, 2)[0]
            tones[k] = replace(
                tone,
                frequency=torch.where(shared, again.frequency, tone.frequency),
                rate=torch.where(shared, again.rate, tone.rate),
            )
            waves[k] = tones[k].waveform(alone)
    return [pooled(tone, n, position) for tone in tones]


def subtract_each(lines: Tensor, tones: list[Tone], rounds: int = 3) -> list[Tensor]:
    """Return the waveform of each tone, with amplitudes that fit the lines jointly.

    The tones are fitted in turn, each to the lines from which the other tones are subtracted.
    Differentiable in the lines.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        tones: Tones of the lines.
        rounds: Number of passes over all tones.

    Returns:
        One tensor of shape (..., pulse, range) for each tone.
    """
    waves = [torch.zeros_like(lines) for _ in tones]
    for _ in range(rounds if len(tones) > 1 else 1):
        for k, tone in enumerate(tones):
            waves[k] = tone.waveform(lines - sum(wave for j, wave in enumerate(waves) if j != k))
    return waves


def subtract_tones(lines: Tensor, tones: list[Tone]) -> Tensor:
    """Subtract tones from lines, with amplitudes that fit the lines jointly.

    Differentiable in the lines.

    Args:
        lines: Raw lines, shape (..., pulse, range), complex.
        tones: Tones of the lines.

    Returns:
        Lines of the same shape.
    """
    for wave in subtract_each(lines, tones):
        lines = lines - wave
    return lines


def around(cell: Tensor, n: int) -> Tensor:
    """Mark the n / 32 cells on each side of a given cell, with cells in circular order.

    Args:
        cell: Index of one FFT cell for each line, shape (..., pulse), int64.
        n: Number of FFT cells of a line.

    Returns:
        True for the given cell and the marked ones, shape (..., pulse, n), bool.
    """
    distance = (torch.arange(n, device=cell.device) - cell[..., None]) % n
    return (distance <= n // 32) | (distance >= n - n // 32)


def anything(mask: Tensor) -> bool:
    """Return whether any entry is True.

    Inside torch.vmap, where values cannot be read, the result is True.

    Args:
        mask: Any shape, bool.

    Returns:
        Whether any entry is True, or may be True.
    """
    return host_value(mask.any(), True)
