"""Newton's method: one step on a quadratic, descent where damped, and `ok` False where it fails."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.optim.searches import CENTRE, F64, rotated, sphere
from torchsar.optim import Descent, newton


def rosenbrock(x: Tensor) -> Tensor:
    return 100 * (x[..., 1] - x[..., 0].square()).square() + (1 - x[..., 0]).square()


def hill(x: Tensor) -> Tensor:
    """Minima at +-1 in each unknown, a maximum at 0."""
    return (x.square() - 1).square().sum(-1)


STARTS = torch.tensor([[-1.2, 1.0], [3.0, -2.0], [0.0, 0.0], [1.0, 1.0]], dtype=F64)


@pytest.mark.parametrize("damped", [True, False])
def test_one_step_on_a_quadratic(damped: bool) -> None:
    start = torch.tensor([[4.0, 4.0, -3.0], [0.0, 0.0, 0.0]], dtype=F64)
    found = newton(rotated, start, damped=damped, value_tolerance=0)
    assert found.converged.all() and found.ok.all() and (found.steps <= 2).all()
    torch.testing.assert_close(found.x, CENTRE.expand(2, 3), atol=1e-9, rtol=0)


@pytest.mark.parametrize("damped", [True, False])
def test_rosenbrock(damped: bool) -> None:
    found = newton(rosenbrock, STARTS, damped=damped, steps=60, value_tolerance=0, gradient_tolerance=1e-10)
    assert found.converged.all() and found.ok.all()
    torch.testing.assert_close(found.x, torch.ones_like(STARTS), atol=1e-6, rtol=0)
    assert found.steps[3] == 0 and found.evaluations[3] == 1


def test_quadratic_convergence_near_the_minimum() -> None:
    near = torch.tensor([[1.01, 1.0]], dtype=F64)
    errors = [
        float((newton(hill, near, steps=n, damped=False, value_tolerance=0, gradient_tolerance=0).x - 1).abs().max())
        for n in (1, 2, 3)
    ]
    assert errors[1] < 3 * errors[0] ** 2 and errors[2] < 1e-12


def test_plain_steps_reach_a_maximum_and_damped_ones_a_minimum() -> None:
    start = torch.tensor([[0.1, -0.2]], dtype=F64)
    plain, damped = newton(hill, start, damped=False), newton(hill, start)
    assert plain.converged.all() and not plain.ok.any(), "it has found the maximum"
    assert (plain.x.abs() < 1e-3).all()
    assert damped.ok.all() and (damped.x.abs() - 1).abs().max() < 1e-4


def test_divergence_ends_at_a_finite_point() -> None:
    start = torch.tensor([[1.6], [0.3]], dtype=F64)
    found = newton(lambda x: torch.log(torch.cosh(x)).sum(-1), start, damped=False, steps=30, value_tolerance=0)
    assert found.ok.tolist() == [False, True]
    assert torch.isfinite(found.x).all() and torch.isfinite(found.cost).all()
    assert newton(lambda x: torch.log(torch.cosh(x)).sum(-1), start, steps=30).ok.all()


def test_steps_to_an_infinite_cost_are_shortened() -> None:
    def walled(x: Tensor) -> Tensor:
        return torch.where(
            (x > 2).any(-1),
            torch.inf,
            (x.square() - 2 * x + 0.1 * x.pow(4)).sum(-1)
            - 5 * torch.sqrt(torch.where(x < 0, 1.0, 1.0 + x.clamp_min(0))).sum(-1),
        )

    found = newton(walled, torch.tensor([[0.2, 0.3]], dtype=F64), steps=40)
    assert torch.isfinite(found.cost).all() and found.ok.all()


def test_a_start_that_is_not_finite() -> None:
    found = newton(
        lambda x: torch.where(x[..., 0] < 0, torch.nan, sphere(x)), torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]], dtype=F64)
    )
    assert found.ok.tolist() == [False, True]


@pytest.mark.parametrize("damped", [True, False])
def test_a_batch_equals_its_singles(damped: bool) -> None:
    together = newton(rosenbrock, STARTS, damped=damped, steps=7)
    for i, row in enumerate(STARTS):
        alone: Descent = newton(rosenbrock, row, damped=damped, steps=7)
        for name in ("steps", "evaluations", "converged", "ok"):
            assert getattr(together, name)[i] == getattr(alone, name), name
        torch.testing.assert_close(together.x[i], alone.x, atol=1e-12, rtol=1e-12)


def test_evaluations_are_counted_per_trial() -> None:
    calls = 0

    def counted(x: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return rosenbrock(x)

    found = newton(counted, STARTS[0], steps=10)
    assert int(found.evaluations) == calls


def test_invalid_arguments_raise() -> None:
    with pytest.raises(ValueError, match="autograd cannot differentiate"):
        newton(lambda x: sphere(x.detach()), torch.zeros(3, dtype=F64))
    with pytest.raises(ValueError, match="one real cost per trial"):
        newton(lambda x: x, torch.zeros(2, 3, dtype=F64))
    with pytest.raises(ValueError, match="steps is 0"):
        newton(sphere, torch.zeros(3, dtype=F64), steps=0)
    with pytest.raises(TypeError, match="float32 or float64"):
        newton(sphere, torch.zeros(3, dtype=torch.int64))
