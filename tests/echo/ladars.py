"""Ladars, motions and direct float64 sums for tests of ladar echoes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.radar import TriangularLadar
from torchsar.scene import Points, Polynomial, RetroAndBrokenLine, Scatterers, Sinusoid
from torchsar.scene.ladar import SweepError
from torchsar.scene.motion import displacement_m
from torchsar.study.bench.direct.triangles import ground

DOUBLE = torch.complex128
THREE = Points([-0.06, 0.0, 0.06], [1.0, 1.5, 2.0], [0.7, 1.0, 0.7])
# motions of the simulation and of the ground experiment, chosen here
COMMON = (
    Polynomial([0.35, 10.0]),
    Sinusoid(160e-6, 100.0, math.degrees(0.3)),
    Sinusoid(10e-6, 330.0, math.degrees(1.0)),
)
GROUND = (
    Polynomial([0.08]),
    Sinusoid(2e-3, 12.0, math.degrees(0.4)),
    Sinusoid(100e-6, 47.0, math.degrees(1.1)),
    Sinusoid(3e-6, 180.0, math.degrees(2.0)),
)


def table4(**changes) -> TriangularLadar:
    """The ground experiment of Table 4: real detection, every fourth period."""
    return ground(**{"keep_every": 4, **changes})


def unit_retro(draws) -> Scatterers:
    """Retro-reflector and broken line with a retro of amplitude 1."""
    return RetroAndBrokenLine(retro_db=0.0).scatterers(draws)


def unit(turns: Tensor) -> Tensor:
    """Unit phasors of phases in cycles."""
    return torch.polar(torch.ones_like(turns), 2 * math.pi * (turns - torch.round(turns)))


def direct_range(
    x: Tensor, r: Tensor, radar: TriangularLadar, time: Tensor, start: Tensor, motion, flight: bool = False
) -> Tensor:
    """Relative range at every time; with flight time R = R(t - R / c) is solved by iteration."""

    def history(t: Tensor) -> Tensor:
        across, near = radar.speed_m_s * t - x, radar.reference_range_m + r
        return (
            r
            + across.square() / (torch.sqrt(near.square() + across.square()) + near)
            + displacement_m(motion, t - start)
        )

    found = history(time)
    for _ in range(3 if flight else 0):
        found = history(time - (radar.reference_range_m + found) / radar.wave_speed_m_s)
    return found


def direct_sweeps(
    s: Scatterers,
    radar: TriangularLadar,
    n_period: int,
    motion=(),
    flight: bool = False,
    error: SweepError | None = None,
) -> Tensor:
    """Scatterer by scatterer, the range at every sample."""
    start, u = radar.sweep_axes(n_period)[1].values(), radar.fast_time_axis().values()
    time = start[:, None] + radar.period_s * torch.tensor([0.25, 0.75], dtype=torch.float64)[:, None, None] + u
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)[:, None, None]
    out = torch.zeros(2, n_period, len(u), dtype=DOUBLE)
    for x, r, a in zip(s.azimuth_m, s.range_m, s.amplitude, strict=True):
        delay = 2 * direct_range(x, r, radar, time, start[0], motion, flight) / radar.wave_speed_m_s
        turns = radar.carrier_hz * delay + sign * radar.chirp_rate_hz_s * (u * delay - delay.square() / 2)
        if error is not None:
            turns = turns + torch.stack(
                [error.turns(u, ramp).expand_as(delay[ramp]) - error.turns(u - delay[ramp], ramp) for ramp in (0, 1)]
            )
        out += a * unit(turns)
    return out


def triangle_turns(radar: TriangularLadar, position: Tensor) -> Tensor:
    """Antiderivative of the frequency of the triangle, period by period."""
    sweep, rate = radar.sweep_s, radar.chirp_rate_hz_s
    position = torch.remainder(position, 2 * sweep)
    return torch.where(
        position < sweep,
        rate * (position - sweep / 2) ** 2 / 2,
        rate * sweep**2 / 4 - rate * (position - 1.5 * sweep) ** 2 / 2,
    )


def direct_record(
    s: Scatterers,
    radar: TriangularLadar,
    n_period: int,
    n_sample: int,
    motion=(),
    trigger_s: float = 0.0,
    flight: bool = False,
) -> Tensor:
    """Complex beats as differences of the triangle's phase, the range at every sample."""
    start, offset = (
        radar.sweep_axes(n_period)[1].values(),
        (torch.arange(n_sample, dtype=torch.float64) + 0.5) / radar.sample_rate_hz,
    )
    position = offset - trigger_s
    out = torch.zeros(n_period, n_sample, dtype=DOUBLE)
    for x, r, a in zip(s.azimuth_m, s.range_m, s.amplitude, strict=True):
        delay = 2 * direct_range(x, r, radar, start[:, None] + offset, start[0], motion, flight) / radar.wave_speed_m_s
        out += a * unit(
            radar.carrier_hz * delay + triangle_turns(radar, position) - triangle_turns(radar, position - delay)
        )
    return out
