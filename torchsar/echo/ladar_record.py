"""What the receiver of a triangular-sweep ladar records: a continuous beat with its transients at
the turning points, real or complex.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, UniformSpline, cis, per_trial, real_dtype, reduced_turns
from torchsar.echo.ladar import SweepLines, lit_by, refuse_beats, shared
from torchsar.echo.ladar_course import LadarCourse, calibration_aux, hand_over, noise_std, refuse_trials
from torchsar.echo.stripmap import Impairment
from torchsar.echo.sweep_error import wound_turns
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.scene import (
    Effect,
    EverySample,
    LadarWorld,
    LinearInSweep,
    Motion,
    QuadraticInSweep,
    RangeHistory,
    Scatterers,
    SweepError,
    displacement_m,
)

_BLOCK_BYTES = 4 << 20
# knots of the motion in a period, joined by a spline: 1e-7 of a vibration whose period is the
# triangle's, 1e-4 of one six times as fast
_KNOTS = 64


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
    """Blocks of a continuous record without noise, (*trials, pulse, time): of `dtype`, or of its
    real parts where radar.detection is "real".

    Turns of a scatterer: fc dtau + psi(t') - psi(t' - dtau), with psi the phase of the triangle and
    t' the time since a reference of it arrived; in block k triangles start at t_k + trigger_s, and
    one period before and after. Within a sweep that is +- (K u dtau - K dtau^2 / 2); an echo that
    was sent before the last turning point, by a time o, differs by +- K o^2 more. The range goes
    along parabolas within a block, the motion along splines with 64 knots a period, the
    log-amplitude along lines. trigger_s, and what log_amplitude gives at slow times (*times) ->
    (*trials, *times), may differ between trials. Differentiable. Raises ValueError where a beat
    does not fit the sampling rate, or real samples would fold it.
    """
    axis, time = radar.record_axes(n_period, n_sample)
    scatterers = Scatterers(shared(scatterers.azimuth_m), shared(scatterers.range_m), scatterers.amplitude)
    start_s = axis.values(scatterers.range_m.device)
    paths = BlockPaths.of(scatterers, radar, start_s, n_sample, motion, without)
    ramps = _Ramps.of(
        radar, time.values(scatterers.range_m.device), trigger_s, 0.0 if "residual_video" in without else 0.5
    )
    _refuse_record(scatterers, radar, n_period, motion, without)
    parts = []
    trials = torch.broadcast_shapes(
        paths.place.shape[:-2], paths.knots.shape[:-2], scatterers.amplitude.shape[:-1]
    ).numel()
    height = max(1, _BLOCK_BYTES // (8 * n_sample * trials))
    for first in range(0, n_period, height):
        beat = _blocks(paths.part(first, first + height), ramps, scatterers.amplitude, sweep_error, dtype)
        parts.append(
            beat
            if log_amplitude is None
            else beat
            * _level(log_amplitude, start_s[first : first + height], time.stop, n_sample).to(real_dtype(dtype))
        )
    record = torch.cat(parts, -2)
    return record.conj().resolve_conj() if record.is_complex() and radar.dechirp_sign == "echo_conj_lo" else record


@dataclass(frozen=True)
class _Ramps:
    """What the triangle does at the samples of a block: time from its start, and from the middle of
    the sweep (s), signed sweep rate (Hz/s).

    (n,), or (*trials, 1, n) with a trigger of each trial. video: 0.5, or 0 without the residual
    video phase.
    """

    radar: TriangularLadar
    position_s: Tensor
    middle_s: Tensor
    rate: Tensor
    video: float

    @staticmethod
    def of(radar: TriangularLadar, time_s: Tensor, trigger_s: Tensor | float, video: float) -> _Ramps:
        trigger = torch.as_tensor(trigger_s, dtype=torch.float64, device=time_s.device)
        position = time_s - (trigger if trigger.ndim == 0 else per_trial(trigger, 2, time_s))
        position = position - radar.period_s * torch.floor(position.detach() / radar.period_s + 1e-9)
        down = position.detach() >= radar.sweep_s * (1 - 1e-9)
        middle = position - radar.sweep_s * torch.where(down, 1.5, 0.5).to(time_s)
        return _Ramps(radar, position, middle, radar.chirp_rate_hz_s * torch.where(down, -1.0, 1.0).to(time_s), video)

    def turns(self, delay: Tensor, error: SweepError | None) -> Tensor:
        """Turns of a beat of delays against the reference, (..., pulse, n)."""
        late = torch.relu((self.middle_s - delay).abs() - self.radar.sweep_s / 2)
        turns = (
            delay * (self.radar.carrier_hz + self.rate * (self.middle_s - self.video * delay))
            + self.rate * late.square()
        )
        if error is None:
            return turns
        return (
            turns
            + wound_turns(error, self.radar, self.position_s)
            - wound_turns(error, self.radar, self.position_s - delay)
        )


@dataclass(frozen=True)
class BlockPaths:
    """Ranges of scatterers in blocks of the record: parabolas of each, and the motion of all at
    knots.

    place (m), speed (m/s), bend (m/s^2, half of it): (..., pulse, target) at the start of the
    block; knots: (..., pulse, knot) in m, step_s apart; shrink: (..., pulse, target), 1 - v / c
    where the flight time is modelled, else 1; lit: bool. offsets_s: (n,) of the samples.
    """

    place: Tensor
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
        length = n_sample / radar.sample_rate_hz
        flight = "flight" not in without
        then = start_s - (radar.reference_range_m / radar.wave_speed_m_s if flight else 0.0)
        effects: tuple[Effect, ...] = ("flight", "hyperbola") if "hyperbola" in without else ("flight",)
        still = RangeHistory(scatterers, radar, (), float(start_s[0]), effects)
        first, middle, last = (still.at(then + share * length) for share in (0.0, 0.5, 1.0))
        count = max(4, math.ceil(length / radar.period_s * _KNOTS))
        steps = length / count * torch.arange(count + 1, dtype=torch.float64, device=start_s.device)
        knots = displacement_m(motion, then[:, None] + steps - start_s[0])
        speed = (last - first) / length + ((knots[..., -1] - knots[..., 0]) / length)[..., None]
        shrink = 1 - speed / radar.wave_speed_m_s if flight else torch.ones_like(first)
        bend = 2 * ((last - middle) - (middle - first)) / length**2
        lit = lit_by(scatterers, radar, start_s + length / 2)
        offsets = radar.record_axes(len(start_s), n_sample)[1].values(start_s.device)
        return BlockPaths(
            first,
            (last - first) / length - bend * length,
            bend,
            knots,
            shrink,
            lit,
            length / count,
            offsets,
            radar.wave_speed_m_s,
        )

    def part(self, first: int, last: int) -> BlockPaths:
        """The blocks first..last-1."""
        return replace(
            self,
            **{
                name: getattr(self, name)[..., first:last, :]
                for name in ("place", "speed", "bend", "knots", "shrink", "lit")
            },
        )

    def motion_m(self) -> Tensor:
        """Displacement at the samples, (..., pulse, n)."""
        return UniformSpline(self.knots, 0.0, self.step_s).at(self.offsets_s)

    def delay_s(self, target: int, motion_m: Tensor) -> Tensor:
        """2 RD / c of one scatterer at the samples, (..., pulse, n)."""
        place, speed, bend, shrink = (v[..., target, None] for v in (self.place, self.speed, self.bend, self.shrink))
        range_m = place + self.offsets_s * (speed + bend * self.offsets_s) + motion_m
        return 2 / self.wave_speed_m_s * shrink * range_m


def _blocks(
    paths: BlockPaths, ramps: _Ramps, amplitude: Tensor, error: SweepError | None, dtype: torch.dtype
) -> Tensor:
    """Sum over scatterers, one after the other, in blocks of the record."""
    total, motion = 0.0, paths.motion_m()
    for target in range(paths.place.shape[-1]):
        turns = reduced_turns(ramps.turns(paths.delay_s(target, motion), error))
        weight = amplitude[..., target, None, None] * paths.lit[..., target, None]
        total = total + (
            _real_part(turns, weight, dtype)
            if ramps.radar.detection == "real"
            else cis((2 * math.pi * turns).to(real_dtype(dtype))) * weight.to(dtype)
        )
    return total  # type: ignore[return-value]


def _real_part(turns: Tensor, weight: Tensor, dtype: torch.dtype) -> Tensor:
    """Real part of weight * exp(2j pi turns), by one cosine."""
    angle = 2 * math.pi * turns + torch.angle(weight)
    return torch.cos(angle.to(real_dtype(dtype))) * weight.abs().to(real_dtype(dtype))


def _level(log_amplitude: Callable[[Tensor], Tensor], start_s: Tensor, length_s: float, n: int) -> Tensor:
    """exp(chi), chi along a line in each block, (*trials, pulse, n)."""
    first, last = log_amplitude(start_s), log_amplitude(start_s + length_s)
    share = torch.linspace(0, 1, n, dtype=torch.float64, device=start_s.device)
    return torch.exp(first[..., None] + (last - first)[..., None] * share)


def _refuse_record(
    s: Scatterers, radar: TriangularLadar, n_period: int, motion: Sequence[Motion], without: Sequence[Effect]
) -> None:
    middle_s = sweep_middles(radar, radar.sweep_axes(n_period)[1], s.range_m.device)
    level = LinearInSweep(tuple(without))
    beat = SweepLines.of(
        RangeHistory(s, radar, motion, radar.sweep_axes(n_period)[1].start, without), level, middle_s
    ).slope
    shines = lit_by(s, radar, middle_s) & (s.amplitude != 0)[..., None, None, :]
    refuse_beats(beat, shines, radar)
    if radar.detection == "real":
        _refuse_folding(beat.detach(), shines)


def _refuse_folding(beat_hz: Tensor, shines: Tensor) -> None:
    """Real samples do not know the sign of a beat: all must be positive in up sweeps and negative
    in down sweeps, or the reverse.
    """
    up = beat_hz * torch.tensor([1.0, -1.0], dtype=torch.float64, device=beat_hz.device)[:, None, None]
    low, high = float(torch.where(shines, up, math.inf).min()), float(torch.where(shines, up, -math.inf).max())
    if low <= 0 <= high:
        raise ValueError(
            f"beats of {low / 1e6:.6g} to {high / 1e6:.6g} MHz fold at zero in real samples; move "
            "the reference range off the scene until the beat of the "
            'range is beyond that of the velocity, 2 v / lambda, or detect complex samples (detection "complex")'
        )


def simulate_ladar_record(
    radar: TriangularLadar,
    world: LadarWorld,
    n_period: int,
    draws: Draws,
    block_s: float | None = None,
    trigger_s: Tensor | float = 0.0,
    told_trigger: bool = False,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """A continuous record (pulse, time) of a world, one block a recorded period, and the truth
    about it; batched over the trials of `draws`.

    block_s: length of a block; by default one period where all are recorded, so that blocks join,
    and two periods where only every keep_every-th is. trigger_s: where in the block an up sweep
    starts, a number or per-trial tensor (whole samples, zero among them, put samples on the
    symmetric grid of separated sweeps); the recording holds it as aux `trigger_s` only if
    told_trigger. Samples are complex (`dtype`) or real (its real dtype) by radar.detection; real
    noise has half the variance, so that the analytic signal has the SNR of complex samples. Truth
    and aux are as of `simulate_ladar`, at the turning points t_k + trigger_s + period / 2, besides
    `trigger_s`. Raises ValueError for beats beyond the sampling rate or that fold, blocks that
    overlap or hold no sweep, a fidelity that is no record's.
    """
    if not isinstance(world.fidelity, EverySample | LinearInSweep | QuadraticInSweep):
        raise ValueError(
            "a continuous record follows the range at every sample, which "
            f"{type(world.fidelity).__name__} does not; use simulate_ladar for such studies"
        )
    course = LadarCourse.of(radar, world, n_period, draws, device)
    axes = radar.record_axes(n_period, _block_samples(radar, block_s))
    trigger = torch.as_tensor(trigger_s, dtype=torch.float64, device=device)
    refuse_trials("trigger_s", trigger, draws)
    if not bool(torch.isfinite(trigger).all()):
        raise ValueError("trigger_s must be finite seconds, a number or one per trial, got NaN or Inf")

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
    noise = _record_noise(world.snr_db, tuple(axis.n for axis in axes), radar, draws, dtype, clean.device)
    data = echo_of(course.motion) + noise if course.motion else clean + noise
    aux = calibration_aux(radar, world, n_period, draws, dtype, device)
    return hand_over(
        data,
        clean + noise,
        axes,
        radar,
        {**aux, "trigger_s": trigger} if told_trigger else aux,
        values,
        impairments,
        draws,
    )


def _block_samples(radar: TriangularLadar, block_s: float | None) -> int:
    length = (radar.period_s if radar.keep_every == 1 else 2 * radar.period_s) if block_s is None else block_s
    if not radar.sweep_s <= length <= radar.pulse_step_s * (1 + 1e-9):
        raise ValueError(
            f"blocks of {length:g} s must hold a sweep of {radar.sweep_s:g} s and not overlap, "
            f"being {radar.pulse_step_s:g} s apart; choose block_s between"
        )
    return round(length * radar.sample_rate_hz)


def _record_noise(
    snr_db: Tensor | float | None,
    shape: tuple[int, ...],
    radar: TriangularLadar,
    draws: Draws,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor | float:
    if snr_db is None:
        return 0.0
    real = radar.detection == "real"
    unit = draws.normal("echo.ladar_record.noise", shape, real_dtype(dtype) if real else dtype, device)
    unit = unit.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" and not real else unit
    std = noise_std(snr_db, unit) / (math.sqrt(2) if real else 1.0)
    return unit * std.to(real_dtype(dtype))[..., None, None]
