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

Estimation of periodic jitter from a pilot tone recorded by the same converter.

A tone of f cycles per sample, taken at n + e[n mod M], has the phase 2 pi f (n + e[n mod M]) +
constant. After removal of the tone, the samples m, m + M, m + 2 M, ... have the mean phase
2 pi f e[m]. The frequency f is estimated from the record. The period M is found by a test of
significance, so that a converter without jitter gives offsets of exactly zero.

Reference:
    Tsvetkov 2017, Fig. 4 (estimation from pilot signals).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    differentiable,
    linear_phasor,
    take,
    unit_level,
)
from torchsar.repair.assess import assess_offsets, of_trials
from torchsar.repair.jitter import MIN_GAP, correct_jitter_exact, smallest_gap, uncrossed


@differentiable("where ok")
def estimate_jitter_pilot(
    pilot: Tensor, max_period: int = 16, period: int | None = None, origin: str = "mean", *, assess: bool = True
) -> Estimate:
    """Estimate the period and the offsets of periodic timing jitter from a pilot tone.

    >>> import torch
    >>> n = torch.arange(64.0).double() + torch.tensor([-0.1, 0.1]).repeat(32)
    >>> found = estimate_jitter_pilot(torch.exp(2j * torch.pi * 0.2 * n), max_period=4)
    >>> int(found["period"]), round(float(found["offset_samples"][1]), 3)
    (2, 0.1)

    The pilot cannot determine the mean offset, which is a delay; `origin` sets it by convention.

    Args:
        pilot: Record of one tone of any frequency other than zero, shape (..., n), complex.
        max_period: Longest period that is tested.
        period: Known period in samples; None: the period is estimated.
        origin: "mean" sets the mean offset to zero, "first" the first one.
        assess: Whether to add standard deviations, quality and outcome.

    Returns:
        Estimate with `offset_samples` of shape (..., P), in samples, and `period` of shape (...,),
        int64. P is the known period or `max_period`; beyond the period of a trial its offsets
        repeat. Offsets with which sample instants would coincide or cross are zero. The standard
        deviation is the Cramer-Rao bound at the measured noise; where no jitter is found, that for
        the longest period. `quality` is the share of the record's power that belongs to the tone.
        `info` has the frequency of the tone in cycles per sample, `frequency_cycles`. The outcome
        is EMPTY for a record of zeros or one that is not finite, SINGULAR where offsets would
        coincide or cross, NOISE where no tone exceeds the noise or the tone is too close to zero
        frequency, and INEXACT where the bound for the longest period tested is 0.01 samples or
        more, so that jitter may be missed.

    Raises:
        ValueError: If the record is shorter than 4 periods, the period is less than one, or the
            origin is unknown.
        TypeError: If the record is real.
    """
    longest = max_period if period is None else period
    if longest < 1:
        raise ValueError(f"a jitter period must be at least one sample, got {longest}")
    if origin not in ("mean", "first"):
        raise ValueError(f"origin {origin!r} is unknown; choose one of ('mean', 'first')")
    n = pilot.shape[-1] if pilot.ndim else 0
    if n < 4 * longest:
        raise ValueError(
            f"pilot must hold at least {4 * longest} samples, 4 jitter periods of {longest} samples, got {n}; "
            "record a longer tone or lower max_period"
        )
    pilot = checked_samples(pilot, "estimate_jitter_pilot", "range", finite=False)
    finite = torch.isfinite(torch.view_as_real(pilot)).flatten(-2).all(-1)
    x = unit_level(torch.where(finite[..., None], pilot, 0).to(torch.complex128), 1)
    periods = range(1, longest + 1) if period is None else [longest]
    *fits, phases = zip(*(_fit(x, m) for m in periods), strict=True)
    frequency, noise, power, jitter = (torch.stack(parts, -1) for parts in fits)
    best = _choose(noise, power, jitter, n) if period is None else torch.zeros_like(power[..., 0], dtype=torch.int64)
    tiled = torch.arange(longest, device=x.device)
    phase = take(torch.stack([phase[..., tiled % m] for m, phase in zip(periods, phases, strict=True)], -2), best, -2)
    frequency, noise, power = (take(x, best) for x in (frequency, noise, power))
    m = best + periods[0]
    radians = 2 * math.pi * torch.where(frequency.abs() > 1 / n, frequency, torch.inf)
    offsets = phase / radians[..., None]
    if origin == "first":
        offsets = offsets - offsets[..., :1]
    value = {"offset_samples": uncrossed(offsets), "period": m}
    info = {"frequency_cycles": frequency}
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(m), info=info)
    # Cramer-Rao bound of an offset, relative to the mean of all or to the first one
    bound = torch.sqrt(noise / (2 * n * power.clamp_min(1e-300))) / radians.abs()
    tested = bound * math.sqrt(longest - 1)
    std = torch.where(m == 1, tested, bound * torch.sqrt(m - 1.0))[..., None].expand(offsets.shape)
    if origin == "first":
        std = std * math.sqrt(2) * torch.sqrt(m / (m - 1).clamp_min(1))[..., None] * (tiled % m[..., None] != 0)
    tone = (power * n > 50 * noise) & torch.isfinite(radians)
    return Estimate(
        value,
        **assess_offsets(offsets, std, tested, tone, finite & (power > 0), power / (power + noise).clamp_min(1e-300)),
        info=info,
    )


def _fit(x: Tensor, m: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Fit a tone with one free phasor for each of M interleaved converters.

    The frequency is that of the strongest spectral line, refined jointly with the phasors by the
    phase slope that remains.

    Returns for each trial the frequency in cycles per sample, the variance of a sample about the
    fit, the mean power of the phasors, and the weighted squares of their phases. The last result is
    the phases in rad relative to the tone, with mean zero, (..., M). The squares are weighted so
    that without jitter their ratio to the noise is chi-squared with M - 1 degrees of freedom.
    """
    n, fine = x.shape[-1], 4 * x.shape[-1]
    peak = torch.fft.fft(x, fine).abs().argmax(-1)
    frequency = (peak - fine * (2 * peak >= fine)).to(torch.float64) / fine
    index = torch.arange(n, device=x.device) % m
    count = torch.bincount(index, minlength=m).to(torch.float64)
    position = torch.arange(n, dtype=torch.float64, device=x.device) - (n - 1) / 2
    steps = 12  # after 12 steps the frequency is exact even in short records of strong jitter
    for step in range(steps):
        z = x * linear_phasor(-frequency, 0, n, x.dtype)
        phasor = torch.zeros((*x.shape[:-1], m), dtype=x.dtype, device=x.device).index_add(-1, index, z) / count
        aligned = z * phasor[..., index].conj()
        if step < steps - 1:
            scale = phasor.abs().square().sum(-1).clamp_min(1e-300) / m
            frequency = frequency + (position * aligned.imag).sum(-1) / scale / (2 * math.pi * position.square().sum())
    noise = (z - phasor[..., index]).abs().square().sum(-1) / max(1, n - m - 1)
    phase = torch.angle(phasor * phasor.sum(-1, keepdim=True).conj())
    phase = phase - phase.mean(-1, keepdim=True)
    power = phasor.abs().square()
    return frequency, noise, power.mean(-1), (2 * count * power * phase.square()).sum(-1), phase


def _choose(noise: Tensor, power: Tensor, jitter: Tensor, n: int) -> Tensor:
    """Index (...,) of the shortest period that explains the record of n samples.

    noise, power, jitter: see `_fit`, (..., period). The threshold of 14 + 4 (M - 1) keeps false
    alarms below 1e-4 per trial.
    """
    # Rounding errors of float64 in a record of up to 1024 samples without noise, relative to the
    # squared phases of jitter and to the power. They grow with longer records. Without this limit
    # they would look like jitter of a longer period.
    longer = max(1.0, n / 1024)
    rounding = torch.maximum(1e-13 * longer * jitter.amax(-1), 1e-28 * longer * power[..., 0] + 1e-300)
    index = torch.arange(jitter.shape[-1], device=jitter.device)
    threshold = torch.where(index > 0, 14 + 4 * index, 0)
    return (jitter / noise.amin(-1).maximum(rounding)[..., None] - threshold).argmax(-1)


class PilotJitter(Stage):
    """Estimator of periodic sampling jitter from a recorded pilot tone.

    >>> import torch
    >>> from torchsar import Signal, radar, repair
    >>> n, offset = torch.arange(64), torch.tensor([-0.1, 0.1])
    >>> pilot = torch.exp(0.4j * torch.pi * (n + offset.repeat(32)))
    >>> lines = Signal(pilot[None], radar.InverseRadar(10e9, 1e9, 1e3).raw_axes(1, 64))
    >>> repair.PilotJitter(max_period=4)(lines, pilot)["offset_samples"].round(decimals=3).tolist()
    [-0.1, 0.1, -0.1, 0.1]

    In a chain, `use(PilotJitter(), pilot="aux.pilot")` takes the record of the tone from the side
    data `pilot` of the recording. The signal is unchanged.

    Args:
        max_period: Longest period that is tested, in samples.
        period: Known period in samples; None: the period is estimated.
        origin: "mean" sets the mean offset to zero, "first" the first one.
        assess: Whether to add standard deviations, quality and outcome.
    """

    provides = ("offset_samples", "period")
    neutral = {"offset_samples": 0.0, "period": 1}
    differentiable = "where ok"

    def __init__(
        self, max_period: int = 16, period: int | None = None, origin: str = "mean", *, assess: bool = True
    ) -> None:
        super().__init__()
        self.max_period, self.period, self.origin, self.assess = max_period, period, origin, assess

    def forward(self, signal: Signal, pilot: Tensor) -> Estimate:
        """Estimate period and offsets of the timing jitter; see `estimate_jitter_pilot`.

        Args:
            signal: Lines, shape (..., pulse, range), of which only the number of trials is used.
            pilot: Record of the tone, shape (..., n), or (n,) for all trials.

        Returns:
            Estimate with `offset_samples` in samples and `period`.

        Raises:
            ValueError: If the record does not fit the trials of the signal.
        """
        if not pilot.ndim or (pilot.ndim > 1 and pilot.shape[:-1] != signal.trials):
            raise ValueError(
                f"pilot must have the shape (n,), or (*trials, n) with the trials {tuple(signal.trials)} of the "
                f"signal, got the shape {tuple(pilot.shape)}"
            )
        pilot = pilot.expand(*signal.trials, pilot.shape[-1])
        return estimate_jitter_pilot(pilot, self.max_period, self.period, self.origin, assess=self.assess)


# least standard deviation of a share that means that it may have any value between 0 and 1
_MOST_SHARE = 0.3


def cyclic_fit(
    y: Tensor, period: int, corrected: Tensor | None = None, converter: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
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
        First-order estimate of the jitter that remains:

        - Fourier coefficients E_1 to E_(M-1) of the M timing offsets in samples, shape
          (..., M - 1), complex;
        - variance of each coefficient in samples^2, shape (..., M - 1); the square root of their
          sum is the standard deviation of each offset;
        - share of the power of the lines that is noise, shape (...,);
        - share of the noise that the converter adds, fitted to corrected lines, shape (...,);
        - standard deviation of this share, shape (...,); infinite without correction.
    """
    n = y.shape[-1] - y.shape[-1] % period
    taper = _taper(n, y.device)
    spectrum = torch.fft.fft(y[..., :n] * taper.to(y.real.dtype)).to(torch.complex128)
    # number of correlated neighbours in a tapered spectrum
    related = n * taper.pow(4).sum() / taper.square().sum().square()
    power = _smooth(spectrum.abs().square().mean(-2), max(1, 256 // y.shape[-2]))
    power = power / power.mean(-1, keepdim=True).clamp_min(1e-300)
    noise = _corrected_noise(period, n, y.device, corrected)
    density = noise.abs().square().mean(-2)
    floor = noise_floor(power / density)[..., None]
    share = torch.as_tensor(converter, dtype=torch.float64, device=y.device)[..., None]
    # noise of the converter has no jitter, and is subtracted
    signal = (power - floor * share * density).clamp_min(0)
    scale = spectrum.abs().square().mean((-2, -1)).clamp_min(1e-300)[..., None]
    tilted = torch.fft.fftfreq(n, dtype=torch.float64, device=y.device) * signal
    coefficient, variance, of_noise = [], [], []
    for k in range(1, period // 2 + 1):
        step = k * (n // period)
        own = floor * (noise * torch.roll(noise, step, -1).conj()).mean(-2)
        # form of the correlation that a periodic gain causes
        both = power + torch.roll(power, step, -1)
        # leakage from the ends of a line adds at least 1e-5 of the mean power to every frequency
        weight = 1 / (power.clamp_min(1e-5) * torch.roll(power, step, -1).clamp_min(1e-5))
        slope = 2j * math.pi * (torch.roll(tilted, step, -1) - tilted)
        slope = slope - both * _along(slope, both, weight)
        cross = (spectrum * torch.roll(spectrum, step, -1).conj()).mean(-2) / scale - share * own
        cross = cross - both * _along(cross, both, weight)
        value = _along(cross, slope, weight)
        rest, information = cross - slope * value, (weight * slope.abs().square()).sum(-1).clamp_min(1e-150)
        scatter = (weight * slope.abs() * rest.abs()).square().sum(-1).clamp_min(1e-300)
        coefficient.append(value[..., 0])
        variance.append(related * scatter / information.square())
        # the part of the correlation of the noise that jitter and gain do not explain
        own = own - both * _along(own, both, weight)
        own = own - slope * _along(own, slope, weight)
        sums = (own.conj() * rest).real, own.abs().square(), weight * (own.abs() * rest.abs()).square()
        of_noise.append(torch.stack([(weight * x).sum(-1) for x in sums]))
    mirrored = slice(0, (period - 1) // 2)
    seen, of_own, scatter = torch.stack(of_noise).sum(0)
    of_own = of_own.clamp_min(1e-150)
    return (
        torch.stack(coefficient + [c.conj() for c in coefficient[mirrored]][::-1], -1),
        torch.stack(variance + variance[mirrored][::-1], -1),
        (floor * density).mean(-1),
        share[..., 0] + seen / of_own,
        (related * scatter).sqrt() / of_own,
    )


def _along(x: Tensor, regressor: Tensor, weight: Tensor) -> Tensor:
    """Coefficient (..., 1) of the weighted least-squares fit of a regressor to x (..., n)."""
    square = (weight * regressor.abs().square()).sum(-1, keepdim=True).clamp_min(1e-150)
    return (weight * regressor.conj() * x).sum(-1, keepdim=True) / square


def _taper(n: int, device: torch.device) -> Tensor:
    """Window (n,) that falls smoothly to zero over a sixteenth of a line at both ends.

    The ends of a recorded line do not join, and would cause a correlation of their own.
    """
    end = (torch.arange(n, dtype=torch.float64, device=device) + 0.5) / (n / 16)
    return torch.sin(math.pi / 2 * torch.minimum(end, end.flip(0)).clamp_max(1)).square()


def _corrected_noise(m: int, n: int, device: torch.device, offsets: Tensor | None) -> Tensor:
    """Spectra (..., M, n) of M impulses at the samples 0 to M - 1, after correction with the
    offsets (..., M).

    The correction repeats every M samples. Averages over the M impulses therefore give the power
    spectrum of corrected white noise of unit power, and its correlation at frequencies k / M cycles
    per sample apart.
    """
    impulse = torch.eye(m, n, dtype=torch.complex128, device=device)
    if offsets is not None:
        impulse = correct_jitter_exact(impulse.expand(*offsets.shape[:-1], m, n), offsets)
    return torch.fft.fft(impulse)


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
    found = {}
    some = y[..., :: max(1, y.shape[-2] // 256), :]
    for m in range(2, max_period + 1):
        (coefficient, variance, *_), primitive = (
            cyclic_fit(some, m),
            [k - 1 for k in range(1, m) if math.gcd(k, m) == 1],
        )
        found[m] = (coefficient.abs().square() / variance)[..., primitive].sum(-1), 9 * len(primitive) + 16
    leak = 0.002 * torch.stack([chi for chi, _ in found.values()]).amax(0)
    counted = {m: torch.where(chi > least + leak, chi, 0) for m, (chi, least) in found.items()}
    explained = [
        sum((counted[m] for m in counted if p % m == 0), torch.zeros_like(leak)) * (1 - 1e-9 * p)
        for p in range(1, max_period + 1)
    ]
    return torch.stack(explained).argmax(0) + 1


@differentiable("no")
def estimate_jitter_blind(
    y: Tensor, max_period: int = 16, period: int | None = None, passes: int = 12, *, assess: bool = True
) -> Estimate:
    """Estimate the period and the offsets of periodic timing jitter from clutter, without a pilot.

    >>> import torch
    >>> noise = torch.randn(16, 256, dtype=torch.complex64)
    >>> estimate_jitter_blind(noise, max_period=4).failed
    tensor(True)

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
        assess: Whether to add standard deviations, quality and outcome.

    Returns:
        Estimate with `offset_samples` of shape (..., P), in samples, with mean zero, and their
        standard deviations; and `period` of shape (...,), int64. P is the known period or
        `max_period`; beyond the period of a trial its offsets repeat. Offsets with which sample
        instants would coincide or cross are zero. Where no jitter is found, the deviation is that
        for the longest period. `quality` is m / (m + v), with the mean square m of the offsets and
        the variance v of their errors, or 1 where there is no jitter. The outcome is EMPTY for
        zeros, SINGULAR where offsets would coincide or cross, NOISE where less than half of the
        power is above the noise, OUTSIDE_SEARCH where corrected lines still repeat with another
        period, MISFIT where the rms of the offsets is 0.22 samples or more, and INEXACT where the
        standard deviation is 0.01 samples or more for the longest period tested (so for a scene of
        one or few points, whose lines resemble each other).

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
    tiled = torch.arange(longest, device=y.device)
    rest = torch.zeros_like(periods, dtype=torch.bool)
    for m in torch.unique(periods).tolist():
        chosen = (periods == m).nonzero()[:, 0]
        if m > 1:
            total, deviation = refine_offsets(rows[chosen], m, passes)
            offsets[chosen], std[chosen] = total[:, tiled % m], deviation[:, None].expand(-1, longest)
        elif assess:
            std[chosen] = cyclic_fit(rows[chosen], longest)[1].sum(-1).sqrt()[:, None].expand(-1, longest)
        if assess:
            rest[chosen] = _has_period(rows[chosen], offsets[chosen, :m])
    value = {
        "offset_samples": uncrossed(offsets).reshape(*y.shape[:-2], longest),
        "period": periods.reshape(y.shape[:-2]),
    }
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(value["period"]))
    size = offsets.square().mean(-1)
    quality = torch.where(periods == 1, 1, size / (size + std[:, 0].square()).clamp_min(1e-300))
    lit = (rows != 0).any(-1).any(-1)
    tested = std[:, 0] * torch.sqrt((longest - 1) / (torch.where(periods == 1, longest, periods) - 1))
    fields = assess_offsets(offsets, std, tested, _signal_share(rows) >= 0.5, lit, quality, most_rms=0.22)
    fields["outcome"] = torch.maximum(fields["outcome"], Outcome.OUTSIDE_SEARCH.like(rest) * rest)
    return Estimate(value, **of_trials(fields, y.shape[:-2]))


def _has_period(y: Tensor, offsets: Tensor) -> Tensor:
    """True where lines (trial, pulse, range), corrected with offsets (trial, M), still repeat along
    range with any period, (trial,).
    """
    m = offsets.shape[-1]
    y = unit_level(y[..., : y.shape[-1] - y.shape[-1] % m])
    y = correct_jitter_exact(y, uncrossed(offsets)) if m > 1 else y
    product = (y[..., 1:] * y[..., :-1].conj()).mean(-2)
    window = torch.hann_window(product.shape[-1], dtype=product.real.dtype, device=y.device)
    power = torch.fft.fft((product - product.mean(-1, keepdim=True)) * window).abs().square()
    # the spectrum of a scene is wide; one of its n values is as high with a probability of exp(-5)
    high = power > (math.log(power.shape[-1]) + 5) * _smooth(power, 65)
    return high[..., 33:-33].any(-1)


def _signal_share(y: Tensor) -> Tensor:
    """Share of the power of lines (trial, pulse, range) that lies above the noise, (trial,)."""
    unit = unit_level(y) * _taper(y.shape[-1], y.device).to(y.real.dtype)
    power = torch.fft.fft(unit).abs().square().mean(-2).to(torch.float64)
    power = _smooth(power, max(1, 256 // y.shape[-2]))
    return 1 - noise_floor(power) / power.mean(-1).clamp_min(1e-300)


def refine_offsets(y: Tensor, period: int, passes: int) -> tuple[Tensor, Tensor]:
    """Fit the timing offsets, correct the recording with them, and fit what remains, repeatedly.

    The changes are scaled by the factor of Irons and Tuck (1969), since large jitter makes the
    first-order fit too long or too short.

    Args:
        y: Lines, shape (trial, pulse, range), complex.
        period: Period M of the jitter in samples.
        passes: Largest number of fits. A trial is finished when its offsets no longer change.

    Returns:
        The total offsets in samples, shape (trial, M), and their standard deviation, shape
        (trial,), by chance, by the unknown share of the converter in the noise, and by what
        further fits would change.
    """
    y = y[..., : y.shape[-1] - y.shape[-1] % period]
    total, change = (torch.zeros((y.shape[0], period), dtype=torch.float64, device=y.device) for _ in range(2))
    factor, std = torch.ones_like(total[:, 0]), torch.zeros_like(total[:, 0])
    converter = torch.ones_like(std)
    active = torch.arange(y.shape[0], device=y.device)
    for i in range(passes):
        at, before = total[active], change[active]
        corrected = correct_jitter_exact(y[active], at) if i else y
        coefficient, variance, noise, share, share_std = cyclic_fit(
            corrected, period, at if i else None, converter[active]
        )
        step = torch.fft.ifft(torch.nn.functional.pad(coefficient, (1, 0)) * period).real
        step_std = torch.sqrt(variance.sum(-1))
        if i:
            turned = before - step
            factor[active] *= (before * turned).sum(-1) / turned.square().sum(-1).clamp_min(1e-300)
            factor[active] = factor[active].clamp(0.3, 2.0)
        moved = at + factor[active, None] * step.clamp(-0.4, 0.4)
        total[active] = torch.where((smallest_gap(moved) >= 2 * MIN_GAP)[:, None], moved, at)
        converter[active] = torch.where(share_std < _MOST_SHARE, share.clamp(0, 1), converter[active])
        # the level of noise from the lowest twentieth of a spectrum of 256 or more looks has an
        # error of 0.08
        unknown = torch.hypot(share_std.clamp_max(_MOST_SHARE), torch.full_like(factor[active], 0.08))
        level = unknown * noise / (1 - noise).clamp_min(0.1) * total[active].square().mean(-1).sqrt()
        std[active], change[active] = torch.hypot(step_std, level), step
        # further fits are needed only where the last change exceeds a tenth of the standard
        # deviation
        active = active[step.square().mean(-1).sqrt() > 0.1 * step_std]
        if not len(active):
            break
    return total, torch.hypot(std, change.square().mean(-1).sqrt())


class BlindJitter(Stage):
    """Estimator of periodic sampling jitter from the clutter of the recording.

    >>> import torch
    >>> from torchsar import Signal, radar, repair
    >>> noise = torch.randn(64, 256, generator=torch.Generator().manual_seed(1)) + 0j
    >>> clutter = torch.fft.ifft(noise * (torch.fft.fftfreq(256).abs() < 0.4))  # in 0.8 of the band
    >>> jittered = repair.correct_jitter(clutter, torch.tensor([0.1, -0.1]))
    >>> lines = Signal(jittered, radar.InverseRadar(10e9, 1e9, 1e3).raw_axes(64, 256))
    >>> repair.BlindJitter(max_period=4)(lines)["offset_samples"].round(decimals=1).tolist()
    [-0.1, 0.1, -0.1, 0.1]

    If this stage is named "blind" in a chain, the jitter is corrected by the later stage
    `use(CorrectJitter(), offset_samples="blind", period="blind")`.

    Args:
        max_period: Longest period that is tested, in samples.
        period: Known period in samples; None: the period is estimated.
        assess: Whether to add standard deviations, quality and outcome.
    """

    provides = ("offset_samples", "period")
    neutral = {"offset_samples": 0.0, "period": 1}
    differentiable = "no"

    def __init__(self, max_period: int = 16, period: int | None = None, *, assess: bool = True) -> None:
        super().__init__()
        self.max_period, self.period, self.assess = max_period, period, assess

    def forward(self, signal: Signal) -> Estimate:
        """Estimate period and offsets of the timing jitter; see `estimate_jitter_blind`.

        Args:
            signal: Raw or range-compressed lines, shape (..., pulse, range).

        Returns:
            Estimate with `offset_samples` in samples and `period`.
        """
        return estimate_jitter_blind(signal.data, self.max_period, self.period, assess=self.assess)
