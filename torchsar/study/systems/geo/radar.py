"""The section `radar` of systems with a far transmitter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchsar.radar import LIGHT_M_S, BistaticRadar, Ephemeris, LinearFM


def bistatic_radar(
    carrier_hz: float,
    bandwidth_hz: float,
    pulse_s: float,
    sampling_hz: float,
    prf_hz: float,
    speed_m_s: float,
    reference_range_m: float,
    height_m: float = 3000.0,
    channel_m: Sequence[float] = (-0.8, 0.0, 0.8),
    element_m: float = 0.8,
    transmit_range: Sequence[float] = (),
    orbit: Ephemeris | None = None,
    wave_speed_m_s: float = LIGHT_M_S,
) -> BistaticRadar:
    """Make a `BistaticRadar` from the keys of a config.

    Args:
        carrier_hz: Carrier frequency in Hz.
        bandwidth_hz: Bandwidth of the transmitted up-chirp in Hz.
        pulse_s: Length of the transmitted pulse in seconds.
        sampling_hz: Complex sampling rate in Hz, at least the bandwidth.
        prf_hz: Pulse repetition frequency of the transmitter in Hz.
        speed_m_s: Speed of the receiver along its straight, level track in m/s.
        reference_range_m: Closest slant range from the receiver to the scene centre in metres.
        height_m: Height of the receiver in metres.
        channel_m: Positions of the channels along the track in metres.
        element_m: Length of the aperture of each channel along the track in metres.
        transmit_range: Coefficients k1, k2, ... (m/s, m/s^2, ...) of the change of the range to the
            transmitter, k1 t + k2 t^2 + ...
        orbit: Orbit of the transmitter, from which these coefficients follow; null if
            transmit_range is given, or the coefficients are zero.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If both transmit_range and orbit are given, or a value is not accepted.
    """
    if orbit is not None and transmit_range:
        raise ValueError("radar: give one of transmit_range and orbit, and leave the other out")
    known: dict[str, Any] = {"height_m": height_m, "channel_m": tuple(channel_m), "element_m": element_m}
    known["transmit_range"] = tuple(transmit_range) if orbit is None else orbit.transmit_coefficients()
    numbers = (sampling_hz, prf_hz, speed_m_s, reference_range_m)
    return BistaticRadar(carrier_hz, LinearFM(bandwidth_hz, pulse_s), *numbers, **known, wave_speed_m_s=wave_speed_m_s)
