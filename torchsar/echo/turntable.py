"""Simulated acquisitions of turning targets: world in, recording and truth out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Signal, Truth, linear_phasor, per_trial, unit_phasor
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

Rotation = Tensor | float | PolynomialRotation

_TABLE_BYTES = 8 << 20
_SERIES_ERROR = 1e-12
_SERIES_TERMS = 12
# what the model of a dechirped pulse may leave out, rad
_DROPPED_RAD = 1e-6


def rotation_angle(radar: InverseRadar, n_pulse: int, rotation: Rotation, like: Tensor) -> Tensor:
    """theta at the middle of each pulse, (*trials, pulse) float64; zero at pulse n_pulse // 2 of an
    even rotation, given as its rate in rad/s, and at the first pulse of a PolynomialRotation.
    Raises ValueError for one that turns back within the record.
    """
    return PulseTurn.of(rotation, radar, n_pulse, like).angle_rad


@dataclass(frozen=True)
class PulseTurn:
    """How the target stands and turns at the middle of each pulse: angle (rad), rate (rad/s),
    acceleration (rad/s^2), (*trials, pulse) float64.
    """

    angle_rad: Tensor
    rate_rad_s: Tensor
    acceleration_rad_s2: Tensor

    @staticmethod
    def of(rotation: Rotation, radar: InverseRadar, n_pulse: int, like: Tensor) -> PulseTurn:
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
    """Range-compressed pulses without errors or noise, (*trials, pulse, range) of `dtype` (Ruan et
    al. 2013, Eqs. 1 and 9).

    s[k, n] = sum_m a_m h(n - y_m / dr) exp(-4j pi / lambda (x_m sin theta_k + (y_m + yc) (cos
    theta_k - 1))), x cross range, y range. h is the response of a rectangular band of n_range
    frequencies, unit peak, periodic in the window. The phase of a_m is that of the echo at theta =
    0. rotation_rad_s: a number or per-trial tensor for an even rotation, theta = 0 at pulse n_pulse
    // 2, or a PolynomialRotation, theta = 0 at the first pulse (Remote Sens. 2025, 17, 3447, Eq. 3,
    with sine and cosine unabridged). centre_deviation_m: yc, a number or per-trial tensor. Range
    frequency by range frequency the sum over scatterers is a matrix product of phasors.
    Differentiable in positions, amplitudes, rate, k and yc.
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
        way = x[..., None, :] * torch.sin(angle) - lever[..., None, :] * (2 * torch.sin(angle / 2).square())
        lines = unit_phasor(-2 / radar.wavelength_m * way, dtype) @ spectra
        # centred in both domains: sample n_range // 2 is range zero; block by block, while the
        # lines are in the cache
        parts.append(torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(lines, dim=-1)), dim=-1))
    return torch.cat(parts, -2)


@dataclass(frozen=True)
class PulseWay:
    """Range of the whole target against the reference during pulses: at their middles, its slope,
    and what is left of straight lines.

    middle_m, speed_m_s: (*trials, pulse); bend_m: (*trials, pulse, fast_time). float64.
    """

    middle_m: Tensor
    speed_m_s: Tensor
    bend_m: Tensor

    @staticmethod
    def of(
        motion: Sequence[Motion], track: Sequence[Motion], pulse_s: Tensor, fast_s: Tensor, half_s: float
    ) -> PulseWay:
        """The motion during pulses with middles at pulse_s (pulse,), half_s to either side, less
        the place of the track at the middles.
        """
        start, middle, end = (displacement_m(motion, pulse_s + shift) for shift in (-half_s, 0.0, half_s))
        speed = (end - start) / (2 * half_s)
        bend = displacement_m(motion, pulse_s[:, None] + fast_s) - middle[..., None] - speed[..., None] * fast_s
        return PulseWay(middle - displacement_m(track, pulse_s), speed, bend)


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
    """Dechirped pulses without noise, (*trials, pulse, fast_time) of `dtype`, the range evaluated
    at every sample.

    Phase of a scatterer: -2 pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2), dtau = 2 (x sin theta
    + y cos theta + d) / c at the time t' from the middle of the pulse, less the constant f0 2 y /
    c, so that amplitudes mean the same as in `turntable_echo`; d is the motion less the track's
    place at the middle. rotation_rad_s and centre_deviation_m as in `turntable_echo`; a centre at
    -yc gives x sin theta + (y + yc) cos theta - yc in place of the first two terms of dtau, and a
    rate that changes is followed inside the pulse by its value and slope at the middle. Within a
    pulse the phases of scatterers differ by lines in t' and by 1e-4 rad beyond them: lines are a
    matrix product of short tables, the rest a power series; together they are exact to 1e-6 rad, to
    1e-10 for the ladar of the paper. The receiver is ideal: a beat frequency beyond the window's,
    such as the coupling v f0 / gamma, wraps round, and `focus.compress_dechirped` takes it back.
    Differentiable, in omega, k and yc as well. Raises ValueError where target or motion turn so far
    within a pulse that more than 1e-6 rad would be missed.
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
        way = PulseWay.of(motion, track, pulse_s[pulses], fast_s, half_s)
        lines = ScattererLines.of(radar, x, y, lever, turn[pulses], way)
        total = _sum_of_lines(lines, amplitude, way.bend_m, fast_s, dtype)
        parts.append(total * unit_phasor(_common_turns(radar, way, fast_s), dtype))
    return torch.cat(parts, -2)


@dataclass(frozen=True)
class ScattererLines:
    """Turns of every scatterer in every pulse beyond what all of them share: start + slope t' +
    curve t'^2 + bend * (bend of the way).

    float64 (*trials, pulse, target), in turns, turns/s, turns/s^2, turns/m.
    """

    start: Tensor
    slope: Tensor
    curve: Tensor
    bend: Tensor

    @staticmethod
    def of(radar: InverseRadar, x: Tensor, y: Tensor, lever: Tensor, turn: PulseTurn, way: PulseWay) -> ScattererLines:
        """Rotation inside the pulse to the second order of t': range along + across (rate t' +
        acceleration t'^2 / 2) - towards (rate t')^2 / 2.

        y, lever: ranges from the middle of the window and from the centre of rotation.
        """
        x, y, lever = x[..., None, :], y[..., None, :], lever[..., None, :]
        theta, rate, acceleration = (
            turn.angle_rad[..., None],
            turn.rate_rad_s[..., None],
            turn.acceleration_rad_s2[..., None],
        )
        middle, speed = way.middle_m[..., None], way.speed_m_s[..., None]
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


def _common_turns(radar: InverseRadar, way: PulseWay, fast_s: Tensor) -> Tensor:
    """Turns that the way of the whole target gives every scatterer, (*trials, pulse, fast_time)."""
    delay = 2 / radar.wave_speed_m_s * (way.middle_m[..., None] + way.speed_m_s[..., None] * fast_s + way.bend_m)
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
    if _bends(lines.bend, bend_m):
        total = total + line_sum(weight * (2j * math.pi * lines.bend).to(dtype)) * bend_m.to(dtype)
    return total


def _bends(turns_per_m: Tensor, bend_m: Tensor) -> bool:
    """Whether the bend of the way within pulses moves scatterers apart at all.

    Raises ValueError where it does so beyond first order.
    """
    worst = 2 * math.pi * float(turns_per_m.detach().abs().max()) * float(bend_m.detach().abs().max())
    if not worst**2 / 2 <= _DROPPED_RAD:
        raise ValueError(
            f"the motion bends by {float(bend_m.detach().abs().max()):.3g} m within a pulse, "
            "which the dechirped model does not follow; shorten the pulse or slow the motion"
        )
    return worst > _SERIES_ERROR


def _line_tables(slope: Tensor, fast_s: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Factors of exp(2j pi slope t'), (..., target, m) and (..., target, blocks)."""
    n = len(fast_s)
    m = 2 ** round(math.log2(max(n, 1)) / 2)
    turns = slope * (float(fast_s[1] - fast_s[0]) if n > 1 else 0.0)
    return linear_phasor(turns, 0, m, dtype), linear_phasor(m * turns, -(n // 2) / m, -(-n // m), dtype)


def _series_terms(phase_rad: Tensor) -> int:
    """Terms of the power series of exp(j phase) beyond the first that leave less than 1e-12.

    Raises ValueError where that would be many.
    """
    worst = float(phase_rad.detach().abs().max())
    # at least one: a target at rest has the gradient of one that turns
    for order in range(1, _SERIES_TERMS + 1):
        if worst ** (order + 1) / math.factorial(order + 1) < _SERIES_ERROR:
            return order
    raise ValueError(
        f"the target turns so fast that phases bend by {worst:.3g} rad within a pulse; the "
        "dechirped model holds to 0.6 rad: shorten the pulse"
    )


@dataclass(frozen=True)
class TurnInPulse:
    """Largest angles (rad) that the target turns through in half a pulse: by its rate, by its
    acceleration, and by what comes after.
    """

    by_rate: float
    by_acceleration: float
    beyond: float

    @staticmethod
    def worst(turn: PulseTurn, rotation: Rotation, radar: InverseRadar, half_s: float) -> TurnInPulse:
        """Over all pulses and trials."""
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
    """The rotation inside a pulse is followed to the second order of time on the carrier and to the
    first on the chirp: what comes after must be nothing.
    """
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
            f"the target turns by {whole:.3g} rad in half a pulse, of which the dechirped model "
            f"drops {dropped:.3g} rad of phase; shorten the pulse or slow the rotation"
        )


def fast_time_axis(radar: InverseRadar, n_fast: int) -> Axis:
    """Fast time of a dechirped pulse (s), zero at sample n_fast // 2, the middle of the pulse."""
    step = _pulse_s(radar) / n_fast
    return Axis("fast_time", n_fast, -(n_fast // 2) * step, step, "s")


def _pulse_s(radar: InverseRadar) -> float:
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; a dechirped pulse needs its length")
    return radar.pulse_s


def _rows_of(scatterers: Scatterers) -> tuple[Tensor, ...]:
    return torch.broadcast_tensors(scatterers.azimuth_m, scatterers.range_m, scatterers.amplitude)


def _pulse_blocks(n_pulse: int, per_pulse: int) -> Iterator[slice]:
    """Blocks of pulses, whatever the number of trials: sums then round alike in batches of any
    size.
    """
    height = max(1, min(64, _TABLE_BYTES // (16 * per_pulse)))
    for first in range(0, n_pulse, height):
        yield slice(first, min(first + height, n_pulse))


@dataclass(frozen=True)
class LostPulses:
    """Whole pulses that were not received, at random places: `count` of them, or a `fraction` of
    all. Their samples are zero.

    Unlike `LostLines` they keep their place: pulses are counted by the trigger. Truth: `present`
    (..., pulse) bool.
    """

    count: int | None = None
    fraction: float | None = None

    def __post_init__(self) -> None:
        if (self.count is None) == (self.fraction is None):
            raise ValueError(
                f"lost pulses need a count or a fraction, got count={self.count}, fraction={self.fraction}"
            )
        if (self.count is not None and self.count < 0) or (self.fraction is not None and not 0 <= self.fraction < 1):
            raise ValueError(
                f"lost pulses need a count >= 0 or a fraction in 0..1, got count={self.count}, fraction={self.fraction}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        data = recording.signal.data
        n = data.shape[-2]
        count = self.count if self.count is not None else round((self.fraction or 0.0) * n)
        if count >= n:
            raise ValueError(f"{count} lost pulses leave nothing of a recording of {n} pulses; lose fewer")
        index = draws.subset("echo.pulses.lost", n, count, data.device)
        if index.shape[:-1] not in ((), data.shape[:-2]):
            raise ValueError(
                f"draws for {tuple(index.shape[:-1])} trials do not fit a recording of "
                f"{tuple(data.shape[:-2])} trials; draw one unbatched trial for a single recording"
            )
        index = index.expand(*data.shape[:-2], -1)
        present = torch.ones(data.shape[:-1], dtype=torch.bool, device=data.device).scatter(-1, index, False)
        return replace(recording, signal=recording.signal.with_data(data * present[..., None])), {"present": present}


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
    """A recording of a turning target and the truth about it, batched over the trials of `draws`.

    At fidelity PhaseOnly the recording has the axes (pulse, range), range-compressed, at Dechirped
    (pulse, fast_time), raw, and aux `reference_m` (..., pulse), how far the receiver's reference
    went. The truth holds `phase_rad` (..., pulse), psi = delta - 4 pi d / lambda with start phase
    delta and displacement d at the middle of the pulse, less the reference's; `displacement_m`
    (..., pulse), the whole of it; `noise_std` of the samples; `cross_range_m`, `range_m`,
    `amplitude` of the scatterers; `rotation_rad_s`; what each impairment says under
    "<impairment>.<name>". Where the world has a polynomial rotation: `omega_rad_s` (...,), `warp_k`
    (..., order - 1), `yc_m` (...,), and `rotation_rad_s` is its mean rate over the record. `clean`
    is the recording without motion, start phases and impairments, with the same noise. At PhaseOnly
    the unimpaired recording is clean * exp(j psi) EXACTLY, noise included: circular Gaussian noise
    is as good after a turn, and tests of equivariance are exact. Noise follows `world.snr_db`, the
    same before and after range compression. Raises ValueError for a target outside the range
    window, an empty scene, no rotation rate, one that turns back, or a dechirped pulse of unknown
    length.
    """
    course = _Course.of(radar, world, n_pulse, n_range, draws, device)
    record = _dechirped if isinstance(world.fidelity, Dechirped) else _phase_only
    clean, data, std, axes, aux = record(radar, world, course, n_range, draws, dtype)
    trials = torch.broadcast_shapes(
        data.shape[:-2], () if draws.trials is None else (len(draws.trials),)
    )  # nothing may differ between trials
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
    recording, told = apply_impairments(
        Recording(Signal(data, axes), radar, {name: v.expand(*trials, -1) for name, v in aux.items()}),
        impairments or {},
        draws,
    )
    return recording, Truth({**values, **told}, Recording(Signal(clean, axes), radar))


def _rotation_truth(
    rotation: Rotation, yc_m: Tensor | float, duration_s: float, device: torch.device, trials: torch.Size
) -> dict[str, Tensor]:
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
    """What happens to a target from pulse to pulse: (*trials, pulse) each but the scatterers and
    the rotation.
    """

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
        """Total phase error of each pulse."""
        return self.start_rad - 4 * math.pi / radar.wavelength_m * (self.moved_m - self.reference_m)


def _first_given(*choices: Rotation | None) -> Rotation | None:
    return next((choice for choice in choices if choice is not None), None)


_Made = tuple[Tensor, Tensor, Tensor, tuple[Axis, ...], dict[str, Tensor]]


def _phase_only(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_range: int, draws: Draws, dtype: torch.dtype
) -> _Made:
    """Clean and recorded samples, deviation of the noise, axes and side data at the level of
    phases.
    """
    n_pulse = course.moved_m.shape[-1]
    still = turntable_echo(course.scatterers, radar, n_pulse, n_range, course.rotation, dtype, world.centre_deviation_m)
    noise, std = _noise(still, world.snr_db, draws)
    clean = still + noise
    return clean, _turned(clean, course.psi_rad(radar)), std, radar.raw_axes(n_pulse, n_range), {}


def _dechirped(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_fast: int, draws: Draws, dtype: torch.dtype
) -> _Made:
    """The same for dechirped pulses.

    The noise is the receiver's and does not turn with the phases of the echo.
    """
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
    return pulses * unit_phasor(phase_rad / (2 * math.pi), pulses.dtype)[..., None]


def _noise(echo: Tensor, snr_db: Tensor | float | None, draws: Draws) -> tuple[Tensor | float, Tensor]:
    """Circular Gaussian noise for an echo, and its deviation (...,): mean power of all samples over
    snr_db.
    """
    if snr_db is None:
        return 0.0, torch.zeros((), dtype=torch.float64, device=echo.device)
    power = torch.view_as_real(echo.detach()).double().square().sum(-1).mean((-2, -1))
    std = torch.sqrt(power / 10 ** (per_trial(snr_db, 0, echo) / 10))
    return draws.normal("noise", tuple(echo.shape[-2:]), echo.dtype, echo.device) * std.to(echo.real.dtype)[
        ..., None, None
    ], std


def _refuse_outside(scatterers: Scatterers, off_m: Tensor, radar: InverseRadar, n_range: int) -> None:
    """off_m: (*trials, pulse), how far the target is from where the window takes it to be."""
    if not scatterers.range_m.shape[-1]:
        raise ValueError("the scene holds no scatterer; give it at least one")
    y, off = scatterers.range_m.detach(), off_m.detach()
    nearest, farthest = float((y.amin(-1) + off.amin(-1)).min()), float((y.amax(-1) + off.amax(-1)).max())
    low, high = (-(n_range // 2) - 0.5) * radar.range_step_m, (n_range - n_range // 2 - 0.5) * radar.range_step_m
    if not (low <= nearest and farthest <= high):
        raise ValueError(
            f"the target reaches from {nearest:.6g} to {farthest:.6g} m of a range window of "
            f"{low:.6g} to {high:.6g} m; "
            "choose a smaller target, more range samples, or let the reference follow it: Dechirped(track=...)"
        )
