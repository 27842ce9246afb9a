"""Reports of runs over cases: one table a figure, rows are cases, columns methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.pictures import Picture
from torchsar.study.report import number, write_page

# metric -> (label, unit, digits)
Shown = Mapping[str, tuple[str, str, int]]
# metric -> case -> method -> what the source published
Published = Mapping[str, Mapping[str, Mapping[str, float]]]


def _cell(row: Mapping[str, float], key: str, digits: int) -> str:
    if key not in row:
        return "–"
    spread = row.get(f"{key}_sd")
    return (
        number(row[key], digits)
        if spread is None or key == "seconds"
        else f"{number(row[key], digits)} ± {number(spread, digits)}"
    )


def tables(metrics: Mapping[str, Any], shown: Shown, published: Published) -> list[dict[str, Any]]:
    """One table a figure that any method has, with what the source published for it below."""
    methods = metrics["methods"]
    cases = list(next(iter(methods.values()))["cases"])
    found = []
    for key, (label, unit, digits) in shown.items():
        columns = [name for name, m in methods.items() if any(key in row for row in m["cases"].values())]
        if not columns:
            continue
        rows = [
            {"case": case, "cells": [_cell(methods[name]["cases"][case], key, digits) for name in columns]}
            for case in cases
        ]
        of_source = published.get(key, {})
        below = [
            {"case": case, "cells": [number(of_source[case].get(name), digits) for name in columns]}
            for case in cases
            if case in of_source
        ]
        found.append(
            {"title": f"{label} ({unit})" if unit else label, "columns": columns, "rows": rows, "published": below}
        )
    return found


def write_case_report(
    path: Path,
    template: str,
    title: str,
    metrics: Mapping[str, Any],
    shown: Shown,
    published: Published,
    pictures: Sequence[Picture],
    figures: Path,
    config_text: str,
    command: str,
    **fields: Any,
) -> None:
    """Write the report of one run over cases; it asks for nothing from outside.

    template: one that extends cases.html.j2.
    """
    best = metrics["methods"]["recommended"]["metrics"]
    facts = [
        (f"{number(best[key], digits)} {unit}", label) for key, (label, unit, digits) in shown.items() if key in best
    ][:6]
    given = {
        "facts": facts,
        "tables": tables(metrics, shown, published),
        "methods": metrics["methods"],
        "trials": metrics["trials"],
        **fields,
    }
    write_page(
        path,
        template,
        pictures,
        figures,
        title=title,
        command=command,
        definitions=metrics["definitions"],
        config=config_text,
        **given,
    )
