"""Pictures: the only importer of the plotting library.

Every function takes signals or arrays and returns a matplotlib Figure.
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

INK, ACCENT, SECOND, THIRD, FAINT = "#1f2933", "#0b6e99", "#d1495b", "#e09f3e", "#9aa5b1"
COLOURS = (ACCENT, SECOND, THIRD, "#4f7942", "#6a4c93", FAINT, "#8d5524", "#1aa6a6")
MARKERS, DASHES = "osD^vPX", ("--", ":", "-.")
_WORDS_FIT = 90  # letters of words beside each other under one panel
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
    """Draw in the house style without touching the user's."""

    @functools.wraps(draw)
    def styled(*args: Any, **options: Any) -> Figure:
        with rc_context(_STYLE):
            return draw(*args, **options)

    return styled


def _panels(rows: int, columns: int, size: tuple[float, float], sharey: bool = False) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)


def decibel(x: Tensor | np.ndarray, reference: float | None = None) -> np.ndarray:
    """20 lg |x| relative to the reference amplitude, by default the largest."""
    amplitude = np.abs(x.detach().cpu().numpy() if isinstance(x, Tensor) else x)
    top = reference if reference is not None else float(amplitude.max(initial=0.0))
    return 20 * np.log10(np.maximum(amplitude, 1e-15 * (top or 1.0)) / (top or 1.0))


def quicklook(signal: Signal, largest: int = 900) -> Signal:
    """Root mean square amplitude over blocks, so that no side has more than `largest` samples;
    unbatched, the axes follow.
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
    """An image or a raw matrix in dB, range horizontal, azimuth vertical, axes in their units.

    The first trial of a batch.

    0 dB is a high percentile of the amplitude, so that one bright ship does not hide the land; 100,
    the peak, suits scenes of points.
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
    """Several images side by side on one scale, taken from the first of them or from the one that
    `reference` names; other arguments as `image`.
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
    """Lines of equal amplitude of images side by side, in dB of the peak of each; range horizontal,
    azimuth vertical. The first trial of a batch.
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
    if once:
        figure.legend(
            drawn.legend_elements()[0],
            [f"{level:g} dB" for level in levels_db],
            loc="outside lower center",
            ncols=len(levels_db),
        )


def short_time_spectrum(samples: Tensor, rate_hz: float, width: int = 64, hop: int = 4) -> Signal:
    """Amplitude of a line of samples over frequency (MHz) and time (us): spectra of Hann windows of
    `width` samples, `hop` apart.

    samples: (n,) complex, frequencies from -rate / 2 on, or real, frequencies from 0 on. Time
    counts from the first sample, to the middle of a window; beyond its ends the line is zero.
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
    """Images, each in dB of its own peak, with lines over them.

    Each part holds `title`; `signal`, with two axes; `lines`, name -> (x, y), may be empty; and may
    hold `ylim`. A part without a signal holds the arguments of `curves`.
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
    """Dashed lines over an image, which keeps its limits."""
    limits = axes.get_xlim(), axes.get_ylim()
    for i, (name, (x, y)) in enumerate(lines.items()):
        axes.plot(
            x, y, label=name, color=COLOURS[(i + 1) % len(COLOURS)], linestyle=DASHES[i % len(DASHES)], linewidth=1.2
        )
    axes.set(xlim=limits[0], ylim=ylim or limits[1])
    if lines:
        axes.legend(loc="upper right", labelcolor="white")


def _first(signal: Signal) -> Signal:
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
    """Lines by name in one panel; marks: vertical lines by name."""
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
    """Points of a scene by their places, on one scale for both axes where aspect is "equal"; size:
    the area of each point, relative to the largest.
    """
    figure, (axes,) = _panels(1, 1, (5.4, 5.0))
    axes.scatter(x, y, s=14 * size / max(float(size.max()), 1e-300), color=COLOURS[0], linewidths=0)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title, aspect=aspect)
    return figure


@_styled
def panels(parts: Sequence[Mapping[str, Any]], columns: int = 2) -> Figure:
    """Several curve panels; each part holds the arguments of `curves`."""
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
    """Draw lines by name into existing axes; the first is the widest, so that others which lie on
    it are seen.
    """
    for i, (name, (x, y)) in enumerate(series.items()):
        axes.plot(
            x,
            y,
            label=name,
            color=COLOURS[i % len(COLOURS)],
            linewidth=max(0.9, 2.0 - 0.45 * i) if len(series) > 1 else 1.2,
        )
    for i, (name, place) in enumerate((marks or {}).items()):
        axes.axvline(place, color=COLOURS[(len(series) + i) % len(COLOURS)], linestyle="--", linewidth=1, label=name)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    if ylim is not None:
        axes.set_ylim(*ylim)
    if len(series) + len(marks or {}) > 1:
        axes.legend(loc="best")


@_styled
def trade(names: Sequence[str], seconds: Sequence[float], error_db: Sequence[float], ylabel: str, title: str) -> Figure:
    """Time against accuracy: one labelled point an alternative, faster to the left, better at the
    bottom.
    """
    figure, (axes,) = _panels(1, 1, (7.2, 4.2))
    for i, (name, s, e) in enumerate(zip(names, seconds, error_db, strict=True)):
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
    """Figures of algorithms with their intervals, over numbers (lines with bands) or words (dots
    with bars), in panels with one y axis.

    Each part holds `title`; `x`, an array or a sequence of words; `series`, name -> (values (x,),
    interval (x, 2)); and `bounds`, name -> values (x,), drawn dark and dashed. What is not finite,
    or not positive on a logarithmic axis, is left out.
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
    """Rows of up to three panels; four stand two by two."""
    return count if count < 4 else 2 if count == 4 else 3


def _grid(count: int, single: tuple[float, float], height: float) -> tuple[Figure, list[Axes]]:
    """Axes for so many panels; those beyond the count are hidden."""
    rows = math.ceil(count / _columns(count))
    figure, axes = _panels(rows, _columns(count), single if count == 1 else (9.6, height * rows + 0.5), sharey=True)
    for one in axes[count:]:
        one.set_visible(False)
    return figure, axes


def _name_axes(axes: Sequence[Axes], titles: Sequence[str], xlabel: str, ylabel: str) -> None:
    """Titles broken to the width of their panels; labels only where nothing stands below or to the
    left.
    """
    columns = _columns(len(titles))
    for i, title in enumerate(titles):
        axes[i].set_title(textwrap.fill(title, {1: 84, 2: 46}.get(columns, 30)))
        axes[i].set_xlabel(xlabel if i + columns >= len(titles) else "")
        axes[i].set_ylabel(textwrap.fill(ylabel, 38) if i % columns == 0 else "")


def _drawable(y: Any, log: bool) -> np.ndarray:
    """Float64 with NaN for what the axis cannot show."""
    y = np.asarray(y, dtype=np.float64)
    return np.where(np.isfinite(y) & ((y > 0) | (not log)), y, np.nan)


def _draw_bands(
    axes: Axes,
    x: np.ndarray,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    bounds: Mapping[str, np.ndarray],
    log: bool,
) -> None:
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
    step = min(0.16, 0.6 / len(series))
    for i, (name, (y, interval)) in enumerate(series.items()):
        place = np.arange(len(x)) + (i - (len(series) - 1) / 2) * step
        low, high = np.moveaxis(_drawable(interval, log), -1, 0)
        axes.vlines(place, low, high, color=COLOURS[i % len(COLOURS)], linewidth=1.6, alpha=0.6)
        axes.plot(
            place,
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
    if x.dtype.kind != "U":
        axes.set_xscale("log" if log_x else "linear")
        place = np.log(x) if log_x else x
        if len(x) <= 8 and np.diff(place).min(initial=np.inf) > 0.08 * np.ptp(place):
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
    """One legend for all panels, under them, where more than one thing is drawn."""
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
    """Cells over two parameters, one panel a part, all on one colour scale; few enough cells carry
    their numbers.

    Each part holds `title`, `x`, `y` and `z` (y, x). limits: ends of the colour scale, by default
    those of what is drawn. What is not finite, or not positive on a logarithmic scale, stays white.
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
    known = z[np.isfinite(z)]
    low, high = (float(known.min()), float(known.max())) if known.size else (1.0, 1.0)
    return (LogNorm if log else Normalize)(low, high if high > low else low + (abs(low) or 1.0) * 0.01)


def _label_cells(axes: Axes, part: Mapping[str, Any], z: np.ndarray, norm: Normalize) -> None:
    """Ticks at the values of the parameters (every so many of them), and the numbers of up to 48
    cells.
    """
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
    """Write a PNG."""
    figure.savefig(path, dpi=dpi)


def array(x: Tensor) -> np.ndarray:
    """A tensor as a numpy array."""
    return torch.as_tensor(x).detach().cpu().resolve_conj().numpy()
