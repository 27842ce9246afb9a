"""Time-domain generator of pulsed echoes along any path in float64.

Each sample is the transmitted chirp at the instant at which it left the transmitter: the delay of
every sample follows from where the transmitter was then and where the receiver is now, so that both
antennas move during the flight and during the pulse. It shares no code with the simulator of the
package.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

C = 299_792_458.0
Track = Callable[[np.ndarray], np.ndarray]


def phase_history(
    transmitter: Track,
    receiver: Track,
    points: np.ndarray,
    amplitude: np.ndarray,
    pulse_s: np.ndarray,
    reference_m: np.ndarray,
    carrier_hz: float,
    bandwidth_hz: float,
    chirp_s: float,
    frequencies: int,
) -> np.ndarray:
    """Phase history (pulse, frequency) of points (point, 3) by compression of their raw echoes.

    `pulse_s` are the times at which the middle of each chirp leaves. The receiver samples from the
    delay of the reference path on, 1.25 times the bandwidth, and multiplies the spectrum of a line
    by that of the chirp, conjugated and of unit modulus.
    """
    rate, sampling = bandwidth_hz / chirp_s, 1.25 * bandwidth_hz
    swath_s = frequencies / bandwidth_hz
    n = int(sampling * (chirp_s + swath_s))
    offset = (np.arange(n) - n // 2) / sampling

    def chirp(t: np.ndarray) -> np.ndarray:
        return np.where(np.abs(t) < chirp_s / 2, np.exp(1j * np.pi * rate * t**2), 0)

    f = bandwidth_hz / frequencies * (np.arange(frequencies) - frequencies // 2)
    # the compressed spectrum at frequencies f, by a plain sum
    analysis = np.exp(-2j * np.pi * np.outer(offset, f))
    replica = chirp(offset) @ analysis
    out = np.zeros((len(pulse_s), frequencies), complex)
    for p, (start, reference) in enumerate(zip(pulse_s, reference_m, strict=True)):
        now = start + reference / C + offset
        raw = np.zeros(n, complex)
        for x, a in zip(points, amplitude, strict=True):
            back = np.linalg.norm(receiver(now) - x, axis=-1)
            delay = np.full(n, reference / C)
            for _ in range(4):
                delay = (np.linalg.norm(transmitter(now - delay) - x, axis=-1) + back) / C
            left = now - delay - start
            raw += a * chirp(left) * np.exp(-2j * np.pi * carrier_hz * (delay - reference / C))
        out[p] = (raw @ analysis) * np.conj(replica) / np.abs(replica) ** 2
    return out
