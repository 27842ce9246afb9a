"""Reports, which are HTML files that contain their pictures, and the figures that every kind of
experiment has.
"""

from __future__ import annotations

import base64
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import torch

from torchsar import plot
from torchsar.core import Outcome, Signal
from torchsar.plot import name_and_unit
from torchsar.study.output.numbers import MISSING, number, quantity, scale_of


@dataclass(frozen=True)
class Column:
    """Presentation of a metric in reports and pictures.

    Args:
        label: Its name in words.
        unit: Its unit for tables and axes; SI units are shown with prefixes.
        digits: Number of digits after the decimal point.
        drawn: Statistic over trials in the picture that compares methods: "mean", "rms", or "" for
            no picture.
    """

    label: str
    unit: str = ""
    digits: int = 3
    drawn: str = ""


Shown = Mapping[str, Column]


def installed_version() -> str:
    """Return the version of the installed distribution."""
    try:
        return version("torchsar-lab")
    except PackageNotFoundError:
        return "not installed"


def write_page(
    path: Path, template: str, pictures: Sequence[Picture], figures: Path, lead: Picture | None = None, **fields: Any
) -> None:
    """Write one HTML file that is self-contained: it loads no external resources.

    Args:
        path: Path of the file.
        template: Template in the folder `templates` that extends base.html.j2.
        pictures: Pictures in their order.
        figures: Folder of the files of the pictures.
        lead: Picture at the head of the page, or None.
        fields: Values of the template; the base needs `title`, `command`, `definitions` and
            `config`.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("torchsar.study.output", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    shown = [
        {"title": p.title, "caption": p.caption, "sources": [_embedded(figures / file) for file in p.files]}
        for p in (*pictures, *([] if lead is None else [lead]))
    ]
    fields = {**fields, "lead": None if lead is None else shown.pop(), "pictures": shown}
    made = f"torchsar-lab {installed_version()}, torch {torch.__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    text = environment.get_template(template).render(made=made, **fields)
    path.write_text(text, encoding="utf-8")


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def run_fields(metrics: Mapping[str, Any], columns: Shown, target_columns: Shown) -> dict[str, Any]:
    """Return the values that are filled into the report page of a run.

    Args:
        metrics: Content of metrics.json.
        columns: Label and unit of each metric.
        target_columns: Label and unit of each metric of targets.
    """
    methods = {"recommended": metrics["methods"]["recommended"], **metrics["methods"]}
    best, cases = methods["recommended"], list(methods["recommended"]["cases"])
    rows = {name: method["cases"] for name, method in methods.items()}
    published = metrics["published"]
    tables = (
        [_one_table(rows, columns, published, cases[0])]
        if len(cases) == 1
        else _tables(rows, columns, published, "case")
    )
    of_targets = {name: method["targets"] for name, method in methods.items() if method["targets"]}
    theory = {"theory": metrics["theory"]} if metrics.get("theory") else {}
    reasons = {
        name: [
            (stage, row["trials"], row["message"])
            for stage, found in method["outcomes"].items()
            for code, row in found.items()
            if not Outcome[code].is_ok
        ]
        for name, method in methods.items()
    }
    return {
        "cases": cases,
        "tables": tables,
        "target_tables": _tables({**of_targets, **theory}, target_columns, metrics["published_targets"], "target"),
        "methods": methods,
        "best": best,
        "estimates": [
            (name, quantity(found["value"], name_and_unit(name)[1], found["std"]), _in_words(found["outcome"]))
            for name, found in best["estimates"].items()
        ],
        "reasons": {name: rows for name, rows in reasons.items() if rows},
        "not_assessed": [
            name
            for name, method in methods.items()
            if {code for found in method["outcomes"].values() for code in found} == {Outcome.NOT_ASSESSED.name}
        ],
        "metrics": metrics,
    }


def _in_words(outcomes: str | list[str] | None) -> str:
    """Outcomes of the trials, or of one trial, in words such as "noise: 2, ok: 1"."""
    found = Counter([outcomes] if isinstance(outcomes, str) else outcomes)
    return (
        ", ".join(f"{Outcome[x].label}{f': {n}' if len(found) > 1 else ''}" for x, n in found.most_common()) or MISSING
    )


def _sd(row: Mapping[str, Any], key: str) -> float | None:
    """Standard deviation over trials; None for times, which depend on the load of the machine."""
    return None if key == "seconds" else row.get(f"{key}_sd")


def _cell(row: Mapping[str, Any], key: str, factor: float, published: Any = None) -> list[str]:
    """Number of a metric as text, and the published one in brackets if there is one."""
    known = [] if published is None else [f"({number(published, None, factor)})"]
    return [number(row.get(key), _sd(row, key), factor), *known]


def _tables(rows: Mapping[str, Any], columns: Shown, published: Mapping[str, Any], first: str) -> list[dict[str, Any]]:
    """Make a table for each metric, with a row for each case or target and a column for each
    method.

    Args:
        rows: Numbers by method, case or target, and metric.
        columns: Presentation of the metrics.
        published: Published values by metric, case or target, and method.
        first: Heading of the first column.
    """
    tables = []
    for key, column in columns.items():
        names = [name for name, of in rows.items() if any(row.get(key) is not None for row in of.values())]
        keys = list(dict.fromkeys(one for name in names for one in rows[name]))
        factor, unit = scale_of([rows[name].get(one, {}).get(key) for name in names for one in keys], column.unit)
        known = published.get(key, {})
        body = [
            (one, [_cell(rows[name].get(one, {}), key, factor, known.get(one, {}).get(name)) for name in names])
            for one in keys
        ]
        if names:
            title = f"{column.label} ({unit})" if unit else column.label
            tables.append({"title": title, "first": first, "columns": names, "rows": body})
    return tables


def _one_table(rows: Mapping[str, Any], columns: Shown, published: Mapping[str, Any], case: str) -> dict[str, Any]:
    """Make the table of one case, with a row for each metric and a column for each method."""
    names, body = list(rows), []
    for key, column in columns.items():
        values = [rows[name][case].get(key) for name in names]
        factor, unit = scale_of(values, column.unit)
        label, known = f"{column.label} ({unit})" if unit else column.label, published.get(key, {}).get(case, {})
        if known or any(value is not None for value in values):
            body.append((label, [_cell(rows[name][case], key, factor, known.get(name)) for name in names]))
    return {"title": "", "first": "figure", "columns": names, "rows": body}


log = logging.getLogger("torchsar")
# ratio of the largest to the smallest value above which a comparison has a logarithmic axis
_DECADES = 100.0
Drawn = Iterator[tuple[str, str, str, Any]]


@dataclass(frozen=True)
class Picture:
    """Files of a figure that are shown side by side, with their title and caption, and with the
    title of each panel.
    """

    files: tuple[str, ...]
    title: str
    caption: str
    panels: tuple[str, ...] = ()


def draw_all(makers: Iterable[Callable[[], Drawn]], folder: Path) -> list[Picture]:
    """Draw pictures and write them as PNG files.

    Args:
        makers: Functions that yield pictures as (name, title, caption, figure); a list of figures
            is one picture with several panels, and an empty list gives no picture.
        folder: Folder of the files; it is made if it does not exist.

    Returns:
        The pictures in their order; one that cannot be drawn has no files, and a caption says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures: list[Picture] = []
    for name, title, caption, drawn in (one for make in makers for one in _drawn(make)):
        stem = f"{len(pictures) + 1:02d}_{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)[:80]}"
        panels = drawn if isinstance(drawn, list) else [drawn] * (drawn is not None)
        files = tuple(f"{stem}_{i}.png" if len(panels) > 1 else f"{stem}.png" for i in range(1, len(panels) + 1))
        for file, figure in zip(files, panels, strict=True):
            plot.save(figure, folder / file)
        if files or drawn is None:
            titles = tuple("".join(part.get_title() for part in figure.axes[:1]) for figure in panels)
            pictures.append(Picture(files, title[:1].upper() + title[1:], caption, titles))
    return pictures


def before_and_after(pictures: Sequence[Picture], methods: Iterable[str]) -> Picture | None:
    """Take the panels of the recommended method and of the first other one from a picture.

    Args:
        pictures: Pictures in their order; the first with a panel of the recommended method is used.
        methods: Names of the methods that process the data, in their order.

    Returns:
        The picture of one or two panels; the first picture if no method has a panel of its own, and
        None if nothing was drawn.
    """
    before = next((name for name in methods if name != "recommended"), "")
    for picture in pictures:
        # a panel may say more than the name of its method, after a comma
        files = {title.partition(",")[0]: f for title, f in zip(picture.panels, picture.files)}
        if "recommended" in files:
            chosen = [files[name] for name in dict.fromkeys((before, "recommended")) if name in files]
            return Picture(tuple(chosen), "Before and after", picture.caption)
    return next((picture for picture in pictures if picture.files), None)


def _drawn(make: Callable[[], Drawn]) -> Drawn:
    """Generate the pictures of one function. If it fails, the last picture contains the error as
    text.
    """
    try:
        yield from make()
    except OSError:  # errors of the disk
        raise
    except Exception as error:  # results are more important than their pictures
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        log.warning("warning: a picture could not be drawn (%s)", text)
        yield "failed", "a picture is missing", f"It could not be drawn ({text}). All numbers are in the tables.", None


def comparisons(results: Mapping[str, Any], columns: Mapping[str, Any], without: str = "ideal") -> Drawn:
    """Yield a picture of each metric over the cases, or over the methods if there is one case.

    A metric that is zero everywhere has no picture.

    Args:
        results: Results by case, with `metrics` by method and name.
        columns: Presentation of the metrics; those with `drawn` are drawn.
        without: The reference method, which is not drawn.
    """
    for key, column in columns.items():
        rows = {
            case: {n: m[key] for n, m in r.metrics.items() if key in m and n != without} for case, r in results.items()
        }
        names = list(dict.fromkeys(name for row in rows.values() for name in row))
        if not column.drawn or sum(map(len, rows.values())) < 2:
            continue

        def mean(values: Any, rms: bool = column.drawn == "rms") -> float:
            there = torch.empty(0) if values is None else values[torch.isfinite(values)]
            return float("nan") if not len(there) else float(there.square().mean().sqrt() if rms else there.mean())

        table = {name: np.array([mean(row.get(name)) for row in rows.values()]) for name in names}
        x, series = list(rows), table
        if len(x) == 1:
            x, series = names, {"": np.array([table[name][0] for name in names])}
        drawn = {name: (y, np.stack([y, y], -1)) for name, y in series.items()}
        known = np.concatenate([y[np.isfinite(y)] for y in series.values()])
        if not known.any():
            continue
        log = known.min() > 0 and (column.drawn == "rms" or known.max() > _DECADES * known.min())
        label = f"{column.label} ({column.unit})" if column.unit else column.label
        statistic = "Root mean square" if column.drawn == "rms" else "Mean"
        figures = plot.error_curves([{"title": "", "x": x, "series": drawn, "bounds": {}}], "", label, log_y=log)
        by = f"of the method '{names[0]}'" if len(names) == 1 else "by method"
        yield key, column.label, f"{statistic} over trials of the {label}, {by}.", figures


def first_named(images: Mapping[str, Signal], name: str = "ideal") -> dict[str, Signal]:
    """Return images by method, with that of the method `name` moved to the front if it exists."""
    front = {name: images[name]} if name in images else {}
    return {**front, **images}
