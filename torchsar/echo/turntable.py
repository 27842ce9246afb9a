"""Simulation of inverse synthetic aperture recordings of a rotating target."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Signal, Truth, gathered_checks, linear_phasor, per_trial, unit_phasor
from torchsar.echo.lines import lost_count
from torchsar.echo.stripmap import Impairment, apply_impairments
from torchsar.radar import InverseRadar
from torchsar.scene import (
    Dechirped,
    Motion,
    PolynomialRotation,
    Scatterers,
    TurntableWorld,
    displacement_m,
    start_phase_rad,
)
from torchsar.scene.trials import refuse_other_trials, refuse_unless

Rotation = Tensor | float | PolynomialRotation

# phase tables of a block of pulses, about the cache of a processor
_TABLE_BYTES = 8 << 20
# largest error of the power series of phases within a pulse, by choice, and its longest length: the
# series then holds to 0.6 rad
_SERIES_ERROR = 1e-12
_SERIES_TERMS = 12
# phase in radians that the model of a dechirped pulse may neglect, by choice
_DROPPED_RAD = 1e-6


def rotation_angle(radar: InverseRadar, n_pulse: int, rotation: Rotation, like: Tensor) -> Tensor:
    """Return the rotation angle at the middle of each pulse.

    Args:
        radar: Radar parameters.
        n_pulse: Number of pulses.
        rotation: Rate in rad/s of a uniform rotation, a number or one value per trial, with the
            angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the angle zero at the
            first pulse.
        like: Tensor that gives the device.

    Returns:
        Angle in radians, shape (*trials, pulse), float64.

    Raises:
        ValueError: If the rate of a PolynomialRotation falls to zero within the record.
    """
    return PulseTurn.of(rotation, radar, n_pulse, like).angle_rad


@dataclass(frozen=True)
class PulseTurn:
    """Angle, rotation rate and angular acceleration of the target at the middle of each pulse.

    Args:
        angle_rad: Angle in radians, shape (*trials, pulse), float64.
        rate_rad_s: Rotation rate in rad/s, same shape.
        acceleration_rad_s2: Angular acceleration in rad/s^2, same shape.
    """

    angle_rad: Tensor
    rate_rad_s: Tensor
    acceleration_rad_s2: Tensor

    @staticmethod
    def of(rotation: Rotation, radar: InverseRadar, n_pulse: int, like: Tensor) -> PulseTurn:
        """Return angle, rate and acceleration of a rotation at the middle of each pulse.

        Args:
            rotation: Rate in rad/s of a uniform rotation, with the angle zero at pulse
                n_pulse // 2; or a PolynomialRotation, with the angle zero at the first pulse.
            radar: Radar parameters.
            n_pulse: Number of pulses.
            like: Tensor that gives the device.

        Returns:
            Angle, rate and acceleration of each pulse.

        Raises:
            ValueError: If the rate of a PolynomialRotation falls to zero within the record.
        """
        pulse = torch.arange(n_pulse, dtype=torch.float64, device=like.device)
        if isinstance(rotation, PolynomialRotation):
            rotation.refuse_turning_back(n_pulse / radar.prf_hz)
            time_s = pulse / radar.prf_hz
            return PulseTurn(rotation.angle(time_s), rotation.rate(time_s), rotation.acceleration(time_s))
        rate = per_trial(rotation, 1, like)
        angle = rate * ((pulse - n_pulse // 2) / radar.prf_hz)
        return PulseTurn(angle, rate.expand_as(angle), torch.zeros_like(angle))

    def __getitem__(self, pulses: slice) -> PulseTurn:
        return PulseTurn(
            self.angle_rad[..., pulses], self.rate_rad_s[..., pulses], self.acceleration_rad_s2[..., pulses]
        )


def turntable_echo(
    scatterers: Scatterers,
    radar: InverseRadar,
    n_pulse: int,
    n_range: int,
    rotation_rad_s: Rotation,
    dtype: torch.dtype = torch.complex64,
    centre_deviation_m: Tensor | float = 0.0,
) -> Tensor:
    """Return range-compressed pulses of a rotating target without range migration and noise.

    In pulse i and at sample n from the middle of the range window,

        s[i, n] = sum_m a_m h(n - y_m / dr)
            exp(-4j pi / lambda (x_m sin theta_i + (y_m + yc) (cos theta_i - 1))),

    with the cross range x_m, range y_m and amplitude a_m of scatterer m, the range step dr and the
    rotation angle theta_i. h is the response of a rectangular band of n_range frequencies, with
    unit peak and periodic in the window. The phase of a_m is that of the echo at theta = 0. For
    each range frequency the sum over scatterers is a matrix product of phasors. Differentiable in
    positions, amplitudes, yc and the parameters of the rotation.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        rotation_rad_s: Rotation rate in rad/s of a uniform rotation, a number or one value per
            trial, with the angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the
            angle zero at the first pulse.
        dtype: Complex dtype of the result.
        centre_deviation_m: Distance yc in metres, a number or one value per trial: the centre of
            rotation lies at the range -yc from the middle of the range window.

    Returns:
        Pulses, shape (*trials, pulse, range).

    Raises:
        ValueError: If the rate of a PolynomialRotation falls to zero within the record.

    Reference:
        Ruan et al. 2013, Eqs. (1), (9); Remote Sens. 2025, 17, 3447, Eq. (3), with exact sine and
        cosine.
    """
    x, y, amplitude = _rows_of(scatterers)
    lever = y + per_trial(centre_deviation_m, 1, y)
    theta = rotation_angle(radar, n_pulse, rotation_rad_s, x)
    spectra = (
        linear_phasor(-y / (n_range * radar.range_step_m), -(n_range // 2), n_range, dtype)
        * amplitude.to(dtype)[..., None]
    )
    parts = []
    for pulses in _pulse_blocks(n_pulse, x.shape[-1]):
        angle = theta[..., pulses, None]
        path = x[..., None, :] * torch.sin(angle) - lever[..., None, :] * (2 * torch.sin(angle / 2).square())
        lines = unit_phasor(-2 / radar.wavelength_m * path, dtype) @ spectra
        # centred in both domains: sample n_range // 2 is range zero; in blocks, while the lines are
        # in the cache
        parts.append(torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(lines, dim=-1)), dim=-1))
    return torch.cat(parts, -2)


@dataclass(frozen=True)
class PulseRange:
    """Range of the whole target during each pulse, relative to the reference of the receiver.

    Within a pulse the range is a straight line in fast time plus a deviation from that line.

    Args:
        middle_m: Range at the middle of each pulse in metres, shape (*trials, pulse), float64.
        speed_m_s: Slope of the straight line in m/s, receding positive, same shape.
        bend_m: Deviation from the straight line in metres, shape (*trials, pulse, fast_time).
    """

    middle_m: Tensor
    speed_m_s: Tensor
    bend_m: Tensor

    @staticmethod
    def of(
        motion: Sequence[Motion], track: Sequence[Motion], pulse_s: Tensor, fast_s: Tensor, half_s: float
    ) -> PulseRange:
        """Compute the range of the target during each pulse.

        Args:
            motion: Motions of the target along the line of sight.
            track: Motions that the reference of the receiver follows from pulse to pulse.
            pulse_s: Times of the pulse middles in seconds, shape (pulse,), float64.
            fast_s: Fast time from the middle of a pulse in seconds, shape (fast_time,), float64.
            half_s: Half the pulse length in seconds.

        Returns:
            The range of the target. `middle_m` is motion minus track; `speed_m_s` and `bend_m`
            follow from the motion alone, since the reference is fixed within a pulse.
        """
        start, middle, end = (displacement_m(motion, pulse_s + shift) for shift in (-half_s, 0.0, half_s))
        speed = (end - start) / (2 * half_s)
        bend = displacement_m(motion, pulse_s[:, None] + fast_s) - middle[..., None] - speed[..., None] * fast_s
        return PulseRange(middle - displacement_m(track, pulse_s), speed, bend)


def dechirped_echo(
    scatterers: Scatterers,
    radar: InverseRadar,
    n_pulse: int,
    n_fast: int,
    rotation_rad_s: Rotation,
    motion: Sequence[Motion] = (),
    track: Sequence[Motion] = (),
    dtype: torch.dtype = torch.complex64,
    centre_deviation_m: Tensor | float = 0.0,
) -> Tensor:
    """Return dechirped pulses with the range evaluated at every sample, without noise.

    At the time t' from the middle of a pulse, the phase of a scatterer is

        -2 pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2),

    with the carrier f0, the chirp rate gamma and the delay dtau relative to the reference of the
    receiver. For a scatterer at the cross range x and the range y,

        dtau = 2 / c (x sin theta + (y + yc) cos theta - yc + d),

    with the rotation angle theta about a centre at the range -yc. d is the motion at the time of
    the sample minus the track at the middle of the pulse. The constant carrier phase of the range y
    is left out, so that the phase of an amplitude is that of the echo at theta = 0. Within a pulse
    the rotation rate is taken as linear in time.

    The result is exact to 1e-6 rad, and to 1e-10 rad for the ladar of Ruan et al. 2013. The
    receiver is ideal: a beat frequency outside the range window wraps around. A radial speed v, for
    example, shifts the echo by v f0 / gamma in range. `focus.compress_dechirped`, given v, corrects
    this shift, also where it wraps. Differentiable in positions, amplitudes, yc and the parameters
    of the rotation.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Radar, with a pulse length.
        n_pulse: Number of pulses.
        n_fast: Number of samples of a pulse.
        rotation_rad_s: Rotation rate in rad/s of a uniform rotation, a number or one value per
            trial, with the angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the
            angle zero at the first pulse.
        motion: Motions of the target along the line of sight.
        track: Motions that the reference of the receiver follows from pulse to pulse.
        dtype: Complex dtype of the result.
        centre_deviation_m: Distance yc in metres, a number or one value per trial: the centre of
            rotation lies at the range -yc from the middle of the range window.

    Returns:
        Pulses, shape (*trials, pulse, fast_time).

    Raises:
        ValueError: If rotation or motion within a pulse is so fast that the model would neglect a
            phase above 1e-6 rad, the pulse length is not known, or the rate of a PolynomialRotation
            falls to zero within the record.
    """
    x, y, amplitude = _rows_of(scatterers)
    lever = y + per_trial(centre_deviation_m, 1, y)
    turn = PulseTurn.of(rotation_rad_s, radar, n_pulse, x)
    fast_s = fast_time_axis(radar, n_fast).values(x.device)
    half_s = _pulse_s(radar) / 2
    _refuse_fast_turns(
        radar,
        float((x.detach().square() + lever.detach().square()).max().sqrt()),
        TurnInPulse.worst(turn, rotation_rad_s, radar, half_s),
        half_s,
    )
    pulse_s = torch.arange(n_pulse, dtype=torch.float64, device=x.device) / radar.prf_hz
    parts = []
    for pulses in _pulse_blocks(n_pulse, x.shape[-1] * 2 * math.isqrt(n_fast)):
        path = PulseRange.of(motion, track, pulse_s[pulses], fast_s, half_s)
        lines = ScattererLines.of(radar, x, y, lever, turn[pulses], path)
        total = _sum_of_lines(lines, amplitude, path.bend_m, fast_s, dtype)
        parts.append(total * unit_phasor(_common_turns(radar, path, fast_s), dtype))
    return torch.cat(parts, -2)


@dataclass(frozen=True)
class ScattererLines:
    """Phase of every scatterer in every dechirped pulse, without the part common to all of them.

    At the time t' from the middle of the pulse the phase in cycles is
    start + slope t' + curve t'^2 + bend r(t'), where r is the deviation of the motion of the whole
    target from a straight line within the pulse.

    Args:
        start: Phase at the middle of the pulse in cycles, shape (*trials, pulse, target), float64.
        slope: Frequency in hertz, same shape.
        curve: Quadratic coefficient in cycles per square second, same shape.
        bend: Cycles per metre of the deviation r, same shape.
    """

    start: Tensor
    slope: Tensor
    curve: Tensor
    bend: Tensor

    @staticmethod
    def of(
        radar: InverseRadar, x: Tensor, y: Tensor, lever: Tensor, turn: PulseTurn, path: PulseRange
    ) -> ScattererLines:
        """Form the phases from the range of each scatterer to second order in fast time.

        At the time t' from the middle of a pulse, the rotation moves a scatterer to the range

            r + (x cos theta - y' sin theta) (rate t' + acceleration t'^2 / 2)
              - (x sin theta + y' cos theta) (rate t')^2 / 2.

        r is its range at the middle of the pulse, x its cross range and y' its range from the
        centre of rotation. theta, rate and acceleration are the rotation angle and its derivatives
        at the middle of the pulse.

        Args:
            radar: Radar parameters.
            x: Cross ranges in metres, shape (..., target), float64.
            y: Ranges from the middle of the window in metres, same shape.
            lever: Ranges from the centre of rotation in metres, same shape.
            turn: Rotation of each pulse.
            path: Range of the target during each pulse.

        Returns:
            Phases of all scatterers.
        """
        x, y, lever = x[..., None, :], y[..., None, :], lever[..., None, :]
        theta, rate, acceleration = (
            turn.angle_rad[..., None],
            turn.rate_rad_s[..., None],
            turn.acceleration_rad_s2[..., None],
        )
        middle, speed = path.middle_m[..., None], path.speed_m_s[..., None]
        sin, drop = torch.sin(theta), 2 * torch.sin(theta / 2).square()
        change = x * sin - lever * drop
        along, towards, across = change + y, change + lever, x - x * drop - lever * sin
        turning = rate * across
        per_m = 2 / radar.wave_speed_m_s
        chirp, video = per_m * radar.chirp_rate_hz_s, 0.5 * per_m**2 * radar.chirp_rate_hz_s
        carrier = per_m * radar.carrier_hz
        start = -carrier * change + video * along * (along + 2 * middle)
        slope = -carrier * turning - chirp * along + 2 * video * (turning * (along + middle) + along * speed)
        curve = (
            carrier * towards * rate.square() / 2
            - chirp * turning
            + video * turning * (turning + 2 * speed)
            - carrier * across * acceleration / 2
        )
        return ScattererLines(start, slope, curve, 2 * video * along)


def _common_turns(radar: InverseRadar, path: PulseRange, fast_s: Tensor) -> Tensor:
    """Cycles by the motion of the whole target, (*trials, pulse, fast_time)."""
    delay = 2 / radar.wave_speed_m_s * (path.middle_m[..., None] + path.speed_m_s[..., None] * fast_s + path.bend_m)
    return -delay * (radar.carrier_hz + radar.chirp_rate_hz_s * (fast_s - delay / 2))


def _sum_of_lines(
    lines: ScattererLines, amplitude: Tensor, bend_m: Tensor, fast_s: Tensor, dtype: torch.dtype
) -> Tensor:
    """Sum over targets of amplitude * exp(2j pi turns), (*trials, pulse, fast_time)."""
    edge_s = float(fast_s.abs().max())
    curve = 2 * math.pi * lines.curve * edge_s**2
    weight = unit_phasor(lines.start, dtype) * amplitude[..., None, :].to(dtype)
    fine, coarse = _line_tables(lines.slope, fast_s, dtype)
    u2 = (fast_s / edge_s).square() if edge_s else torch.zeros_like(fast_s)

    def line_sum(factor: Tensor) -> Tensor:
        return ((coarse * factor[..., None]).mT @ fine).flatten(-2)[..., : len(fast_s)]

    total = line_sum(weight)
    for order in range(1, _series_terms(curve) + 1):
        term = curve.pow(order) / math.factorial(order)
        total = total + line_sum(weight * (term * 1j**order).to(dtype)) * u2.pow(order).to(dtype)
    if _needs_bend(lines.bend, bend_m):
        total = total + line_sum(weight * (2j * math.pi * lines.bend).to(dtype)) * bend_m.to(dtype)
    return total


def _needs_bend(turns_per_m: Tensor, bend_m: Tensor) -> bool:
    """Whether the residual range of the motion changes phases between scatterers."""
    worst = 2 * math.pi * float(turns_per_m.detach().abs().max()) * float(bend_m.detach().abs().max())
    if not worst**2 / 2 <= _DROPPED_RAD:
        raise ValueError(
            f"the motion departs by {float(bend_m.detach().abs().max()):.3g} m from a straight line within a "
            "pulse, more than the dechirped model can represent; shorten the pulse or slow the motion"
        )
    return worst > _SERIES_ERROR


def _line_tables(slope: Tensor, fast_s: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Factors of exp(2j pi slope t'), (..., target, m) and (..., target, blocks)."""
    n = len(fast_s)
    m = 2 ** round(math.log2(max(n, 1)) / 2)
    turns = slope * (float(fast_s[1] - fast_s[0]) if n > 1 else 0.0)
    return linear_phasor(turns, 0, m, dtype), linear_phasor(m * turns, -(n // 2) / m, -(-n // m), dtype)


def _series_terms(phase_rad: Tensor) -> int:
    """Number of terms beyond the first of the power series of exp(j phase)."""
    worst = float(phase_rad.detach().abs().max())
    # at least one term, so that gradients are right for a target at rest, too
    for order in range(1, _SERIES_TERMS + 1):
        if worst ** (order + 1) / math.factorial(order + 1) < _SERIES_ERROR:
            return order
    raise ValueError(
        f"the rotation causes a quadratic phase of {worst:.3g} rad within a pulse, and the dechirped model is "
        "valid up to 0.6 rad; shorten the pulse"
    )


@dataclass(frozen=True)
class TurnInPulse:
    """Largest angles by which the target turns in half a pulse, split by their order in time.

    Args:
        by_rate: Angle due to the rotation rate in radians.
        by_acceleration: Angle due to the angular acceleration in radians.
        beyond: Angle due to all higher orders in radians.
    """

    by_rate: float
    by_acceleration: float
    beyond: float

    @staticmethod
    def worst(turn: PulseTurn, rotation: Rotation, radar: InverseRadar, half_s: float) -> TurnInPulse:
        """Return the largest angles by which the target turns in half a pulse.

        Args:
            turn: Angle, rate and acceleration at the middle of each pulse.
            rotation: Rate in rad/s of a uniform rotation, or a PolynomialRotation.
            radar: Radar parameters.
            half_s: Half the pulse length in seconds.

        Returns:
            The largest angles of all pulses and trials.
        """
        by_rate, by_acceleration = (
            float(turn.rate_rad_s.detach().abs().max()) * half_s,
            float(turn.acceleration_rad_s2.detach().abs().max()) * half_s**2 / 2,
        )
        if not isinstance(rotation, PolynomialRotation):
            return TurnInPulse(by_rate, by_acceleration, 0.0)
        middle_s = (
            torch.arange(turn.angle_rad.shape[-1], dtype=torch.float64, device=turn.angle_rad.device) / radar.prf_hz
        )
        beyond = [
            rotation.angle(middle_s + s) - turn.angle_rad - turn.rate_rad_s * s - turn.acceleration_rad_s2 * s**2 / 2
            for s in (-half_s, half_s)
        ]
        return TurnInPulse(by_rate, by_acceleration, float(torch.stack(beyond).detach().abs().max()))


def _refuse_fast_turns(radar: InverseRadar, radius_m: float, turn: TurnInPulse, half_s: float) -> None:
    """Raise ValueError if the orders of rotation that are dropped matter."""
    whole = turn.by_rate + turn.by_acceleration + turn.beyond
    squares = (whole**2 - turn.by_rate**2) / 2
    on_carrier = whole**3 / 6 + squares + turn.beyond
    on_chirp = whole**2 / 2 + turn.by_acceleration + turn.beyond
    dropped = (
        4
        * math.pi
        / radar.wave_speed_m_s
        * radius_m
        * (radar.carrier_hz * on_carrier + radar.chirp_rate_hz_s * half_s * on_chirp)
    )
    if not dropped <= _DROPPED_RAD:
        raise ValueError(
            f"the target turns by {whole:.3g} rad in half a pulse, for which the dechirped model neglects a phase of "
            f"{dropped:.3g} rad, more than {_DROPPED_RAD:g} rad; shorten the pulse or slow the rotation"
        )


def fast_time_axis(radar: InverseRadar, n_fast: int) -> Axis:
    """Return the fast-time axis of a dechirped pulse.

    Args:
        radar: Radar, with a pulse length.
        n_fast: Number of samples of a pulse.

    Returns:
        Axis in seconds, zero at sample n_fast // 2, the middle of the pulse.

    Raises:
        ValueError: If the pulse length is not known.
    """
    step = _pulse_s(radar) / n_fast
    return Axis("fast_time", n_fast, -(n_fast // 2) * step, step, "s")


def _pulse_s(radar: InverseRadar) -> float:
    """Pulse length in seconds."""
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; give the pulse length (s), which dechirped pulses need")
    return radar.pulse_s


def _rows_of(scatterers: Scatterers) -> tuple[Tensor, ...]:
    """Cross range, range and amplitude of one shape."""
    return torch.broadcast_tensors(scatterers.azimuth_m, scatterers.range_m, scatterers.amplitude)


def _pulse_blocks(n_pulse: int, per_pulse: int) -> Iterator[slice]:
    """Blocks of pulses, independent of the number of trials, so that sums round equally."""
    height = max(1, min(64, _TABLE_BYTES // (16 * per_pulse)))
    for first in range(0, n_pulse, height):
        yield slice(first, min(first + height, n_pulse))


@dataclass(frozen=True)
class LostPulses:
    """Impairment: whole pulses at random positions that were not received; their samples are zero.

    All other pulses keep their positions, as where a trigger counts the pulses. (`LostLines` is the
    impairment in which later lines move up instead.) The true value `present`, shape (..., pulse),
    bool, is true for the pulses that were received.

    Args:
        count: Number of lost pulses, fixed for all trials; None if a fraction is given.
        fraction: Fraction of all pulses, at least 0 and below 1; None if a count is given.

    Raises:
        ValueError: Unless exactly one of count and fraction is given, and within its range. When
            applied, if no pulse would be left or the trials of draws and recording differ.
    """

    count: int | None = None
    fraction: Tensor | float | None = None

    def __post_init__(self) -> None:
        if (self.count is None) == (self.fraction is None):
            raise ValueError(
                "lost pulses need a count or a fraction, and not both, got "
                f"count={self.count}, fraction={self.fraction}"
            )
        if self.count is not None and self.count < 0:
            raise ValueError(f"count of lost pulses must be 0 or more, got {self.count}")
        if self.fraction is not None:
            sentence = "fraction of lost pulses must be at least 0 and below 1"
            refuse_unless(sentence, self.fraction, lambda x: (x >= 0) & (x < 1))

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data = recording.signal.data
        n = data.shape[-2]
        count = lost_count(self.count, self.fraction, n, data)
        if bool((count >= n).any()):
            raise ValueError(f"{int(count.max())} lost pulses leave nothing of a recording of {n} pulses; lose fewer")
        order = draws.permutation("echo.pulses.lost", n, data.device)
        if order.shape[:-1] not in ((), data.shape[:-2]):
            raise ValueError(
                f"draws must have the trials of the recording, of shape {tuple(data.shape[:-2])}, got trials of shape "
                f"{tuple(order.shape[:-1])}; use draws without trials for a single recording"
            )
        kept = (torch.arange(n, device=data.device) >= count[..., None]).expand(data.shape[:-1])
        present = torch.zeros_like(kept).scatter(-1, order.expand(kept.shape), kept)
        return replace(recording, signal=recording.signal.with_data(data * present[..., None])), {"present": present}


@gathered_checks()
def simulate_turntable(
    radar: InverseRadar,
    world: TurntableWorld,
    n_pulse: int,
    n_range: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate recordings of a rotating target, one per trial of `draws`.

    `world.fidelity` is the model of the echo. With `PhaseOnly`, the recording before impairments is
    EXACTLY the clean recording, noise included, with each pulse multiplied by exp(j psi), where psi
    is the phase error of the pulse. Circular Gaussian noise keeps its distribution under this
    factor. With `Dechirped`, the noise is added to the echo after its phase errors. The
    signal-to-noise ratio `world.snr_db` is the same before and after range compression.

    Args:
        radar: Radar parameters.
        world: Scene, rotation, motion, start phases, model of the echo and signal-to-noise ratio.
        n_pulse: Number of pulses.
        n_range: Number of range samples, or of samples of a dechirped pulse.
        draws: Random draws.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording and the truth. With `PhaseOnly` the recording is range-compressed, shape (...,
        pulse, range). With `Dechirped` it is raw, shape (..., pulse, fast_time), and its side data
        `aux` hold `reference_m`, the displacement of the reference, shape (..., pulse).

        The values of the truth are:

        - `phase_rad`, shape (..., pulse): the phase error psi = delta - 4 pi d / lambda, with the
          start phase delta and the displacement d relative to the reference at the middle of the
          pulse;
        - `displacement_m`, shape (..., pulse): the whole displacement of the target;
        - `noise_std`, shape (...,) or (): the standard deviation of the complex noise of a sample;
        - `cross_range_m`, `range_m` and `amplitude` of the scatterers, shape (..., target);
        - `rotation_rad_s`, shape (...,) or (): the rate of a uniform rotation, or the mean rate of
          a polynomial rotation over the record;
        - with a polynomial rotation only: its rate `omega_rad_s` at the first pulse and the centre
          deviation `yc_m`, shape (...,); its coefficients `warp_k`, shape (..., order - 1);
        - the true values of each impairment, as "<impairment>.<name>".

        The recording `clean` of the truth has the same noise, but no motion, start phases or
        impairments.

    Raises:
        ValueError: If the target leaves the range window, the scene is empty, there is no rotation
            rate, the rate falls to zero, the length of a dechirped pulse is not known, or a
            parameter given per trial has another length than the number of trials.
    """
    refuse_other_trials(world, draws)
    course = _Course.of(radar, world, n_pulse, n_range, draws, device)
    record = _dechirped if isinstance(world.fidelity, Dechirped) else _phase_only
    clean, data, std, axes, aux = record(radar, world, course, n_range, draws, dtype)
    trials = np.broadcast_shapes(
        data.shape[:-2], () if draws.trials is None else (len(draws.trials),)
    )  # without random numbers the data have no trials yet
    clean, data, psi, moved = (
        v.expand(*trials, *v.shape[v.ndim - tail :])
        for v, tail in ((clean, 2), (data, 2), (course.psi_rad(radar), 1), (course.moved_m, 1))
    )
    values = {
        "phase_rad": psi,
        "displacement_m": moved,
        "noise_std": std,
        "cross_range_m": course.scatterers.azimuth_m,
        "range_m": course.scatterers.range_m,
        "amplitude": course.scatterers.amplitude,
        **_rotation_truth(course.rotation, world.centre_deviation_m, n_pulse / radar.prf_hz, data.device, trials),
    }
    recording, impairment_truth = apply_impairments(
        Recording(Signal(data, axes), radar, {name: v.expand(*trials, -1) for name, v in aux.items()}),
        impairments or {},
        draws,
    )
    return recording, Truth({**values, **impairment_truth}, Recording(Signal(clean, axes), radar))


def _rotation_truth(
    rotation: Rotation, yc_m: Tensor | float, duration_s: float, device: torch.device, trials: tuple[int, ...]
) -> dict[str, Tensor]:
    """True values of the rotation by name."""
    if not isinstance(rotation, PolynomialRotation):
        return {"rotation_rad_s": torch.as_tensor(rotation, dtype=torch.float64)}
    like = torch.zeros((), dtype=torch.float64, device=device)
    k = rotation.warp_k(like)
    scalars = {
        "rotation_rad_s": rotation.mean_rate(duration_s, like),
        "omega_rad_s": rotation.omega(like),
        "yc_m": per_trial(yc_m, 0, like),
    }
    return {**{name: value.expand(trials) for name, value in scalars.items()}, "warp_k": k.expand(*trials, k.shape[-1])}


@dataclass(frozen=True)
class _Course:
    """Scatterers, rotation, displacements and start phases of a simulation."""

    scatterers: Scatterers
    rotation: Rotation
    moved_m: Tensor
    reference_m: Tensor
    start_rad: Tensor

    @staticmethod
    def of(
        radar: InverseRadar,
        world: TurntableWorld,
        n_pulse: int,
        n_range: int,
        draws: Draws,
        device: torch.device | str | None,
    ) -> _Course:
        """Draw the target and its motion; raises ValueError for impossible ones."""
        rotation = _first_given(world.rotation, world.rotation_rad_s, radar.rotation_rad_s)
        if rotation is None:
            raise ValueError(
                "neither radar.rotation_rad_s nor world.rotation_rad_s is set; the world needs a "
                "rotation rate, 0 for none"
            )
        if n_pulse < 1 or n_range < 1:
            raise ValueError(
                f"a recording needs at least one pulse of one sample, got n_pulse={n_pulse}, n_range={n_range}"
            )
        drawn = world.scene.scatterers(draws)
        scatterers = Scatterers(*(v.to(device) for v in (drawn.azimuth_m, drawn.range_m, drawn.amplitude)))
        time_s = torch.arange(n_pulse, dtype=torch.float64, device=device) / radar.prf_hz
        moved = displacement_m(world.motion, time_s)
        followed = (
            displacement_m(world.fidelity.track, time_s)
            if isinstance(world.fidelity, Dechirped)
            else torch.zeros_like(time_s)
        )
        _refuse_outside(
            scatterers, moved - followed if isinstance(world.fidelity, Dechirped) else followed, radar, n_range
        )
        return _Course(
            scatterers, rotation, moved, followed, start_phase_rad(world.start_phase, draws, n_pulse).to(device)
        )

    def psi_rad(self, radar: InverseRadar) -> Tensor:
        """Total phase error of each pulse, (*trials, pulse)."""
        return self.start_rad - 4 * math.pi / radar.wavelength_m * (self.moved_m - self.reference_m)


def _first_given(*choices: Rotation | None) -> Rotation | None:
    """The first choice that is not None."""
    return next((choice for choice in choices if choice is not None), None)


_Simulated = tuple[Tensor, Tensor, Tensor, tuple[Axis, ...], dict[str, Tensor]]


def _phase_only(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_range: int, draws: Draws, dtype: torch.dtype
) -> _Simulated:
    """Clean and recorded samples, noise standard deviation, axes and side data with `PhaseOnly`."""
    n_pulse = course.moved_m.shape[-1]
    still = turntable_echo(course.scatterers, radar, n_pulse, n_range, course.rotation, dtype, world.centre_deviation_m)
    noise, std = _noise(still, world.snr_db, draws)
    clean = still + noise
    return clean, _turned(clean, course.psi_rad(radar)), std, radar.raw_axes(n_pulse, n_range), {}


def _dechirped(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_fast: int, draws: Draws, dtype: torch.dtype
) -> _Simulated:
    """The same with `Dechirped`, where the noise of the receiver has no phase error."""
    n_pulse, track = course.moved_m.shape[-1], world.fidelity.track if isinstance(world.fidelity, Dechirped) else ()
    turned = partial(
        dechirped_echo,
        course.scatterers,
        radar,
        n_pulse,
        n_fast,
        course.rotation,
        dtype=dtype,
        centre_deviation_m=world.centre_deviation_m,
    )
    still = turned()
    moving = turned(world.motion, track) if world.motion or track else still
    noise, std = _noise(still, world.snr_db, draws)
    axes = (radar.raw_axes(n_pulse, n_fast)[0], fast_time_axis(radar, n_fast))
    return still + noise, _turned(moving, course.start_rad) + noise, std, axes, {"reference_m": course.reference_m}


def _turned(pulses: Tensor, phase_rad: Tensor) -> Tensor:
    """Pulses multiplied by exp(j phase)."""
    return pulses * unit_phasor(phase_rad / (2 * math.pi), pulses.dtype)[..., None]


def _noise(echo: Tensor, snr_db: Tensor | float | None, draws: Draws) -> tuple[Tensor | float, Tensor]:
    """Circular Gaussian noise of an echo, and its standard deviation (...,)."""
    if snr_db is None:
        return 0.0, torch.zeros((), dtype=torch.float64, device=echo.device)
    power = torch.view_as_real(echo.detach()).double().square().sum(-1).mean((-2, -1))
    std = torch.sqrt(power / 10 ** (per_trial(snr_db, 0, echo) / 10))
    return draws.normal("noise", tuple(echo.shape[-2:]), echo.dtype, echo.device) * std.to(echo.real.dtype)[
        ..., None, None
    ], std


def _refuse_outside(scatterers: Scatterers, off_m: Tensor, radar: InverseRadar, n_range: int) -> None:
    """Raise ValueError if the target leaves the range window; off_m: (*trials, pulse)."""
    if not scatterers.range_m.shape[-1]:
        raise ValueError("the scene holds no scatterer; give it at least one")
    y, off = scatterers.range_m.detach(), off_m.detach()
    nearest, farthest = float((y.amin(-1) + off.amin(-1)).min()), float((y.amax(-1) + off.amax(-1)).max())
    low, high = (-(n_range // 2) - 0.5) * radar.range_step_m, (n_range - n_range // 2 - 0.5) * radar.range_step_m
    if not (low <= nearest and farthest <= high):
        raise ValueError(
            f"the target must stay within the range window of {low:.6g} to {high:.6g} m, but reaches from "
            f"{nearest:.6g} to {farthest:.6g} m; choose a smaller target or more range samples, or let the window "
            "follow the target by the track of Dechirped (in a config, track_m of the fidelity dechirped)"
        )
