"""Simulation of a triangular-sweep ladar by separated sweeps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, gathered_checks, host_largest, linear_phasor, real_dtype, unit_phasor
from torchsar.echo.ladar_course import LadarCourse, calibration_aux, hand_over
from torchsar.echo.recorded import Impairment, noise
from torchsar.echo.sums import LineSum, blocks, row_bytes
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.scene import EverySample, LadarWorld, LinearInSweep, Motion, Scatterers
from torchsar.scene.ladar import SweepError
from torchsar.scene.ladar_range import Fidelity, RangeHistory

_DEFAULT = LinearInSweep()
# sign of the sweep rate in up-sweeps and in down-sweeps
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
    """Return dechirped sweeps without noise.

    >>> import torch
    >>> from torchsar import echo, radar, scene
    >>> ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> range_m = torch.tensor([10 * ladar.range_step_m], dtype=torch.float64)
    >>> point = scene.Scatterers(0 * range_m, range_m, torch.ones(1, dtype=torch.complex128))
    >>> torch.fft.fft(echo.ladar_echo(point, ladar, 2)).abs().argmax(-1)  # up-sweeps, down-sweeps
    tensor([[ 10,  10],
            [118, 118]])

    The phase of a scatterer in cycles is fc dtau +- (K u dtau - K dtau^2 / 2), with + in up-sweeps
    and - in down-sweeps. Here fc is the carrier, K the chirp rate, u the time from the middle of
    the sweep and dtau = 2 RD / c the delay, with the range RD relative to the reference range. This
    holds for radar.dechirp_sign "lo_conj_echo"; for "echo_conj_lo" the samples are conjugated.

    A scatterer at azimuth x is illuminated in a sweep if |V t - x| is at most half the width of the
    beam at the slow time t of the middle of the sweep, with the speed V of the ladar.
    Differentiable in positions, amplitudes and motions.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Ladar parameters.
        n_period: Number of periods.
        motion: Motions along the line of sight; draw random ones first with `drawn_motion`.
        fidelity: Model of the range within a sweep.
        sweep_error: Phase error of the laser. All models of the range but `EverySample` compute it
            as for scatterers at rest.
        dtype: Complex dtype of the result.

    Returns:
        Sweeps, shape (*trials, 2, pulse, fast_time), up-sweeps first, both in their natural order
        of time.

    Raises:
        ValueError: If a beat frequency exceeds half the sampling rate.

    Reference:
        Remote Sens. 2024, 16, 793, section 2.2, with the signs of the down-sweep corrected.
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
        echo = _sum_of_lines(lines, s, sweep_error, lit, radar, dtype)
    return echo.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else echo


def range_model_error_db(
    scatterers: Scatterers,
    radar: TriangularLadar,
    n_period: int,
    motion: Sequence[Motion] = (),
    fidelity: Fidelity = _DEFAULT,
) -> float:
    """Predict the relative error that a range model makes in the echo of one scatterer.

    The error is 1 - |mean exp(j phi)|^2 in dB, where phi is the phase difference between the model
    and the exact echo, in which the range is evaluated at every sample with all effects. A complex
    gain that is common to the whole echo counts as no error. To save time the mean is taken over a
    regular selection of periods and samples.

    Args:
        scatterers: One scatterer without trial dimensions, shape (1,).
        radar: Ladar parameters.
        n_period: Number of recorded periods.
        motion: Motions along the line of sight; draw random ones first with `drawn_motion`.
        fidelity: Model of the range within a sweep.

    Returns:
        Error in dB; -300 dB where there is none.

    Raises:
        ValueError: If the beam never illuminates the scatterer.
    """
    pulse = radar.sweep_axes(n_period)[1]
    middle_s = sweep_middles(radar, pulse)[:, :: max(1, n_period // 256)]
    u = radar.fast_time_axis().values()[:: max(1, radar.sweep_samples // 16)]
    time_s = middle_s[..., None] + u
    exact, model = (RangeHistory(scatterers, radar, motion, pulse.start, without) for without in ((), fidelity.without))
    if isinstance(fidelity, EverySample):
        turns = _sample_turns(model, None, time_s, u)[..., 0]
    else:
        lines = SweepLines.of(model, fidelity, middle_s)
        turns = lines.start + lines.slope * u
        turns = turns if lines.curve is None else turns + lines.curve[..., None] * u.square()
    lit = lit_by(scatterers, radar, middle_s).expand(turns.shape).to(torch.float64)
    if not bool(lit.any()):
        raise ValueError(
            "the beam illuminates none of the scatterers during the record; widen the beam (beam_rad), record more "
            "periods, or move the scatterers"
        )
    error = unit_phasor(turns - _sample_turns(exact, None, time_s, u)[..., 0], torch.complex128)
    mean = (lit * error).sum().abs() / lit.sum()
    return 10 * math.log10(max(1 - float(mean) ** 2, 1e-30))


def lit_by(s: Scatterers, radar: TriangularLadar, time_s: Tensor) -> Tensor:
    """Return whether the beam illuminates each scatterer at each time.

    Args:
        s: Scatterers, shape (..., target).
        radar: Ladar parameters.
        time_s: Slow time in seconds, any shape, float64.

    Returns:
        Shape (..., *times, target), bool.
    """
    x, near = (
        v.detach()[(...,) + (None,) * time_s.ndim + (slice(None),)]
        for v in (s.azimuth_m, radar.reference_range_m + s.range_m)
    )
    half_m = math.inf if radar.beam_rad is None else radar.beam_rad * near / 2
    return (radar.speed_m_s * time_s[..., None] - x).abs() <= half_m


def refuse_beats(beat_hz: Tensor, shines: Tensor, radar: TriangularLadar) -> None:
    """Raise ValueError if a beat frequency exceeds half the sampling rate.

    Args:
        beat_hz: Beat frequencies in hertz, shape (..., target).
        shines: Whether a scatterer contributes to the echo, broadcastable to beat_hz, bool.
        radar: Ladar parameters.

    Raises:
        ValueError: If a contributing scatterer has too high a beat frequency.
    """
    worst = host_largest(torch.where(shines, beat_hz.detach().abs(), 0.0), 0.0)
    if not worst < radar.sample_rate_hz / 2:
        raise ValueError(
            f"the beat frequency of a scatterer must be below half the sampling rate, {radar.sample_rate_hz / 2e6:g} "
            f"MHz, got {worst / 1e6:.6g} MHz; move it nearer to the reference range "
            f"(1 m is {radar.beat_hz(1.0) / 1e6:.3g} MHz), move it more slowly (1 m/s is "
            f"{radar.doppler_hz(1.0) / 1e6:.3g} MHz), sample faster, or exclude it by gate_m"
        )


@dataclass(frozen=True)
class SweepLines:
    """Phase of each scatterer in each sweep as a polynomial of the time from the sweep middle.

    Args:
        start: Phase at the middle of the sweep in cycles, shape (*trials, 2, pulse, target),
            float64.
        slope: Frequency in hertz, same shape.
        curve: Quadratic coefficient in cycles per square second, the mean of all scatterers, shape
            (*trials, 2, pulse); None for straight lines.
    """

    start: Tensor
    slope: Tensor
    curve: Tensor | None

    @staticmethod
    def of(history: RangeHistory, fidelity: Fidelity, middle_s: Tensor) -> SweepLines:
        """Form the phase polynomials of a range history.

        For the range model `EverySample` the polynomials serve only to check beat frequencies.

        Args:
            history: Range of the scatterers.
            fidelity: Model of the range within a sweep.
            middle_s: Slow times of the sweep middles in seconds, shape (2, pulse).

        Returns:
            The polynomials.
        """
        radar, per_m = history.radar, 2 / history.radar.wave_speed_m_s
        range_m, speed, bend = fidelity.sweep_range_m(history, middle_s)
        rate = radar.chirp_rate_hz_s * torch.tensor(_RATES, dtype=torch.float64, device=middle_s.device)[:, None, None]
        video = 0.0 * rate if "residual_video" in history.without else rate
        delay, drift = per_m * range_m, per_m * speed
        start = radar.carrier_hz * delay - video * delay.square() / 2
        slope = radar.carrier_hz * drift + rate * delay - video * delay * drift
        if bend is None:
            return SweepLines(start, slope, None)
        curve = radar.carrier_hz * per_m * bend / 2 + rate * drift - video * (drift.square() + delay * per_m * bend) / 2
        return SweepLines(start, slope, curve.mean(-1))


def _sum_of_lines(
    lines: SweepLines, s: Scatterers, error: SweepError | None, lit: Tensor, radar: TriangularLadar, dtype: torch.dtype
) -> Tensor:
    """Sum over scatterers with polynomial phases, (*trials, 2, pulse, fast_time)."""
    u = radar.fast_time_axis().values(lines.start.device)
    amplitude = s.amplitude[..., None, None, :].to(dtype) * lit
    table = None if error is None else _error_table(error, s, u, radar, dtype)
    n, parts = len(u), []
    for pulses in blocks(lines.start.shape[-2], 2 * row_bytes(s.range_m.shape[-1], n, dtype)):
        weight = unit_phasor(lines.start[..., pulses, :], dtype) * amplitude[..., pulses, :]
        turns = lines.slope[..., pulses, :] / radar.sample_rate_hz
        if table is None:
            total = LineSum(turns, n, -(n - 1) / 2, dtype)(weight)
        else:
            total = _sum_with_errors(weight, turns, table)
        if lines.curve is not None:
            total = total * unit_phasor(lines.curve[..., pulses, None] * u.square(), dtype)
        parts.append(total)
    return torch.cat(parts, -2)


def _sum_with_errors(weight: Tensor, turns: Tensor, table: Tensor) -> Tensor:
    """Sum over scatterers, one after the other, multiplied by a phase table (..., 2, 1,
    target, n).
    """
    n, total = table.shape[-1], torch.zeros((), dtype=table.dtype, device=table.device)
    for at in range(turns.shape[-1]):
        phasor = weight[..., at, None] * linear_phasor(turns[..., at], -(n - 1) / 2, n, table.dtype)
        total = total + phasor * table[..., at, :]
    return total


def _error_table(error: SweepError, s: Scatterers, u: Tensor, radar: TriangularLadar, dtype: torch.dtype) -> Tensor:
    """Phasors exp(2j pi (e(u) - e(u - dtau))) of scatterers at rest, (..., 2, 1, target, n)."""
    delay = (2 / radar.wave_speed_m_s * s.range_m)[..., None]
    turns = [error.turns(u, ramp, 2) - error.turns(u - delay, ramp, 2) for ramp in (0, 1)]
    return unit_phasor(torch.stack(torch.broadcast_tensors(*turns), -3), dtype)[..., None, :, :]


def _sampled(
    history: RangeHistory, error: SweepError | None, middle_s: Tensor, lit: Tensor, trials: int, dtype: torch.dtype
) -> Tensor:
    """Sum over scatterers, with the range computed at every sample, in blocks of pulses."""
    s, radar = history.scatterers, history.radar
    u = radar.fast_time_axis().values(middle_s.device)
    amplitude = s.amplitude[..., None, None, :].to(dtype) * lit
    parts = []
    for pulses in blocks(middle_s.shape[-1], 16 * trials * 2 * len(u) * s.range_m.shape[-1]):
        turns = _sample_turns(history, error, middle_s[:, pulses, None] + u, u)
        parts.append((unit_phasor(turns, dtype) * amplitude[..., pulses, None, :]).sum(-1))
    return torch.cat(parts, -2)


def _sample_turns(history: RangeHistory, error: SweepError | None, time_s: Tensor, u: Tensor) -> Tensor:
    """Phases at times (2, pulse, fast_time) in cycles, (*trials, 2, pulse, fast_time, target)."""
    radar = history.radar
    delay = 2 / radar.wave_speed_m_s * history.at(time_s)
    half = 0.0 if "residual_video" in history.without else 0.5
    rate = radar.chirp_rate_hz_s * torch.tensor(_RATES, dtype=torch.float64, device=u.device)[:, None, None, None]
    turns = delay * (radar.carrier_hz + rate * (u[:, None] - half * delay))
    if error is None:
        return turns
    added = [
        error.turns(u[:, None], ramp, 3) - error.turns(u[:, None] - delay[..., ramp, :, :, :], ramp, 3)
        for ramp in (0, 1)
    ]
    return turns + torch.stack(torch.broadcast_tensors(*added), -4)


def shared(positions: Tensor) -> Tensor:
    """Remove trial dimensions that only repeat the same positions.

    Args:
        positions: Positions, shape (..., target).

    Returns:
        The same positions without leading dimensions of length one or stride zero.
    """
    while positions.ndim > 1 and (positions.shape[0] == 1 or positions.stride(0) == 0):
        positions = positions[0]
    return positions


@gathered_checks()
def simulate_ladar(
    radar: TriangularLadar,
    world: LadarWorld,
    n_period: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate separated sweeps of a ladar, batched over the trials of the draws.

    >>> from torchsar import Draws, echo, radar, scene
    >>> ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> world = scene.LadarWorld(scene.Points([0.0], [0.0]), [scene.Polynomial([0.1])])
    >>> recording, truth = echo.simulate_ladar(ladar, world, n_period=4, draws=Draws(1))
    >>> recording.signal.data.shape, truth.values["velocity_m_s"].round(decimals=2)
    (torch.Size([2, 4, 128]), tensor([0.1000, 0.1000, 0.1000, 0.1000], dtype=torch.float64))

    Samples are complex whatever radar.detection is, as if an ideal stage had cut the record of the
    receiver into sweeps; `simulate_ladar_record` simulates that record itself.

    Args:
        radar: Ladar parameters.
        world: Scene, motion, propagation, laser errors and noise.
        n_period: Number of periods.
        draws: Random draws.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording, shape (..., 2, pulse, fast_time), and the truth. With a calibration fibre the
        recording has aux `calibration`, shape (..., 2, pulse or 1, fast_time), and
        `calibration_delay_s`. `clean` is the recording without motion and impairments, with the
        same noise and scintillation.

        Some true values are given once per period, shape (..., pulse). At the turning point, half a
        period after the start of the period: `velocity_m_s`, the velocity of the motion alone,
        receding positive; `range_error_m`, the displacement in metres; and `log_amplitude` if it is
        modelled. At the middles of the up-sweeps and down-sweeps: `range_error_up_m` and
        `range_error_down_m`, the displacement in metres. Where the flight time is modelled, all
        these are the values at the time of reflection, which is earlier by the reference range over
        the speed of light.

        Further true values are `azimuth_m`, `range_m` and `amplitude` of the scatterers, shape
        (..., target); `noise_std`, the standard deviation of the noise of a sample, shape (...,);
        and the values of each impairment under "<impairment>.<name>".

    Raises:
        TypeError: If radar, world or draws has the wrong type.
        ValueError: If a beat frequency exceeds half the sampling rate, the scene or the gate is
            empty, there is no period, or a parameter per trial has another length than the trials.
    """
    course = LadarCourse.of(radar, world, n_period, draws, device)
    axes = radar.sweep_axes(n_period)
    middle_s = sweep_middles(radar, axes[1], course.scatterers.range_m.device)

    def echo_of(motion: Sequence[Motion]) -> Tensor:
        return ladar_echo(course.scatterers, radar, n_period, motion, world.fidelity, world.sweep_error, dtype)

    level = torch.exp(course.log_amplitude(middle_s)).to(real_dtype(dtype))[..., None]
    values = course.truths(radar, world, middle_s)
    clean = echo_of(()) * level
    data = echo_of(course.motion) * level if course.motion else clean
    if world.snr_db is not None:
        added = noise(draws, "echo.ladar.noise", (2, n_period, axes[2].n), values["noise_std"], dtype, data.device)
        # the two dechirp signs give conjugate data
        added = added.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else added
        clean, data = clean + added, data + added
    aux = calibration_aux(radar, world, n_period, draws, dtype, device)
    return hand_over(data, clean, axes, radar, aux, values, impairments, draws)
