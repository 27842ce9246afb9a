"""Periodic jitter from the recorded clutter itself, without a pilot.

Clutter is stationary along range: its spectrum has no correlation between different frequencies.
Jitter e[n mod M] with the Fourier coefficients E_k = (1/M) sum_m e[m] exp(-2j pi k m / M) makes it
cyclostationary; to first order, with the power spectrum S,
    <Y(f) Y*(f - k/M)> = 2j pi E_k [(f - k/M) S(f - k/M) - f S(f)],  frequencies wrapped to +-1/2
    cycle per sample.
Each E_k is a least-squares fit of that over the band; exact correction and a new fit remove the
higher orders. The unequal slopes of the pattern at the wrap tell jitter from a ripple of power; the
mean offset (k = 0) cannot be seen. Source: brief 004, item 4 and its table of recorded data
(offsets from clutter).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage
from torchsar.repair.jitter import MIN_GAP, correct_jitter_exact, smallest_gap


@dataclass(frozen=True)
class CyclicFit:
    """First-order jitter of one period: coefficients E_1 ..

    E_{M-1} and the variance of each, (..., M - 1).
    """

    coefficient: Tensor
    variance: Tensor

    def significance(self, primitive: bool = False) -> Tensor:
        """Chi-squared of the coefficients where there is no jitter, (...,): M - 1 degrees of
        freedom, or those of no shorter period only.
        """
        m = self.coefficient.shape[-1] + 1
        used = [k - 1 for k in range(1, m) if not primitive or math.gcd(k, m) == 1]
        return (self.coefficient.abs().square() / self.variance)[..., used].sum(-1)

    @property
    def offset_samples(self) -> Tensor:
        """Offsets of mean zero, (..., M)."""
        m = self.coefficient.shape[-1] + 1
        return torch.fft.ifft(torch.nn.functional.pad(self.coefficient, (1, 0)) * m).real

    @property
    def std_samples(self) -> Tensor:
        """Deviation common to all offsets, (...,)."""
        return torch.sqrt(self.variance.sum(-1))


def cyclic_fit(y: Tensor, period: int) -> CyclicFit:
    """Fit E_k to the correlations between frequencies k/M apart. y: (..., pulse, range) complex.

    The variance carries the scatter of the correlations about the fit, so that lines that resemble
    one another are not counted twice.
    """
    n = y.shape[-1] - y.shape[-1] % period
    spectrum = torch.fft.fft(y[..., :n]).to(torch.complex128)
    lines = y.shape[-2]
    power = _smooth(spectrum.abs().square().mean(-2), max(1, 256 // lines))
    power = power / power.mean(-1, keepdim=True).clamp_min(1e-300)
    scale = spectrum.abs().square().mean((-2, -1)).clamp_min(1e-300)
    frequency = torch.fft.fftfreq(n, dtype=torch.float64, device=y.device)
    coefficient, variance = [], []
    for k in range(1, period // 2 + 1):
        step = k * (n // period)
        cross = (spectrum * torch.roll(spectrum, step, -1).conj()).mean(-2) / scale[..., None]
        other = torch.roll(power, step, -1)
        slope = 2j * math.pi * (torch.roll(frequency, step, -1) * other - frequency * power)
        weight = 1 / (power * other).clamp_min(1e-6)
        information = (weight * slope.abs().square()).sum(-1).clamp_min(1e-300)
        value = (weight * slope.conj() * cross).sum(-1) / information
        scatter = (weight * (cross - slope * value[..., None]).abs().square()).mean(-1)
        coefficient.append(value)
        variance.append(scatter.clamp_min(1e-300) / information)
    mirrored = [c.conj() for c in reversed(coefficient[: (period - 1) // 2])]
    return CyclicFit(
        torch.stack(coefficient + mirrored, -1),
        torch.stack(variance + list(reversed(variance[: (period - 1) // 2])), -1),
    )


def _smooth(power: Tensor, width: int) -> Tensor:
    """Circular running mean over an odd number of bins near `width`."""
    half = min(width // 2, (power.shape[-1] - 1) // 2)
    return sum((torch.roll(power, i, -1) for i in range(-half, half + 1)), torch.zeros_like(power)) / (2 * half + 1)


def detect_jitter_period(y: Tensor, max_period: int = 16, lines: int = 256) -> Tensor:
    """The shortest period that holds all significant repetitions, 1 where there is none; (...,
    pulse, range) -> (...,) int64.

    Looks at up to `lines` lines spread over the recording. For each M the coefficients that no
    shorter period has are tested; false alarms stay below 1e-5 a trial. A repetition weaker by 27
    dB than the strongest one is taken for its leakage.
    """
    stride = max(1, y.shape[-2] // lines)
    found = {m: cyclic_fit(y[..., ::stride, :], m).significance(primitive=True) for m in range(2, max_period + 1)}
    leak = 0.002 * torch.stack(list(found.values())).amax(0)
    new = {m: sum(math.gcd(k, m) == 1 for k in range(1, m)) for m in found}
    counted = {m: torch.where(chi > 9 * new[m] + 16 + leak, chi, 0) for m, chi in found.items()}
    explained = [
        sum((counted[m] for m in counted if p % m == 0), torch.zeros_like(leak)) * (1 - 1e-9 * p)
        for p in range(1, max_period + 1)
    ]
    return torch.stack(explained).argmax(0) + 1


def estimate_jitter_blind(y: Tensor, max_period: int = 16, period: int | None = None, passes: int = 3) -> Estimate:
    """Period and offsets from clutter.

    y: (..., pulse, range) raw or range-compressed, no line number matters.

    Gives `offset_samples` (..., P) of mean zero and `period` (...,) as estimate_jitter_pilot does;
    with a known `period` nothing is tested and P = period. quality: 1 - chance-sized share of the
    offsets. Not ok, with zero offsets: an all-zero trial, or offsets that bring instants together.
    Needs a signal that is not much oversampled and a range line of at least 8 periods; a periodic
    change of gain that goes with the jitter is not modelled.
    """
    longest = max_period if period is None else period
    if longest < 2 or y.shape[-1] < 8 * longest:
        raise ValueError(
            "blind jitter estimation needs a period of 2 or more and lines of at least "
            f"{8 * longest} samples, got period {longest} and lines of {y.shape[-1]}"
        )
    rows = y.detach().reshape(-1, *y.shape[-2:])
    periods = (
        detect_jitter_period(rows, max_period)
        if period is None
        else torch.full(rows.shape[:1], period, device=y.device)
    )
    offsets, std = (torch.zeros((rows.shape[0], longest), dtype=torch.float64, device=y.device) for _ in range(2))
    ok = rows.abs().amax((-2, -1)) > 0
    tiled = torch.arange(longest, device=y.device)
    for m in torch.unique(periods).tolist():
        if m > 1:
            chosen = (periods == m).nonzero()[:, 0]
            fit, total = refine_offsets(rows[chosen], m, passes)
            offsets[chosen] = total[..., tiled % m]
            std[chosen] = fit.std_samples[..., None].expand(-1, longest)
    ok = ok & torch.isfinite(offsets).all(-1) & (smallest_gap(offsets) >= MIN_GAP)
    offsets = torch.where(ok[..., None], offsets, 0)
    size, chance = offsets.square().mean(-1), std.square().mean(-1)
    quality = torch.where(ok, size / (size + chance).clamp_min(1e-300), 0) + (ok & (periods == 1)).to(torch.float64)
    shape = y.shape[:-2]
    value = {"offset_samples": offsets.reshape(*shape, longest), "period": periods.reshape(shape)}
    return Estimate(
        value, quality.clamp(0, 1).reshape(shape), ok.reshape(shape), {"offset_samples": std.reshape(*shape, longest)}
    )


def refine_offsets(y: Tensor, period: int, passes: int) -> tuple[CyclicFit, Tensor]:
    """Fit, correct the recording exactly, and fit what is left. y: (trial, pulse, range).

    Returns the last fit and the offsets (trial, M).
    """
    y = y[..., : y.shape[-1] - y.shape[-1] % period]
    total = torch.zeros((y.shape[0], period), dtype=torch.float64, device=y.device)
    for i in range(passes):
        fit = cyclic_fit(correct_jitter_exact(y, total) if i else y, period)
        step = total + fit.offset_samples.clamp(-0.4, 0.4)
        total = torch.where((smallest_gap(step) >= 2 * MIN_GAP)[:, None], step, total)
    return fit, total


class BlindJitter(Stage):
    """Jitter offsets from the clutter of the recording: `use(CorrectJitter(),
    offset_samples="blind", period="blind")`.
    """

    provides = ("offset_samples", "period")

    def __init__(self, max_period: int = 16, period: int | None = None) -> None:
        super().__init__()
        self.max_period, self.period = max_period, period

    def forward(self, signal: Signal) -> Estimate:
        return estimate_jitter_blind(signal.data, self.max_period, self.period)
