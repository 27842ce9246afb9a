"""The report of a run of a turning target: one table of entropies as the source prints it, one of all figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.pictures import Picture
from torchsar.study.report import number, write_page

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


def _cell(row: Mapping[str, float], key: str, digits: int) -> str:
    if key not in row:
        return "–"
    spread = row.get(f"{key}_sd")
    return number(row[key], digits) if spread is None or key == "seconds" else f"{number(row[key], digits)} ± {spread:.{digits}f}"


def tables(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One table a figure: rows are cases, columns methods; of the entropy also what the source published, less its ideal."""
    methods = metrics["methods"]
    cases = list(next(iter(methods.values()))["cases"])
    found = []
    for key, (label, unit, digits) in _SHOWN.items():
        columns = [name for name, m in methods.items() if any(key in row for row in m["cases"].values())]
        if not columns:
            continue
        rows = [{"case": case, "cells": [_cell(methods[name]["cases"][case], key, digits) for name in columns]} for case in cases]
        found.append({"title": f"{label} ({unit})" if unit else label, "columns": columns, "rows": rows, "published": _published(metrics, columns, cases) if key == "entropy_above_ideal_nats" else []})
    return found


def _published(metrics: Mapping[str, Any], columns: Sequence[str], cases: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of the source beside ours: entropy less the entropy that it implies for the error-free image."""
    ideal, entropies = metrics["published"]["ideal_entropy_nats"], metrics["published"]["entropy_nats"]
    if ideal is None:
        return []
    return [{"case": case, "cells": [number(entropies[case][name] - ideal, 3) if name in entropies[case] else "–" for name in columns]} for case in cases if case in entropies]


def write_report(path: Path, title: str, metrics: Mapping[str, Any], pictures: Sequence[Picture], figures: Path, config_text: str, command: str) -> None:
    """Write the report of one run; it asks for nothing from outside."""
    best = metrics["methods"]["recommended"]["metrics"]
    facts = [(f"{number(best[key], digits)} {unit}", label) for key, (label, unit, digits) in _SHOWN.items() if key in best][:6]
    fields = {"facts": facts, "tables": tables(metrics), "methods": metrics["methods"], "trials": metrics["trials"]}
    write_page(path, "isal.html.j2", pictures, figures, title=title, command=command, definitions=metrics["definitions"], config=config_text, **fields)
