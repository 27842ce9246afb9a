"""The pictures of a sweep, drawn from its summary alone."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchsar import plot
from torchsar.study.montecarlo.statistics import LEVEL
from torchsar.study.output.numbers import name_and_unit
from torchsar.study.output.pictures import Drawn, Picture, draw_all

PANELS = 6


def axis_label(name: str) -> str:
    """'doppler_error_hz' -> 'doppler error (Hz)'."""
    words, unit = name_and_unit(name)
    return f"{words} ({unit})" if unit else words


def value_label(name: str, label: float | str) -> str:
    """One value of a parameter, for reading: 'squint 3 deg', 'scene: point'."""
    words, unit = name_and_unit(name)
    return f"{words}: {label}" if isinstance(label, str) else f"{words} {label:g} {unit}".rstrip()


@dataclass(frozen=True)
class Quantity:
    """What is drawn of a metric: a field of the summary and the field of its interval."""

    metric: str
    field: str
    interval: str
    words: str
    log: bool = False

    @property
    def label(self) -> str:
        return self.words + axis_label(self.metric) if not self.field.endswith("share") else self.words

    @property
    def title(self) -> str:
        return self.words + name_and_unit(self.metric)[0] if not self.field.endswith("share") else self.words


def main_quantity(metric: str, bounded: bool = False) -> Quantity:
    """RMSE on a logarithmic axis for errors about zero; the median of everything else, errors that
    are ratios in dB among them.

    bounded: whether the metric has bounds, which make a logarithmic axis of their own right.
    """
    if "error" in metric and not metric.endswith("_db"):
        return Quantity(metric, "rmse", "interval", "RMSE of ", log=True)
    return Quantity(metric, "median", "median_interval", "median of ", log=bounded)


@dataclass(frozen=True)
class Panel:
    """One place along the parameters that are not axes of a figure: its title and index by
    parameter.
    """

    title: str
    index: Mapping[str, int]


@dataclass(frozen=True)
class Cube:
    """A summary as arrays.

    figures: metric -> field -> (algorithm, *parameters, ...); bounds: metric -> name ->
    (*parameters).
    """

    algorithms: list[str]
    labels: dict[str, list[float | str]]
    figures: dict[str, dict[str, np.ndarray]]
    bounds: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    @property
    def numeric(self) -> list[str]:
        """Parameters with two numbers or more."""
        return [name for name, labels in self.labels.items() if len(labels) > 1 and not isinstance(labels[0], str)]

    @property
    def worded(self) -> list[str]:
        """Parameters with two words or more."""
        return [name for name, labels in self.labels.items() if len(labels) > 1 and isinstance(labels[0], str)]

    def order(self, name: str) -> np.ndarray:
        """Indices that sort a parameter's numbers; words stay as they are."""
        labels = self.labels[name]
        return np.arange(len(labels)) if isinstance(labels[0], str) else np.argsort(np.asarray(labels, dtype=float))

    def cut(self, array: np.ndarray, panel: Panel, over: str, lead: int = 1) -> np.ndarray:
        """Along one sorted parameter, the others at the panel's place.

        lead: dims before the parameters.
        """
        place = tuple(self.order(name) if name == over else panel.index[name] for name in self.labels)
        return array[(slice(None),) * lead + place]


def read_summary(summary: Mapping[str, Any]) -> Cube:
    """The arrays of a summary, made by `summary_tree` or read from its file."""
    labels = {name: list(values) for name, values in summary["parameters"].items()}
    algorithms, shape = list(summary["algorithms"]), tuple(len(values) for values in labels.values())
    cube = Cube(algorithms, labels, {})
    for point in summary["points"]:
        at = (algorithms.index(point["algorithm"]), *_index(labels, point["parameters"]))
        fields = cube.figures.setdefault(point["metric"], {})
        for name, value in point.items():
            if name not in ("algorithm", "parameters", "metric"):
                number = np.array(value, dtype=np.float64)
                fields.setdefault(name, np.full((len(algorithms), *shape, *number.shape), np.nan))[at] = number
    for bound in summary["bounds"]:
        known = cube.bounds.setdefault(bound["metric"], {})
        known.setdefault(bound["bound"], np.full(shape, np.nan))[_index(labels, bound["parameters"])] = np.array(
            bound["rms"], dtype=np.float64
        )
    return cube


def _index(labels: Mapping[str, list[float | str]], parameters: Mapping[str, float | str]) -> tuple[int, ...]:
    return tuple(values.index(parameters[name]) for name, values in labels.items())


def draw_sweep(summary: Mapping[str, Any], folder: Path, show: Sequence[str] = ()) -> list[Picture]:
    """The pictures of a sweep as PNG files in the folder (made if need be), in the order of
    reading.

    show: the metrics to draw, in this order; by default the errors, and where nothing is called an
    error everything that was measured.
    """
    cube = read_summary(summary)
    wanted = show or [metric for metric in cube.figures if "error" in metric] or list(cube.figures)
    return draw_all([partial(_all, cube, wanted)], folder)


def _all(cube: Cube, wanted: Sequence[str]) -> Drawn:
    """Of each metric its curves, its success and its heat maps; last what the algorithms trust."""
    for metric in wanted:
        fields = cube.figures[metric]
        quantity = main_quantity(metric, bool(cube.bounds.get(metric)))
        yield from _curves(cube, quantity)
        if "success_share" in fields:
            limit = np.nanmax(fields["success_limit"])
            words = (
                f"share of trials trusted and within {limit:g} {name_and_unit(metric)[1]}: {name_and_unit(metric)[0]}"
            )
            yield from _curves(cube, Quantity(metric, "success_share", "success_interval", words))
        for x, y in itertools.combinations(cube.numeric, 2):
            yield from _heat_maps(cube, quantity, x, y)
    if cube.figures:
        yield from _curves(
            cube, Quantity(next(iter(cube.figures)), "ok_share", "ok_interval", "share of trusted trials")
        )


# --- curves
# --------------------------------------------------------------------------------------------------


def _curves(cube: Cube, quantity: Quantity) -> Drawn:
    """Over every parameter with two numbers or more; without any, over the one with the
    most words.
    """
    values = cube.figures[quantity.metric][quantity.field]
    if not np.isfinite(values).any():
        return
    longest = max(cube.worded, key=lambda name: len(cube.labels[name]), default=None)
    for over in cube.numeric or [longest]:
        panels, note = panels_beside(cube, {over})
        pages = [panels[i : i + PANELS] for i in range(0, len(panels), PANELS)]
        for page, some in enumerate(pages, 1):
            name = quantity.field if quantity.field == "ok_share" else f"{quantity.metric}_{quantity.field}"
            name += f"_over_{over.rpartition('.')[2]}" if over else ""
            title = (
                quantity.title
                + (f" over {name_and_unit(over)[0]}" if over else "")
                + (f" ({page} of {len(pages)})" if len(pages) > 1 else "")
            )
            yield name, title, _caption(cube, quantity) + note, _curve_figure(cube, quantity, over, some)


def _curve_figure(cube: Cube, quantity: Quantity, over: str | None, panels: list[Panel]) -> Any:
    log_y = quantity.log and _has_positive(cube, quantity)
    ylim = (-0.04, 1.04) if quantity.field.endswith("share") else None
    make = _part_over_algorithms if over is None else _part
    parts = [make(cube, quantity, panel, over or "") for panel in panels]
    return plot.error_curves(
        parts, axis_label(over) if over else "", quantity.label, _is_logarithmic(cube, over), log_y, ylim
    )


def _part(cube: Cube, quantity: Quantity, panel: Panel, over: str) -> dict[str, Any]:
    """Every algorithm along one parameter."""
    fields = cube.figures[quantity.metric]
    y, interval = (cube.cut(fields[name], panel, over) for name in (quantity.field, quantity.interval))
    bounds = cube.bounds.get(quantity.metric, {}) if quantity.log else {}
    labels = [cube.labels[over][i] for i in cube.order(over)]
    return {
        "title": panel.title,
        "x": labels if isinstance(labels[0], str) else np.asarray(labels, dtype=float),
        "series": {name: (y[i], interval[i]) for i, name in enumerate(cube.algorithms)},
        "bounds": {name: cube.cut(values, panel, over, lead=0) for name, values in bounds.items()},
    }


def _part_over_algorithms(cube: Cube, quantity: Quantity, panel: Panel, over: str) -> dict[str, Any]:
    """The algorithms side by side, for a sweep of one place."""
    place = (slice(None), *(panel.index[name] for name in cube.labels))
    y, interval = (cube.figures[quantity.metric][name][place] for name in (quantity.field, quantity.interval))
    bounds = cube.bounds.get(quantity.metric, {}) if quantity.log else {}
    return {
        "title": "",
        "x": cube.algorithms,
        "series": {quantity.title: (y, interval)},
        "bounds": {name: np.full(len(y), values[place[1:]]) for name, values in bounds.items()},
    }


def _has_positive(cube: Cube, quantity: Quantity) -> bool:
    return bool((cube.figures[quantity.metric][quantity.field] > 0).any())


def _is_logarithmic(cube: Cube, over: str | None) -> bool:
    """Positive numbers over two decades and more, unless they are logarithms themselves."""
    if over not in cube.numeric or over.endswith("_db"):
        return False
    values = np.asarray(cube.labels[over], dtype=float)
    return bool((values > 0).all() and values.max() >= 100 * values.min())


def panels_beside(cube: Cube, over: set[Any]) -> tuple[list[Panel], str]:
    """A panel for every place along the other parameters, words first, and a sentence on what is
    left out or fixed.

    Beyond six panels each other parameter of numbers shows its first, middle and last value, then
    first and last, then the middle one.
    """
    others = [name for name in (*cube.worded, *cube.numeric) if name not in over]
    fixed = {name: 0 for name, labels in cube.labels.items() if len(labels) == 1}
    for keep in (10**9, 3, 2, 1):
        chosen = {name: _some(cube.order(name), keep if name in cube.numeric else 10**9) for name in others}
        places = [dict(zip(others, index, strict=True)) for index in itertools.product(*chosen.values())]
        if len(places) <= PANELS:
            break
    panels = [
        Panel(", ".join(value_label(name, cube.labels[name][i]) for name, i in place.items()), fixed | place)
        for place in places
    ]
    return panels, _left_out(cube, chosen) + _held(cube, fixed)


def _some(indices: np.ndarray, keep: int) -> list[int]:
    """First, middle and last of them (3), first and last (2), the middle one (1), or all."""
    if keep >= len(indices):
        return indices.tolist()
    picks = {3: [0, len(indices) // 2, -1], 2: [0, -1], 1: [len(indices) // 2]}
    return [int(indices[i]) for i in picks[keep]]


def _left_out(cube: Cube, chosen: Mapping[str, list[int]]) -> str:
    thinned = [name for name, shown in chosen.items() if len(shown) < len(cube.labels[name])]
    sentences = (
        f" Of {len(cube.labels[n])} values of {name_and_unit(n)[0]} this shows "
        f"{', '.join(f'{cube.labels[n][i]:g}' for i in chosen[n])}; the table holds all."
        for n in thinned
    )
    return "".join(sentences)


def _held(cube: Cube, fixed: Mapping[str, int]) -> str:
    return f" Throughout: {', '.join(value_label(name, cube.labels[name][0]) for name in fixed)}." if fixed else ""


def _caption(cube: Cube, quantity: Quantity) -> str:
    """What a reader should see, the interval's level and the number of trials."""
    trials = _trials(cube, quantity.metric)
    if quantity.field.endswith("share"):
        success = (
            " Success means trusted by the algorithm and within the limit."
            if quantity.field == "success_share"
            else " Trusted is what the algorithm itself says of a trial, right or wrong."
        )
        return f"Share of {trials}, with exact {LEVEL:.0%} intervals.{success}"
    below = "" if quantity.field == "median" else " Lower is better."
    bounds = (
        " Dark lines are bounds: a curve that lies on one cannot be improved without bias, "
        "and where it departs from it the algorithm has its threshold."
    )
    has_bounds = quantity.log and bool(cube.bounds.get(quantity.metric))
    some_zero = (
        quantity.log
        and _has_positive(cube, quantity)
        and bool((cube.figures[quantity.metric][quantity.field] == 0).any())
    )
    zeros = " Zeros have no place on the logarithmic axis." if some_zero else ""
    return (
        f"{quantity.title[:1].upper() + quantity.title[1:]} over {trials}, trusted or not, "
        f"with {LEVEL:.0%} intervals.{below}{zeros}{bounds if has_bounds else ''}"
    )


def _trials(cube: Cube, metric: str) -> str:
    done = cube.figures[metric]["trials"]
    few, many = int(done.min()), int(done.max())
    return f"{many} trials a point" if few == many else f"{few} to {many} trials a point"


# --- heat maps
# --------------------------------------------------------------------------------------------------


def _heat_maps(cube: Cube, quantity: Quantity, x: str, y: str) -> Drawn:
    """One panel an algorithm and place along the other parameters; all pages share one colour
    scale.
    """
    values = cube.figures[quantity.metric][quantity.field]
    log = quantity.log and _has_positive(cube, quantity)
    known = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not known.size:
        return
    panels, note = panels_beside(cube, {x, y})
    per_page = max(1, PANELS // len(cube.algorithms))
    pages = [panels[i : i + per_page] for i in range(0, len(panels), per_page)]
    for page, some in enumerate(pages, 1):
        parts = [
            _heat_part(cube, values[i], panel, x, y, name) for panel in some for i, name in enumerate(cube.algorithms)
        ]
        title = f"{quantity.title} over {name_and_unit(x)[0]} and {name_and_unit(y)[0]}" + (
            f" ({page} of {len(pages)})" if len(pages) > 1 else ""
        )
        caption = (
            f"{quantity.title[:1].upper() + quantity.title[1:]} over "
            f"{_trials(cube, quantity.metric)}, all panels on one{' logarithmic' if log else ''} "
            f"colour scale, dark for small.{note}"
        )
        figure = plot.heat_map(
            parts, axis_label(x), axis_label(y), quantity.label, log, (float(known.min()), float(known.max()))
        )
        yield f"{quantity.metric}_map_{x.rpartition('.')[2]}_{y.rpartition('.')[2]}", title, caption, figure


def _heat_part(cube: Cube, values: np.ndarray, panel: Panel, x: str, y: str, algorithm: str) -> dict[str, Any]:
    """values: (*parameters)."""
    names = list(cube.labels)
    z = np.moveaxis(values, (names.index(y), names.index(x)), (0, 1))
    z = z[(slice(None), slice(None), *(panel.index[name] for name in names if name not in (x, y)))][
        np.ix_(cube.order(y), cube.order(x))
    ]
    sorted_labels = {name: [cube.labels[name][i] for i in cube.order(name)] for name in (x, y)}
    return {
        "title": f"{algorithm}; {panel.title}" if panel.title else algorithm,
        "x": sorted_labels[x],
        "y": sorted_labels[y],
        "z": z,
    }
