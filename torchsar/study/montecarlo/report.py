"""The report of a sweep: one HTML file made from the summary, the pictures and the config."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.core import Outcome
from torchsar.plot import axis_label
from torchsar.study.montecarlo.pictures import label_text
from torchsar.study.output.numbers import MISSING, number
from torchsar.study.output.pictures import Picture
from torchsar.study.output.progress import clock
from torchsar.study.output.report import write_page

# parts of `about` that are shown elsewhere in the report, or are too long for it
_NOT_SHOWN = ("title", "config", "identity", "sessions", "chunk_rows")


def write_sweep_report(
    path: Path, tree: Mapping[str, Any], pictures: Sequence[Picture], figures: Path, config_text: str, command: str
) -> None:
    """Write the report of a sweep; it is self-contained and loads no external resources.

    Args:
        path: Where to write it.
        tree: The content of summary.json.
        pictures: Pictures in the order in which they are shown.
        figures: The folder that holds them.
        config_text: The resolved config.
        command: The command that made it.
    """
    tables = [*metric_tables(tree), *outcome_tables(tree), *bound_tables(tree)]
    fields = {"facts": facts(tree), "tables": tables, "origin": list(origin(tree["about"]))}
    shown = {"title": tree["title"], "definitions": tree["definitions"], "config": config_text, "command": command}
    write_page(path, "sweep.html.j2", pictures, figures, **shown, **fields)


def with_interval(value: float | None, interval: Sequence[float | None]) -> str:
    """Return a value with its interval, as '1.234 [1.100, 1.400]'; without one, the value alone."""
    low, high = map(number, interval)
    return number(value) if MISSING in (low, high) else f"{number(value)} [{low}, {high}]"


def facts(tree: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return (value, name) of the numbers at the top of the report.

    They are the numbers of trials, points and algorithms, and the computing time and the trials per
    second over all sessions.
    """
    done = {tuple(point["parameters"].values()): point["trials"] for point in tree["points"]}
    few, many = min(done.values(), default=0), max(done.values(), default=0)
    sessions = tree["about"].get("sessions", [])
    seconds = sum(session["seconds"] for session in sessions)
    rate = sum(session["trials"] for session in sessions) / seconds if seconds else None
    return [
        (f"{sum(done.values()):,}", f"trials, {many if few == many else f'{few} to {many}'} a point"),
        (f"{math.prod(map(len, tree['parameters'].values()))}", "points"),
        (f"{len(tree['algorithms'])}", "algorithms"),
        (clock(seconds) if seconds else MISSING, "time"),
        (number(rate), "trials per second"),
    ]


def metric_tables(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a table for each metric, with title, columns and rows of text."""
    grouped: dict[str, list[Mapping[str, Any]]] = {}
    for point in tree["points"]:
        grouped.setdefault(point["metric"], []).append(point)
    first, last = ["algorithm", *map(axis_label, tree["parameters"])], ["RMSE", "median", "mean", "std", "ok share"]
    tables = []
    for metric, points in grouped.items():
        limit = points[0].get("success_limit")
        success = [] if limit is None else [f"success (within {limit:g})"]
        columns = [*first, "n of trials", *last, *success]
        tables.append({"title": axis_label(metric), "columns": columns, "rows": [_row(point) for point in points]})
    return tables


def _row(point: Mapping[str, Any]) -> list[str]:
    pairs = [("rmse", "interval"), ("median", "median_interval"), ("mean", "mean_interval")]
    shares = [name for name in ("ok", "success") if f"{name}_share" in point]
    return [
        point["algorithm"],
        *map(label_text, point["parameters"].values()),
        f"{point['n']} of {point['trials']}",
        *(with_interval(point[value], point[interval]) for value, interval in pairs),
        number(point["std"]),
        *(with_interval(point[f"{name}_share"], point[f"{name}_interval"]) for name in shares),
    ]


def outcome_tables(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One table of the outcomes of each algorithm at every point, if there are any."""
    rows = [
        [
            *(point["algorithm"], *map(label_text, point["parameters"].values()), f"{point['trials']}"),
            with_interval(point["ok_share"], point["ok_interval"]),
            ", ".join(f"{Outcome[name].label}: {n}" for name, n in point["outcomes"].items()),
        ]
        for point in tree["points"]
        if point["metric"] == tree["points"][0]["metric"]
    ]
    columns = ["algorithm", *map(axis_label, tree["parameters"]), "trials", "ok share", "outcomes"]
    return [{"title": "outcomes", "columns": columns, "rows": rows}] if rows else []


def bound_tables(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One table of all bounds, if there are any."""
    rows = [
        [b["bound"], axis_label(b["metric"]), *map(label_text, b["parameters"].values()), number(b["rms"])]
        for b in tree["bounds"]
    ]
    columns = ["bound", "metric", *map(axis_label, tree["parameters"]), "rms"]
    return [{"title": "bounds", "columns": columns, "rows": rows}] if rows else []


def origin(about: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of seed and hash of the sweep, and of device and versions by session."""
    sessions = about.get("sessions", [])
    trees = [(f"session {i}: " if len(sessions) > 1 else "", session) for i, session in enumerate(sessions, 1)]
    for before, tree in [("", about), *trees]:
        for name, value in tree.items():
            if name not in _NOT_SHOWN and value is not None:
                inner = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)
                yield before + name.replace("_", " "), number(value) if isinstance(value, float) else inner
