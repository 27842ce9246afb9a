"""Figures of sweeps: errors over one parameter, and values over two parameters."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from torchsar.plot.style import (
    COLOURS,
    DASHES,
    FAINT,
    INK,
    MARKERS,
    legend_below,
    new_figure,
    panel_width,
    styled,
    wrapped_title,
)


@styled
def error_curves(
    parts: Sequence[Mapping[str, Any]],
    xlabel: str,
    ylabel: str,
    log_x: bool = False,
    log_y: bool = False,
    ylim: tuple[float, float] | None = None,
    band: str = "",
) -> list[Figure]:
    """Draw the errors of algorithms, with their confidence intervals, over one parameter.

    If the values of the parameter are numbers, lines with bands are drawn; if they are words, dots
    with bars. All panels have the same vertical scale. Values that are not finite, or not positive
    on a logarithmic axis, are left out, and so are panels without any value.

    Args:
        parts: One mapping for each panel, with the keys `title`; `x`, the n values of the
            parameter, numbers or words; `series`, a mapping from names to pairs of errors (n,) and
            intervals (n, 2); and `bounds`, a mapping from names to values (n,), such as lower
            bounds, drawn dark and dashed.
        xlabel: Label of the horizontal axes, with unit.
        ylabel: Label of the vertical axes, with unit.
        log_x: Whether the horizontal axes are logarithmic.
        log_y: Whether the vertical axes are logarithmic.
        ylim: Limits of the vertical axes.
        band: Name of the intervals in the legends; they are not named by default.

    Returns:
        The figures, one for each part that has values.
    """
    filled = [part for part in parts if any(np.isfinite(_drawable(y, log_y)).any() for y, _ in part["series"].values())]
    figures, width = [], panel_width(len(filled))
    for part in filled:
        figure, axes = new_figure(width, 0.62 * width)
        draw = _draw_dots if any(isinstance(x, str) for x in part["x"]) else _draw_bands
        draw(axes, part["x"], part["series"], part["bounds"], log_y)
        axes.set_yscale("log" if log_y else "linear")
        axes.set(
            xlabel=xlabel, ylabel=textwrap.fill(ylabel, round(7 * width)), title=wrapped_title(part["title"], width)
        )
        figures.append(figure)
    ends = [figure.axes[0].get_ylim() for figure in figures]
    common = ylim or (min((low for low, _ in ends), default=0.0), max((high for _, high in ends), default=1.0))
    for figure in figures:
        if band:
            figure.axes[0].fill_between([], [], color=FAINT, alpha=0.4, linewidth=0, label=band)
        _scale_axes(figure.axes[0], np.asarray(filled[0]["x"]), log_x, common)
        legend_below(figure, figure.axes[0])
    return figures


def _drawable(y: Any, log: bool) -> np.ndarray:
    """Values in float64, with NaN where the axis cannot show them."""
    y = np.asarray(y, dtype=np.float64)
    return np.where(np.isfinite(y) & ((y > 0) | (not log)), y, np.nan)


def _draw_bands(
    axes: Axes,
    x: np.ndarray,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    bounds: Mapping[str, np.ndarray],
    log: bool,
) -> None:
    """Draw lines with bands for the confidence intervals, and dashed lines for the bounds."""
    for i, (name, (y, interval)) in enumerate(series.items()):
        low, high = np.moveaxis(_drawable(interval, log), -1, 0)
        colour, line = COLOURS[i % len(COLOURS)], "-" if i < len(COLOURS) else (0, (6, 2))
        axes.fill_between(x, low, high, color=colour, alpha=0.18 if len(series) < 5 else 0.1, linewidth=0)
        axes.plot(
            x,
            _drawable(y, log),
            color=colour,
            linestyle=line,
            marker=MARKERS[i % len(MARKERS)],
            markersize=3.5,
            label=name if np.isfinite(_drawable(y, log)).any() else "_",
        )
    for i, (name, y) in enumerate(bounds.items()):
        axes.plot(x, _drawable(y, log), color=INK, linestyle=DASHES[i % len(DASHES)], linewidth=1.1, label=name)


def _draw_dots(
    axes: Axes,
    x: Sequence[str],
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    bounds: Mapping[str, np.ndarray],
    log: bool,
) -> None:
    """Draw dots with bars for the confidence intervals at words, and dashed lines for the
    bounds.
    """
    step = min(0.16, 0.6 / len(series))
    for i, (name, (y, interval)) in enumerate(series.items()):
        position = np.arange(len(x)) + (i - (len(series) - 1) / 2) * step
        low, high = np.moveaxis(_drawable(interval, log), -1, 0)
        axes.vlines(position, low, high, color=COLOURS[i % len(COLOURS)], linewidth=1.6, alpha=0.6)
        axes.plot(
            position,
            _drawable(y, log),
            color=COLOURS[i % len(COLOURS)],
            marker=MARKERS[i % len(MARKERS)],
            markersize=5,
            linestyle="none",
            label=name,
        )
    for i, (name, y) in enumerate(bounds.items()):
        axes.hlines(
            _drawable(y, log),
            np.arange(len(x)) - 0.4,
            np.arange(len(x)) + 0.4,
            color=INK,
            linestyle=DASHES[i % len(DASHES)],
            linewidth=1.1,
            label=name,
        )
    _label_words(axes, x)
    axes.set_xlim(-0.6, len(x) - 0.4)
    axes.grid(False, axis="x")


def _label_words(axes: Axes, words: Sequence[str]) -> None:
    """Write words below an axis, in several lines if they fit, else slanted.

    The figure is made higher for slanted words.
    """
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    # twelve letters of 9 points fit in one inch below an axis
    fitting = int(12 * figure.get_figwidth() / len(words))
    filled = [textwrap.fill(word, fitting, break_long_words=False) for word in words]
    longest = [max(map(len, text.splitlines()), default=0) + 1 for text in filled]
    if all(one + other <= 2 * fitting for one, other in itertools.pairwise(longest)):
        axes.set_xticks(np.arange(len(words)), filled)
        return
    # a slanted word needs a twentieth of an inch of height per letter
    figure.set_figheight(figure.get_figheight() + 0.05 * max(map(len, words)))
    axes.set_xticks(np.arange(len(words)), words, rotation=40, ha="right")


def _scale_axes(axes: Axes, x: np.ndarray, log_x: bool, ylim: tuple[float, float]) -> None:
    """Set the horizontal scale and its ticks, and the limits of the vertical axis."""
    if x.dtype.kind != "U":
        axes.set_xscale("log" if log_x else "linear")
        position = np.log(x) if log_x else x
        if len(x) <= 8 and np.diff(position).min(initial=np.inf) > 0.08 * np.ptp(position):
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.xaxis.set_minor_formatter("")
    axes.set_ylim(*ylim)


@styled
def heat_map(
    parts: Sequence[Mapping[str, Any]],
    xlabel: str,
    ylabel: str,
    label: str,
    log: bool = False,
    limits: tuple[float, float] | None = None,
) -> list[Figure]:
    """Draw values over two parameters as coloured cells, all panels on one colour scale.

    In a panel of few cells, each cell also shows its value as a number. Values that are not finite,
    or not positive on a logarithmic scale, stay white; panels without any value are left out.

    Args:
        parts: One mapping for each panel, with the keys `title`, `x` (n,) and `y` (m,), the values
            of the two parameters, and `z` (m, n), the values that are drawn.
        xlabel: Label of the horizontal axes, with unit.
        ylabel: Label of the vertical axes, with unit.
        label: Label of the colour scale, with unit.
        log: Whether the colour scale is logarithmic.
        limits: Lowest and highest value of the colour scale; by default those of the values drawn.

    Returns:
        The figures, one for each part that has values.
    """
    shown = [(part, _drawable(part["z"], log)) for part in parts]
    shown = [(part, z) for part, z in shown if np.isfinite(z).any()]
    figures, width = [], panel_width(len(shown))
    norm = _norm(np.concatenate([z.ravel() for _, z in shown] if limits is None else [np.asarray(limits)]), log)
    for part, z in shown:
        figure, axes = new_figure(width, 0.68 * width)
        mesh = axes.imshow(z, norm=norm, cmap="viridis", origin="lower", aspect="auto", interpolation="nearest")
        _label_cells(axes, part, z, norm)
        figure.colorbar(mesh, ax=axes, label=textwrap.fill(label, 30), fraction=0.05, pad=0.02)
        axes.set(xlabel=xlabel, ylabel=textwrap.fill(ylabel, 30), title=wrapped_title(part["title"], width))
        figures.append(figure)
    return figures


def _norm(z: np.ndarray, log: bool) -> Normalize:
    """Colour scale from the lowest to the highest finite value."""
    known = z[np.isfinite(z)]
    low, high = (float(known.min()), float(known.max())) if known.size else (1.0, 1.0)
    return (LogNorm if log else Normalize)(low, high if high > low else low + (abs(low) or 1.0) * 0.01)


def _label_cells(axes: Axes, part: Mapping[str, Any], z: np.ndarray, norm: Normalize) -> None:
    """Set ticks at values of the parameters, and write the value into each of few cells."""
    for axis, values in ((axes.xaxis, part["x"]), (axes.yaxis, part["y"])):
        step = math.ceil(len(values) / 8)
        axis.set_ticks(np.arange(0, len(values), step), [f"{value:g}" for value in values[::step]])
    axes.grid(False)
    if z.size <= 48 and z.shape[1] <= 7:  # only then the numbers fit into the cells
        for (row, column), value in np.ndenumerate(z):
            if np.isfinite(value):
                axes.text(
                    column,
                    row,
                    f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=INK if norm(value) > 0.6 else "white",
                )
