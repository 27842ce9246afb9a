"""The report of a run of a target that turns unevenly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.case_report import tables, write_case_report
from torchsar.study.pictures import Picture

SHOWN = {
    "omega_error_percent": ("error of the rate", "%", 4),
    "k1_error_percent": ("error of k1", "%", 4),
    "k2_error_percent": ("error of k2", "%", 4),
    "entropy_nats": ("entropy", "nats", 3),
    "contrast": ("contrast of the intensity", "", 2),
    "seconds": ("time a trial", "s", 3),
    "entropy_above_ideal_nats": ("entropy above the ideal image", "nats", 3),
    "cross_range_scale_error_percent": ("error of the cross-range scale", "%", 4),
    "k1_error_per_s": ("error of k1, whose true value is 0", "1/s", 4),
    "k2_error_per_s2": ("error of k2, whose true value is 0", "1/s^2", 3),
    "k3_error_per_s3": ("error of k3, whose true value is 0", "1/s^3", 1),
    "yc_error_m": ("error of the range centre deviation", "m", 4),
    "omega_std_percent": ("the method's own prediction of the error of the rate", "%", 4),
    "k1_std_percent": ("the method's own prediction of the error of k1", "%", 4),
    "k2_std_percent": ("the method's own prediction of the error of k2", "%", 4),
    "yc_std_m": ("the method's own prediction of the error of the range centre deviation", "m", 4),
    "evaluations": ("evaluations of the objective", "", 0),
    "ok": ("share of trials that the method trusts", "", 2),
}
TARGETS = {
    "peak_db": ("peak relative to the ideal image", "dB", 2),
    "irw_azimuth_m": ("width in cross range", "m", 5),
    "pslr_azimuth_db": ("PSLR in cross range", "dB", 2),
}
_TRAP_NATS, _TRAP_PERCENT = 0.005, 1.0


def entropy_traps(metrics: Mapping[str, Any]) -> list[dict[str, str]]:
    """Where an image of a wrong rotation has less entropy than the right one: a sentence for every
    such case.
    """
    methods, reference = metrics["methods"], metrics["definitions"]["reference"]
    notes = []
    for case in methods[reference]["cases"] if reference else ():
        rows = {name: method["cases"][case] for name, method in methods.items()}
        trapped = [
            name
            for name, row in rows.items()
            if row.get("entropy_above_ideal_nats", 0.0) < -_TRAP_NATS
            and abs(row.get("k1_error_percent", 0.0)) > _TRAP_PERCENT
        ]
        if trapped:
            figures = ", ".join(
                f"{name} ({rows[name]['entropy_above_ideal_nats']:.3f} nats, k1 "
                f"{rows[name]['k1_error_percent']:.2g} % off)"
                for name in trapped
            )
            text = (
                "Wrong rotations give less entropy here than the right one, on the grid of its "
                f"image: {figures}. A finer grid takes this away."
            )
            notes.append({"title": f"Entropy trap, case {case}", "text": text})
    return notes


def _target_tables(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Tables of point targets: a row each, as those of the cases."""
    if not any(method["targets"] for method in metrics["methods"].values()):
        return []
    return tables(
        {"methods": {name: {"cases": method["targets"]} for name, method in metrics["methods"].items()}},
        TARGETS,
        metrics["published"]["targets"],
    )


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
    shown = [*_target_tables(metrics), *tables(metrics, SHOWN, metrics["published"])]
    # the page of triangular ladars: figures of the first case, and notes below them
    write_case_report(
        path,
        "sal.html.j2",
        title,
        metrics,
        SHOWN,
        {},
        pictures,
        figures,
        config_text,
        command,
        notes=entropy_traps(metrics),
        tables=shown,
    )
