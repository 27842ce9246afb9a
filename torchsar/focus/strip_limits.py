"""Limit of the Doppler band of a stripmap recording, computed from the radar parameters."""

from __future__ import annotations

from torchsar.focus.ladar_requirements import Limit
from torchsar.radar import StripmapRadar


def strip_limits(radar: StripmapRadar, samples: int, doppler_hz: float, velocity_m_s: float) -> tuple[Limit, ...]:
    """Compare the Doppler band of the aperture of a stripmap radar with its PRF.

    Args:
        radar: Radar of the recording.
        samples: Number of range samples of a line; the Doppler rate is that at the middle one.
        doppler_hz: Absolute Doppler centroid in Hz.
        velocity_m_s: Effective velocity in m/s.

    Returns:
        The limit of the Doppler band; an empty tuple where the radar has no integration time.
    """
    if radar.integration_s is None:
        return ()
    middle = radar.near_range_m + samples // 2 * radar.range_step_m
    cos2 = 1 - float(radar.sin_squint(doppler_hz, velocity_m_s)) ** 2
    rate = float(radar.azimuth_rate_hz_s(middle, velocity_m_s)) * cos2
    shorter = f"shorten the aperture to {radar.prf_hz / rate:.3g} s, or raise the PRF"
    name = f"Doppler band of a {radar.integration_s:g} s aperture"
    return (Limit(name, rate * radar.integration_s, radar.prf_hz, "Hz", "warn", "its ends alias in azimuth", shorter),)
