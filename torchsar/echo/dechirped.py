"""Echo of dechirped pulses of a rotating target, with its motion within each pulse."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsar.core import Axis, per_trial, unit_phasor
from torchsar.echo.sums import LineSum, blocks
from torchsar.radar import InverseRadar
from torchsar.scene import Motion, PolynomialRotation, Scatterers
from torchsar.scene.motion import displacement_m
from torchsar.scene.turntable import Rotation, pulse_length_s, rotation_angle

# phase in radians that the model of a dechirped pulse may neglect, by choice
_DROPPED_RAD = 1e-6


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

    >>> import torch
    >>> from torchsar import core, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, pulse_s=1e-4)
    >>> range_m = torch.tensor([3 * isar.range_step_m], dtype=torch.float64)
    >>> point = scene.Scatterers(0 * range_m, range_m, torch.ones(1, dtype=torch.complex128))
    >>> core.centred_ifft(echo.dechirped_echo(point, isar, 4, 16, 0.1)).abs().argmax(-1)
    tensor([11, 11, 11, 11])

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
    x, y, amplitude = torch.broadcast_tensors(*scatterers.tensors)
    lever = y + per_trial(centre_deviation_m, 1, y)
    turn = _turn(rotation_rad_s, radar, n_pulse, x)
    fast_s = fast_time_axis(radar, n_fast).values(x.device)
    half_s = pulse_length_s(radar) / 2
    radius_m = float((x.detach().square() + lever.detach().square()).max().sqrt())
    _refuse_fast_turns(radar, radius_m, turn, rotation_rad_s, half_s)
    pulse_s = torch.arange(n_pulse, dtype=torch.float64, device=x.device) / radar.prf_hz
    parts = []
    for pulses in blocks(n_pulse, 16 * x.shape[-1] * 2 * math.isqrt(n_fast), most=64):
        path = _pulse_range(motion, track, pulse_s[pulses], fast_s, half_s)
        lines = _scatterer_lines(radar, x, y, lever, [v[..., pulses, None] for v in turn], path)
        total = _sum_of_lines(lines, amplitude, path[2], fast_s, dtype)
        parts.append(total * unit_phasor(_common_turns(radar, path, fast_s), dtype))
    return torch.cat(parts, -2)


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
    step = pulse_length_s(radar) / n_fast
    return Axis("fast_time", n_fast, -(n_fast // 2) * step, step, "s")


def _turn(rotation: Rotation, radar: InverseRadar, n_pulse: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angle, rotation rate and angular acceleration at the middles of pulses, (*trials, pulse)."""
    angle = rotation_angle(radar, n_pulse, rotation, like)
    if isinstance(rotation, PolynomialRotation):
        time_s = torch.arange(n_pulse, dtype=torch.float64, device=like.device) / radar.prf_hz
        return angle, rotation.rate(time_s), rotation.acceleration(time_s)
    return angle, per_trial(rotation, 1, like).expand_as(angle), torch.zeros_like(angle)


def _pulse_range(
    motion: Sequence[Motion], track: Sequence[Motion], pulse_s: Tensor, fast_s: Tensor, half_s: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Motion of the whole target in each pulse.

    Returns its range at the middle of the pulse relative to the reference of the receiver, and the
    slope of its chord (m/s), (*trials, pulse) each. Also returns its deviation from this straight
    line in metres, (*trials, pulse, fast_time). The reference is fixed within a pulse.
    """
    start, middle, end = (displacement_m(motion, pulse_s + shift) for shift in (-half_s, 0.0, half_s))
    speed = (end - start) / (2 * half_s)
    bend = displacement_m(motion, pulse_s[:, None] + fast_s) - middle[..., None] - speed[..., None] * fast_s
    return middle - displacement_m(track, pulse_s), speed, bend


def _scatterer_lines(
    radar: InverseRadar,
    x: Tensor,
    y: Tensor,
    lever: Tensor,
    turn: Sequence[Tensor],
    path: tuple[Tensor, Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Phase of every scatterer in every pulse, without the part common to all scatterers.

    Returns its start (cycles), its slope (Hz), and its curvature (cycles/s^2), (*trials, pulse,
    target) each. The fourth result has the unit cycles per metre: it multiplies the deviation of
    the motion of the whole target from a straight line.

    At the time t' from the middle of a pulse, the rotation moves a scatterer to the range

        r + (x cos theta - y' sin theta) (rate t' + acceleration t'^2 / 2)
          - (x sin theta + y' cos theta) (rate t')^2 / 2.

    Here r is its range at the middle of the pulse, x its cross range, and y' its range from the
    centre of rotation. theta, rate and acceleration are the rotation angle and its derivatives at
    the middle of the pulse.
    """
    x, y, lever = x[..., None, :], y[..., None, :], lever[..., None, :]
    theta, rate, acceleration = turn
    middle, speed = path[0][..., None], path[1][..., None]
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
    return start, slope, curve, 2 * video * along


def _common_turns(radar: InverseRadar, path: tuple[Tensor, Tensor, Tensor], fast_s: Tensor) -> Tensor:
    """Cycles due to the motion of the whole target, (*trials, pulse, fast_time)."""
    middle_m, speed_m_s, bend_m = path
    delay = 2 / radar.wave_speed_m_s * (middle_m[..., None] + speed_m_s[..., None] * fast_s + bend_m)
    return -delay * (radar.carrier_hz + radar.chirp_rate_hz_s * (fast_s - delay / 2))


def _sum_of_lines(
    lines: tuple[Tensor, Tensor, Tensor, Tensor], amplitude: Tensor, bend_m: Tensor, fast_s: Tensor, dtype: torch.dtype
) -> Tensor:
    """Sum over targets of amplitude * exp(2j pi turns), (*trials, pulse, fast_time)."""
    start, slope, curve, bend = lines
    n, edge_s = len(fast_s), float(fast_s.abs().max())
    curve = 2 * math.pi * curve * edge_s**2
    weight = unit_phasor(start, dtype) * amplitude[..., None, :].to(dtype)
    sum_of = LineSum(slope * (float(fast_s[1] - fast_s[0]) if n > 1 else 0.0), n, -(n // 2), dtype)
    u2 = (fast_s / edge_s).square() if edge_s else torch.zeros_like(fast_s)
    total = sum_of(weight)
    for order in range(1, _series_terms(curve) + 1):
        term = curve.pow(order) / math.factorial(order)
        total = total + sum_of(weight * (term * 1j**order).to(dtype)) * u2.pow(order).to(dtype)
    # the deviation of the motion also changes the phase between scatterers
    off_m = float(bend_m.detach().abs().max())
    worst = 2 * math.pi * float(bend.detach().abs().max()) * off_m
    if not worst**2 / 2 <= _DROPPED_RAD:
        raise ValueError(
            f"the motion departs by {off_m:.3g} m from a straight line within a pulse, more than the dechirped model "
            "can represent; shorten the pulse or slow the motion"
        )
    if worst > 1e-12:
        total = total + sum_of(weight * (2j * math.pi * bend).to(dtype)) * bend_m.to(dtype)
    return total


def _series_terms(phase_rad: Tensor) -> int:
    """Number of terms, beyond the first, of the power series of exp(j phase) for an error of 1e-12.

    There is at least one, so that gradients are also correct for a target at rest.
    """
    worst = float(phase_rad.detach().abs().max())
    for order in range(1, 13):
        if worst ** (order + 1) / math.factorial(order + 1) < 1e-12:
            return order
    raise ValueError(
        f"the rotation causes a quadratic phase of {worst:.3g} rad within a pulse, and the dechirped model is "
        "valid up to 0.6 rad; shorten the pulse"
    )


def _refuse_fast_turns(
    radar: InverseRadar, radius_m: float, turn: Sequence[Tensor], rotation: Rotation, half_s: float
) -> None:
    """Raise ValueError if the neglected orders of the rotation are not negligible."""
    angle, rate, acceleration = (v.detach() for v in turn)
    # largest angles by which the target rotates in half a pulse, by their order in time
    by_rate, by_acceleration = float(rate.abs().max()) * half_s, float(acceleration.abs().max()) * half_s**2 / 2
    beyond = 0.0
    if isinstance(rotation, PolynomialRotation):
        middle_s = torch.arange(angle.shape[-1], dtype=torch.float64, device=angle.device) / radar.prf_hz
        off = [rotation.angle(middle_s + s) - angle - rate * s - acceleration * s**2 / 2 for s in (-half_s, half_s)]
        beyond = float(torch.stack(off).detach().abs().max())
    whole = by_rate + by_acceleration + beyond
    on_carrier = whole**3 / 6 + (whole**2 - by_rate**2) / 2 + beyond
    on_chirp = whole**2 / 2 + by_acceleration + beyond
    scale = radar.carrier_hz * on_carrier + radar.chirp_rate_hz_s * half_s * on_chirp
    dropped = 4 * math.pi / radar.wave_speed_m_s * radius_m * scale
    if not dropped <= _DROPPED_RAD:
        raise ValueError(
            f"the target turns by {whole:.3g} rad in half a pulse, for which the dechirped model neglects a phase of "
            f"{dropped:.3g} rad, more than {_DROPPED_RAD:g} rad; shorten the pulse or slow the rotation"
        )
