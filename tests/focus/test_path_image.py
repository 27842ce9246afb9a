"""Stages that image any path: trials, precision, orientation and refusals."""

from __future__ import annotations

import math

import pytest
import torch

from tests.focus.geometries import case
from torchsar.core import Signal
from torchsar.focus import DirectImage, TileImage
from torchsar.metrics import error_db
from torchsar.radar import InverseRadar, range_profiles

DRAWN = case(1002)
N = len(DRAWN.frequency_hz)
STEP_M = 0.4


def signal(history: torch.Tensor) -> Signal:
    radar = InverseRadar(float(DRAWN.frequency_hz[N // 2]), N * float(DRAWN.frequency_hz.diff()[0]), 100.0)
    return Signal(range_profiles(history), radar.raw_axes(history.shape[-2], N))


def values(**changes: torch.Tensor) -> dict[str, torch.Tensor | None]:
    known = {
        "frequency_hz": DRAWN.frequency_hz,
        "transmitter_m": DRAWN.transmitter_m,
        "receiver_m": DRAWN.receiver_m,
        "path_reference_m": DRAWN.reference_m,
    }
    return {**known, **changes}


@pytest.mark.parametrize("window", ["none", "hann", "range"])
def test_tiles_equal_the_direct_sum_on_noise(window: str) -> None:
    numbers = (12.0, 8.0, STEP_M, (3.0, -2.0), 0.3)
    tiles, exact = (
        stage(*numbers, window=window)(signal(DRAWN.history), **values()) for stage in (TileImage, DirectImage)
    )
    assert tiles.axes == exact.axes and tiles.data.shape == (31, 21)
    assert float(error_db(tiles.data, exact.data)) < -55
    single = DirectImage(*numbers, window=window)(signal(DRAWN.history.to(torch.complex64)), **values())
    assert single.data.dtype == torch.complex64 and float(error_db(single.data.to(torch.complex128), exact.data)) < -100


def test_trials_have_paths_of_their_own() -> None:
    moved = DRAWN.transmitter_m + torch.tensor([0.0, 0.03], dtype=torch.float64)[:, None, None]
    stage = TileImage(6.0, 6.0, STEP_M)
    both = stage(signal(DRAWN.history), **values(transmitter_m=moved))
    assert both.data.shape == (2, 16, 16)
    one = stage(signal(DRAWN.history), **values(transmitter_m=moved[1]))
    assert float(error_db(both.data[1], one.data)) < -55


@pytest.mark.parametrize(
    "change", [{"step_m": 0.0}, {"step_m": 9.0}, {"height_m": math.nan}, {"centre_m": (1.0,)}, {"window": "kaiser"}]
)
def test_images_that_make_no_sense_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match="an image needs finite numbers|window"):
        TileImage(**{"azimuth_m": 8.0, "range_m": 8.0, "step_m": 0.5, **change})
