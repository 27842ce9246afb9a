"""Non-linear sweeps of a triangular ladar, from the internal calibration channel.

The transmitter's optical frequency is fc +- K u + e'(u), e in turns. The channel beats it with
itself delayed by tc, the echo by dtau:
  channel / 2 pi = fc tc +- K u tc + e(u) - e(u - tc) + constant    (up +, down -, each with its own
  e; brief 000, section 3 signs).
Let w(u) = u +- e'(u) / K be the time at which a linear sweep has the frequency of the real one.
e(u) - e(u - t) = t e'(u - t / 2) but for t^3 e''' / 24, so that the channel gives w - u at u - tc /
2, and a beat of ANY range is a pure tone in w. The constant of e' is a change of carrier that no
channel tells; its mean over the sweep is put to zero. Source of the channel: paper 000, section 2.1
(correction of the echo phase).
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, refuse_non_finite, unit_phasor
from torchsar.radar import TriangularLadar
from torchsar.repair.jitter import band_limited_weights

Method = Literal["resample", "phase"]


def sweep_error_s(calibration: Tensor, radar: TriangularLadar, delay_s: float) -> Tensor:
    """w(u) - u of both ramps at fast times u, s, mean zero.

    calibration: (..., 2, K, N) complex, K periods or one. Returns (..., 2, N) float64.

    Periods are averaged after their own constant phase is taken out. The first delay_s of a sweep,
    where the delayed copy is still in the sweep before, is extended from what follows. delay_s must
    be known: an error of it counts as an error of the sweep rate. Phases are unwrapped along u:
    needs the channel's noise below about a radian a sample, and a beat below fs / 2.
    """
    calibration = calibration.conj() if radar.dechirp_sign == "echo_conj_lo" else calibration
    tone = _sign(calibration) * _line(radar, delay_s, calibration)
    phasor = _mean_period(calibration.to(torch.complex128) * unit_phasor(-tone, torch.complex128)[..., None, :])
    turns = _unwrapped(phasor) / (2 * math.pi)
    moved = turns / (radar.chirp_rate_hz_s * delay_s) * _sign(calibration)
    error = _shifted(moved, radar, delay_s)
    return error - error.mean(-1, keepdim=True)


def _line(radar: TriangularLadar, delay_s: float, like: Tensor) -> Tensor:
    """K u tc, turns (N,)."""
    if not delay_s > 0:
        raise ValueError(f"the delay of the calibration channel must be positive, got {delay_s} s")
    return radar.chirp_rate_hz_s * delay_s * radar.fast_time_axis().values(like.device)


def _sign(like: Tensor) -> Tensor:
    """+1 for the up ramp, -1 for the down one, (2, 1)."""
    return torch.tensor([[1.0], [-1.0]], dtype=torch.float64, device=like.device)


def _mean_period(x: Tensor) -> Tensor:
    """Mean over periods, each turned to the phase of the first. (..., K, N) -> (..., N)."""
    turn = (x * x[..., :1, :].conj()).sum(-1, keepdim=True)
    return (x * (turn.conj() / turn.abs().clamp_min(1e-300))).mean(-2)


def _unwrapped(phasor: Tensor) -> Tensor:
    """Continuous phase along the last dim, 0 at its first sample."""
    steps = torch.angle(phasor[..., 1:] * phasor[..., :-1].conj())
    return torch.nn.functional.pad(torch.cumsum(steps, -1), (1, 0))


def _shifted(error: Tensor, radar: TriangularLadar, delay_s: float) -> Tensor:
    """An error known at u - tc / 2, from the first whole one on, at u."""
    lost, half = math.ceil(delay_s * radar.sample_rate_hz - 1e-9), delay_s * radar.sample_rate_hz / 2
    if lost > error.shape[-1] // 2:
        raise ValueError(
            f"a calibration delay of {delay_s:g} s takes {lost} of {error.shape[-1]} samples of a "
            "sweep; more than half must be left"
        )
    place = torch.arange(error.shape[-1], dtype=torch.float64, device=error.device) + half
    return _sampled(error[..., lost:], place - lost)


def _sampled(x: Tensor, place: Tensor) -> Tensor:
    """x (..., n) at fractional indices (..., m) by cubic interpolation; beyond its ends the
    straight line through its last samples.
    """
    n = x.shape[-1]
    inside = place.clamp(0, n - 1)
    first = torch.floor(inside).long().clamp(1, n - 3) - 1
    shape = torch.broadcast_shapes(x.shape[:-1], place.shape[:-1])
    x = x.expand(*shape, n)
    at = inside - (first + 1)
    weights = (
        -at * (at - 1) * (at - 2) / 6,
        (at + 1) * (at - 1) * (at - 2) / 2,
        -(at + 1) * at * (at - 2) / 2,
        (at + 1) * at * (at - 1) / 6,
    )
    found = sum(w * x.gather(-1, (first + i).expand(*shape, place.shape[-1])) for i, w in enumerate(weights))
    span = min(8, n - 1)
    slope = (
        torch.where(place < 0, x[..., span : span + 1] - x[..., :1], x[..., -1:] - x[..., -1 - span : n - span]) / span
    )
    return found + slope * (place - inside)


def calibrate_sweeps(
    sweeps: Tensor,
    calibration: Tensor,
    radar: TriangularLadar,
    delay_s: float,
    method: Method = "resample",
    range_m: float | None = None,
    points: int = 12,
    band: float = 0.9,
) -> Tensor:
    """Sweeps as a linear transmitter would give them.

    sweeps: (..., 2, K, N) complex; calibration: (..., 2, K or 1, N) complex. Same shape as sweeps.

    delay_s: tc of the channel. method "resample": every sweep at the instants u(w) of uniform w,
    right for all ranges at once, through `points` neighbours with the least error over `band` of
    the sampling rate; range_m, where given, is the middle of the gate and takes its flight of RD /
    c into account. Constant carrier phases stay; a Doppler fd, which does not follow w, keeps 2 pi
    fd (w - u). method "phase": multiplied by the phase of one relative range range_m; a scatterer
    RD beyond it keeps 4 pi K RD (w - u) / c.

    Residual phase rms at w - u up to 9 ns (0.11 % of the sweep): RD 1.5 m without Doppler 0.16 rad
    before, 0.0002 by "phase" (0.054 half a metre off), 0.0025 by "resample" (0.0012 with range_m;
    half a metre off the same); at 0.5 m/s 0.016 by "resample". RD 10.5 m: 0.56, 1e-6, 0.027
    (0.002). Differentiable in the sweeps. Raises ValueError for an unknown method or a missing
    range.
    """
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {method!r}")
    _refuse_other(sweeps, "the sweeps to calibrate are", "K", radar.sweep_samples)
    _refuse_other(calibration, "the calibration channel is", "K or 1", radar.sweep_samples)
    if calibration.shape[-2] not in (1, sweeps.shape[-2]):
        raise ValueError(
            f"the calibration channel has {calibration.shape[-2]} periods; give one, or the "
            f"{sweeps.shape[-2]} of the sweeps"
        )
    refuse_non_finite(calibration, "the calibration channel")
    error = sweep_error_s(calibration, radar, delay_s)
    if method == "phase":
        return _phase_corrected(sweeps, error, radar, range_m)
    dtau = 0.0 if range_m is None else 2 * range_m / radar.wave_speed_m_s
    return _resampled(sweeps, _instants(error, radar, dtau), points, band)


def _refuse_other(x: Tensor, what: str, periods: str, n: int) -> None:
    """Raise ValueError unless x is complex (..., 2, K, n); periods: what K is called."""
    if not (x.is_complex() and x.ndim >= 3 and x.shape[-3] == 2 and x.shape[-1] == n):
        raise ValueError(f"{what} complex (..., 2, {periods}, {n}), up before down, got {x.dtype} {tuple(x.shape)}")


def _phase_corrected(sweeps: Tensor, error_s: Tensor, radar: TriangularLadar, range_m: float | None) -> Tensor:
    """Multiply by exp(-j 2 pi [e(u) - e(u - dtau)]) of one range."""
    if range_m is None:
        raise ValueError("method 'phase' corrects one relative range: give range_m")
    dtau = 2 * range_m / radar.wave_speed_m_s
    place = torch.arange(sweeps.shape[-1], dtype=torch.float64, device=sweeps.device) - dtau / 2 * radar.sample_rate_hz
    turns = _sign(sweeps) * radar.chirp_rate_hz_s * dtau * _sampled(error_s, place)
    sense = 1 if radar.dechirp_sign == "lo_conj_echo" else -1
    return sweeps * unit_phasor(-sense * turns, sweeps.dtype)[..., None, :]


def _instants(error_s: Tensor, radar: TriangularLadar, dtau_s: float, steps: int = 4) -> Tensor:
    """Fractional sample index at which w(u - dtau / 2) + dtau / 2 has the value of each grid
    sample, (..., 2, N), by fixed-point iteration.
    """
    error = error_s * radar.sample_rate_hz
    grid, half = (
        torch.arange(error.shape[-1], dtype=torch.float64, device=error.device),
        dtau_s / 2 * radar.sample_rate_hz,
    )
    place = grid.expand(error.shape)
    for _ in range(steps):
        place = grid - _sampled(error, place - half)
    return place


def _resampled(x: Tensor, place: Tensor, points: int, band: float) -> Tensor:
    """x (..., 2, K, N) at fractional indices (..., 2, N) of its last dim."""
    n = x.shape[-1]
    first = (torch.floor(place.detach()).long() - (points // 2 - 1)).clamp(0, n - points)
    index = first[..., None] + torch.arange(points, device=x.device)
    weights = band_limited_weights(index - place[..., None], band).to(x.real.dtype)
    out = torch.zeros_like(x)
    for i in range(points):
        column = index[..., None, :, i].expand(x.shape)
        out = out + weights[..., None, :, i] * x.gather(-1, column)
    return out


class CalibrateSweeps(Stage):
    """Linear sweeps from the calibration channel: `use(CalibrateSweeps(radar, delay_s),
    calibration="aux.calibration")`. See calibrate_sweeps.

    delay_s: of the channel; None where it is recorded side data: `use(...,
    calibration="aux.calibration", delay_s="aux.calibration_delay_s")`.
    """

    works_on = ("ramp", "pulse", "fast_time")

    def __init__(
        self,
        radar: TriangularLadar,
        delay_s: float | None = None,
        method: Method = "resample",
        range_m: float | None = None,
    ) -> None:
        super().__init__()
        if method not in get_args(Method) or (method == "phase" and range_m is None):
            raise ValueError(
                f"method must be 'resample', or 'phase' with range_m, got {method!r} with range_m={range_m}"
            )
        if delay_s is not None and not delay_s > 0:
            raise ValueError(f"the delay of the calibration channel must be positive, got {delay_s} s")
        self.radar, self.delay_s, self.range_m = radar, delay_s, range_m
        self.method: Method = method

    def forward(self, signal: Signal, calibration: Tensor, delay_s: Tensor | None = None) -> Signal:
        if delay_s is None and self.delay_s is None:
            raise ValueError(
                "CalibrateSweeps needs the delay of the channel: CalibrateSweeps(radar, delay_s) or "
                "use(..., delay_s='aux.calibration_delay_s')"
            )
        delay = self.delay_s if delay_s is None else float(delay_s)
        return signal.with_data(
            calibrate_sweeps(signal.data, calibration, self.radar, delay or 0.0, self.method, self.range_m)
        )
