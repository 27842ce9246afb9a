"""Time-domain generator of raw bistatic data in float64.

The signal model is that of Remote Sens. 2020, 12, 1703: a far transmitter, whose range changes by
k1 t + k2 t^2, and a receiver on a straight track.

The pulse is evaluated at the instant of every sample, so that its edges lie between samples. It
shares no code with the simulator of the package.
"""

from __future__ import annotations

import math

import numpy as np

C = 299_792_458.0


def echo(
    time_s: np.ndarray,
    line_m: np.ndarray,
    *,
    carrier_hz: float,
    rate_hz_s: float,
    pulse_s: float,
    speed_m_s: float,
    channel_m: float,
    closest_m: float,
    along_m: float,
    closing_m_s: float,
    transmit: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Lines (pulse, sample) of one point, and its receive range (pulse,).

    The sample at `line_m` is taken at the delay (transmit range + line_m) / c. The point is at the
    position `along_m` and the closest range `closest_m` at time zero, and closes at `closing_m_s`.
    """
    receive = np.hypot(speed_m_s * time_s + channel_m - along_m, closest_m) - closing_m_s * time_s
    sent = transmit[0] * time_s + transmit[1] * time_s**2
    late = (line_m[None] - receive[:, None]) / C
    pulse = np.exp(1j * math.pi * rate_hz_s * (late - pulse_s / 2) ** 2) * ((late >= 0) & (late < pulse_s))
    return pulse * np.exp(-2j * math.pi * np.remainder(carrier_hz / C * (sent + receive), 1))[:, None], receive
