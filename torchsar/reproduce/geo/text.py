"""Numbers in the text of Remote Sens. 2020, 12, 1703, and what it has wrong."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from torchsar.radar import range_coefficients, seen_point
from torchsar.radar.orbit import EARTH_GRAVITY_M3_S2
from torchsar.reproduce.geo.sensor import BANDWIDTH_HZ, INTEGRATION_S, OFF_NADIR_DEG, ORBIT, RADAR
from torchsar.reproduce.geo.velocity import TABLE_3, TRUE_M_S, Columns, over_noise
from torchsar.reproduce.item import Check, Item, given, misprint, number, statement

# PRINTED_K2: largest second coefficient of the transmit range in the text (m/s2).
# SHIPS: distance from the receiver (m) and along-track speed (m/s) of each ship.
PRINTED_K2 = 0.03
SHIPS = {"ship 2": (6490.0, 0.0, 934.58, 216.3), "ship 3": (4860.0, 10.0, 723.99, 167.6)}


def _receiver_hz() -> float:
    return RADAR.speed_m_s**2 * INTEGRATION_S / (RADAR.wavelength_m * RADAR.reference_range_m)


def _delay_s() -> float:
    """Azimuth delay in s of a channel against its neighbour."""
    return (RADAR.channel_m[1] - RADAR.channel_m[0]) / RADAR.speed_m_s


def _orbit(small: bool) -> list[float]:
    """Largest magnitudes of the range coefficients k1 to k4 over one orbit, for squints of 0, 45
    and 90 degrees.
    """
    turn_s = 2 * math.pi * math.sqrt(float(ORBIT.semi_major_m) ** 3 / EARTH_GRAVITY_M3_S2)
    time = torch.linspace(0, turn_s, 90 if small else 1440, dtype=torch.float64)
    looks = [seen_point(*ORBIT.state(time), OFF_NADIR_DEG, squint) for squint in (0.0, 45.0, 90.0)]
    return torch.stack([range_coefficients(ORBIT, point, time) for point in looks]).abs().amax((0, 1)).tolist()


def _higher_terms(k: list[float], path: Path) -> list[Check]:
    phase = 2 / RADAR.wavelength_m * sum(k[i] * (INTEGRATION_S / 2) ** (i + 1) for i in (2, 3))
    claim = "below 1e-4 pi within the integration time"
    return [statement("phase of the third and the fourth term", claim, phase < 1e-4, f"{phase:.2g} pi")]


def _second_term(k: list[float], path: Path) -> list[Check]:
    bandwidth = 2 * k[1] * INTEGRATION_S / RADAR.wavelength_m
    shown = k[1] < 0.8 * PRINTED_K2 and bandwidth < 0.9
    ours = f"{k[1]:.4f} m/s2 at most over the orbit, which gives a bandwidth of {bandwidth:.2f} Hz"
    return [misprint("largest k2, and its Doppler bandwidth", "about 0.03 m/s2, 1.1 Hz", shown, ours)]


def _scnr(seen: Columns, path: Path) -> list[Check]:
    """Check the relative error of a speed of 10 m/s that SIR finds at -10 dB, at the pulse rates of
    Table 2.
    """
    column = seen[1].index(-10.0)
    return [
        number(
            f"relative error at -10 dB, {rate} (%)", 5.0, (100 / TRUE_M_S * errors[column]["SIR"]).tolist(), 1, "lower"
        )
        for rate, columns in seen[0].items()
        for errors in [columns]
    ]


def _ship(name: str, range_m: float, u_a: float, distance_m: float, shift_m: float) -> list[Check]:
    along = RADAR.speed_m_s - u_a
    return [
        number(f"{name}: distance of the false target (m)", distance_m, RADAR.prf_hz * 0.24 * range_m / along, 0.1),
        number(f"{name}: displacement (m)", shift_m, TRUE_M_S * range_m / along, 0.1),
    ]


def _equation_30() -> Check:
    (range_m, u_a, _, printed), v = SHIPS["ship 3"], RADAR.speed_m_s
    by_equation, by_speed = v * TRUE_M_S * range_m / (v - u_a) ** 2, TRUE_M_S * range_m / (v - u_a)
    shown = abs(by_speed - printed) < 0.1 < abs(by_equation - printed)
    ours = f"{by_equation:.1f} m by the equation, {by_speed:.1f} m by u_r R0 / (v_R - u_a)"
    return misprint("displacement of ship 3 by Eq. (30)", f"{printed:g} m", shown, ours)


def _equation_28() -> Check:
    printed, right = (
        PRINTED_K2 * x * INTEGRATION_S for x in (RADAR.wavelength_m / (4 * math.pi), 2 / RADAR.wavelength_m)
    )
    ours = f"{printed:.4f} Hz by k2 lambda / (4 pi); {right:.2f} Hz by 2 k2 / lambda"
    return misprint(
        "share of the transmitter in the Doppler bandwidth, Eq. (28)", "1.1 Hz", printed < 0.1 < right, ours
    )


def _table_3() -> Check:
    worst, relative = max(TABLE_3.values()), max(100 * error / abs(u_r) for u_r, error in TABLE_3.items())
    ours = f"the table has {worst:g} m/s and {relative:.0f} %"
    return misprint("largest errors of Table 3", "below 0.15 m/s and below 3 %", worst > 0.15 and relative > 3, ours)


def _equation_13() -> Check:
    second = PRINTED_K2 * _delay_s() * INTEGRATION_S
    at_s = 1.6e-3 / (2 * PRINTED_K2 * _delay_s())
    ours = f"{second:.1e} m at the ends of the integration time; 1.6e-3 m needs {at_s:.0f} s"
    return misprint("second term of the range error, Eq. (13)", "1.6e-3 m", second < 0.5e-3, ours)


# items in the order of the paper
ITEMS = (
    given(
        "Text 1",
        "Doppler bandwidth (section 2.3)",
        number("of the receiver (Hz)", 337.5, _receiver_hz(), 0.1),
        number("of receiver and transmitter (Hz)", 338.6, _receiver_hz() + 2 * PRINTED_K2 * INTEGRATION_S / 0.24, 0.1),
    ),
    Item("Text 2", "neglected terms of the transmit range (section 2.1)", _orbit, _higher_terms),
    given(
        "Text 3",
        "third term of the range error between channels (section 2.1)",
        number("largest value (1e-7 m)", 2.1, 1e7 * PRINTED_K2 * _delay_s() ** 2, 0.05),
    ),
    given(
        "Text 4",
        "number of channels (section 2.3)",
        statement("two channels", "are enough", 2 * RADAR.prf_hz > BANDWIDTH_HZ, f"{2 * RADAR.prf_hz:g} Hz in all"),
    ),
    Item("Text 5", "SCNR of a relative error below 5 % (section 4.2)", over_noise, _scnr),
    given(
        "Text 6",
        "theory of the false targets of the ships (section 5.2)",
        *(check for name, row in SHIPS.items() for check in _ship(name, *row)),
    ),
    Item("Erratum 1", "second coefficient of the transmit range", _orbit, _second_term),
    given("Erratum 2", "range error between channels", _equation_13()),
    given("Erratum 3", "Doppler bandwidth of the transmitter", _equation_28()),
    given("Erratum 4", "displacement in azimuth", _equation_30()),
    given("Erratum 5", "text about Table 3", _table_3()),
)
