"""Tones in raw lines: estimated by maximum likelihood and subtracted.

A tone is A exp(2j pi (f t + r t^2 / 2)) over the whole line, t in samples from the middle of the
line: amplitude, frequency and a linear drift, each line with its own. Demodulated at (f, r), a line
is expanded in Legendre polynomials; the tone is right when the first and second coefficients have
no part in quadrature to the zeroth, and their quadrature parts are the Gauss-Newton steps. Every
real parameter costs a line of n samples 1 / (2 n) of the signal's power at that frequency, so f and
r are pooled over lines wherever the tone drifts smoothly. Source: brief 004, item 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import unit_phasor
from torchsar.repair.interference_detect import THRESHOLD, Level, line_spectra, stands_out

_SWEEP_CELLS = 48  # drift within a line that is searched, +- frequency cells
_OFFSET_CELLS = 12
_STEPS = 6


@dataclass(frozen=True)
class Tone:
    """One tone a line: frequency (cycles per sample, at the middle), rate (cycles per sample^2),
    all (..., pulse) float64; where it is present.

    noise_rad: predicted standard deviation of each Legendre coefficient of the phase.
    """

    frequency: Tensor
    rate: Tensor
    present: Tensor
    noise_rad: Tensor

    def phasor(self, n: int, dtype: torch.dtype) -> Tensor:
        """The tone with unit amplitude, (..., pulse, n)."""
        t = torch.arange(n, dtype=torch.float64, device=self.frequency.device) - (n - 1) / 2
        return unit_phasor((self.frequency[..., None] + self.rate[..., None] * (t / 2)) * t, dtype)

    def cell(self, n: int) -> Tensor:
        """Nearest cell of an n-point FFT, int64 (..., pulse)."""
        return torch.round(self.frequency * n).to(torch.int64) % n

    def waveform(self, lines: Tensor) -> Tensor:
        """The tone as it is in these lines (least squares amplitude), zero where it is not present.

        Differentiable in lines.
        """
        unit = self.phasor(lines.shape[-1], lines.dtype)
        amplitude = (lines * unit.conj()).mean(-1, keepdim=True)
        return amplitude * unit * self.present[..., None]


def legendre(n: int, like: Tensor) -> Tensor:
    """Orthonormal polynomials 1, u, u^2 over n samples (mean square 1), (n, 3) real."""
    u = torch.linspace(-1, 1, n, dtype=torch.float64, device=like.device)
    basis = [torch.ones_like(u)]
    for power in (1, 2):
        p = u**power
        p = p - sum((p * q).mean() * q for q in basis)
        basis.append(p / p.square().mean().sqrt())
    return torch.stack(basis, -1).to(like.real.dtype)


def block_sums(x: Tensor) -> Tensor:
    """Sums over short blocks of a line, (..., n) -> (..., block): a narrow band about zero
    frequency, n / 16 cells wide or less.
    """
    n = x.shape[-1]
    length = 2 ** math.ceil(math.log2(max(1, n / 128))) if n >= 1024 else max(1, n // 64)
    return torch.nn.functional.pad(x, (0, -n % length)).unflatten(-1, (-1, length)).sum(-1)


def coarse_offset(blocks: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Frequency offset and rate that collect most energy of demodulated block sums, in cells (1 /
    n) and cells per line, (...,).
    """
    count = blocks.shape[-1]
    u = torch.linspace(-0.5, 0.5, count, dtype=torch.float64, device=blocks.device)
    offset = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device=blocks.device) / 2
    best = torch.full(blocks.shape[:-1], -1.0, dtype=blocks.real.dtype, device=blocks.device)
    cells, sweep = torch.zeros_like(best, dtype=torch.float64), torch.zeros_like(best, dtype=torch.float64)
    for cells_per_line in sorted(range(-_SWEEP_CELLS, _SWEEP_CELLS + 1, 2), key=abs):
        chirp = unit_phasor(-0.5 * cells_per_line * u.square(), blocks.dtype)
        # the strongest cell of a drifting tone may be any that it passes
        near = offset.abs() <= _OFFSET_CELLS + abs(cells_per_line) / 2
        value, index = (torch.fft.fft(blocks * chirp, 2 * count).abs() * near).max(-1)
        # a drift must earn its parameter
        better = value > best * (1.0 if cells_per_line == 0 else 1.02)
        best, cells = torch.where(better, value, best), torch.where(better, offset[index], cells)
        sweep = torch.where(better, float(cells_per_line), sweep)
    return cells, sweep


def phase_step(blocks: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton steps of the first and second Legendre coefficient of the phase, rad, from
    demodulated blocks. (..., block) -> (...,) each.
    """
    a = blocks @ basis.to(blocks.dtype)
    carrier = a[..., 0]
    power = (carrier.real.square() + carrier.imag.square()).clamp_min(torch.finfo(carrier.real.dtype).tiny)
    steps = (a[..., 1:] * carrier.conj()[..., None]).imag / power[..., None]
    steps = steps.clamp(-0.7, 0.7).to(torch.float64)
    return steps[..., 0], steps[..., 1]


def _to_frequency(first_rad: Tensor, n: int) -> Tensor:
    return math.sqrt(3) * first_rad / (math.pi * n)


def _to_rate(second_rad: Tensor, n: int) -> Tensor:
    return 6 * math.sqrt(5) * second_rad / (math.pi * n * n)


def fit_tone(lines: Tensor, cell: Tensor, present: Tensor, level: Level) -> Tone:
    """Maximum likelihood tone near a frequency cell of each line.

    lines: (..., pulse, range); cell, present: (..., pulse).
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
    basis = legendre(blocks.shape[-1], lines)
    first = second = torch.zeros_like(tone.frequency)
    for _ in range(steps):
        turns = (first[..., None] * basis[:, 1] + second[..., None] * basis[:, 2]) / (2 * math.pi)
        step = phase_step(blocks * unit_phasor(-turns, blocks.dtype), basis)
        first, second = first + step[0], second + step[1]
    return replace(
        tone, frequency=tone.frequency + _to_frequency(first, n), rate=tone.rate + _to_rate(second, n)
    ), blocks


def is_steady(blocks: Tensor, energy: Tensor, density: Tensor) -> Tensor:
    """Whether the spectral line comes from a tone that lasts the whole line, (..., block) -> (...,)
    bool.

    Echoes of regularly spaced targets make spectral lines too, but a chirp passes a frequency in a
    moment: their energy sits in few blocks. A tone fills all of them, so its coherent sum holds the
    share z / (z + blocks) of the energy, z its excess.
    """
    n_blocks = blocks.shape[-1]
    coherent = blocks.sum(-1).abs().square() / (
        n_blocks * blocks.abs().square().sum(-1).clamp_min(torch.finfo(density.dtype).tiny)
    )
    z = energy / density.clamp_min(torch.finfo(density.dtype).tiny)
    return coherent > 0.35 * z / (z + n_blocks)


def pooled(tone: Tone, n: int, position: Tensor) -> Tone:
    """Frequency and rate smoothed over neighbouring lines as far as the data agree with a smooth
    drift.

    Local straight lines over windows that grow threefold; a line keeps the widest window whose
    residuals are no larger than the predicted noise. A tone that jumps from line to line keeps its
    own values. position: line numbers, float64 (..., pulse).
    """
    frequency = smooth_track(tone.frequency, _to_frequency(tone.noise_rad, n), tone.present, position)
    return replace(
        tone, frequency=frequency, rate=smooth_track(tone.rate, _to_rate(tone.noise_rad, n), tone.present, position)
    )


def smooth_track(value: Tensor, std: Tensor, present: Tensor, position: Tensor) -> Tensor:
    """Local straight-line fits wherever they agree with the predicted std, the values themselves
    elsewhere. All (..., pulse) float64.
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
    """Sums over lines i - half .. i + half, cut at the ends."""

    def sums(x: Tensor) -> Tensor:
        total = torch.nn.functional.pad(x, (half + 1, half)).cumsum(-1)
        return total[..., 2 * half + 1 :] - total[..., : x.shape[-1]]

    return sums


def _local_line(value: Tensor, weight: Tensor, i: Tensor, box: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Weighted straight-line fit over position i in a sliding window, at each position; also where
    it is determined.
    """
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
    """Up to `most` tones a line, strongest first, each found on what the earlier ones leave.

    lines: (..., pulse, range).

    position: line numbers (..., pulse) where the lines are a selection. Lines where the tones do
    not account for the energy about them keep none: what is there is not a tone.
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
        # a tone that leaves most of the energy about it is part of something wider
        useful = tone.present & accounts_for(excess, after, near, 0.7)
        rest, excess = torch.where(useful[..., None], without, rest), torch.where(useful[..., None], after, excess)
        blocked = blocked | near & (strong & ~useful)[..., None]
        tones.append(replace(tone, present=useful))
    at = torch.arange(lines.shape[-2], device=lines.device).expand(lines.shape[:-1]) if position is None else position
    return refit(lines.detach(), explaining(lines.detach(), rest, tones, level), at.to(torch.float64))


def accounts_for(before: Tensor, after: Tensor, near: Tensor, share: float) -> Tensor:
    """Whether at most a share of the energy in the cells `near` is left, clutter (1 a cell) apart.

    (..., pulse, range) -> (..., pulse) bool.
    """
    return (after * near).sum(-1) < share * (before * near).sum(-1) + 2 * near.sum(-1)


def explaining(lines: Tensor, rest: Tensor, tones: list[Tone], level: Level) -> list[Tone]:
    """The tones that together account for nearly all energy about them; the others are marked
    absent.
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
    """Each tone fitted again with the others taken out, then pooled over lines."""
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
    """Waveform of every tone in the lines, amplitudes fitted jointly by turns.

    Differentiable in lines.
    """
    waves = [torch.zeros_like(lines) for _ in tones]
    for _ in range(rounds if len(tones) > 1 else 1):
        for k, tone in enumerate(tones):
            waves[k] = tone.waveform(lines - sum(wave for j, wave in enumerate(waves) if j != k))
    return waves


def subtract_tones(lines: Tensor, tones: list[Tone]) -> Tensor:
    """Lines (..., pulse, range) without the tones."""
    for wave in subtract_each(lines, tones):
        lines = lines - wave
    return lines


def around(cell: Tensor, n: int) -> Tensor:
    """Cells within n / 32 of one cell a line, circular, (..., pulse) -> (..., pulse, n) bool."""
    distance = (torch.arange(n, device=cell.device) - cell[..., None]) % n
    return (distance <= n // 32) | (distance >= n - n // 32)


def anything(mask: Tensor) -> bool:
    """Whether any entry is true; True inside vmap, where a value cannot be looked at."""
    try:
        return bool(mask.any())
    except RuntimeError:
        return True
