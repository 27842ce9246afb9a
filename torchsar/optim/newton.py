"""Newton's method with exact second derivatives, per trial: damped, which descends, and plain,
which does not have to.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.optim.descent import (
    Descent,
    Objective,
    _check_cost,
    _check_limits,
    _check_start,
    _check_tolerances,
    _norm,
)

_SUFFICIENT = 1e-4  # of the decrease that the slope promises (Armijo)
_LEAST = 1e-6  # of the largest curvature: what damping lifts the least one to, where it is positive


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
    """Newton's method.

    start: (..., n) float32 or float64, n small; objective: (..., n) -> (...,) costs, each of its
    own row alone, twice differentiable by autograd.

    damped=True: the Hessian is shifted (Levenberg) until its least eigenvalue, if negative, has
    changed sign, and is 1e-6 of the largest one at least; the step is halved, at most `search`
    times, until the cost falls (Armijo), and a trial whose search finds nothing ends there.
    damped=False: x - H^-1 gradient as it is, which climbs to maxima and saddles as readily as it
    descends, and diverges where H is near singular: the published behaviour of what Remote Sens.
    2025, 17, 3447 calls Gauss-Newton. (An entropy is no sum of squares; with its true Hessian this
    is the Newton-type method that the name must stand for. The quasi-Newton one is `lbfgs`.)

    Result: x is the last point, finite wherever the start is: a trial that steps into a cost or
    derivative that is not finite stays before it, not ok. converged: the gradient norm is at most
    gradient_tolerance of that at the start, or a step changed the cost by at most value_tolerance
    of it. ok: nothing was lost on the way, the end is not above the start and its Hessian positive
    definite, and, undamped, the trial has converged. evaluations: calls of the objective in which
    the trial took part; one that also gives the Hessian counts once but costs n + 1 backward passes
    on top. Detached; it cannot be put inside vmap. Errors as in `lbfgs`. Nocedal and Wright 2006,
    Numerical Optimization, section 3.4 (modification of the Hessian), algorithm 3.1.
    """
    _check_start(start)
    _check_limits("newton", steps=steps, search=search)
    _check_tolerances("newton", gradient_tolerance, value_tolerance)
    begin = _place(objective, start.detach().clone())
    rules = _Rules(
        damped,
        search,
        gradient_tolerance * _norm(begin.gradient),
        max(value_tolerance, 4 * torch.finfo(start.dtype).eps),
    )
    state = _opening(begin)
    for _ in range(steps):
        if not bool(state.active.any()):
            break
        state = _advance(objective, state, rules)
    here = state.place
    bowl = _curvatures(here)[0][..., 0] > 0
    ok = begin.finite & ~state.lost & bowl & (here.cost <= begin.cost) & (state.converged | damped)
    return Descent(here.x, here.cost, _norm(here.gradient), state.steps, state.evaluations, state.converged, ok)


class _Rules(NamedTuple):
    damped: bool
    search: int
    small: Tensor
    still: float


class _Place(NamedTuple):
    x: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    finite: Tensor


class _State(NamedTuple):
    """lost: stepped into a cost or derivative that is not finite, or had no finite step."""

    place: _Place
    steps: Tensor
    evaluations: Tensor
    active: Tensor
    converged: Tensor
    lost: Tensor


def _opening(begin: _Place) -> _State:
    none = torch.zeros_like(begin.finite, dtype=torch.int64)
    level = begin.finite & (_norm(begin.gradient) == 0)
    return _State(begin, none, none + 1, begin.finite & ~level, level, torch.zeros_like(level))


def _advance(objective: Objective, state: _State, rules: _Rules) -> _State:
    """One step of every active trial."""
    here = state.place
    step = _step(here, rules.damped)
    sound, tried = torch.isfinite(step).all(-1), torch.zeros_like(state.steps)
    if rules.damped:
        step, tried = _shortened(objective, here, step, state.active & sound, rules.search)
    moved = state.active & sound & (step != 0).any(-1)
    there = _place(objective, torch.where(moved[..., None], here.x + step, here.x))
    arrived = moved & there.finite
    still = (there.cost - here.cost).abs() <= rules.still * torch.maximum(there.cost.abs(), here.cost.abs())
    ended = arrived & ((_norm(there.gradient) <= rules.small) | still)
    return _State(
        place=_Place(
            *(
                torch.where(arrived[(...,) + (None,) * (new.ndim - arrived.ndim)], new, old)
                for new, old in zip(there, here, strict=True)
            )
        ),
        steps=state.steps + arrived,
        evaluations=state.evaluations + tried + moved,
        active=arrived & ~ended,
        converged=state.converged | ended,
        lost=state.lost | (state.active & ~(sound & (arrived | ~moved))),
    )


def _place(objective: Objective, x: Tensor) -> _Place:
    """Cost, gradient and Hessian at x (..., n): rows do not mix, so the Hessians of all trials come
    from n backward passes.
    """
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        cost = objective(x)
        _check_cost(cost, x)
        if not cost.requires_grad:
            raise ValueError(
                "the objective returned costs that autograd cannot follow back to x; leave out detach and no_grad"
            )
        (gradient,) = torch.autograd.grad(cost.sum(), x, create_graph=True)
        hessian = torch.stack([_row(part, x) for part in gradient.unbind(-1)], -2)
    cost, gradient = cost.detach(), gradient.detach()
    finite = torch.isfinite(cost) & torch.isfinite(gradient).all(-1) & torch.isfinite(hessian).all(-1).all(-1)
    return _Place(x.detach(), cost, gradient, 0.5 * (hessian + hessian.mT), finite)


def _row(part: Tensor, x: Tensor) -> Tensor:
    row = torch.autograd.grad(part.sum(), x, retain_graph=True, allow_unused=True)[0] if part.requires_grad else None
    return torch.zeros_like(x) if row is None else row.detach()


def _curvatures(place: _Place) -> tuple[Tensor, Tensor]:
    """Eigenvalues, rising, and eigenvectors of the Hessian; of a diagonal of zeros where it is not
    finite.
    """
    return torch.linalg.eigh(torch.where(place.finite[..., None, None], place.hessian, 0))


def _step(place: _Place, damped: bool) -> Tensor:
    """-(H + shift)^-1 gradient; not finite where the Hessian is singular to the last digit."""
    values, vectors = _curvatures(place)
    if damped:
        least = values[..., 0]
        values = values + torch.maximum(-2 * least, _LEAST * values.abs().amax(-1) - least).clamp_min(0)[..., None]
    along = (vectors.mT @ place.gradient[..., None])[..., 0]
    return -(vectors @ (along / values)[..., None])[..., 0]


def _shortened(objective: Objective, place: _Place, step: Tensor, active: Tensor, search: int) -> tuple[Tensor, Tensor]:
    """Steps halved until the cost falls enough, zero where it never does; and the evaluations this
    took each trial.
    """
    promised = (place.gradient * step).sum(-1)
    rounding = 4 * torch.finfo(place.cost.dtype).eps * place.cost.abs()
    searching, scale = active & (promised < 0), torch.ones_like(promised)
    found, tries = torch.zeros_like(active), torch.zeros_like(active, dtype=torch.int64)
    with torch.no_grad():
        for _ in range(search):
            if not bool(searching.any()):
                break
            cost = objective(torch.where(searching[..., None], place.x + scale[..., None] * step, place.x))
            low = searching & (cost - place.cost <= _SUFFICIENT * scale * promised + rounding)
            tries, found, searching = tries + searching, found | low, searching & ~low
            scale = torch.where(searching, scale / 2, scale)
    return torch.where(found[..., None], scale[..., None] * step, 0), tries
