"""A notebook shows the figures of torchsar.plot by itself, single ones and panels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar.core import Axis, Signal

plot = pytest.importorskip("torchsar.plot")
SIGNAL = Signal(torch.rand(24, 32), (Axis("azimuth", 24, 0.0, 1.0, "m"), Axis("range", 32, 0.0, 1.0, "m")))


def test_figures_and_panels_show_the_picture_that_save_writes(tmp_path: Path) -> None:
    from matplotlib.image import imread

    for draw in (lambda: plot.image(SIGNAL), lambda: plot.images({"a": SIGNAL, "b": SIGNAL, "c": SIGNAL})):
        shown = tmp_path / "shown.png"
        shown.write_bytes(draw()._repr_png_())
        plot.save(draw(), tmp_path / "saved.png")
        assert np.array_equal(imread(shown), imread(tmp_path / "saved.png")) and imread(shown).std() > 0.1


def test_what_functions_draw_stays_a_matplotlib_figure_or_a_list() -> None:
    from matplotlib.figure import Figure

    panels = plot.images({"a": SIGNAL, "b": SIGNAL})
    assert isinstance(plot.image(SIGNAL), Figure)
    assert isinstance(panels, list) and all(isinstance(one, Figure) for one in panels)


def test_a_response_has_both_cuts_with_width_and_side_lobes() -> None:
    line = torch.sinc(torch.arange(-64.0, 64.0) / 2)
    axes = Axis("azimuth", 128, -32.0, 0.5, "m"), Axis("range", 128, -128.0, 2.0, "m")
    figures = plot.response(Signal(torch.outer(line, line) + 0j, axes), (0.0, 0.0))
    for figure, name, width in zip(figures, ("azimuth", "range"), (0.886, 3.54), strict=True):
        cut, mark = figure.axes[0].get_lines()
        assert figure.axes[0].get_title() == f"{name}: PSLR -13.3 dB"
        assert np.ptp(mark.get_xdata()) == pytest.approx(width, rel=5e-3) and f"{width:.3g}"[:3] in mark.get_label()
        x, level = cut.get_xdata(), cut.get_ydata()
        assert level.max() == pytest.approx(0, abs=1e-3) and len(x) > 128
        assert np.interp(width / 2, x, level) == pytest.approx(-3, abs=0.1)


def test_the_label_of_the_colours_fits_a_flat_image() -> None:
    flat = Signal(torch.rand(24, 96), (Axis("azimuth", 24, 0.0, 1.0, "m"), Axis("range", 96, 0.0, 1.0, "m")))
    for figure in (plot.image(flat), *plot.images({"a": flat, "b": flat})):
        figure.canvas.draw()
        label = figure.axes[1].yaxis.label
        box = label.get_window_extent()
        assert "percentile 99.9" in label.get_text() and box.y0 >= 0 and box.y1 <= figure.bbox.height


def test_doppler_frequencies_are_those_of_baseband() -> None:
    axes = Axis("doppler", 24, -12.0, 1.0, "Hz"), Axis("range_frequency", 32, 0.0, 1.0, "1/m")
    drawn = plot.image(Signal(torch.rand(24, 32), axes)).axes[0]
    assert (drawn.get_ylabel(), drawn.get_xlabel()) == ("baseband Doppler (Hz)", "range frequency (1/m)")


def test_curves_have_limits_of_both_axes() -> None:
    axes = plot.curves({"a": (np.arange(9.0), np.arange(9.0))}, "x", "y", ylim=(1, 2), xlim=(3, 4)).axes[0]
    assert axes.get_xlim() == (3, 4) and axes.get_ylim() == (1, 2)


def test_a_profile_is_no_picture_and_what_draws_it_is_named() -> None:
    profile = SIGNAL.isel(azimuth=0)
    with pytest.raises(ValueError, match=r"a Signal with two axes, got \('range',\); .*plot.curves"):
        plot.image(profile)
    with pytest.raises(ValueError, match="a Signal with two axes"):
        plot.image(Signal(torch.rand(2, 32), profile.axes))
    plot.curves({"profile": (profile.axes[0].values(), abs(profile))}, "range (m)", "amplitude")
