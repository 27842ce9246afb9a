"""The report of a run of a triangular-sweep ladar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.case_report import write_case_report
from torchsar.study.pictures import Picture

_TRAPPED_RAD = 1.0
SHOWN = {
    "residual_phase_rms_rad": ("residual phase, rms without constant and slope", "rad", 3),
    "pslr_azimuth_db": ("PSLR in azimuth", "dB", 2),
    "irw_azimuth_m": ("width in azimuth", "m", 4),
    "velocity_rmse_m_s": ("velocity error, rms", "m/s", 6),
    "entropy_above_ideal_nats": ("entropy above the ideal image", "nats", 3),
    "range_error_detrended_rms_m": ("range error, rms without constant and slope", "m", 3),
    "range_error_max_m": ("range error, largest", "m", 3),
    "islr_azimuth_db": ("ISLR in azimuth", "dB", 2),
    "irw_range_m": ("width in range", "m", 4),
    "pslr_range_db": ("PSLR in range", "dB", 2),
    "islr_range_db": ("ISLR in range", "dB", 2),
    "entropy_nats": ("entropy", "nats", 3),
    "contrast": ("contrast of the amplitude", "", 3),
    "ok": ("share of trials that the method trusts", "", 2),
    "seconds": ("time a trial", "s", 3),
}


def entropy_traps(metrics: Mapping[str, Any]) -> list[dict[str, str]]:
    """Where a wrong image has less entropy than the right one: a sentence for every such case."""
    methods, reference = metrics["methods"], metrics["definitions"]["reference"]
    notes = []
    for case, ideal in (methods[reference]["cases"] if reference else {}).items():
        rows = {name: method["cases"][case] for name, method in methods.items() if name != reference}
        trapped = [
            name
            for name, row in rows.items()
            if row["entropy_nats"] < ideal["entropy_nats"] - 0.02 and row["residual_phase_rms_rad"] > _TRAPPED_RAD
        ]
        if trapped:
            figures = ", ".join(
                f"{name} {rows[name]['entropy_nats']:.2f} nats with {rows[name]['residual_phase_rms_rad']:.3g} rad left"
                for name in trapped
            )
            text = (
                f"Wrong images have less entropy here than the right one ({ideal['entropy_nats']:.2f} "
                f"nats): {figures}. Judge by what is left of the motion, by entropy second."
            )
            notes.append({"title": f"Entropy trap, case {case}", "text": text})
    return notes


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
    write_case_report(
        path,
        "sal.html.j2",
        title,
        metrics,
        SHOWN,
        metrics["published"],
        pictures,
        figures,
        config_text,
        command,
        notes=entropy_traps(metrics),
    )
