"""Pictures of images that hold zeros, NaN or infinities, and of amplitudes of any size."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar.core import Axis, Signal
from torchsar.study.output.report import draw_all

plot = pytest.importorskip("torchsar.plot")
CHANGES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "NaN": lambda x: x.index_fill(0, torch.tensor(3), torch.nan),
    "only NaN": lambda x: x * torch.nan,
    "infinite": lambda x: x.index_fill(0, torch.tensor(3), torch.inf),
    "zero": lambda x: 0 * x,
    "large": lambda x: 1e30 * x,
    "small": lambda x: 1e-38 * x,
}


def signal_of(data: torch.Tensor) -> Signal:
    return Signal(data, (Axis("azimuth", 24, 0.0, 1.0, "m"), Axis("range", 32, 0.0, 1.0, "m")))


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_any_image_is_drawn(change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    plain = torch.randn(24, 32, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    signal = signal_of(change(plain))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot.images({"a": signal, "b": signal_of(plain)})
        plot.image(signal, percentile=100.0)
        plot.contours({"a": signal})
        levels = plot.decibel(signal.data)
    assert np.isfinite(levels).sum() == torch.isfinite(signal.data.abs()).sum() and np.isfinite(plot.level(signal))


def test_sizes_do_not_change_the_average_of_blocks() -> None:
    signal = signal_of(torch.randn(24, 32, dtype=torch.complex64))
    expected = signal.data.abs().square().unflatten(0, (12, 2)).unflatten(2, (16, 2)).mean((1, 3)).sqrt()
    for scale in (1e30, 1.0, 1e-30):
        torch.testing.assert_close(plot.quicklook(signal_of(scale * signal.data), 16).data, scale * expected)


@pytest.mark.parametrize("text", [r"$\SI{1}{m/s}$", r"$\frac{1}$", "5 $ and 6 $", r"$\sigma$ of $10^3$", "$"])
def test_texts_that_are_no_formulas_are_shown_as_they_are_written(text: str) -> None:
    series = {text: (np.arange(3.0), np.arange(3.0)), "b": (np.arange(3.0), np.ones(3))}
    plot.save(plot.curves(series, text, text, title=text), io.BytesIO())


@pytest.mark.parametrize("low", [1e-12, 8e-5, 0.3, 2e4])
@pytest.mark.parametrize("ratio", [1.02, 3.0, 80.0, 1e5])
def test_logarithmic_axes_show_plain_numbers(low: float, ratio: float) -> None:
    x, y = low * np.geomspace(1.0, ratio, 12), low * np.geomspace(1.0, ratio, 12)
    part = {"title": "", "x": x, "series": {"a": (y, np.stack([y, y], -1))}, "bounds": {}}
    words = {**part, "x": ["a", "b"], "series": {"a": (y[[0, -1]], np.stack([y[[0, -1]]] * 2, -1))}}
    map_ = {"title": "", "x": [1, 2, 3], "y": [1, 2, 3, 4], "z": y.reshape(4, 3)}
    figures = [
        *plot.error_curves([part], "x", "y", log_x=True, log_y=True),
        *plot.error_curves([words], "", "y", log_y=True),
        *plot.heat_map([map_], "x", "y", "z", log=True),
        plot.trade(["a", "b"], [x[0], x[-1]], [1.0, 0.5], "loss (dB)", "t"),
    ]
    for figure in figures:
        plot.save(figure, io.BytesIO())
        for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
            texts = [text.get_text() for text in axis.get_ticklabels(which="both")]
            assert not any("$" in text for text in texts), texts
            assert axis.get_scale() == "linear" or ratio < 2 or sum(map(bool, texts)) > 1, texts


def test_a_picture_that_fails_costs_no_other(tmp_path: Path) -> None:
    def drawn(name: str) -> Iterator:
        yield name, name, "A caption.", plot.curves({"a": (np.arange(3.0), torch.arange(3.0))}, "x", "y")

    def failing() -> Iterator:
        yield from drawn("first")
        raise ZeroDivisionError("division by zero")

    def full() -> Iterator:
        raise OSError("No space left on device")
        yield

    found = draw_all([failing, lambda: drawn("x" * 400)], tmp_path)
    assert [len(picture.files) for picture in found] == [1, 0, 1]
    assert "could not be drawn (ZeroDivisionError: division by zero)" in found[1].caption
    with pytest.raises(OSError, match="No space"):
        draw_all([full], tmp_path)
