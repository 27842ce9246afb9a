"""The report of a run of moving targets: their figures as the source prints them, with theory
beside, and conditioning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.case_report import tables, write_case_report
from torchsar.study.pictures import Picture

TARGETS = {
    "irw_azimuth_m": ("width in azimuth along the track that the target sees", "m", 3),
    "pslr_azimuth_db": ("PSLR in azimuth", "dB", 2),
    "islr_azimuth_db": ("ISLR in azimuth", "dB", 2),
    "mfta_db": ("largest false target (MFTA)", "dB", 1),
    "u_r_error_m_s": ("error of the slant-range velocity", "m/s", 4),
    "u_a_error_m_s": ("error of the along-track velocity", "m/s", 4),
    "position_error_m": ("error of the place along track", "m", 3),
    "irw_range_m": ("width in range, axis c tau / 2", "m", 3),
    "pslr_range_db": ("PSLR in range", "dB", 2),
    "islr_range_db": ("ISLR in range", "dB", 2),
    "range_error_m": ("error of the range", "m", 3),
    "condition_number": ("condition number of the reconstruction", "", 2),
    "noise_gain_db": ("noise gain of the reconstruction", "dB", 2),
    "u_r_std_m_s": ("the method's own prediction of the error of the slant-range velocity", "m/s", 4),
    "u_a_std_m_s": ("the method's own prediction of the error of the along-track velocity", "m/s", 4),
    "ok": ("share of trials that the method trusts", "", 2),
    "seconds": ("time a target and trial", "s", 3),
}
_FACTS = ("irw_azimuth_m", "pslr_azimuth_db", "mfta_db", "irw_range_m", "condition_number", "noise_gain_db")


def _target_tables(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a target, a column a method, and theory as the last column."""
    of_methods = {name: {"cases": method["targets"]} for name, method in metrics["methods"].items()}
    return tables(
        {"methods": {**of_methods, "theory": {"cases": metrics["theory"]}}}, TARGETS, metrics["published"]["targets"]
    )


def level_note(definitions: Mapping[str, Any]) -> dict[str, str]:
    """How strong the targets are, both ways."""
    if "snr_db" not in definitions:
        return {"title": "No noise", "text": "Echoes are free of noise."}
    text = (
        f"A target stands {definitions['snr_db']:.4g} dB above the noise in a "
        f"range-compressed sample of one channel, {definitions['raw_scnr_db']:.4g} dB before "
        "compression."
    )
    return {"title": "Signal to noise", "text": text}


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
    facts = {key: TARGETS[key] for key in _FACTS}
    notes = [level_note(metrics["definitions"])]
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
        tables=_target_tables(metrics),
    )
