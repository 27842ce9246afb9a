"""The rotation of least image entropy, by every search that a paper has used: grid, genetic,
differential evolution, Newton, quasi-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from torchsar.compensate.rotation.image_entropy import ImageEntropy
from torchsar.compensate.rotation.unknowns import Variables, k_name
from torchsar.core import Draws, Estimate, Signal, Stage, settle
from torchsar.optim import Descent, Searched, differential_evolution, genetic, grid_search, lbfgs, newton
from torchsar.radar import InverseRadar

Vector = Sequence[float] | Tensor

_EDGE = 1e-3  # of the width of a box: nearer to its edge a minimum is taken to lie outside
_GAIN_NATS = 0.01  # by which compensation must lower the entropy at least
# relative changes of the entropy that are left to rounding
_STILL = {torch.complex64: 1e-8, torch.complex128: 1e-9}
_FIRST_STEP = 0.3  # in units of the unknowns, of about a radian each


def search_rotation(figure: ImageEntropy, axes: Sequence[Vector], *, limit: int = 100_000) -> Estimate:
    """The best of a full grid: one list of values per unknown of the figure, (m,) or (..., m) per
    trial. Paper's size: 5 x 21 x 201.

    Estimates as `genetic_rotation`; a best point at the end of an axis of several values is not ok.
    info["entropy_grid_nats"]: (..., m_1, m_2, ...), the landscape.
    """
    _same_number(figure, axes, "search_rotation")
    values = [torch.as_tensor(axis, dtype=torch.float64, device=figure.range_m.device) for axis in axes]
    found = grid_search(figure, values, trials=figure.trials, limit=limit)
    ends = [(axis.amin(-1).expand(figure.trials), axis.amax(-1).expand(figure.trials)) for axis in values]
    low, high = (torch.stack(list(bounds), -1) for bounds in zip(*ends, strict=True))
    return _of_box(figure, found, low, high, entropy_grid_nats=found.history)


def genetic_rotation(figure: ImageEntropy, low: Vector, high: Vector, *, draws: Draws, **options: Any) -> Estimate:
    """The rotation that a genetic algorithm finds in a box: the published estimator (Remote Sens.

    2025, 17, 3447, section 3.3).

    figure: the entropy as a function of its unknowns. low, high: one value per unknown
    (`figure.unknowns.names`), (n,) or (..., n). draws and options: as in `torchsar.optim.genetic`.

    value: omega_rad_s (...,) >= 0 (its sign cannot be seen: the image may be mirrored in cross
    range) and yc_m (...,), where the range term is compensated; warp_k (..., order - 1) and its
    entries k1_per_s, k2_per_s2, ... There are no predicted deviations: an entropy is no likelihood.
    quality: by which share the exp(entropy) of the image, the cells it fills, falls against no
    compensation. ok: it falls, and the minimum does not lie on the edge of the box. A figure of
    coarse lines has its minimum at a wrong place (see `ImageEntropy`): ok does not say that the
    value is free of bias. info: evaluations, entropy_nats, uncompensated_entropy_nats, on_edge
    (..., n) and best_entropy_nats (..., generation).
    """
    low, high = _box(figure, low, high)
    found = genetic(figure, low, high, draws=draws, **options)
    return _of_box(figure, found, low, high, best_entropy_nats=found.history)


def evolve_rotation(figure: ImageEntropy, low: Vector, high: Vector, *, draws: Draws, **options: Any) -> Estimate:
    """The same by differential evolution; options as in `torchsar.optim.differential_evolution`."""
    low, high = _box(figure, low, high)
    found = differential_evolution(figure, low, high, draws=draws, **options)
    return _of_box(figure, found, low, high, best_entropy_nats=found.history)


def newton_rotation(figure: ImageEntropy, start: Tensor, *, damped: bool = True, steps: int = 20) -> Estimate:
    """The same by Newton's method from `start` (..., n), see `figure.start`: what the paper calls
    Gauss-Newton, of which its Table 2 shows that it depends on the start.

    damped=False diverges on most targets, from the truth as well: one direction is nearly flat.
    Such trials are not ok and keep their last finite point, nor are those that use up their steps.
    info["iterations"]: steps taken.
    """
    scaled = _Scaled(figure, _started(figure, start))
    return _of_descent(
        figure, scaled, newton(scaled.single, scaled.start, damped=damped, steps=steps), steps, trusted=True
    )


def descend_rotation(figure: ImageEntropy, start: Tensor, *, steps: int = 60, tolerance: float = 1e-4) -> Estimate:
    """The same by L-BFGS with exact gradients from `start` (..., n): the minimum next to it.

    Best in the variables "shape".

    tolerance: of the gradient against that at the start. Not ok where the steps run out. A figure
    of order 2 without range term makes this the second-order method 'SM' of the paper, whose k1 is
    not that of the target but about k1 + k2 T / 2.
    """
    scaled = _Scaled(figure, _started(figure, start))
    found = lbfgs(
        scaled.with_gradient,
        scaled.start,
        steps=steps,
        first_step=_FIRST_STEP,
        gradient_tolerance=tolerance,
        value_tolerance=_STILL[figure.dtype],
        with_gradient=True,
    )
    return _of_descent(figure, scaled, found, steps, trusted=False)


class _Scaled:
    """A figure in units that make its unknowns about one."""

    def __init__(self, figure: ImageEntropy, start: Tensor) -> None:
        self._figure, self.unit = figure, figure.units(start)
        self.start = start / self.unit

    def single(self, z: Tensor) -> Tensor:
        return self._figure.single(z * self.unit)

    def with_gradient(self, z: Tensor) -> tuple[Tensor, Tensor]:
        cost, gradient = self._figure.with_gradient(z * self.unit)
        return cost, gradient * self.unit


def _of_box(figure: ImageEntropy, found: Searched, low: Tensor, high: Tensor, **info: Tensor) -> Estimate:
    width = high - low
    near = torch.minimum(found.x - low, high - found.x) <= _EDGE * width
    edge = near & (width > 0)
    return _estimate(
        figure,
        found.x,
        found.cost,
        found.ok & ~edge.any(-1),
        {"evaluations": found.evaluations, "on_edge": edge, **info},
    )


def _of_descent(figure: ImageEntropy, scaled: _Scaled, found: Descent, steps: int, trusted: bool) -> Estimate:
    """Not ok where the steps ran out.

    trusted: whether the descent's own verdict counts; that of L-BFGS is about walls on its way,
    which infeasible candidates are, too.
    """
    ok = (found.ok if trusted else torch.isfinite(found.cost)) & (found.converged | (found.steps < steps))
    return _estimate(
        figure,
        found.x * scaled.unit,
        found.cost,
        ok,
        {"evaluations": found.evaluations, "iterations": found.steps, "converged": found.converged},
    )


def _estimate(figure: ImageEntropy, x: Tensor, cost: Tensor, ok: Tensor, info: dict[str, Tensor]) -> Estimate:
    turn, before = figure.turn(x.detach()), figure.uncompensated()
    cost, finite = settle(cost.detach(), before)
    gain = before - cost
    value = {"warp_k": turn.warp_k, **{k_name(i + 1): k for i, k in enumerate(turn.warp_k.unbind(-1))}}
    if figure.unknowns.range_term:
        value |= {"omega_rad_s": turn.omega_rad_s.abs(), "yc_m": turn.yc_m.clone()}
    quality = (1 - torch.exp(-gain)).clamp(0, 1)
    return Estimate(
        value,
        quality,
        ok & finite & turn.feasible & (gain > _GAIN_NATS),
        info={**info, "entropy_nats": cost, "uncompensated_entropy_nats": before},
    )


def _box(figure: ImageEntropy, low: Vector, high: Vector) -> tuple[Tensor, Tensor]:
    return figure.spread(figure.unknowns.vector(low, "low")), figure.spread(figure.unknowns.vector(high, "high"))


def _started(figure: ImageEntropy, start: Tensor) -> Tensor:
    """A start (..., n) for every trial; where its own warp is not monotonic that of even rotation
    takes its place.
    """
    x = figure.spread(figure.unknowns.vector(start, "start").detach())
    turn = figure.turn(x)
    return torch.where(turn.feasible[..., None], x, 0)


def _same_number(figure: ImageEntropy, axes: Sequence[Any], who: str) -> None:
    names = figure.unknowns.names
    if len(axes) != len(names):
        raise ValueError(
            f"{who} needs the values of the {len(names)} unknowns {', '.join(names)}, got {len(axes)} lists"
        )


class _Search(Stage):
    """What every search for the rotation is told about the image; see `ImageEntropy`."""

    def __init__(
        self,
        radar: InverseRadar,
        order: int,
        range_term: bool,
        yc_m: float | None,
        variables: Variables,
        oversampling: float,
        lines: int | None,
        taps: int,
    ) -> None:
        super().__init__()
        self.radar, self.order, self.range_term = radar, order, range_term
        self.options = {
            "order": order,
            "range_term": range_term,
            "variables": variables,
            "oversampling": oversampling,
            "lines": lines,
            "taps": taps,
        }
        self.yc_m = yc_m
        self.provides = (
            "warp_k",
            *(k_name(i) for i in range(1, order)),
            *(("omega_rad_s", "yc_m") if range_term else ()),
        )

    def figure(self, signal: Signal, yc_m: Tensor | None) -> ImageEntropy:
        """yc_m: a connected value is that of the centre deviation, unless it is searched for."""
        known = self.yc_m if yc_m is None or self.yc_m is None else yc_m
        return ImageEntropy.of(signal, self.radar, yc_m=known, **self.options)


class RotationSearch(_Search):
    """`search_rotation` on counts[i] values from low[i] to high[i], one entry per unknown: omega
    (rad/s), k1, k2, ... and yc where it is None (see `Unknowns`).

    yc_m: the known centre deviation; a connected value goes before it; None searches for it.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        counts: list[int],
        order: int = 3,
        range_term: bool = True,
        yc_m: float | None = 0.0,
        variables: Variables = "raw",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 4,
        limit: int = 100_000,
    ) -> None:
        super().__init__(radar, order, range_term, yc_m, variables, oversampling, lines, taps)
        if not len(low) == len(high) == len(counts) or any(count < 1 for count in counts):
            raise ValueError(
                "a grid needs as many values in low, high and counts, and counts of at least 1, got "
                f"{list(low)}, {list(high)} and {list(counts)}"
            )
        self.axes = [torch.linspace(a, b, n, dtype=torch.float64) for a, b, n in zip(low, high, counts, strict=True)]
        self.limit = limit

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        return search_rotation(self.figure(signal, yc_m), self.axes, limit=self.limit)


class RotationGenetic(_Search):
    """`genetic_rotation` in the box low..high, one entry per unknown as in `RotationSearch`.

    All trials see the random numbers of `seed`.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        order: int = 3,
        range_term: bool = True,
        yc_m: float | None = 0.0,
        variables: Variables = "raw",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 4,
        population: int = 30,
        generations: int = 30,
        elites: int = 2,
        selection: Literal["tournament", "roulette"] = "tournament",
        seed: int = 1,
    ) -> None:
        super().__init__(radar, order, range_term, yc_m, variables, oversampling, lines, taps)
        self.low, self.high, self.seed = tuple(low), tuple(high), seed
        self.rules = {"population": population, "generations": generations, "elites": elites, "selection": selection}

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        return genetic_rotation(self.figure(signal, yc_m), self.low, self.high, draws=Draws(self.seed), **self.rules)


class RotationEvolution(_Search):
    """`evolve_rotation` in the box low..high, one entry per unknown as in `RotationSearch`.

    All trials see the random numbers of `seed`.
    """

    def __init__(
        self,
        radar: InverseRadar,
        low: list[float],
        high: list[float],
        order: int = 3,
        range_term: bool = True,
        yc_m: float | None = 0.0,
        variables: Variables = "raw",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 4,
        population: int = 24,
        generations: int = 36,
        strategy: Literal["rand1bin", "best1bin"] = "rand1bin",
        seed: int = 1,
    ) -> None:
        super().__init__(radar, order, range_term, yc_m, variables, oversampling, lines, taps)
        self.low, self.high, self.seed = tuple(low), tuple(high), seed
        self.rules = {"population": population, "generations": generations, "strategy": strategy}

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        return evolve_rotation(self.figure(signal, yc_m), self.low, self.high, draws=Draws(self.seed), **self.rules)


class _Descending(_Search):
    """A search from a start [omega (rad/s), k1, k2, ...], without omega where there is no range
    term; connected values go before its entries.
    """

    def __init__(self, start: list[float] | None, *image: Any) -> None:
        super().__init__(*image)
        wanted = self.order - 1 + self.range_term
        if start is not None and len(start) != wanted:
            raise ValueError(
                f"a start needs the {wanted} values {'omega, ' if self.range_term else ''}k1, k2, "
                f"..., got {list(start)}"
            )
        self.begin = None if start is None else torch.tensor(start, dtype=torch.float64)

    def started(
        self, figure: ImageEntropy, omega_rad_s: Tensor | None, warp_k: Tensor | None, yc_m: Tensor | None
    ) -> Tensor:
        """The vector to start from.

        Raises ValueError where a value is neither connected nor in the start.
        """
        omega = self._given()[0] if omega_rad_s is None else omega_rad_s
        k = self._given()[1] if warp_k is None else warp_k
        if omega is None or k is None:
            raise ValueError(
                f"{type(self).__name__} needs a start: give start=[omega, k1, k2, ...], or connect "
                "omega_rad_s and warp_k from an estimator before it"
            )
        return figure.start(omega, k, yc_m)

    def _given(self) -> tuple[Tensor | float | None, Tensor | None]:
        """Rate and warp of the start, or what stands in for them: the rate that the radar is told;
        nothing where there is nothing to know.
        """
        rate = self.radar.rotation_rad_s if self.range_term else 0.0
        if self.begin is None:
            return rate, torch.zeros(0, dtype=torch.float64) if self.order == 1 else None
        first = int(self.range_term)
        return self.begin[0] if first else rate, self.begin[first:]


class RotationNewton(_Descending):
    """`newton_rotation` from `start`, [omega (rad/s), k1, k2, ...] (no omega without range term),
    in raw or well-conditioned variables.

    Values connected (omega_rad_s, warp_k, yc_m) go before the entries of the start, and
    rotation_rad_s of the radar stands in for an omega that is missing. yc_m: as in
    `RotationSearch`; where it is searched for, it starts from the connected value or 0.
    """

    def __init__(
        self,
        radar: InverseRadar,
        start: list[float] | None = None,
        order: int = 3,
        range_term: bool = True,
        yc_m: float | None = 0.0,
        variables: Variables = "raw",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 6,
        damped: bool = True,
        steps: int = 20,
    ) -> None:
        super().__init__(start, radar, order, range_term, yc_m, variables, oversampling, lines, taps)
        self.damped, self.steps = damped, steps

    def forward(
        self,
        signal: Signal,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        figure = self.figure(signal, yc_m)
        return newton_rotation(
            figure, self.started(figure, omega_rad_s, warp_k, yc_m), damped=self.damped, steps=self.steps
        )


class RotationDescent(_Descending):
    """`descend_rotation` from a start, given or connected as in `RotationNewton`.

    With order=2 and range_term=False: the second-order method 'SM'.
    """

    def __init__(
        self,
        radar: InverseRadar,
        start: list[float] | None = None,
        order: int = 3,
        range_term: bool = True,
        yc_m: float | None = 0.0,
        variables: Variables = "shape",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 4,
        steps: int = 60,
    ) -> None:
        super().__init__(start, radar, order, range_term, yc_m, variables, oversampling, lines, taps)
        self.steps = steps

    def forward(
        self,
        signal: Signal,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        figure = self.figure(signal, yc_m)
        return descend_rotation(figure, self.started(figure, omega_rad_s, warp_k, yc_m), steps=self.steps)
