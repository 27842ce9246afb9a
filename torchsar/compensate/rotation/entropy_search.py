"""Search for the rotation of a target with which the image entropy is least.

The methods are grid search, a genetic algorithm, differential evolution, Newton's method and
L-BFGS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchsar.compensate.rotation.assess import judged_motion
from torchsar.compensate.rotation.image_entropy import (
    EntropyObjective,
    ImageEntropy,
    k_name,
    uniform_rotation,
    values_of,
)
from torchsar.compensate.rotation.motion import Motion, each
from torchsar.core import Draws, Estimate, Outcome, Signal, Stage, differentiable, worst
from torchsar.core.derivatives import without_derivatives
from torchsar.optim import differential_evolution, genetic, grid_search, implicit, lbfgs, newton
from torchsar.radar import InverseRadar

Vector = Sequence[float] | Tensor
Method = Literal["grid", "genetic", "evolution", "newton", "descent"]
# options of the stage that each method takes
_OPTIONS: dict[str, tuple[str, ...]] = {
    "grid": ("low", "high", "counts"),
    "genetic": ("low", "high", "population", "generations", "seed"),
    "evolution": ("low", "high", "population", "generations", "seed"),
    "newton": ("start", "damped", "steps"),
    "descent": ("start", "steps"),
}


@differentiable("where ok")
def entropy_rotation(
    figure: ImageEntropy, method: Method, where: Sequence[Vector] | Tensor, *, assess: bool = True, **options: Any
) -> Estimate:
    """Find the rotation of least image entropy by one of five methods.

    >>> import torch
    >>> from torchsar.compensate import EntropyObjective, ImageEntropy, entropy_rotation
    >>> points = torch.zeros(64, 4, dtype=torch.complex64)
    >>> points[:, 1], points[:, 2] = 1, 1j  # on the axis of rotation
    >>> range_m = torch.arange(4, dtype=torch.float64)
    >>> objective = EntropyObjective(order=2, range_term=False)
    >>> figure = ImageEntropy(points, objective, wavelength_m=1e-6, prf_hz=1e3, range_m=range_m)
    >>> found = entropy_rotation(figure, "grid", [[-1.0, 0.0, 1.0]], assess=False)
    >>> found["k1_per_s"].shape, found.info["entropy_grid_nats"].shape
    (torch.Size([]), torch.Size([3]))

    - "grid" evaluates all points of a grid. That of Remote Sens. 2025, 17, 3447 has 5 x 21 x 201.
    - "genetic" is the published estimator, a genetic algorithm in a box.
    - "evolution" is differential evolution in a box.
    - "newton" is Newton's method, which Remote Sens. 2025, 17, 3447 calls Gauss-Newton. Table 2 of
      that paper shows that the result depends on the start. Undamped steps diverge on most targets,
      even from the true rotation, because the entropy is nearly flat in one direction.
    - "descent" is L-BFGS with exact gradients. It converges best if `variables` of the
      `EntropyObjective` is "shape", see `Unknowns`. With a rotation angle of order 2 and without
      compensation of the range-dependent phase, this is the second-order method (SM) of Remote
      Sens. 2025, 17, 3447. If the angle of the target is of order 3, SM finds about k1 + k2 T / 2
      instead of k1, with the length T of the aperture.

    The last two have derivatives, the others none.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        method: The method.
        where: What the method is given: for "grid" the values of each unknown
            (`figure.unknowns.names`), shape (m,), or (..., m) per trial; for "genetic" and
            "evolution" the lower and the upper bounds, one per unknown, shape (n,) or (..., n)
            each; for "newton" and "descent" the unknowns to start from, shape (..., n), see
            `figure.start`. A start at which the rotation stops or reverses is replaced by zeros.
        assess: False leaves out the assessment.
        options: Options of the functions `grid_search`, `genetic`, `differential_evolution`,
            `newton` and `lbfgs` of `torchsar.optim`, of which "genetic" and "evolution" need
            `draws`, the source of random numbers. By default Newton's method makes 20 damped
            steps, and L-BFGS 60 steps, until the norm of the gradient is 1e-4 of that at the start.

    Returns:
        `warp_k`, the relative derivatives k1 (1/s), k2 (1/s^2), ... of the rotation rate at the
        first pulse, shape (..., order - 1), and each of them as `k1_per_s`, `k2_per_s2`, ..., shape
        (...,). If `figure` compensates the range-dependent phase, also `omega_rad_s`, the rotation
        rate at the first pulse, and `yc_m`, the range centre deviation yc, shape (...,) each. A
        cell at range y lies at y + yc from the rotation centre. The data do not show the sign of
        the rotation rate, so `omega_rad_s` is positive and the image may be mirrored in cross
        range. There are no standard deviations, because an entropy is not a likelihood.

        quality is the relative decrease of exp(entropy), the number of cells that the image fills,
        due to the compensation. Outcomes: those of `coarse_rotation`; OUTSIDE_SEARCH if the minimum
        lies on the edge of the grid or box; and NOT_CONVERGED, where Newton's method diverges (the
        result is then its last finite point), or a descent has not converged after its steps. They
        do not refer to `omega_rad_s` and `yc_m`: with few image lines these are biased, see
        `EntropyObjective`. Below third order PARTS_DISAGREE includes what a rotation of third order
        would correct.

        info holds `evaluations`; entropy_nats and uncompensated_entropy_nats, the entropy with and
        without compensation; on a grid or in a box on_edge, shape (..., n), True for unknowns on
        the edge; entropy_grid_nats, shape (..., m_1, m_2, ...), the entropy on the grid;
        best_entropy_nats, shape (..., generations + 1), the least entropy up to each generation;
        and of a descent `iterations` and `converged`.

    Raises:
        ValueError: If the method is none of these, there is not one list of values, one bound or
            one start value per unknown, `draws` is missing, or an option is invalid.

    Reference:
        Remote Sens. 2025, 17, 3447, section 3.3 and Table 2.
    """
    if method not in get_args(Method):
        raise ValueError(f"entropy_rotation: method must be one of {', '.join(get_args(Method))}, got {method!r}")
    if method in ("newton", "descent"):
        return _from_start(figure, method, where, assess, **options)
    with without_derivatives(f"entropy_rotation with method {method!r}", figure):
        return _searched(figure, method, where, assess, **options)


def _searched(
    figure: ImageEntropy, method: Method, where: Sequence[Vector] | Tensor, assess: bool, **options: Any
) -> Estimate:
    """Estimate on a grid or in a box."""
    names = figure.unknowns.names
    try:
        axes = [torch.as_tensor(part, dtype=torch.float64, device=figure.range_m.device) for part in where]
    except (TypeError, ValueError, RuntimeError):
        axes = []
    if len(axes) != (len(names) if method == "grid" else 2) or not all(axis.ndim for axis in axes):
        form = "a list of values for each" if method == "grid" else "two lists, the lower and the upper bounds,"
        raise ValueError(
            f"entropy_rotation: where must hold {form} of the {len(names)} unknowns {', '.join(names)} for method "
            f"{method!r}, got {where!r:.200}"
        )
    if method == "grid":
        found = grid_search(figure, axes, trials=figure.trials, **options)
        low, high = (
            torch.stack([end(axis, -1).expand(figure.trials) for axis in axes], -1) for end in (torch.amin, torch.amax)
        )
    else:
        low, high = (
            figure.spread(figure.unknowns.vector(x, what)) for x, what in zip(axes, ("low", "high"), strict=True)
        )
        if not isinstance(options.get("draws"), Draws):
            raise ValueError(f"entropy_rotation: method {method!r} needs random numbers; give draws=Draws(seed)")
        found = (genetic if method == "genetic" else differential_evolution)(figure, low, high, **options)
    width = high - low
    # a minimum this close to the edge is assumed to lie outside the search region, a convention
    edge = (torch.minimum(found.x - low, high - found.x) <= 1e-3 * width) & (width > 0)
    doubts = worst((Outcome.NOT_CONVERGED, ~found.ok), (Outcome.OUTSIDE_SEARCH, edge.any(-1)))
    history = "entropy_grid_nats" if method == "grid" else "best_entropy_nats"
    info = {history: found.history, "evaluations": found.evaluations, "on_edge": edge}
    return _estimate(figure, found.x, found.cost, doubts, info, assess)


def _from_start(figure: ImageEntropy, method: Method, start: Any, assess: bool, **options: Any) -> Estimate:
    """Estimate by Newton's method or L-BFGS, with unknowns scaled to about one.

    A start at which the rotation stops or reverses is replaced by uniform rotation.
    """
    x = figure.spread(figure.unknowns.vector(start, "start").detach())
    x = torch.where(figure.turn(x).feasible[..., None], x, 0)
    unit = figure.units(x)

    def with_gradient(z: Tensor) -> tuple[Tensor, Tensor]:
        cost, gradient = figure.with_gradient(z * unit)
        return cost, gradient * unit

    if method == "newton":
        options = {"steps": 20, **options}
        found = newton(lambda z: figure.single(z * unit), x / unit, **options)
        finite = found.ok
    else:
        # The first step is 0.3 in units that change phases by about a radian. The value tolerance
        # is near the rounding of the entropy.
        rounding = 1e-8 if figure.dtype == torch.complex64 else 1e-9
        known = {"first_step": 0.3, "gradient_tolerance": 1e-4, "value_tolerance": rounding, "with_gradient": True}
        options = {"steps": 60, **known, **options}
        found = lbfgs(with_gradient, x / unit, **options)
        # the outcome of the optimiser also reports infeasible candidates on its path
        finite = torch.isfinite(found.cost)
    doubts = Outcome.of(finite & (found.converged | (found.steps < options["steps"])), Outcome.NOT_CONVERGED)
    info = {"evaluations": found.evaluations, "iterations": found.steps, "converged": found.converged}
    z = implicit(lambda z, *data: figure.single(z * unit), found.x, figure)
    return _estimate(figure, z * unit, found.cost, doubts, info, assess)


def _estimate(
    figure: ImageEntropy, x: Tensor, cost: Tensor, doubts: Tensor, info: dict[str, Tensor], assess: bool
) -> Estimate:
    """Make the estimate from the best vectors, their entropies and the doubts of the search."""
    rotation, cost = figure.turn(x), cost.detach()
    value = values_of(rotation.omega_rad_s.abs(), rotation.warp_k, rotation.yc_m)
    if not figure.unknowns.range_term:
        value = {name: value[name] for name in value if name not in ("omega_rad_s", "yc_m")}
    info = {**info, "entropy_nats": cost}
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(cost), info=info)
    before = figure.uncompensated()
    cost = torch.where(torch.isfinite(cost), cost, before)
    w = rotation.omega_rad_s.square().reshape(-1)
    k = rotation.warp_k.reshape(len(w), -1)
    motion = Motion(k, w, w * rotation.yc_m.reshape(-1), torch.zeros_like(w))
    with torch.no_grad():
        parts = [
            judged_motion(figure.rows[i], figure.sampling, each(lambda x, i=i: x[i], motion), {})
            for i in figure.blocks(len(w))
        ]
    outcome = torch.maximum(torch.cat([part.outcome for part in parts]).reshape(figure.trials), doubts)
    outcome = torch.maximum(outcome, Outcome.of(rotation.feasible, Outcome.NOT_CONVERGED))
    error = torch.cat([part.info["phase_error_rad"] for part in parts]).reshape(figure.trials)
    info |= {"entropy_nats": cost, "uncompensated_entropy_nats": before, "phase_error_rad": error}
    return Estimate(value, quality=(1 - torch.exp(cost - before)).clamp(0, 1), outcome=outcome, info=info)


class EntropyRotation(Stage):
    """Rotation of least image entropy by one of five methods; see `entropy_rotation`.

    With the default settings the unknowns are the rotation rate omega at the first pulse (rad/s)
    and its relative derivatives k1 (1/s) and k2 (1/s^2). Other settings change their number and
    meaning, see `Unknowns`. All trials use the same random numbers. Along unknown i a grid has
    counts[i] equally spaced values from low[i] to high[i].

    "newton" and "descent" start from the values `omega_rad_s` and `warp_k` that other stages
    provide. A value that no stage provides is taken from `start`. Without `start` the rotation rate
    is `rotation_rad_s` of the radar. A range centre deviation `yc_m` that another stage provides
    replaces that of the settings. If they make it an unknown, these methods start from that of the
    stage, or from 0.

    Args:
        radar: Radar parameters.
        method: "grid", "genetic", "evolution", "newton" or "descent". With order 2 and without
            compensation of the range-dependent phase, "descent" is the second-order method (SM) of
            Remote Sens. 2025, 17, 3447.
        low: Lowest value of each unknown, for a grid or a box.
        high: Highest value of each unknown.
        counts: Number of values of each unknown, for a grid.
        objective: Settings of the entropy; by default a gridding kernel of six taps for "newton",
            which needs second derivatives, and the variables "shape" for "descent".
        start: Values to start from, [omega (rad/s), k1 (1/s), k2 (1/s^2), ...]. Leave omega out if
            `objective` does not compensate the range-dependent phase. None if other stages provide
            the values.
        population: Number of candidates in a generation, by default 30, or 24 for "evolution".
        generations: Number of generations, by default 30, or 36 for "evolution".
        seed: Seed of the random numbers, by default 1.
        damped: False leaves the steps of Newton's method undamped.
        steps: Largest number of steps, by default 20 for "newton" and 60 for "descent".
        assess: False leaves out the assessment.

    Raises:
        ValueError: If the method is none of these, an option is missing or belongs to another
            method, or the lists have the wrong number of values.
    """

    differentiable = "where ok"

    def __init__(
        self,
        radar: InverseRadar,
        method: Method,
        low: list[float] | None = None,
        high: list[float] | None = None,
        counts: list[int] | None = None,
        objective: EntropyObjective | None = None,
        start: list[float] | None = None,
        population: int | None = None,
        generations: int | None = None,
        seed: int | None = None,
        damped: bool | None = None,
        steps: int | None = None,
        assess: bool = True,
    ) -> None:
        super().__init__()
        given: dict[str, Any] = {
            "low": low,
            "high": high,
            "counts": counts,
            "start": start,
            "population": population,
            "generations": generations,
            "seed": seed,
            "damped": damped,
            "steps": steps,
        }
        given = {name: value for name, value in given.items() if value is not None}
        if method not in tuple(_OPTIONS):
            raise ValueError(f"EntropyRotation: method must be one of {', '.join(_OPTIONS)}, got {method!r}")
        takes = _OPTIONS[method]
        missing = [name for name in takes if name in ("low", "high", "counts") and name not in given]
        faults = {"needs": missing, "does not take": [name for name in given if name not in takes]}
        if any(faults.values()):
            said = " and ".join(f"{verb} {', '.join(some)}" for verb, some in faults.items() if some)
            raise ValueError(f"EntropyRotation: method {method!r} {said}; its options are {', '.join(takes)}")
        if objective is None:
            objective = EntropyObjective(
                taps=6 if method == "newton" else 4, variables="shape" if method == "descent" else "raw"
            )
        self.radar, self.objective = radar, objective
        self.method: Method = method
        self.differentiable = "where ok" if "start" in takes else "no"
        ends = [given.pop(name) for name in ("low", "high", "counts") if name in given]
        if counts is not None:
            if len({len(end) for end in ends}) > 1 or min(counts, default=0) < 1:
                raise ValueError(
                    "low, high and counts must hold one entry per unknown, with counts of 1 or more, got "
                    f"low {low}, high {high} and counts {counts}"
                )
            ends = [torch.linspace(a, b, n, dtype=torch.float64) for a, b, n in zip(*ends, strict=True)]
        self.where = ends
        begin, rate = given.pop("start", None), objective.range_term
        self.names = (*(("omega",) if rate else ()), "k1, k2, ...")
        if begin is not None and len(begin) != objective.order - 1 + rate:
            raise ValueError(
                f"start must hold the {objective.order - 1 + rate} values {', '.join(self.names)}, got {begin}"
            )
        self.rate, k = radar.rotation_rad_s if rate else 0.0, [] if objective.order == 1 else None
        if begin is not None:
            self.rate, k = (begin[0], begin[1:]) if rate else (0.0, begin)
        self.k = None if k is None else torch.tensor(k, dtype=torch.float64)
        if "seed" in takes:
            population, generations = (30, 30) if method == "genetic" else (24, 36)
            draws = Draws(given.pop("seed", 1))
            given = {"population": population, "generations": generations, "draws": draws, **given}
        self.options = {"assess": assess, **given}
        self.provides = (
            "warp_k",
            *(k_name(i) for i in range(1, objective.order)),
            *(("omega_rad_s", "yc_m") if rate else ()),
        )
        self.neutral = uniform_rotation(radar, self.provides, objective.yc_m)

    def forward(
        self,
        signal: Signal,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the rotation from a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            omega_rad_s: Rotation rate in rad/s to start from, shape (...,); None takes that of the
                stage or of the radar.
            warp_k: Relative derivatives k1, k2, ... of the rotation rate to start from, in 1/s,
                1/s^2, ..., shape (..., order - 1); None takes those of the stage.
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), known a priori, shape (...,); None takes that of the settings.

        Returns:
            The `Estimate` of `entropy_rotation`.

        Raises:
            ValueError: If there is no rotation rate or no `warp_k` to start from, or the method
                takes no start.
        """
        known = self.objective.yc_m if yc_m is None or self.objective.yc_m is None else yc_m
        figure = ImageEntropy.of(signal, self.radar, replace(self.objective, yc_m=known))
        if self.where:
            if omega_rad_s is not None or warp_k is not None:
                raise ValueError(
                    f"EntropyRotation: method {self.method!r} takes no omega_rad_s or warp_k to start from"
                )
            return entropy_rotation(figure, self.method, self.where, **self.options)
        omega, k = self.rate if omega_rad_s is None else omega_rad_s, self.k if warp_k is None else warp_k
        if omega is None or k is None:
            raise ValueError(
                f"EntropyRotation needs a rotation to start from: give start=[{', '.join(self.names)}], or "
                f"connect {'omega_rad_s and ' if self.objective.range_term else ''}warp_k from an earlier estimator"
            )
        return entropy_rotation(figure, self.method, figure.start(omega, k, yc_m), **self.options)
