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

    The range to the transmitter follows from transmit_range, k1, k2, ..., or from an orbit.
    """
    if orbit is not None and transmit_range:
        raise ValueError("radar: give one of transmit_range and orbit, and leave the other out")
    known: dict[str, Any] = {"height_m": height_m, "channel_m": tuple(channel_m), "element_m": element_m}
    known["transmit_range"] = tuple(transmit_range) if orbit is None else orbit.transmit_coefficients()
    numbers = (sampling_hz, prf_hz, speed_m_s, reference_range_m)
    return BistaticRadar(carrier_hz, LinearFM(bandwidth_hz, pulse_s), *numbers, **known, wave_speed_m_s=wave_speed_m_s)
