"""Limits of a stripmap recording, which follow from the radar before any simulation."""

from __future__ import annotations

from torchsar.focus.ladar_requirements import Limit
from torchsar.radar import StripmapRadar


def strip_limits(radar: StripmapRadar, samples: int, doppler_hz: float, velocity_m_s: float) -> tuple[Limit, ...]:
    """List the limits of a recording; none where the radar has no integration time.

    Args:
        radar: Instrument.
        samples: Range samples of a line; the aperture is that of the middle one.
        doppler_hz: Absolute Doppler centroid in Hz.
        velocity_m_s: Effective velocity in m/s.

    Returns:
        The limit of the Doppler band, or nothing.
    """
    if radar.integration_s is None:
        return ()
    middle = radar.near_range_m + samples // 2 * radar.range_step_m
    cos2 = 1 - float(radar.sin_squint(doppler_hz, velocity_m_s)) ** 2
    rate = float(radar.azimuth_rate_hz_s(middle, velocity_m_s)) * cos2
    shorter = f"shorten the aperture to {radar.prf_hz / rate:.3g} s, or raise the PRF"
    name = f"Doppler band of a {radar.integration_s:g} s aperture"
    return (Limit(name, rate * radar.integration_s, radar.prf_hz, "Hz", "warn", "its ends alias in azimuth", shorter),)
