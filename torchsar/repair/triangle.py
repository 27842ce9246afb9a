"""Separation of a continuous triangular beat record into sweeps, and blanking of turning points.

Each period of the laser's frequency is a triangle: an up sweep, then a down sweep of the same
duration T. A record (..., pulse, time) holds one block of samples for each recorded period. The
triangle starts at the time `trigger_s` in its block (the trigger). Separated sweeps have the shape
(..., ramp, pulse, fast_time), with ramp 0 for up and 1 for down sweeps. Time rises along both.
Their time grid, `TriangularLadar.fast_time_axis`, is symmetric about the middle of the sweep. With
the range beat frequency f+ and the Doppler shift fd, up sweeps have the beat frequency fd + f+ and
down sweeps fd - f+.

The first sample of a sweep lies half a sampling interval after the trigger. If the record has no
sample there, the whole record is delayed by a fraction of a sample (linear phase of its spectrum).
A record with a sample exactly at the trigger must be delayed as well. Shifting the time grid of the
sweeps instead would be wrong. Velocities that are estimated from the product of the up sweep and
the mirrored down sweep would be biased by 0.76 f+ dt lambda / T for a shift by dt.

A detector with one real channel does not give the sign of a beat frequency. Its analytic signal has
the beat frequency f+ + fd in the up sweep and f+ - fd in the down sweep; the conjugate of the down
sweep is that of a complex detector. The analytic signal is formed from the record BEFORE it is cut,
since the record continues through turning points, whereas a cut sweep ends with a jump.

The relative rms error of the analytic signal was measured for one scatterer, without the transient
after the turning point and 2 samples at either end. It is 1.3 % at 350 cycles per sweep and 2.1 %
at 50 cycles; if the record is cut first, 1.6 % and 2.3 %. Most of the error lies near the ends:
without 40 samples at either end it is 0.6 % and 0.8 %. A delay by half a sample causes an error of
0.1 % in a complex record, and of 0.04 % without 40 samples at either end.

Reference:
    Remote Sens. 2024, 16, 793, Fig. 15.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Estimate, Signal, Stage, checked_samples, host_value
from torchsar.radar import TriangularLadar
from torchsar.repair.trigger import delayed, find_trigger


def split_record(
    record: Tensor,
    radar: TriangularLadar,
    trigger_s: float | Tensor = 0.0,
    contiguous: bool | None = None,
    nearer: bool = False,
    first_s: float = 0.0,
) -> Tensor:
    """Separate a record of triangular sweeps into up and down sweeps.

    The record has K blocks, one for each recorded period. In a contiguous record the blocks follow
    each other without a gap. It is cut into periods from the first start of an up sweep on, and the
    incomplete period at its end is dropped, so that K' = K - 1 periods remain. (K' = K if one
    trigger is given for all trials and the first sample of the record is, to half a sample, the
    first sample of an up sweep.) Blocks with gaps between them are cut one by one, and K' = K. The
    first sample of a sweep lies half a sampling interval after the start of the sweep. With real
    detection the Doppler shift must be smaller than the beat frequency of the range. Differentiable
    in record and trigger.

    Args:
        record: Record, shape (..., pulse, time), real or complex.
        radar: Ladar parameters.
        trigger_s: Start of the up sweep in seconds, on a time axis on which the first sample of a
            block lies at `first_s`; a number or shape (...,).
        contiguous: Whether the record is contiguous; None: contiguous if blocks are one period long
            and every period is recorded.
        nearer: With real detection, whether the scene is nearer than the reference range, so that
            beats in up sweeps are negative.
        first_s: Time of the first sample of a block in seconds, on the time axis of `trigger_s`.

    Returns:
        Sweeps of N samples, up before down, shape (..., 2, K', N), complex.

    Raises:
        ValueError: If a period does not fit its block, the record has no samples, or a trigger is
            not finite or not one per trial.
        TypeError: If the record is not a tensor of samples, or the trigger not a number.
    """
    record = checked_samples(record, "split_record", "pulse, time", real=True, finite=False)
    if not isinstance(trigger_s, Tensor | float | int):
        raise TypeError(f"trigger_s must be a number of seconds, or a tensor with one per trial, got {trigger_s!r}")
    trigger, trials = torch.as_tensor(trigger_s, dtype=torch.float64, device=record.device), record.shape[:-2]
    if not host_value(torch.isfinite(trigger.detach()).all(), True):
        raise ValueError(
            "trigger_s must be finite, got NaN or Inf; use an estimate of find_trigger "
            "with ok True, or leave that trial out"
        )
    if (
        trials
        and trigger.shape[-len(trials) :] not in (trials, ())
        and any(a != b and 1 not in (a, b) for a, b in zip(trigger.shape[::-1], trials[::-1]))
    ):
        raise ValueError(
            f"trigger_s must be one number, or one number per trial with the trials {tuple(trials)}, "
            f"got the shape {tuple(trigger.shape)}"
        )
    joined = is_contiguous(record.shape[-1], radar) if contiguous is None else contiguous
    lines = record.flatten(-2)[..., None, :] if joined else record
    start, fraction = start_sample(trigger - first_s, radar, joined)
    whole = delayed(lines, fraction, analytic=not record.is_complex())
    periods = _cut_joined(whole, start, record.shape[-2], radar) if joined else _cut_inside(whole, start, radar)
    sweeps = periods.unflatten(-1, (2, radar.sweep_samples)).movedim(-2, -3)
    return sweeps if record.is_complex() else canonical_ramps(sweeps, radar, nearer)


def is_contiguous(block_samples: int, radar: TriangularLadar) -> bool:
    """Return whether the blocks of a record follow each other without a gap.

    Args:
        block_samples: Number of samples of a block; the record has one block per recorded period.
        radar: Ladar parameters.

    Returns:
        True if every period is kept and a block is as long as a period.
    """
    return radar.keep_every == 1 and block_samples == 2 * radar.sweep_samples


def start_sample(trigger_s: Tensor, radar: TriangularLadar, joined: bool) -> tuple[Tensor, Tensor]:
    """Return the index of the first sample of the up sweep, half a sample after the trigger.

    Args:
        trigger_s: Start of the up sweep (trigger) in seconds after the first sample of a block,
            shape (...,), float64.
        radar: Ladar parameters.
        joined: Whether the record is contiguous; the index is then taken modulo the period.

    Returns:
        Index of the nearest sample, shape (...,), int64, and the remaining fraction of a sample,
        -0.5..0.5, shape (...,).
    """
    samples = trigger_s * radar.sample_rate_hz + 0.5
    start = torch.round(samples.detach())
    fraction = samples - start
    start = start.to(torch.int64)
    return (torch.remainder(start, 2 * radar.sweep_samples) if joined else start), fraction


def canonical_ramps(sweeps: Tensor, radar: TriangularLadar, nearer: bool) -> Tensor:
    """Convert sweeps of a real detector's analytic signal to those of a complex detector.

    An analytic signal has positive beat frequencies only. With a complex detector, either the up or
    the down sweeps have negative beat frequencies; these sweeps are conjugated.

    Args:
        sweeps: Sweeps of the analytic signal, up before down, shape (..., 2, K, N), complex.
        radar: Ladar parameters.
        nearer: Whether the scene is nearer than the reference range.

    Returns:
        Sweeps of the same shape.
    """
    up_positive = (radar.dechirp_sign == "lo_conj_echo") != nearer
    up, down = sweeps.unbind(-3)
    return torch.stack([up, down.conj()] if up_positive else [up.conj(), down], -3)


def _cut_joined(line: Tensor, start: Tensor, n_period: int, radar: TriangularLadar) -> Tensor:
    """Cut periods (..., K', period) out of a contiguous record (..., 1, n), from sample
    `start` on.
    """
    period = 2 * radar.sweep_samples
    if line.shape[-1] != n_period * period:
        raise ValueError(
            f"a contiguous record of {n_period} periods of {period} samples must hold {n_period * period} "
            f"samples, got {line.shape[-1]}; give contiguous=False for blocks of another length"
        )
    if start.ndim == 0 and not host_value(start, 0):
        return line.squeeze(-2).unflatten(-1, (n_period, period))
    if n_period < 2:
        raise ValueError(
            f"a contiguous record of {n_period} period that starts inside a triangular sweep has no "
            "complete triangle; record 2 periods or more"
        )
    return _taken(line, start, (n_period - 1) * period).squeeze(-2).unflatten(-1, (n_period - 1, period))


def _cut_inside(blocks: Tensor, start: Tensor, radar: TriangularLadar) -> Tensor:
    """Cut periods (..., K, period) out of blocks (..., K, n), from sample `start` on."""
    period, n = 2 * radar.sweep_samples, blocks.shape[-1]
    if period > n or host_value(((start < 0) | (start + period > n)).any(), False):
        allowed = (
            f"which allows triggers from 0 to {(n - period) / radar.sample_rate_hz:.4g} s after the first sample"
            if n >= period
            else "too short for any trigger"
        )
        raise ValueError(
            f"blocks must hold a whole period of {period} samples after the trigger, got blocks of {n} samples, "
            f"{allowed}; record longer blocks, or every period without a gap (keep_every=1)"
        )
    return _taken(blocks, start, period)


def _taken(lines: Tensor, start: Tensor, n: int) -> Tensor:
    """Take n samples of every line (..., line, samples) from index `start` (...,) on."""
    if start.ndim == 0:
        return lines[..., start + torch.arange(n, device=lines.device)]
    index = start[..., None, None] + torch.arange(n, device=lines.device)
    shape = np.broadcast_shapes(lines.shape[:-2], start.shape)
    return lines.expand(*shape, *lines.shape[-2:]).gather(-1, index.expand(*shape, lines.shape[-2], n))


def circular_shift(record: Tensor, radar: TriangularLadar, shift_s: float) -> Tensor:
    """Shift the samples of each period circularly, as published; for comparisons only.

    >>> import torch
    >>> from torchsar import radar, repair
    >>> ladar = radar.TriangularLadar(2e14, 5e9, 16e-6, 64e6, 60.0, 3000.0)
    >>> record = torch.arange(2048.0).reshape(2, 1024)  # two periods
    >>> repair.circular_shift(record, ladar, 2 / ladar.sample_rate_hz)[:, [0, -1]].tolist()
    [[2.0, 1.0], [1026.0, 1025.0]]

    Samples that are one period apart become neighbours, which makes a phase step of 2 pi fd period
    (with the Doppler shift fd) inside a sweep. No estimator of the velocity tolerates this step,
    unless it lies a few samples from the end of a sweep. To separate sweeps use `split_record`,
    which cuts the continuous record instead.

    Args:
        record: Record, shape (..., pulse, time), real or complex.
        radar: Ladar parameters.
        shift_s: Shift to earlier times in seconds, rounded to whole samples.

    Returns:
        Record of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples.

    Reference:
        Remote Sens. 2024, 16, 793, Fig. 15b.
    """
    record = checked_samples(record, "circular_shift", "pulse, time", real=True, finite=False)
    return torch.roll(record, -round(shift_s * radar.sample_rate_hz), -1)


def blank_turning_points(
    sweeps: Tensor, radar: TriangularLadar, farthest_m: float, nearest_m: float = 0.0, margin: int = 0
) -> Tensor:
    """Set the samples to zero at which local oscillator and echo sweep in opposite directions.

    >>> import torch
    >>> from torchsar import radar, repair
    >>> ladar = radar.TriangularLadar(2e14, 5e9, 16e-6, 64e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 3, ladar.sweep_samples, dtype=torch.complex64)  # ramp, pulse, time
    >>> repair.blank_turning_points(sweeps, ladar, farthest_m=30.0)[0, 0].eq(0).sum().item()
    13

    The echo of a scatterer at a range RD beyond the reference range turns 2 RD / c after the local
    oscillator, so that the first ceil(2 RD fs / c) samples of each sweep are set to zero (fs: the
    sampling rate). With negative RD the echo turns earlier, and the last samples are set to zero.
    Differentiable.

    Args:
        sweeps: Sweeps, up before down, shape (..., 2, K, N), complex.
        radar: Ladar parameters.
        farthest_m: Largest range relative to the reference range in metres.
        nearest_m: Smallest range relative to the reference range in metres.
        margin: Number of further samples that are set to zero at either end.

    Returns:
        Sweeps of the same shape.

    Raises:
        ValueError: If there are no samples, or if less than half a sweep remains, the ranges are
            not in order, or the margin is negative.
        TypeError: If the sweeps are not complex64, complex128, float32 or float64.
    """
    sweeps = checked_samples(sweeps, "blank_turning_points", "fast time", real=True, finite=False)
    if not (nearest_m <= farthest_m and margin >= 0):
        raise ValueError(
            "blanking of turning points needs nearest_m <= farthest_m and a margin of 0 samples or more, "
            f"got nearest_m={nearest_m:g}, farthest_m={farthest_m:g} and margin={margin}"
        )
    first, last = (
        math.ceil(max(0.0, d) * 2 * radar.sample_rate_hz / radar.wave_speed_m_s - 1e-9) + margin
        for d in (farthest_m, -nearest_m)
    )
    n = sweeps.shape[-1]
    if not 0 <= first + last <= n // 2:
        raise ValueError(
            f"ranges of {nearest_m:g} to {farthest_m:g} m with a margin of {margin} samples would blank "
            f"{first + last} of {n} samples of a sweep, of which half must remain; check that the ranges are "
            "relative to the reference range"
        )
    index = torch.arange(n, device=sweeps.device)
    return sweeps * ((index >= first) & (index < n - last))


class SplitSweeps(Stage):
    """Separation of a record with the axes (pulse, time) into sweeps (ramp, pulse, fast_time).

    >>> import torch
    >>> from torchsar import Signal, radar, repair
    >>> ladar = radar.TriangularLadar(2e14, 5e9, 16e-6, 64e6, 60.0, 3000.0)
    >>> record = Signal(torch.zeros(3, 1024, dtype=torch.complex64), ladar.record_axes(3, 1024))
    >>> sweeps = repair.SplitSweeps(ladar, trigger=1e-6)(record)
    >>> sweeps.names, sweeps.data.shape
    (('ramp', 'pulse', 'fast_time'), torch.Size([2, 2, 512]))

    The trigger is the start of the triangle. A trigger that is common to all trials is added to the
    slow time of the sweeps. Triggers that differ between trials are not added, since all trials
    share one pulse axis: the slow time is then too early by the trigger, which is less than one
    period. The real samples of a one-channel detector become complex ones.

    In a chain, `use(SplitSweeps(radar, "recorded"), trigger_s="aux.trigger_s")` takes the trigger
    from the side data `trigger_s` of the recording.

    Args:
        radar: Ladar parameters.
        trigger: Start of the triangle in seconds on the time axis of the record; "recorded" if
            `forward` receives the trigger; or "search" to estimate it by `find_trigger`.
        nearer: Whether the scene is nearer than the reference range.
        assess: Whether an estimate of the trigger is assessed.

    Raises:
        ValueError: If the trigger is neither a finite number nor "recorded" nor "search".
    """

    works_on = ("pulse", "time")
    takes_real = True

    def __init__(
        self, radar: TriangularLadar, trigger: float | str = 0.0, nearer: bool = False, *, assess: bool = True
    ) -> None:
        super().__init__()
        if isinstance(trigger, str) and trigger not in ("recorded", "search"):
            raise ValueError(f"trigger must be a number of seconds, 'recorded' or 'search', got {trigger!r}")
        if not isinstance(trigger, str) and not math.isfinite(trigger):
            raise ValueError(f"trigger must be a finite number of seconds, got {trigger}")
        self.radar, self.trigger, self.nearer, self.assess = radar, trigger, nearer, assess
        self.provides = ("trigger_s",) if trigger == "search" else ()
        self.neutral = {"trigger_s": "a record has no nominal start of the triangle"} if self.provides else {}

    def forward(self, signal: Signal, trigger_s: Tensor | None = None) -> Signal | tuple[Signal, Estimate]:
        """Separate a record into up and down sweeps; see `split_record`.

        Args:
            signal: Record, shape (..., pulse, time), real or complex.
            trigger_s: Recorded trigger in seconds on the time axis of the record, a number or shape
                (...,).

        Returns:
            Sweeps, shape (..., ramp, pulse, fast_time), complex. If the trigger is searched for,
            also the Estimate of `find_trigger`, with `trigger_s` on the time axis of the record;
            trials without a reliable estimate are separated all the same.

        Raises:
            ValueError: If a recorded trigger is missing, the sampling rate is not that of the
                radar, or a whole period does not fit a block after the trigger.
        """
        radar, (pulse, time) = self.radar, signal.axes
        if abs(time.step * radar.sample_rate_hz - 1) > 1e-9:
            raise ValueError(
                f"the record is sampled at {1 / time.step:.6g} Hz, but sample_rate_hz of the radar is "
                f"{radar.sample_rate_hz:.6g} Hz; give the radar with which it was recorded"
            )
        contiguous = is_contiguous(time.n, radar) and abs(pulse.step / (time.n * time.step) - 1) < 1e-9
        if self.trigger == "search":
            found = find_trigger(signal.data, radar, contiguous, self.nearer, assess=self.assess)
            estimated = found["trigger_s"] + time.start
            found, fitting = replace(found, value={"trigger_s": estimated}), estimated
            if not contiguous:  # the trigger is limited so that a period fits into its block
                room = max(0, time.n - 2 * radar.sweep_samples)
                fitting = estimated.clamp(
                    time.start - 0.5 / radar.sample_rate_hz, time.start + (room - 0.6) / radar.sample_rate_hz
                )
            return self._split(signal, fitting, contiguous), found
        if self.trigger == "recorded" and trigger_s is None:
            raise ValueError(
                "SplitSweeps(trigger='recorded') needs the recorded time trigger_s; in a chain write "
                "use(SplitSweeps(radar, 'recorded'), trigger_s='aux.trigger_s')"
            )
        trigger = torch.as_tensor(self.trigger if trigger_s is None else trigger_s, dtype=torch.float64)
        return self._split(signal, trigger, contiguous)

    def _split(self, signal: Signal, trigger_s: Tensor, contiguous: bool) -> Signal:
        pulse, time = signal.axes
        data = split_record(signal.data, self.radar, trigger_s, contiguous, self.nearer, time.start)
        shift = 0.0
        if trigger_s.ndim == 0:
            start, fraction = start_sample(trigger_s.detach() - time.start, self.radar, contiguous)
            shift = time.start + (float(start + fraction) - 0.5) / self.radar.sample_rate_hz
        axes = self.radar.sweep_axes(data.shape[-2], pulse.start + shift)
        return Signal(data, (axes[0], Axis("pulse", data.shape[-2], axes[1].start, pulse.step, "s"), axes[2]))


class BlankTurningPoints(Stage):
    """Stage that sets the transients at turning points to zero; see `blank_turning_points`.

    Args:
        radar: Ladar parameters.
        farthest_m: Largest range relative to the reference range in metres.
        nearest_m: Smallest range relative to the reference range in metres.
        margin: Number of further samples that are set to zero at either end of a sweep.

    Raises:
        ValueError: If less than half a sweep remains, the ranges are not in order, or the margin is
            negative.
    """

    works_on = ("ramp", "pulse", "fast_time")

    def __init__(self, radar: TriangularLadar, farthest_m: float, nearest_m: float = 0.0, margin: int = 0) -> None:
        super().__init__()
        self.radar, self.farthest_m, self.nearest_m, self.margin = radar, farthest_m, nearest_m, margin
        blank_turning_points(torch.zeros(radar.sweep_samples), radar, farthest_m, nearest_m, margin)

    def forward(self, signal: Signal) -> Signal:
        """Set the samples at the turning points of sweeps to zero; see `blank_turning_points`.

        Args:
            signal: Sweeps, shape (..., ramp, pulse, fast_time).

        Returns:
            Signal of the same shape.
        """
        return signal.with_data(
            blank_turning_points(signal.data, self.radar, self.farthest_m, self.nearest_m, self.margin)
        )


CircularShift = Stage.of(circular_shift, works_on=("pulse", "time"), takes_real=True)
