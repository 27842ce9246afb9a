"""Figures of curves, of scatterers, and of alternatives by time and loss."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchsar.plot.style import (
    ALONE,
    BELOW,
    COLOURS,
    ELONGATED,
    HIGHEST,
    INK,
    MARKERS,
    SECOND,
    legend_below,
    new_figure,
    panel_width,
    styled,
    wrapped_title,
)


def alike(curves: Mapping[str, tuple[Any, Tensor]], largest: int = 4) -> list[dict[str, tuple[Any, Tensor]]]:
    """Group curves by magnitude, so that all curves of a group can be seen in one panel.

    The largest absolute values of the curves of a group differ by less than a factor of 10.

    Args:
        curves: Curves (x, y) by name; y, shape (n,), may have NaN.
        largest: Largest number of curves in a group.

    Returns:
        Groups of curves, those of the smallest values first; within a group the curve of the
        largest values is first.
    """
    size = {name: float(torch.nan_to_num(y).abs().max()) for name, (_, y) in curves.items()}
    groups: list[list[str]] = []
    for name in sorted(size, key=lambda name: size[name]):
        if groups and len(groups[-1]) < largest and size[name] < 10 * max(size[groups[-1][0]], 1e-300):
            groups[-1].append(name)
        else:
            groups.append([name])
    return [{name: curves[name] for name in reversed(group)} for group in groups]


@styled
def curves(
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    marks: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
    xlim: tuple[float, float] | None = None,
) -> Figure:
    """Draw curves into one panel.

    The first curve is the widest, so that it stays visible under others.

    Args:
        series: Curves (x, y) by name, each a pair of arrays of shape (n,).
        xlabel: Label of the horizontal axis, with unit.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the panel.
        marks: Positions of vertical lines by name, in the unit of x.
        ylim: Limits of the vertical axis.
        xlim: Limits of the horizontal axis.

    Returns:
        The figure.
    """
    return curves_of(ALONE, series, xlabel, ylabel, title, marks, ylim, xlim)


def curves_of(
    width: float,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    marks: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
    xlim: tuple[float, float] | None = None,
) -> Figure:
    """Draw curves into a new figure.

    Args:
        width: Width of the figure in inches.
        series: Horizontal and vertical values of each curve, by its name.
        xlabel: Label of the horizontal axis.
        ylabel: Label of the vertical axis.
        title: Title.
        marks: Places of vertical lines, by their names.
        ylim: Limits of the vertical axis.
        xlim: Limits of the horizontal axis.

    Returns:
        The figure.
    """
    figure, axes = new_figure(width, 0.68 * width)
    for i, (name, (x, y)) in enumerate(series.items()):
        axes.plot(
            x,
            y,
            label=name,
            color=COLOURS[i % len(COLOURS)],
            linewidth=max(0.9, 2.0 - 0.45 * i) if len(series) > 1 else 1.2,
        )
    for i, (name, position) in enumerate((marks or {}).items()):
        axes.axvline(position, color=COLOURS[(len(series) + i) % len(COLOURS)], linestyle="--", linewidth=1, label=name)
    axes.set(xlabel=xlabel, ylabel=textwrap.fill(ylabel, round(7 * width)), title=wrapped_title(title, width))
    if ylim is not None:
        axes.set_ylim(*ylim)
    if xlim is not None:
        axes.set_xlim(*xlim)
    legend_below(figure, axes)
    return figure


@styled
def scatterers(
    x: np.ndarray,
    y: np.ndarray,
    size: np.ndarray,
    xlabel: str,
    ylabel: str,
    title: str = "",
    aspect: Literal["equal", "auto"] = "equal",
) -> Figure:
    """Draw the point scatterers of a scene at their positions.

    With one scale on both axes, each axis shows at least a quarter of the extent of the other, even
    if the points hardly differ along it.

    Args:
        x: Horizontal positions, shape (n,).
        y: Vertical positions, shape (n,).
        size: Relative areas of the points, shape (n,).
        xlabel: Label of the horizontal axis, with unit.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the figure.
        aspect: "equal" for one scale on both axes, "auto" otherwise.

    Returns:
        The figure.
    """
    ratio = float(np.ptp(y)) / max(float(np.ptp(x)), 1e-300) if aspect == "equal" else 0.8
    ratio = min(max(ratio, 1 / ELONGATED), ELONGATED)
    height = min(max((ALONE - 0.9) * ratio, 1.2), HIGHEST) + BELOW
    figure, axes = new_figure(ALONE, height, aspect == "equal")
    largest = 14 if len(x) > 20 else 40  # the points of a scene with many points are small
    axes.scatter(x, y, s=largest * size / max(float(size.max()), 1e-300), color=COLOURS[0], linewidths=0)
    if aspect == "equal":
        middle = np.array([[x.min() + x.max(), y.min() + y.max()]]) / 2
        reach = 0.5 * max(float(np.ptp(x)), float(np.ptp(y))) / ELONGATED
        axes.update_datalim(np.concatenate([middle - reach, middle + reach]))
    axes.margins(0.08)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title, aspect=aspect)
    return figure


@styled
def panels(parts: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Draw several panels of curves, each into a figure of its own.

    Args:
        parts: One mapping for each panel, with the arguments of `curves`.

    Returns:
        The figures, one for each part.
    """
    return [curves_of(panel_width(len(parts)), **part) for part in parts]


@styled
def marks(names: Sequence[str], series: Mapping[str, np.ndarray], xlabel: str, title: str = "") -> Figure:
    """Draw values with their intervals, one line of the panel for each name.

    Args:
        names: Names of the lines, from top to bottom.
        series: Values with the lower and the upper ends of their intervals, shape (name, 3), by
            what they are; NaN is not drawn.
        xlabel: Label of the horizontal axis.
        title: Title of the figure.

    Returns:
        The figure.
    """
    title = wrapped_title(title, 0.7 * ALONE)
    figure, axes = new_figure(ALONE, 0.9 + 0.24 * len(names) + 0.2 * title.count("\n"))
    for i, (label, rows) in enumerate(series.items()):
        at = -np.arange(len(names)) + 0.12 * (0.5 * (len(series) - 1) - i)
        value, *ends = rows.T
        reach = np.abs(np.stack(ends) - value)
        axes.errorbar(value, at, xerr=reach, fmt=MARKERS[i], color=COLOURS[i], markersize=4, linewidth=1, label=label)
    axes.set(yticks=-np.arange(len(names)), yticklabels=names, xlabel=xlabel, title=title)
    legend_below(figure, axes)
    return figure


@styled
def trade(
    names: Sequence[str],
    seconds: Sequence[float],
    loss: Sequence[float],
    ylabel: str,
    title: str,
    tolerance: float | None = None,
) -> Figure:
    """Draw the loss of accuracy of alternative methods over their computing time.

    Each alternative is a numbered point, with its name in the legend below the axes. Points
    for which no faster alternative has an equal or smaller loss form the Pareto front; they are
    filled and joined by a step line.

    Args:
        names: Names of the alternatives.
        seconds: Computing time of each alternative, in seconds.
        loss: Loss of each alternative, in the unit of `ylabel`; less is better.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the figure.
        tolerance: Largest acceptable loss, drawn as a dashed line.

    Returns:
        The figure.
    """
    figure, axes = new_figure(ALONE, 3.6)
    points = sorted(zip(seconds, loss, strict=True))
    front = [(s, e) for i, (s, e) in enumerate(points) if all(e < other for _, other in points[:i])]
    axes.set(xscale="log", xlabel="time (s)", ylabel=ylabel, title=title)
    for i, (name, s, e) in enumerate(zip(names, seconds, loss, strict=True), 1):
        colour = COLOURS[(i - 1) % len(COLOURS)]
        filled = colour if (s, e) in front else "white"
        axes.plot([s], [e], "o", color=colour, markerfacecolor=filled, markersize=7, label=f"{i}  {name}")
    axes.margins(0.12)
    low, high = (math.log10(x) for x in (points[0][0], points[-1][0]))
    # margin in decades, at least 0.3, so that ticks at 1, 2 and 5 appear
    margin = max(0.12 * (high - low), 0.3)
    low, high = low - margin, high + margin
    axes.step(
        [s for s, _ in front] + [10**high], [e for _, e in front] + [front[-1][1]], where="post", color=INK, zorder=0
    )
    if tolerance is not None:
        axes.axhline(tolerance, color=SECOND, linestyle="--", zorder=0, label="tolerance")
    bottom, top = axes.get_ylim()
    _number_points(
        axes, [((math.log10(s) - low) / (high - low), (e - bottom) / (top - bottom)) for s, e in zip(seconds, loss)]
    )
    axes.set(xlim=(10**low, 10**high), ylim=(bottom, top))
    legend_below(figure, axes)
    return figure


def _number_points(axes: Axes, points: Sequence[tuple[float, float]]) -> None:
    """Write the number of every point beside it, without overlap with other points and numbers.

    Args:
        axes: Axes of a figure of one panel.
        points: Positions in shares of the axes.
    """
    # approximate size of the panel in points of 1/72 inch
    size = np.array([72 * 0.8 * ALONE, 72 * 0.75 * 3.6])
    at = [np.array(point) * size for point in points]
    # directions from a point in which its number may be written
    around = ((1, 0.6), (-1, 0.6), (1, -0.6), (-1, -0.6), (0, 1.1), (0, -1.1), (1.2, 0), (-1.2, 0))
    taken = list(at)
    for i, point in enumerate(at, 1):
        beside = [np.array([9.0 * ring * x, 9.0 * ring * y]) for ring in (1, 2, 3, 4) for x, y in around]
        # nearest free position, or the last position if none is free
        offset = next((o for o in beside if all(np.hypot(*(point + o - t)) > 8.5 for t in taken)), beside[-1])
        taken.append(point + offset)
        axes.annotate(
            str(i),
            points[i - 1],
            xycoords="axes fraction",
            textcoords="offset points",
            xytext=tuple(offset),
            fontsize=8,
            color=INK,
            ha="center",
            va="center",
        )
