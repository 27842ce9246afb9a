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

Tones in raw lines by maximum likelihood.

A tone is A exp(2j pi (f t + r t^2 / 2)) over the whole line, with t in samples from the middle of
the line. Each line has its own complex amplitude A, frequency f (cycles per sample) and linear
drift r (cycles per sample^2). To refine f and r, a line is demodulated with their first estimates
and projected on the Legendre polynomials of degree 0, 1 and 2 over t. At the maximum of the
likelihood the coefficients of degree 1 and 2 are in phase with that of degree 0; parts in
quadrature give the Gauss-Newton steps of f and r. Every real parameter that is fitted to a line
also removes half a frequency cell of its clutter. Therefore f and r are averaged over neighbouring
lines wherever the tone drifts smoothly.

Interference that is wider than a tone, subtracted as a narrowband random process.

A group of 32 successive lines shares one spectrum of the interferer: the excess of their averaged
range spectra over clutter. Each line is modelled as a stationary process with that spectrum plus
white clutter, and the conditional mean of the process is subtracted. The model accounts for the
finite length of a line: its n samples are a part of a process with the period 2 n. The spectral
leakage of a strong interferer is therefore subtracted as well, which a notch filter cannot do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

from torchsar.core import checked_samples, cholesky_factor, host_value, power_of, unit_level, unit_phasor
from torchsar.repair.response import unit_legendre

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
