"""Narrowband interference in raw lines: detection, and correction by one of three methods.

The interference is subtracted (`subtract_interference`, recommended), its frequencies are set to
zero (`notch_interference`), or whole lines are set to zero (`drop_interference`). Each of these
functions takes raw lines (..., pulse, range) and returns a `Repaired`. The corresponding stages of
a processing chain (`SubtractInterference`, `NotchInterference`, `DropInterference`) return the
corrected signal and a mask of the lines that are missing afterwards; a later stage can fill these
lines. Lines without interference are unchanged bit for bit.

Detection: the power of each cell of the range spectrum is compared with its level, the power
without interference. The level is the larger of two estimates. The first is the gain of the line
times a clean spectrum that all lines share: a median over lines, followed by a local median over
frequency. The median over lines rejects interferers whose frequency changes from line to line; the
local median rejects narrowband interferers of constant frequency, and preserves the steep edges of
the pulse band. The second is the local median of the line's own spectrum. It is needed for lines
without an echo, whose spectrum has another shape than that of lines with an echo. Regularly spaced
targets also make narrow spectral peaks. A line is therefore treated only if the energy near its
peak lasts most of the line.

Tones are estimated by maximum likelihood. A tone is A exp(2j pi (f t + r t^2 / 2)) over the whole
line, with t in samples from the middle of the line. Each line has its own complex amplitude A,
frequency f (cycles per sample) and linear drift r (cycles per sample^2). To refine f and r, a line
is demodulated with their first estimates and projected on the Legendre polynomials of degree 0, 1
and 2 over t. At the maximum of the likelihood the coefficients of degree 1 and 2 are in phase with
that of degree 0; parts in quadrature give the Gauss-Newton steps of f and r. Every real parameter
that is fitted to a line also removes half a frequency cell of its clutter. Therefore f and r are
averaged over neighbouring lines wherever the tone drifts smoothly.

Wider interference is subtracted as a narrowband random process. A group of successive lines shares
one spectrum of the interferer: the excess of their averaged range spectra over clutter. Each line
is modelled as a stationary process with that spectrum plus white clutter, and the conditional mean
of the process is subtracted. The model accounts for the finite length of a line: its n samples are
a part of a process with the period 2 n. The spectral leakage of a strong interferer is therefore
subtracted as well, which a notch filter cannot do.

Reference:
    Tsvetkov 2017, Figs. 2 and 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    cholesky_factor,
    host_largest,
    host_value,
    level_of,
    power_of,
    unit_level,
    unit_phasor,
)
from torchsar.repair.assess import assess_lines
from torchsar.repair.response import unit_legendre

# In units of the mean level. Speckle is exponential: exp(-30) leaves one false cell in 1e13. The
# clean RADARSAT-1 blocks stay below 24.
THRESHOLD = 30.0
# Width of the local median over the band, by choice: an interferer of half of it does not raise
# the median; one that is wider than this is not narrowband.
_LEVEL_SHARE = 1 / 16
# Least median over mean power of the blocks of a line for energy that lasts (1 for a tone, 0.7 for
# noise-like interference, near 0 for chirps that sweep through its frequency), and least share of
# the coherence that a tone is expected to have.
_LASTING = 0.35
# Largest drift within a line and largest error of the initial frequency that are searched, in
# frequency cells either way, by choice: the cost of the search grows with the drift.
_SWEEP_CELLS, _OFFSET_CELLS = 48, 12
# Share of the energy around a tone that its subtraction leaves at most, at first, when other tones
# may be near, and in the end; wider interference leaves more.
_LEFT_AT_FIRST, _LEFT = 0.7, 0.1
# Lines that share one spectrum, by choice: more lines estimate it better, fewer follow a changing
# interferer.
_STRETCH = 32


@dataclass(frozen=True)
class Repaired:
    """Lines after the correction of interference.

    Args:
        data: Lines, shape (..., pulse, range), complex.
        touched: Lines that were changed, shape (..., pulse), bool.
        missing: Lines that could not be corrected and are zero, shape (..., pulse), bool.
        cells: Number of contaminated range-frequency cells of each line: those above the threshold,
            or all cells of a line that is dropped, shape (..., pulse), int64.
        tone_cycles: Frequency of the strongest tone of each line in cycles per sample, 0 where
            there is none, shape (..., pulse), float64.
    """

    data: Tensor
    touched: Tensor
    missing: Tensor
    cells: Tensor
    tone_cycles: Tensor


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
    power = _line_spectra(unit_level(checked_samples(raw, "find_contamination", "pulse, range")))
    density = _clean_density(power)
    excess = _excess(power, density)
    return Contamination(density, excess, excess > threshold, _stands_out(excess, threshold))


def notch_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated cells of the range spectrum to zero: a notch filter, the simplest method.

    The clutter of those cells is removed as well. Side lobes of a tone that are below the threshold
    remain; a line in which they make the power more than 1.5 times that of clutter is set to zero
    and marked as missing. Differentiable in the lines.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw, level, density, touched = _searched(raw, "notch_interference", threshold)
    spectrum = torch.fft.fft(raw)
    power = power_of(spectrum.detach()) / raw.shape[-1]
    hit = (_excess(power, density) > threshold) & touched[..., None]
    # a line that keeps more than 1.5 times the power of clutter is lost, by choice
    lost = touched & (power.masked_fill(hit, 0).sum(-1) > 1.5 * density.sum(-1))
    data = torch.where(touched[..., None], torch.fft.ifft(spectrum.masked_fill(hit, 0)), raw)
    return Repaired(
        data.masked_fill(lost[..., None], 0) * level,
        touched,
        lost,
        hit.sum(-1),
        torch.zeros_like(touched, dtype=torch.float64),
    )


def drop_interference(raw: Tensor, threshold: float = THRESHOLD) -> Repaired:
    """Set contaminated lines to zero and mark them as missing, so that a later stage can fill them.

    Differentiable in the lines.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw, level, _, touched = _searched(raw, "drop_interference", threshold)
    return Repaired(
        raw.masked_fill(touched[..., None], 0) * level,
        touched,
        touched,
        torch.where(touched, raw.shape[-1], 0),
        torch.zeros_like(touched, dtype=torch.float64),
    )


def subtract_interference(raw: Tensor, threshold: float = THRESHOLD, most_tones: int = 4) -> Repaired:
    """Subtract tones by maximum likelihood, and wider interference as a narrowband random process.

    A tone has its own frequency, linear drift, amplitude and phase in each line. Wider interference
    is subtracted in up to three bands, each narrower than about 1/40 of the sampling rate fs. The
    subtraction also removes some clutter. In a line of n samples, which has n frequency cells, a
    tone costs the clutter of 1 to 2 cells, and a band of width B that of about B n / fs cells. A
    line in which the remaining interference is stronger than the clutter is set to zero and marked
    as missing. Lines without interference are unchanged. Differentiable in the lines, with the
    frequencies and spectra of the interference held fixed.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference.
        most_tones: Largest number of tones that are subtracted from a line.

    Returns:
        `Repaired`: lines of the same shape, and masks of the changed and of the missing lines.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    raw = checked_samples(raw, "subtract_interference", "pulse, range")
    scale = level_of(raw)
    raw = raw / scale
    found = find_contamination(raw, threshold)
    nothing = torch.zeros_like(found.lines)
    if not _anything(found.lines):
        return Repaired(
            raw * scale, nothing, nothing, found.cells.sum(-1), torch.zeros_like(nothing, dtype=torch.float64)
        )
    # the marked lines of each trial; unmarked ones follow
    count = host_largest(found.lines.sum(-1), found.lines.shape[-1])
    index = torch.argsort((~found.lines).to(torch.int8), dim=-1, stable=True)[..., :count]
    wide = index[..., None].expand(*index.shape, raw.shape[-1])
    lines, density = raw.gather(-2, wide), found.density.gather(-2, wide)
    tones = _find_tones(lines, density, index.to(torch.float64), most_tones, threshold)
    touched, cycles = torch.zeros_like(index, dtype=torch.bool), torch.zeros_like(index, dtype=torch.float64)
    cleaned = lines - sum(_waveforms(lines, tones))
    for tone in reversed(tones):
        touched, cycles = touched | tone.present, torch.where(tone.present, tone.frequency, cycles)
    # at most three bands, by choice: every round costs a search of all lines
    for _ in range(3):
        banded = _find_band(cleaned, density, threshold)
        if not _anything(banded):
            break
        cleaned, touched = _subtract_band(cleaned, banded, density), touched | banded
    # lines whose cells above the threshold hold more power than the clutter of the whole line
    power = _line_spectra(cleaned.detach())
    left = (power * (_excess(power, density) > threshold)).sum(-1)
    lost = touched & (left > density.sum(-1))
    cleaned = torch.where(touched[..., None], cleaned, lines).masked_fill(lost[..., None], 0)
    touched, lost = (nothing.scatter(-1, index, mask) for mask in (touched, lost))
    return Repaired(
        raw.scatter(-2, wide, cleaned) * scale,
        touched,
        lost,
        found.cells.sum(-1) * touched,
        torch.zeros_like(nothing, dtype=torch.float64).scatter(-1, index, cycles),
    )


def _searched(raw: Tensor, name: str, threshold: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines of unit level, their level, their density, and the lines with a tone or wider
    interference that lasts the whole line.
    """
    raw = checked_samples(raw, name, "pulse, range")
    level = level_of(raw)
    raw = raw / level
    found = find_contamination(raw, threshold)
    touched = _find_band(raw, found.density, threshold) if _anything(found.lines) else found.lines
    if _anything(found.lines & ~touched):
        row = torch.arange(raw.shape[-2], dtype=torch.float64, device=raw.device).expand(touched.shape)
        for tone in _find_tones(raw, found.density, row, 1, threshold):
            touched = touched | tone.present
    return raw, level, found.density, touched


def _anything(mask: Tensor) -> bool:
    """Whether any entry is True; True inside torch.vmap, where values cannot be read."""
    return host_value(mask.any(), True)


def _line_spectra(raw: Tensor, oversampling: int = 1) -> Tensor:
    """Power spectral density of each line in FFT order, (..., pulse, oversampling * range).

    The four-term Blackman-Harris taper, whose side lobes are at -92 dB, confines a strong tone to
    +-4 cells.
    """
    n = raw.shape[-1]
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64, device=raw.device) / n
    w = 0.35875 - 0.48829 * torch.cos(turn) + 0.14128 * torch.cos(2 * turn) - 0.01168 * torch.cos(3 * turn)
    taper = (w / w.square().mean().sqrt()).to(raw.real.dtype)
    return power_of(torch.fft.fft(raw * taper, oversampling * n)) / n


def _excess(power: Tensor, density: Tensor) -> Tensor:
    """Power spectra divided by the density, cell by cell; 0 where a line is empty."""
    return torch.where(density > 0, power / torch.where(density > 0, density, 1), 0)


def _local_median(power: Tensor, width: int) -> Tensor:
    """For each cell the larger median of the two windows, overlapping by half, that hold it."""
    n = power.shape[-1]
    width = min(width, n)
    hop = max(1, width // 2)
    around_the_end = torch.cat([power[..., n - hop :], power, power[..., :width]], -1)
    windows = around_the_end.unfold(-1, width, hop)[..., : -(-n // hop) + 1, :].median(-1).values
    return torch.maximum(windows[..., :-1], windows[..., 1:]).repeat_interleave(hop, -1)[..., :n]


def _clean_density(power: Tensor) -> Tensor:
    """Mean power spectral density without interference, of spectra (..., pulse, range).

    The power of speckle divided by it has unit mean.
    """
    width = max(32, round(_LEVEL_SHARE * power.shape[-1]))

    def shape_for(gain: Tensor) -> Tensor:
        relative = torch.where(gain[..., None] > 0, power / torch.where(gain > 0, gain, 1)[..., None], torch.nan)
        return _local_median(relative.nanmedian(-2).values.nan_to_num(0.0), width)

    # lines relative to their median over the whole band, then over the part that holds signal
    shape = shape_for(power.median(-1).values)
    lit = shape > 0.1 * shape.amax(-1, keepdim=True)
    inside = torch.where(lit[..., None, :], power / torch.where(lit, shape, 1)[..., None, :], torch.nan)
    gain = inside.nanmedian(-1).values.nan_to_num(0.0)
    common = gain[..., None] * shape_for(gain)[..., None, :]
    return torch.maximum(common, _local_median(power, width)) / math.log(2)


def _stands_out(excess: Tensor, threshold: float) -> Tensor:
    """Lines that exceed the threshold in few parts of the band, (..., pulse) bool.

    Echoes of regularly spaced targets make many spectral peaks of similar strength over the whole
    pulse band, interferers only a few. The band is divided into 32 parts; a line is selected if at
    most a quarter of them contain a cell within 10 dB of its strongest cell.
    """
    n = excess.shape[-1]
    part = -(-n // 32)
    parts = pad(excess, (0, -n % part)).unflatten(-1, (-1, part)).amax(-1)
    peak = parts.amax(-1, keepdim=True)
    busy = parts > torch.maximum(0.1 * peak, torch.full_like(peak, threshold / 2))
    return (peak[..., 0] > threshold) & (busy.sum(-1) <= busy.shape[-1] // 4)


def _block_sums(x: Tensor) -> Tensor:
    """Sums (..., block) of the samples (..., n) of short blocks, which keep frequencies near zero.

    A line of 64 samples or more is divided into about 64 to 128 blocks.
    """
    n = x.shape[-1]
    length = 2 ** math.ceil(math.log2(max(1, n / 128))) if n >= 1024 else max(1, n // 64)
    return pad(x, (0, -n % length)).unflatten(-1, (-1, length)).sum(-1)


@dataclass(frozen=True)
class _Tone:
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
    """Frequency and drift that one radian of the first and second Legendre polynomial add."""
    return math.sqrt(3) / (math.pi * n), 6 * math.sqrt(5) / (math.pi * n * n)


def _coarse_offset(blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Frequency offset, and change of the frequency within the line, in cells of 1 / n cycles per
    sample, (...,) each, that give a demodulated tone the highest spectral peak.
    """
    count = blocks.shape[-1]
    u = torch.linspace(-0.5, 0.5, count, dtype=torch.float64, device=blocks.device)
    offset = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device=blocks.device) / 2
    best = torch.full(blocks.shape[:-1], -1.0, dtype=blocks.real.dtype, device=blocks.device)
    cells = sweep = torch.zeros_like(best, dtype=torch.float64)
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


def _fit_tone(lines: Tensor, cell: Tensor, present: Tensor, density: Tensor) -> _Tone:
    """Tone near a frequency cell (..., pulse) of each line by maximum likelihood, present only
    where it lasts the whole line, for a density (..., pulse) of the clutter.
    """
    n = lines.shape[-1]
    signed = torch.where(cell > n // 2, cell - n, cell).to(torch.float64)
    zero = torch.zeros_like(signed)
    tone = _Tone(signed / n, zero, present, zero)
    offset, sweep = _coarse_offset(_block_sums(lines * tone.phasor(lines).conj()))
    tone = replace(tone, frequency=tone.frequency + offset / n, rate=sweep / (n * n))
    for steps in (6, 3, 1):
        tone, blocks = _refined(lines, tone, steps)
    energy = power_of(blocks.sum(-1)) / n
    tiny, count = torch.finfo(energy.dtype).tiny, blocks.shape[-1]
    noise = torch.sqrt(density / (2 * energy.clamp_min(tiny))).to(torch.float64)
    # a chirp has a given frequency in few blocks only, whereas a tone fills all of them; the
    # coherent share of the energy expected of a tone with z = energy / density is z / (z + count)
    coherent = power_of(blocks.sum(-1)) / (count * power_of(blocks).sum(-1).clamp_min(tiny))
    z = energy / density.clamp_min(tiny)
    return replace(tone, present=present & (coherent > _LASTING * z / (z + count)), noise_rad=noise)


def _refined(lines: Tensor, tone: _Tone, steps: int) -> tuple[_Tone, Tensor]:
    """Tone after Gauss-Newton steps on the block sums of one demodulation, and those sums."""
    blocks = _block_sums(lines * tone.phasor(lines).conj())
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
def _find_tones(lines: Tensor, density: Tensor, position: Tensor, most: int, threshold: float) -> list[_Tone]:
    """Tones in lines at positions (..., pulse): the strongest first, then the strongest in what
    remains, and so on.

    A line keeps its tones only if their subtraction removes nine tenths of the energy around them;
    otherwise the energy is that of a wider interferer. In each cell, twice the mean power of
    clutter may remain in addition. Frequencies and drifts are averaged over neighbouring lines.
    """
    rest, found, n = lines, [], lines.shape[-1]
    blocked = torch.zeros(lines.shape, dtype=torch.bool, device=lines.device)
    before = excess = _excess(_line_spectra(rest), density)
    for _ in range(most):
        visible = excess.masked_fill(blocked, 0)
        strong = _stands_out(visible, threshold)
        if not _anything(strong):
            break
        peak = visible.argmax(-1)
        level = density.gather(-1, peak[..., None])[..., 0]
        tone = _fit_tone(rest, peak, strong, level)
        without = rest - tone.waveform(rest)
        after = _excess(_line_spectra(without), density)
        cell = torch.round(tone.frequency * n).to(torch.int64) % n
        distance = (torch.arange(n, device=lines.device) - cell[..., None]) % n
        near = (distance <= n // 32) | (distance >= n - n // 32)
        clutter, reached = 2 * near.sum(-1), (before * near).sum(-1)
        present = tone.present & ((after * near).sum(-1) < _LEFT_AT_FIRST * (excess * near).sum(-1) + clutter)
        rest, excess = torch.where(present[..., None], without, rest), torch.where(present[..., None], after, excess)
        blocked = blocked | near & (strong & ~present)[..., None]
        found.append((replace(tone, present=present), near, _LEFT * reached + clutter))
    tones = [replace(tone, present=tone.present & ((excess * near).sum(-1) < left)) for tone, near, left in found]
    return _refit(lines, [tone for tone in tones if _anything(tone.present)], position)


def _refit(lines: Tensor, tones: list[_Tone], position: Tensor) -> list[_Tone]:
    """Tones fitted again where a line holds several of them, each to the line without the others,
    with frequencies and drifts averaged over neighbouring lines.
    """
    n, tones = lines.shape[-1], list(tones)
    shared = sum((tone.present.int() for tone in tones), torch.zeros_like(position)) > 1
    for _ in range(2 if _anything(shared) else 0):
        waves = _waveforms(lines, tones)
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


def _waveforms(lines: Tensor, tones: list[_Tone]) -> list[Tensor]:
    """Waveform of each tone, with amplitudes that fit the lines jointly.

    The tones are fitted in turn, each to the lines from which the other tones are subtracted.
    """
    waves = [torch.zeros_like(lines) for _ in tones]
    for _ in range(3 if len(tones) > 1 else 1):
        for k, tone in enumerate(tones):
            waves[k] = tone.waveform(lines - sum(wave for j, wave in enumerate(waves) if j != k))
    return waves


def _smooth_track(value: Tensor, std: Tensor, present: Tensor, position: Tensor) -> Tensor:
    """Smooth one value per line by local straight-line fits where these fit within the noise.

    The window of the fits grows threefold in each step. Each line keeps the fit with the widest
    window whose residuals are no larger than predicted; without any, as where a tone jumps from
    line to line, it keeps its own value. All arguments have the shape (..., pulse).
    """
    weight = torch.where(present, 1 / std.square().clamp_min(1e-60), 0.0)
    weight = weight / weight.amax(-1, keepdim=True).clamp_min(1e-300)
    unit = position / position.amax(-1, keepdim=True).clamp_min(1)
    chosen, half = value, 2
    while half < value.shape[-1]:
        line, support = _local_line(value, weight, unit, half)
        misfit = torch.where(present, (value - line) / std.clamp_min(1e-30), 0.0).square()
        count = _window_sums(present.to(value.dtype), half)
        spread = _window_sums(misfit, half) / (count - 2).clamp_min(1)
        wider = half < present.sum(-1, keepdim=True)
        expected = (spread < 1 + 3 * torch.sqrt(2 / count.clamp_min(1))) & (misfit < 16)
        chosen = torch.where(present & support & wider & (count >= 5) & expected, line, chosen)
        half *= 3
    return chosen


def _window_sums(x: Tensor, half: int) -> Tensor:
    """Sums over a sliding window of 2 half + 1 lines, which is cut at the ends."""
    total = pad(x, (half + 1, half)).cumsum(-1)
    return total[..., 2 * half + 1 :] - total[..., : x.shape[-1]]


def _local_line(value: Tensor, weight: Tensor, i: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """Weighted straight-line fit in a sliding window, and where it is determined."""
    anchor = (weight * value).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-300)
    y = torch.where(weight > 0, value - anchor, 0.0)
    parts = weight, weight * i, weight * i * i, weight * y, weight * i * y
    s0, s1, s2, sy, s1y = (_window_sums(part, half) for part in parts)
    determinant = s0 * s2 - s1 * s1
    support = determinant > 1e-12 * s0 * s2.clamp_min(1e-300)
    slope = torch.where(support, (s0 * s1y - s1 * sy) / torch.where(support, determinant, 1), 0.0)
    mean = sy / torch.where(support, s0, 1)
    return anchor + mean + slope * (i - s1 / torch.where(support, s0, 1)), support


def _find_band(lines: Tensor, density: Tensor, threshold: float) -> Tensor:
    """Lines with interference that lasts the whole line, (..., pulse) bool.

    A single line of noise-like interference may look intermittent. A line therefore counts only if
    the interference lasts in most of the neighbouring lines that exceed the threshold.
    """
    lines = lines.detach()
    excess = _excess(_line_spectra(lines), density)
    strong = _stands_out(excess, threshold)
    if not _anything(strong):
        return strong
    frequency = excess.argmax(-1).to(torch.float64) / lines.shape[-1]
    carrier = _Tone(frequency, torch.zeros_like(frequency), strong, frequency).phasor(lines)
    power = power_of(_block_sums(lines * carrier.conj()))
    lasts = power.median(-1).values > _LASTING * power.mean(-1)
    votes, of_all = (_window_sums(x.to(torch.float64), _STRETCH // 2) for x in (strong & lasts, strong))
    return strong & (votes > 0.5 * of_all)


def _subtract_band(lines: Tensor, touched: Tensor, density: Tensor) -> Tensor:
    """Lines less the interference near the strongest cell of each group of 32 lines, where touched.

    Differentiable in the lines, with the spectrum of the interference held fixed.
    """
    n_pulse, n = lines.shape[-2:]
    fill = -n_pulse % _STRETCH
    x, floor = (pad(part, (0, 0, 0, fill)).unflatten(-2, (-1, _STRETCH)) for part in (lines, density))
    on = pad(touched, (0, fill)).unflatten(-1, (-1, _STRETCH))
    # spectrum over the density at half cells, mean of the marked lines of a group; one line of
    # every group at a time takes a fraction of the memory of all at once
    total = torch.zeros(*x.shape[:-2], 2 * n, dtype=x.real.dtype, device=x.device)
    for k in range(_STRETCH):
        fine = floor[..., k, :].repeat_interleave(2, -1)
        total = total + on[..., k, None] * _excess(_line_spectra(x[..., k, :].detach(), 2), fine)
    excess = total / on.sum(-1).clamp_min(1)[..., None]
    # the band around the strongest half cell, and interferer over clutter there
    m = 2 * max(8, round(n * _LEVEL_SHARE / 2))
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
    points, and C (C + 1)^-1 x = F q (1 + q F^H F q)^-1 q F^H x with q^2 = ratio: an m x m solve per
    group.
    """
    n, m = x.shape[-1], ratio.shape[-1]
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


class _InterferenceCorrection(Stage):
    """Common part of the three stages.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    provides = ("missing",)
    neutral = {"missing": False}
    repair: Callable[..., Repaired]

    def __init__(self, threshold: float = THRESHOLD, *, assess: bool = True) -> None:
        super().__init__()
        if not threshold > 1:
            raise ValueError(
                "threshold must be above 1 (the mean power of clutter), got "
                f"{threshold}; 20 to 50 is useful, {THRESHOLD:g} the default"
            )
        self.threshold, self.assess = float(threshold), assess

    def forward(self, signal: Signal, missing: Tensor | None = None) -> tuple[Signal, Estimate]:
        """Correct raw lines that contain narrowband interference.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            missing: Lines that earlier stages marked as missing, shape (..., pulse), bool.

        Returns:
            The corrected signal, and an Estimate with `missing` of shape (..., pulse), bool: lines
            that were missing before, or that this stage could not correct and set to zero.
            `quality` is the share of lines that this stage did not set to zero. The outcome is
            EMPTY for data that are all zero, MISFIT where lines with more than four times the
            median power of their neighbours hold more power than the rest (interference that is not
            narrowband, or too short to be found), and TOO_FEW where less than half of the lines
            remain. It is OK where there is no interference. `info` holds, for each trial, the
            numbers of corrected lines, `lines_touched`, and of contaminated frequency cells,
            `cells_touched`; and for each line whether it was corrected, `touched`, and the
            frequency of its strongest tone, `tone_cycles_per_sample`.
        """
        result = type(self).repair(signal.data, self.threshold)
        given_up = result.missing if missing is None else result.missing | missing.bool()
        info = {
            "lines_touched": result.touched.sum(-1),
            "cells_touched": result.cells.sum(-1),
            "touched": result.touched,
            "tone_cycles_per_sample": result.tone_cycles,
        }
        not_assessed: dict[str, Any] = {"outcome": Outcome.NOT_ASSESSED.like(info["lines_touched"])}
        judged = assess_lines(result.data, result.missing) if self.assess else not_assessed
        return signal.with_data(result.data), Estimate({"missing": given_up}, **judged, info=info)


class SubtractInterference(_InterferenceCorrection):
    """Stage that subtracts narrowband interference (recommended); see `subtract_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(subtract_interference)


class NotchInterference(_InterferenceCorrection):
    """Stage that removes narrowband interference by a notch filter; see `notch_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(notch_interference)


class DropInterference(_InterferenceCorrection):
    """Stage that sets lines with interference to zero, so that a later stage can fill them.

    The stage returns the mask of these lines as `missing`; see `drop_interference`.

    Args:
        threshold: Ratio of the power of a frequency cell to the mean power of clutter above which
            the cell counts as interference; 20 to 50 is useful.
        assess: Whether to add quality and outcome.

    Raises:
        ValueError: If the threshold is not above 1.
    """

    repair = staticmethod(drop_interference)
