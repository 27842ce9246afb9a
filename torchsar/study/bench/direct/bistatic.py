"""Time-domain generator of raw bistatic data in float64.

The signal model is that of Remote Sens. 2020, 12, 1703: a far transmitter, whose range changes by
k1 t + k2 t^2, and a receiver on a straight track.

The pulse is evaluated at the instant of every sample, so that its edges lie between samples. It
shares no code with the simulator of the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# speed of light in m/s
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


@dataclass(frozen=True)
class Survey:
    """Numbers of a bistatic radar.

    `transmit` are k1 and k2 of the range to the transmitter. A channel at a positive `channel_m`
    follows the middle of the receiver by this length, as in Eq. (4) of the paper.
    """

    carrier_hz: float = 1.25e9
    bandwidth_hz: float = 50e6
    pulse_s: float = 10e-6
    sampling_hz: float = 60e6
    prf_hz: float = 180.0
    speed_m_s: float = 300.0
    range_m: float = 5000.0
    channel_m: tuple[float, ...] = (-0.8, 0.0, 0.8)
    transmit: tuple[float, float] = (-243.0, 0.018)
    element_m: float = 0.8
    wave_m_s: float = C

    def raw(
        self,
        pulses: int,
        line_m: np.ndarray,
        u_r_m_s: float = 0.0,
        u_a_m_s: float = 0.0,
        y0_m: float = 0.0,
        slant_m: float | None = None,
        lit_s: float | None = 4.5,
    ) -> np.ndarray:
        """Raw lines (channel, pulse, sample) of a moving point of unit amplitude.

        Pulse `pulses // 2` reaches the scene at time zero. The sample at `line_m` is taken when
        that range has been covered since the pulse reached the scene, by the orbit that the
        receiver knows for the time of the pulse. The receiver flies on during the flight and the
        pulse, the transmitter moves and the pulse begins and ends between samples. The transmitter
        lights the point for the time `lit_s` with edges between pulses, or, if it is None, each
        channel sees it through the one-way pattern of its element.
        """
        start = (np.arange(pulses) - pulses // 2)[:, None] / self.prf_hz
        arrived = start + line_m[None] / self.wave_m_s
        slant = self.range_m if slant_m is None else slant_m
        k1, k2 = self.transmit
        lines = []
        for dx in self.channel_m:
            flown = np.full_like(arrived, slant / self.wave_m_s)
            for _ in range(4):
                met = arrived - flown
                along = self.speed_m_s * arrived - dx - y0_m - u_a_m_s * met
                flown = np.hypot(along, slant - u_r_m_s * met) / self.wave_m_s
            # the orbit is known for the start of the pulse
            late = (met - start) * (1 - (k1 + k2 * (met + start)) / self.wave_m_s)
            envelope = np.exp(1j * math.pi * self.bandwidth_hz / self.pulse_s * (late - self.pulse_s / 2) ** 2)
            turns = np.remainder(self.carrier_hz * (flown + (k1 * met + k2 * met**2) / self.wave_m_s), 1)
            line = np.where((late >= 0) & (late < self.pulse_s), envelope * np.exp(-2j * math.pi * turns), 0)
            if lit_s is None:
                sine = along / (self.wave_m_s * flown)
                lines.append(line * np.sinc(self.element_m * self.carrier_hz / self.wave_m_s * sine))
            else:
                lines.append(line * (np.abs(start - y0_m / (self.speed_m_s - u_a_m_s)) < lit_s / 2))
        return np.stack(lines)
