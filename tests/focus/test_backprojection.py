"""The direct sum at pixels in space against its definition."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tests.focus.geometries import C128, F64, Case, case
from tests.helpers import assert_forward_equals_backward
from torchsar.focus import backproject
from torchsar.metrics import error_db


def image(drawn: Case, pixels_m: torch.Tensor, history: torch.Tensor | None = None, **how) -> torch.Tensor:
    history = drawn.history if history is None else history
    return backproject(
        history, drawn.frequency_hz, drawn.transmitter_m, drawn.receiver_m, drawn.reference_m, pixels_m, **how
    )


@pytest.mark.parametrize("seed", range(3000, 3006))
def test_equals_the_double_sum(seed: int) -> None:
    drawn = case(seed)
    pixels = drawn.grid.pixels_m(slice(0, 9, 2), slice(3, 7))
    found = image(drawn, pixels)
    assert found.shape == pixels.shape[:-1]
    assert float(error_db(found, drawn.direct(pixels.reshape(-1, 3)).reshape(found.shape))) < -180
    single = image(drawn, pixels, drawn.history.to(torch.complex64), eps=1e-6, block_bytes=1)
    assert single.dtype == torch.complex64 and float(error_db(single.to(C128), found)) < -105


def test_trials_with_and_without_a_path_of_their_own() -> None:
    drawn, pixels = case(3001), case(3001).grid.pixels_m()[:3, :2]
    moved = replace(drawn, transmitter_m=drawn.transmitter_m + torch.tensor([0.0, 0.1])[:, None, None])
    history = torch.randn(3, 1, *drawn.history.shape, dtype=C128)
    found = image(moved, pixels, history)
    assert found.shape == (3, 2, 3, 2)
    one = replace(moved, transmitter_m=moved.transmitter_m[1])
    torch.testing.assert_close(found[2, 1], image(one, pixels, history[2, 0]))


def test_gradcheck_in_history_positions_and_pixels() -> None:
    drawn = case(3002)
    few = replace(
        drawn,
        transmitter_m=drawn.transmitter_m[:5],
        receiver_m=None,
        reference_m=drawn.reference_m[:5],
        frequency_hz=drawn.frequency_hz[:6],
    )
    radian = float(few.frequency_hz.mean()) * 2 * math.pi / 299792458.0

    def at(history, shift, pixels):
        return image(replace(few, transmitter_m=few.transmitter_m + shift / radian), pixels / radian, history)

    inputs = (
        drawn.history[:5, :6].clone().requires_grad_(),
        torch.zeros(5, 3, dtype=F64, requires_grad=True),
        (radian * drawn.grid.pixels_m()[:2, 4]).requires_grad_(),
    )
    assert torch.autograd.gradcheck(at, inputs, eps=1e-3, rtol=1e-4, atol=1e-4)
    assert_forward_equals_backward(at, inputs)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"pixels_m": torch.zeros(4, 2, dtype=F64)}, ValueError, "at least one pixel"),
        ({"pixels_m": torch.zeros(0, 3, dtype=F64)}, ValueError, "at least one pixel"),
        ({"pixels_m": torch.zeros(4, 3)}, TypeError, "pixels_m must be a float64 tensor"),
        ({"pixels_m": torch.full((1, 3), math.inf, dtype=F64)}, ValueError, "pixels_m: 3 of 3 values are NaN or Inf"),
        ({"history": torch.zeros(4, 5, dtype=C128)}, ValueError, "needs a history"),
    ],
)
def test_input_that_makes_no_sense_is_refused(change: dict, error: type, text: str) -> None:
    with pytest.raises(error, match=text):
        image(case(3000), **{"pixels_m": torch.zeros(1, 3, dtype=F64), **change})
