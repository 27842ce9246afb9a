"""The report of a run of a turning target: one table of entropies as the source prints it, one of
all figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.case_report import Published, write_case_report
from torchsar.study.pictures import Picture

_SHOWN = {
    "entropy_above_ideal_nats": ("entropy above the ideal image", "nats", 3),
    "entropy_above_clean_nats": ("entropy above the method's own result without injected phases", "nats", 4),
    "residual_phase_rms_rad": ("residual phase, rms", "rad", 3),
    "agreement_rad": ("influence of the injected phases, rms", "rad", 4),
    "residual_phase_std_rad": ("the method's own prediction of the residual", "rad", 3),
    "strehl": ("Strehl ratio", "", 3),
    "entropy_nats": ("entropy", "nats", 3),
    "contrast": ("contrast of the intensity", "", 2),
    "ok": ("share of trials that the method trusts", "", 2),
    "seconds": ("time a trial", "s", 3),
}


def _published(metrics: Mapping[str, Any]) -> Published:
    """Entropies of the source less the entropy that it implies for the error-free image."""
    ideal, entropies = metrics["published"]["ideal_entropy_nats"], metrics["published"]["entropy_nats"]
    if ideal is None:
        return {}
    return {
        "entropy_above_ideal_nats": {
            case: {name: value - ideal for name, value in row.items()} for case, row in entropies.items()
        }
    }


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
        path, "isal.html.j2", title, metrics, _SHOWN, _published(metrics), pictures, figures, config_text, command
    )
