"""Direct float64 evaluation of the beat of a triangular ladar: reference of several tests."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import unit_phasor
from torchsar.radar import LIGHT_M_S, TriangularLadar


def table1(**changes) -> TriangularLadar:
    """Simulated ladar of Remote Sens. 2024, 16, 793, Table 1; further values by choice."""
    values = {
        "carrier_hz": LIGHT_M_S / 1.55e-6,
        "bandwidth_hz": 5e9,
        "period_s": 16e-6,
        "sample_rate_hz": 64e6,
        "speed_m_s": 60.0,
        "reference_range_m": 3000.0,
    }
    return TriangularLadar(**{**values, **changes})


def ground(**changes) -> TriangularLadar:
    """Ladar of the outdoor experiment (section 3.3 of the same paper), with a real detector."""
    values = {
        "period_s": 32e-6,
        "sample_rate_hz": 150e6,
        "speed_m_s": 3.125,
        "reference_range_m": 4339.5,
        "detection": "real",
    }
    return table1(**{**values, **changes})


def swing(t: Tensor) -> Tensor:
    """Radial motion in metres, at up to 0.6 m/s."""
    return 0.35 * t + 10 * t.square() + 160e-6 * torch.sin(2 * torch.pi * 100 * t + 0.3)


def sweep_turns(radar: TriangularLadar, t: Tensor) -> Tensor:
    """Phase of the triangular sweep in turns; t = 0 at the start of an up sweep."""
    phase_s = torch.remainder(t, radar.period_s)
    u = torch.remainder(phase_s, radar.sweep_s) - radar.sweep_s / 2
    return torch.where(phase_s < radar.sweep_s, 1, -1) * radar.chirp_rate_hz_s / 2 * (u.square() - radar.sweep_s**2 / 4)


def beat(radar: TriangularLadar, t: Tensor, motion=swing, scatterers=((1.5, 1.0),)) -> Tensor:
    """LO conj(echo) at times t after the start of a triangle, with its transients."""
    total = torch.zeros(t.shape, dtype=torch.complex128)
    for range_m, amplitude in scatterers:
        dtau = 2 * (range_m + motion(t)) / radar.wave_speed_m_s
        turns = radar.carrier_hz * dtau + sweep_turns(radar, t) - sweep_turns(radar, t - dtau)
        total = total + amplitude * unit_phasor(turns, torch.complex128)
    return total.conj() if radar.dechirp_sign == "echo_conj_lo" else total


def record(
    radar: TriangularLadar,
    trigger_s: float,
    n_period: int,
    block: int | None = None,
    first_s: float = 0.0,
    snr_db: float | None = None,
    seed: int = 0,
    **scene,
) -> Tensor:
    """Blocks (pulse, time) whose triangles start trigger_s after the start of each block."""
    block = 2 * radar.sweep_samples if block is None else block
    k, n = torch.arange(n_period, dtype=torch.float64)[:, None], torch.arange(block, dtype=torch.float64)
    x = beat(radar, k * radar.pulse_step_s + first_s + n / radar.sample_rate_hz - trigger_s, **scene)
    if snr_db is not None:
        x = x + 10 ** (-snr_db / 20) * torch.randn(
            x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(seed)
        )
    return x.real if radar.detection == "real" else x


def sweeps(radar: TriangularLadar, n_period: int, first: int = 0, trigger_s: float = 0.0, **scene) -> Tensor:
    """Separated sweeps (2, pulse, fast_time) on the symmetric grid, from triangle `first` on."""
    u = radar.fast_time_axis().values()
    ramp = torch.tensor([0.5, 1.5], dtype=torch.float64)[:, None, None] * radar.sweep_s
    t = (first + torch.arange(n_period, dtype=torch.float64))[:, None] * radar.pulse_step_s + ramp + u
    return beat(radar, t, **scene)
