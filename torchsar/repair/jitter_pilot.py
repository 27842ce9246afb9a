"""Estimation of periodic jitter from a pilot tone recorded by the same converter.

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
from torchsar.repair.assess import assess_offsets
from torchsar.repair.jitter import uncrossed


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
