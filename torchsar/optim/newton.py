"""Newton's method with exact second derivatives per trial, damped or plain."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.optim.checks import check_cost, check_limits, check_start, check_tolerances, norm
from torchsar.optim.descent import Descent, Objective

# sufficient decrease (Armijo) of the line search, the value of Nocedal and Wright 2006, section 3.1
_SUFFICIENT = 1e-4
# chosen: damping raises the least eigenvalue of the Hessian to this share of the largest
_LEAST = 1e-6


def newton(
    objective: Objective,
    start: Tensor,
    *,
    damped: bool = True,
    steps: int = 20,
    search: int = 12,
    gradient_tolerance: float = 1e-6,
    value_tolerance: float = 1e-9,
) -> Descent:
    """Minimise a smooth cost of few unknowns per trial by Newton's method.

    With `damped`, a multiple of the identity is added to the Hessian H (Levenberg). It is so large
    that a negative least eigenvalue changes its sign, and that the least eigenvalue is at least
    1e-6 of the largest magnitude. The step is then halved until the cost falls (Armijo).

    Without `damped`, the step is -H^-1 gradient. It can also lead to maxima and saddles, and
    diverges where H is near singular. Remote Sens. 2025, 17, 3447 reports this behaviour for its
    "Gauss-Newton" method, which minimises an entropy rather than a sum of squares.

    The result carries no gradient; torch.func.vmap is not supported.

    Args:
        objective: Maps points (..., n) to real costs (...,), each cost from its own row alone,
            twice differentiable by autograd.
        start: First point, shape (..., n), float32 or float64.
        damped: Whether to add a multiple of the identity to the Hessian and to halve steps.
        steps: Largest number of steps of a trial.
        search: Largest number of lengths of a step that are tried, each half of the one before. A
            trial in which none of them lowers the cost ends.
        gradient_tolerance: A trial has converged when its gradient norm is at most this fraction of
            that at the start.
        value_tolerance: A trial has converged when a step changed the cost by at most this fraction
            of the cost; a fraction below four times the machine epsilon of the dtype is raised to
            that.

    Returns:
        Last point per trial, finite where the start is: a trial that would step to a cost or
        derivative that is not finite stops before that step. `evaluations` counts calls of the
        objective; a call that also gives the Hessian counts once and takes n + 1 backward passes.
        `ok` is False where the trial met values that were not finite, where it ended at a cost
        above that of its start or at a point without a positive definite Hessian, and, without
        `damped`, where it has not converged.

    Raises:
        TypeError: If the start is not float32 or float64.
        ValueError: If the objective returns another shape or costs without a gradient, or if a
            limit is not positive or a tolerance negative.

    Reference:
        Nocedal and Wright 2006, Numerical Optimization, section 3.4 (modification of the Hessian),
        algorithm 3.1 (backtracking).
    """
    check_start(start)
    check_limits("newton", steps=steps, search=search)
    check_tolerances("newton", gradient_tolerance, value_tolerance)
    begin = _evaluated(objective, start.detach().clone())
    rules = _Rules(
        damped,
        search,
        gradient_tolerance * norm(begin.gradient),
        max(value_tolerance, 4 * torch.finfo(start.dtype).eps),
    )
    state = _opening(begin)
    for _ in range(steps):
        if not bool(state.active.any()):
            break
        state = _advance(objective, state, rules)
    here = state.point
    convex = _curvatures(here)[0][..., 0] > 0
    ok = begin.finite & ~state.lost & convex & (here.cost <= begin.cost) & (state.converged | damped)
    return Descent(here.x, here.cost, norm(here.gradient), state.steps, state.evaluations, state.converged, ok)


class _Rules(NamedTuple):
    """Limits and tolerances of `newton`."""

    damped: bool
    search: int
    gradient_norm: Tensor
    value_tolerance: float


class _Point(NamedTuple):
    """A point with its cost, gradient and Hessian, and whether all are finite."""

    x: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    finite: Tensor


class _State(NamedTuple):
    """State between two steps; `lost` marks trials that met values that are not finite."""

    point: _Point
    steps: Tensor
    evaluations: Tensor
    active: Tensor
    converged: Tensor
    lost: Tensor


def _opening(begin: _Point) -> _State:
    """State at the start."""
    none = torch.zeros_like(begin.finite, dtype=torch.int64)
    level = begin.finite & (norm(begin.gradient) == 0)
    return _State(begin, none, none + 1, begin.finite & ~level, level, torch.zeros_like(level))


def _advance(objective: Objective, state: _State, rules: _Rules) -> _State:
    """One step of every active trial."""
    here = state.point
    step = _step(here, rules.damped)
    usable, tried = torch.isfinite(step).all(-1), torch.zeros_like(state.steps)
    if rules.damped:
        step, tried = _shortened(objective, here, step, state.active & usable, rules.search)
    moved = state.active & usable & (step != 0).any(-1)
    there = _evaluated(objective, torch.where(moved[..., None], here.x + step, here.x))
    arrived = moved & there.finite
    level = (there.cost - here.cost).abs() <= rules.value_tolerance * torch.maximum(there.cost.abs(), here.cost.abs())
    ended = arrived & ((norm(there.gradient) <= rules.gradient_norm) | level)
    return _State(
        point=_Point(
            *(
                torch.where(arrived[(...,) + (None,) * (new.ndim - arrived.ndim)], new, old)
                for new, old in zip(there, here, strict=True)
            )
        ),
        steps=state.steps + arrived,
        evaluations=state.evaluations + tried + moved,
        active=arrived & ~ended,
        converged=state.converged | ended,
        lost=state.lost | (state.active & ~(usable & (arrived | ~moved))),
    )


def _evaluated(objective: Objective, x: Tensor) -> _Point:
    """Cost, gradient and Hessian at x (..., n); since rows do not mix, the Hessians of all trials
    take n backward passes.
    """
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        cost = objective(x)
        check_cost(cost, x)
        if not cost.requires_grad:
            raise ValueError(
                "the objective returned costs that autograd cannot differentiate with respect to x; leave "
                "out detach and no_grad"
            )
        (gradient,) = torch.autograd.grad(cost.sum(), x, create_graph=True)
        hessian = torch.stack([_row(part, x) for part in gradient.unbind(-1)], -2)
    cost, gradient = cost.detach(), gradient.detach()
    finite = torch.isfinite(cost) & torch.isfinite(gradient).all(-1) & torch.isfinite(hessian).all(-1).all(-1)
    return _Point(x.detach(), cost, gradient, 0.5 * (hessian + hessian.mT), finite)


def _row(part: Tensor, x: Tensor) -> Tensor:
    """One row of the Hessians; zeros where the gradient does not depend on x."""
    row = torch.autograd.grad(part.sum(), x, retain_graph=True, allow_unused=True)[0] if part.requires_grad else None
    return torch.zeros_like(x) if row is None else row.detach()


def _curvatures(point: _Point) -> tuple[Tensor, Tensor]:
    """Eigenvalues (rising) and eigenvectors of the Hessian; those of zeros where it is not
    finite.
    """
    return torch.linalg.eigh(torch.where(point.finite[..., None, None], point.hessian, 0))


def _step(point: _Point, damped: bool) -> Tensor:
    """-(H + shift)^-1 gradient; not finite where the Hessian is singular to the last digit."""
    values, vectors = _curvatures(point)
    if damped:
        least = values[..., 0]
        values = values + torch.maximum(-2 * least, _LEAST * values.abs().amax(-1) - least).clamp_min(0)[..., None]
    along = (vectors.mT @ point.gradient[..., None])[..., 0]
    return -(vectors @ (along / values)[..., None])[..., 0]


def _shortened(objective: Objective, point: _Point, step: Tensor, active: Tensor, search: int) -> tuple[Tensor, Tensor]:
    """Steps halved until the cost falls sufficiently, 0 where it never does, and the evaluations
    taken.
    """
    slope = (point.gradient * step).sum(-1)
    rounding = 4 * torch.finfo(point.cost.dtype).eps * point.cost.abs()
    searching, scale = active & (slope < 0), torch.ones_like(slope)
    found, tries = torch.zeros_like(active), torch.zeros_like(active, dtype=torch.int64)
    with torch.no_grad():
        for _ in range(search):
            if not bool(searching.any()):
                break
            cost = objective(torch.where(searching[..., None], point.x + scale[..., None] * step, point.x))
            low = searching & (cost - point.cost <= _SUFFICIENT * scale * slope + rounding)
            tries, found, searching = tries + searching, found | low, searching & ~low
            scale = torch.where(searching, scale / 2, scale)
    return torch.where(found[..., None], scale[..., None] * step, 0), tries
