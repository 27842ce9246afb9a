"""The recommended autofocus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import Pulses, prepare, refuse_odd_counts, rotate, starting_phase
from torchsar.compensate.pulse_phase.gaps import across_gaps, have_gaps
from torchsar.compensate.pulse_phase.halves import Which
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.linking import linked, may_be_ok
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.points import FEW_ROWS, Points, phases_of_points
from torchsar.compensate.pulse_phase.sharpen import (
    LEAST_PULSES_OF_FACTORS,
    WIENER_FACTORS,
    LogAbove,
    Run,
    Wiener,
    fixed_point,
    in_turn,
)
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate, Outcome, host_value, host_values, power_of, true_positions
from torchsar.metrics import entropy

# floor of the entropy fixed point in mean powers, found by trial: a lower floor includes noise, a
# higher one excludes weak scatterers
_FLOOR = 2.5
# floor of the first iterations where noise is weak, and their number: without them one scene of two
# hundred ended in a wrong minimum
_FIRST_FLOOR, _FIRST_ITERATIONS = 5.0, 6
# on scenes at 30 dB, 3 of 32 trials of the entropy fixed point ended in a local minimum without
# over-relaxation and none with this one
_RELAXATION = 1.8
# Standard deviation of the sharpest phases below which they are ok where only the dependence of
# range cells speaks against linked phases: a third of the largest one that is ok elsewhere.
_SURE_RAD = 0.15
# Iterations across gaps for each of the third step: filled pulses grow slowly. A quarter of a
# record of 40 points takes 60 to 100.
_FILLING = 5
# lines of the image in a strip, by choice: more than the response of a point is wide
_STRIP = 4
_SLOPES = 48  # slopes tried over one turn per pulse, found by trial: spacing against time
# longest records whose phases are linked: the matrices of all pairs of pulses then take 2 to 3 GB
_MOST_LINKED = 3072


def autofocus(
    data: Tensor,
    *,
    start: Tensor | None = None,
    search: int = 120,
    polish: int = 20,
    search_tolerance_rad: float = 0.01,
    tolerance_rad: float = 2e-3,
    imaging: Imaging | None = None,
) -> Estimate:
    """Estimate the phase of each pulse; the recommended autofocus.

    In sparse scenes the phases sharpen the image. In scenes whose homogeneous description is more
    likely (see `describe`), such as clutter that fills a large part of the Doppler band, they are
    those of `link_phases`, because sharpness does not find them. Longer records than 3072 pulses
    keep the phases that sharpen, which are not ok there: the memory of `link_phases` grows with the
    square of the number of pulses, and its time with the cube.

    The sharpening has three steps. The first is `sca`. The second repeats the iterations of
    `entropy_fixed_point` until the phases no longer change; cells below 2.5 times the mean power of
    the image get no weight (5 times in the first six iterations if noise is weak). In the third
    step the phase of each pulse is measured against a Wiener estimate of the scene, on an image of
    twice as many Doppler cells. The third step reduces the remaining error by half or more. Where
    two to sixteen points explain the pulses down to the noise, their phases by maximum likelihood
    take its place (see `phases_of_points`): the sharpest phases of few points are up to eight times
    as wrong at 25 dB. Without `imaging`, missing pulses, which are all zeros, are filled in from
    the estimate of the scene (see `across_gaps`). Differentiable without `imaging`.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`). With this default the size of the phase errors
            has no effect on the result.
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
            slope is then estimated too.
            After the three steps, 48 slopes over one turn per pulse are tried and the best is
            refined; then the second and the third step are repeated with `imaging`. The scene is
            then taken to be sparse.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. Its standard deviation follows from two
        halves of the range cells, or of the image by `imaging`, or from the noise where points
        explain the pulses; for point targets it is close to the true error.
        `ok` is False unless the image is 1.5 times as sharp as autofocus can make
        pure noise, more than one range cell or a single point makes the sharpness, the pulses show
        one scene, and the Strehl ratio predicted from the standard deviation exceeds 0.8. Sharpness
        is the amount by which the image entropy lies below that of speckle. The pulses show one
        scene where the images of quarters of them are alike; where these are not alike enough,
        because scatterers change or are not resolved in a quarter, phases found anew from two
        halves of the range cells must agree to 0.25 rad, less where few range cells make the
        sharpness. The standard deviation then is at least half of their difference. Where few
        range cells make the sharpness, it is also at least half of the difference between
        scatterers beyond noise, and `ok` is False if that is 0.25 rad or more; with less than 2.5
        such cells, or a gap of more than 0.36 of the pulses, `ok` is also False unless points
        explain the pulses down to the noise. One point that noise leaves alone tells no change of
        its own phase from a phase error: both are in the phases, which then are those of this
        point, and ok. Phases of `link_phases` have its
        standard deviations, `quality` and `ok`; where they are not ok but the sharpest ones are,
        these stay. `info` holds "homogeneous" of shape (...,), bool, True where the homogeneous
        description is more likely and linked phases do not contradict it; `ok` is False if they do
        not confirm it, and where too few range cells have similar power for that. It also holds
        "jitter_cells" and "migration_cells", the displacement of the range profiles from pulse to
        pulse and of groups of pulses in cells rms: `ok` is False from 0.25 and 0.4 cell on, because
        the phases may then be wrong. `imaging` corrects displacements, which are not examined then.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a number of iterations is not a whole number of 0 or more.
    """
    pulses = prepare(data, "autofocus")
    refuse_odd_counts("autofocus", 0, search=search, polish=polish)
    through = None if imaging is None else Through(imaging)
    coarse, fine = (AlongPulses(), AlongPulses(2)) if through is None else (through, through)
    quick = through is None and pulses.n >= LEAST_PULSES_OF_FACTORS
    factors, few_iterations = (WIENER_FACTORS, len(WIENER_FACTORS)) if quick else (1.0, 6)
    of_lines = through is None and polish > 0  # points, and pulses that are filled in
    if polish:
        again = Run(Wiener(), fine, few_iterations, factors, tolerance_rad)
    else:
        again = Run(LogAbove(_FLOOR), coarse, 4, _RELAXATION, 0.0)

    def iterations(imaging: Imaging) -> Run:
        return Run(LogAbove(_FLOOR), imaging, search, _RELAXATION, search_tolerance_rad)

    def polishing(imaging: Imaging) -> Run:
        return Run(Wiener(), imaging, polish, factors, tolerance_rad)

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> Found:
        first = Run(
            LogAbove(_first_floor(rows)),
            AlongPulses(),
            min(search, _FIRST_ITERATIONS),
            _RELAXATION,
            search_tolerance_rad,
        )
        begin = pair_phase(rows, present) if begin is None else begin
        phase, taken = in_turn(rows, begin, [first, iterations(AlongPulses())])
        few, gaps = _few_rows(rows) & of_lines, have_gaps(present) & of_lines
        counts = host_values(torch.stack([few.sum(), gaps.sum()]), len(rows))
        points = phases_of_points(rows, present, phase, few, counts[0])
        phase, more = _polished(rows, points, polishing(AlongPulses(2)))
        taken = taken + more
        if counts[1]:
            phase = _filled(rows, phase, phase, gaps & ~points.explained, _FILLING * polish, tolerance_rad / 10)

            def further(some: Tensor, which: Which, at: Tensor) -> Tensor:
                reached = fixed_point(some, at, again)[0]
                return _filled(some, reached, at, gaps[which], _FILLING * few_iterations, tolerance_rad / 10)

            return phase, taken, further
        if through is not None:
            phase, more = _WithSlope(through, [iterations(through), polishing(through)])(rows, phase)
            taken = taken + more
        return phase, taken, lambda some, _, at: fixed_point(some, at, again)[0]

    begin = starting_phase(start, pulses, "autofocus")
    if through is None:
        sharpest = estimated(pulses, begin, find, at_rest=True)
    else:
        halves = partial(halves_of_image, through)
        sharpest = estimated(pulses, begin, find, at_rest=True, compare=False, halves=halves)
    return _with_linked(pulses, sharpest)


def _few_rows(rows: Tensor) -> Tensor:
    """Whether the energy lies in so few range cells that few points may explain it, (trial,)."""
    energy = power_of(rows.detach()).sum(-1)
    return energy.sum(-1).square() < FEW_ROWS * energy.square().sum(-1)


def _polished(rows: Tensor, points: Points, run: Run) -> tuple[Tensor, Tensor]:
    """Phases (trial, pulse) and number of iterations (trial,) of the third step.

    The phases of points stay where these explain the pulses.
    """
    phase, taken = points.phase_rad, torch.zeros_like(points.explained, dtype=torch.int64)
    count = host_value((~points.explained).sum(), len(rows)) if points.examined else len(rows)
    if not count:
        return phase, taken
    if count == len(rows):
        other, more = fixed_point(rows, phase, run)
    else:
        at = true_positions(~points.explained, count)
        other, more = fixed_point(rows[at], phase[at], run.of(at))
        other, more = phase.index_copy(0, at, other), taken.index_copy(0, at, more)
    return torch.where(points.explained[:, None], phase, other), torch.where(points.explained, taken, more)


def _filled(rows: Tensor, phase: Tensor, start: Tensor, gaps: Tensor, iterations: int, tolerance_rad: float) -> Tensor:
    """Phases (trial, pulse): those across gaps, found from a start, where there are gaps."""
    count = host_value(gaps.sum(), len(gaps))
    if not count:
        return phase
    at = true_positions(gaps, count)
    found = across_gaps(rows[at], start[at], iterations, tolerance_rad)
    return torch.where(gaps[:, None], phase.index_copy(0, at, found), phase)


def _with_linked(pulses: Pulses, sharpest: Estimate) -> Estimate:
    """The estimate with the linked phases in trials whose scene is more likely homogeneous.

    Where that description turns out to be less likely with the linked phases, the sharpest phases
    stay; they are not ok, because the descriptions contradict each other. But where it is less
    likely only because range cells depend on each other, as those that side lobes of few points
    fill, the scene is sparse after all, and phases of small deviation are ok. The sharpest phases
    also stay in long records, and where they are ok but the linked ones are not, as in scenes of
    few points. Nothing is linked where neither can be ok.
    """
    if pulses.n > _MOST_LINKED:
        return sharpest
    homogeneous = sharpest.info["homogeneous"].flatten()
    matter = homogeneous & (sharpest.info["ok_if_sparse"].flatten() | may_be_ok(pulses.rows))
    count = host_value(matter.sum(), 0)
    if not count:
        return sharpest
    at = true_positions(matter, count)
    some = linked(Pulses(pulses.rows[at], pulses.present[at], at.shape))
    info, ok = dict(sharpest.info), sharpest.ok.flatten()
    std = sharpest.std["phase_rad"].reshape(pulses.rows.shape[0], -1)[at]
    likelier = some.info["gain_nats"] > info["sparse_gain_nats"].flatten()[at]
    fits = some.info["fit_nats"] > info["sparse_gain_nats"].flatten()[at]
    if_sparse, sharp = info["ok_if_sparse"].flatten()[at], std[:, 0] < _SURE_RAD
    better = likelier & if_sparse & ~some.ok
    sparse = better | (~likelier & fits)
    sure = if_sparse & (better | sharp)
    ok = ok.index_copy(0, at[sparse], sure[sparse]).reshape(sharpest.ok.shape)
    info["homogeneous"] = homogeneous.index_fill(0, at[sparse], False).reshape(sharpest.ok.shape)
    likelier = likelier & ~better
    at = at[likelier]

    def mixed(of_all: Tensor, of_some: Tensor) -> Tensor:
        flat = of_all.reshape(len(pulses.rows), *of_some.shape[1:])
        return flat.index_copy(0, at, of_some[likelier].to(of_all.dtype)).reshape(of_all.shape)

    return Estimate(
        {"phase_rad": mixed(sharpest["phase_rad"], some["phase_rad"])},
        {"phase_rad": mixed(sharpest.std["phase_rad"], some.std["phase_rad"])},
        mixed(sharpest.quality, some.quality),
        Outcome.of(mixed(ok, some.ok), Outcome.NOISE),
        info=info,
    )


def halves_of_image(imaging: Imaging, rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Divide pulses into those of two halves of their image.

    Range cells do not divide scatterers that migrate through them. Strips of four range lines of
    the image (fewer if there are less than eight), sorted by energy, are taken alternately.

    Args:
        imaging: Image formation of pulses (trial, range, pulse), with the range as last dimension
            of the image.
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase that focuses them in rad, shape (trial, pulse).

    Returns:
        Pulses of both halves, of the shape of the rows.
    """
    image = imaging.image(rotate(rows, phase))
    lines = image.shape[-1]
    strip = torch.arange(lines, device=image.device) // max(1, min(_STRIP, lines // 2))
    energy = power_of(image).sum(-2)
    strips = energy.new_zeros(len(energy), int(strip[-1]) + 1).index_add_(1, strip, energy)
    place = strips.argsort(-1, descending=True).argsort(-1)[:, strip]
    one, other = (rotate(imaging.adjoint(torch.where(place[:, None] % 2 == half, image, 0)), -phase) for half in (0, 1))
    return one, other


def _first_floor(rows: Tensor) -> Tensor:
    """Floor of the first iterations, (trial, 1, 1).

    It is higher where less than half of the range cells hold the energy, that is where noise is
    weak. A low floor then ends in a wrong minimum in one scene of two hundred; in strong noise, a
    high floor hides the target.
    """
    energy = power_of(rows.detach()).sum(-1)
    share = energy / energy.sum(-1, keepdim=True).clamp_min(torch.finfo(energy.dtype).tiny)
    filled = 1 / share.square().sum(-1).clamp_min(torch.finfo(energy.dtype).tiny) / rows.shape[-2]
    return torch.where(filled < 0.5, _FIRST_FLOOR, _FLOOR)[:, None, None].to(energy.dtype)


@dataclass(frozen=True)
class _WithSlope:
    """Slope and phase with an image formation in which scatterers do not migrate.

    Finds the slope over one turn, the phase, the slope again, and the phase again.
    """

    through: Through
    runs: list[Run]

    def __call__(self, rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        step = 2 * math.pi / _SLOPES
        phase = self._best_slope(rows, phase, step, _SLOPES)
        total = torch.zeros_like(phase[:, 0], dtype=torch.int64)
        for _ in range(2):
            phase = self._best_slope(rows, phase, step / 8, 17)
            phase, taken = in_turn(rows, phase, self.runs)
            total = total + taken
        return self._best_slope(rows, self._best_slope(rows, phase, step / 8, 17), step / 64, 17), total

    @torch.no_grad()
    def _best_slope(self, rows: Tensor, phase: Tensor, step_rad: float, count: int) -> Tensor:
        """The phase plus the slope, of `count` about its own, that gives the least entropy."""
        n = rows.shape[-1]
        ramp = torch.arange(n, dtype=phase.dtype, device=phase.device) - (n - 1) / 2
        best, least = phase, torch.full_like(phase[:, 0], torch.inf)
        for index in range(count):
            candidate = phase + (index - count // 2) * step_rad * ramp
            cost = entropy(self.through.image(rotate(rows, candidate)))
            better = cost < least
            best, least = torch.where(better[:, None], candidate, best), torch.where(better, cost, least)
        return best
