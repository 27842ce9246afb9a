"""The report of a run of ships on a sea: a table a figure, ships below each other, methods side by
side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.case_report import tables, write_case_report
from torchsar.study.pictures import Picture

SHIPS = {
    "u_r_error_m_s": ("error of the slant-range velocity", "m/s", 3),
    "u_a_error_m_s": ("error of the along-track velocity", "m/s", 3),
    "position_error_m": ("error of the place", "m", 2),
    "along_error_m": ("of it along track", "m", 2),
    "range_error_m": ("of it in range", "m", 2),
    "scatterers_error_m": ("error of the place against the scatterers' powers", "m", 2),
    "displacement_vt_m": ("displacement in the image of everything at rest, predicted, axis (V_R - u_a) t", "m", 1),
    "replica_distance_vt_m": ("distance of the false target, predicted, same axis", "m", 1),
    "displacement_m": ("displacement, measured, axis V_R t", "m", 1),
    "replica_distance_m": ("distance of the false target, measured, axis V_R t", "m", 1),
    "replica_before_db": ("false target over the sea, image of everything at rest", "dB", 1),
    "replica_db": ("false target over the sea, final image", "dB", 1),
    "replica_left_db": ("what is left of the false target over the sea", "dB", 1),
    "sea_error_db": ("error of the sea about a ship that was removed", "dB", 1),
    "sea_error_before_db": ("the same before it was removed", "dB", 1),
    "hole_db": ("sea where the ship was shown against the true sea", "dB", 1),
    "contrast_db": ("ship over the sea at its true place, final image", "dB", 1),
    "u_r_std_m_s": ("the method's own prediction of the error of the slant-range velocity", "m/s", 3),
    "found": ("share of ships found", "", 2),
}
SCENES = {
    "false_targets": ("targets that belong to no ship", "", 1),
    "condition_number": ("condition number of the reconstruction of what is at rest", "", 2),
    "noise_gain_db": ("noise gain of that reconstruction", "dB", 2),
    "seconds": ("time a scene", "s", 1),
}
_FACTS = ("u_r_error_m_s", "u_a_error_m_s", "position_error_m", "replica_db", "sea_error_db", "contrast_db")


def write_report(
    path: Path,
    title: str,
    metrics: Mapping[str, Any],
    pictures: Sequence[Picture],
    figures: Path,
    config_text: str,
    command: str,
) -> None:
    """Write the report of one run; it asks for nothing from outside."""
    of_ships = {"methods": {name: {"cases": method["targets"]} for name, method in metrics["methods"].items()}}
    shown = [*tables(of_ships, SHIPS, metrics["published"]["targets"]), *tables(metrics, SCENES, {})]
    facts = {key: SHIPS[key] for key in _FACTS}
    notes = [
        {
            "title": "Places",
            "text": (
                "Errors of places count from what the image of the ship's own echo would show: its "
                "scatterers interfere, and no image shows the middle of their powers."
            ),
        }
    ]
    write_case_report(
        path,
        "geo.html.j2",
        title,
        metrics,
        facts,
        {},
        pictures,
        figures,
        config_text,
        command,
        notes=notes,
        tables=shown,
    )
