"""The report of a sweep: one HTML file with its pictures inside, made only from the summary, the
pictures and the resolved config.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchsar.study.montecarlo.pictures import axis_label
from torchsar.study.output.pictures import Picture
from torchsar.study.output.report import write_page

MISSING = "–"
_NOT_SHOWN = ("title", "config", "identity", "sessions", "chunk_rows")


def write_sweep_report(
    path: Path,
    summary: Mapping[str, Any],
    pictures: Sequence[Picture],
    figures_folder: Path,
    config_text: str,
    command: str,
) -> None:
    """Write the report; it asks for nothing from outside.

    summary: of `summary_tree`, or read from its file.
    """
    fields = {
        "facts": facts(summary),
        "tables": [*metric_tables(summary), *bound_tables(summary)],
        "origin": list(origin(summary["about"])),
    }
    write_page(
        path,
        "sweep.html.j2",
        pictures,
        figures_folder,
        title=summary["title"],
        command=command,
        definitions=summary["definitions"],
        config=config_text,
        **fields,
    )


def figure(value: float | None) -> str:
    """Four significant digits, or all before the point up to ten million; what is unknown is a
    dash.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def with_interval(value: float | None, interval: Sequence[float | None]) -> str:
    """'1.234 [1.1, 1.4]', without brackets where there is no interval."""
    low, high = map(figure, interval)
    return figure(value) if MISSING in (low, high) else f"{figure(value)} [{low}, {high}]"


# --- facts
# --------------------------------------------------------------------------------------------------


def facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(value, what it is): trials, points, algorithms, time and pace."""
    done = {_key(point): point["trials"] for point in summary["points"]}
    few, many = min(done.values(), default=0), max(done.values(), default=0)
    seconds, pace = _time(summary["about"], sum(done.values()))
    return [
        (f"{sum(done.values()):,}", f"trials, {many if few == many else f'{few} to {many}'} a point"),
        (f"{math.prod(map(len, summary['parameters'].values()))}", "points"),
        (f"{len(summary['algorithms'])}", "algorithms"),
        (_duration(seconds), "time"),
        (figure(pace), "trials per second"),
    ]


def _key(point: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(point["parameters"].values())


def _time(about: Mapping[str, Any], trials: int) -> tuple[float | None, float | None]:
    """Seconds, and trials per second, over all sessions of a sweep that was taken up again; None
    where nobody measured.
    """
    sessions = [session for session in about.get("sessions", [about]) if session.get("seconds")]
    seconds = sum(session["seconds"] for session in sessions)
    return (seconds, sum(session.get("trials", trials) for session in sessions) / seconds) if seconds else (None, None)


def _duration(seconds: float | None) -> str:
    if seconds is None or seconds < 120:
        return MISSING if seconds is None else f"{seconds:.3g} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02} min"


# --- tables
# --------------------------------------------------------------------------------------------------


def metric_tables(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One table a metric: title, columns and rows of text."""
    grouped: dict[str, list[Mapping[str, Any]]] = {}
    for point in summary["points"]:
        grouped.setdefault(point["metric"], []).append(point)
    return [_metric_table(summary, metric, points) for metric, points in grouped.items()]


def _metric_table(summary: Mapping[str, Any], metric: str, points: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    limit = points[0].get("success_limit")
    columns = [
        "algorithm",
        *map(axis_label, summary["parameters"]),
        "n of trials",
        "RMSE",
        "median",
        "mean",
        "std",
        "ok share",
    ]
    rows = [_row(point) for point in points]
    return {
        "title": axis_label(metric),
        "columns": columns + ([f"success (within {limit:g})"] if limit is not None else []),
        "rows": rows,
    }


def _row(point: Mapping[str, Any]) -> list[str]:
    cells = [point["algorithm"], *map(_label, point["parameters"].values()), f"{point['n']} of {point['trials']}"]
    pairs = [("rmse", "interval"), ("median", "median_interval"), ("mean", "mean_interval")]
    cells += [with_interval(point[value], point[interval]) for value, interval in pairs]
    cells += [figure(point["std"]), with_interval(point["ok_share"], point["ok_interval"])]
    return cells + (
        [with_interval(point["success_share"], point["success_interval"])] if "success_share" in point else []
    )


def _label(label: float | str) -> str:
    return label if isinstance(label, str) else f"{label:g}"


def bound_tables(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One table of all bounds, if there are any."""
    rows = [
        [bound["bound"], axis_label(bound["metric"]), *map(_label, bound["parameters"].values()), figure(bound["rms"])]
        for bound in summary["bounds"]
    ]
    columns = ["bound", "metric", *map(axis_label, summary["parameters"]), "rms"]
    return [{"title": "bounds", "columns": columns, "rows": rows}] if rows else []


# --- where it was made
# --------------------------------------------------------------------------------------------------


def origin(about: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and text of seed, hash, versions, device and the like; of every session where there
    were several.
    """
    yield from _flat(about)
    sessions = about.get("sessions", [])
    for number, session in enumerate(sessions, 1):
        yield from _flat(session, f"session {number}: " if len(sessions) > 1 else "")


def _flat(tree: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for name, value in tree.items():
        words = name.replace("_", " ")
        if name in _NOT_SHOWN or value is None:
            continue
        if isinstance(value, Mapping):
            yield before + words, ", ".join(f"{key} {inner}" for key, inner in value.items())
        else:
            yield before + words, figure(value) if isinstance(value, float) else str(value)
