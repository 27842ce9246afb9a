"""Minimising a smooth function of a vector per trial, all trials at once: each trial has its own
search, its own history and its own end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

# (..., n) -> (...,), or with_gradient=True: -> ((...,), (..., n))
Objective = Callable[[Tensor], Any]

_SUFFICIENT = 1e-4  # of the decrease that the slope promises (Armijo)
_CURVATURE = 0.9  # of the slope at the start of the search (strong Wolfe)
_EDGE = 0.1  # of a bracket: no trial point closer to its ends


@dataclass(frozen=True)
class Descent:
    """What a descent found, per trial (...,).

    x: (..., n) best point. cost: (...,) there, in the dtype of the objective. gradient_norm: (...,)
    Euclidean, there. steps: (...,) int64 steps taken. evaluations: (...,) int64 calls of the
    objective in which the trial took part. converged: (...,) bool, a tolerance was met. ok: (...,)
    bool, False where the start or the way was not finite: x is then the best finite point, or the
    start; a start that was not finite keeps its cost and gradient as they came.
    """

    x: Tensor
    cost: Tensor
    gradient_norm: Tensor
    steps: Tensor
    evaluations: Tensor
    converged: Tensor
    ok: Tensor


def lbfgs(
    objective: Objective,
    start: Tensor,
    *,
    steps: int = 50,
    history: int = 10,
    gradient_tolerance: float = 1e-6,
    value_tolerance: float = 1e-9,
    first_step: float = 1.0,
    search: int = 20,
    with_gradient: bool = False,
) -> Descent:
    """Limited-memory BFGS with a strong Wolfe line search.

    start: (..., n) float32 or float64; objective: (..., n) -> (...,) costs, each of its own row
    alone.

    Every call of the objective serves all trials, each at its own place of its own search: none
    waits for another, and no result depends on the others. A finished trial is still evaluated (at
    its result), but neither changes nor counts. Gradients come from autograd, also under no_grad,
    or from the objective itself (with_gradient=True: it returns costs (...,) and gradients (...,
    n)). Invariant to the scale and the offset of the cost, but for value_tolerance. The result is
    detached. Trials are leading dims; it cannot be put inside vmap.

    steps: at most, per trial. history: pairs kept, those without positive curvature are dropped.
    gradient_tolerance: a trial has converged when its gradient norm is at most this fraction of
    that at the start. value_tolerance: or when a step lowers the cost by at most this fraction of
    it (at least four units of rounding). first_step: length of the first trial step in the units of
    x. search: evaluations of one line search at most; a search that finds nothing drops the history
    once, then ends the trial. A step into non-finite cost or gradient counts as too long; a trial
    whose search ends at such a wall is not ok.

    Raises TypeError or ValueError for a start that is not real floating, an answer of the wrong
    shape, or limits that make no sense. Nocedal and Wright 2006, Numerical Optimization, algorithms
    7.4 (two loops), 3.5 and 3.6 (search), Eq. (3.59) (cubic).
    """
    _check_start(start)
    _check_limits("lbfgs", steps=steps, history=history, search=search, first_step=first_step)
    _check_tolerances("lbfgs", gradient_tolerance, value_tolerance)
    rules = _Rules(steps, gradient_tolerance, value_tolerance, first_step, search)
    with torch.no_grad():
        scaled = _Scaled(objective, start, with_gradient)
        state = _opening(scaled, history, rules)
        while bool(state.active.any()):
            state = _advance(state, scaled, rules)
    norm = _norm(state.gradient) * scaled.scale
    return Descent(state.x, state.cost, norm, state.steps, state.evaluations, state.converged, state.ok)


def adam(
    objective: Objective,
    start: Tensor,
    *,
    steps: int = 500,
    rate: float = 0.05,
    betas: tuple[float, float] = (0.9, 0.999),
    gradient_tolerance: float = 1e-6,
    value_tolerance: float = 1e-6,
    patience: int = 50,
    with_gradient: bool = False,
) -> Descent:
    """Adam at a constant rate, returning the best point visited.

    start, objective, gradients, result and errors as in `lbfgs`; one evaluation a step.

    rate: length of the first step in each coordinate, in the units of x. betas: memory of the
    gradient and of its square, per step. A trial has converged when its gradient norm is at most
    gradient_tolerance of that at the start, or when its best cost fell by at most value_tolerance
    of itself during `patience` steps, which must outlast an overshoot. A trial that steps onto a
    non-finite cost or gradient ends there, not ok. For costs that are rough on the scale of a step,
    or noisy; `lbfgs` goes further in fewer evaluations on a smooth one. Kingma and Ba 2015,
    algorithm 1, with epsilon relative to the first gradient.
    """
    _check_start(start)
    _check_limits("adam", steps=steps, patience=patience, rate=rate)
    _check_tolerances("adam", gradient_tolerance, value_tolerance)
    if not all(0 <= beta < 1 for beta in betas):
        raise ValueError(f"adam: betas are {betas}; choose both in 0 <= beta < 1, for instance (0.9, 0.999)")
    with torch.no_grad():
        scaled = _Scaled(objective, start, with_gradient)
        walk = _first_walk(scaled, gradient_tolerance)
        for count in range(1, steps + 1):
            if not bool(walk.active.any()):
                break
            walk = _walk(walk, scaled, count, rate, betas)
            walk = _ended(walk, scaled, gradient_tolerance, value_tolerance, patience)
    return Descent(
        walk.best, walk.best_cost, walk.best_norm * scaled.scale, walk.steps, walk.steps + 1, walk.converged, walk.ok
    )


class _Rules(NamedTuple):
    steps: int
    gradient_tolerance: float
    value_tolerance: float
    first_step: float
    search: int


class _Scaled:
    """The objective with gradients divided by the largest element of the first one, per trial: no
    square of them leaves the range of the dtype.
    """

    def __init__(self, objective: Objective, start: Tensor, with_gradient: bool) -> None:
        self._objective, self._with_gradient = objective, with_gradient
        self.start = start.detach().clone()
        self.scale = torch.ones_like(self.start[..., 0])
        self.cost, gradient, self.finite = self(self.start)
        peak = gradient.abs().amax(-1)
        self.scale = torch.where(peak > 0, peak, self.scale)
        self.gradient = gradient / self.scale[..., None]
        self.norm = _norm(self.gradient)

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (...,) as it came, scaled gradient (..., n), and whether both are finite (...,)."""
        cost, gradient = (_given if self._with_gradient else _derived)(self._objective, x)
        finite = torch.isfinite(cost) & torch.isfinite(gradient).all(-1)
        return cost, gradient / self.scale[..., None], finite


class _Point(NamedTuple):
    """A point of the search: step along the direction, rise of the cost since the search began and
    slope, both over the descent there (slope -1 at step 0).
    """

    step: Tensor
    rise: Tensor
    slope: Tensor


class _Search(NamedTuple):
    """low: the lowest point with sufficient decrease, with its cost and gradient.

    high: the other end of the bracket, at step inf until there is one.
    """

    low: _Point
    high: _Point
    cost: Tensor
    gradient: Tensor
    step: Tensor
    tries: Tensor


class _Pairs(NamedTuple):
    """The last moves and gradient changes (history, ..., n), newest last, and 1 / (move .

    change), (history, ...), 0 where there is none.
    """

    move: Tensor
    change: Tensor
    inverse: Tensor


class _State(NamedTuple):
    x: Tensor
    cost: Tensor
    gradient: Tensor
    direction: Tensor
    descent: Tensor
    pairs: _Pairs
    search: _Search
    steps: Tensor
    evaluations: Tensor
    active: Tensor
    converged: Tensor
    ok: Tensor


def _opening(scaled: _Scaled, history: int, rules: _Rules) -> _State:
    none = scaled.start.new_zeros(history, *scaled.start.shape)
    pairs = _Pairs(none, none, none[..., 0])
    converged = scaled.finite & (scaled.norm == 0)
    direction, descent, search = _aim(scaled.cost, scaled.gradient, pairs, rules)
    steps = torch.zeros_like(converged, dtype=torch.int64)
    active = scaled.finite & ~converged
    return _State(
        scaled.start,
        scaled.cost,
        scaled.gradient,
        direction,
        descent,
        pairs,
        search,
        steps,
        steps + 1,
        active,
        converged,
        scaled.finite,
    )


def _advance(state: _State, scaled: _Scaled, rules: _Rules) -> _State:
    """One evaluation of every active trial; those whose search has ended move and aim anew."""
    search, accepted = _probe(state, scaled)
    state = state._replace(search=search, evaluations=state.evaluations + state.active)
    ended = state.active & (accepted | (search.tries >= rules.search))
    if not bool(ended.any()):
        return state
    wall = ended & ~accepted & torch.isinf(search.high.rise)
    return _turn(_move(state, ended, wall, scaled, rules), ended, rules)


def _probe(state: _State, scaled: _Scaled) -> tuple[_Search, Tensor]:
    """Evaluate the next point of each search; the search that knows it, and whether the point is
    good enough.
    """
    search = state.search
    cost, gradient, finite = scaled(_where(state.active, _along(state, search.step), state.x))
    rise = _relative(cost - state.cost, state, scaled)
    slope = _dot(gradient, state.direction) / state.descent
    point = _Point(search.step, torch.where(finite, rise, torch.inf), slope)
    # near the minimum the cost is rounded: a rise of some units in its last place is none, and the
    # slope decides
    rounding = _relative(4 * torch.finfo(cost.dtype).eps * state.cost.abs(), state, scaled)
    low, high, step, higher, accepted = _narrow(search.low, search.high, point, rounding)
    return _Search(
        low, high, _where(higher, search.cost, cost), _where(higher, search.gradient, gradient), step, search.tries + 1
    ), accepted


def _narrow(
    low: _Point, high: _Point, point: _Point, rounding: Tensor
) -> tuple[_Point, _Point, Tensor, Tensor, Tensor]:
    """One round of the strong Wolfe search: new ends, next step, whether the point is too high, and
    whether it is good enough.
    """
    higher = ~(point.rise <= torch.minimum(-_SUFFICIENT * point.step, low.rise) + rounding)
    accepted = ~higher & (point.slope.abs() <= _CURVATURE)
    turned = ~higher & (torch.sign(point.slope) * torch.sign(high.step - low.step) > 0)
    next_low = _where(higher, low, point)
    next_high = _where(higher, point, _where(turned, low, high))
    step = torch.where(torch.isinf(next_high.step), _beyond(low, point), _between(next_low, next_high))
    return next_low, next_high, step, higher, accepted


def _between(low: _Point, high: _Point) -> Tensor:
    width = high.step - low.step
    part = (_cubic(low, high) - low.step) / width
    return low.step + width * torch.where(torch.isfinite(part), part, 0.5).clamp(_EDGE, 1 - _EDGE)


def _beyond(low: _Point, point: _Point) -> Tensor:
    width = point.step - low.step
    part = (_cubic(low, point) - point.step) / width
    return point.step + width * torch.where(torch.isfinite(part) & (part > 0), part, 4.0).clamp(1.1, 4.0)


def _cubic(a: _Point, b: _Point) -> Tensor:
    """Minimiser of the cubic through two points and their slopes; NaN where it has none."""
    width = b.step - a.step
    bend = a.slope + b.slope - 3 * (b.rise - a.rise) / width
    root = torch.sign(width) * torch.sqrt(bend.square() - a.slope * b.slope)
    return b.step - width * (b.slope + root - bend) / (b.slope - a.slope + 2 * root)


def _move(state: _State, ended: Tensor, wall: Tensor, scaled: _Scaled, rules: _Rules) -> _State:
    """Take the lowest point of each search that has ended, remember the pair, and see who has
    finished.
    """
    search = state.search
    moved = ended & (search.low.step > 0)
    x, cost, gradient = (
        _where(moved, _along(state, search.low.step), state.x),
        _where(moved, search.cost, state.cost),
        _where(moved, search.gradient, state.gradient),
    )
    # below a few units of rounding a search only chases noise
    tolerance = max(rules.value_tolerance, 4 * torch.finfo(cost.dtype).eps) if rules.value_tolerance else 0.0
    lowered = state.cost - cost <= tolerance * torch.maximum(cost.abs(), state.cost.abs())
    converged = moved & ((lowered & ~wall) | (_norm(gradient) <= rules.gradient_tolerance * scaled.norm))
    steps = state.steps + moved
    stuck = ended & ~moved & (state.pairs.inverse == 0).all(0)
    pairs = _remember(state.pairs, x - state.x, gradient - state.gradient, moved)
    pairs = pairs._replace(inverse=torch.where(ended & ~moved, 0, pairs.inverse))
    active = state.active & ~(converged | stuck | wall | (steps >= rules.steps))
    return state._replace(
        x=x,
        cost=cost,
        gradient=gradient,
        pairs=pairs,
        steps=steps,
        active=active,
        converged=state.converged | converged,
        ok=state.ok & (~wall | converged),
    )


def _turn(state: _State, ended: Tensor, rules: _Rules) -> _State:
    """Begin a new search where one has ended."""
    direction, descent, search = _aim(state.cost, state.gradient, state.pairs, rules)
    return state._replace(
        direction=_where(ended, direction, state.direction),
        descent=_where(ended, descent, state.descent),
        search=_where(ended, search, state.search),
    )


def _aim(cost: Tensor, gradient: Tensor, pairs: _Pairs, rules: _Rules) -> tuple[Tensor, Tensor, _Search]:
    """The quasi-Newton direction (steepest descent without pairs), the descent along it per unit
    step, and a search that has not begun.
    """
    newton = _two_loops(gradient, pairs)
    promised = -_dot(gradient, newton)
    usable = (pairs.inverse[-1] > 0) & torch.isfinite(promised) & (promised > 0)
    direction = _where(usable, newton, -gradient)
    norm = _norm(gradient)
    step = torch.where(usable, 1.0, rules.first_step / torch.where(norm > 0, norm, 1))
    descent = torch.where(usable, promised, norm.square())
    zero = torch.zeros_like(step)
    low = _Point(zero, zero, zero - 1)
    return (
        direction,
        descent,
        _Search(
            low, low._replace(step=zero + torch.inf), cost, gradient, step, torch.zeros_like(step, dtype=torch.int64)
        ),
    )


def _two_loops(gradient: Tensor, pairs: _Pairs) -> Tensor:
    """-H gradient; a slot whose inverse is 0 changes nothing."""
    q, weights = -gradient, []
    for move, change, inverse in reversed(list(zip(*pairs, strict=True))):
        weights.append((inverse * _dot(move, q))[..., None])
        q = q - weights[-1] * change
    size = pairs.inverse[-1] * _dot(pairs.change[-1], pairs.change[-1])
    q = q / torch.where(size > 0, size, 1)[..., None]
    for (move, change, inverse), weight in zip(zip(*pairs, strict=True), reversed(weights), strict=True):
        q = q + (weight - (inverse * _dot(change, q))[..., None]) * move
    return q


def _remember(pairs: _Pairs, move: Tensor, change: Tensor, moved: Tensor) -> _Pairs:
    """Pairs with the newest one, where it has positive curvature beyond rounding."""
    curvature = _dot(move, change)
    keep = moved & (curvature > torch.finfo(move.dtype).eps * _norm(move) * _norm(change))
    newest = _Pairs(move, change, 1 / torch.where(keep, curvature, 1))
    move, change, inverse = (torch.cat((old[1:], new[None])) for old, new in zip(pairs, newest, strict=True))
    return _Pairs(
        torch.where(keep[..., None], move, pairs.move),
        torch.where(keep[..., None], change, pairs.change),
        torch.where(keep, inverse, pairs.inverse),
    )


def _along(state: _State, step: Tensor) -> Tensor:
    return state.x + step[..., None] * state.direction


def _relative(difference: Tensor, state: _State, scaled: _Scaled) -> Tensor:
    return (difference / scaled.scale).to(state.x.dtype) / state.descent


class _Walk(NamedTuple):
    x: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    best: Tensor
    best_cost: Tensor
    best_norm: Tensor
    mark: Tensor
    waited: Tensor
    steps: Tensor
    active: Tensor
    converged: Tensor
    ok: Tensor


def _first_walk(scaled: _Scaled, gradient_tolerance: float) -> _Walk:
    none, count = torch.zeros_like(scaled.start), torch.zeros_like(scaled.finite, dtype=torch.int64)
    converged = scaled.finite & (scaled.norm == 0)
    active = scaled.finite & ~converged
    return _Walk(
        scaled.start,
        scaled.gradient,
        none,
        none,
        scaled.start,
        scaled.cost,
        scaled.norm,
        scaled.cost,
        count,
        count,
        active,
        converged,
        scaled.finite,
    )


def _walk(walk: _Walk, scaled: _Scaled, count: int, rate: float, betas: tuple[float, float]) -> _Walk:
    """One step of the active trials, and the best point so far."""
    active = walk.active
    mean = betas[0] * walk.mean + (1 - betas[0]) * walk.gradient
    square = betas[1] * walk.square + (1 - betas[1]) * walk.gradient.square()
    move = rate * (mean / (1 - betas[0] ** count)) / ((square / (1 - betas[1] ** count)).sqrt() + 1e-8)
    x = _where(active, walk.x - move, walk.x)
    cost, gradient, finite = scaled(x)
    better = active & finite & (cost < walk.best_cost)
    return walk._replace(
        x=x,
        gradient=gradient,
        mean=mean,
        square=square,
        best=_where(better, x, walk.best),
        best_cost=_where(better, cost, walk.best_cost),
        best_norm=_where(better, _norm(gradient), walk.best_norm),
        steps=walk.steps + active,
        active=active & finite,
        ok=walk.ok & (finite | ~active),
    )


def _ended(walk: _Walk, scaled: _Scaled, gradient_tolerance: float, value_tolerance: float, patience: int) -> _Walk:
    """Who has converged: a small gradient at the best point, or no gain worth the name for
    `patience` steps.
    """
    gain = walk.mark - walk.best_cost > value_tolerance * torch.maximum(walk.mark.abs(), walk.best_cost.abs())
    waited = torch.where(gain, 0, walk.waited + 1)
    converged = walk.active & ((walk.best_norm <= gradient_tolerance * scaled.norm) | (waited >= patience))
    return walk._replace(
        mark=torch.where(gain, walk.best_cost, walk.mark),
        waited=waited,
        active=walk.active & ~converged,
        converged=walk.converged | converged,
    )


def _derived(objective: Objective, x: Tensor) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        cost = objective(x)
        _check_cost(cost, x)
        (gradient,) = torch.autograd.grad(cost.sum(), x, allow_unused=True) if cost.requires_grad else (None,)
        if gradient is None:
            raise ValueError(
                "the objective returned costs that autograd cannot follow back to x; leave out "
                "detach and no_grad, or return (cost, gradient) with with_gradient=True"
            )
    return cost.detach(), gradient


def _given(objective: Objective, x: Tensor) -> tuple[Tensor, Tensor]:
    answer = objective(x)
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise TypeError(
            "with_gradient=True needs an objective that returns (cost, gradient), this one "
            f"returned {type(answer).__name__}; return the pair or leave with_gradient out"
        )
    cost, gradient = answer
    _check_cost(cost, x)
    if not isinstance(gradient, Tensor) or gradient.shape != x.shape:
        raise ValueError(
            f"the objective returned {_what(gradient)} as gradient at x of shape "
            f"{tuple(x.shape)}; return the same shape as x"
        )
    return cost.detach(), gradient.detach().to(x.dtype)


def _check_start(start: Tensor) -> None:
    if start.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"start is {start.dtype}; a descent needs float32 or float64, give complex unknowns "
            "as their real and imaginary parts"
        )
    if start.ndim == 0 or start.shape[-1] == 0:
        raise ValueError(
            f"start has shape {tuple(start.shape)}; give the unknowns in its last dim, (..., n) with n of at least 1"
        )


def _check_limits(method: str, **limits: float) -> None:
    for name, value in limits.items():
        if not value > 0:
            raise ValueError(f"{method}: {name} is {value}; choose a positive number")


def _check_tolerances(method: str, gradient_tolerance: float, value_tolerance: float) -> None:
    if not (gradient_tolerance >= 0 and value_tolerance >= 0):
        raise ValueError(
            f"{method}: gradient_tolerance is {gradient_tolerance} and value_tolerance "
            f"{value_tolerance}; choose relative tolerances of at least 0, such as 1e-6"
        )


def _check_cost(cost: Any, x: Tensor) -> None:
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        raise ValueError(
            f"the objective returned {_what(cost)} for x of shape {tuple(x.shape)}; return one "
            f"real cost per trial, shape {tuple(x.shape[:-1])}"
        )


def _what(value: Any) -> str:
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__


def _where(mask: Tensor, yes: Any, no: Any) -> Any:
    """torch.where, in every tensor of named tuples; mask: (...,), also over tensors with a dim of
    unknowns (..., n).
    """
    if isinstance(yes, Tensor):
        return torch.where(mask[..., None] if yes.ndim > mask.ndim else mask, yes, no)
    return type(yes)(*(_where(mask, a, b) for a, b in zip(yes, no, strict=True)))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _norm(x: Tensor) -> Tensor:
    return torch.linalg.vector_norm(x, dim=-1)
