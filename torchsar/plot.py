"""Figures of images, curves and parameter sweeps; the only module that imports matplotlib.

Each function that draws takes signals or arrays and returns a matplotlib Figure, or a list of
Figures, one for each panel, so that a page can set the panels side by side or below each other.
`save` writes a Figure or such a list into one file, and notebooks show both as pictures.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Signal

try:
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure
    from matplotlib.image import imsave
    from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation, LogLocator, NullFormatter
except ImportError as error:
    raise ImportError("torchsar.plot needs matplotlib: pip install 'torchsar-lab[study]'") from error

# palette by choice: text and frames, then colours of curves in their order
INK, ACCENT, SECOND, THIRD, FAINT = "#1f2933", "#0b6e99", "#d1495b", "#e09f3e", "#9aa5b1"
COLOURS = (ACCENT, SECOND, THIRD, "#4f7942", "#6a4c93", FAINT, "#8d5524", "#1aa6a6")
# seven markers beside eight colours: more than eight curves still differ
MARKERS, DASHES = "osD^vPX", ("--", ":", "-.")
# widths in inches of a figure alone and of one panel among several: text of 9 points has at least 9
# pixels where a page of 420 pixels leaves 386 of them
_ALONE, _PANEL = 5.2, 3.9
# directions from a point in which its number may stand
_AROUND = ((1, 0.6), (-1, 0.6), (1, -0.6), (-1, -0.6), (0, 1.1), (0, -1.1), (1.2, 0), (-1.2, 0))
# inches beside and below images for labels and the colour scale, and the largest height of an image
_BESIDE, _BELOW, _HIGHEST = 1.55, 0.85, 4.6
# pictures to scale become illegible when they are more elongated than this
_ELONGATED = 4.0
# blocks of images per inch of a figure, fewer than pixels, so that no block is lost in drawing
_BLOCKS_PER_INCH = 90
# letters that fit in an inch: of titles, and of words side by side below an axis, found by trial
_LETTERS, _WORDS_FIT = 11.0, 12.0
# inches of height that a letter of a slanted word needs
_SLANTED = 0.05
# points of a scene that are drawn small
_MANY = 20
# cells of a heat map, and those of a row, whose numbers fit into a panel
_CELLS = 48, 7
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
    "axes.axisbelow": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.2,
    "figure.facecolor": "white",
    "axes.prop_cycle": cycler(color=COLOURS),
}


class _NotebookFigure(Figure):
    """Figure that a notebook shows by itself, without pyplot and its settings."""

    def _repr_png_(self) -> bytes:
        return _png(self)


class Panels(list[Figure]):
    """Figures that a notebook shows side by side, row by row."""

    def _repr_png_(self) -> bytes:
        return _png(self)


def _png(figure: Figure | Sequence[Figure]) -> bytes:
    file = io.BytesIO()
    save(figure, file)
    return file.getvalue()


Drawn = TypeVar("Drawn", Figure, list[Figure])


def _styled(draw: Callable[..., Drawn]) -> Callable[..., Drawn]:
    """Run a drawing function in the style of this module, without a change of global settings."""

    @functools.wraps(draw)
    def styled(*args: Any, **options: Any) -> Any:
        with rc_context(_STYLE):
            drawn = draw(*args, **options)
        return Panels(drawn) if isinstance(drawn, list) else drawn

    return styled


def _figure(width: float, height: float, to_scale: bool = False) -> tuple[Figure, Axes]:
    """Figure of one panel, with its axes."""
    figure = _NotebookFigure(figsize=(width, height), layout="compressed" if to_scale else "constrained")
    return figure, figure.subplots()


def _width(count: int) -> float:
    """Width in inches of each of several panels."""
    return _ALONE if count == 1 else _PANEL


def _wrapped(title: str, width: float) -> str:
    return textwrap.fill(title, round(_LETTERS * (width - 0.5)))


def decibel(x: Tensor | np.ndarray, reference: float | None = None) -> np.ndarray:
    """Convert amplitudes to decibels, 20 lg |x / reference|.

    Args:
        x: Amplitudes, any shape, real or complex.
        reference: Amplitude of 0 dB; by default the largest finite one.

    Returns:
        Levels in dB, same shape; lower levels than -300 dB are set to -300 dB. NaN where the
        amplitude is not finite.
    """
    amplitude = np.abs(array(x) if isinstance(x, Tensor) else x).astype(np.float64)
    amplitude = np.where(np.isfinite(amplitude), amplitude, np.nan)
    top = reference if reference is not None else _largest(amplitude)
    return 20 * np.log10(np.maximum(amplitude, 1e-15 * (top or 1.0)) / (top or 1.0))


def quicklook(signal: Signal, largest: int = 900) -> Signal:
    """Average an image in blocks, so that no side has more than a given number of samples.

    Args:
        signal: Image or raw data with two axes, shape (..., azimuth, range).
        largest: Largest number of samples of a side.

    Returns:
        Root mean square amplitude of each block, on axes of the block centres; NaN for a block
        with a sample that is not finite. Samples at the end that do not fill a block are dropped.
    """
    data, axes = signal.data.detach().abs(), []
    data = torch.where(torch.isfinite(data), data, torch.nan)
    peak = torch.nan_to_num(data).amax()
    data = data / torch.where(peak > 0, peak, 1)  # squares of the amplitudes themselves may overflow
    for dim, axis in zip((-2, -1), signal.axes, strict=True):
        step = math.ceil(axis.n / largest)
        count = axis.n // step
        data = data.narrow(dim, 0, count * step).unflatten(dim, (count, step))
        data = data.square().mean(dim if dim == -1 else -2).sqrt()
        axes.append(Axis(axis.name, count, axis.start + (step - 1) / 2 * axis.step, axis.step * step, axis.unit))
    return Signal(data * peak, tuple(axes))


def _largest(amplitude: np.ndarray) -> float:
    """The largest finite amplitude; 0 if there is none."""
    return float(np.max(amplitude, initial=0.0, where=np.isfinite(amplitude)))


def span(positions: Tensor, margin: float) -> tuple[float, float]:
    """Return the interval from the lowest to the highest position, with a margin on both sides.

    Args:
        positions: Positions on an axis, any shape.
        margin: Distance in the unit of the axis.

    Returns:
        Lowest position minus the margin, and highest position plus the margin.
    """
    return float(positions.min()) - margin, float(positions.max()) + margin


def within(signal: Signal, spans: Mapping[str, tuple[float, float]]) -> Signal:
    """Cut out the part of a signal between two positions on some axes.

    Args:
        signal: Signal to crop.
        spans: First and last position by the name of the axis; names that the signal does not have
            are ignored.

    Returns:
        The part that lies inside the signal, at least two samples of each axis.
    """
    cut = {}
    for axis in signal.axes:
        if axis.name in spans:
            first, last = (round(float(axis.index_of(edge))) for edge in spans[axis.name])
            first = min(max(first, 0), max(axis.n - 2, 0))
            cut[axis.name] = slice(first, max(last + 1, first + 2))
    return signal.isel(**cut)


def boxes(centres: Sequence[tuple[float, float]], half_x: float, half_y: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the outlines of equal rectangles about some positions as one line with gaps.

    The functions `overlays` and `images` draw such a line over an image.

    Args:
        centres: Positions (x, y) of the centres of the rectangles.
        half_x: Half width of the rectangles in the unit of x.
        half_y: Half height of the rectangles in the unit of y.

    Returns:
        Coordinates x and y of the line, with NaN after each rectangle.
    """
    x, y = half_x * np.array([-1, 1, 1, -1, -1, np.nan]), half_y * np.array([-1, -1, 1, 1, -1, np.nan])
    at = np.asarray(centres, dtype=float).reshape(-1, 2)
    return (at[:, :1] + x).ravel(), (at[:, 1:] + y).ravel()


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


def _to_scale(signal: Signal) -> float | None:
    """Height over width where both axes can have one scale; None for different units or shapes
    that are too elongated.
    """
    vertical, horizontal = signal.axes
    ratio = vertical.n * vertical.step / (horizontal.n * horizontal.step)
    fits = vertical.unit == horizontal.unit and 1 / _ELONGATED <= ratio <= _ELONGATED
    return ratio if fits else None


def level(signal: Signal, percentile: float = 100.0, width: float = _PANEL) -> float:
    """Compute the amplitude that pictures of a signal show as 0 dB.

    Args:
        signal: Signal with two axes; the first trial counts.
        percentile: Percentile of the amplitude, 0 to 100, that is 0 dB; 100 is the peak.
        width: Width of the figure in inches, on which the averaging in blocks depends.

    Returns:
        The amplitude; if the percentile is zero, the peak, and if that is zero, 1.
    """
    amplitude = quicklook(_first(signal), round(_BLOCKS_PER_INCH * width)).data.cpu().numpy()
    known = amplitude[np.isfinite(amplitude)]
    return float(np.percentile(known, percentile) if len(known) else 0.0) or _largest(amplitude) or 1.0


def _show(signal: Signal, width: float, dynamic_range_db: float, title: str, top: float, label: str) -> Figure:
    """Draw the first trial of a signal into a new figure, to scale where that is possible."""
    signal = _first(signal)
    view, ratio = quicklook(signal, round(_BLOCKS_PER_INCH * width)), _to_scale(signal)
    height = min((width - _BESIDE) * (ratio or 0.8), _HIGHEST) + _BELOW
    figure, axes = _figure(width, height, ratio is not None)
    origin = (0.0, signal.axes[1].start if signal.axes[1].start > 1e4 else 0.0)
    shown = axes.imshow(
        decibel(view.data.cpu().numpy(), top),
        cmap="gray",
        vmin=-dynamic_range_db,
        vmax=0,
        origin="lower",
        aspect="auto" if ratio is None else "equal",
        extent=_extent(view, origin),
        interpolation="nearest",
    )
    beyond = f" beyond {origin[1]:,.0f} m" if origin[1] else ""
    axes.set(
        xlabel=f"{signal.axes[1].name}{beyond} ({signal.axes[1].unit})",
        ylabel=f"{signal.axes[0].name} ({signal.axes[0].unit})",
        title=_wrapped(title, width),
    )
    axes.grid(False)
    # as high as the image, whatever its shape
    figure.colorbar(shown, ax=axes, label=label, fraction=0.05, pad=0.02, aspect=20 * max(1.0, ratio or 1.0))
    return figure


def _below(percentile: float) -> str:
    """Label of a colour scale."""
    return "dB relative to the peak" if percentile == 100 else f"dB relative to percentile {percentile:g}"


@_styled
def image(signal: Signal, dynamic_range_db: float = 50.0, title: str = "", percentile: float = 99.9) -> Figure:
    """Draw an image or raw data in dB, range horizontal, azimuth or slow time vertical.

    Both axes have one scale if they have the same unit and the image is not too elongated. 0 dB is
    a high percentile of the amplitude, so that a few bright targets do not darken all the rest. For
    scenes of points, choose percentile 100, the peak. The first trial of a batch is drawn.

    Args:
        signal: Signal with two axes, shape (..., azimuth, range).
        dynamic_range_db: Range of levels shown in dB; everything lower is black.
        title: Title of the figure.
        percentile: Percentile of the amplitude, 0 to 100, that is 0 dB.

    Returns:
        The figure.

    Raises:
        TypeError: If `signal` is not a Signal.
    """
    top = level(signal, percentile, _ALONE)
    return _show(signal, _ALONE, dynamic_range_db, title, top, _below(percentile))


@_styled
def images(
    signals: Mapping[str, Signal],
    dynamic_range_db: float = 50.0,
    percentile: float = 99.9,
    reference: str | None = None,
    lines: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]] | None = None,
) -> list[Figure]:
    """Draw several images with the same 0 dB amplitude, each into a figure of its own.

    Args:
        signals: Signals with two axes, by title; the first trial of each is drawn.
        dynamic_range_db: Range of levels shown in dB; everything lower is black.
        percentile: Percentile of the amplitude, 0 to 100, that is 0 dB.
        reference: Title of the image whose percentile is 0 dB; by default the first image.
        lines: Dashed lines over some of the images, by their titles: a mapping from names to pairs
            of coordinates (x, y), such as those of `boxes`.

    Returns:
        The figures, one for each signal.
    """
    width = _width(len(signals))
    top = level(signals[reference or next(iter(signals))], percentile, width)
    figures = {title: _show(signal, width, dynamic_range_db, title, top, "dB") for title, signal in signals.items()}
    for title, over in (lines or {}).items():
        _draw_over(figures[title], over, None)
    return list(figures.values())


@_styled
def contours(signals: Mapping[str, Signal], levels_db: Sequence[float] = (-30, -20, -13, -3)) -> list[Figure]:
    """Draw lines of equal amplitude of several images, range horizontal, azimuth vertical.

    Args:
        signals: Signals with two axes, by title; the first trial of each is drawn into a figure of
            its own.
        levels_db: Levels of the lines, in dB relative to the peak of each image, rising.

    Returns:
        The figures, one for each signal.
    """
    figures, width = [], _width(len(signals))
    for title, signal in signals.items():
        (vertical, horizontal), ratio = signal.axes, _to_scale(signal)
        figure, axes = _figure(width, min((width - 0.8) * (ratio or 0.8), _HIGHEST) + 1.1)
        drawn = axes.contour(
            array(horizontal.values()),
            array(vertical.values()),
            decibel(_first(signal).data),
            levels=list(levels_db),
            colors=COLOURS,
            linewidths=1.0,
        )
        axes.set(
            xlabel=f"{horizontal.name} ({horizontal.unit})",
            ylabel=f"{vertical.name} ({vertical.unit})",
            title=_wrapped(title, width),
            aspect="auto" if ratio is None else "equal",
        )
        names = [f"{level:g} dB" for level in levels_db]
        figure.legend(drawn.legend_elements()[0], names, loc="outside lower center", ncols=len(names))
        figures.append(figure)
    return figures


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
def overlays(parts: Sequence[Mapping[str, Any]], dynamic_range_db: float = 40.0) -> list[Figure]:
    """Draw images, each in dB relative to its own peak, with dashed lines over them.

    Args:
        parts: One mapping for each figure, with the keys `title`, `signal` (with two axes), `lines`
            (a mapping from names to pairs of coordinates (x, y)) and optionally `ylim`, the limits
            of the vertical axis. A mapping without `signal` has the arguments of `curves` and draws
            curves alone.
        dynamic_range_db: Range of levels shown in dB below the peak; everything lower is black.

    Returns:
        The figures, one for each part.
    """
    figures, width = [], _width(len(parts))
    for part in parts:
        if "signal" not in part:
            figures.append(_curves(width, **part))
            continue
        top = level(part["signal"], width=width)
        figures.append(_show(part["signal"], width, dynamic_range_db, part["title"], top, _below(100)))
        _draw_over(figures[-1], part["lines"], part.get("ylim"))
    return figures


def _draw_over(
    figure: Figure, lines: Mapping[str, tuple[np.ndarray, np.ndarray]], ylim: tuple[float, float] | None
) -> None:
    """Draw dashed lines over an image without a change of its limits."""
    axes = figure.axes[0]
    limits = axes.get_xlim(), axes.get_ylim()
    for i, (name, (x, y)) in enumerate(lines.items()):
        axes.plot(
            x, y, label=name, color=COLOURS[(i + 1) % len(COLOURS)], linestyle=DASHES[i % len(DASHES)], linewidth=1.2
        )
    axes.set(xlim=limits[0], ylim=ylim or limits[1])
    _legend_below(figure, axes, least=1)


def _first(signal: Signal) -> Signal:
    """First trial of a signal."""
    if not isinstance(signal, Signal):
        raise TypeError(f"a picture needs a Signal, got {type(signal).__name__}; wrap a tensor: Signal(data, axes)")
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

    The first curve is the widest, so that it stays visible under others.

    Args:
        series: Curves (x, y) by name, each a pair of arrays of shape (n,).
        xlabel: Label of the horizontal axis, with unit.
        ylabel: Label of the vertical axis, with unit.
        title: Title of the panel.
        marks: Positions of vertical lines by name, in the unit of x.
        ylim: Limits of the vertical axis.

    Returns:
        The figure.
    """
    return _curves(_ALONE, series, xlabel, ylabel, title, marks, ylim)


@_styled
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
    ratio = min(max(ratio, 1 / _ELONGATED), _ELONGATED)
    height = min(max((_ALONE - 0.9) * ratio, 1.2), _HIGHEST) + _BELOW
    figure, axes = _figure(_ALONE, height, aspect == "equal")
    largest = 14 if len(x) > _MANY else 40
    axes.scatter(x, y, s=largest * size / max(float(size.max()), 1e-300), color=COLOURS[0], linewidths=0)
    if aspect == "equal":
        middle = np.array([[x.min() + x.max(), y.min() + y.max()]]) / 2
        reach = 0.5 * max(float(np.ptp(x)), float(np.ptp(y))) / _ELONGATED
        axes.update_datalim(np.concatenate([middle - reach, middle + reach]))
    axes.margins(0.08)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title, aspect=aspect)
    return figure


@_styled
def panels(parts: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Draw several panels of curves, each into a figure of its own.

    Args:
        parts: One mapping for each panel, with the arguments of `curves`.

    Returns:
        The figures, one for each part.
    """
    return [_curves(_width(len(parts)), **part) for part in parts]


def _curves(
    width: float,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    marks: Mapping[str, float] | None = None,
    ylim: tuple[float, float] | None = None,
) -> Figure:
    """Draw curves into a new figure; the arguments are those of `curves`."""
    figure, axes = _figure(width, 0.68 * width)
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
    axes.set(xlabel=xlabel, ylabel=textwrap.fill(ylabel, round(7 * width)), title=_wrapped(title, width))
    if ylim is not None:
        axes.set_ylim(*ylim)
    _legend_below(figure, axes)
    return figure


@_styled
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
    figure, axes = _figure(_ALONE, 3.6)
    points = sorted(zip(seconds, loss, strict=True))
    front = [(s, e) for i, (s, e) in enumerate(points) if all(e < other for _, other in points[:i])]
    axes.set(xscale="log", xlabel="time (s)", ylabel=ylabel, title=title)
    for i, (name, s, e) in enumerate(zip(names, seconds, loss, strict=True), 1):
        colour = COLOURS[(i - 1) % len(COLOURS)]
        filled = colour if (s, e) in front else "white"
        axes.plot([s], [e], "o", color=colour, markerfacecolor=filled, markersize=7, label=f"{i}  {name}")
    axes.margins(0.12)
    low, high = (math.log10(x) for x in (points[0][0], points[-1][0]))
    margin = max(0.12 * (high - low), 0.3)  # decades; at least so much that ticks of 1, 2, 5 show
    low, high = low - margin, high + margin
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high - low < 3 else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
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
    _legend_below(figure, axes)
    return figure


def _number_points(axes: Axes, points: Sequence[tuple[float, float]]) -> None:
    """Write the number of every point beside it, clear of other points and numbers.

    Args:
        axes: Axes of a figure of one panel.
        points: Positions in shares of the axes.
    """
    size = np.array([72 * 0.8 * _ALONE, 72 * 0.75 * 3.6])  # of the panel in points of 1/72 inch, roughly
    at = [np.array(point) * size for point in points]
    taken = list(at)
    for i, point in enumerate(at, 1):
        beside = [np.array([9.0 * ring * x, 9.0 * ring * y]) for ring in (1, 2, 3, 4) for x, y in _AROUND]
        # the free position that is nearest; the last one where none is
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


@_styled
def error_curves(
    parts: Sequence[Mapping[str, Any]],
    xlabel: str,
    ylabel: str,
    log_x: bool = False,
    log_y: bool = False,
    ylim: tuple[float, float] | None = None,
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

    Returns:
        The figures, one for each part that has values.
    """
    filled = [part for part in parts if any(np.isfinite(_drawable(y, log_y)).any() for y, _ in part["series"].values())]
    figures, width = [], _width(len(filled))
    for part in filled:
        figure, axes = _figure(width, 0.62 * width)
        draw = _draw_dots if any(isinstance(x, str) for x in part["x"]) else _draw_bands
        draw(axes, part["x"], part["series"], part["bounds"], log_y)
        axes.set_yscale("log" if log_y else "linear")
        axes.set(xlabel=xlabel, ylabel=textwrap.fill(ylabel, round(7 * width)), title=_wrapped(part["title"], width))
        figures.append(figure)
    ends = [figure.axes[0].get_ylim() for figure in figures]
    common = ylim or (min((low for low, _ in ends), default=0.0), max((high for _, high in ends), default=1.0))
    for figure in figures:
        _scale_axes(figure.axes[0], np.asarray(filled[0]["x"]), log_x, log_y, common)
        _legend_below(figure, figure.axes[0])
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
    _label_words(axes, x)
    axes.set_xlim(-0.6, len(x) - 0.4)
    axes.grid(False, axis="x")


def _label_words(axes: Axes, words: Sequence[str]) -> None:
    """Write words below an axis: in lines where they fit, else slanted below a higher figure."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    fitting = int(_WORDS_FIT * figure.get_figwidth() / len(words))
    filled = [textwrap.fill(word, fitting, break_long_words=False) for word in words]
    longest = [max(map(len, text.splitlines()), default=0) + 1 for text in filled]
    if all(one + other <= 2 * fitting for one, other in itertools.pairwise(longest)):
        axes.set_xticks(np.arange(len(words)), filled)
        return
    figure.set_figheight(figure.get_figheight() + _SLANTED * max(map(len, words)))
    axes.set_xticks(np.arange(len(words)), words, rotation=40, ha="right")


def _scale_axes(axes: Axes, x: np.ndarray, log_x: bool, log_y: bool, ylim: tuple[float, float]) -> None:
    """Set scales, ticks and limits."""
    if x.dtype.kind != "U":
        axes.set_xscale("log" if log_x else "linear")
        position = np.log(x) if log_x else x
        if len(x) <= 8 and np.diff(position).min(initial=np.inf) > 0.08 * np.ptp(position):
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(*ylim)
    if log_y and ylim[1] < 1000 * ylim[0]:
        subs = (1, 2, 5) if ylim[1] > 10 * ylim[0] else (1, 1.5, 2, 3, 4, 5, 6, 8)
        axes.yaxis.set_major_locator(LogLocator(subs=subs))
        axes.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: f"{value:g}")
            if ylim[0] >= 1e-3 and ylim[1] < 1e5
            else LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf))
        )
        axes.yaxis.set_minor_formatter(NullFormatter())


def _legend_below(figure: Figure, axes: Axes, least: int = 2) -> None:
    """Legend below the axes, for which the figure grows, if there are enough entries."""
    handles, names = axes.get_legend_handles_labels()
    if len(names) < least:
        return
    fitting = int(_LETTERS * figure.get_figwidth() / (5 + max(map(len, names))))
    columns = max(1, min(fitting, len(names)))
    figure.set_figheight(figure.get_figheight() + 0.19 * math.ceil(len(names) / columns))
    figure.legend(handles, names, loc="outside lower center", ncols=columns)


@_styled
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
    figures, width = [], _width(len(shown))
    norm = _norm(np.concatenate([z.ravel() for _, z in shown] if limits is None else [np.asarray(limits)]), log)
    for part, z in shown:
        figure, axes = _figure(width, 0.68 * width)
        mesh = axes.imshow(z, norm=norm, cmap="viridis", origin="lower", aspect="auto", interpolation="nearest")
        _label_cells(axes, part, z, norm)
        figure.colorbar(mesh, ax=axes, label=textwrap.fill(label, 30), fraction=0.05, pad=0.02)
        axes.set(xlabel=xlabel, ylabel=textwrap.fill(ylabel, 30), title=_wrapped(part["title"], width))
        figures.append(figure)
    return figures


def _norm(z: np.ndarray, log: bool) -> Normalize:
    """Colour scale from the lowest to the highest finite value."""
    known = z[np.isfinite(z)]
    low, high = (float(known.min()), float(known.max())) if known.size else (1.0, 1.0)
    return (LogNorm if log else Normalize)(low, high if high > low else low + (abs(low) or 1.0) * 0.01)


def _label_cells(axes: Axes, part: Mapping[str, Any], z: np.ndarray, norm: Normalize) -> None:
    """Set ticks at values of the parameters and, for few cells, write their numbers."""
    for axis, values in ((axes.xaxis, part["x"]), (axes.yaxis, part["y"])):
        step = math.ceil(len(values) / 8)
        axis.set_ticks(np.arange(0, len(values), step), [f"{value:g}" for value in values[::step]])
    axes.grid(False)
    if z.size <= _CELLS[0] and z.shape[1] <= _CELLS[1]:
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


def save(figure: Figure | Sequence[Figure], path: Any, dpi: int = 120, columns: int = 2) -> None:
    """Write one figure, or several figures as one picture, to a file.

    Args:
        figure: Figure to write, or several, which are set side by side, row by row.
        path: Path of the file, whose suffix gives the format, or a binary file for PNG.
        dpi: Resolution in dots per inch.
        columns: Number of panels in a row.
    """
    kind = "png" if not isinstance(path, str | PathLike) or str(path).endswith(".png") else None
    figures = [figure] if isinstance(figure, Figure) else figure
    if len(figures) == 1 and kind is None:
        figures[0].savefig(path, dpi=dpi)  # with its vectors, where the format has them
        return
    # savefig draws a figure with a layout twice
    drawn = [_pixels(one, dpi) for one in figures]
    rows = [drawn[first : first + columns] for first in range(0, len(drawn), columns)]
    wide = [max(row[i].shape[1] for row in rows if i < len(row)) for i in range(len(rows[0]))]
    sheet = np.full((sum(max(len(one) for one in row) for row in rows), sum(wide), 4), 255, np.uint8)
    above = 0
    for row in rows:
        for i, one in enumerate(row):
            left = sum(wide[:i])
            sheet[above : above + len(one), left : left + one.shape[1]] = one
        above += max(len(one) for one in row)
    imsave(path, sheet, dpi=dpi, format=kind)


def _pixels(figure: Figure, dpi: int) -> np.ndarray:
    """A figure as colours, shape (height, width, 4)."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def array(x: Tensor) -> np.ndarray:
    """Convert a tensor to a numpy array on the CPU, without gradient.

    Args:
        x: Tensor, any shape.

    Returns:
        Array of the same shape and type.
    """
    return torch.as_tensor(x).detach().cpu().resolve_conj().numpy()


# units by the last words of a name, the longest first
_UNITS = {
    "_per_s2": "1/s²",
    "_per_s": "1/s",
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
_WRITTEN = [
    "Doppler",
    "SNR",
    "PRF",
    "RMS",
    "RMSE",
    "IRW",
    "PSLR",
    "ISLR",
    "RCS",
    "SIR",
    "CNR",
    "SCR",
    "SCNR",
    "MFTA",
    "ADC",
]
_ACRONYMS = {word.lower(): word for word in _WRITTEN}


def name_and_unit(name: str) -> tuple[str, str]:
    """Split the last part of a dotted name into words and unit.

    Args:
        name: Name with its unit, such as 'world.noise.snr_db'.

    Returns:
        Words and unit, such as ('SNR', 'dB').
    """
    last = name.rpartition(".")[2]
    suffix = next((suffix for suffix in _UNITS if last.endswith(suffix) and last != suffix), "")
    words = last.removesuffix(suffix).strip("_").split("_")
    return " ".join(_ACRONYMS.get(word, word) for word in words), _UNITS.get(suffix, "")


def axis_label(name: str) -> str:
    """Make the label of an axis from a name.

    Args:
        name: Name with its unit, such as 'doppler_error_hz'.

    Returns:
        Label such as 'Doppler error (Hz)'.
    """
    words, unit = name_and_unit(name)
    return f"{words} ({unit})" if unit else words
