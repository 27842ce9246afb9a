"""Time-domain generator of raw stripmap data in float64, from the signal model of Tsvetkov 2017.

It evaluates the transmitted pulse at the instant of every sample. The edges of an echo lie between
samples, and the antenna moves between transmission and reception if that is asked for. It shares no
code with the simulator of the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# speed of light in m/s
C = 299_792_458.0


@dataclass(frozen=True)
class Instrument:
    """Numbers of a radar: a pulse exp(j pi k (t - T / 2)^2) from t = 0 to t = T, k = rate_hz_s."""

    carrier_hz: float
    rate_hz_s: float
    pulse_s: float
    sampling_hz: float
    prf_hz: float
    velocity_m_s: float
    near_range_m: float

    def pulse(self, t: np.ndarray) -> np.ndarray:
        """The pulse at times after its leading edge."""
        inside = (t >= 0) & (t < self.pulse_s)
        return np.where(inside, np.exp(1j * math.pi * self.rate_hz_s * (t - self.pulse_s / 2) ** 2), 0)


def echo(
    radar: Instrument,
    crossing_s: np.ndarray,
    slant_m: np.ndarray,
    n_pulse: int,
    n_range: int,
    squint_deg: float = 0.0,
    dwell_s: float = math.inf,
    amplitude: np.ndarray | None = None,
    moving: bool = False,
) -> np.ndarray:
    """Raw lines (pulse, sample) of points that the beam centre crosses at `crossing_s`, at the
    slant range `slant_m`; moving: the antenna moves during the flight of the pulse and during the
    pulse.
    """
    sine, cosine = math.sin(math.radians(squint_deg)), math.cos(math.radians(squint_deg))
    start = np.arange(n_pulse)[:, None] / radar.prf_hz
    after = 2 * radar.near_range_m / C + np.arange(n_range)[None] / radar.sampling_hz
    raw = np.zeros((n_pulse, n_range), dtype=complex)
    gains = np.ones(len(slant_m)) if amplitude is None else amplitude
    for crossing, slant, gain in zip(crossing_s, slant_m, gains, strict=True):
        along, closest = radar.velocity_m_s * crossing + slant * sine, slant * cosine

        def distance(t: np.ndarray, along: float = along, closest: float = closest) -> np.ndarray:
            return np.hypot(along - radar.velocity_m_s * t, closest)

        if moving:  # the path of what arrives at `start + after`: sent one delay earlier, from elsewhere
            arrival = start + after
            delay = 2 * distance(arrival) / C
            for _ in range(4):
                delay = (distance(arrival) + distance(arrival - delay)) / C
        else:
            delay = 2 * distance(start) / C
        lit = np.abs(start - crossing) < dwell_s / 2
        raw += (
            gain * lit * radar.pulse(after - delay) * np.exp(-2j * math.pi * np.remainder(radar.carrier_hz * delay, 1))
        )
    return raw
