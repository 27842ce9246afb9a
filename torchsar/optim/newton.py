"""Newton's method with exact second derivatives per trial, and derivatives of any minimum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar.core import differentiable, is_plain
from torchsar.core.derivatives import is_differentiated
from torchsar.optim.descent import (
    SUFFICIENT,
    Descent,
    Objective,
    check_cost,
    check_limits,
    check_start,
    check_tolerances,
    norm,
)


@differentiable("no")
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

    >>> import torch
    >>> from torchsar.optim import newton
    >>> newton(lambda x: (x - 2).square().sum(-1) + 0.5 * x.square().sum(-1), torch.zeros(1)).x
    tensor([1.3333])

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
    here = begin = _evaluated(objective, start.detach().clone())
    value_tolerance = max(value_tolerance, 4 * torch.finfo(start.dtype).eps)
    taken, lost = torch.zeros_like(begin.finite, dtype=torch.int64), torch.zeros_like(begin.finite)
    evaluations = taken + 1
    converged = begin.finite & (norm(begin.gradient) == 0)
    active = begin.finite & ~converged
    for _ in range(steps):
        if not bool(active.any()):
            break
        step = _step(here, damped)
        usable, tried = torch.isfinite(step).all(-1), torch.zeros_like(taken)
        if damped:
            step, tried = _shortened(objective, here, step, active & usable, search)
        moved = active & usable & (step != 0).any(-1)
        there = _evaluated(objective, torch.where(moved[..., None], here.x + step, here.x))
        arrived = moved & there.finite
        level = (there.cost - here.cost).abs() <= value_tolerance * torch.maximum(there.cost.abs(), here.cost.abs())
        ended = arrived & ((norm(there.gradient) <= gradient_tolerance * norm(begin.gradient)) | level)
        here = _Point(
            *(
                torch.where(arrived[(...,) + (None,) * (new.ndim - arrived.ndim)], new, old)
                for new, old in zip(there, here, strict=True)
            )
        )
        taken, evaluations = taken + arrived, evaluations + tried + moved
        lost = lost | (active & ~(usable & (arrived | ~moved)))
        active, converged = arrived & ~ended, converged | ended
    convex = _curvatures(here)[0][..., 0] > 0
    ok = begin.finite & ~lost & convex & (here.cost <= begin.cost) & (converged | damped)
    return Descent(here.x, here.cost, norm(here.gradient), taken, evaluations, converged, ok)


def implicit(objective: Callable[..., Tensor], minimum: Tensor, *data: Any) -> Tensor:
    """Give a minimum its derivatives by the data, however it was found.

    >>> import torch
    >>> from torchsar.optim import implicit, lbfgs
    >>> def cost(x, level):
    ...     return (x[..., 0] ** 2 - level).square()
    >>> level = torch.tensor(4.0, requires_grad=True)
    >>> with torch.no_grad():
    ...     found = lbfgs(lambda x: cost(x, level), torch.ones(1)).x
    >>> root = implicit(cost, found, level)[0]  # the square root, by its derivative 1 / 4
    >>> torch.autograd.grad(root, level)[0]
    tensor(0.2500)

    The value stays as it is, to the bit. The implicit function theorem gives its derivatives, those
    of one Newton step -H^-1 gradient at the minimum, with the Hessian H held constant. They are
    zero in trials in which the Hessian is not positive definite. They are those of a search without
    bounds: at a bound, where the gradient is not zero, they are wrong. If no derivative by the data
    is asked for, nothing is computed.

    Args:
        objective: Maps points (..., n) and the data to real costs (...,), each cost from its own
            trial alone, twice differentiable by autograd.
        minimum: Points of least cost, shape (..., n).
        data: Tensors, trees of tensors such as signals, or objects with tensors as attributes, by
            which derivatives may be asked for.

    Returns:
        The points, with derivatives by the data in reverse and forward mode.

    Raises:
        RuntimeError: If a derivative is asked for by a transform of torch.func.
        ValueError: If the objective returns another shape or costs without a gradient.
    """
    x = minimum.detach()
    if not is_differentiated(data):
        return x
    if x.numel() and not is_plain(x):
        raise RuntimeError(
            "derivatives of a minimum are not found inside transforms of torch.func; use torch.autograd.grad, backward "
            "or forward-mode tangents"
        )
    cost, gradient, hessian = _derivatives(lambda point: objective(point, *data), x)
    unit = hessian.diagonal(dim1=-2, dim2=-1).abs().clamp_min(torch.finfo(x.dtype).tiny).rsqrt()
    scaled = unit[..., :, None] * hessian * unit[..., None, :]
    point = _Point(x, cost, unit * gradient, scaled, torch.isfinite(scaled).all(-1).all(-1))
    convex = _curvatures(point)[0][..., :1] > 1e3 * torch.finfo(x.dtype).eps
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    step = _step(point._replace(hessian=torch.where(convex[..., None], scaled, eye)), False)
    step = torch.where(convex, unit * step, 0)
    return x + (step - step.detach())


class _Point(NamedTuple):
    """A point with its cost, gradient and Hessian, and True where all of them are finite."""

    x: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    finite: Tensor


def _evaluated(objective: Objective, x: Tensor) -> _Point:
    """Compute cost, gradient and Hessian at x (..., n).

    The trials are independent, so that n backward passes give the Hessians of all of them.
    """
    cost, gradient, hessian = (value.detach() for value in _derivatives(objective, x))
    finite = torch.isfinite(cost) & torch.isfinite(gradient).all(-1) & torch.isfinite(hessian).all(-1).all(-1)
    return _Point(x.detach(), cost, gradient, hessian, finite)


def _derivatives(objective: Objective, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost and gradient, with derivatives, and Hessian at x (..., n)."""
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
    return cost, gradient, 0.5 * (hessian + hessian.mT)


def _row(part: Tensor, x: Tensor) -> Tensor:
    """One row of the Hessian of each trial; zeros if the gradient does not depend on x."""
    row = torch.autograd.grad(part.sum(), x, retain_graph=True, allow_unused=True)[0] if part.requires_grad else None
    return torch.zeros_like(x) if row is None else row.detach()


def _curvatures(point: _Point) -> tuple[Tensor, Tensor]:
    """Eigenvalues in rising order and eigenvectors of the Hessian, or of zeros where it is not
    finite.
    """
    return torch.linalg.eigh(torch.where(point.finite[..., None, None], point.hessian, 0))


def _step(point: _Point, damped: bool) -> Tensor:
    """Newton step -(H + shift)^-1 gradient; it is not finite where the Hessian is exactly
    singular.
    """
    values, vectors = _curvatures(point)
    if damped:
        least = values[..., 0]
        values = values + torch.maximum(-2 * least, 1e-6 * values.abs().amax(-1) - least).clamp_min(0)[..., None]
    along = (vectors.mT @ point.gradient[..., None])[..., 0]
    return -(vectors @ (along / values)[..., None])[..., 0]


def _shortened(objective: Objective, point: _Point, step: Tensor, active: Tensor, search: int) -> tuple[Tensor, Tensor]:
    """Halve the steps until the cost decreases sufficiently.

    Returns the steps, which are 0 where the cost never decreases sufficiently, and the number of
    evaluations.
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
            low = searching & (cost - point.cost <= SUFFICIENT * scale * slope + rounding)
            tries, found, searching = tries + searching, found | low, searching & ~low
            scale = torch.where(searching, scale / 2, scale)
    return torch.where(found[..., None], scale[..., None] * step, 0), tries
