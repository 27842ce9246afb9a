"""Figures of images and raw data, range horizontal, azimuth or slow time vertical."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchsar.core import Axis, Signal
from torchsar.metrics import impulse_response
from torchsar.metrics.cuts import impulse_cuts
from torchsar.plot.curves import curves_of
from torchsar.plot.style import (
    ALONE,
    BELOW,
    COLOURS,
    DASHES,
    ELONGATED,
    HIGHEST,
    PANEL,
    array,
    legend_below,
    new_figure,
    panel_width,
    styled,
    wrapped_title,
)

# number of averaged blocks of an image per inch of a figure; fewer than pixels, so that each block
# is drawn
_BLOCKS_PER_INCH = 90


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

    Raises:
        ValueError: If the signal does not have two axes.
    """
    if len(signal.axes) != 2:
        raise ValueError(
            f"a picture needs a Signal with two axes, got {signal.names}; `signal.isel(AXIS=0)` removes an axis, and "
            '`plot.curves({"profile": (axis.values(), abs(signal))}, "x", "y")` draws a profile'
        )
    data, axes = signal.data.detach().abs(), []
    data = torch.where(torch.isfinite(data), data, torch.nan)
    peak = torch.nan_to_num(data).amax()
    # divided by the peak, since squares of the amplitudes may overflow
    data = data / torch.where(peak > 0, peak, 1)
    for dim, axis in zip((-2, -1), signal.axes, strict=True):
        step = math.ceil(axis.n / largest)
        count = axis.n // step
        data = data.narrow(dim, 0, count * step).unflatten(dim, (count, step))
        data = data.square().mean(dim if dim == -1 else -2).sqrt()
        axes.append(Axis(axis.name, count, axis.start + (step - 1) / 2 * axis.step, axis.step * step, axis.unit))
    return Signal(data * peak, tuple(axes))


def _largest(amplitude: np.ndarray) -> float:
    """Largest finite amplitude; 0 if no amplitude is finite."""
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


def _label(axis: Axis, more: str = "") -> str:
    """Label of an axis of a picture. The Doppler frequency of sampled pulses is known within one
    PRF only, which is called baseband.
    """
    name = "baseband Doppler" if axis.name == "doppler" else axis.name.replace("_", " ")
    return f"{name}{more} ({axis.unit})"


def _extent(signal: Signal, origin: Sequence[float]) -> tuple[float, float, float, float]:
    """Edges of an image as `imshow` needs them, relative to an origin of the axes."""
    vertical, horizontal = signal.axes
    v, h = vertical.start - origin[0], horizontal.start - origin[1]
    return (
        h - horizontal.step / 2,
        h + (horizontal.n - 0.5) * horizontal.step,
        v - vertical.step / 2,
        v + (vertical.n - 0.5) * vertical.step,
    )


def _to_scale(signal: Signal) -> float | None:
    """Ratio of height to width of an image whose axes have the same scale.

    None if the axes have different units or the image would be too elongated.
    """
    vertical, horizontal = signal.axes
    ratio = vertical.n * vertical.step / (horizontal.n * horizontal.step)
    fits = vertical.unit == horizontal.unit and 1 / ELONGATED <= ratio <= ELONGATED
    return ratio if fits else None


def level(signal: Signal, percentile: float = 100.0, width: float = PANEL) -> float:
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
    """Draw the first trial of a signal in a new figure, with equal scales if that is possible."""
    signal = _first(signal)
    view, ratio = quicklook(signal, round(_BLOCKS_PER_INCH * width)), _to_scale(signal)
    beside = 1.55  # inches for labels and the colour scale
    height = min((width - beside) * (ratio or 0.8), HIGHEST) + BELOW
    figure, axes = new_figure(width, height, ratio is not None)
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
        xlabel=_label(signal.axes[1], beyond),
        ylabel=_label(signal.axes[0]),
        title=wrapped_title(title, width),
    )
    axes.grid(False)
    # the colour scale has the height of the image
    words = textwrap.fill(label, max(15, round(12 * (height - 0.3))))
    figure.colorbar(shown, ax=axes, label=words, fraction=0.05, pad=0.02, aspect=20 * max(1.0, ratio or 1.0))
    return figure


def _below(percentile: float) -> str:
    """Label of the colour scale that names the amplitude shown as 0 dB."""
    return "dB relative to the peak" if percentile == 100 else f"dB relative to percentile {percentile:g}"


@styled
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
    top = level(signal, percentile, ALONE)
    return _show(signal, ALONE, dynamic_range_db, title, top, _below(percentile))


@styled
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
    width = panel_width(len(signals))
    top = level(signals[reference or next(iter(signals))], percentile, width)
    label = _below(percentile)
    figures = {title: _show(signal, width, dynamic_range_db, title, top, label) for title, signal in signals.items()}
    for title, over in (lines or {}).items():
        _draw_over(figures[title], over, None)
    return list(figures.values())


@styled
def response(signal: Signal, at_m: tuple[float, float], floor_db: float = -50.0) -> list[Figure]:
    """Draw both cuts of the point response nearest to a position, in dB relative to its peak.

    The cuts have 16 points per sample. A line marks the -3 dB width, and the title has the PSLR,
    both as by `metrics.impulse_response`.

    Args:
        signal: Image with two axes; the first trial is drawn.
        at_m: Coordinates on the two axes in metres.
        floor_db: Lowest level shown in dB.

    Returns:
        The figures, one for each axis.

    Raises:
        ValueError: If the position lies outside the image, or a sample is not finite.
    """
    one, figures = _first(signal), []
    measured, cuts = impulse_response(one, at_m), impulse_cuts(one, at_m)
    for axis in one.axes:
        half = float(measured[f"irw_{axis.name}_m"]) / 2
        mark = np.array([-half, half]), np.full(2, -3.0)
        series = {
            "cut": (array(cuts[axis.name][0]), decibel(cuts[axis.name][1], float(measured["peak"].abs()))),
            f"-3 dB width {2 * half:.3g} {axis.unit}": mark,
        }
        title = f"{axis.name}: PSLR {float(measured[f'pslr_{axis.name}_db']):.1f} dB"
        xlabel = _label(axis, " from the peak")
        figures.append(curves_of(PANEL, series, xlabel, "level (dB)", title, ylim=(floor_db, 1.0)))
    return figures


@styled
def contours(signals: Mapping[str, Signal], levels_db: Sequence[float] = (-30, -20, -13, -3)) -> list[Figure]:
    """Draw lines of equal amplitude of several images, range horizontal, azimuth vertical.

    Args:
        signals: Signals with two axes, by title; the first trial of each is drawn into a figure of
            its own.
        levels_db: Levels of the lines, in dB relative to the peak of each image, rising.

    Returns:
        The figures, one for each signal.
    """
    figures, width = [], panel_width(len(signals))
    for title, signal in signals.items():
        (vertical, horizontal), ratio = signal.axes, _to_scale(signal)
        figure, axes = new_figure(width, min((width - 0.8) * (ratio or 0.8), HIGHEST) + 1.1)
        drawn = axes.contour(
            array(horizontal.values()),
            array(vertical.values()),
            decibel(_first(signal).data),
            levels=list(levels_db),
            colors=COLOURS,
            linewidths=1.0,
        )
        axes.set(
            xlabel=_label(horizontal),
            ylabel=_label(vertical),
            title=wrapped_title(title, width),
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


@styled
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
    figures, width = [], panel_width(len(parts))
    for part in parts:
        if "signal" not in part:
            figures.append(curves_of(width, **part))
            continue
        top = level(part["signal"], width=width)
        figures.append(_show(part["signal"], width, dynamic_range_db, part["title"], top, _below(100)))
        _draw_over(figures[-1], part["lines"], part.get("ylim"))
    return figures


def _draw_over(
    figure: Figure, lines: Mapping[str, tuple[np.ndarray, np.ndarray]], ylim: tuple[float, float] | None
) -> None:
    """Draw dashed lines over an image without changing the limits of the axes."""
    axes = figure.axes[0]
    limits = axes.get_xlim(), axes.get_ylim()
    for i, (name, (x, y)) in enumerate(lines.items()):
        axes.plot(
            x, y, label=name, color=COLOURS[(i + 1) % len(COLOURS)], linestyle=DASHES[i % len(DASHES)], linewidth=1.2
        )
    axes.set(xlim=limits[0], ylim=ylim or limits[1])
    legend_below(figure, axes, least=1)


def _first(signal: Signal) -> Signal:
    """First trial of a signal."""
    return signal.with_data(signal.data.flatten(0, len(signal.trials) - 1)[0]) if signal.trials else signal
