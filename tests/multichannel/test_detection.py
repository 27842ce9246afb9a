"""Detection of bright positions in an image."""

from __future__ import annotations

import pytest
import torch

from torchsar.core import Axis, Signal
from torchsar.multichannel import detect
from torchsar.multichannel.chip import contrast

AXES = (Axis("azimuth", 800, -400.0, 1.0, "m"), Axis("range", 64, 5000.0, 5.0, "m"))


def speckle(seed=1) -> torch.Tensor:
    return torch.randn(800, 64, dtype=torch.complex64, generator=torch.Generator().manual_seed(seed))


def patch(data, azimuth_m, range_m, level) -> None:
    row, column = round(azimuth_m + 400), round((range_m - 5000) / 5)
    data[row - 15 : row + 16, column - 1 : column + 2] *= level


def test_bright_positions_are_detected_strongest_first() -> None:
    data = speckle()
    patch(data, -100.0, 5100.0, 8.0)
    patch(data, 150.0, 5200.0, 20.0)
    found = detect(Signal(data, AXES), apart_m=(100.0, 30.0))
    assert len(found) == 2 and found[0].contrast_db > found[1].contrast_db > 10
    for position, (azimuth, range_) in zip(found, ((150.0, 5200.0), (-100.0, 5100.0)), strict=True):
        assert abs(position.azimuth_m - azimuth) < 15 and abs(position.range_m - range_) < 5


def test_neighbours_are_one_detection_and_most_limits_the_number() -> None:
    data = speckle()
    patch(data, -30.0, 5100.0, 20.0)
    patch(data, 30.0, 5100.0, 18.0)
    assert len(detect(Signal(data, AXES))) == 1
    assert len(detect(Signal(data, AXES), apart_m=(50.0, 20.0), most=1)) == 1


def test_contrast_is_the_mean_of_a_neighbourhood_over_the_median() -> None:
    data = torch.ones(800, 64, dtype=torch.complex128)
    data[120:180, 10:12] = 3.0
    level, (rows, columns) = contrast(Signal(data, AXES))
    i, j = int((rows - (149.5 - 400)).abs().argmin()), int((columns - 5052.5).abs().argmin())
    assert (
        rows[i] == 149.5 - 400
        and columns[j] == 5052.5
        and float(level[i, j]) == pytest.approx(9.0)
        and float(level.median()) == 1
    )


def test_nothing_is_detected_in_speckle_or_zeros_and_trials_are_rejected() -> None:
    assert detect(Signal(speckle(), AXES)) == [] == detect(Signal(torch.zeros(800, 64, dtype=torch.complex64), AXES))
    with pytest.raises(ValueError, match="one image at a time"):
        detect(Signal(torch.zeros(2, 800, 64, dtype=torch.complex64), AXES))
