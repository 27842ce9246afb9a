"""Pictures: the only importer of the plotting library. Every function takes signals or arrays and returns a matplotlib Figure."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Signal

try:
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError("torchsar.plot needs matplotlib: pip install 'torchsar-lab[study]'") from error

INK, ACCENT, SECOND, THIRD, FAINT = "#1f2933", "#0b6e99", "#d1495b", "#e09f3e", "#9aa5b1"
COLOURS = (ACCENT, SECOND, THIRD, "#4f7942", "#6a4c93", FAINT)
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


def _panels(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def decibel(x: Tensor | np.ndarray, reference: float | None = None) -> np.ndarray:
    """20 lg |x| relative to the reference amplitude, by default the largest."""
    amplitude = np.abs(x.detach().cpu().numpy() if isinstance(x, Tensor) else x)
    top = reference if reference is not None else float(amplitude.max(initial=0.0))
    return 20 * np.log10(np.maximum(amplitude, 1e-15 * (top or 1.0)) / (top or 1.0))


def quicklook(signal: Signal, largest: int = 900) -> Signal:
    """Root mean square amplitude over blocks, so that no side has more than `largest` samples; unbatched, the axes follow."""
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
    return h - horizontal.step / 2, h + (horizontal.n - 0.5) * horizontal.step, v - vertical.step / 2, v + (vertical.n - 0.5) * vertical.step


def _show(axes: Axes, signal: Signal, dynamic_range_db: float, title: str, reference: float | None = None, percentile: float = 100.0) -> Any:
    """Draw one image into existing axes."""
    view = quicklook(signal)
    amplitude = view.data.cpu().numpy()
    top = reference if reference is not None else float(np.percentile(amplitude, percentile)) or float(amplitude.max(initial=1.0))
    origin = (0.0, signal.axes[1].start if signal.axes[1].start > 1e4 else 0.0)
    shown = axes.imshow(decibel(amplitude, top), cmap="gray", vmin=-dynamic_range_db, vmax=0, origin="lower", aspect="auto", extent=_extent(view, origin), interpolation="nearest")
    beyond = f" beyond {origin[1]:,.0f} m" if origin[1] else ""
    axes.set(xlabel=f"{signal.axes[1].name}{beyond} ({signal.axes[1].unit})", ylabel=f"{signal.axes[0].name} ({signal.axes[0].unit})", title=title)
    axes.grid(False)
    return shown


@_styled
def image(signal: Signal, dynamic_range_db: float = 50.0, title: str = "", percentile: float = 99.9) -> Figure:
    """An image or a raw matrix in dB, range horizontal, azimuth vertical, axes in their units. The first trial of a batch.

    0 dB is a high percentile of the amplitude, so that one bright ship does not hide the land; 100, the peak, suits scenes of points.
    """
    figure, (axes,) = _panels(1, 1, (7.2, 6.2))
    shown = _show(axes, _first(signal), dynamic_range_db, title, percentile=percentile)
    figure.colorbar(shown, ax=axes, label="amplitude (dB below the peak)" if percentile == 100 else f"amplitude (dB below the {percentile:g}th percentile)", shrink=0.8)
    return figure


@_styled
def images(signals: Mapping[str, Signal], dynamic_range_db: float = 50.0, columns: int = 2, percentile: float = 99.9) -> Figure:
    """Several images side by side on one scale, taken from the first of them; arguments as `image`."""
    rows = math.ceil(len(signals) / columns)
    figure, panels = _panels(rows, min(columns, len(signals)), (4.6 * min(columns, len(signals)), 3.9 * rows))
    first = quicklook(_first(next(iter(signals.values())))).data.cpu().numpy()
    top = float(np.percentile(first, percentile)) or None
    shown: Any = None
    for axes, (title, signal) in zip(panels, signals.items(), strict=False):
        shown = _show(axes, _first(signal), dynamic_range_db, title, top)
    for axes in panels[len(signals) :]:
        axes.set_visible(False)
    figure.colorbar(shown, ax=panels, label="amplitude (dB)", shrink=0.6)
    return figure


def _first(signal: Signal) -> Signal:
    return signal.with_data(signal.data.flatten(0, -3)[0]) if signal.trials else signal


@_styled
def curves(series: Mapping[str, tuple[np.ndarray, np.ndarray]], xlabel: str, ylabel: str, title: str = "", marks: Mapping[str, float] | None = None, ylim: tuple[float, float] | None = None) -> Figure:
    """Lines by name in one panel; marks: vertical lines by name."""
    figure, (axes,) = _panels(1, 1, (7.2, 3.2))
    draw_curves(axes, series, xlabel, ylabel, title, marks, ylim)
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
    """Draw lines by name into existing axes; the first is the widest, so that others which lie on it are seen."""
    for i, (name, (x, y)) in enumerate(series.items()):
        axes.plot(x, y, label=name, color=COLOURS[i % len(COLOURS)], linewidth=max(0.9, 2.0 - 0.45 * i) if len(series) > 1 else 1.2)
    for i, (name, place) in enumerate((marks or {}).items()):
        axes.axvline(place, color=COLOURS[(len(series) + i) % len(COLOURS)], linestyle="--", linewidth=1, label=name)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    if ylim is not None:
        axes.set_ylim(*ylim)
    if len(series) + len(marks or {}) > 1:
        axes.legend(loc="best")


@_styled
def trade(names: Sequence[str], seconds: Sequence[float], error_db: Sequence[float], ylabel: str, title: str) -> Figure:
    """Time against accuracy: one labelled point an alternative, faster to the left, better at the bottom."""
    figure, (axes,) = _panels(1, 1, (7.2, 4.2))
    for i, (name, s, e) in enumerate(zip(names, seconds, error_db, strict=True)):
        axes.plot([s], [e], "o", color=COLOURS[i % len(COLOURS)], markersize=7)
        axes.annotate(name, (s, e), textcoords="offset points", xytext=(7, 4 if i % 2 else -10), fontsize=8, color=INK)
    axes.set(xscale="log", xlabel="time (s)", ylabel=ylabel, title=title)
    axes.margins(0.18)
    return figure


def save(figure: Figure, path: Any, dpi: int = 110) -> None:
    """Write a PNG."""
    figure.savefig(path, dpi=dpi)


def array(x: Tensor) -> np.ndarray:
    """A tensor as a numpy array."""
    return torch.as_tensor(x).detach().cpu().resolve_conj().numpy()
