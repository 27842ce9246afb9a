"""Full grid: every point once, the best per trial."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.optim.searches import CENTRE, F64, sphere
from torchsar.optim import grid_search

AXES = [torch.linspace(-1, 1, 9, dtype=F64), torch.linspace(-1, 2, 4, dtype=F64), torch.linspace(0, 2, 5, dtype=F64)]


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_every_combination_once(block: int) -> None:
    seen: list[Tensor] = []

    def watched(x: Tensor) -> Tensor:
        seen.append(x)
        return sphere(x)

    found = grid_search(watched, AXES, block=block)
    points = torch.cartesian_prod(*AXES)
    torch.testing.assert_close(torch.cat(seen[: -(-180 // block)]), points, atol=0, rtol=0)
    costs = sphere(points)
    torch.testing.assert_close(found.x, points[costs.argmin()], atol=0, rtol=0)
    assert found.cost == costs.min() and found.evaluations == 180
    torch.testing.assert_close(found.history, costs.reshape(9, 4, 5), atol=0, rtol=0)


def test_trials_have_their_own_axes_and_minima() -> None:
    own = torch.stack([AXES[0], AXES[0] + 0.05, AXES[0] - 0.1])
    shift = torch.tensor([0.0, 0.5, -0.5], dtype=F64)
    found = grid_search(lambda x: sphere(x - shift[:, None, None]), [own, *AXES[1:]])
    for i in range(3):
        alone = grid_search(lambda x, i=i: sphere(x - shift[i]), [own[i], *AXES[1:]])
        torch.testing.assert_close(found.x[i], alone.x, atol=0, rtol=0)
        torch.testing.assert_close(found.history[i], alone.history, atol=0, rtol=0)


def test_trials_without_axes_of_their_own() -> None:
    found = grid_search(sphere, AXES, trials=(2, 3))
    assert found.x.shape == (2, 3, 3) and found.history.shape == (2, 3, 9, 4, 5)
    assert ((found.x - CENTRE).abs() <= torch.tensor([0.125, 0.5, 0.25], dtype=F64)).all()


def test_non_finite_costs_are_not_selected() -> None:
    found = grid_search(lambda x: torch.where(x[..., 0] > 0, torch.nan, sphere(x)), AXES)
    assert found.ok and found.x[0] == 0
    assert not grid_search(lambda x: torch.full_like(x[..., 0], torch.inf), AXES).ok


def test_invalid_arguments_raise() -> None:
    with pytest.raises(
        ValueError, match="9 x 4 x 5 values are 180 evaluations per trial, above the limit of 100; use fewer values$"
    ):
        grid_search(sphere, AXES, limit=100)
    with pytest.raises(ValueError, match="at least one unknown"):
        grid_search(sphere, [])
    with pytest.raises(ValueError, match="axis 1 must be finite, but 4 of its values"):
        grid_search(sphere, [AXES[0], AXES[1] * torch.inf, AXES[2]])
    with pytest.raises(TypeError, match="axis 0 must be a float32 or float64"):
        grid_search(sphere, [AXES[0].long(), *AXES[1:]])
