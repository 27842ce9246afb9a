"""The report of a sweep, one HTML file, and its pictures, both from the summary alone."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchsar import plot
from torchsar.core import Outcome
from torchsar.metrics.intervals import LEVEL
from torchsar.plot import axis_label, name_and_unit
from torchsar.study.montecarlo.summary import Summary
from torchsar.study.output.numbers import MISSING, number
from torchsar.study.output.progress import clock
from torchsar.study.output.report import Drawn, Picture, draw_all, write_page

# parts of `about` that are shown elsewhere in the report, or are too long for it
_NOT_SHOWN = ("title", "config", "identity", "earlier", "sessions", "chunk_rows")


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
    """Table of the outcomes of each algorithm at every point, if there are any."""
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
    """Table of all bounds, if there are any."""
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


# largest number of panels of a figure; more would be too small to read
PANELS = 6


def label_text(label: float | str) -> str:
    """Text of a value of a parameter, as in the results."""
    return label if isinstance(label, str) else f"{label:g}"


@dataclass(frozen=True)
class Quantity:
    """A statistic of a metric that is drawn, such as its RMSE.

    Args:
        metric: Name of the metric.
        field: Key of the statistic in `Summary.figures[metric]`, such as "rmse".
        interval: Key of the confidence interval of the statistic.
        title: Name of the statistic in titles.
        label: Name of the statistic with its unit, for axes.
        log: Whether the axis is logarithmic.
    """

    metric: str
    field: str
    interval: str
    title: str
    label: str
    log: bool = False

    @property
    def is_share(self) -> bool:
        return self.field.endswith("share")


def share(metric: str, name: str, title: str) -> Quantity:
    """Return a share of trials as a quantity without a unit."""
    return Quantity(metric, f"{name}_share", f"{name}_interval", title, title)


@dataclass(frozen=True)
class Panel:
    """One panel of a figure: a choice of values of the parameters that are not its axes.

    Args:
        title: These values as text.
        index: Index of the value of each parameter, by name.
    """

    title: str
    index: Mapping[str, int]


class SweepPictures:
    """Draws the pictures of a sweep.

    Args:
        summary: Statistics and bounds of the metrics of the sweep.
    """

    def __init__(self, summary: Summary) -> None:
        self.algorithms, self.labels = list(summary.algorithms), summary.labels
        self.figures, self.bounds = summary.figures, summary.bounds
        several = {name: labels for name, labels in self.labels.items() if len(labels) > 1}
        self.numeric = [name for name, labels in several.items() if not isinstance(labels[0], str)]
        self.worded = [name for name in several if name not in self.numeric]
        self.fixed = {name: 0 for name in self.labels if name not in several}

    def order(self, name: str) -> np.ndarray:
        """Return the indices that sort the values of a parameter; words keep their order."""
        labels = self.labels[name]
        return np.arange(len(labels)) if isinstance(labels[0], str) else np.argsort(np.asarray(labels, dtype=float))

    def sorted_labels(self, name: str) -> list[Any]:
        """Values of a parameter in the order in which they are drawn."""
        return [self.labels[name][i] for i in self.order(name)]

    def cut(self, array: np.ndarray, panel: Panel, over: str, lead: int = 1) -> np.ndarray:
        """Return the part of an array that a panel shows over one parameter.

        Args:
            array: Array of shape (..., *parameters, ...).
            panel: The panel, which fixes the values of the other parameters.
            over: Name of the parameter on the axis; empty if the panel fixes all parameters.
            lead: Number of dims before those of the parameters.

        Returns:
            Array of shape (..., value of `over`, ...), with sorted values; without this dim if
            `over` is empty.
        """
        index = tuple(self.order(name) if name == over else panel.index[name] for name in self.labels)
        return array[(slice(None),) * lead + index]

    def all(self, wanted: Sequence[str]) -> Drawn:
        """Yield the pictures of each metric (curves, share of successes, heat maps), and last the
        share of trials that the algorithms call reliable.
        """
        for metric in wanted:
            fields, (name, unit) = self.figures[metric], name_and_unit(metric)
            quantity = main_quantity(metric, bool(self.bounds.get(metric)))
            yield from self.curves(quantity)
            if "success_share" in fields:
                within = f"{np.nanmax(fields['success_limit']):g} {unit}".rstrip()
                title = f"share of trials trusted and within {within}: {name}"
                yield from self.curves(share(metric, "success", title))
            for x, y in itertools.combinations(self.numeric, 2):
                yield from self.heat_maps(quantity, x, y)
        if self.figures:
            yield from self.curves(share(next(iter(self.figures)), "ok", "share of trusted trials"))

    def curves(self, quantity: Quantity, axis: str = "") -> Drawn:
        """Yield curves over each parameter with at least two numeric values, or over a given one.

        Without such a parameter, the curves are over the non-numeric parameter with the most
        values, and if no parameter has several values, over the algorithms.
        """
        if not np.isfinite(self.values(quantity)).any():
            return
        longest = max(self.worded, key=lambda name: len(self.labels[name]), default="")
        ylim = (-0.04, 1.04) if quantity.is_share else None
        for over in [axis] if axis else self.numeric or [longest]:
            panels, note = self.panels_beside({over})
            name = quantity.field if quantity.field == "ok_share" else f"{quantity.metric}_{quantity.field}"
            along = over and f" over {name_and_unit(over)[0]}"
            for page, some in _paged(panels, PANELS):
                parts = [self.part(quantity, panel, over) for panel in some]
                x, logs = over and axis_label(over), (self.is_log(over), self.has_positive(quantity))
                figure = plot.error_curves(parts, x, quantity.label, *logs, ylim, band=f"{LEVEL:.0%} interval")
                end = over and f"_over_{over.rpartition('.')[2]}"
                yield name + end, quantity.title + along + page, self.caption(quantity) + note, figure

    def values(self, quantity: Quantity) -> np.ndarray:
        """Return the values that are drawn, (algorithm, *parameters)."""
        return self.figures[quantity.metric][quantity.field]

    def part(self, quantity: Quantity, panel: Panel, over: str) -> dict[str, Any]:
        """Return the data of a panel: one curve for each algorithm over the parameter `over`.

        If `over` is empty, it is one curve over the algorithms.
        """
        fields = self.figures[quantity.metric]
        y, interval = (self.cut(fields[name], panel, over) for name in (quantity.field, quantity.interval))
        bounds = self.bounds.get(quantity.metric, {}) if quantity.log else {}
        bounds = {name: self.cut(rms, panel, over, lead=0) for name, rms in bounds.items()}
        if not over:
            series = {quantity.title: (y, interval)}
            bounds = {name: np.full(len(y), rms) for name, rms in bounds.items()}
            return {"title": "", "x": self.algorithms, "series": series, "bounds": bounds}
        x = self.sorted_labels(over) if over in self.worded else np.asarray(self.sorted_labels(over), dtype=float)
        series = {name: (y[i], interval[i]) for i, name in enumerate(self.algorithms)}
        return {"title": panel.title, "x": x, "series": series, "bounds": bounds}

    def has_positive(self, quantity: Quantity) -> bool:
        """Return whether the axis is logarithmic and at least one value is positive."""
        return quantity.log and bool((self.values(quantity) > 0).any())

    def is_log(self, over: str) -> bool:
        """Return whether the axis of a parameter is logarithmic.

        It is logarithmic if all values are positive, span at least two decades and are not in dB.
        """
        if over not in self.numeric or over.endswith("_db"):
            return False
        values = np.asarray(self.labels[over], dtype=float)
        return bool((values > 0).all() and values.max() >= 100 * values.min())

    def panels_beside(self, over: Collection[str]) -> tuple[list[Panel], str]:
        """Return a panel for each combination of values of the parameters that are not axes.

        If these are more than six panels, numeric parameters are reduced to their first, middle and
        last values; if that is not enough, to the first and last, or to the middle one.

        Args:
            over: Names of the parameters that are axes.

        Returns:
            The panels, and sentences about values that are left out and parameters with one value.
        """
        others = [name for name in (*self.worded, *self.numeric) if name not in over]
        chosen, positions = {}, []
        for pick in (lambda n: range(n), lambda n: [0, n // 2, n - 1], lambda n: [0, n - 1], lambda n: [n // 2]):
            thin = {name: dict.fromkeys(pick(len(self.labels[name]))) for name in others if name in self.numeric}
            chosen = {name: self.order(name)[list(thin[name])] if name in thin else self.order(name) for name in others}
            positions = [dict(zip(others, map(int, index))) for index in itertools.product(*chosen.values())]
            if len(positions) <= PANELS:
                break
        panels = [Panel(self._texts(position), self.fixed | position) for position in positions]
        thinned = (
            f" Of {len(self.labels[n])} values of {name_and_unit(n)[0]} this shows "
            f"{', '.join(f'{self.labels[n][i]:g}' for i in shown)}; the table holds all."
            for n, shown in chosen.items()
            if len(shown) < len(self.labels[n])
        )
        return panels, "".join(thinned) + (f" Throughout: {self._texts(self.fixed)}." if self.fixed else "")

    def _texts(self, index: Mapping[str, int]) -> str:
        """Values of parameters as text for readers, such as 'squint 3 deg, scene: point'."""
        known = [(*name_and_unit(name), self.labels[name][i]) for name, i in index.items()]
        texts = (
            f"{words}: {x}" if isinstance(x, str) else f"{words} {x:g} {unit}".rstrip() for words, unit, x in known
        )
        return ", ".join(texts)

    def caption(self, quantity: Quantity) -> str:
        """Return a caption with what is drawn, the confidence level and the number of trials."""
        trials = self.trials(quantity.metric)
        if quantity.is_share:
            more = ", right or wrong" if quantity.field == "ok_share" else "; within: the error is at most the limit"
            return (
                f"Share of {trials}, with exact {LEVEL:.0%} intervals. "
                f"Trusted: the algorithm itself calls its estimate reliable (ok){more}."
            )
        sentences = {
            f"{_capital(quantity.title)} over {trials}, reliable or not, with {LEVEL:.0%} intervals.": True,
            "Lower is better.": quantity.field != "median",
            "Zeros cannot be shown on the logarithmic axis.": (
                self.has_positive(quantity) and (self.values(quantity) == 0).any()
            ),
            "Dark lines are bounds: a curve that lies on one cannot be improved without bias, and where it departs "
            "from it is the threshold of the algorithm.": quantity.log and self.bounds.get(quantity.metric),
        }
        return " ".join(text for text, applies in sentences.items() if applies)

    def trials(self, metric: str) -> str:
        """Number of trials per point, or its range."""
        done = self.figures[metric]["trials"]
        few, many = int(done.min()), int(done.max())
        return f"{many} trials a point" if few == many else f"{few} to {many} trials a point"

    def heat_maps(self, quantity: Quantity, x: str, y: str) -> Drawn:
        """Yield heat maps of a statistic over the parameters `x` and `y`, on one colour scale.

        There is a panel for each algorithm and each combination of the other parameters.
        """
        values, log = self.values(quantity), self.has_positive(quantity)
        known = values[np.isfinite(values) & ((values > 0) | (not log))]
        if not known.size:
            return
        panels, note = self.panels_beside({x, y})
        caption = (
            f"{_capital(quantity.title)} over {self.trials(quantity.metric)}, all panels on one"
            f"{' logarithmic' if log else ''} colour scale, dark for small.{note}"
        )
        scale = (float(known.min()), float(known.max()))
        name = f"{quantity.metric}_map_{x.rpartition('.')[2]}_{y.rpartition('.')[2]}"
        for page, some in _paged(panels, max(1, PANELS // len(self.algorithms))):
            parts = [self.map_part(values[i], p, x, y, name) for p in some for i, name in enumerate(self.algorithms)]
            figure = plot.heat_map(parts, axis_label(x), axis_label(y), quantity.label, log, scale)
            yield name, f"{quantity.title} over {name_and_unit(x)[0]} and {name_and_unit(y)[0]}{page}", caption, figure

    def map_part(self, values: np.ndarray, panel: Panel, x: str, y: str, algorithm: str) -> dict[str, Any]:
        """Return one panel of a heat map, for the values (*parameters) of one algorithm."""
        names = list(self.labels)
        z = np.moveaxis(values, (names.index(y), names.index(x)), (0, 1))
        z = z[(slice(None), slice(None), *(panel.index[name] for name in names if name not in (x, y)))]
        title = f"{algorithm}; {panel.title}" if panel.title else algorithm
        z = z[np.ix_(self.order(y), self.order(x))]
        return {"title": title, "x": self.sorted_labels(x), "y": self.sorted_labels(y), "z": z}


def main_quantity(metric: str, bounded: bool = False) -> Quantity:
    """Return the statistic of a metric that is drawn, with its kind of axis.

    For an error, a metric with "error" in its name, it is the RMSE on a logarithmic axis. For any
    other metric, and for errors in dB, it is the median.

    Args:
        metric: Name of the metric.
        bounded: Whether the metric has lower bounds. The axis of a median is then logarithmic.
    """
    name, label = name_and_unit(metric)[0], axis_label(metric)
    if "error" in metric and not metric.endswith("_db"):
        return Quantity(metric, "rmse", "interval", f"RMSE of {name}", f"RMSE of {label}", log=True)
    return Quantity(metric, "median", "median_interval", f"median of {name}", f"median of {label}", log=bounded)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _paged(panels: Sequence[Panel], size: int) -> Iterator[tuple[str, Sequence[Panel]]]:
    """Generate the panels of each page, with the end of the title of the page."""
    count = -(-len(panels) // size)
    for page in range(count):
        yield f" ({page + 1} of {count})" if count > 1 else "", panels[page * size : (page + 1) * size]


def draw_sweep(summary: Summary, folder: Path, show: Sequence[str] = ()) -> list[Picture]:
    """Draw the pictures of a sweep, and write them as PNG files in a new folder.

    Args:
        summary: Statistics and bounds of the metrics of the sweep.
        folder: The folder.
        show: Names of the metrics that are drawn, in this order. If empty, these are the metrics
            with "error" in their names, or all metrics if there are none.

    Returns:
        The pictures, in the order of the report.
    """
    wanted = show or [metric for metric in summary.figures if "error" in metric] or list(summary.figures)
    return draw_all([lambda: SweepPictures(summary).all(wanted)], folder)
