"""The recommended autofocus, and its second step alone, the entropy fixed point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import (
    Pulses,
    find_phases,
    pair_phase,
    prepare,
    refuse_odd_counts,
    rotate,
    starting_phase,
)
from torchsar.compensate.pulse_phase.fixed_point import (
    LEAST_PULSES_OF_FACTORS,
    WIENER_FACTORS,
    LogAbove,
    Run,
    Wiener,
    across_gaps,
    fixed_point,
    have_gaps,
    in_turn,
)
from torchsar.compensate.pulse_phase.homogeneous import describe, occupied_band
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.linking import link_phases, linked
from torchsar.compensate.pulse_phase.points import phases_of_points
from torchsar.compensate.pulse_phase.stages import _PhaseEstimatorFromStart
from torchsar.core import Estimate, Signal, differentiable, fft_lines, host_value, power_of, true_positions
from torchsar.focus import TargetImage
from torchsar.metrics import entropy

Scene = Literal["sparse", "points", "clutter", "auto"]

# floor of the entropy fixed point in mean powers: a lower floor includes noise, a higher one
# excludes weak scatterers
_FLOOR = 2.5
# On scenes at 30 dB, 3 of 32 trials of the entropy fixed point ended in a local minimum without
# over-relaxation, and none with this value.
_RELAXATION = 1.8
# iterations across gaps for each iteration of the third step, because filled pulses converge slowly
_FILLING = 5


@differentiable("where ok")
def autofocus(
    data: Tensor,
    *,
    start: Tensor | None = None,
    scene: Scene = "sparse",
    search: int = 120,
    polish: int = 20,
    search_tolerance_rad: float = 0.01,
    tolerance_rad: float = 2e-3,
    imaging: Imaging | None = None,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase of each pulse; the recommended autofocus.

    >>> import torch
    >>> from torchsar.compensate import autofocus, correct_pulse_phase
    >>> point = torch.zeros(64, 16, dtype=torch.complex64)  # pulses, range cells
    >>> point[:, 5] = torch.exp(2j * torch.rand(64))
    >>> found = autofocus(point, assess=False)
    >>> correct_pulse_phase(point, found["phase_rad"]).shape
    torch.Size([64, 16])

    The phases sharpen the image in three steps. The first is `sca`. The second repeats the
    iterations of `entropy_fixed_point` until the phases no longer change; cells below 2.5 times the
    mean power of the image get no weight (5 times in the first six iterations if noise is weak). In
    the third step the phase of each pulse is measured against a Wiener estimate of the scene, on an
    image of twice as many Doppler cells, which reduces the remaining error by half or more. Without
    `imaging`, missing pulses, which are all zeros, are filled in from the estimate of the scene
    (see `across_gaps`). Differentiable without `imaging`.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`). With this default the size of the phase errors
            has no effect on the result.
        scene: Kind of the scene. "sparse": scatterers that a sharp image separates. "points": two
            to sixteen points at several ranges, whose phases by maximum likelihood take the place
            of the third step where they explain the pulses down to the noise (the sharpest phases
            of few points are up to eight times as wrong at 25 dB). "clutter": homogeneous clutter
            that fills a large part of the Doppler band, see `link_phases`. "auto": points where
            they explain the pulses, and linked phases where a homogeneous description is more
            likely (see `describe`); it may take many times as long.
        search: Largest number of iterations of the second step, approximately; only hard cases of
            low SNR need them all.
        polish: Largest number of iterations of the third step; with 0 it is left out.
        search_tolerance_rad: Phase change in rad, rms over the pulses, below which the iterations
            of the second step end.
        tolerance_rad: Phase step in rad, rms over the pulses, below which the iterations of the
            third step end. With 24 pulses or more the steps are taken 0.88, 3.75 and 1.43 times in
            turn, which converges faster; the tolerance holds for 0.88 times a step.
        imaging: Image formation that corrects range migration, for data in which scatterers migrate
            through range cells; see `entropy_fixed_point`. Its image, with the range as last
            dimension, must cover the whole unambiguous cross range. A slope of the phase over
            pulses displaces the image, and a displaced image has the wrong migration; therefore the
            slope is then estimated too. After the three steps, 48 slopes over one turn per pulse
            are tried and the best is refined; then the second and the third step are repeated with
            `imaging`. The scene is then taken to be sparse.
        assess: Whether to add the standard deviation and the outcome, which takes about as long as
            the estimate.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, zero with fewer than three pulses. `info`
        holds "present", shape (..., pulse), False for pulses of zeros, and "iterations".

        With `assess`, the standard deviation is half of the rms difference between the phases of
        two halves of the range cells (or of the image by `imaging`), and at least the distance of
        their mean from the phase. `quality` is the Strehl ratio that follows from it, times the
        share of the sharpness that noise does not explain. Sharpness is the amount in nats by which
        the image entropy lies below that of speckle. Outcomes:

        - EMPTY, SINGULAR: only zeros; fewer than three pulses.
        - NOISE: the image is less than 1.5 times as sharp as autofocus makes noise.
        - DISPLACED: the range profiles are displaced by 0.25 cell rms from pulse to pulse, or 0.4
          cell between groups of pulses.
        - HOMOGENEOUS: a homogeneous description of the scene is likelier.
        - PARTS_DISAGREE: one of three blocks of neighbouring range cells gets sharper with phases
          of its own by more than 2.2 times the sharpness of noise, as where something in the scene
          moves on its own.
        - INEXACT: the Strehl ratio is below 0.8.

        `info` also holds, of shape (...,), "sharpness_nats", "noise_sharpness_nats",
        "gain_of_parts", "jitter_cells" and "migration_cells". Scatterers that change from pulse to
        pulse are not recognised: the standard deviation is then too small. With `imaging` only the
        sharpness and the halves are examined. Linked phases have the outcomes of `link_phases`.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, the kind of scene is unknown, or a number of iterations is not a whole number of
            0 or more.
    """
    if scene not in get_args(Scene):
        raise ValueError(f"autofocus: scene must be one of {', '.join(map(repr, get_args(Scene)))}, got {scene!r}")
    if scene == "clutter":
        return link_phases(data, start=start, assess=assess)
    pulses = prepare(data, "autofocus")
    refuse_odd_counts("autofocus", 0, search=search, polish=polish)
    through = None if imaging is None else Through(imaging)
    quick = through is None and pulses.n >= LEAST_PULSES_OF_FACTORS
    factors, few_iterations = (WIENER_FACTORS, len(WIENER_FACTORS)) if quick else (1.0, 6)
    of_points = scene != "sparse" and through is None and polish > 0

    def iterations(imaging: AlongPulses | Through) -> Run:
        return Run(LogAbove(_FLOOR), imaging, search, _RELAXATION, search_tolerance_rad)

    def polishing(imaging: AlongPulses | Through, count: int = polish) -> Run:
        return Run(Wiener(), imaging, count, factors, tolerance_rad)

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        # If less than half of the range cells hold the energy, noise is weak. A low floor of the
        # first iterations then ends in a wrong minimum in one scene of two hundred. In strong
        # noise, a high floor suppresses the target.
        energy = power_of(rows.detach()).sum(-1)
        tiny = torch.finfo(energy.dtype).tiny
        share = energy / energy.sum(-1, keepdim=True).clamp_min(tiny)
        filled = 1 / share.square().sum(-1).clamp_min(tiny) / rows.shape[-2]
        floor = torch.where(filled < 0.5, 5.0, _FLOOR)[:, None, None].to(energy.dtype)
        first = Run(LogAbove(floor), AlongPulses(), min(search, 6), _RELAXATION, search_tolerance_rad)
        begin = pair_phase(rows, present) if begin is None else begin
        phase, taken = in_turn(rows, begin, [first, iterations(AlongPulses())])
        explained = torch.zeros_like(present[:, 0])
        if of_points:
            points, explained = phases_of_points(rows, present, phase)
        phase, more = fixed_point(rows, phase, polishing(AlongPulses(2)))
        if through is None:
            phase = torch.where(explained[:, None], points, phase) if of_points else phase
            gaps = have_gaps(present) & ~explained & (polish > 0)
            return _filled(rows, phase, phase, gaps, _FILLING * polish, tolerance_rad / 10), taken + more
        phase, last = _with_slope(through, [iterations(through), polishing(through)], rows, phase)
        return phase, taken + more + last

    def again(rows: Tensor, which: Tensor | slice, at: Tensor) -> Tensor:
        along = AlongPulses(2) if through is None else through
        if not polish:
            return fixed_point(rows, at, Run(LogAbove(_FLOOR), AlongPulses(), 4, _RELAXATION, 0.0))[0]
        reached = fixed_point(rows, at, polishing(along, few_iterations))[0]
        if not with_gaps:
            return reached
        gaps = have_gaps(pulses.present[which])
        return _filled(rows, reached, at, gaps, _FILLING * few_iterations, tolerance_rad / 10)

    judged = assess and through is None and polish > 0 and pulses.n >= 3 and len(pulses.rows) > 0
    with_gaps = judged and bool(host_value(have_gaps(pulses.present).any(), True))
    begin = starting_phase(start, pulses, "autofocus")
    phase, taken = find_phases(pulses, find, begin, whole=through is not None)
    sharpest = conclude(pulses, phase, taken, assess, again, through)
    return _with_linked(pulses, sharpest, assess) if scene == "auto" and through is None else sharpest


@differentiable("where ok")
def entropy_fixed_point(
    data: Tensor,
    *,
    start: Tensor | None = None,
    floors: Sequence[tuple[Tensor | float, int]] = ((5.0, 12), (2.0, 12)),
    relaxation: Tensor | float = 1.8,
    tolerance_rad: float = 1e-3,
    imaging: Imaging | None = None,
    assess: bool = True,
) -> Estimate:
    r"""Estimate the phase of each pulse by a fixed-point iteration that lowers the image entropy.

    >>> import torch
    >>> from torchsar.compensate import entropy_fixed_point
    >>> point = torch.zeros(32, 8, dtype=torch.complex64)  # pulses, range cells
    >>> point[:, 3] = torch.exp(2j * torch.rand(32))
    >>> entropy_fixed_point(point, assess=False)["phase_rad"].shape
    torch.Size([32])

    Each iteration forms the image and weights its cells with ln(max(p, floor) / floor), where p is
    the power of a cell over the mean power. It transforms the weighted image back to pulses and
    takes the phase of each pulse relative to the result. An iteration takes two transforms and,
    unlike PGA, needs no peaks and no windows. Differentiable, also in the floors and the
    relaxation, which may be tensors of one number.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`). With this default the size of the phase errors
            has no effect on the result.
        floors: Pairs (floor, largest number of iterations), used one after another. A floor is a
            multiple of the mean power. A trial proceeds to the next pair once its phase steps are
            below `tolerance_rad`.
        relaxation: Factor applied to the phase step. Above 1 it helps to pass local minima; at 2 or
            more the iteration need not converge.
        tolerance_rad: Phase step in rad, rms over the pulses, below which a trial ends its
            iterations with a floor.
        imaging: Image formation whose image is sharpened, by default a Fourier transform along
            pulses; any object with the methods `image` and `adjoint` for profiles of shape (...,
            pulse, range), such as `torchsar.focus.PolarOperator`.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a floor, an iteration count or the relaxation is invalid.
    """
    pulses = prepare(data, "entropy_fixed_point")
    if not floors or not all(floor > 0 and count >= 1 for floor, count in floors) or not 0 < relaxation < 2:
        raise ValueError(
            "entropy_fixed_point: floors must be pairs of a floor above 0 and a number of iterations of 1 or more, "
            f"and relaxation must lie between 0 and 2, got floors {list(floors)} and relaxation {relaxation}"
        )
    through = None if imaging is None else Through(imaging)
    operator = AlongPulses() if through is None else through
    runs = [Run(LogAbove(floor), operator, count, relaxation, tolerance_rad) for floor, count in floors]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)

    begin = starting_phase(start, pulses, "entropy_fixed_point")
    tuned = (relaxation, *(floor for floor, _ in floors))
    found = find_phases(pulses, find, begin, tuned, through is not None)
    return conclude(pulses, *found, assess, through=through)


class Autofocus(_PhaseEstimatorFromStart):
    """Phase per pulse by the recommended autofocus; see `autofocus`.

    Args:
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        imaging: Image formation whose image is sharpened; by default a Fourier transform along
            pulses. A `TargetImage` with a geometry gives the polar-format image of the target, one
            without a geometry the Fourier transform.
        scene: Kind of the scene: "sparse", "points", "clutter" or "auto", see `autofocus`. With an
            image formation other than the Fourier transform it is taken to be sparse.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        search: int = 120,
        polish: int = 20,
        imaging: Imaging | TargetImage | None = None,
        scene: Scene = "sparse",
        assess: bool = True,
    ) -> None:
        super().__init__(autofocus, search=search, polish=polish, scene=scene, assess=assess)
        self.imaging = imaging

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the
                spatial correlation algorithm (function `sca`).

        Returns:
            `Estimate` by the function `autofocus` with `phase_rad` of shape (..., pulse), to be
            removed.
        """
        imaging = self.imaging.operator(signal.data) if isinstance(self.imaging, TargetImage) else self.imaging
        return self.find(signal.data, start=start, imaging=imaging, **self.options)


class EntropyFixedPoint(_PhaseEstimatorFromStart):
    """Phase per pulse by the entropy fixed point; see `entropy_fixed_point`.

    Args:
        floors: Power floors as multiples of the mean power of the image, used one after another;
            cells below the floor get no weight. An nn.Parameter, shape (floor,), stays tunable.
        iterations: Largest number of iterations for each floor.
        relaxation: Factor applied to the phase step. An nn.Parameter stays tunable.
        imaging: Image formation whose image is sharpened; by default a Fourier transform along
            pulses.
        assess: Whether to add the standard deviation and the outcome.

    Raises:
        ValueError: If `floors` and `iterations` differ in length.
    """

    def __init__(
        self,
        floors: list[float] | tuple[float, ...] | nn.Parameter = (5.0, 2.0),
        iterations: list[int] | tuple[int, ...] = (12, 12),
        relaxation: float | nn.Parameter = 1.8,
        imaging: Imaging | None = None,
        assess: bool = True,
    ) -> None:
        super().__init__(entropy_fixed_point, imaging=imaging, assess=assess)
        if len(floors) != len(iterations):
            raise ValueError(
                "EntropyFixedPoint: iterations must hold a number of iterations for each floor, got floors "
                f"{list(floors)} and iterations {list(iterations)}"
            )
        self.floors, self.iterations, self.relaxation = floors, iterations, relaxation

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the
                spatial correlation algorithm (function `sca`).

        Returns:
            `Estimate` by the function `entropy_fixed_point` with `phase_rad` of shape (...,
            pulse), to be removed.
        """
        floors = tuple(zip(self.floors, self.iterations))
        return self.find(signal.data, start=start, floors=floors, relaxation=self.relaxation, **self.options)


def _filled(rows: Tensor, phase: Tensor, start: Tensor, gaps: Tensor, iterations: int, tolerance_rad: float) -> Tensor:
    """Phases (trial, pulse), which in trials with gaps are those of `across_gaps` from the given
    start.
    """
    at = true_positions(gaps, host_value(gaps.sum(), len(gaps)))
    if not len(at):
        return phase
    found = across_gaps(rows[at], start[at], iterations, tolerance_rad)
    return torch.where(gaps[:, None], phase.index_copy(0, at, found), phase)


def _with_linked(pulses: Pulses, sharpest: Estimate, assess: bool) -> Estimate:
    """The sharpest estimate, with linked phases in those trials in which they make a homogeneous
    description likelier than the sparse one.
    """
    rows, phase = pulses.rows.detach(), sharpest["phase_rad"].detach().reshape(-1, pulses.n)
    with torch.no_grad():
        sparse, ratio = describe(rows, phase, occupied_band(fft_lines(rows)))
    at = true_positions(ratio > 1, host_value((ratio > 1).sum(), 0))
    if not len(at) or pulses.n < 3:
        return sharpest
    some = linked(Pulses(pulses.rows[at], pulses.present[at], at.shape), assess=assess)
    likelier = some.info["gain_nats"] > sparse[at]

    def mixed(of_all: Tensor, of_some: Tensor) -> Tensor:
        flat, width = of_all.reshape(len(rows), -1), likelier[:, None]
        chosen = torch.where(width, of_some.reshape(len(at), -1).to(flat.dtype), flat[at])
        return flat.index_copy(0, at, chosen).reshape(of_all.shape)

    return Estimate(
        {name: mixed(x, some[name]) for name, x in sharpest.value.items()},
        {name: mixed(x, some.std[name]) for name, x in sharpest.std.items()},
        mixed(sharpest.quality, some.quality),
        mixed(sharpest.outcome, some.outcome),
        sharpest.info,
    )


def _with_slope(through: Through, runs: list[Run], rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Find the phase, including its linear part (slope), for an image formation in which scatterers
    do not migrate.

    A first search finds the slope over one turn per pulse; then phase and slope are found in turn.
    Returns the phase and the number of iterations.
    """
    n = rows.shape[-1]
    ramp = torch.arange(n, dtype=phase.dtype, device=phase.device) - (n - 1) / 2

    @torch.no_grad()
    def best_slope(phase: Tensor, step_rad: float, count: int) -> Tensor:
        """The phase plus that linear phase, of `count` slopes around zero, of which the entropy is
        least.
        """
        best, least = phase, torch.full_like(phase[:, 0], torch.inf)
        for index in range(count):
            candidate = phase + (index - count // 2) * step_rad * ramp
            cost = entropy(through.image(rotate(rows, candidate)))
            better = cost < least
            best, least = torch.where(better[:, None], candidate, best), torch.where(better, cost, least)
        return best

    # 48 slopes over one turn per pulse, a compromise between spacing and time, found by trial
    step = 2 * math.pi / 48
    phase, total = best_slope(phase, step, 48), torch.zeros_like(phase[:, 0], dtype=torch.int64)
    for _ in range(2):
        phase, taken = in_turn(rows, best_slope(phase, step / 8, 17), runs)
        total = total + taken
    return best_slope(best_slope(phase, step / 8, 17), step / 64, 17), total
