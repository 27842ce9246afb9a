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
