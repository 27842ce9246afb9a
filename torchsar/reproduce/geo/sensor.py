"""The radar of Table 1 of Remote Sens. 2020, 12, 1703."""

from __future__ import annotations

from pathlib import Path

from torchsar.radar import BistaticRadar, LinearFM, Orbit
from torchsar.reproduce.item import Check, Item, parameters

# values of Table 1; pulse length and sampling are chosen, and the printed numbers follow from a
# speed of 3e8 m/s
RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    wave_speed_m_s=3e8,
)
# integration time, Doppler bandwidth of this time, height of the satellite, off-nadir angle
INTEGRATION_S, BANDWIDTH_HZ, HEIGHT_M, OFF_NADIR_DEG = 4.5, 337.5, 36_500e3, 7.0
ORBIT = Orbit.at_height(HEIGHT_M, inclination_deg=60.0, raan_deg=195.5, argument_of_perigee_deg=270.0)
# Taylor coefficients (m/s, m/s2, m/s3) of the transmit range for an orbit of this height, by choice
TRANSMIT_RANGE = (-243.0, 0.02, 5e-7)


def _table_1(small: bool, path: Path) -> list[Check]:
    rows = {
        "carrier (GHz)": (1.25, 1e-9 * RADAR.carrier_hz),
        "pulse rate (Hz)": (180.0, RADAR.prf_hz),
        "bandwidth (MHz)": (50.0, 1e-6 * RADAR.pulse.bandwidth_hz),
        "integration time (s)": (4.5, INTEGRATION_S),
        "inclination (deg)": (60.0, ORBIT.inclination_deg),
        "right ascension of the ascending node (deg)": (195.5, ORBIT.raan_deg),
        "argument of perigee (deg)": (270.0, ORBIT.argument_of_perigee_deg),
        "off-nadir angle (deg)": (7.0, OFF_NADIR_DEG),
        "range of the scene (km)": (5.0, 1e-3 * RADAR.reference_range_m),
        "speed of the receiver (m/s)": (300.0, RADAR.speed_m_s),
        "channels": (3, RADAR.channels),
        "spacing of the channels (m)": (0.8, RADAR.channel_m[1] - RADAR.channel_m[0]),
    }
    return parameters(rows, 1e-6)


ITEMS = (Item("Table 1", "parameters of the simulation", bool, _table_1),)
