"""Pictures of the ladar: short-time spectra, contours and overlays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchsar import plot
from torchsar.core import Axis, Signal


@pytest.mark.parametrize("is_complex", [True, False])
def test_short_time_spectrum_finds_a_tone(is_complex: bool) -> None:
    time_s = torch.arange(1024, dtype=torch.float64) / 64e6
    tone = torch.polar(torch.ones_like(time_s), 2 * np.pi * 5e6 * time_s) * (time_s > 8e-6)
    shown = plot.short_time_spectrum(tone if is_complex else tone.real, 64e6)
    assert shown.names == ("frequency", "time")
    late = shown.data[:, int(shown.axis("time").index_of(12.0).round())]
    assert abs(float(shown.axis("frequency").values()[int(late.argmax())]) - 5.0) < 0.1
    strength = shown.data.amax(0)
    middle = float(shown.axis("time").values()[int((strength > strength.max() / 2).to(torch.int8).argmax())])
    assert abs(middle - 8.0) < 0.1  # a tone that begins in the middle of a window gives half


def test_contours_and_overlays_draw() -> None:
    axes = Axis("azimuth", 20, -1.0, 0.1, "m"), Axis("range", 30, 0.0, 0.1, "m")
    blob = torch.exp(-(axes[0].values()[:, None].square() + (axes[1].values() - 1.5).square()) / 0.2).to(
        torch.complex64
    )
    drawn = plot.contours({"a": Signal(blob, axes), "b": Signal(blob[None], axes)})
    assert [figure.axes[0].get_title() for figure in drawn] == ["a", "b"]
    assert len(drawn[0].axes[0].collections) and drawn[0].axes[0].get_xlabel() == "range (m)"
    line = np.array([0.0, 2.0]), np.array([0.0, 0.5])
    parts = [
        {"title": "with", "signal": Signal(blob, axes), "lines": {"line": line}},
        {"series": {"line": line}, "xlabel": "x", "ylabel": "y", "title": "without"},
    ]
    over, beside = (figure.axes[0] for figure in plot.overlays(parts))
    assert over.get_images() and len(over.get_lines()) == 1 and not beside.get_images()
    assert over.get_xlim() == pytest.approx((-0.05, 2.95))


def test_lines_over_one_of_several_images_change_no_limits() -> None:
    signal = Signal(torch.rand(20, 30) + 0j, (Axis("azimuth", 20, -1.0, 0.1, "m"), Axis("range", 30, 0.0, 0.1, "m")))
    outline = plot.boxes([(0.0, 0.0)], 9.0, 0.2)  # wider than the image
    marked, plain = plot.images({"a": signal, "b": signal}, lines={"a": {"part": outline}})
    assert [text.get_text() for text in marked.legends[0].get_texts()] == ["part"] and not plain.legends
    assert len(marked.axes[0].lines) == 1 and marked.axes[0].get_xlim() == plain.axes[0].get_xlim()
    assert marked.axes[0].get_ylim() == plain.axes[0].get_ylim()
