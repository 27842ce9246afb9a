"""Simulation of the continuous record of a triangular-sweep ladar, transients included."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchsar.core import (
    Draws,
    Recording,
    Spline,
    Truth,
    cis,
    gathered_checks,
    per_trial,
    real_dtype,
    reduced_turns,
)
from torchsar.echo.ladar import SweepLines, lit_by, refuse_beats, shared
from torchsar.echo.ladar_course import LadarCourse, calibration_aux, hand_over
from torchsar.echo.recorded import Impairment, noise
from torchsar.echo.sums import blocks
from torchsar.echo.sweep_error import wound_turns
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.scene import EverySample, LadarWorld, LinearInSweep, Motion, QuadraticInSweep, Scatterers
from torchsar.scene.ladar import SweepError
from torchsar.scene.ladar_range import Effect, RangeHistory
from torchsar.scene.motion import displacement_m


def ladar_record(
    scatterers: Scatterers,
    radar: TriangularLadar,
    n_period: int,
    n_sample: int,
    motion: Sequence[Motion] = (),
    trigger_s: Tensor | float = 0.0,
    without: Sequence[Effect] = ("flight",),
    sweep_error: SweepError | None = None,
    log_amplitude: Callable[[Tensor], Tensor] | None = None,
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Return blocks of a continuous record without noise.

    The phase of a scatterer in cycles is fc dtau + psi(t') - psi(t' - dtau), with the carrier fc,
    the delay dtau relative to the reference range, the phase psi of the triangular frequency sweep
    and the time t' since the start of a triangle. In each block a triangle starts trigger_s after
    the start of the block; it is repeated before and after with the period.

    In an up-sweep psi(t') - psi(t' - dtau) is K (u dtau - dtau^2 / 2 + o^2), in a down-sweep its
    negative. Here K is the chirp rate, u the time from the middle of the sweep, and o the time by
    which t' - dtau lies outside this sweep, or 0 if it lies inside.

    Within a block the range of each scatterer follows a parabola, the motion a spline with 64 knots
    per period, and the log-amplitude a straight line. Differentiable.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Ladar parameters.
        n_period: Number of recorded periods, one block each.
        n_sample: Number of samples of a block.
        motion: Motions along the line of sight; draw random ones first with `drawn_motion`.
        trigger_s: Time from the start of a block to the start of an up-sweep in seconds, a number
            or one value per trial.
        without: Physical effects that are left out: "residual_video", "hyperbola" or "flight".
        sweep_error: Phase error of the laser.
        log_amplitude: Function of slow times (*times) that returns the log-amplitude, shape
            (*trials, *times); None for none.
        dtype: Complex dtype of the result; if radar.detection is "real", the result has the
            corresponding real dtype.

    Returns:
        Record, shape (*trials, pulse, time).

    Raises:
        ValueError: If a beat frequency exceeds half the sampling rate, or folds at zero in real
            samples.
    """
    axis, time = radar.record_axes(n_period, n_sample)
    scatterers = Scatterers(shared(scatterers.azimuth_m), shared(scatterers.range_m), scatterers.amplitude)
    start_s = axis.values(scatterers.range_m.device)
    paths = BlockPaths.of(scatterers, radar, start_s, n_sample, motion, without)
    video = 0.0 if "residual_video" in without else 0.5
    ramps = _Ramps.of(radar, time.values(scatterers.range_m.device), trigger_s, video)
    _refuse_record(scatterers, radar, n_period, motion, without)
    parts = []
    trials = np.broadcast_shapes(paths.start_m.shape[:-2], paths.knots.shape[:-2], scatterers.amplitude.shape[:-1])
    for rows in blocks(n_period, 8 * n_sample * math.prod(trials), 4 << 20):
        beat = _blocks(paths.part(rows), ramps, scatterers.amplitude, sweep_error, dtype)
        if log_amplitude is not None:
            beat = beat * _level(log_amplitude, start_s[rows], time.stop, n_sample).to(real_dtype(dtype))
        parts.append(beat)
    record = torch.cat(parts, -2)
    return record.conj().resolve_conj() if record.is_complex() and radar.dechirp_sign == "echo_conj_lo" else record


@dataclass(frozen=True)
class _Ramps:
    """Times within the triangle and within the sweep (s), and sweep rate (Hz/s), at the samples of
    a block.
    """

    radar: TriangularLadar
    position_s: Tensor  # time since the start of the triangle
    middle_s: Tensor  # time since the middle of the sweep
    rate: Tensor  # sweep rate with its sign
    video: float  # factor of the residual video phase: 0.5, or 0 to leave this phase out

    @staticmethod
    def of(radar: TriangularLadar, time_s: Tensor, trigger_s: Tensor | float, video: float) -> _Ramps:
        """The triangle at the samples of a block, (n,), or (*trials, 1, n) if the trigger times
        differ.
        """
        trigger = torch.as_tensor(trigger_s, dtype=torch.float64, device=time_s.device)
        position = time_s - (trigger if trigger.ndim == 0 else per_trial(trigger, 2, time_s))
        position = position - radar.period_s * torch.floor(position.detach() / radar.period_s + 1e-9)
        down = position.detach() >= radar.sweep_s * (1 - 1e-9)
        middle = position - radar.sweep_s * torch.where(down, 1.5, 0.5).to(time_s)
        return _Ramps(radar, position, middle, radar.chirp_rate_hz_s * torch.where(down, -1.0, 1.0).to(time_s), video)

    def turns(self, delay: Tensor, error: SweepError | None) -> Tensor:
        """Phase in cycles, (..., pulse, n), of a beat signal with given delays."""
        late = torch.relu((self.middle_s - delay).abs() - self.radar.sweep_s / 2)
        turns = delay * (self.radar.carrier_hz + self.rate * (self.middle_s - self.video * delay))
        turns = turns + self.rate * late.square()
        if error is None:
            return turns
        ends = [wound_turns(error, self.radar, at) for at in (self.position_s, self.position_s - delay)]
        return turns + ends[0] - ends[1]


@dataclass(frozen=True)
class BlockPaths:
    """Ranges of scatterers in blocks of a record.

    Args:
        start_m: Range relative to the reference range, without motion, at the start of the block in
            metres, shape (..., pulse, target), float64.
        speed: First derivative of that range at the start of the block in m/s, same shape.
        bend: Half the second derivative of that range in m/s^2, same shape.
        knots: Displacement by the motion at the knots of a spline in metres, shape (..., pulse,
            knot).
        shrink: Factor of the range, 1 - v / c at the radial velocity v where the flight time is
            modelled, otherwise 1, shape (..., pulse, target).
        lit: Whether the scatterer is illuminated, shape (..., pulse, target), bool.
        step_s: Distance of the knots in seconds.
        offsets_s: Times of the samples from the start of the block in seconds, shape (n,).
        wave_speed_m_s: Speed of light in m/s.
    """

    start_m: Tensor
    speed: Tensor
    bend: Tensor
    knots: Tensor
    shrink: Tensor
    lit: Tensor
    step_s: float
    offsets_s: Tensor
    wave_speed_m_s: float

    @staticmethod
    def of(
        scatterers: Scatterers,
        radar: TriangularLadar,
        start_s: Tensor,
        n_sample: int,
        motion: Sequence[Motion],
        without: Sequence[Effect],
    ) -> BlockPaths:
        """Compute the range history of every scatterer in each block of the record.

        Args:
            scatterers: Scatterers, shape (..., target).
            radar: Ladar parameters.
            start_s: Start times of the blocks in seconds, shape (pulse,), float64.
            n_sample: Number of samples in a block.
            motion: Motions along the line of sight; draw random ones first with `drawn_motion`.
            without: Names of physical effects that are left out of the model.

        Returns:
            Range histories of all blocks.
        """
        length = n_sample / radar.sample_rate_hz
        flight = "flight" not in without
        then = start_s - (radar.reference_range_m / radar.wave_speed_m_s if flight else 0.0)
        effects: tuple[Effect, ...] = ("flight", "hyperbola") if "hyperbola" in without else ("flight",)
        still = RangeHistory(scatterers, radar, (), float(start_s[0]), effects)
        first, middle, last = (still.at(then + share * length) for share in (0.0, 0.5, 1.0))
        # With 64 knots of the spline per period, the error is 1e-7 of a vibration with the period
        # of the triangle, and 1e-4 of one six times as fast.
        count = max(4, math.ceil(length / radar.period_s * 64))
        steps = length / count * torch.arange(count + 1, dtype=torch.float64, device=start_s.device)
        knots = displacement_m(motion, then[:, None] + steps - start_s[0])
        speed = (last - first) / length + ((knots[..., -1] - knots[..., 0]) / length)[..., None]
        shrink = 1 - speed / radar.wave_speed_m_s if flight else torch.ones_like(first)
        bend = 2 * ((last - middle) - (middle - first)) / length**2
        lit = lit_by(scatterers, radar, start_s + length / 2)
        offsets = radar.record_axes(len(start_s), n_sample)[1].values(start_s.device)
        start_speed = (last - first) / length - bend * length
        step_s, c = length / count, radar.wave_speed_m_s
        return BlockPaths(first, start_speed, bend, knots, shrink, lit, step_s, offsets, c)

    def part(self, rows: slice) -> BlockPaths:
        """Return the range histories of some blocks.

        Args:
            rows: The blocks.

        Returns:
            Their range histories.
        """
        names = ("start_m", "speed", "bend", "knots", "shrink", "lit")
        return replace(self, **{name: getattr(self, name)[..., rows, :] for name in names})

    def motion_m(self) -> Tensor:
        """Return the displacement by the motion at all samples of all blocks.

        Returns:
            Displacement in metres, shape (..., pulse, n).
        """
        return Spline(self.knots, (0.0, self.step_s)).at(self.offsets_s)

    def delay_s(self, target: int, motion_m: Tensor) -> Tensor:
        """Return the delay of one scatterer at all samples, relative to the reference range.

        Args:
            target: Index of the scatterer.
            motion_m: Displacement at the samples in metres, shape (..., pulse, n).

        Returns:
            Delay in seconds, twice the relative range over the speed of light, shape (..., pulse,
            n).
        """
        start_m, speed, bend, shrink = (
            x[..., target, None] for x in (self.start_m, self.speed, self.bend, self.shrink)
        )
        range_m = start_m + self.offsets_s * (speed + bend * self.offsets_s) + motion_m
        return 2 / self.wave_speed_m_s * shrink * range_m


def _blocks(
    paths: BlockPaths, ramps: _Ramps, amplitude: Tensor, error: SweepError | None, dtype: torch.dtype
) -> Tensor:
    """Sum over scatterers, one after the other, for blocks of the record."""
    total, motion = 0.0, paths.motion_m()
    for target in range(paths.start_m.shape[-1]):
        turns = reduced_turns(ramps.turns(paths.delay_s(target, motion), error))
        weight = amplitude[..., target, None, None] * paths.lit[..., target, None]
        if ramps.radar.detection == "real":  # a real echo is one cosine
            angle = (2 * math.pi * turns + torch.angle(weight)).to(real_dtype(dtype))
            total = total + torch.cos(angle) * weight.abs().to(real_dtype(dtype))
        else:
            total = total + cis((2 * math.pi * turns).to(real_dtype(dtype))) * weight.to(dtype)
    return total  # type: ignore[return-value]


def _level(log_amplitude: Callable[[Tensor], Tensor], start_s: Tensor, length_s: float, n: int) -> Tensor:
    """Amplitude exp(chi), (*trials, pulse, n), where chi follows a straight line in each block."""
    first, last = log_amplitude(start_s), log_amplitude(start_s + length_s)
    share = torch.linspace(0, 1, n, dtype=torch.float64, device=start_s.device)
    return torch.exp(first[..., None] + (last - first)[..., None] * share)


def _refuse_record(
    s: Scatterers, radar: TriangularLadar, n_period: int, motion: Sequence[Motion], without: Sequence[Effect]
) -> None:
    """Raise ValueError for beat frequencies that a record cannot represent."""
    pulse = radar.sweep_axes(n_period)[1]
    middle_s = sweep_middles(radar, pulse, s.range_m.device)
    history = RangeHistory(s, radar, motion, pulse.start, without)
    beat = SweepLines.of(history, LinearInSweep(tuple(without)), middle_s).slope
    contributing = lit_by(s, radar, middle_s) & (s.amplitude != 0)[..., None, None, :]
    refuse_beats(beat, contributing, radar)
    if radar.detection != "real":
        return
    # for real samples, the sign of a frequency is lost
    up = beat.detach() * torch.tensor([1.0, -1.0], dtype=torch.float64, device=beat.device)[:, None, None]
    low = float(torch.where(contributing, up, math.inf).min())
    high = float(torch.where(contributing, up, -math.inf).max())
    if low <= 0 <= high:
        raise ValueError(
            f"beat frequencies of {low / 1e6:.6g} to {high / 1e6:.6g} MHz fold at zero in real samples; move the "
            "reference range so far off the scene that the beat frequency due to range exceeds the Doppler shift, "
            '2 v / lambda, or record complex samples (detection "complex")'
        )


@gathered_checks()
def simulate_ladar_record(
    radar: TriangularLadar,
    world: LadarWorld,
    n_period: int,
    draws: Draws,
    block_s: float | None = None,
    trigger_s: Tensor | float = 0.0,
    trigger_known: bool = False,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate a continuous record of a ladar, batched over the trials of the draws.

    >>> from torchsar import Draws, echo, radar, scene
    >>> ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> world = scene.LadarWorld(scene.Points([0.0], [0.0]))
    >>> recording, _ = echo.simulate_ladar_record(ladar, world, n_period=4, draws=Draws(1))
    >>> recording.signal.names, recording.signal.data.shape
    (('pulse', 'time'), torch.Size([4, 256]))

    The record has one block per recorded period. Samples are complex or real by radar.detection;
    real noise has half the variance, so that the analytic signal has the signal-to-noise ratio of
    complex samples.

    Args:
        radar: Ladar parameters.
        world: Scene, motion, propagation, laser errors and noise.
        n_period: Number of recorded periods.
        draws: Random draws.
        block_s: Length of a block in seconds. By default one period if all periods are recorded, so
            that blocks adjoin, otherwise two periods.
        trigger_s: Time from the start of a block to the start of an up-sweep in seconds, a number
            or one value per trial. If it is a whole number of sampling intervals, such as 0, the
            samples of separated sweeps are samples of the record.
        trigger_known: Whether the recording holds the trigger times, as aux `trigger_s`.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording; real samples have the corresponding real dtype.
        device: Device of the recording.

    Returns:
        The recording, shape (..., pulse, time), and the truth. With a calibration fibre the
        recording has aux `calibration`, shape (..., 2, pulse or 1, fast_time), and
        `calibration_delay_s`. `clean` is the recording without motion and impairments, with the
        same noise and scintillation.

        Some true values are given once per block, shape (..., pulse). At the turning point,
        trigger_s plus half a period after the start of the block: `velocity_m_s`, the velocity of
        the motion alone, receding positive; `range_error_m`, the displacement in metres; and
        `log_amplitude` if it is modelled. At the middles of the up-sweeps and down-sweeps:
        `range_error_up_m` and `range_error_down_m`, the displacement in metres. Where the flight
        time is modelled, all these are the values at the time of reflection, which is earlier by
        the reference range over the speed of light. They are exact for up to 16 different trigger
        times, and interpolated for more.

        Further true values are `azimuth_m`, `range_m` and `amplitude` of the scatterers, shape
        (..., target); `noise_std`, the standard deviation of the noise of a complex sample, shape
        (...,); `trigger_s`; and the values of each impairment under "<impairment>.<name>".

    Raises:
        TypeError: If radar, world or draws has the wrong type.
        ValueError: If a beat frequency exceeds half the sampling rate or folds at zero, blocks
            overlap or hold no sweep, the fidelity does not apply to a record, the scene or the gate
            is empty, or a parameter per trial has another length than the trials.
    """
    if not isinstance(world.fidelity, EverySample | LinearInSweep | QuadraticInSweep):
        raise ValueError(
            "fidelity of a continuous record must be EverySample, LinearInSweep or QuadraticInSweep, got "
            f"{type(world.fidelity).__name__}; use simulate_ladar for this fidelity"
        )
    course = LadarCourse.of(radar, world, n_period, draws, device)
    axes = radar.record_axes(n_period, _block_samples(radar, block_s))
    trigger = torch.as_tensor(trigger_s, dtype=torch.float64, device=device)
    if trigger.ndim and draws.trials is not None and trigger.shape[-1] not in (1, len(draws.trials)):
        raise ValueError(
            f"trigger_s must be a number or one for each of the {len(draws.trials)} trials of the draws, "
            f"got shape {tuple(trigger.shape)}"
        )
    if not bool(torch.isfinite(trigger).all()):
        raise ValueError("trigger_s must be a finite number of seconds, or one per trial, got NaN or Inf")

    def echo_of(motion: Sequence[Motion]) -> Tensor:
        chi = None if course.chi is None else course.log_amplitude
        return ladar_record(
            course.scatterers,
            radar,
            n_period,
            axes[1].n,
            motion,
            trigger,
            world.fidelity.without,
            world.sweep_error,
            chi,
            dtype,
        )

    values = {
        **course.truths(radar, world, sweep_middles(radar, axes[0], course.scatterers.range_m.device), trigger),
        "trigger_s": trigger,
    }
    clean = echo_of(())
    data = echo_of(course.motion) if course.motion else clean
    if world.snr_db is not None:
        real = radar.detection == "real"
        std = values["noise_std"] / (math.sqrt(2) if real else 1.0)
        kind, shape = real_dtype(dtype) if real else dtype, [axis.n for axis in axes]
        added = noise(draws, "echo.ladar_record.noise", shape, std, kind, clean.device)
        added = added.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" and not real else added
        clean, data = clean + added, data + added
    aux = calibration_aux(radar, world, n_period, draws, dtype, device)
    aux = {**aux, "trigger_s": trigger} if trigger_known else aux
    return hand_over(data, clean, axes, radar, aux, values, impairments, draws)


def _block_samples(radar: TriangularLadar, block_s: float | None) -> int:
    """Number of samples of a block."""
    length = (radar.period_s if radar.keep_every == 1 else 2 * radar.period_s) if block_s is None else block_s
    if not radar.sweep_s <= length <= radar.pulse_step_s * (1 + 1e-9):
        raise ValueError(
            f"block_s must be at least the {radar.sweep_s:g} s of a sweep and at most the {radar.pulse_step_s:g} s "
            f"from one block to the next, got {length:g} s"
        )
    return round(length * radar.sample_rate_hz)
