"""Descents of many trials at once against single descents, scipy and known minima."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from torchsar.optim import Descent, adam, lbfgs
from torchsar.optim.descent import _append, _Pairs

F64 = torch.float64


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def rosenbrock(x: Tensor) -> Tensor:
    return (100 * (x[..., 1:] - x[..., :-1].square()).square() + (1 - x[..., :-1]).square()).sum(-1)


def rosenbrock_with_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
    bend, gap = x[..., 1:] - x[..., :-1].square(), 1 - x[..., :-1]
    gradient = torch.zeros_like(x)
    gradient[..., 1:] += 200 * bend
    gradient[..., :-1] -= 400 * x[..., :-1] * bend + 2 * gap
    return rosenbrock(x), gradient


def periodic(x: Tensor) -> Tensor:
    """A chain of phases with many minima: differences of neighbours near 0.3 modulo 2 pi and phases
    near 0 modulo pi lower the cost.
    """
    return (
        (1 - torch.cos(x[..., 1:] - x[..., :-1] - 0.3)).sum(-1)
        + 0.05 * (1 - torch.cos(2 * x)).sum(-1)
        + 0.01 * x.square().sum(-1)
    )


def quadratic(n: int, condition: float, seed: int = 0) -> tuple[Callable[[Tensor], Tensor], Tensor]:
    """A rotated quadratic and its minimum, (n,)."""
    turn = torch.linalg.qr(normal(n, n, seed=seed)).Q
    root = turn * torch.linspace(0, 1, n, dtype=F64).mul(torch.log(torch.tensor(condition, dtype=F64)) / 2).exp()
    centre = normal(n, seed=seed + 1)
    return lambda x: 0.5 * ((x - centre.to(x.dtype)) @ root.to(x.dtype)).square().sum(-1), centre


def of_singles(descend: Callable[..., Descent], objective: Callable, start: Tensor, **limits) -> list[Descent]:
    return [descend(objective, row, **limits) for row in start]


def equal(together: Descent, i: int, alone: Descent, tolerance: float = 1e-12) -> None:
    for name in ("steps", "evaluations", "converged", "ok"):
        assert getattr(together, name)[i] == getattr(alone, name), name
    torch.testing.assert_close(together.x[i], alone.x, atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(together.cost[i], alone.cost, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("condition", [1.0, 1e2, 1e4])
def test_quadratics_are_solved(condition: float) -> None:
    objective, centre = quadratic(12, condition)
    found = lbfgs(objective, centre + normal(3, 12, seed=5), steps=1000, gradient_tolerance=1e-12, value_tolerance=0)
    assert found.converged.all() and found.ok.all()
    torch.testing.assert_close(found.x, centre.expand(3, 12), atol=1e-8, rtol=0)


@pytest.mark.parametrize("n", [2, 5, 20])
def test_rosenbrock_from_many_starts(n: int) -> None:
    start = torch.cat([normal(6, n, seed=n), torch.tensor([-1.2, 1.0], dtype=F64).repeat(n)[:n][None]])
    found = lbfgs(rosenbrock, start, steps=500, gradient_tolerance=1e-9, value_tolerance=0)
    assert found.converged.all()
    # from four dims on there is a second minimum near (-1, 1, 1, ...)
    near = (found.x - 1).abs().amax(-1) < 1e-6
    assert near[found.x[..., 0] > 0].all() and near.sum() >= 4
    assert (found.gradient_norm < 1e-4).all()


def test_minima_of_a_periodic_cost() -> None:
    start = 2 * normal(8, 30)
    found = lbfgs(periodic, start, steps=300)
    again = found.x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(periodic(again).sum(), again)
    torch.testing.assert_close(found.gradient_norm, gradient.norm(dim=-1))
    torch.testing.assert_close(found.cost, periodic(found.x))
    assert found.converged.all() and (found.gradient_norm < 1e-3).all() and (found.cost < periodic(start)).all()
    assert found.cost.unique().numel() > 1


@pytest.mark.parametrize(
    "objective, n", [(rosenbrock, 2), (rosenbrock, 10), (periodic, 30), (quadratic(20, 1e3, seed=50)[0], 20)]
)
def test_as_few_evaluations_as_scipy(objective: Callable, n: int) -> None:
    start = torch.stack([normal(n, seed=seed) for seed in range(5)])
    (slope,) = torch.autograd.grad(objective(x := start.clone().requires_grad_()).sum(), x)
    found = lbfgs(objective, start, steps=1000, gradient_tolerance=1e-6, value_tolerance=1e-14)
    counts = []
    for i, row in enumerate(start.numpy()):

        def single(z) -> tuple[float, object]:
            at = torch.tensor(z, requires_grad=True)
            value = objective(at)
            return value.item(), torch.autograd.grad(value, at)[0].numpy()

        limits = {
            "maxcor": 10,
            "gtol": 1e-6 * float(slope[i].norm()) / n**0.5,
            "ftol": 1e-14,
            "maxiter": 1000,
            "maxfun": 5000,
        }
        theirs = minimize(single, row, jac=True, method="L-BFGS-B", options=limits)
        counts.append(theirs.nfev)
        assert float(found.cost[i]) <= theirs.fun + 1e-6 * max(1.0, abs(theirs.fun)) or objective is periodic
    assert float(found.evaluations.sum()) <= 1.5 * sum(counts), (found.evaluations.tolist(), counts)


@pytest.mark.parametrize("descend, limits", [(lbfgs, {"steps": 60}), (adam, {"steps": 100})])
@pytest.mark.parametrize("objective", [rosenbrock, periodic])
def test_batch_equals_singles(descend: Callable, limits: dict, objective: Callable) -> None:
    start = normal(5, 6) * torch.tensor([1.0, 0.1, 2.0, 0.5, 1.0], dtype=F64)[:, None]
    together = descend(objective, start, **limits)
    for i, alone in enumerate(of_singles(descend, objective, start, **limits)):
        equal(together, i, alone)


@pytest.mark.parametrize("descend", [lbfgs, adam])
def test_trials_with_non_finite_or_large_costs_leave_others_unchanged(descend: Callable) -> None:
    start, level = normal(4, 5), torch.tensor([1.0, 1e6, 1.0, 1.0], dtype=F64)
    bad = torch.tensor([False, False, True, False])

    def wild(x: Tensor) -> Tensor:
        return torch.where(bad, torch.log(-x.square().sum(-1)), level * rosenbrock(x))

    found = descend(wild, start, steps=60)
    assert found.ok.tolist() == [True, True, False, True] and not found.converged[2]
    assert torch.equal(found.x[2], start[2]) and found.evaluations[2] == 1
    for i in (0, 3):
        equal(found, i, descend(rosenbrock, start[i], steps=60))


def test_a_finished_trial_is_evaluated_at_its_result() -> None:
    start = torch.stack([normal(6, seed=1), torch.ones(6, dtype=F64) + 1e-3])
    seen: list[Tensor] = []

    def watched(x: Tensor) -> Tensor:
        seen.append(x.detach().clone())
        return rosenbrock(x)

    found = lbfgs(watched, start, steps=200)
    first, last = int(found.evaluations.min()), int(found.evaluations.max())
    quick = int(found.evaluations.argmin())
    assert first < last == len(seen)
    assert all(torch.equal(x[quick], found.x[quick]) for x in seen[first:])


def test_steps_limit_each_trial() -> None:
    found = lbfgs(rosenbrock, normal(4, 8), steps=7)
    assert (found.steps == 7).all() and not found.converged.any() and found.ok.all()
    assert (found.evaluations >= 8).all()
    assert (found.cost < rosenbrock(normal(4, 8))).all()


@pytest.mark.parametrize("descend", [lbfgs, adam])
def test_a_start_with_zero_gradient_is_the_result(descend: Callable) -> None:
    start = torch.stack([torch.ones(4, dtype=F64), normal(4)])
    found = descend(rosenbrock, start, steps=30)
    assert torch.equal(found.x[0], start[0]) and found.converged[0] and found.ok[0]
    assert found.evaluations[0] == 1 and found.steps[0] == 0 and found.gradient_norm[0] == 0
    assert found.steps[1] > 0


def test_a_value_tolerance_ends_earlier() -> None:
    rough, fine = (
        lbfgs(lambda x: 1 + rosenbrock(x), normal(4, 8), steps=300, gradient_tolerance=0, value_tolerance=part)
        for part in (1e-3, 1e-12)
    )
    assert rough.converged.all() and fine.converged.all()
    assert (
        (rough.evaluations < fine.evaluations).all()
        and (fine.cost < 1 + 1e-9).any()
        and (rough.cost >= fine.cost).all()
    )


def test_rounding_of_the_cost_takes_no_further_evaluations() -> None:
    """Near the minimum the cost 1e6 + q is constant to rounding, while its slope is not."""
    objective, centre = quadratic(10, 100.0)
    found = lbfgs(
        lambda x: 1e6 + objective(x),
        centre + normal(6, 10, seed=7),
        steps=200,
        gradient_tolerance=1e-12,
        value_tolerance=0,
    )
    assert found.converged.all() and (found.evaluations <= found.steps + 6).all()
    torch.testing.assert_close(found.x, centre.expand(6, 10), atol=1e-4, rtol=0)


def test_pairs_without_positive_curvature_are_dropped_per_trial() -> None:
    old = _Pairs(normal(2, 4, 3), normal(2, 4, 3, seed=1), torch.ones(2, 4, dtype=F64))
    move, moved = normal(4, 3, seed=2), torch.tensor([True, True, True, False])
    change = move * torch.tensor([2.0, -1.0, 0.0, 1.0], dtype=F64)[:, None]
    new = _append(old, move, change, moved)
    for kept in (1, 2, 3):
        assert all(torch.equal(a[:, kept], b[:, kept]) for a, b in zip(new, old, strict=True))
    assert torch.equal(new.move[:, 0], torch.stack([old.move[1, 0], move[0]]))
    torch.testing.assert_close(new.inverse[1, 0], 0.5 / move[0].square().sum())


def test_scale_and_offset_of_the_cost_do_not_matter() -> None:
    start, plain = normal(3, 5), lbfgs(rosenbrock, normal(3, 5), steps=100, value_tolerance=0)
    loud = lbfgs(lambda x: 2.0**40 * rosenbrock(x), start, steps=100, value_tolerance=0)
    assert torch.equal(loud.x, plain.x) and torch.equal(loud.evaluations, plain.evaluations)
    raised = lbfgs(lambda x: 1e3 + rosenbrock(x), start, steps=100, value_tolerance=0)
    torch.testing.assert_close(raised.x, plain.x, atol=1e-3, rtol=0)


@pytest.mark.parametrize("level", [1e-28, 1.0, 1e28])
@pytest.mark.parametrize("descend, limits, tolerance", [(lbfgs, {}, 1e-3), (adam, {"steps": 1000}, 2e-2)])
def test_float32_at_all_levels(descend: Callable, limits: dict, tolerance: float, level: float) -> None:
    objective, centre = quadratic(6, 10.0)
    found = descend(lambda x: level * objective(x), normal(3, 6, seed=4, dtype=torch.float32), **limits)
    assert found.x.dtype == found.cost.dtype == found.gradient_norm.dtype == torch.float32
    assert found.ok.all() and torch.isfinite(found.gradient_norm).all()
    torch.testing.assert_close(found.x, centre.float().expand(3, 6), atol=tolerance, rtol=0)


@pytest.mark.parametrize("level", [1e-200, 1e200])
def test_float64_at_all_levels(level: float) -> None:
    found, plain = (
        lbfgs(lambda x: level * rosenbrock(x), normal(3, 5), steps=100),
        lbfgs(rosenbrock, normal(3, 5), steps=100),
    )
    torch.testing.assert_close(found.x, plain.x, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.gradient_norm / level, plain.gradient_norm, atol=1e-3, rtol=0)


@pytest.mark.parametrize("descend", [lbfgs, adam])
def test_one_trial_of_float32(descend: Callable) -> None:
    found = descend(rosenbrock, normal(5, dtype=torch.float32), steps=20)
    assert found.x.dtype == found.cost.dtype == found.gradient_norm.dtype == torch.float32
    assert found.cost.shape == () and found.cost < rosenbrock(normal(5))


def test_a_start_at_the_minimum_ends_after_few_evaluations() -> None:
    objective, centre = quadratic(8, 1e2)
    once = lbfgs(lambda x: 1 + objective(x), centre + normal(4, 8, seed=2), steps=200)
    again = lbfgs(lambda x: 1 + objective(x), once.x, steps=200)
    assert again.ok.all() and (again.evaluations <= 60).all()
    torch.testing.assert_close(again.x, once.x, atol=1e-3, rtol=0)


def test_steps_to_a_non_finite_cost_are_shortened() -> None:
    """-log x + x is not finite for x <= 0; its minimum is at 1."""
    found = lbfgs(
        lambda x: (x - torch.log(x)).sum(-1),
        torch.tensor([[0.01, 0.02], [3.0, 8.0], [0.5, 30.0]], dtype=F64),
        first_step=5.0,
    )
    assert found.ok.all() and found.converged.all()
    torch.testing.assert_close(found.x, torch.ones(3, 2, dtype=F64), atol=1e-4, rtol=0)


def test_a_descent_to_a_non_finite_cost_returns_its_best_finite_point() -> None:
    start = torch.tensor([[1.0], [1.0]], dtype=F64)

    def cliff(x: Tensor) -> Tensor:
        """The cost of the second row is not finite below 0.3."""
        return torch.where(torch.tensor([False, True]) & (x[..., 0] < 0.3), torch.nan, 1 + (x + 1).square().sum(-1))

    found = lbfgs(cliff, start)
    assert found.ok.tolist() == [True, False] and found.converged.tolist() == [True, False]
    assert 0.3 <= float(found.x[1, 0]) < 0.31 and torch.isfinite(found.cost).all()
    stepped = adam(cliff, start, steps=100)
    assert stepped.ok.tolist() == [True, False] and 0.3 <= float(stepped.x[1, 0]) < 0.36


def test_a_non_finite_gradient_ends_the_trial() -> None:
    def corner(x: Tensor) -> tuple[Tensor, Tensor]:
        return x.square().sum(-1), torch.where(x.abs() < 0.1, torch.nan, 2 * x)

    found = lbfgs(corner, torch.ones(1, 1, dtype=F64), with_gradient=True)
    assert not found.ok.any() and 0.1 <= float(found.x) <= 1 and float(found.cost) <= 1


def test_an_unbounded_cost_ends_after_the_given_steps() -> None:
    found = lbfgs(lambda x: x.sum(-1), normal(2, 3), steps=5)
    assert (found.steps <= 5).all() and torch.isfinite(found.x).all() and (found.cost < -1e3).all()


@pytest.mark.parametrize("descend", [lbfgs, adam])
def test_given_gradients_and_autograd_agree(descend: Callable) -> None:
    derived = descend(rosenbrock, normal(4, 6), steps=40)
    given = descend(rosenbrock_with_gradient, normal(4, 6), steps=40, with_gradient=True)
    torch.testing.assert_close(given.x, derived.x, atol=1e-7, rtol=0)
    assert torch.equal(given.steps, derived.steps)


@pytest.mark.parametrize("descend", [lbfgs, adam])
def test_works_under_no_grad_and_for_trials_of_any_shape(descend: Callable) -> None:
    start = normal(2, 3, 4).requires_grad_()
    with torch.no_grad():
        found = descend(rosenbrock, start, steps=20)
        assert not torch.is_grad_enabled()
    assert found.x.shape == (2, 3, 4) and found.cost.shape == found.ok.shape == found.evaluations.shape == (2, 3)
    assert found.steps.dtype == found.evaluations.dtype == torch.int64 and not found.x.requires_grad
    single = descend(rosenbrock, start.detach()[1, 2], steps=20)
    assert single.cost.shape == ()
    torch.testing.assert_close(found.x[1, 2], single.x)
    assert descend(rosenbrock, torch.zeros(0, 4, dtype=F64), steps=20).x.shape == (0, 4)


def test_float64_costs_of_float32_unknowns_stay_float64() -> None:
    found = lbfgs(
        lambda x: 1e6 + rosenbrock(x.double()), normal(3, 4, dtype=torch.float32), value_tolerance=1e-15, steps=200
    )
    assert found.x.dtype == torch.float32 and found.cost.dtype == F64
    assert ((found.cost - 1e6) < 1e-3).all()


def test_adam_reaches_the_minimum() -> None:
    objective, centre = quadratic(8, 30.0)
    found = adam(objective, centre + normal(4, 8, seed=3), steps=3000, rate=0.02)
    torch.testing.assert_close(found.x, centre.expand(4, 8), atol=1e-3, rtol=0)
    assert found.converged.all() and found.evaluations.unique().numel() > 1
    assert torch.equal(found.evaluations, found.steps + 1)


def test_adam_returns_the_best_point_visited() -> None:
    """With a rate that is far too large the points jump about the minimum."""
    costs: list[Tensor] = []

    def watched(x: Tensor) -> Tensor:
        costs.append((cost := x.square().sum(-1)).detach())
        return cost

    found = adam(watched, normal(3, 2), rate=3.0, steps=30, patience=30)
    assert torch.equal(found.cost, torch.stack(costs).amin(0)) and torch.equal(found.x.square().sum(-1), found.cost)


MISTAKES = [
    pytest.param(torch.zeros(3, 2, dtype=torch.int64), rosenbrock, {}, TypeError, "float32 or float64", id="integers"),
    pytest.param(
        torch.zeros(3, 2, dtype=torch.complex128), rosenbrock, {}, TypeError, "real and imaginary", id="complex"
    ),
    pytest.param(torch.tensor(1.0), rosenbrock, {}, ValueError, "last dim", id="scalar"),
    pytest.param(torch.zeros(3, 0), rosenbrock, {}, ValueError, "n >= 1", id="no unknowns"),
    pytest.param(
        torch.zeros(3, 2),
        lambda x: x.sum(),
        {},
        ValueError,
        r"one real cost per trial, shape \(3,\)",
        id="one cost for all",
    ),
    pytest.param(torch.zeros(3, 2), lambda x: 1.0, {}, ValueError, "returned float", id="a number"),
    pytest.param(
        torch.zeros(3, 2), lambda x: x.detach().sum(-1), {}, ValueError, "autograd cannot differ", id="detached"
    ),
    pytest.param(torch.zeros(3, 2), rosenbrock, {"with_gradient": True}, TypeError, "cost, gradient", id="no pair"),
    pytest.param(
        torch.zeros(3, 2),
        lambda x: (x.sum(-1), x.sum(-1)),
        {"with_gradient": True},
        ValueError,
        "same shape as x",
        id="gradient of a wrong shape",
    ),
    pytest.param(
        torch.zeros(3, 2), rosenbrock, {"value_tolerance": -1.0}, ValueError, "at least 0", id="negative tolerance"
    ),
    pytest.param(torch.zeros(3, 2), rosenbrock, {"steps": 0}, ValueError, "steps is 0", id="no steps"),
]


@pytest.mark.parametrize("descend", [lbfgs, adam])
@pytest.mark.parametrize("start, objective, limits, error, words", MISTAKES)
def test_invalid_arguments_raise(
    descend: Callable, start: Tensor, objective: Callable, limits: dict, error: type, words: str
) -> None:
    with pytest.raises(error, match=words):
        descend(objective, start, **limits)


def test_betas_are_checked() -> None:
    with pytest.raises(ValueError, match="betas"):
        adam(rosenbrock, torch.zeros(2, 2), betas=(0.9, 1.0))
