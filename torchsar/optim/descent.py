"""Gradient descent of a smooth cost per trial: L-BFGS and Adam.

All trials are evaluated together, but each follows its own search and ends by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar.core import differentiable

# function of points (..., n) that returns costs, or with with_gradient=True costs and gradients
Objective = Callable[[Tensor], Any]

# constants of sufficient decrease (Armijo) and curvature (strong Wolfe) for quasi-Newton methods
# according to Nocedal and Wright 2006, section 3.1
SUFFICIENT, _CURVATURE = 1e-4, 0.9


@dataclass(frozen=True)
class Descent:
    """Result of a descent, per trial.

    >>> import torch
    >>> from torchsar.optim import lbfgs
    >>> found = lbfgs(lambda x: (x - 1).square().sum(-1), torch.zeros(3, 2))  # trials, unknowns
    >>> found.x.shape, found.converged, bool(found.cost.max() < 1e-6)
    (torch.Size([3, 2]), tensor([True, True, True]), True)

    Args:
        x: Best point, shape (..., n). Where `ok` is False it is the best finite point, or the
            start.
        cost: Cost at `x`, shape (...,), in the dtype of the objective. Where the cost or gradient
            at the start is not finite, the trial ends there and has the cost of the start.
        gradient_norm: Euclidean norm of the gradient at `x`, shape (...,).
        steps: Steps taken, shape (...,), int64.
        evaluations: Calls of the objective in which the trial took part, shape (...,), int64.
        converged: True where a tolerance was met, shape (...,), bool.
        ok: False where the start, or a point at which the search ended, had a cost or gradient that
            was not finite, shape (...,), bool. `newton` documents further conditions.
    """

    x: Tensor
    cost: Tensor
    gradient_norm: Tensor
    steps: Tensor
    evaluations: Tensor
    converged: Tensor
    ok: Tensor


@differentiable("no")
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
    """Minimise a smooth cost per trial by limited-memory BFGS with a strong Wolfe line search.

    >>> import torch
    >>> from torchsar.optim import lbfgs
    >>> lbfgs(lambda x: (x - torch.tensor([1.0, 2.0])).square().sum(-1), torch.zeros(2)).x
    tensor([1., 2.])

    Every call of the objective evaluates all trials, each at the current point of its own search,
    so that no result depends on the other trials. A finished trial is still evaluated, at its
    result, but its point and its counts no longer change. Apart from `value_tolerance` the search
    is invariant to the scale and the offset of the cost. The result carries no gradient. All
    leading dimensions are trials; torch.func.vmap is not supported.

    Args:
        objective: Maps points (..., n) to real costs (...,), each cost from its own row alone.
            Gradients come from autograd, also under no_grad.
        start: First point, shape (..., n), float32 or float64.
        steps: Largest number of steps of a trial.
        history: Number of stored pairs of a step and its change of the gradient. Pairs without
            positive curvature are dropped.
        gradient_tolerance: A trial has converged when its gradient norm is at most this fraction of
            that at the start.
        value_tolerance: A trial has converged when a step lowers the cost by at most this fraction
            of the cost. A positive value below four times the machine epsilon of the dtype is
            raised to that; 0 remains 0.
        first_step: Length of the first step that is tested, in the units of x.
        search: Largest number of evaluations of one line search. After a search that finds no lower
            point, the history is dropped and the search repeated along the steepest descent; if
            that fails too, the trial ends. A step to a cost or gradient that is not finite counts
            as too long; `ok` is False for a trial whose search ends there.
        with_gradient: Whether the objective itself returns the pair of costs (...,) and gradients
            (..., n).

    Returns:
        Best point per trial, with cost, counts, `converged` and `ok`.

    Raises:
        TypeError: If the start is not float32 or float64, or `with_gradient` is set and the
            objective does not return a pair.
        ValueError: If the objective returns another shape or costs without a gradient, or if a
            limit is not positive or a tolerance negative.

    Reference:
        Nocedal and Wright 2006, Numerical Optimization, algorithms 7.4 (two-loop recursion), 3.5
        and 3.6 (line search), Eq. (3.59) (cubic interpolation).
    """
    check_start(start)
    check_limits("lbfgs", steps=steps, history=history, search=search, first_step=first_step)
    check_tolerances("lbfgs", gradient_tolerance, value_tolerance)
    with torch.no_grad():
        scaled = _Scaled(objective, start, with_gradient)
        none, count = scaled.start.new_zeros(history, *start.shape), torch.zeros_like(scaled.finite, dtype=torch.int64)
        pairs = _Pairs(none, none, none[..., 0])
        flat = scaled.finite & (scaled.norm == 0)
        state = _State(
            x=scaled.start,
            cost=scaled.cost,
            gradient=scaled.gradient,
            pairs=pairs,
            search=_new_search(scaled.cost, scaled.gradient, pairs, first_step),
            steps=count,
            evaluations=count + 1,
            active=scaled.finite & ~flat,
            converged=flat,
            ok=scaled.finite,
        )
        rounds, known, on_host = 0, 0, start.device.type == "cpu"
        while rounds < known or bool(state.active.any()):
            # an accelerator waits for each look, which therefore become rarer
            rounds, known = rounds + 1, known if on_host or rounds < known else 3 * (rounds + 1) // 2
            line, accepted = _probe(state, scaled)
            state = state._replace(search=line, evaluations=state.evaluations + state.active)
            ended = state.active & (accepted | (line.tries >= search))
            if on_host and not bool(ended.any()):
                continue
            # trials whose line search has ended move to its result and start a new search
            not_finite = ended & ~accepted & torch.isinf(line.high.rise)
            state = _move(state, ended, not_finite, gradient_tolerance * scaled.norm, value_tolerance)
            begun = _new_search(state.cost, state.gradient, state.pairs, first_step)
            active = state.active & (state.steps < steps)
            state = state._replace(search=_where(ended, begun, state.search), active=active)
    gradient_norm = norm(state.gradient) * scaled.scale
    return Descent(state.x, state.cost, gradient_norm, state.steps, state.evaluations, state.converged, state.ok)


@differentiable("no")
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
    """Minimise a cost per trial by Adam at a constant rate, and return the best point visited.

    >>> import torch
    >>> from torchsar.optim import adam
    >>> found = adam(lambda x: (x - 1).square().sum(-1), torch.zeros(2))
    >>> bool((found.x - 1).abs().max() < 0.01)
    True

    Adam suits costs that are noisy, or rough on the scale of a step; on a smooth cost `lbfgs`
    reaches a lower cost in fewer evaluations. Each step evaluates the objective once.

    Args:
        objective: Maps points (..., n) to real costs (...,), each cost from its own row alone.
            Gradients come from autograd, also under no_grad.
        start: First point, shape (..., n), float32 or float64.
        steps: Largest number of steps of a trial.
        rate: Length of the first step in each coordinate, in the units of x.
        betas: Decay per step of the averages of the gradient and of its square.
        gradient_tolerance: A trial has converged when its gradient norm is at most this fraction of
            that at the start.
        value_tolerance: A trial has converged when its best cost fell by at most this fraction of
            itself during `patience` steps.
        patience: Number of steps without such a fall of the best cost after which a trial has
            converged; choose it longer than the oscillations about a minimum.
        with_gradient: Whether the objective itself returns the pair of costs (...,) and gradients
            (..., n).

    Returns:
        Best point per trial, with cost, counts, `converged` and `ok`. `ok` is False where the start
        or a later point had a cost or gradient that was not finite; the trial ends there.

    Raises:
        TypeError: If the start is not float32 or float64, or `with_gradient` is set and the
            objective does not return a pair.
        ValueError: If the objective returns another shape or costs without a gradient, if a limit
            is not positive or a tolerance negative, or if `betas` do not lie in 0 <= beta < 1.

    Reference:
        Kingma and Ba 2015, algorithm 1, with epsilon relative to the first gradient.
    """
    check_start(start)
    check_limits("adam", steps=steps, patience=patience, rate=rate)
    check_tolerances("adam", gradient_tolerance, value_tolerance)
    if not all(0 <= beta < 1 for beta in betas):
        raise ValueError(f"adam: both betas must satisfy 0 <= beta < 1, such as (0.9, 0.999), got {betas}")
    with torch.no_grad():
        scaled = _Scaled(objective, start, with_gradient)
        x, gradient, mean, square = scaled.start, scaled.gradient, 0 * scaled.start, 0 * scaled.start
        best = _Point(scaled.start, scaled.cost, scaled.norm)
        mark, ok = scaled.cost, scaled.finite
        waited = taken = torch.zeros_like(ok, dtype=torch.int64)
        converged = ok & (scaled.norm == 0)
        active = ok & ~converged
        for count in range(1, steps + 1):
            if not bool(active.any()):
                break
            mean = betas[0] * mean + (1 - betas[0]) * gradient
            square = betas[1] * square + (1 - betas[1]) * gradient.square()
            move = rate * (mean / (1 - betas[0] ** count)) / ((square / (1 - betas[1] ** count)).sqrt() + 1e-8)
            x = _where(active, x - move, x)
            cost, gradient, finite = scaled(x)
            better = active & finite & (cost < best.cost)
            best = _where(better, _Point(x, cost, norm(gradient)), best)
            taken, ok, active = taken + active, ok & (finite | ~active), active & finite
            gain = mark - best.cost > value_tolerance * torch.maximum(mark.abs(), best.cost.abs())
            mark, waited = torch.where(gain, best.cost, mark), torch.where(gain, 0, waited + 1)
            ended = active & ((best.norm <= gradient_tolerance * scaled.norm) | (waited >= patience))
            active, converged = active & ~ended, converged | ended
    return Descent(best.x, best.cost, best.norm * scaled.scale, taken, taken + 1, converged, ok)


class _Point(NamedTuple):
    """A point (..., n), its cost, and the norm of the gradient there, (...,) each."""

    x: Tensor
    cost: Tensor
    norm: Tensor


class _Scaled:
    """Objective with gradients divided by the largest element of the first gradient of each trial,
    so that no square overflows or underflows in the dtype.
    """

    def __init__(self, objective: Objective, start: Tensor, with_gradient: bool) -> None:
        self._objective, self._with_gradient = objective, with_gradient
        self.start = start.detach().clone()
        self.scale = torch.ones_like(self.start[..., 0])
        self.cost, gradient, self.finite = self(self.start)
        peak = gradient.abs().amax(-1)
        self.scale = torch.where(peak > 0, peak, self.scale)
        self.gradient = gradient / self.scale[..., None]
        self.norm = norm(self.gradient)

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (...,), scaled gradient (..., n), and True where both are finite (...,)."""
        cost, gradient = (_given if self._with_gradient else _derived)(self._objective, x)
        finite = torch.isfinite(cost) & torch.isfinite(gradient).all(-1)
        return cost, gradient / self.scale[..., None], finite


class _Along(NamedTuple):
    """Point of a line search: step length, change of the cost, and slope. Both are relative to the
    decrease per unit step at the start, so that the slope there is -1.
    """

    step: Tensor
    rise: Tensor
    slope: Tensor


class _Search(NamedTuple):
    """State of a line search: direction, decrease of the cost per unit step, and bracket.

    `low` is the lowest point so far with sufficient decrease; `cost` and `gradient` are those at
    this point. `high` is the other end of the bracket; its step is infinite until a bracket is
    found.
    """

    direction: Tensor
    descent: Tensor
    low: _Along
    high: _Along
    cost: Tensor
    gradient: Tensor
    step: Tensor
    tries: Tensor


class _Pairs(NamedTuple):
    """Last moves and changes of the gradient, (history, ..., n), the newest one last.

    `inverse` is 1 / (move . change), (history, ...), and 0 for an empty place.
    """

    move: Tensor
    change: Tensor
    inverse: Tensor


class _State(NamedTuple):
    """State of `lbfgs` between two evaluations, for all trials."""

    x: Tensor
    cost: Tensor
    gradient: Tensor
    pairs: _Pairs
    search: _Search
    steps: Tensor
    evaluations: Tensor
    active: Tensor
    converged: Tensor
    ok: Tensor


def _probe(state: _State, scaled: _Scaled) -> tuple[_Search, Tensor]:
    """Evaluate the next point of each line search; return searches and acceptances."""
    search = state.search
    cost, gradient, finite = scaled(_where(state.active, _along(state, search.step), state.x))
    rise = ((cost - state.cost) / scaled.scale).to(state.x.dtype) / search.descent
    point = _Along(search.step, torch.where(finite, rise, torch.inf), _dot(gradient, search.direction) / search.descent)
    # near the minimum, a rise of the cost by a few rounding errors is ignored
    rounding = (4 * torch.finfo(cost.dtype).eps * state.cost.abs() / scaled.scale).to(state.x.dtype) / search.descent
    low, high, step, higher, accepted = _narrow(search.low, search.high, point, rounding)
    cost, gradient = _where(higher, search.cost, cost), _where(higher, search.gradient, gradient)
    return _Search(search.direction, search.descent, low, high, cost, gradient, step, search.tries + 1), accepted


def _narrow(
    low: _Along, high: _Along, point: _Along, rounding: Tensor
) -> tuple[_Along, _Along, Tensor, Tensor, Tensor]:
    """Make one step of the strong Wolfe line search.

    Returns the new ends of the bracket and the next step length. Also returns True where the cost
    at the point is too high, and True where the point is accepted.
    """
    higher = ~(point.rise <= torch.minimum(-SUFFICIENT * point.step, low.rise) + rounding)
    accepted = ~higher & (point.slope.abs() <= _CURVATURE)
    turned = ~higher & (torch.sign(point.slope) * torch.sign(high.step - low.step) > 0)
    next_low = _where(higher, low, point)
    next_high = _where(higher, point, _where(turned, low, high))
    step = torch.where(torch.isinf(next_high.step), _beyond(low, point), _between(next_low, next_high))
    return next_low, next_high, step, higher, accepted


def _between(low: _Along, high: _Along) -> Tensor:
    """Next step length inside a bracket: the minimum of the cubic, but not close to the ends."""
    width = high.step - low.step
    part = (_cubic(low, high) - low.step) / width
    # at least a tenth of the bracket away from its ends
    return low.step + width * torch.where(torch.isfinite(part), part, 0.5).clamp(0.1, 1 - 0.1)


def _beyond(low: _Along, point: _Along) -> Tensor:
    """Next step length while there is no bracket: at the minimum of the cubic if it has one, but
    between 1.1 and 4 times the last interval beyond the last point.
    """
    width = point.step - low.step
    part = (_cubic(low, point) - point.step) / width
    return point.step + width * torch.where(torch.isfinite(part) & (part > 0), part, 4.0).clamp(1.1, 4.0)


def _cubic(a: _Along, b: _Along) -> Tensor:
    """Minimum of the cubic through two points with given slopes; NaN if it has no minimum."""
    width = b.step - a.step
    bend = a.slope + b.slope - 3 * (b.rise - a.rise) / width
    root = torch.sign(width) * torch.sqrt(bend.square() - a.slope * b.slope)
    return b.step - width * (b.slope + root - bend) / (b.slope - a.slope + 2 * root)


def _move(state: _State, ended: Tensor, not_finite: Tensor, flat_norm: Tensor, value_tolerance: float) -> _State:
    """Move to the result of each search that has ended, and mark the trials that are finished.

    The move and the change of the gradient are added to the pairs.
    """
    search = state.search
    moved = ended & (search.low.step > 0)
    x, cost, gradient = (
        _where(moved, _along(state, search.low.step), state.x),
        _where(moved, search.cost, state.cost),
        _where(moved, search.gradient, state.gradient),
    )
    # a decrease of the cost by a few rounding errors is not significant
    tolerance = max(value_tolerance, 4 * torch.finfo(cost.dtype).eps) if value_tolerance else 0.0
    lowered = state.cost - cost <= tolerance * torch.maximum(cost.abs(), state.cost.abs())
    converged = moved & ((lowered & ~not_finite) | (norm(gradient) <= flat_norm))
    stuck = ended & ~moved & (state.pairs.inverse == 0).all(0)
    pairs = _append(state.pairs, x - state.x, gradient - state.gradient, moved)
    return state._replace(
        x=x,
        cost=cost,
        gradient=gradient,
        pairs=pairs._replace(inverse=torch.where(ended & ~moved, 0, pairs.inverse)),
        steps=state.steps + moved,
        active=state.active & ~(converged | stuck | not_finite),
        converged=state.converged | converged,
        ok=state.ok & (~not_finite | converged),
    )


def _new_search(cost: Tensor, gradient: Tensor, pairs: _Pairs, first_step: float) -> _Search:
    """Start a line search along the quasi-Newton direction; without pairs, the steepest descent."""
    newton = _two_loops(gradient, pairs)
    decrease = -_dot(gradient, newton)
    usable = (pairs.inverse[-1] > 0) & torch.isfinite(decrease) & (decrease > 0)
    size = norm(gradient)
    step = torch.where(usable, 1.0, first_step / torch.where(size > 0, size, 1))
    zero = torch.zeros_like(step)
    low = _Along(zero, zero, zero - 1)
    return _Search(
        direction=_where(usable, newton, -gradient),
        descent=torch.where(usable, decrease, size.square()),
        low=low,
        high=low._replace(step=zero + torch.inf),
        cost=cost,
        gradient=gradient,
        step=step,
        tries=torch.zeros_like(step, dtype=torch.int64),
    )


def _two_loops(gradient: Tensor, pairs: _Pairs) -> Tensor:
    """Quasi-Newton direction by the two-loop recursion; pairs with inverse 0 have no effect."""
    q, weights = -gradient, []
    for move, change, inverse in reversed(list(zip(*pairs, strict=True))):
        weights.append((inverse * _dot(move, q))[..., None])
        q = q - weights[-1] * change
    size = pairs.inverse[-1] * _dot(pairs.change[-1], pairs.change[-1])
    q = q / torch.where(size > 0, size, 1)[..., None]
    for (move, change, inverse), weight in zip(zip(*pairs, strict=True), reversed(weights), strict=True):
        q = q + (weight - (inverse * _dot(change, q))[..., None]) * move
    return q


def _append(pairs: _Pairs, move: Tensor, change: Tensor, moved: Tensor) -> _Pairs:
    """Append the newest pair where its curvature is positive and larger than rounding errors."""
    curvature = _dot(move, change)
    keep = moved & (curvature > torch.finfo(move.dtype).eps * norm(move) * norm(change))
    newest = _Pairs(move, change, 1 / torch.where(keep, curvature, 1))
    move, change, inverse = (torch.cat((old[1:], new[None])) for old, new in zip(pairs, newest, strict=True))
    return _Pairs(
        torch.where(keep[..., None], move, pairs.move),
        torch.where(keep[..., None], change, pairs.change),
        torch.where(keep, inverse, pairs.inverse),
    )


def _along(state: _State, step: Tensor) -> Tensor:
    """Point at a given step length along the direction of the line search."""
    return state.x + step[..., None] * state.search.direction


def _derived(objective: Objective, x: Tensor) -> tuple[Tensor, Tensor]:
    """Compute cost and gradient by automatic differentiation."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        cost = objective(x)
        check_cost(cost, x)
        (gradient,) = torch.autograd.grad(cost.sum(), x, allow_unused=True) if cost.requires_grad else (None,)
        if gradient is None:
            raise ValueError(
                "the objective returned costs that autograd cannot differentiate with respect to x; "
                "leave out detach and no_grad, or return (cost, gradient) with with_gradient=True"
            )
    return cost.detach(), gradient


def _given(objective: Objective, x: Tensor) -> tuple[Tensor, Tensor]:
    """Compute cost and gradient by an objective that returns both."""
    answer = objective(x)
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise TypeError(
            "with_gradient=True needs an objective that returns the pair (cost, gradient), got "
            f"{type(answer).__name__}; return the pair or leave with_gradient out"
        )
    cost, gradient = answer
    check_cost(cost, x)
    if not isinstance(gradient, Tensor) or gradient.shape != x.shape:
        raise ValueError(
            f"the objective returned {described(gradient)} as gradient for x of shape "
            f"{tuple(x.shape)}; return a gradient of the same shape as x"
        )
    return cost.detach(), gradient.detach().to(x.dtype)


def _where(mask: Tensor, yes: Any, no: Any) -> Any:
    """Apply torch.where to all tensors (...,) and (..., n) of named tuples, with a mask (...,)."""
    if isinstance(yes, Tensor):
        return torch.where(mask[..., None] if yes.ndim > mask.ndim else mask, yes, no)
    return type(yes)(*(_where(mask, a, b) for a, b in zip(yes, no, strict=True)))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of two vectors of each trial."""
    return (a * b).sum(-1)


def check_start(start: Tensor) -> None:
    """Check that the first point of a search is a real tensor of shape (..., n) for n unknowns.

    Args:
        start: First point of the search.

    Raises:
        TypeError: If `start` is neither float32 nor float64.
        ValueError: If `start` has no dimension, or its last dimension, the unknowns, is empty.
    """
    if start.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"start must be a tensor of float32 or float64, got {start.dtype}; give complex unknowns "
            "as their real and imaginary parts"
        )
    if start.ndim == 0 or start.shape[-1] == 0:
        raise ValueError(
            "start must have the shape (..., n), with n >= 1 unknowns in the last dimension, got "
            f"shape {tuple(start.shape)}"
        )


def check_limits(method: str, **limits: float) -> None:
    """Check that limits such as the number of steps are positive.

    Args:
        method: Name of the optimiser, for the message.
        **limits: Values by the names of their parameters.

    Raises:
        ValueError: If a value is not positive.
    """
    for name, value in limits.items():
        if not value > 0:
            raise ValueError(f"{method}: {name} is {value}; choose a positive number")


def check_tolerances(method: str, gradient_tolerance: float, value_tolerance: float) -> None:
    """Check that both relative tolerances are at least 0.

    Args:
        method: Name of the optimiser, for the message.
        gradient_tolerance: Relative tolerance of the gradient norm.
        value_tolerance: Relative tolerance of the cost.

    Raises:
        ValueError: If a tolerance is negative or not a number.
    """
    if not (gradient_tolerance >= 0 and value_tolerance >= 0):
        raise ValueError(
            f"{method}: gradient_tolerance and value_tolerance must be relative tolerances of at least 0, "
            f"such as 1e-6, got {gradient_tolerance} and {value_tolerance}"
        )


def check_cost(cost: Any, x: Tensor) -> None:
    """Check that an objective returned one real cost per trial.

    Args:
        cost: Value that the objective returned.
        x: Point at which it was called, shape (..., n).

    Raises:
        ValueError: If the cost is not a real tensor of shape (...,).
    """
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        raise ValueError(
            f"the objective returned {described(cost)} for x of shape {tuple(x.shape)}; return one "
            f"real cost per trial, shape {tuple(x.shape[:-1])}"
        )


def described(value: Any) -> str:
    """Describe a value for messages: dtype and shape of a tensor, or the type of another value.

    Args:
        value: Any value.

    Returns:
        A few words for a message.
    """
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__


def norm(x: Tensor) -> Tensor:
    """Compute the Euclidean norm of each trial over its unknowns.

    Args:
        x: Values, shape (..., n).

    Returns:
        Norms, shape (...,).
    """
    return torch.linalg.vector_norm(x, dim=-1)
