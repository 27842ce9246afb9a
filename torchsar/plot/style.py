"""The style of all figures, their panels, labels and legends, and how they are saved."""

from __future__ import annotations

import functools
import io
import math
import textwrap
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, TypeVar

import numpy as np
import torch
from cycler import cycler
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter, LogLocator
from torch import Tensor

from torchsar.core.show import argument

# palette, by choice: colours of text and frames, and colours of curves in their order
INK, ACCENT, SECOND, THIRD, FAINT = "#1f2933", "#0b6e99", "#d1495b", "#e09f3e", "#9aa5b1"
COLOURS = (ACCENT, SECOND, THIRD, "#4f7942", "#6a4c93", FAINT, "#8d5524", "#1aa6a6")
# seven markers and eight colours, so that more than eight curves also differ
MARKERS, DASHES = "osD^vPX", ("--", ":", "-.")
# ALONE: width in inches of a figure that is the only one in its row
# PANEL: width in inches of one of several panels
# On a page 420 pixels wide, 386 pixels are left for a figure; text of 9 points is then at least 9
# pixels high.
ALONE, PANEL = 5.2, 3.9
# largest ratio of the sides of a picture with equal scales; more elongated pictures are illegible
ELONGATED = 4.0
# BELOW: inches below images for labels
# HIGHEST: largest height of an image in inches
BELOW, HIGHEST = 0.85, 4.6
# number of letters of titles and legends in an inch
_LETTERS = 11.0
# settings of matplotlib, by choice
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
    """Figure that a notebook shows without pyplot and its settings."""

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


def styled(draw: Callable[..., Drawn]) -> Callable[..., Drawn]:
    """Run a drawing function in the style of this package, without a change of global settings.

    Texts that are no formulas of matplotlib, such as commands of LaTeX that it lacks, are shown as
    they are written. Logarithmic axes without labels of their own show plain numbers.

    Args:
        draw: Function that returns a figure or a list of figures.

    Returns:
        The function in that style; a list becomes `Panels`.
    """

    @functools.wraps(draw)
    def styled(*args: Any, **options: Any) -> Any:
        with rc_context(_STYLE):
            drawn = draw(*args, **options)
        for figure in drawn if isinstance(drawn, list) else [drawn]:
            for text in figure.findobj(Text):
                text.set_parse_math("$" in text.get_text() and _is_formula(text.get_text()))
            _number_ticks(*(axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)))
        return Panels(drawn) if isinstance(drawn, list) else drawn

    return styled


def _number_ticks(*axes: Axis) -> None:
    """Write plain numbers at logarithmic axes, also between powers of 10 at short ones."""
    for axis in (axis for axis in axes if isinstance(axis.get_major_formatter(), LogFormatter)):
        low, high = axis.get_view_interval()
        if high < 1000 * low:
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 6, 8)))
        axis.set(major_formatter=lambda value, _: f"{value:g}", minor_formatter="")


def _is_formula(text: str) -> bool:
    """True if matplotlib can draw a text as a formula."""
    try:
        MathTextParser("path").parse(text)
    except ValueError:
        return False
    return True


def new_figure(width: float, height: float, to_scale: bool = False) -> tuple[Figure, Axes]:
    """Make a figure of one panel.

    Args:
        width: Width in inches.
        height: Height in inches.
        to_scale: The axes have the same scale, and the figure leaves no margins beside them.

    Returns:
        The figure and its axes.
    """
    figure = _NotebookFigure(figsize=(width, height), layout="compressed" if to_scale else "constrained")
    return figure, figure.subplots()


def panel_width(count: int) -> float:
    """Width of each of several panels.

    Args:
        count: Number of panels.

    Returns:
        The width in inches.
    """
    return ALONE if count == 1 else PANEL


def wrapped_title(title: str, width: float) -> str:
    """Break a title into lines that fit a figure.

    Args:
        title: Title.
        width: Width of the figure in inches.

    Returns:
        The title with line breaks.
    """
    return textwrap.fill(title, round(_LETTERS * (width - 0.5)))


def legend_below(figure: Figure, axes: Axes, least: int = 2) -> None:
    """Draw a legend below the axes, for which the figure grows.

    Args:
        figure: Figure, which is changed.
        axes: Axes whose entries the legend shows.
        least: A legend with fewer entries is not drawn.
    """
    handles, names = axes.get_legend_handles_labels()
    if len(names) < least:
        return
    fitting = int(_LETTERS * figure.get_figwidth() / (5 + max(map(len, names))))
    columns = max(1, min(fitting, len(names)))
    figure.set_figheight(figure.get_figheight() + 0.19 * math.ceil(len(names) / columns))
    figure.legend(handles, names, loc="outside lower center", ncols=columns)


def save(
    figure: Figure | Sequence[Figure], path: Any, dpi: int = 120, columns: int = 2, width_in: float | None = None
) -> None:
    """Write one figure, or several figures as one picture, to a file.

    PDF and SVG hold text as text, in fonts that publishers accept (TrueType).

    Args:
        figure: Figure to write, or several, which are set side by side, row by row.
        path: Path of the file, whose suffix gives the format, or a binary file for PNG.
        dpi: Resolution in dots per inch.
        columns: Number of panels in a row.
        width_in: Width of a figure in inches, such as 3.5 for one column of a journal and 7.16 for
            two; the height follows, and text keeps its size. None for the width of the figure.

    Raises:
        TypeError: If there is no figure.
    """
    kind = "png" if not isinstance(path, str | PathLike) or str(path).endswith(".png") else None
    figures = [figure] if isinstance(figure, Figure) else figure
    if not (isinstance(figures, Sequence) and figures and all(isinstance(one, Figure) for one in figures)):
        raise TypeError(f"save writes a figure or a list of figures, got {argument(figure)}; draw: plot.image(signal)")
    for one in figures:
        if width_in is not None:
            one.set_size_inches(width_in, one.get_figheight() * width_in / one.get_figwidth())
    if len(figures) == 1 and kind is None:
        with rc_context({"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none"}):
            figures[0].savefig(path, dpi=dpi)  # in vector graphics if the file format has them
        return
    # pixels are drawn here because savefig would draw a figure with a layout twice
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
    """Draw a figure as an image of colours, (height, width, 4)."""
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


# units by the last words of a name; longer endings come first
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
# words of names that have capital letters
_WRITTEN = "Doppler SNR PRF RMS RMSE IRW PSLR ISLR RCS SIR CNR SCR SCNR MFTA ADC"
_ACRONYMS = {word.lower(): word for word in _WRITTEN.split()}


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
