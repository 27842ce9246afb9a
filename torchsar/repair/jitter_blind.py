"""Estimation of periodic jitter from the recorded clutter, without a pilot tone.

Clutter is stationary along range: its spectrum has no correlation between different frequencies.
Jitter e[n mod M] with the Fourier coefficients E_k = (1 / M) sum_m e[m] exp(-2j pi k m / M) makes
it cyclostationary: its spectrum Y is then correlated at frequencies k / M apart. To first order,
with the power spectrum S, the mean <> over lines and frequencies wrapped to +-1/2 cycle per sample,

    <Y(f) Y*(f - k/M)> = 2j pi E_k [(f - k/M) S(f - k/M) - f S(f)].

Each E_k is fitted to this relation over the band by least squares. Then the lines are corrected
exactly and fitted again, which removes the terms of higher order. The converter adds noise that has
no jitter; to such noise the correction gives a correlation of its own, with which its share of all
noise is fitted. Noise that reaches the converter has the jitter of the signal. Where f - k/M is
wrapped, the bracket jumps; this distinguishes jitter from a periodic gain, whose correlation
S(f) + S(f - k/M) is fitted along with it. The mean offset (k = 0) cannot be observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, Signal, Stage, checked_samples
from torchsar.repair.jitter import MIN_GAP, correct_jitter_exact, smallest_gap

# Largest standard deviation of an offset that is ok, in samples (-24 dB of the signal).
_MOST_STD = 0.01
# Largest rms offset that is ok, in samples, found by trial: above 0.23 the fits settle on wrong
# offsets.
_MOST_RMS = 0.22
# Error of the noise level: that of the lowest twentieth of a spectrum of 256 looks or more.
_NOISE_ERROR = 0.08
# Least power over its mean that a frequency is given: the ends of a line leak as much.
_LEAST_POWER = 1e-5
# Standard deviation of a share that may be anything between 0 and 1.
_MOST_SHARE = 0.3
# Share of the standard deviation below which a further fit changes nothing of interest, by choice.
_SETTLED = 0.1
# Limits of the factor by which a fitted change is lengthened or shortened, by choice.
_SHORTEST, _LONGEST = 0.3, 2.0


@dataclass(frozen=True)
class CyclicFit:
    """First-order estimate of timing jitter for one assumed period of M samples.

    Args:
        coefficient: Fourier coefficients E_1 to E_(M-1) of the M timing offsets in samples, shape
            (..., M - 1), complex.
        variance: Variance of each coefficient in samples^2, shape (..., M - 1).
        noise: Share of the power of the lines that is noise, shape (...,).
        converter: Share of the noise that the converter adds, fitted to corrected lines, shape
            (...,).
        converter_std: Standard deviation of this share, shape (...,); infinite without correction.
    """

    coefficient: Tensor
    variance: Tensor
    noise: Tensor
    converter: Tensor
    converter_std: Tensor

    def significance(self, primitive: bool = False) -> Tensor:
        """Return the chi-squared statistic of the Fourier coefficients of the jitter.

        Without jitter it has as many degrees of freedom as coefficients are counted.

        Args:
            primitive: Whether to count only the coefficients E_k for which k and the period have no
                common divisor. Coefficients with a common divisor also occur for a shorter period.

        Returns:
            Statistic, shape (...,).
        """
        m = self.coefficient.shape[-1] + 1
        used = [k - 1 for k in range(1, m) if not primitive or math.gcd(k, m) == 1]
        return (self.coefficient.abs().square() / self.variance)[..., used].sum(-1)

    def excess(self, period: int) -> Tensor:
        """Return the mean square of jitter that a shorter period lacks, beyond what chance gives.

        Args:
            period: Shorter period, which divides M.

        Returns:
            Mean square in samples^2, less the mean and twice the standard deviation of chance,
            shape (...,); it may be negative.
        """
        m = self.coefficient.shape[-1] + 1
        other = torch.arange(1, m, device=self.variance.device) * period % m != 0
        chance = (self.variance * other).sum(-1) + 2 * ((self.variance * other).square().sum(-1) * 2).sqrt()
        return (self.coefficient.abs().square() * other).sum(-1) - chance

    @property
    def offset_samples(self) -> Tensor:
        """Timing offsets of the M converters in samples, with mean zero, shape (..., M)."""
        m = self.coefficient.shape[-1] + 1
        return torch.fft.ifft(torch.nn.functional.pad(self.coefficient, (1, 0)) * m).real

    @property
    def std_samples(self) -> Tensor:
        """Standard deviation of each timing offset in samples, equal for all, shape (...,)."""
        return torch.sqrt(self.variance.sum(-1))


def cyclic_fit(y: Tensor, period: int, corrected: Tensor | None = None, converter: Tensor | float = 1.0) -> CyclicFit:
    """Fit the Fourier coefficients of timing jitter to correlations in the range spectrum.

    Jitter of period M correlates spectral components that lie k / M cycles per sample apart, with
    whole k from 1 to M - 1. The variance includes the scatter of the correlations about the fit, so
    that lines that resemble each other do not count as independent.

    Args:
        y: Lines, shape (..., pulse, range), complex.
        period: Period M in samples.
        corrected: Offsets in samples with which the lines were corrected, shape (..., M); lines are
            then a multiple of M long. None: none.
        converter: Share of the noise that the converter adds, shape (...,) or a number.

    Returns:
        Coefficients of the jitter that remains, and their variance.
    """
    n = y.shape[-1] - y.shape[-1] % period
    taper = _taper(n, y.device)
    spectrum = torch.fft.fft(y[..., :n] * taper.to(y.real.dtype)).to(torch.complex128)
    related = n * taper.pow(4).sum() / taper.square().sum().square()  # neighbours in a tapered spectrum
    lines = y.shape[-2]
    power = _smooth(spectrum.abs().square().mean(-2), max(1, 256 // lines))
    power = power / power.mean(-1, keepdim=True).clamp_min(1e-300)
    noise = None if corrected is None else _corrected_noise(corrected, n)
    density = torch.ones_like(power) if noise is None else noise.abs().square().mean(-2)
    floor = noise_floor(power / density)[..., None]
    share = torch.as_tensor(converter, dtype=torch.float64, device=y.device).expand(floor.shape[:-1])[..., None]
    level = floor * share
    signal = (power - level * density).clamp_min(0)  # noise of the converter has no jitter
    scale = spectrum.abs().square().mean((-2, -1)).clamp_min(1e-300)
    frequency = torch.fft.fftfreq(n, dtype=torch.float64, device=y.device)
    coefficient, variance = [], []
    seen, information_seen = torch.zeros_like(level[..., 0]), torch.zeros_like(level[..., 0])
    scatter_seen = torch.zeros_like(seen)
    for k in range(1, period // 2 + 1):
        step = k * (n // period)
        cross = (spectrum * torch.roll(spectrum, step, -1).conj()).mean(-2) / scale[..., None]
        own = None if noise is None else floor * (noise * torch.roll(noise, step, -1).conj()).mean(-2)
        if own is not None:
            cross = cross - share * own
        other = torch.roll(power, step, -1)
        slope = 2j * math.pi * (torch.roll(frequency * signal, step, -1) - frequency * signal)
        weight = 1 / (power.clamp_min(_LEAST_POWER) * other.clamp_min(_LEAST_POWER))
        both = power + other  # the correlation that a periodic gain gives; its share is taken out
        scale_both = (weight * both.square()).sum(-1, keepdim=True).clamp_min(1e-150)
        slope = slope - both * ((weight * both * slope).sum(-1, keepdim=True) / scale_both)
        cross = cross - both * ((weight * both * cross).sum(-1, keepdim=True) / scale_both)
        information = (weight * slope.abs().square()).sum(-1).clamp_min(1e-150)
        value = (weight * slope.conj() * cross).sum(-1) / information
        rest = cross - slope * value[..., None]
        scatter = (weight * slope).abs() * rest.abs()
        coefficient.append(value)
        variance.append(related * scatter.square().sum(-1).clamp_min(1e-300) / information.square())
        if own is not None:  # the part of the noise's correlation that jitter and gain do not explain
            own = own - both * ((weight * both * own).sum(-1, keepdim=True) / scale_both)
            own = own - slope * ((weight * slope.conj() * own).sum(-1) / information)[..., None]
            seen = seen + (weight * (own.conj() * rest).real).sum(-1)
            information_seen = information_seen + (weight * own.abs().square()).sum(-1)
            scatter_seen = scatter_seen + (weight * own.abs() * rest.abs()).square().sum(-1)
    mirrored = [c.conj() for c in reversed(coefficient[: (period - 1) // 2])]
    return CyclicFit(
        torch.stack(coefficient + mirrored, -1),
        torch.stack(variance + list(reversed(variance[: (period - 1) // 2])), -1),
        (floor * density).mean(-1),
        share[..., 0] + seen / information_seen.clamp_min(1e-150),
        torch.where(
            information_seen > 1e-150, (related * scatter_seen).sqrt() / information_seen.clamp_min(1e-150), math.inf
        ),
    )


def _taper(n: int, device: torch.device) -> Tensor:
    """Window that falls smoothly to zero over a sixteenth of a line at both ends, (n,): the ends of
    a recorded line do not join, and would give correlations of their own.
    """
    end = (torch.arange(n, dtype=torch.float64, device=device) + 0.5) / (n / 16)
    return torch.sin(math.pi / 2 * torch.minimum(end, end.flip(0)).clamp_max(1)).square()


def _corrected_noise(offsets: Tensor, n: int) -> Tensor:
    """Spectra of corrected impulses at the first M samples, (..., M, n).

    The correction repeats every M samples, so that the means over the M impulses of their power and
    of their products at k / M apart are those of corrected white noise of unit power.
    """
    m = offsets.shape[-1]
    impulse = torch.eye(m, n, dtype=torch.complex128, device=offsets.device)
    return torch.fft.fft(correct_jitter_exact(impulse.expand(*offsets.shape[:-1], m, n), offsets))


def noise_floor(power: Tensor) -> Tensor:
    """Estimate the noise level of a range spectrum: the power that a twentieth of the bins do not
    exceed.

    Args:
        power: Smoothed power spectrum, shape (..., n).

    Returns:
        Noise level, shape (...,).
    """
    return power.kthvalue(max(1, power.shape[-1] // 20), dim=-1).values


def _smooth(power: Tensor, width: int) -> Tensor:
    """Circular running mean over an odd number of bins near `width`."""
    half = min(width // 2, (power.shape[-1] - 1) // 2)
    return sum((torch.roll(power, i, -1) for i in range(-half, half + 1)), torch.zeros_like(power)) / (2 * half + 1)


def detect_jitter_period(y: Tensor, max_period: int = 16) -> Tensor:
    """Find the shortest period that explains all significant Fourier coefficients of the jitter.

    For each period, only the coefficients are tested that do not occur for a shorter period; the
    false-alarm rate is below 1e-5 per trial. A period whose coefficients are more than 27 dB weaker
    than those of the strongest period is ignored, since leakage can cause them.

    Args:
        y: Lines, shape (..., pulse, range), complex.
        max_period: Longest period that is tested.

    Returns:
        Period in samples, 1 where there is no jitter, shape (...,), int64.
    """
    found = {m: cyclic_fit(_some_lines(y), m).significance(primitive=True) for m in range(2, max_period + 1)}
    leak = 0.002 * torch.stack(list(found.values())).amax(0)
    new = {m: sum(math.gcd(k, m) == 1 for k in range(1, m)) for m in found}
    counted = {m: torch.where(chi > 9 * new[m] + 16 + leak, chi, 0) for m, chi in found.items()}
    explained = [
        sum((counted[m] for m in counted if p % m == 0), torch.zeros_like(leak)) * (1 - 1e-9 * p)
        for p in range(1, max_period + 1)
    ]
    return torch.stack(explained).argmax(0) + 1


def _some_lines(y: Tensor, lines: int = 256) -> Tensor:
    """About this number of lines, spread over the recording."""
    return y[..., :: max(1, y.shape[-2] // lines), :]


def _hidden(y: Tensor, period: int, offsets: Tensor, converter: Tensor, max_period: int) -> Tensor:
    """Largest mean square in samples^2 of jitter that a multiple of the period shows beyond chance
    in lines (trial, pulse, range) after correction of the offsets (trial, period), (trial,).
    """
    y = _some_lines(y)
    most = torch.zeros(y.shape[0], dtype=torch.float64, device=y.device)
    for p in range(2 * period, max_period + 1, period):
        cut = y[..., : y.shape[-1] - y.shape[-1] % p]
        tiled = offsets.repeat(1, p // period)
        fit = cyclic_fit(correct_jitter_exact(cut, tiled), p, tiled, converter) if period > 1 else cyclic_fit(cut, p)
        most = torch.maximum(most, fit.excess(period))
    return most


def estimate_jitter_blind(y: Tensor, max_period: int = 16, period: int | None = None, passes: int = 12) -> Estimate:
    """Estimate the period and the offsets of periodic timing jitter from clutter, without a pilot.

    The signal must fill most of the sampled band, but leave a twentieth of it to noise alone, where
    the power of the noise is measured: noise that the converter adds has no jitter, and its share
    of the noise is estimated. A periodic gain that accompanies the jitter is modelled to first
    order. Not differentiable.

    Args:
        y: Raw or range-compressed lines, shape (..., pulse, range), complex, in any order.
        max_period: Longest period that is tested.
        period: Known period in samples; None: the period is estimated.
        passes: Largest number of fits; before each, lines are corrected with the offsets found so
            far.

    Returns:
        Estimate with `offset_samples` of shape (..., P), in samples, with mean zero, and their
        standard deviations; and `period` of shape (...,), int64. P is the known period or
        `max_period`; beyond the period of a trial its offsets repeat. The standard deviation
        includes jitter that is visible, but not so far above chance that its period is certain.
        `quality` is m / (m + v), with the mean square m of the offsets and the variance v of their
        errors, or 1 where there is no jitter. `ok` is False, and the offsets are zero, where a
        trial is all zero, the standard deviation is 0.01 samples or more (for `max_period` where no
        jitter is found; so for a scene of one or few points, whose lines resemble each other), less
        than half of the power is above the noise, the rms of the offsets is 0.22 samples or more,
        or sample instants would coincide or cross.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the period is less than
            2, or lines are shorter than 8 periods.
    """
    y = checked_samples(y, "estimate_jitter_blind", "line, range")
    longest = max_period if period is None else period
    if longest < 2 or y.shape[-1] < 8 * longest:
        raise ValueError(
            "blind jitter estimation needs a period of 2 samples or more and lines of 8 periods or more, "
            f"got a period of {longest} and lines of {y.shape[-1]} samples; give longer lines or a shorter period"
        )
    rows = y.detach().reshape(-1, *y.shape[-2:])
    periods = (
        detect_jitter_period(rows, max_period)
        if period is None
        else torch.full(rows.shape[:1], period, device=y.device)
    )
    offsets, std = (torch.zeros((rows.shape[0], longest), dtype=torch.float64, device=y.device) for _ in range(2))
    share = _signal_share(rows)
    ok = (rows.abs().amax((-2, -1)) > 0) & (share >= 0.5)
    tiled = torch.arange(longest, device=y.device)
    for m in torch.unique(periods).tolist():
        chosen = (periods == m).nonzero()[:, 0]
        if m == 1:
            total = torch.zeros((len(chosen), 1), dtype=torch.float64, device=y.device)
            converter = total[:, 0]
            chance, left = cyclic_fit(rows[chosen], longest).std_samples, total[:, 0]
        else:
            total, chance, left, converter = refine_offsets(rows[chosen], m, passes)
        offsets[chosen] = total[..., tiled % m]
        hidden = left.square() * 0 if period else _hidden(rows[chosen], m, total, converter, max_period)
        chance = chance.square()
        # offsets of zero err by the jitter alone
        square = torch.maximum(chance, hidden) if m == 1 else chance + left.square() + hidden
        std[chosen] = square.sqrt()[..., None].expand(-1, longest)
    ok = (
        ok
        & (std[:, 0] < _MOST_STD)
        & (offsets.square().mean(-1).sqrt() < _MOST_RMS)
        & (smallest_gap(offsets) >= MIN_GAP)
    )
    offsets = torch.where(ok[..., None], offsets, 0)
    size, chance = offsets.square().mean(-1), std.square().mean(-1)
    quality = torch.where(ok, size / (size + chance).clamp_min(1e-300), 0) + (ok & (periods == 1)).to(torch.float64)
    shape = y.shape[:-2]
    value = {"offset_samples": offsets.reshape(*shape, longest), "period": periods.reshape(shape)}
    return Estimate(
        value,
        {"offset_samples": std.reshape(*shape, longest)},
        quality.clamp(0, 1).reshape(shape),
        Outcome.of(ok.reshape(shape), Outcome.NOISE),
    )


def _signal_share(y: Tensor) -> Tensor:
    """Share of the power of lines (trial, pulse, range) that lies above the noise, (trial,)."""
    unit = y / y.abs().amax((-2, -1), keepdim=True).clamp_min(torch.finfo(y.real.dtype).tiny)
    unit = unit * _taper(y.shape[-1], y.device).to(y.real.dtype)
    power = torch.fft.fft(unit).abs().square().mean(-2).to(torch.float64)
    power = _smooth(power, max(1, 256 // y.shape[-2]))
    return 1 - noise_floor(power) / power.mean(-1).clamp_min(1e-300)


def refine_offsets(y: Tensor, period: int, passes: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit the timing offsets, correct the recording with them, and fit what remains, repeatedly.

    Args:
        y: Lines, shape (trial, pulse, range), complex.
        period: Period M of the jitter in samples.
        passes: Largest number of fits. A trial is finished when its offsets no longer change.

    Returns:
        The total offsets in samples, shape (trial, M), the standard deviation that chance and the
        unknown share of the converter in the noise give them, the rms of their last change, and the
        share of the converter in the noise, shape (trial,) each.

    The changes are scaled by the factor of Irons and Tuck (1969), since large jitter makes the
    first-order fit too long or too short.
    """
    y = y[..., : y.shape[-1] - y.shape[-1] % period]
    total, change = (torch.zeros((y.shape[0], period), dtype=torch.float64, device=y.device) for _ in range(2))
    factor, std = torch.ones_like(total[:, 0]), torch.zeros_like(total[:, 0])
    converter = torch.ones_like(std)
    active = torch.arange(y.shape[0], device=y.device)
    for i in range(passes):
        at, before = total[active], change[active]
        corrected = correct_jitter_exact(y[active], at) if i else y
        fit = cyclic_fit(corrected, period, at if i else None, converter[active])
        step = fit.offset_samples
        if i:
            turned = before - step
            factor[active] *= (before * turned).sum(-1) / turned.square().sum(-1).clamp_min(1e-300)
            factor[active] = factor[active].clamp(_SHORTEST, _LONGEST)
        moved = at + factor[active, None] * step.clamp(-0.4, 0.4)
        total[active] = torch.where((smallest_gap(moved) >= 2 * MIN_GAP)[:, None], moved, at)
        converter[active] = torch.where(fit.converter_std < _MOST_SHARE, fit.converter.clamp(0, 1), converter[active])
        unknown = torch.hypot(fit.converter_std.clamp_max(_MOST_SHARE), torch.full_like(factor[active], _NOISE_ERROR))
        level = unknown * fit.noise / (1 - fit.noise).clamp_min(0.1) * total[active].square().mean(-1).sqrt()
        std[active], change[active] = torch.hypot(fit.std_samples, level), step
        active = active[step.square().mean(-1).sqrt() > _SETTLED * fit.std_samples]
        if not len(active):
            break
    return total, std, change.square().mean(-1).sqrt(), converter


class BlindJitter(Stage):
    """Estimator of periodic sampling jitter from the clutter of the recording.

    If this stage is named "blind" in a chain, the jitter is corrected by the later stage
    `use(CorrectJitter(), offset_samples="blind", period="blind")`.

    Args:
        max_period: Longest period that is tested, in samples.
        period: Known period in samples; None: the period is estimated.
    """

    provides = ("offset_samples", "period")
    neutral = {"offset_samples": 0.0, "period": 1}

    def __init__(self, max_period: int = 16, period: int | None = None) -> None:
        super().__init__()
        self.max_period, self.period = max_period, period

    def forward(self, signal: Signal) -> Estimate:
        """Estimate period and offsets of the timing jitter; see `estimate_jitter_blind`.

        Args:
            signal: Raw or range-compressed lines, shape (..., pulse, range).

        Returns:
            Estimate with `offset_samples` in samples and `period`.
        """
        return estimate_jitter_blind(signal.data, self.max_period, self.period)
