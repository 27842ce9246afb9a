"""Figures of images, curves and sweeps; the only module that imports the plotting library.

Each function that draws takes signals or arrays and returns a matplotlib Figure.
"""

from __future__ import annotations

import functools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Signal

try:
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation, LogLocator, NullFormatter
except ImportError as error:
    raise ImportError("torchsar.plot needs matplotlib: pip install 'torchsar-lab[study]'") from error

# palette by choice: text and frames, then colours of curves in their order
INK, ACCENT, SECOND, THIRD, FAINT = "#1f2933", "#0b6e99", "#d1495b", "#e09f3e", "#9aa5b1"
COLOURS = (ACCENT, SECOND, THIRD, "#4f7942", "#6a4c93", FAINT, "#8d5524", "#1aa6a6")
# seven markers beside eight colours: more than eight curves still differ
MARKERS, DASHES = "osD^vPX", ("--", ":", "-.")
# letters of all words that fit side by side under one panel, found by trial; more are turned
_WORDS_FIT = 90
# appearance by choice
_STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.2,
    "figure.facecolor": "white",
    "axes.prop_cycle": cycler(color=COLOURS),
}


def _styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Run a drawing function in the style of this module, without a change of global settings."""

    @functools.wraps(draw)
    def styled(*args: Any, **options: Any) -> Figure:
        with rc_context(_STYLE):
            return draw(*args, **options)

    return styled


def _panels(rows: int, columns: int, size: tuple[float, float], sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """Figure with a grid of axes."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)


def decibel(x: Tensor | np.ndarray, reference: float | None = None) -> np.ndarray:
    """Convert amplitudes to decibels, 20 lg |x / reference|.

    Args:
        x: Amplitudes, any shape, real or complex.
        reference: Amplitude of 0 dB; by default the largest one.

    Returns:
        Levels in dB, same shape, limited to -300 dB.
    """
    amplitude = np.abs(x.detach().cpu().numpy() if isinstance(x, Tensor) else x)
    top = reference if reference is not None else float(amplitude.max(initial=0.0))
    return 20 * np.log10(np.maximum(amplitude, 1e-15 * (top or 1.0)) / (top or 1.0))


def quicklook(signal: Signal, largest: int = 900) -> Signal:
    """Average an image in blocks, so that no side has more than a given number of samples.

    Args:
        signal: Image or raw data with two axes, shape (..., azimuth, range).
        largest: Largest number of samples of a side.

    Returns:
        Root mean square amplitude of each block, on axes of the block centres. Samples at the end
        that do not fill a block are dropped.
    """
    data, axes = signal.data.detach(), []
    for dim, axis in zip((-2, -1), signal.axes, strict=True):
        step = math.ceil(axis.n / largest)
        count = axis.n // step
        data = data.narrow(dim, 0, count * step).unflatten(dim, (count, step))
        power = data.real.square() + data.imag.square() if data.is_complex() else data.square()
        data = power.mean(dim if dim == -1 else -2).sqrt()
        axes.append(Axis(axis.name, count, axis.start + (step - 1) / 2 * axis.step, axis.step * step, axis.unit))
    return Signal(data, tuple(axes))


def _extent(signal: Signal, origin: Sequence[float]) -> tuple[float, float, float, float]:
    """Edges of an image for imshow, relative to an origin of the axes."""
    vertical, horizontal = signal.axes
    v, h = vertical.start - origin[0], horizontal.start - origin[1]
    return (
        h - horizontal.step / 2,
        h + (horizontal.n - 0.5) * horizontal.step,
        v - vertical.step / 2,
        v + (vertical.n - 0.5) * vertical.step,
    )


def _show(
    axes: Axes,
    signal: Signal,
    dynamic_range_db: float,
    title: str,
    reference: float | None = None,
    percentile: float = 100.0,
) -> Any:
    """Draw one image into existing axes."""
    view = quicklook(signal)
    amplitude = view.data.cpu().numpy()
    top = (
        reference
        if reference is not None
        else float(np.percentile(amplitude, percentile)) or float(amplitude.max(initial=1.0))
    )
    origin = (0.0, signal.axes[1].start if signal.axes[1].start > 1e4 else 0.0)
    shown = axes.imshow(
        decibel(amplitude, top),
        cmap="gray",
        vmin=-dynamic_range_db,
        vmax=0,
        origin="lower",
        aspect="auto",
        extent=_extent(view, origin),
        interpolation="nearest",
    )
    beyond = f" beyond {origin[1]:,.0f} m" if origin[1] else ""
    axes.set(
        xlabel=f"{signal.axes[1].name}{beyond} ({signal.axes[1].unit})",
        ylabel=f"{signal.axes[0].name} ({signal.axes[0].unit})",
        title=title,
    )
    axes.grid(False)
    return shown


@_styled
def image(signal: Signal, dynamic_range_db: float = 50.0, title: str = "", percentile: float = 99.9) -> Figure:
    """Draw an image or raw data in dB, range horizontal, azimuth or slow time vertical.

    0 dB is a high percentile of the amplitude, so that a few bright ships do not darken the land;
    100, the peak, suits scenes of points. The first trial of a batch is drawn.

    Args:
        signal: Signal with two axes, shape (..., azimuth, range).
        dynamic_range_db: Lowest level, in dB below 0 dB.
        title: Title of the figure.
        percentile: Percentile of the amplitude that is 0 dB.
    """
    figure, (axes,) = _panels(1, 1, (7.2, 6.2))
    shown = _show(axes, _first(signal), dynamic_range_db, title, percentile=percentile)
    figure.colorbar(
        shown,
        ax=axes,
        label="amplitude (dB below the peak)"
        if percentile == 100
        else f"amplitude (dB below the {percentile:g}th percentile)",
        shrink=0.8,
    )
    return figure


@_styled
def images(
    signals: Mapping[str, Signal],
    dynamic_range_db: float = 50.0,
    columns: int = 2,
    percentile: float = 99.9,
    reference: str | None = None,
) -> Figure:
    """Draw several images side by side on one scale.

    Args:
        signals: Signals with two axes, by title; the first trial of each is drawn.
        dynamic_range_db: Lowest level, in dB below 0 dB.
        columns: Number of images in a row.
        percentile: Percentile of the amplitude that is 0 dB.
        reference: Title of the image whose percentile counts; by default the first.
    """
    rows = math.ceil(len(signals) / columns)
    figure, panels = _panels(rows, min(columns, len(signals)), (4.6 * min(columns, len(signals)), 3.9 * rows))
    scale = quicklook(_first(signals[reference or next(iter(signals))])).data.cpu().numpy()
    top = float(np.percentile(scale, percentile)) or None
    shown: Any = None
    for axes, (title, signal) in zip(panels, signals.items(), strict=False):
        shown = _show(axes, _first(signal), dynamic_range_db, title, top)
    for axes in panels[len(signals) :]:
        axes.set_visible(False)
    figure.colorbar(shown, ax=panels, label="amplitude (dB)", shrink=0.6)
    return figure


@_styled
def contours(
    signals: Mapping[str, Signal], levels_db: Sequence[float] = (-30, -20, -13, -3), columns: int = 3
) -> Figure:
    """Draw lines of equal amplitude of several images, range horizontal, azimuth vertical.

    Args:
        signals: Signals with two axes, by title; the first trial of each is drawn.
        levels_db: Levels of the lines, in dB relative to the peak of each image, rising.
        columns: Number of images in a row.
    """
    rows = math.ceil(len(signals) / columns)
    figure, panels = _panels(rows, min(columns, len(signals)), (3.3 * min(columns, len(signals)), 3.1 * rows))
    for axes, (title, signal) in zip(panels, signals.items(), strict=False):
        vertical, horizontal = signal.axes
        drawn = axes.contour(
            array(horizontal.values()),
            array(vertical.values()),
            decibel(_first(signal).data),
            levels=list(levels_db),
            colors=COLOURS,
            linewidths=1.0,
        )
        axes.set(
            xlabel=f"{horizontal.name} ({horizontal.unit})", ylabel=f"{vertical.name} ({vertical.unit})", title=title
        )
        _legend_levels(figure, drawn, levels_db, once=axes is panels[0])
    for axes in panels[len(signals) :]:
        axes.set_visible(False)
    return figure


def _legend_levels(figure: Figure, drawn: Any, levels_db: Sequence[float], once: bool) -> None:
    """One legend of the levels for all panels."""
    if once:
        figure.legend(
            drawn.legend_elements()[0],
            [f"{level:g} dB" for level in levels_db],
            loc="outside lower center",
            ncols=len(levels_db),
        )


def short_time_spectrum(samples: Tensor, rate_hz: float, width: int = 64, hop: int = 4) -> Signal:
    """Compute a spectrogram of one line of samples, with Hann windows.

    Args:
        samples: Samples, shape (n,), real or complex.
        rate_hz: Sampling rate in Hz.
        width: Length of the windows in samples.
        hop: Distance between windows in samples.

    Returns:
        Amplitudes with the axes `frequency` (MHz; from -rate / 2 on for complex samples, from 0 on
        for real ones) and `time` (us; that of the middle of a window, counted from the first
        sample). The samples are continued by zeros at both ends.
    """
    n = 8 * width
    window = torch.hann_window(width, dtype=samples.real.dtype, device=samples.device)
    pieces = torch.nn.functional.pad(samples, (width // 2, width - width // 2)).unfold(0, width, hop) * window
    spectra = (
        torch.fft.fftshift(torch.fft.fft(pieces, n), dim=-1) if samples.is_complex() else torch.fft.rfft(pieces, n)
    )
    low = -0.5e-6 * rate_hz if samples.is_complex() else 0.0
    frequency = Axis("frequency", spectra.shape[-1], low, 1e-6 * rate_hz / n, "MHz")
    return Signal(
        spectra.mT.abs(), (frequency, Axis("time", len(spectra), -0.5e6 / rate_hz, 1e6 * hop / rate_hz, "us"))
    )


@_styled
def overlays(parts: Sequence[Mapping[str, Any]], columns: int = 2, dynamic_range_db: float = 40.0) -> Figure:
    """Draw images, each in dB of its own peak, with dashed lines over them.

    Args:
        parts: Panels. Each has `title`, `signal` with two axes, `lines`, a mapping from names to
            (x, y), and may have `ylim`. A panel without `signal` has the arguments of `curves`.
        columns: Number of panels in a row.
        dynamic_range_db: Lowest level, in dB below the peak.
    """
    rows = math.ceil(len(parts) / columns)
    figure, panels = _panels(rows, min(columns, len(parts)), (4.4 * min(columns, len(parts)), 3.2 * rows))
    shown: Any = None
    for axes, part in zip(panels, parts, strict=False):
        if "signal" not in part:
            draw_curves(axes, **part)
            continue
        shown = _show(axes, _first(part["signal"]), dynamic_range_db, part["title"])
        _draw_over(axes, part["lines"], part.get("ylim"))
    for axes in panels[len(parts) :]:
        axes.set_visible(False)
    if shown is not None:
        figure.colorbar(shown, ax=panels, label="amplitude (dB below the peak)", shrink=0.8)
    return figure


def _draw_over(
    axes: Axes, lines: Mapping[str, tuple[np.ndarray, np.ndarray]], ylim: tuple[float, float] | None
) -> None:
    """Draw dashed lines over an image without a change of its limits."""
    limits = axes.get_xlim(), axes.get_ylim()
    for i, (name, (x, y)) in enumerate(lines.items()):
        axes.plot(
            x, y, label=name, color=COLOURS[(i + 1) % len(COLOURS)], linestyle=DASHES[i % len(DASHES)], linewidth=1.2
        )
    axes.set(xlim=limits[0], ylim=ylim or limits[1])
    if lines:
        axes.legend(loc="upper right", labelcolor="white")


def _first(signal: Signal) -> Signal:
    """First trial of a signal."""
    return signal.with_data(signal.data.flatten(0, -3)[0]) if signal.trials else signal


@_styled
def curves(
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    marks: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
) -> Figure:
    """Draw curves into one panel.

    Args:
        series: Curves (x, y) by name, each a pair of arrays of shape (n,).
        xlabel: Label of the horizontal axis, with unit.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the panel.
        marks: Positions of vertical lines by name, in the unit of x.
        ylim: Limits of the vertical axis.
    """
    figure, (axes,) = _panels(1, 1, (7.2, 3.2))
    draw_curves(axes, series, xlabel, ylabel, title, marks, ylim)
    return figure


@_styled
def places(
    x: np.ndarray,
    y: np.ndarray,
    size: np.ndarray,
    xlabel: str,
    ylabel: str,
    title: str = "",
    aspect: Literal["equal", "auto"] = "equal",
) -> Figure:
    """Draw the points of a scene by their positions.

    Args:
        x: Horizontal positions, shape (n,).
        y: Vertical positions, shape (n,).
        size: Relative areas of the points, shape (n,).
        xlabel: Label of the horizontal axis, with unit.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the figure.
        aspect: "equal" for one scale on both axes, "auto" otherwise.
    """
    figure, (axes,) = _panels(1, 1, (5.4, 5.0))
    axes.scatter(x, y, s=14 * size / max(float(size.max()), 1e-300), color=COLOURS[0], linewidths=0)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title, aspect=aspect)
    return figure


@_styled
def panels(parts: Sequence[Mapping[str, Any]], columns: int = 2) -> Figure:
    """Draw several panels of curves.

    Args:
        parts: Panels, each with the arguments of `curves`.
        columns: Number of panels in a row.
    """
    rows = math.ceil(len(parts) / columns)
    figure, axes = _panels(rows, min(columns, len(parts)), (4.6 * min(columns, len(parts)), 3.0 * rows))
    for one, part in zip(axes, parts, strict=False):
        draw_curves(one, **part)
    for one in axes[len(parts) :]:
        one.set_visible(False)
    return figure


def draw_curves(
    axes: Axes,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    marks: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
) -> None:
    """Draw curves into existing axes.

    The first curve is the widest, so that it stays visible under others.

    Args:
        axes: Axes of matplotlib.
        series: As in `curves`.
        xlabel: As in `curves`.
        ylabel: As in `curves`.
        title: As in `curves`.
        marks: As in `curves`.
        ylim: As in `curves`.
    """
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
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    if ylim is not None:
        axes.set_ylim(*ylim)
    if len(series) + len(marks or {}) > 1:
        axes.legend(loc="best")


@_styled
def trade(
    names: Sequence[str],
    seconds: Sequence[float],
    loss: Sequence[float],
    ylabel: str,
    title: str,
    tolerance: float | None = None,
) -> Figure:
    """Draw loss over computing time: a labelled point for each alternative and the Pareto front.

    Args:
        names: Names of the alternatives.
        seconds: Computing time of each, in seconds.
        loss: Loss of each, in the unit of `ylabel`; less is better.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the figure.
        tolerance: Largest acceptable loss, drawn as a dashed line.
    """
    figure, (axes,) = _panels(1, 1, (7.2, 4.2))
    points = sorted(zip(seconds, loss, strict=True))
    front = [(s, e) for i, (s, e) in enumerate(points) if all(e < other for _, other in points[:i])]
    axes.step([s for s, _ in front], [e for _, e in front], where="post", color=FAINT, linewidth=1, zorder=0)
    if tolerance is not None:
        axes.axhline(tolerance, color=FAINT, linestyle="--", linewidth=1, zorder=0)
    for i, (name, s, e) in enumerate(zip(names, seconds, loss, strict=True)):
        axes.plot([s], [e], "o", color=COLOURS[i % len(COLOURS)], markersize=7)
        axes.annotate(name, (s, e), textcoords="offset points", xytext=(7, 4 if i % 2 else -10), fontsize=8, color=INK)
    axes.set(xscale="log", xlabel="time (s)", ylabel=ylabel, title=title)
    axes.margins(0.18)
    return figure


@_styled
def error_curves(
    parts: Sequence[Mapping[str, Any]],
    xlabel: str,
    ylabel: str,
    log_x: bool = False,
    log_y: bool = False,
    ylim: tuple[float, float] | None = None,
) -> Figure:
    """Draw errors of algorithms with their intervals over one parameter.

    Numbers give lines with bands, words dots with bars; all panels share the vertical axis. Values
    that are not finite, or not positive on a logarithmic axis, are left out.

    Args:
        parts: Panels. Each has `title`; `x`, numbers (n,) or words; `series`, a mapping from names
            to values (n,) and intervals (n, 2); and `bounds`, a mapping from names to values (n,),
            drawn dark and dashed.
        xlabel: Label of the horizontal axes, with unit.
        ylabel: Label of the vertical axes, with unit.
        log_x: Whether the horizontal axes are logarithmic.
        log_y: Whether the vertical axes are logarithmic.
        ylim: Limits of the vertical axes.
    """
    figure, axes = _grid(len(parts), (7.2, 3.6), 3.0)
    for one, part in zip(axes, parts, strict=False):
        draw = _draw_dots if any(isinstance(x, str) for x in part["x"]) else _draw_bands
        draw(one, part["x"], part["series"], part["bounds"], log_y)
        if not any(np.isfinite(_drawable(y, log_y)).any() for y, _ in part["series"].values()):
            one.text(0.5, 0.5, "no value to show", transform=one.transAxes, ha="center", va="center", color=FAINT)
    for one in axes[: len(parts)]:
        _scale_axes(one, np.asarray(parts[0]["x"]), log_x, log_y, ylim)
    _name_axes(axes, [part["title"] for part in parts], xlabel, ylabel)
    _legend_below(figure, axes)
    return figure


def _columns(count: int) -> int:
    """Number of panels in a row: up to three, two if there are four panels."""
    return count if count < 4 else 2 if count == 4 else 3


def _grid(count: int, single: tuple[float, float], height: float) -> tuple[Figure, list[Axes]]:
    """Axes for a number of panels; further axes of the grid are hidden."""
    rows = math.ceil(count / _columns(count))
    figure, axes = _panels(rows, _columns(count), single if count == 1 else (9.6, height * rows + 0.5), sharey=True)
    for one in axes[count:]:
        one.set_visible(False)
    return figure, axes


def _name_axes(axes: Sequence[Axes], titles: Sequence[str], xlabel: str, ylabel: str) -> None:
    """Set titles, wrapped to the width of a panel, and labels at the outer edges of the grid."""
    columns = _columns(len(titles))
    for i, title in enumerate(titles):
        axes[i].set_title(textwrap.fill(title, {1: 84, 2: 46}.get(columns, 30)))
        axes[i].set_xlabel(xlabel if i + columns >= len(titles) else "")
        axes[i].set_ylabel(textwrap.fill(ylabel, 38) if i % columns == 0 else "")


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
    """Draw lines with bands for their intervals, and dashed bounds."""
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
    """Draw dots with bars for their intervals over words, and dashed bounds."""
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
    axes.set_xticks(
        np.arange(len(x)),
        x,
        **({"rotation": 40, "ha": "right"} if sum(len(word) + 2 for word in x) > _WORDS_FIT else {}),
    )
    axes.set_xlim(-0.6, len(x) - 0.4)
    axes.grid(False, axis="x")


def _scale_axes(axes: Axes, x: np.ndarray, log_x: bool, log_y: bool, ylim: tuple[float, float] | None) -> None:
    """Set scales, ticks and limits."""
    if x.dtype.kind != "U":
        axes.set_xscale("log" if log_x else "linear")
        position = np.log(x) if log_x else x
        if len(x) <= 8 and np.diff(position).min(initial=np.inf) > 0.08 * np.ptp(position):
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.xaxis.set_minor_formatter(NullFormatter())
    if log_y:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        if high < 1000 * low:
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 6, 8)))
            plain = low >= 1e-3 and high < 1e5
            axes.yaxis.set_major_formatter(
                FuncFormatter(lambda value, _: f"{value:g}")
                if plain
                else LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf))
            )
            axes.yaxis.set_minor_formatter(NullFormatter())
    if ylim is not None:
        axes.set_ylim(*ylim)


def _legend_below(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend for all panels below them, if there are several entries."""
    found = {label: handle for one in axes for handle, label in zip(*one.get_legend_handles_labels(), strict=True)}
    if len(found) > 1:
        fitting = int(12 * figure.get_figwidth() / (6 + max(map(len, found))))
        figure.legend(
            list(found.values()), list(found), loc="outside lower center", ncols=max(1, min(fitting, len(found)))
        )


@_styled
def heat_map(
    parts: Sequence[Mapping[str, Any]],
    xlabel: str,
    ylabel: str,
    label: str,
    log: bool = False,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Draw coloured cells over two parameters, all panels on one colour scale.

    Panels of up to 48 cells show their numbers. Values that are not finite, or not positive on a
    logarithmic scale, stay white.

    Args:
        parts: Panels. Each has `title`, `x` (n,), `y` (m,) and `z` (m, n).
        xlabel: Label of the horizontal axes, with unit.
        ylabel: Label of the vertical axes, with unit.
        label: Label of the colour scale, with unit.
        log: Whether the colour scale is logarithmic.
        limits: Ends of the colour scale; by default those of the values.
    """
    shown = [_drawable(part["z"], log) for part in parts]
    norm = _norm(np.stack(shown) if limits is None else np.asarray(limits), log)
    figure, axes = _grid(len(parts), (7.2, 4.2), 2.9)
    mesh: Any = None
    for one, part, z in zip(axes, parts, shown, strict=False):
        mesh = one.imshow(z, norm=norm, cmap="viridis", origin="lower", aspect="auto", interpolation="nearest")
        _label_cells(one, part, z, norm)
    figure.colorbar(mesh, ax=axes, label=label, shrink=0.9)
    _name_axes(axes, [part["title"] for part in parts], xlabel, ylabel)
    return figure


def _norm(z: np.ndarray, log: bool) -> Normalize:
    """Colour scale from the lowest to the highest finite value."""
    known = z[np.isfinite(z)]
    low, high = (float(known.min()), float(known.max())) if known.size else (1.0, 1.0)
    return (LogNorm if log else Normalize)(low, high if high > low else low + (abs(low) or 1.0) * 0.01)


def _label_cells(axes: Axes, part: Mapping[str, Any], z: np.ndarray, norm: Normalize) -> None:
    """Set ticks at values of the parameters and, for up to 48 cells, write their numbers."""
    for axis, values in ((axes.xaxis, part["x"]), (axes.yaxis, part["y"])):
        step = math.ceil(len(values) / 8)
        axis.set_ticks(np.arange(0, len(values), step), [f"{value:g}" for value in values[::step]])
    axes.grid(False)
    if z.size <= 48:
        for (row, column), value in np.ndenumerate(z):
            if np.isfinite(value):
                axes.text(
                    column,
                    row,
                    f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color=INK if norm(value) > 0.6 else "white",
                )


def save(figure: Figure, path: Any, dpi: int = 110) -> None:
    """Write a figure to a file.

    Args:
        figure: Figure to write.
        path: Path of the file; its suffix gives the format.
        dpi: Resolution in dots per inch.
    """
    figure.savefig(path, dpi=dpi)


def array(x: Tensor) -> np.ndarray:
    """Convert a tensor to a numpy array on the CPU, without gradient.

    Args:
        x: Tensor, any shape.
    """
    return torch.as_tensor(x).detach().cpu().resolve_conj().numpy()


# units by the last words of a name, the longest first
_UNITS = {
    "_rad_s": "rad/s",
    "_m_s2": "m/s²",
    "_m_s": "m/s",
    "_hz": "Hz",
    "_db": "dB",
    "_nats": "nats",
    "_rad": "rad",
    "_deg": "deg",
    "_m": "m",
    "_s": "s",
}
# words of names that are not written in small letters
_WRITTEN = ["Doppler", "SNR", "PRF", "RMS", "IRW", "PSLR", "ISLR", "RCS", "SIR", "CNR", "SCR", "SCNR", "MFTA", "ADC"]
_ACRONYMS = {word.lower(): word for word in _WRITTEN}


def name_and_unit(name: str) -> tuple[str, str]:
    """What the last part of a name says, and its unit: 'world.noise.snr_db' -> ('SNR', 'dB')."""
    last = name.rpartition(".")[2]
    suffix = next((suffix for suffix in _UNITS if last.endswith(suffix) and last != suffix), "")
    words = last.removesuffix(suffix).strip("_").split("_")
    return " ".join(_ACRONYMS.get(word, word) for word in words), _UNITS.get(suffix, "")


def axis_label(name: str) -> str:
    """'doppler_error_hz' -> 'Doppler error (Hz)'."""
    words, unit = name_and_unit(name)
    return f"{words} ({unit})" if unit else words
