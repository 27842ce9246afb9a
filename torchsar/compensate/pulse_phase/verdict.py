"""Reliability of the phases that autofocus estimates.

It follows from the sharpness of the image, compared with that of noise, and from the agreement of
estimates from two halves of the range cells or of the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import Displacement, displacement
from torchsar.compensate.pulse_phase.data import Pulses, dealt, or_one, rising, rotate, without_lobes
from torchsar.compensate.pulse_phase.few import STEADY, between_scatterers, scatter_of_point
from torchsar.compensate.pulse_phase.gaps import longest_gap
from torchsar.compensate.pulse_phase.halves import (
    EVERY,
    UNKNOWN_RAD,
    Again,
    Halves,
    half_difference,
    half_of,
    halves_of_rows,
)
from torchsar.compensate.pulse_phase.homogeneous import describe
from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.compensate.pulse_phase.points import FEW_ROWS, phases_of_points
from torchsar.compensate.pulse_phase.quarters import one_scene
from torchsar.core import Estimate, Outcome, block_bytes_of, host_value, over_blocks, power_of, true_positions
from torchsar.metrics.phase import phase_rmse

# difference of the entropies of a uniform row and of speckle, whose power has an exponential
# distribution: 1 - Euler's constant
SPECKLE_NATS = 1 - 0.5772156649015329
LEAST_STREHL = 0.8  # Strehl ratio of a well-focused image, a convention (Marechal)
# factor by which the sharpness must exceed that of noise: `sharpness_of_noise` errs by up to 15 %
_MARGIN = 1.5
# a single row, 1, cannot separate phase errors from the scene, unless it holds one point
LEAST_ROWS = 1.5
# fewest pulses in which a single point of steady modulus tells its phases: with fewer, phases can
# be found that make the modulus of noise as steady
_LEAST_PULSES = 32
# Changes of few scatterers do not average out. Where fewer rows than this make the sharpness, the
# largest deviation that is ok is smaller, and the scatterers are compared with each other.
_TELLING_ROWS = 6
# Where fewer rows than this make the sharpness, points must explain the pulses down to the noise:
# more than noise beside a bright point tells that they change.
_ROWS_THAT_TELL = 2.5
# Longest gap as a share of the pulses from the first to the last, up to which scenes of many points
# tell how the phases before and after it go together: with 0.39, 1 trial of 32 was wrong.
_LONGEST_GAP = 0.36
# Factor of the deviation of few scatterers whose quarters are not the same. Their errors are slow,
# and the difference of two halves has as few degrees of freedom as the record has times of
# coherence: with 4 of them, an error is sqrt(4 / (4 - 2)) as large as such a difference says.
_FEW_TELL = 1.4
# Largest deviation that is ok where this is not sure, but halves of the rows from which phases are
# found anew agree, as in dense scenes whose scatterers the quarters do not resolve. Found by trial:
# with 0.3, 1.7 % were wrong and ok where 40 scatterers change within 16 of 128 pulses.
_UNSURE_RAD = 0.25
# factor of the deviation of these: halves agree by chance in some of those that are ok, which were
# 0.9 times (dense scenes) to 1.4 times (40 points that change) as wrong as the deviation said
_BY_CHANCE = 1.15
# limit of `_drift`, found by trial: more rounds cost time and rarely change the result
_ROUNDS = 6
# Smaller steps of `_drift` rarely change its result, and smaller differences between few scatterers
# that of phases found anew: both only cost time.
_FAR_RAD = 0.1

Found = tuple[Tensor, Tensor, Again]
Find = Callable[[Tensor, Tensor, Tensor | None], Found]


def sharpness_beyond_speckle(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute by how much the entropy of an image lies below that of speckle.

    The speckle has the same energy in each row (range cell) as the image. The result is 0 for an
    image of circular noise to which no phase was fitted.

    Args:
        image: Image, shape (..., range, Doppler), complex.

    Returns:
        The difference of entropies in nats, positive for an image sharper than speckle; the
        effective number of rows over which the energy is spread; and the effective number of rows
        over which the difference of entropies is spread (1 if one bright row makes all of it);
        shape (...,) each, float64.
    """
    real, imag = image.real.contiguous(), image.imag.contiguous()
    power = real * real + imag * imag
    row = power.sum(-1)
    tiny = torch.finfo(power.dtype).tiny
    # entropy of a row: ln(sum p) - sum p ln p / sum p
    entropy = torch.log(row.clamp_min(tiny)) - (power * torch.log(power.clamp_min(tiny))).sum(-1) / or_one(row)
    row, entropy = row.to(torch.float64), entropy.to(torch.float64)
    share = row / or_one(row.sum(-1, keepdim=True))
    lack = share * torch.where(row > 0, math.log(image.shape[-1]) - SPECKLE_NATS - entropy, 0)
    sharp = lack.sum(-1)
    return sharp, 1 / or_one(share.square().sum(-1)), sharp.square() / or_one(lack.square().sum(-1))


def sharpness_of_noise(rows: Tensor) -> Tensor:
    """Predict the sharpness of the sharpest image that autofocus can make from pure noise.

    The sharpness is the amount in nats by which the image entropy lies below that of speckle. The
    prediction is a fit, within 15 %, to measurements with the entropy fixed point on circular noise
    of 4 to 1024 rows and 64 to 1600 pulses: 0.94, 0.29, 0.10, 0.045, 0.019 nats at 4, 16, 64, 256,
    1024 rows. The number of pulses has hardly any effect.

    Args:
        rows: Effective number of rows (range cells), shape (...,).

    Returns:
        The sharpness in nats, shape (...,).
    """
    return 0.62 / torch.sqrt(rows) + 2.1 / rows


def occupied_band(rows: Tensor) -> Tensor:
    """Compute the share of the range band that the data occupy.

    It is the share of the rows (range cells) that are independent: 1 / 4 in noise that is sampled
    four times too finely, for example.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.

    Returns:
        The share 0..1, shape (trial,), float64.
    """
    spectrum = torch.fft.fft(rows, dim=-2)
    density = power_of(spectrum).mean(-1, dtype=torch.float64)
    return torch.where(density.sum(-1) > 0, _filled(density), 1)


def _filled(density: Tensor) -> Tensor:
    """Share of the last dimension over which a density is spread, 0 where there is none."""
    return density.mean(-1).square() / or_one(density.square().mean(-1))


def _band_of_noise(image: Tensor) -> Tensor:
    """Share of the range band that noise occupies, (trial,), from a focused image.

    The density of a range frequency is the median over Doppler, in which a sparse scene has no
    part. Its relative variance is 3.2 / Doppler cells, measured.

    image: (trial, range, Doppler).
    """
    spectrum = without_lobes(torch.fft.fft(image, dim=-2))
    cells = image.shape[-1]
    density = rising(power_of(spectrum))[..., (cells - 1) // 2].to(torch.float64)
    return ((1 + 3.2 / cells) * _filled(density)).clamp_max(1)


def estimated(
    pulses: Pulses,
    start: Tensor | None,
    find: Find,
    at_rest: bool = False,
    compare: bool = True,
    imaging: Imaging | None = None,
    halves: Halves | None = None,
    tuned: Sequence[Tensor | float] = (),
) -> Estimate:
    """Run an autofocus method on all trials and predict the accuracy of its phases.

    Trials are processed in blocks that fit into the cache, or all at once if gradients are
    required. The standard deviation is the larger of two:

    - Half of the rms difference between the phases from two halves of the rows (range cells), and
      the whole difference where it exceeds 2 rad, as in pulses that do not see the scene. The rows
      are sorted by energy and taken alternately; the noise of the halves is independent. The halves
      start from phases that a walk of 0.4 rad moves apart: what the scene does not hold, because
      its scatterers change from pulse to pulse, stays apart. (With `imaging` or `halves` the method
      settles too slowly for that, and the halves start from the phases themselves.) If the halves
      agree on other phases, because the method had not converged, their distance counts. The result
      is divided by the square root of the share of the band that the data and their noise occupy,
      because rows that are sampled finer than their band requires are not independent. Where a
      single point makes the image sharp, it is the relative scatter of the modulus of its echo
      instead: noise and weaker scatterers change the modulus as much as the phase, and the phase
      error does not change it. The scatter of the phase that remains is added. Where less than 6
      independent rows make the sharpness, the halves may hold the same scatterers; the difference
      between scatterers beyond noise then counts too, and the scatter of the point if one makes the
      scene (see `between_scatterers`). All this holds where few points do not explain the pulses
      down to the noise. Where they do, the scene is known to stay, and the deviation is the
      distance from the phases of these points and their deviation due to noise (see
      `phases_of_points`).
    - The distance by which the phases move when the method is continued on all rows.

    Args:
        pulses: The pulses.
        start: Phase to start from in rad, one row per trial, or None.
        find: The autofocus method: a function of (rows, present, start). It returns the phase
            (trial, pulse), the number of iterations (trial,), and a function of (rows, which,
            phase) that continues the method from a phase, on all or on half of the rows, in all or
            in some of the trials, by their indices `which`.
        at_rest: True if continuing the method does not move its result; the second
            standard deviation is then left out.
        compare: False if the image is not the Fourier transform along pulses. The scene is then
            not compared with a homogeneous one, and the alignment of the profiles not examined.
        imaging: Image formation of all trials, from rows (trial, range, pulse) to images (trial,
            line, range), with which the sharpness is measured; by default a Fourier transform. All
            trials are then processed at once.
        halves: Function of (rows, phase) that divides the pulses into two, whose noise is
            independent and which both determine all phases; by default the rows are divided.
        tuned: Settings of the method; where one of them, the start or the rows require a gradient,
            all trials are processed at once.

    Returns:
        `phase_rad` of shape (..., pulse) with its standard deviation. Sharpness is the amount by
        which the image entropy lies below that of speckle. `quality` is the Strehl ratio predicted
        from the standard deviation, times the share of the sharpness that noise does not explain.
        `ok` is False unless that Strehl ratio exceeds 0.8, the profiles are aligned (see
        `Displacement`; not examined without `compare`), the image is 1.5 times as sharp as
        autofocus can make pure noise, more than one row contributes to the sharpness, a homogeneous
        description of the scene is not more likely (see `describe`), because sharpness does not
        find the phases of homogeneous clutter, and the pulses show one scene: where its scatterers
        change, the standard deviation is too small. That is sure where the images of quarters of
        the pulses are alike, or points explain the pulses. Otherwise the quarters may show
        scatterers that change, or stay and are not resolved. The phases are then found anew from
        two halves of the rows without a common scatterer, and the standard deviation is at least
        half of their difference; it must be below 0.25 rad, as where few scatterers differ beyond
        noise. Where less than 2.5 rows make the sharpness, points must explain the pulses down to
        the noise, be it points of one range; and points of several ranges where one gap takes more
        than 0.36 of the pulses. The last six conditions need not hold for a single point whose
        modulus scatters by less than 0.25, with 32 pulses or more. `info` holds "present", shape
        (..., pulse), False for pulses that hold only zeros; and, of shape (...,), "homogeneous"
        (True where that description is more likely), "ok_if_sparse" (what `ok` is if it is not),
        "sparse_gain_nats" (gain of the log likelihood of the sparse description over white noise),
        "jitter_cells" and "migration_cells" (see `Displacement`),
        "iterations", "sharpness_nats", "noise_sharpness_nats" (the largest sharpness that noise can
        reach), "effective_rows" (number of rows over which the energy is spread) and "telling_rows"
        (number of rows over which the sharpness is spread).
    """
    rows, present = pulses.rows, pulses.present
    if not len(rows) or pulses.n < 3:
        return _gathered(pulses, [_no_estimate(rows)])
    of_gradients = any(isinstance(x, Tensor) and x.requires_grad for x in (rows, start, *tuned))
    if imaging is not None or len(rows) == 1 or (of_gradients and torch.is_grad_enabled()):
        return _gathered(pulses, [_assessed(rows, present, start, find, at_rest, compare, imaging, halves)])
    height = max(1, block_bytes_of(rows.device) // (rows[0].numel() * rows.element_size()))
    parts = [slice(first, first + height) for first in range(0, len(rows), height)]
    done: dict[int, tuple[Tensor, ...]] = {}

    def work(part: slice) -> None:
        begin = None if start is None else start[part]
        done[part.start] = _assessed(rows[part], present[part], begin, find, at_rest, compare, halves=halves)

    with torch.no_grad():
        over_blocks(work, parts, rows)
    return _gathered(pulses, [done[part.start] for part in parts])


def _assessed(
    rows: Tensor,
    present: Tensor,
    start: Tensor | None,
    find: Find,
    at_rest: bool,
    compare: bool,
    imaging: Imaging | None = None,
    halves: Halves | None = None,
) -> tuple[Tensor, ...]:
    """Phase, iterations, sharpness, effective rows of both, std, and the descriptions per trial.

    The last four are True where a single point makes the image sharp, True where the scene stays
    the same, the jitter and the migration.
    """
    phase, taken, again = find(rows, present, start)
    with torch.no_grad():
        focused = rotate(rows, phase)
        image = torch.fft.fft(focused, norm="ortho") if imaging is None else imaging.image(focused).mT
        sharp, effective, sharpness_rows = sharpness_beyond_speckle(image)
        occupied = occupied_band(rows)
        scatter, rest = scatter_of_point(focused, present)
        lone = (sharpness_rows <= LEAST_ROWS) & (scatter < STEADY) & (present.sum(-1) >= _LEAST_PULSES)
        lone = lone & (imaging is None) & (rows.shape[-2] > 1)
        compared = (sharpness_rows * occupied < _TELLING_ROWS) & compare
        few_points = (compared | (effective < FEW_ROWS)) & compare
        points = phases_of_points(rows, present, phase, few_points)
        stay, compared = points.explained, compared & ~points.explained
        disturbed = halves is None and imaging is None
        which = ~stay if points.examined else None
        apart = half_difference(rows, present, phase, again, halves or halves_of_rows, disturbed, which)
        mixed = torch.where(lone, 0, apart)
        band = torch.maximum(occupied, _band_of_noise(image)) if halves is None else torch.ones_like(apart)
        apart = apart / band.sqrt()
        of_point = torch.hypot(scatter, rest)
        std = torch.where(lone, of_point, apart)
        if not at_rest:
            std = torch.maximum(std, _drift(rows, present, phase, again))
        scene = describe(rows, phase, occupied)
        moved = displacement(rows, present) if compare else Displacement(0 * sharp, 0 * sharp)
        if compare:
            few = (sharpness_rows / _TELLING_ROWS).clamp_max(1)
            largest = math.sqrt(-math.log(LEAST_STREHL)) * few
            alone = ~lone & (sharpness_rows < _TELLING_ROWS)
            between, unlike, untold = torch.zeros_like(std), torch.zeros_like(stay), torch.zeros_like(stay)
            if points.examined:
                between, unlike, untold = between_scatterers(
                    rows, present, phase, again, points.noise, mixed, of_point, compared
                )
            exact = torch.hypot(points.std_rad / band.sqrt(), phase_rmse(points.phase_rad, phase, present))
            std = torch.where(stay, exact, torch.maximum(std, between / occupied.sqrt()))
            one, sure, differ = one_scene(rows, phase, std, largest, sharpness_rows)
            least, sure = _UNSURE_RAD * few, sure | stay
            unsure = one & ~sure & ~lone & (std < least)
            far = unlike & (between > _FAR_RAD) & (std < _UNSURE_RAD)
            anew = _found_anew(rows, present, start, phase, find, unsure | far)
            std = torch.maximum(std, anew / occupied.sqrt())
            stays = one & (sure | (unsure & (std < least)))
            std = torch.where(unsure, _BY_CHANCE * std, std)
            std = torch.where(differ & alone & ~stay, _FEW_TELL * std, std)
            unlike = unlike & (std >= _UNSURE_RAD)
            hidden = alone & ~points.enough & (sharpness_rows < _ROWS_THAT_TELL)
            hidden = hidden | (~stay & (longest_gap(present) > _LONGEST_GAP))
            stays, lone = stays & ~unlike & ~(untold & differ) & ~hidden, lone & ~unlike
        else:
            stays = torch.ones_like(lone)
    homogeneous = scene.homogeneous & compare & ~lone & ~stay
    scene_rows = effective * occupied, sharpness_rows
    return phase, taken, sharp, *scene_rows, std, scene.sparse, homogeneous, lone, stays, moved.jitter, moved.migration


def _no_estimate(rows: Tensor) -> tuple[Tensor, ...]:
    """The result of `_assessed` where no phase can be found: too few pulses, or no trials."""
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    std, no = zero + UNKNOWN_RAD, zero > 0
    return rows[:, 0].real * 0, zero.long(), zero, zero, zero, std, zero, no, no, no, zero, zero


def _gathered(pulses: Pulses, parts: Sequence[tuple[Tensor, ...]]) -> Estimate:
    """Estimate from the results of all blocks of trials."""
    phase, taken, sharp, effective, sharpness_rows, std_rad, sparse, homogeneous, lone, stays, jitter, migration = (
        torch.cat(pieces) for pieces in zip(*parts, strict=True)
    )
    present, shape = pulses.present, pulses.trials
    noise = sharpness_of_noise(effective.clamp_min(1))
    enough_pulses = present.sum(-1) >= 3
    strehl = torch.exp(-std_rad.square())
    quality = torch.where(enough_pulses, strehl * (1 - (noise / sharp.clamp_min(1e-12)).clamp(0, 1)), 0)
    distinct = (sharp > _MARGIN * noise) & (sharpness_rows > LEAST_ROWS) & stays
    distinct = distinct | (lone & (sharp > noise))
    if_sparse = enough_pulses & distinct & (strehl > LEAST_STREHL) & Displacement(jitter, migration).aligned
    phase = torch.where(enough_pulses[:, None], phase, 0)
    info = {
        "iterations": taken,
        "sharpness_nats": sharp,
        "noise_sharpness_nats": noise,
        "effective_rows": effective,
        "telling_rows": sharpness_rows,
        "sparse_gain_nats": sparse,
        "homogeneous": homogeneous,
        "ok_if_sparse": if_sparse,
        "jitter_cells": jitter,
        "migration_cells": migration,
    }
    std = std_rad[:, None].expand(-1, pulses.n).to(phase.dtype)
    return Estimate(
        {"phase_rad": phase.reshape(*shape, pulses.n)},
        {"phase_rad": std.reshape(*shape, pulses.n)},
        quality.reshape(shape).to(phase.dtype),
        Outcome.of((if_sparse & ~homogeneous).reshape(shape), Outcome.NOISE),
        info={
            "present": present.reshape(*shape, pulses.n),
            **{name: value.reshape(shape) for name, value in info.items()},
        },
    )


def _found_anew(
    rows: Tensor, present: Tensor, start: Tensor | None, phase: Tensor, find: Find, unsure: Tensor
) -> Tensor:
    """Std of the phase (rad) from phases that are found from two halves of the rows, (trial,).

    Zero for trials that are not unsure. The halves have no scatterer in common, unlike those of
    `halves_of_rows`: rows between two minima of the energy, which one scatterer fills, stay
    together.
    """
    std = torch.zeros_like(phase[:, 0], dtype=torch.float64)
    count = host_value(unsure.sum(), len(unsure))
    if not count:
        return std
    at = true_positions(unsure, count)
    rows, present, phase, start = rows[at], present[at], phase[at], None if start is None else start[at]
    energy = power_of(rows).sum(-1)
    half = dealt(energy, 2)
    parts = [torch.where((half == k)[..., None], rows, 0) for k in (0, 1)]
    ends = [find(part, present, start)[0] for part in parts]
    return torch.where(unsure, std.index_copy(0, at, half_of(parts, ends, phase, present)), 0)


def _drift(rows: Tensor, present: Tensor, phase: Tensor, again: Again) -> Tensor:
    """Distance in rad rms, (trial,), by which continuing the method moves its result on all rows.

    It is continued while the steps are large and the phase might still count as reliable, because
    it moves slowly on dense targets: PGA on 256 scatterers per row has an error of 0.8 rad, of
    which the first round reveals 0.3.
    """
    current, total = phase, torch.zeros(len(phase), dtype=torch.float64, device=phase.device)
    active = torch.ones_like(total, dtype=torch.bool)
    for _ in range(_ROUNDS):
        reached = again(rows, EVERY, current)
        step = phase_rmse(reached, current, present)
        total = torch.where(active, phase_rmse(reached, phase, present), total)
        active = active & (step > _FAR_RAD) & (torch.exp(-total.square()) > LEAST_STREHL)
        if not bool(active.any()):
            break
        current = reached
    return total
