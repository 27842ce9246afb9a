"""Separation of a continuous triangular beat record into up and down sweeps, and blanking of its
turning points.

A record (..., pulse, time) holds one block a recorded period; the triangle starts `trigger_s` after
the start of each block. Sweeps are (..., ramp, pulse, fast_time), ramp 0 up and 1 down, both in
natural time order, on the grid of TriangularLadar.fast_time_axis that is symmetric about the middle
of the sweep. A trigger between two samples is met by a delay of the whole record (linear phase in
its spectrum), never by a shifted grid: with a grid that is off by dt the velocity from the
intercept of the mirror product is biased by 0.76 f+ dt lambda / T. So is a record whose first
sample lies AT the trigger: the first sample of a symmetric grid lies half a sample later.

One real channel keeps |f| only. Its analytic signal has the beat f+ + fd in the up and f+ - fd in
the down sweep, the latter mirrored; its conjugate is the sweep that a complex detector sees. The
analytic signal is formed of the record BEFORE it is cut: the record runs on through turning points,
where a cut sweep ends in a jump. Rms error with the transient and 2 samples of the end left out,
one scatterer: 1.3 % at 350 cycles a sweep, 2.1 % at 50 (cutting first: 1.6 and 2.3 %), most of it
at the ends: without 40 samples there 0.6 and 0.8 % (cutting first 0.65 %). A delay by half a sample
costs 0.1 % of a complex record there, 0.04 % without 40 samples. Brief 000, sections 3 and 5,
erratum 16.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Axis, Estimate, Signal, Stage
from torchsar.radar import TriangularLadar
from torchsar.repair.analytic import delayed
from torchsar.repair.trigger import find_trigger

Trigger = float | Tensor


def split_record(
    record: Tensor,
    radar: TriangularLadar,
    trigger_s: Trigger = 0.0,
    contiguous: bool | None = None,
    nearer: bool = False,
    first_s: float = 0.0,
) -> Tensor:
    """Up and down sweeps of a record.

    record: (..., pulse, time) complex or real; trigger_s: number or (...,). Returns (..., 2, K', N)
    complex.

    contiguous: whether blocks follow each other without a gap; None: where they are one period long
    and every period is kept. Such a record is cut anew from the trigger on (modulo the period), and
    the period that its end leaves incomplete is dropped: K' = K - 1, or K where a trigger common to
    all trials is less than half a sample. Other blocks are cut inside, K' = K, and need trigger +
    period to fit. first_s: time of the first sample of a block, as trigger_s counts it. The first
    sample of a sweep lies half a sample after its start. nearer: with real detection, whether the
    scene lies nearer than the reference (RD < 0) and has negative beats in up sweeps. With real
    detection |fd| < f+ is required. Differentiable in record and trigger_s. Raises ValueError where
    a period does not fit, and for a trigger that is not finite or not one per trial; TypeError for
    what is no record.
    """
    refuse_no_record(record, "split_record")
    trigger = _trigger_of(trigger_s, record)
    joined = is_contiguous(record.shape[-1], radar) if contiguous is None else contiguous
    lines = record.flatten(-2)[..., None, :] if joined else record
    start, fraction = start_sample(trigger - first_s, radar, joined)
    whole = delayed(lines, fraction, analytic=not record.is_complex())
    periods = _cut_joined(whole, start, record.shape[-2], radar) if joined else _cut_inside(whole, start, radar)
    sweeps = periods.unflatten(-1, (2, radar.sweep_samples)).movedim(-2, -3)
    return sweeps if record.is_complex() else canonical_ramps(sweeps, radar, nearer)


def refuse_no_record(record: Tensor, what: str) -> None:
    """Raise TypeError or ValueError unless record is floating or complex (..., pulse, time)."""
    if not (isinstance(record, Tensor) and (record.is_complex() or record.is_floating_point())):
        raise TypeError(
            f"{what} works on a real or complex record (..., pulse, time), got "
            f"{getattr(record, 'dtype', type(record).__name__)}; convert the samples first"
        )
    if record.ndim < 2 or not record.numel():
        raise ValueError(
            f"{what} works on a record (..., pulse, time) with samples in it, got shape {tuple(record.shape)}"
        )


def _trigger_of(trigger_s: Trigger, record: Tensor) -> Tensor:
    """The trigger as a float64 tensor, a number or one per trial of the record."""
    if not isinstance(trigger_s, Tensor | float | int):
        raise TypeError(f"trigger_s must be seconds, a number or one per trial, got {trigger_s!r}")
    trigger, trials = torch.as_tensor(trigger_s, dtype=torch.float64, device=record.device), record.shape[:-2]
    if _any(~torch.isfinite(trigger)):
        raise ValueError(
            "trigger_s must be finite, got NaN or Inf; take one that find_trigger is sure of "
            "(ok), or leave that trial out"
        )
    if (
        trials
        and trigger.shape[-len(trials) :] not in (trials, ())
        and any(a != b and 1 not in (a, b) for a, b in zip(trigger.shape[::-1], trials[::-1]))
    ):
        raise ValueError(
            f"trigger_s must be a number or one per trial {tuple(trials)}, got shape {tuple(trigger.shape)}"
        )
    return trigger


def is_contiguous(block_samples: int, radar: TriangularLadar) -> bool:
    """Whether blocks of so many samples follow each other without a gap."""
    return radar.keep_every == 1 and block_samples == 2 * radar.sweep_samples


def start_sample(trigger_s: Tensor, radar: TriangularLadar, joined: bool) -> tuple[Tensor, Tensor]:
    """First sample of the up sweep, half a sample after the trigger (...,): whole, modulo the
    period in a joined record, and the fraction left.
    """
    samples = trigger_s * radar.sample_rate_hz + 0.5
    start = torch.round(samples.detach())
    fraction = samples - start
    start = start.to(torch.int64)
    return (torch.remainder(start, 2 * radar.sweep_samples) if joined else start), fraction


def canonical_ramps(sweeps: Tensor, radar: TriangularLadar, nearer: bool) -> Tensor:
    """Sweeps (..., 2, K, N) of an analytic signal as a complex detector gives them: the ramp whose
    beat is negative is conjugated.
    """
    up_positive = (radar.dechirp_sign == "lo_conj_echo") != nearer
    up, down = sweeps.unbind(-3)
    return torch.stack([up, down.conj()] if up_positive else [up.conj(), down], -3)


def _cut_joined(line: Tensor, start: Tensor, n_period: int, radar: TriangularLadar) -> Tensor:
    """(..., 1, n) -> (..., K', period) from sample `start` on."""
    period = 2 * radar.sweep_samples
    if line.shape[-1] != n_period * period:
        raise ValueError(
            f"a contiguous record of {n_period} periods of {period} samples has "
            f"{n_period * period}, got {line.shape[-1]}; blocks of another length are no "
            "contiguous record"
        )
    if start.ndim == 0 and not _any(start != 0):
        return line.squeeze(-2).unflatten(-1, (n_period, period))
    if n_period < 2:
        raise ValueError(
            f"a contiguous record of {n_period} period that starts inside a triangle holds no "
            "whole one; record 2 periods or more"
        )
    return _taken(line, start, (n_period - 1) * period).squeeze(-2).unflatten(-1, (n_period - 1, period))


def _cut_inside(blocks: Tensor, start: Tensor, radar: TriangularLadar) -> Tensor:
    """(..., K, n) -> (..., K, period)."""
    period, n = 2 * radar.sweep_samples, blocks.shape[-1]
    if period > n or _any((start < 0) | (start + period > n)):
        fits = (
            f"triggers up to {(n - period) / radar.sample_rate_hz:.4g} s after their first sample fit"
            if n >= period
            else "none fits"
        )
        raise ValueError(
            f"blocks of {n} samples do not hold a period of {period} from the trigger on "
            f"({fits}); record longer blocks, or every period without a gap (keep_every=1)"
        )
    return _taken(blocks, start, period)


def _taken(lines: Tensor, start: Tensor, n: int) -> Tensor:
    """n samples of every line (..., line, samples) from index `start` (...,) on."""
    if start.ndim == 0:
        return lines[..., start + torch.arange(n, device=lines.device)]
    index = start[..., None, None] + torch.arange(n, device=lines.device)
    shape = torch.broadcast_shapes(lines.shape[:-2], start.shape)
    return lines.expand(*shape, *lines.shape[-2:]).gather(-1, index.expand(*shape, lines.shape[-2], n))


def _any(condition: Tensor) -> bool:
    """Whether it holds for a trial; False inside vmap, where a value cannot be looked at."""
    try:
        return bool(condition.detach().any())
    except RuntimeError:
        return False


def circular_shift(record: Tensor, shift_s: float, radar: TriangularLadar) -> Tensor:
    """Each period moved to the left by whole samples and closed to a ring, (..., pulse, time): what
    the paper does (its Fig. 15b). Not for use.

    Samples one period apart become neighbours: a phase step of 2 pi fd period inside one sweep,
    which no method survives unless the shift falls into the last samples of a sweep. split_record
    cuts the continuous record anew instead. Brief 000, erratum 16.
    """
    return torch.roll(record, -round(shift_s * radar.sample_rate_hz), -1)


def blank_turning_points(
    sweeps: Tensor, radar: TriangularLadar, farthest_m: float, nearest_m: float = 0.0, margin: int = 0
) -> Tensor:
    """Zero the samples of sweeps (..., 2, K, N) where reference and echo sweep in opposite
    directions. Differentiable.

    farthest_m: largest relative range; its echo turns 2 RD / c after the reference: the first
    ceil(2 RD fs / c) samples of each sweep. nearest_m: least relative range; where negative its
    echo turns earlier: the last samples. margin: further samples at either end. Raises ValueError
    where this leaves less than half a sweep, for ranges out of order and a negative margin.
    """
    if not isinstance(sweeps, Tensor):
        raise TypeError(f"blank_turning_points works on a tensor of sweeps (..., 2, K, N), got {type(sweeps).__name__}")
    if not (nearest_m <= farthest_m and margin >= 0):
        raise ValueError(
            "blanking needs nearest_m <= farthest_m (relative ranges) and a margin of 0 samples "
            f"or more, got {nearest_m:g}, {farthest_m:g} and {margin}"
        )
    first, last = (
        math.ceil(max(0.0, d) * 2 * radar.sample_rate_hz / radar.wave_speed_m_s - 1e-9) + margin
        for d in (farthest_m, -nearest_m)
    )
    n = sweeps.shape[-1]
    if not 0 <= first + last <= n // 2:
        blanked = (
            f"ranges {nearest_m:g}..{farthest_m:g} m and a margin of {margin} blank "
            f"{first + last} of {n} samples of a sweep"
        )
        raise ValueError(f"{blanked}; half must stay: are the ranges relative to the reference?")
    place = torch.arange(n, device=sweeps.device)
    return sweeps * ((place >= first) & (place < n - last))


class SplitSweeps(Stage):
    """(pulse, time) -> (ramp, pulse, fast_time): `SplitSweeps(radar, trigger)`; trigger: seconds,
    "recorded" or "search".

    "recorded": `use(SplitSweeps(radar, "recorded"), trigger_s="aux.trigger_s")`, a number or one
    per trial. "search": by find_trigger, whose Estimate (`trigger_s`) comes along; a trial that it
    is not sure of is cut all the same. A trigger common to all trials moves the pulse axis; one per
    trial cannot (an axis is shared): slow time is then early by the trigger, less than one period.
    Real samples of one channel are taken and leave as complex ones. See split_record for `nearer`
    and for periods dropped.
    """

    works_on = ("pulse", "time")
    takes_real = True

    def __init__(self, radar: TriangularLadar, trigger: float | str = 0.0, nearer: bool = False) -> None:
        super().__init__()
        if isinstance(trigger, str) and trigger not in ("recorded", "search"):
            raise ValueError(f"trigger must be seconds, 'recorded' or 'search', got {trigger!r}")
        if not isinstance(trigger, str) and not math.isfinite(trigger):
            raise ValueError(f"trigger must be a finite number of seconds, got {trigger}")
        self.radar, self.trigger, self.nearer = radar, trigger, nearer
        self.provides = ("trigger_s",) if trigger == "search" else ()

    def forward(self, signal: Signal, trigger_s: Tensor | None = None) -> Signal | tuple[Signal, Estimate]:
        if self.trigger == "search":
            contiguous = self._contiguous(signal)
            found = find_trigger(signal.data, self.radar, contiguous, self.nearer)
            found = replace(found, value={"trigger_s": found["trigger_s"] + signal.axis("time").start})
            return self._split(signal, _fitting(found["trigger_s"], signal, self.radar, contiguous)), found
        if self.trigger == "recorded" and trigger_s is None:
            raise ValueError(
                "SplitSweeps(trigger='recorded') needs the recorded time: use(SplitSweeps(radar, "
                "'recorded'), trigger_s='aux.trigger_s')"
            )
        return self._split(
            signal, torch.as_tensor(self.trigger if trigger_s is None else trigger_s, dtype=torch.float64)
        )

    def _contiguous(self, signal: Signal) -> bool:
        pulse, time = signal.axes
        if abs(time.step * self.radar.sample_rate_hz - 1) > 1e-9:
            raise ValueError(
                f"the record is sampled at {1 / time.step:.6g} Hz, the radar says {self.radar.sample_rate_hz:.6g} Hz"
            )
        return is_contiguous(time.n, self.radar) and abs(pulse.step / (time.n * time.step) - 1) < 1e-9

    def _split(self, signal: Signal, trigger_s: Tensor) -> Signal:
        contiguous = self._contiguous(signal)
        data = split_record(signal.data, self.radar, trigger_s, contiguous, self.nearer, signal.axis("time").start)
        pulse = signal.axis("pulse")
        shift = 0.0
        if trigger_s.ndim == 0:
            start, fraction = start_sample(trigger_s.detach() - signal.axis("time").start, self.radar, contiguous)
            shift = signal.axis("time").start + (float(start + fraction) - 0.5) / self.radar.sample_rate_hz
        axes = self.radar.sweep_axes(data.shape[-2], pulse.start + shift)
        return Signal(data, (axes[0], Axis("pulse", data.shape[-2], axes[1].start, pulse.step, "s"), axes[2]))


def _fitting(trigger_s: Tensor, signal: Signal, radar: TriangularLadar, contiguous: bool) -> Tensor:
    """A trigger that the data gave, held inside blocks that a period from it on would overrun
    (find_trigger calls it not ok).
    """
    if contiguous:
        return trigger_s
    first, room = signal.axes[1].start, signal.axes[1].n - 2 * radar.sweep_samples
    return trigger_s.clamp(first - 0.5 / radar.sample_rate_hz, first + (max(0, room) - 0.6) / radar.sample_rate_hz)


class BlankTurningPoints(Stage):
    """Zero the transients after turning points: see blank_turning_points."""

    works_on = ("ramp", "pulse", "fast_time")

    def __init__(self, radar: TriangularLadar, farthest_m: float, nearest_m: float = 0.0, margin: int = 0) -> None:
        super().__init__()
        self.radar, self.farthest_m, self.nearest_m, self.margin = radar, farthest_m, nearest_m, margin
        blank_turning_points(torch.zeros(radar.sweep_samples), radar, farthest_m, nearest_m, margin)

    def forward(self, signal: Signal) -> Signal:
        return signal.with_data(
            blank_turning_points(signal.data, self.radar, self.farthest_m, self.nearest_m, self.margin)
        )


class CircularShift(Stage):
    """The paper's shift inside each period, for the experiment that shows why it fails: see
    circular_shift. Followed by SplitSweeps(radar, 0.0).
    """

    works_on = ("pulse", "time")
    takes_real = True

    def __init__(self, radar: TriangularLadar, shift_s: float) -> None:
        super().__init__()
        self.radar, self.shift_s = radar, shift_s

    def forward(self, signal: Signal) -> Signal:
        return signal.with_data(circular_shift(signal.data, self.shift_s, self.radar))
