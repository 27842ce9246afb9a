"""Echoes of moving points in front of a bistatic receiver, by direct sums.

They share no code with the simulation of the package.
"""

from __future__ import annotations

import math

import torch

from torchsar.core import Signal
from torchsar.radar import BistaticRadar, LinearFM


def published_radar(**changes) -> BistaticRadar:
    """Return the instrument of Remote Sens. 2020, 12, 1703, Table 1, with c = 3e8 m/s."""
    values: dict = {
        "carrier_hz": 1.25e9,
        "pulse": LinearFM(50e6, 10e-6),
        "sampling_hz": 60e6,
        "prf_hz": 180.0,
        "speed_m_s": 300.0,
        "reference_range_m": 5000.0,
        "wave_speed_m_s": 3e8,
    }
    return BistaticRadar(**{**values, **changes})


def time_of(radar, n_pulse):
    return (torch.arange(n_pulse, dtype=torch.float64) - n_pulse // 2) / radar.prf_hz


def range_of(radar, time_s, u_r=0.0, u_a=0.0, y0=0.0, r0=None):
    """Return R_m(t) by the printed formula, (channel, pulse)."""
    r0 = radar.reference_range_m if r0 is None else r0
    dx = torch.tensor(radar.channel_m, dtype=torch.float64)[:, None]
    return torch.sqrt((r0 - u_r * time_s) ** 2 + ((radar.speed_m_s - u_a) * time_s - y0 - dx) ** 2)


def lit(radar, time_s, u_a=0.0, y0=0.0, gate_s=4.5):
    return ((time_s - y0 / (radar.speed_m_s - u_a)).abs() < gate_s / 2).to(torch.float64)


def transmit_of(radar, time_s):
    return sum((k * time_s**power for power, k in enumerate(radar.transmit_range, 1)), torch.zeros_like(time_s))


def azimuth_echo(radar, n_pulse, u_r=0.0, u_a=0.0, y0=0.0, r0=None, gate_s=4.5):
    """Return the echo (channel, pulse) of one point, with the transmit range of the radar."""
    t = time_of(radar, n_pulse)
    path = range_of(radar, t, u_r, u_a, y0, r0) - radar.reference_range_m + transmit_of(radar, t)
    return torch.exp(-2j * math.pi * torch.remainder(path / radar.wavelength_m, 1)) * lit(radar, t, u_a, y0, gate_s)


def compressed_echo(radar, n_pulse, n_range, points, gate_s=4.5):
    """Return the signal (channel, pulse, range) of points (dicts of u_r, u_a, y0, r0, amplitude).

    Each point has a rectangular band of unit peak at R_m(t); the transmit range is in the carrier
    only.
    """
    t = time_of(radar, n_pulse)
    fr = torch.fft.fftfreq(n_range, 1 / radar.sampling_hz, dtype=torch.float64)
    band = (fr.abs() < radar.pulse.bandwidth_hz / 2).to(torch.float64)
    c, first = radar.wave_speed_m_s, radar.reference_range_m - (n_range // 2) * radar.wave_speed_m_s / radar.sampling_hz
    total = torch.zeros(radar.channels, n_pulse, n_range, dtype=torch.complex128)
    for point in points:
        move = {name: point[name] for name in ("u_r", "u_a", "y0", "r0") if name in point}
        r = range_of(radar, t, **move)
        carrier = (r - radar.reference_range_m + transmit_of(radar, t)) / radar.wavelength_m
        turns = torch.remainder(carrier, 1)[..., None] + fr * ((r - first) / c)[..., None]
        gate = lit(radar, t, point.get("u_a", 0.0), point.get("y0", 0.0), gate_s)
        total += point.get("amplitude", 1.0) * torch.exp(-2j * math.pi * turns) * gate[..., None]
    data = torch.fft.ifft(total * band * (n_range / band.sum()))
    return Signal(data, radar.axes(n_pulse, n_range))
