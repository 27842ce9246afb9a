"""Remote Sens. 2024, 16, 793: synthetic aperture ladar with a triangular sweep."""

from __future__ import annotations

import math

from torchsar.reproduce.item import Check, Item, Paper, given, in_order, number, statement
from torchsar.reproduce.sal import ground, points

__all__ = ["PAPER"]
__dir__ = __all__.copy


def _micrometre() -> Check:
    phase = 4e-6 * math.pi * points.RADAR.carrier_hz / points.RADAR.wave_speed_m_s
    return statement("motion of a micrometre", "spoils the focus", phase > math.pi / 4, f"{phase:.1f} rad")


# the paper with its items
PAPER = Paper(
    "sal",
    "SAL motion compensation by segmented interference of triangular sweeps, Remote Sens. 2024, 16, 793",
    in_order(
        Item("Figure 1", "structure of the system", kind="diagram"),
        Item("Figure 3", "flow of the processing", kind="diagram"),
        Item("Figure 13", "geometry of the observation", kind="diagram"),
        Item("Figure 14", "the instrument, the laboratory and the target", kind="photograph"),
        *points.ITEMS,
        *ground.ITEMS,
        given(
            "Text 1",
            "range cell (sections 3.1 and 3.3)",
            number("c / 2B (m)", 0.03, points.RADAR.range_step_m, 1e-4),
        ),
        given(
            "Text 2",
            "sensitivity to radial motion (section 1)",
            _micrometre(),
        ),
        given(
            "Text 3",
            "spacing of 62 points (section 3.2)",
            statement(
                "main lobes of neighbours, 5 cm and 1 cm apart",
                "separate in range and azimuth",
                0.886 * points.RADAR.range_step_m < 0.05 and points.TABLE_2[3] < 0.01,
                f"widths of {88.6 * points.RADAR.range_step_m:.2f} and {100 * points.TABLE_2[3]:.2f} cm",
            ),
        ),
    ),
)
