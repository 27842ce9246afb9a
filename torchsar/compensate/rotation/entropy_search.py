"""Searches for the rotation of a target with which the image entropy is least.

The methods are grid search, a genetic algorithm, differential evolution, Newton's method and
L-BFGS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

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
from torchsar.core import Draws, Estimate, Outcome, Signal, Stage, worst
from torchsar.optim import Descent, Searched, differential_evolution, genetic, grid_search, lbfgs, newton
from torchsar.radar import InverseRadar

Vector = Sequence[float] | Tensor

# what the stages minimise by default: the published unknowns; a more accurate transform for
# Newton's method, which needs second derivatives; unknowns with uncorrelated errors for a descent
_PUBLISHED, _FOR_NEWTON, _FOR_DESCENT = (
    EntropyObjective(),
    EntropyObjective(taps=6),
    EntropyObjective(variables="shape"),
)


def search_rotation(
    figure: ImageEntropy, axes: Sequence[Vector], *, limit: int = 100_000, assess: bool = True
) -> Estimate:
    """Find the rotation of least image entropy on a full grid.

    The grid of Remote Sens. 2025, 17, 3447 has 5 x 21 x 201 points.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        axes: Values of each unknown, shape (m,), or (..., m) per trial.
        limit: Largest number of grid points per trial.
        assess: False leaves out the assessment.

    Returns:
        `warp_k`, the relative derivatives of the rotation rate. If `figure` compensates the
        range-dependent phase, also `omega_rad_s`, the rotation rate at the first pulse, and `yc_m`,
        the range centre deviation. `genetic_rotation` describes these values and quality in full.
        The outcome is OUTSIDE_SEARCH where the best point lies on the edge of the grid.
        info["entropy_grid_nats"], shape (..., m_1, m_2, ...), is the entropy on the grid.

    Raises:
        ValueError: If there is not one list of values per unknown, or the grid exceeds the limit.
    """
    names = figure.unknowns.names
    if len(axes) != len(names):
        raise ValueError(
            f"search_rotation: axes must hold a list of values for each of the {len(names)} unknowns "
            f"{', '.join(names)}, got {len(axes)} lists"
        )
    values = [torch.as_tensor(axis, dtype=torch.float64, device=figure.range_m.device) for axis in axes]
    found = grid_search(figure, values, trials=figure.trials, limit=limit)
    ends = [(axis.amin(-1).expand(figure.trials), axis.amax(-1).expand(figure.trials)) for axis in values]
    low, high = (torch.stack(list(bounds), -1) for bounds in zip(*ends, strict=True))
    return _of_box(figure, found, low, high, assess, entropy_grid_nats=found.history)


def genetic_rotation(
    figure: ImageEntropy, low: Vector, high: Vector, *, draws: Draws, assess: bool = True, **options: Any
) -> Estimate:
    """Find the rotation of least image entropy in a box by a genetic algorithm.

    This is the published estimator, see Reference.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        low: Lower bounds, one per unknown (`figure.unknowns.names`), shape (n,) or (..., n).
        high: Upper bounds, same shape.
        draws: Source of random numbers, see `torchsar.optim.genetic`.
        assess: False leaves out the assessment.
        options: Options of `torchsar.optim.genetic`.

    Returns:
        `warp_k`, the relative derivatives k1 (1/s), k2 (1/s^2), ... of the rotation rate at the
        first pulse, shape (..., order - 1), and each of them as `k1_per_s`, `k2_per_s2`, ..., shape
        (...,). If `figure` compensates the range-dependent phase, also `omega_rad_s`, the rotation
        rate at the first pulse, and `yc_m`, the range centre deviation yc, shape (...,) each. A
        cell at range y lies at y + yc from the rotation centre. The data do not show the sign of
        the rotation rate, so `omega_rad_s` is positive and the image may be mirrored in cross
        range. There are no standard deviations, because an entropy is not a likelihood.

        quality is the relative decrease of exp(entropy), the number of cells that the image fills,
        due to the compensation. Outcomes: those of `coarse_rotation`, OUTSIDE_SEARCH if the minimum
        lies on the edge of the box, and NOT_CONVERGED. They do not refer to `omega_rad_s` and
        `yc_m`: with few image lines these are biased, see `EntropyObjective`. Below third order
        PARTS_DISAGREE includes what a rotation of third order would correct.

        info holds the number of evaluations; entropy_nats and uncompensated_entropy_nats, the
        entropy with and without compensation; on_edge, shape (..., n), True for unknowns on the
        edge of the box; and best_entropy_nats, shape (..., generations + 1), the least entropy up
        to each generation.

    Raises:
        ValueError: If there is not one bound per unknown, or an option is invalid.

    Reference:
        Remote Sens. 2025, 17, 3447, section 3.3.
    """
    return _in_box(figure, genetic, low, high, assess, draws=draws, **options)


def evolve_rotation(
    figure: ImageEntropy, low: Vector, high: Vector, *, draws: Draws, assess: bool = True, **options: Any
) -> Estimate:
    """Find the rotation of least image entropy in a box by differential evolution.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        low: Lower bounds, one per unknown, shape (n,) or (..., n).
        high: Upper bounds, same shape.
        draws: Source of random numbers, see `torchsar.optim.differential_evolution`.
        assess: False leaves out the assessment.
        options: Options of `torchsar.optim.differential_evolution`.

    Returns:
        `warp_k`, the relative derivatives of the rotation rate. If `figure` compensates the
        range-dependent phase, also `omega_rad_s`, the rotation rate at the first pulse, and `yc_m`,
        the range centre deviation. `genetic_rotation` describes these values, quality,
        outcomes and info in full.

    Raises:
        ValueError: If there is not one bound per unknown, or an option is invalid.
    """
    return _in_box(figure, differential_evolution, low, high, assess, draws=draws, **options)


def newton_rotation(
    figure: ImageEntropy, start: Tensor, *, damped: bool = True, steps: int = 20, assess: bool = True
) -> Estimate:
    """Find a rotation of least image entropy near a start by Newton's method.

    Remote Sens. 2025, 17, 3447 calls this method Gauss-Newton. Table 2 of that paper shows that the
    result depends on the start.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        start: Unknowns to start from, shape (..., n), see `figure.start`. A start at which the
            rotation stops or reverses is replaced by zeros.
        damped: True damps the steps. Undamped steps diverge on most targets, even from the true
            rotation, because the entropy is nearly flat in one direction.
        steps: Largest number of steps.
        assess: False leaves out the assessment.

    Returns:
        `warp_k`, the relative derivatives of the rotation rate. If `figure` compensates the
        range-dependent phase, also `omega_rad_s`, the rotation rate at the first pulse, and `yc_m`,
        the range centre deviation. `genetic_rotation` describes these values and quality in full.
        The outcome is NOT_CONVERGED where the search diverges (the result is then its last finite
        point) or has not converged after `steps` steps. info["iterations"] is the number of steps.

    Raises:
        ValueError: If the start does not have one value per unknown.

    Reference:
        Remote Sens. 2025, 17, 3447, Table 2.
    """
    x, unit = _scaled(figure, start)
    found = newton(lambda z: figure.single(z * unit), x, damped=damped, steps=steps)
    return _of_descent(figure, found, unit, found.ok, steps, assess)


def descend_rotation(
    figure: ImageEntropy, start: Tensor, *, steps: int = 60, tolerance: float = 1e-4, assess: bool = True
) -> Estimate:
    """Find a rotation of least image entropy near a start by L-BFGS with exact gradients.

    The search converges best if `variables` of the `EntropyObjective` is "shape", see `Unknowns`.

    With a rotation angle of order 2 and without compensation of the range-dependent phase, this is
    the second-order method (SM) of Remote Sens. 2025, 17, 3447. If the angle of the target is of
    order 3, SM finds about k1 + k2 T / 2 instead of k1. Here k1 and k2 are the relative derivatives
    of the rotation rate, and T is the length of the aperture.

    Args:
        figure: Image entropy as a function of the unknowns of the rotation.
        start: Unknowns to start from, shape (..., n), see `figure.start`. A start at which the
            rotation stops or reverses is replaced by zeros.
        steps: Largest number of steps.
        tolerance: A trial ends when the norm of its gradient is at most this fraction of that at
            the start.
        assess: False leaves out the assessment.

    Returns:
        `warp_k`, the relative derivatives of the rotation rate. If `figure` compensates the
        range-dependent phase, also `omega_rad_s`, the rotation rate at the first pulse, and `yc_m`,
        the range centre deviation. `genetic_rotation` describes these values and quality in full.
        The outcome is NOT_CONVERGED where a trial has not converged after `steps` steps.

    Raises:
        ValueError: If the start does not have one value per unknown.
    """
    x, unit = _scaled(figure, start)

    def with_gradient(z: Tensor) -> tuple[Tensor, Tensor]:
        cost, gradient = figure.with_gradient(z * unit)
        return cost, gradient * unit

    found = lbfgs(
        with_gradient,
        x,
        steps=steps,
        first_step=0.3,  # in units of the unknowns, of about a radian each
        gradient_tolerance=tolerance,
        value_tolerance=1e-8 if figure.dtype == torch.complex64 else 1e-9,  # near the rounding of the entropy
        with_gradient=True,
    )
    # its own verdict also reports infeasible candidates on its path
    return _of_descent(figure, found, unit, torch.isfinite(found.cost), steps, assess)


def descent_near_truth(
    data: Tensor,
    omega_rad_s: Tensor,
    warp_k: Tensor,
    *,
    order: int,
    yc_m: float | None,
    assess: bool = True,
    **known: Any,
) -> Estimate:
    """Estimate a rotation by a descent of the image entropy that starts at 0.95 of the true values.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range).
        omega_rad_s: True rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: True derivatives k1, k2, ... of the rotation rate at the first pulse, divided by
            that rate, in 1/s, 1/s^2, ..., shape (..., coefficient).
        order: As in `uneven_rotation`.
        yc_m: Range centre deviation in metres; None is 0.
        assess: False leaves out the assessment.
        known: The arguments wavelength_m, prf_hz and range_m of `uneven_rotation`.

    Returns:
        The `Estimate` that the function `descend_rotation` returns.
    """
    objective = ImageEntropy(data, EntropyObjective(order=order, yc_m=yc_m or 0.0, variables="shape"), **known)
    return descend_rotation(objective, objective.start(0.95 * omega_rad_s, 0.95 * warp_k, None), assess=assess)


def genetic_near_truth(
    data: Tensor,
    omega_rad_s: Tensor,
    warp_k: Tensor,
    *,
    order: int,
    yc_m: float | None,
    assess: bool = True,
    **known: Any,
) -> Estimate:
    """Estimate a rotation by a genetic algorithm that searches within 10 % of the true values.

    The image entropy is minimised with 10 individuals in 4 generations.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range).
        omega_rad_s: True rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: True derivatives k1, k2, ... of the rotation rate at the first pulse, divided by
            that rate, in 1/s, 1/s^2, ..., shape (..., coefficient).
        order: As in `uneven_rotation`.
        yc_m: Range centre deviation in metres; None is 0.
        assess: False leaves out the assessment.
        known: The arguments wavelength_m, prf_hz and range_m of `uneven_rotation`.

    Returns:
        The `Estimate` that the function `genetic_rotation` returns.
    """
    objective = ImageEntropy(data, EntropyObjective(order=order, yc_m=yc_m or 0.0, variables="raw"), **known)
    centre = torch.cat([omega_rad_s[..., None], warp_k], -1)
    box = 0.1 * torch.where(centre != 0, centre.abs(), 1)
    size = {"population": 10, "generations": 4}  # short enough to compare
    return genetic_rotation(objective, centre - box, centre + box, draws=Draws(1), assess=assess, **size)


def _scaled(figure: ImageEntropy, start: Tensor) -> tuple[Tensor, Tensor]:
    """A start (..., n) in units that make the unknowns about one, and these units.

    Uniform rotation takes the place of a rotation that stops or reverses.
    """
    x = figure.spread(figure.unknowns.vector(start, "start").detach())
    x = torch.where(figure.turn(x).feasible[..., None], x, 0)
    unit = figure.units(x)
    return x / unit, unit


def _in_box(
    figure: ImageEntropy, search: Callable[..., Searched], low: Vector, high: Vector, assess: bool, **options: Any
) -> Estimate:
    """Estimate from a search with options between two vectors of bounds."""
    low, high = (figure.spread(figure.unknowns.vector(bound, what)) for bound, what in ((low, "low"), (high, "high")))
    found = search(figure, low, high, **options)
    return _of_box(figure, found, low, high, assess, best_entropy_nats=found.history)


def _of_box(figure: ImageEntropy, found: Searched, low: Tensor, high: Tensor, assess: bool, **info: Tensor) -> Estimate:
    """Estimate from a search in a box."""
    width = high - low
    # a minimum so near the edge is taken to lie outside, a convention
    edge = (torch.minimum(found.x - low, high - found.x) <= 1e-3 * width) & (width > 0)
    doubts = worst((Outcome.NOT_CONVERGED, ~found.ok), (Outcome.OUTSIDE_SEARCH, edge.any(-1)))
    info |= {"evaluations": found.evaluations, "on_edge": edge}
    return _estimate(figure, found.x, found.cost, doubts, info, assess)


def _of_descent(
    figure: ImageEntropy, found: Descent, unit: Tensor, finite: Tensor, steps: int, assess: bool
) -> Estimate:
    """Estimate from a descent."""
    doubts = Outcome.of(finite & (found.converged | (found.steps < steps)), Outcome.NOT_CONVERGED)
    info = {"evaluations": found.evaluations, "iterations": found.steps, "converged": found.converged}
    return _estimate(figure, found.x * unit, found.cost, doubts, info, assess)


def _estimate(
    figure: ImageEntropy, x: Tensor, cost: Tensor, doubts: Tensor, info: dict[str, Tensor], assess: bool
) -> Estimate:
    """Estimate from the best vectors, their entropies and the doubts of the search."""
    rotation, cost = figure.turn(x.detach()), cost.detach()
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


class _Search(Stage):
    """A search for the rotation that minimises an image entropy, by one of the functions above."""

    def __init__(
        self, radar: InverseRadar, objective: EntropyObjective, find: Callable[..., Estimate], **options: Any
    ) -> None:
        super().__init__()
        self.radar, self.objective, self.find, self.options = radar, objective, find, options
        self.provides = (
            "warp_k",
            *(k_name(i) for i in range(1, objective.order)),
            *(("omega_rad_s", "yc_m") if objective.range_term else ()),
        )
        self.neutral = uniform_rotation(radar, self.provides, objective.yc_m)

    def figure(self, signal: Signal, yc_m: Tensor | None) -> ImageEntropy:
        """Build the image entropy of a signal as a function of the unknowns of the rotation.

        Args:
            signal: Range-compressed pulses of axes (pulse, range).
            yc_m: Known range centre deviation in metres, shape (...,); None takes that of the
                settings. It is ignored if the settings make yc an unknown.

        Returns:
            The entropy function.
        """
        known = self.objective.yc_m if yc_m is None or self.objective.yc_m is None else yc_m
        return ImageEntropy.of(signal, self.radar, replace(self.objective, yc_m=known))

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        """Estimate the rotation from a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), known a priori, shape (...,).

        Returns:
            The `Estimate` of the function that the description of the stage names.
        """
        return self.find(self.figure(signal, yc_m), **self.options)


class RotationSearch(_Search):
    """Rotation of least image entropy on a grid; see `search_rotation`.

    Along unknown i the grid has counts[i] equally spaced values from low[i] to high[i]. With the
    default settings the unknowns are the rotation rate omega at the first pulse (rad/s) and its
    relative derivatives k1 (1/s) and k2 (1/s^2). Other settings change their number and meaning,
    see `Unknowns`.

    Args:
        radar: Radar parameters.
        low: Lowest value of each unknown: by default omega (rad/s), k1 (1/s) and k2 (1/s^2).
        high: Highest value of each unknown.
        counts: Number of values of each unknown.
        objective: Settings of the entropy. If another stage provides `yc_m` (range centre
            deviation), this value replaces that of the settings, unless the settings make it an
            unknown.
        limit: Largest number of grid points per trial.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If low, high and counts differ in length, or a count is below 1.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        counts: list[int],
        objective: EntropyObjective = _PUBLISHED,
        limit: int = 100_000,
        assess: bool = True,
    ) -> None:
        if not len(low) == len(high) == len(counts) or any(count < 1 for count in counts):
            raise ValueError(
                "low, high and counts must hold one entry per unknown, with counts of 1 or more, got "
                f"low {list(low)}, high {list(high)} and counts {list(counts)}"
            )
        axes = [torch.linspace(a, b, n, dtype=torch.float64) for a, b, n in zip(low, high, counts, strict=True)]
        super().__init__(radar, objective, search_rotation, axes=axes, limit=limit, assess=assess)


class RotationGenetic(_Search):
    """Rotation of least image entropy in a box by a genetic algorithm; see `genetic_rotation`.

    All trials use the same random numbers. With the default settings the unknowns are the rotation
    rate omega at the first pulse (rad/s) and its relative derivatives k1 (1/s) and k2 (1/s^2).
    Other settings change their number and meaning, see `Unknowns`.

    Args:
        radar: Radar parameters.
        low: Lower bound of each unknown: by default omega (rad/s), k1 (1/s) and k2 (1/s^2).
        high: Upper bound of each unknown.
        objective: Settings of the entropy. If another stage provides `yc_m` (range centre
            deviation), this value replaces that of the settings, unless the settings make it an
            unknown.
        population: Number of candidates in a generation.
        generations: Number of generations.
        elites: Number of best candidates that pass unchanged to the next generation.
        selection: Selection of parents, "tournament" or "roulette".
        seed: Seed of the random numbers.
        assess: False leaves out the assessment.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        objective: EntropyObjective = _PUBLISHED,
        population: int = 30,
        generations: int = 30,
        elites: int = 2,
        selection: Literal["tournament", "roulette"] = "tournament",
        seed: int = 1,
        assess: bool = True,
    ) -> None:
        size = {"population": population, "generations": generations, "elites": elites}
        box = {"low": tuple(low), "high": tuple(high), "draws": Draws(seed)}
        super().__init__(radar, objective, genetic_rotation, **box, **size, selection=selection, assess=assess)


class RotationEvolution(_Search):
    """Rotation of least image entropy in a box by differential evolution; see `evolve_rotation`.

    All trials use the same random numbers. With the default settings the unknowns are the rotation
    rate omega at the first pulse (rad/s) and its relative derivatives k1 (1/s) and k2 (1/s^2).
    Other settings change their number and meaning, see `Unknowns`.

    Args:
        radar: Radar parameters.
        low: Lower bound of each unknown: by default omega (rad/s), k1 (1/s) and k2 (1/s^2).
        high: Upper bound of each unknown.
        objective: Settings of the entropy. If another stage provides `yc_m` (range centre
            deviation), this value replaces that of the settings, unless the settings make it an
            unknown.
        population: Number of candidates in a generation.
        generations: Number of generations.
        strategy: Mutation strategy, "rand1bin" or "best1bin".
        seed: Seed of the random numbers.
        assess: False leaves out the assessment.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        objective: EntropyObjective = _PUBLISHED,
        population: int = 24,
        generations: int = 36,
        strategy: Literal["rand1bin", "best1bin"] = "rand1bin",
        seed: int = 1,
        assess: bool = True,
    ) -> None:
        size = {"population": population, "generations": generations}
        box = {"low": tuple(low), "high": tuple(high), "draws": Draws(seed)}
        super().__init__(radar, objective, evolve_rotation, **box, **size, strategy=strategy, assess=assess)


class _Descending(_Search):
    """A search from a start, [omega (rad/s), k1, k2, ...], without omega if there is no range term.

    Connected values take precedence over the entries of the start.
    """

    def __init__(
        self,
        radar: InverseRadar,
        objective: EntropyObjective,
        start: list[float] | None,
        find: Callable[..., Estimate],
        **options: Any,
    ) -> None:
        super().__init__(radar, objective, find, **options)
        self.names = (*(("omega",) if objective.range_term else ()), "k1, k2, ...")
        wanted = objective.order - 1 + objective.range_term
        if start is not None and len(start) != wanted:
            raise ValueError(f"start must hold the {wanted} values {', '.join(self.names)}, got {list(start)}")
        begin = None if start is None else torch.tensor(start, dtype=torch.float64)
        self.rate, self.k = radar.rotation_rad_s if objective.range_term else 0.0, begin
        if begin is None:
            self.k = torch.zeros(0, dtype=torch.float64) if objective.order == 1 else None
        elif objective.range_term:
            self.rate, self.k = begin[0], begin[1:]

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
                rotation centre), shape (...,); None takes that of the settings.

        Returns:
            The `Estimate` of the function that the description of the stage names.

        Raises:
            ValueError: If there is no rotation rate or no `warp_k` to start from.
        """
        omega, k = self.rate if omega_rad_s is None else omega_rad_s, self.k if warp_k is None else warp_k
        if omega is None or k is None:
            raise ValueError(
                f"{type(self).__name__} needs a rotation to start from: give start=[{', '.join(self.names)}], or "
                f"connect {'omega_rad_s and ' if self.objective.range_term else ''}warp_k from an earlier estimator"
            )
        figure = self.figure(signal, yc_m)
        return self.find(figure, figure.start(omega, k, yc_m), **self.options)


class RotationNewton(_Descending):
    """Rotation of least image entropy near a start by Newton's method; see `newton_rotation`.

    The search starts from the values `omega_rad_s` and `warp_k` that other stages provide. A value
    that no stage provides is taken from `start`. Without `start` the rotation rate is
    `rotation_rad_s` of the radar.

    Args:
        radar: Radar parameters.
        start: Values to start from, [omega (rad/s), k1 (1/s), k2 (1/s^2), ...]: the rotation rate
            omega at the first pulse and its relative derivatives. Leave omega out if `objective`
            does not compensate the range-dependent phase. None if other stages provide the values.
        objective: Settings of the image entropy, by default with a gridding kernel of six taps. A
            range centre deviation `yc_m` that another stage provides replaces that of the settings.
            If they make it an unknown, the search starts from that of the stage, or from 0.
        damped: True damps the steps.
        steps: Largest number of steps.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If `start` has the wrong number of values.
    """

    def __init__(
        self,
        radar: InverseRadar,
        start: list[float] | None = None,
        objective: EntropyObjective = _FOR_NEWTON,
        damped: bool = True,
        steps: int = 20,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, objective, start, newton_rotation, damped=damped, steps=steps, assess=assess)


class RotationDescent(_Descending):
    """Rotation of least image entropy near a start by L-BFGS; see `descend_rotation`.

    With order 2 and without compensation of the range-dependent phase it is the second-order method
    (SM) of Remote Sens. 2025, 17, 3447.

    The search starts from the values `omega_rad_s` and `warp_k` that other stages provide. A value
    that no stage provides is taken from `start`. Without `start` the rotation rate is
    `rotation_rad_s` of the radar.

    Args:
        radar: Radar parameters.
        start: Values to start from, [omega (rad/s), k1 (1/s), k2 (1/s^2), ...]: the rotation rate
            omega at the first pulse and its relative derivatives. Leave omega out if `objective`
            does not compensate the range-dependent phase. None if other stages provide the values.
        objective: Settings of the entropy, by default with the variables "shape". A range centre
            deviation `yc_m` that another stage provides replaces that of the settings. If they make
            it an unknown, the search starts from that of the stage, or from 0.
        steps: Largest number of steps.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If `start` has the wrong number of values.
    """

    def __init__(
        self,
        radar: InverseRadar,
        start: list[float] | None = None,
        objective: EntropyObjective = _FOR_DESCENT,
        steps: int = 60,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, objective, start, descend_rotation, steps=steps, assess=assess)
