"""Simulated acquisitions of a triangular-sweep ladar, sweep by sweep: world in, recording and truth
out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, linear_phasor, real_dtype, unit_phasor
from torchsar.echo.ladar_course import LadarCourse, calibration_aux, hand_over
from torchsar.echo.stripmap import Impairment
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.scene import (
    EverySample,
    Fidelity,
    LadarWorld,
    LinearInSweep,
    Motion,
    RangeHistory,
    Scatterers,
    SweepError,
)

_TABLE_BYTES = 8 << 20
_DEFAULT = LinearInSweep()
# sign of the sweep rate in up and down sweeps
_RATES = (1.0, -1.0)


def ladar_echo(
    scatterers: Scatterers,
    radar: TriangularLadar,
    n_period: int,
    motion: Sequence[Motion] = (),
    fidelity: Fidelity = _DEFAULT,
    sweep_error: SweepError | None = None,
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Dechirped sweeps without noise, (*trials, 2, pulse, fast_time) of `dtype`: up sweeps, then
    down sweeps, both in natural time order.

    Turns of a scatterer at RD(t) beyond the reference, dtau = 2 RD / c, in the convention LO *
    conj(echo): fc dtau +- (K u dtau - K dtau^2 / 2), + in the up sweep (brief 000, section 3); all
    conjugated for "echo_conj_lo". Beside the beam (radar.beam_rad) a scatterer is dark: |V t - x|
    beyond half the beam in the middle of the sweep. motion: without random ones. sweep_error: below
    `EverySample` its change with the motion of a scatterer within the sweep and with that of the
    whole is left out. Differentiable in positions, amplitudes and motions. Raises ValueError where
    a beat does not fit the sampling rate.
    """
    s = Scatterers(shared(scatterers.azimuth_m), shared(scatterers.range_m), scatterers.amplitude)
    history = RangeHistory(s, radar, motion, radar.sweep_axes(n_period)[1].start, fidelity.without)
    middle_s = sweep_middles(radar, radar.sweep_axes(n_period)[1], s.range_m.device)
    lit = lit_by(s, radar, middle_s)
    lines = SweepLines.of(history, fidelity, middle_s)
    refuse_beats(lines.slope, lit & (s.amplitude != 0)[..., None, None, :], radar)
    if isinstance(fidelity, EverySample):
        echo = _sampled(history, sweep_error, middle_s, lit, lines.start.shape[:-3].numel(), dtype)
    else:
        echo = _lined(lines, s, sweep_error, lit, radar, dtype)
    return echo.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else echo


def lit_by(s: Scatterers, radar: TriangularLadar, time_s: Tensor) -> Tensor:
    """Whether the beam lights each scatterer at times of any shape, bool (..., *times, target)."""
    x, near = (
        v.detach()[(...,) + (None,) * time_s.ndim + (slice(None),)]
        for v in (s.azimuth_m, radar.reference_range_m + s.range_m)
    )
    half_m = math.inf if radar.beam_rad is None else radar.beam_rad * near / 2
    return (radar.speed_m_s * time_s[..., None] - x).abs() <= half_m


def refuse_beats(beat_hz: Tensor, shines: Tensor, radar: TriangularLadar) -> None:
    """Raise ValueError where a beat of a scatterer that shines lies beyond half the
    sampling rate.
    """
    try:
        worst = float(torch.where(shines, beat_hz.detach().abs(), 0.0).max())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not worst < radar.sample_rate_hz / 2:
        raise ValueError(
            f"a scatterer beats at {worst / 1e6:.6g} MHz, beyond half the sampling rate of "
            f"{radar.sample_rate_hz / 1e6:g} MHz; bring it nearer to the reference range "
            f"(1 m is {radar.beat_hz(1.0) / 1e6:.3g} MHz), move it more slowly (1 m/s is "
            f"{radar.doppler_hz(1.0) / 1e6:.3g} MHz), sample faster, or gate it out (gate_m)"
        )


@dataclass(frozen=True)
class SweepLines:
    """Phase of each scatterer in each sweep: turns in its middle, slope (Hz), and bend of all
    (turns / s^2), None for straight lines.

    start, slope: (*trials, 2, pulse, target); curve: (*trials, 2, pulse). float64.
    """

    start: Tensor
    slope: Tensor
    curve: Tensor | None

    @staticmethod
    def of(history: RangeHistory, fidelity: Fidelity, middle_s: Tensor) -> SweepLines:
        """Lines at the level of `fidelity`; those of `EverySample` serve only to judge its
        beats.
        """
        radar, per_m = history.radar, 2 / history.radar.wave_speed_m_s
        place, speed, bend = fidelity.sweep_range_m(history, middle_s)
        rate = radar.chirp_rate_hz_s * torch.tensor(_RATES, dtype=torch.float64, device=middle_s.device)[:, None, None]
        video = 0.0 * rate if "residual_video" in history.without else rate
        delay, drift = per_m * place, per_m * speed
        start = radar.carrier_hz * delay - video * delay.square() / 2
        slope = radar.carrier_hz * drift + rate * delay - video * delay * drift
        if bend is None:
            return SweepLines(start, slope, None)
        curve = radar.carrier_hz * per_m * bend / 2 + rate * drift - video * (drift.square() + delay * per_m * bend) / 2
        return SweepLines(start, slope, curve.mean(-1))


def _lined(
    lines: SweepLines, s: Scatterers, error: SweepError | None, lit: Tensor, radar: TriangularLadar, dtype: torch.dtype
) -> Tensor:
    """Sum over scatterers of straight lines of phase, (*trials, 2, pulse, fast_time), bent
    together.
    """
    u = radar.fast_time_axis().values(lines.start.device)
    amplitude = s.amplitude[..., None, None, :].to(dtype) * lit
    table = None if error is None else _error_table(error, s, u, radar, dtype)
    parts = []
    for pulses in _pulse_blocks(lines.start.shape[-2], 2 * s.range_m.shape[-1] * 16 * 64):
        weight = unit_phasor(lines.start[..., pulses, :], dtype) * amplitude[..., pulses, :]
        turns = lines.slope[..., pulses, :] / radar.sample_rate_hz
        total = _line_sum(weight, turns, len(u), dtype) if table is None else _erring_sum(weight, turns, table)
        parts.append(
            total if lines.curve is None else total * unit_phasor(lines.curve[..., pulses, None] * u.square(), dtype)
        )
    return torch.cat(parts, -2)


def _line_sum(weight: Tensor, turns: Tensor, n: int, dtype: torch.dtype) -> Tensor:
    """sum_m weight_m exp(2j pi turns_m i), i counted from the middle of n samples: (..., target) ->
    (..., n), as a product of two short tables.
    """
    m = 2 ** round(math.log2(n) / 2)
    fine, coarse = linear_phasor(turns, 0, m, dtype), linear_phasor(m * turns, -(n - 1) / (2 * m), -(-n // m), dtype)
    return ((coarse * weight[..., None]).mT @ fine).flatten(-2)[..., :n]


def _erring_sum(weight: Tensor, turns: Tensor, table: Tensor) -> Tensor:
    """The same with phases of their own for each scatterer, table (..., 2, 1, target, n): scatterer
    by scatterer, as lines are no longer short tables.
    """
    n, total = table.shape[-1], torch.zeros((), dtype=table.dtype, device=table.device)
    for at in range(turns.shape[-1]):
        total = (
            total
            + weight[..., at, None] * linear_phasor(turns[..., at], -(n - 1) / 2, n, table.dtype) * table[..., at, :]
        )
    return total


def _error_table(error: SweepError, s: Scatterers, u: Tensor, radar: TriangularLadar, dtype: torch.dtype) -> Tensor:
    """exp(2j pi (e(u) - e(u - dtau))) of scatterers at rest, (..., 2, 1, target, n)."""
    delay = (2 / radar.wave_speed_m_s * s.range_m)[..., None]
    return torch.stack(
        [unit_phasor(error.turns(u, ramp) - error.turns(u - delay, ramp), dtype) for ramp in (0, 1)], -3
    )[..., None, :, :]


def _sampled(
    history: RangeHistory, error: SweepError | None, middle_s: Tensor, lit: Tensor, trials: int, dtype: torch.dtype
) -> Tensor:
    """Direct evaluation, the range at every sample; blocks hold the ranges of so many trials."""
    s, radar = history.scatterers, history.radar
    u = radar.fast_time_axis().values(middle_s.device)
    amplitude = s.amplitude[..., None, None, :].to(dtype) * lit
    parts = []
    for pulses in _pulse_blocks(middle_s.shape[-1], 16 * trials * 2 * len(u) * s.range_m.shape[-1]):
        turns = _sample_turns(history, error, middle_s[:, pulses, None] + u, u)
        parts.append((unit_phasor(turns, dtype) * amplitude[..., pulses, None, :]).sum(-1))
    return torch.cat(parts, -2)


def _sample_turns(history: RangeHistory, error: SweepError | None, time_s: Tensor, u: Tensor) -> Tensor:
    """Turns at times (2, pulse, fast_time), (*trials, 2, pulse, fast_time, target)."""
    radar = history.radar
    delay = 2 / radar.wave_speed_m_s * history.at(time_s)
    half = 0.0 if "residual_video" in history.without else 0.5
    rate = radar.chirp_rate_hz_s * torch.tensor(_RATES, dtype=torch.float64, device=u.device)[:, None, None, None]
    turns = delay * (radar.carrier_hz + rate * (u[:, None] - half * delay))
    if error is None:
        return turns
    return turns + torch.stack(
        [error.turns(u[:, None], ramp) - error.turns(u[:, None] - delay[..., ramp, :, :, :], ramp) for ramp in (0, 1)],
        -4,
    )


def shared(positions: Tensor) -> Tensor:
    """Positions without trial dims that only repeat them."""
    while positions.ndim > 1 and (positions.shape[0] == 1 or positions.stride(0) == 0):
        positions = positions[0]
    return positions


def _pulse_blocks(n_pulse: int, bytes_per_pulse: int) -> Iterator[slice]:
    height = max(1, min(n_pulse, _TABLE_BYTES // bytes_per_pulse))
    for first in range(0, n_pulse, height):
        yield slice(first, min(first + height, n_pulse))


def simulate_ladar(
    radar: TriangularLadar,
    world: LadarWorld,
    n_period: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Separated sweeps (ramp, pulse, fast_time) of a world and the truth about it, batched over the
    trials of `draws`.

    The samples are complex whatever radar.detection is, as an ideal splitter would hand them over;
    `simulate_ladar_record` gives what the receiver records. aux: `calibration` (..., 2, K or 1,
    fast_time) and `calibration_delay_s` where the world has a fibre. The truth, float64 (...,
    pulse) at the turning points t_k + period / 2 (with the flight time R / c earlier):
    `velocity_m_s` of the motion alone, receding positive; `range_error_m`, and `range_error_up_m`,
    `range_error_down_m` in the middles of sweeps; `log_amplitude` where modelled; `azimuth_m`,
    `range_m`, `amplitude` of the scatterers; `noise_std` of a sample; what each impairment says
    under "<impairment>.<name>". `clean` is the same world without motion and impairments, with the
    same noise and scintillation. Raises ValueError for beats beyond the sampling rate, an empty
    scene or gate.
    """
    course = LadarCourse.of(radar, world, n_period, draws, device)
    axes = radar.sweep_axes(n_period)
    middle_s = sweep_middles(radar, axes[1], course.scatterers.range_m.device)

    def echo_of(motion: Sequence[Motion]) -> Tensor:
        return ladar_echo(course.scatterers, radar, n_period, motion, world.fidelity, world.sweep_error, dtype)

    level = torch.exp(course.log_amplitude(middle_s)).to(real_dtype(dtype))[..., None]
    values = course.truths(radar, world, middle_s)
    noise = _noise(values["noise_std"], world.snr_db, (2, n_period, axes[2].n), radar, draws, dtype)
    clean = echo_of(()) * level + noise
    data = echo_of(course.motion) * level + noise if course.motion else clean
    return hand_over(
        data,
        clean,
        axes,
        radar,
        calibration_aux(radar, world, n_period, draws, dtype, device),
        values,
        impairments,
        draws,
    )


def _noise(
    std: Tensor,
    snr_db: Tensor | float | None,
    shape: tuple[int, ...],
    radar: TriangularLadar,
    draws: Draws,
    dtype: torch.dtype,
) -> Tensor | float:
    """Circular noise, conjugated with the dechirp sign, so that both conventions give conjugate
    recordings.
    """
    if snr_db is None:
        return 0.0
    unit = draws.normal("echo.ladar.noise", shape, dtype, std.device)
    unit = unit.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else unit
    return unit * std.to(real_dtype(dtype))[(...,) + (None,) * len(shape)]
