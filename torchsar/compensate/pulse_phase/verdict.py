"""Reliability of the phases that autofocus estimates.

It follows from the sharpness of the image, compared with that of noise, and from the agreement of
estimates from two halves of the range cells or of the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import Displacement, displacement
from torchsar.compensate.pulse_phase.data import (
    Pulses,
    dealt,
    on_the_circle,
    or_one,
    rising,
    rotate,
    safe_angle,
    without_line,
)
from torchsar.compensate.pulse_phase.homogeneous import describe
from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.core import Estimate, block_bytes_of, host_value, over_blocks, true_positions
from torchsar.metrics.phase import phase_rmse, residual_phase

# difference of the entropies of a uniform row and of speckle, whose power has an exponential
# distribution: 1 - Euler's constant
SPECKLE_NATS = 1 - 0.5772156649015329
LEAST_STREHL = 0.8  # Strehl ratio of a well-focused image, a convention (Marechal)
# factor by which the sharpness must exceed that of noise: `sharpness_of_noise` errs by up to 15 %
_MARGIN = 1.5
# a single row, 1, cannot separate phase errors from the scene, unless it holds one point
LEAST_ROWS = 1.5
# A single point: largest relative scatter of its modulus, far below the 0.52 of noise, and least
# number of pulses; with fewer, phases can be found that make the scatter of noise as small.
_STEADY, _LEAST_PULSES = 0.25, 32
# Difference of halves of the rows from which on a phase counts as unknown: half of the difference
# of uniformly distributed phases is half of their error. In normal errors of the largest standard
# deviation that is ok, 3 % of the differences are larger.
_APART_RAD = 2.0
_UNKNOWN_RAD = math.pi / math.sqrt(3)  # standard deviation of a random phase
# Phases from which halves of the rows start are apart by a walk of so many rad rms; they go on for
# so many rounds at most, until a round moves them by less than this. Found by trial: what the scene
# does not hold stays apart, and weak targets are found again.
_DISTURBED_RAD, _RETURNED_RAD, _RETURNS = 0.4, 0.04, 6
# Quarters of the pulses; a quarter is compared with the others if its even and odd pulses have
# such a correlation: with less, noise hides the scene. It was 0.2 at -5 dB, 0.5 at 0 dB, 0.9 at 20
# dB. No two quarters may be less alike than this, as where the scene is another one.
_QUARTERS, _SEEN, _ALIKE = 4, 0.17, 0.33
# Mean correlation of the quarters, without noise: 0.93 to 1.06 in 90 % of the trials measured with
# up to 300 points that stay, 0.76 to 0.88 with the aircraft and where points are not resolved, 0.58
# to 0.78 where 40 or 120 scatterers change within 8 to 16 of 128 pulses, where the deviation is too
# small. The largest deviation that is surely ok grows from 0 at the first correlation to its usual
# value at the second. Both are lines (value at 0, slope) over the share of the scene in the moduli,
# the correlation of even and odd pulses. Found by trial: most of the wrong estimates lie beyond.
_CHANGING, _STAYING = (0.62, 0.19), (0.94, -0.09)
# Changes of few scatterers do not average out. Where fewer rows than the first number make the
# sharpness, the largest deviation that is ok is smaller; where fewer than the second do, nothing is
# sure below this correlation, which a few percent of the trials reach where four points change
# within 32 pulses, and most where few points stay.
_TELLING_ROWS, _MANY_ROWS, _STILL = 6, 30, 0.92
# From this share of the scene in the moduli on, noise does not make a large deviation of few
# scatterers, but changes do: the usual largest deviation is then exceeded only where the quarters
# are the same, by this difference of the correlation from 1. Without this, 5 % were wrong and ok
# where two scatterers turn out of sight, whose correlations were 0.80 to 0.98; those of points that
# stay were 0.995 to 1.01.
_CLEAR, _SAME = 0.6, 0.015
# Multiple of the difference that noise explains from which on few scatterers differ. Where three of
# them walk in phase within 40 of 128 pulses, 15 to 45 % were wrong and ok without this. With 12
# telling rows instead of 6, points that migrate in a small scene were doubted.
_BEYOND_NOISE = 3.0
# Factor of the deviation of few scatterers whose quarters are not the same. Their errors are slow,
# and the difference of two halves has as few degrees of freedom as the record has times of
# coherence: with 4 of them, an error is sqrt(4 / (4 - 2)) as large as such a difference says.
_FEW_TELL = 1.4
# With little noise bright scatterers may stay while weak ones change, as in an aircraft in flight.
# It is enough if they are alike: the same limits for moduli above so many times their median, in
# images with such a share of the scene. The correlation was below 0.71 in 95 % of the trials where
# 40 scatterers change, 0.75 in the recorded flight and 0.81 to 0.85 with the aircraft.
_BRIGHT, _LITTLE_NOISE = 3.0, 0.8
_BRIGHT_CHANGING, _BRIGHT_STAYING = 0.68, 0.76
# Largest deviation that is ok where this is not sure, but halves of the rows from which phases are
# found anew agree, as in dense scenes whose scatterers the quarters do not resolve. Found by trial:
# with 0.3, 1.7 % were wrong and ok where 40 scatterers change within 16 of 128 pulses.
_UNSURE_RAD = 0.25
# factor of the deviation of these: halves agree by chance in some of those that are ok, which were
# 0.9 times (dense scenes) to 1.4 times (40 points that change) as wrong as the deviation said
_BY_CHANCE = 1.15
# limits of `_drift`, found by trial: more rounds, or rounds after smaller steps, cost time and
# rarely change the result
_ROUNDS = 6
_FAR_RAD = 0.1
_EVERY = slice(None)

# continues a method: (rows, which of the trials that it found these are, phase) -> phase
Which = Tensor | slice
Again = Callable[[Tensor, Which, Tensor], Tensor]
Halves = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
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
    density = (spectrum.real.square() + spectrum.imag.square()).mean(-1, dtype=torch.float64)
    return torch.where(density.sum(-1) > 0, density.mean(-1).square() / or_one(density.square().mean(-1)), 1)


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
      is divided by the square root of `occupied_band`, because rows that are sampled finer than
      their band requires are not independent. Where a single point makes the image sharp, it is the
      relative scatter of the modulus of its echo instead: noise and weaker scatterers change the
      modulus as much as the phase, and the phase error does not change it. The scatter of the phase
      that remains is added. Where less than 6 rows make the sharpness, the halves may hold the
      same scatterers; the difference between scatterers beyond noise then counts too.
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
        the pulses are alike. Otherwise the quarters may show scatterers that change, or stay and
        are not resolved. The phases are then found anew from two halves of the rows without a
        common scatterer, and the standard deviation is at least half of their difference; it must
        be below 0.25 rad. The last four conditions need not hold for a single point whose modulus
        scatters by less than 0.25, with 32 pulses or more. `info` holds "present", shape (...,
        pulse), False for pulses that hold only zeros; and, of shape (...,), "homogeneous" (True
        where that description is more likely), "ok_if_sparse" (what `ok` is if it is not),
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
        scatter, rest = _of_point(focused, present)
        lone = (sharpness_rows <= LEAST_ROWS) & (scatter < _STEADY) & (present.sum(-1) >= _LEAST_PULSES)
        lone = lone & (imaging is None) & (rows.shape[-2] > 1)
        disturbed = halves is None and imaging is None
        apart = _half_difference(rows, present, phase, again, halves or halves_of_rows, disturbed)
        if halves is None:
            apart = apart / occupied.sqrt()
        std = torch.where(lone, torch.hypot(scatter, rest), apart)
        if not at_rest:
            std = torch.maximum(std, _drift(rows, present, phase, again))
        scene = describe(rows, phase, occupied)
        moved = displacement(rows, present) if compare else Displacement(0 * sharp, 0 * sharp)
        if compare:
            few = (sharpness_rows / _TELLING_ROWS).clamp_max(1)
            largest = math.sqrt(-math.log(LEAST_STREHL)) * few
            alone = ~lone & (sharpness_rows < _TELLING_ROWS)
            std = torch.maximum(std, _between_scatterers(rows, present, phase, again, image, alone) / occupied.sqrt())
            one, sure, differ = _one_scene(rows, phase, std, largest, sharpness_rows)
            least = _UNSURE_RAD * few
            unsure = one & ~sure & ~lone & (std < least)
            std = torch.maximum(std, _found_anew(rows, present, start, phase, find, unsure) / occupied.sqrt())
            stays = one & (sure | (unsure & (std < least)))
            std = torch.where(unsure, _BY_CHANCE * std, std)
            std = torch.where(differ & alone, _FEW_TELL * std, std)
        else:
            stays = torch.ones_like(lone)
    homogeneous = scene.homogeneous & compare & ~lone
    scene_rows = effective * occupied, sharpness_rows
    return phase, taken, sharp, *scene_rows, std, scene.sparse, homogeneous, lone, stays, moved.jitter, moved.migration


def _no_estimate(rows: Tensor) -> tuple[Tensor, ...]:
    """The result of `_assessed` where no phase can be found: too few pulses, or no trials."""
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    std, no = zero + _UNKNOWN_RAD, zero > 0
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
        value={"phase_rad": phase.reshape(*shape, pulses.n)},
        std={"phase_rad": std.reshape(*shape, pulses.n)},
        quality=quality.reshape(shape).to(phase.dtype),
        ok=(if_sparse & ~homogeneous).reshape(shape),
        info={
            "present": present.reshape(*shape, pulses.n),
            **{name: value.reshape(shape) for name, value in info.items()},
        },
    )


def _of_point(focused: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Scatter of modulus and phase of the strongest point over the pulses, (trial,) each.

    The scatter of the modulus is a standard deviation over its mean; that of the phase is in rad,
    about a straight line. The rows are added up with the weights and phases of the point: with the
    conjugate of its cell in the image. focused: (trial, range, pulse), with the phases removed.
    """
    bright = (focused.real.square() + focused.imag.square()).sum(-1).argmax(-1)
    row = focused.gather(1, bright[:, None, None].expand(-1, 1, focused.shape[-1]))
    at = torch.fft.fft(row).abs().argmax(-1)[..., None].expand(-1, focused.shape[-2], 1)
    echo = (focused * torch.fft.fft(focused).gather(-1, at).conj()).sum(-2)
    modulus, count = echo.abs().to(torch.float64), present.sum(-1).clamp_min(1)
    mean = modulus.sum(-1) / count
    spread = torch.where(present, (modulus - mean[:, None]).square(), 0).sum(-1) / (count - 1).clamp_min(1)
    angle = safe_angle(echo).to(torch.float64)
    return torch.where(mean > 0, spread.sqrt() / or_one(mean), torch.pi), phase_rmse(angle, 0 * angle, present)


def halves_of_rows(rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Divide the rows, sorted by energy, alternately into two halves.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase in rad, shape (trial, pulse); not used.

    Returns:
        Both halves, shape (trial, range of the half, pulse).
    """
    order = (rows.real.square() + rows.imag.square()).sum(-1).argsort(-1, descending=True)
    one, other = (
        rows.gather(1, order[:, part::2].sort(-1).values[..., None].expand(-1, -1, rows.shape[-1])) for part in (0, 1)
    )
    return one, other


def _half_difference(
    rows: Tensor, present: Tensor, phase: Tensor, again: Again, halves: Halves, disturbed: bool
) -> Tensor:
    """Std of the phase (rad) from the differences between two halves of the pulses, (trial,).

    It is at least the distance of their mean from the phase, and pi / sqrt(3), as for a random
    phase, if there is only one row or a half is empty.

    disturbed: Whether the halves start on either side of the phase (see `_settled_apart`).
    """
    if rows.shape[-2] < 2:
        return torch.full_like(phase[:, 0], _UNKNOWN_RAD, dtype=torch.float64)
    parts = halves(rows, phase)
    if disturbed:
        ends = _settled_apart(parts, present, phase, again, _EVERY)
    else:
        ends = [again(part, _EVERY, phase) for part in parts]
    return _half_of(parts, ends, phase, present)


def _half_of(parts: Sequence[Tensor], ends: Sequence[Tensor], phase: Tensor, present: Tensor) -> Tensor:
    """Half of the difference between the phases of two halves, or their distance from the phase of
    both if that is more, in rad rms, (trial,); that of a random phase if a half is empty.
    """
    filled = torch.stack([(part != 0).flatten(1).any(-1) for part in parts]).all(0)
    one, other = ends
    apart = residual_phase(one, other, present)
    moved = phase_rmse(one - apart / 2, phase, present)
    apart = torch.where(apart.abs() > _APART_RAD, apart, apart / 2)
    apart = (apart.square().sum(-1) / present.sum(-1).clamp_min(1)).sqrt()
    return torch.where(filled, torch.maximum(apart, moved), _UNKNOWN_RAD)


def _settled_apart(
    parts: Sequence[Tensor], present: Tensor, phase: Tensor, again: Again, which: Which
) -> Sequence[Tensor]:
    """Phases of two halves, (trial, pulse) each, that started on either side of the phase."""
    walk = _disturbance(phase)
    ends: Sequence[Tensor] = (phase + walk, phase - walk)
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    every = 1 if phase.device.type == "cpu" else _RETURNS // 2  # waiting costs as much as a round
    for number in range(1, _RETURNS + 1):
        reached = [again(part, which, at) for part, at in zip(parts, ends, strict=True)]
        far = torch.stack([_moved(*pair, present) for pair in zip(reached, ends, strict=True)]) >= _RETURNED_RAD
        ends = [torch.where(active[:, None], new, old) for new, old in zip(reached, ends, strict=True)]
        active = active & far.any(0)
        if number % every == 0 and number < _RETURNS and not bool(active.any()):
            break
    return ends


def _moved(new: Tensor, old: Tensor, present: Tensor) -> Tensor:
    """Rms of the change of phases (trial, pulse) about its mean and slope in rad, (trial,)."""
    step = without_line(on_the_circle(new - old), present)
    return (torch.where(present, step, 0).square().sum(-1) / present.sum(-1).clamp_min(1)).sqrt()


def _one_scene(
    rows: Tensor, phase: Tensor, std_rad: Tensor, largest_rad: Tensor, telling_rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether the quarters of the pulses may show one scene, whether this is sure, and whether they
    differ although noise does not hide the scene.

    It is sure as far as the deviation needs it. Quarters that noise hides are left out. The results
    are bools per trial.

    largest_rad: largest deviation that is ok; telling_rows: effective number of rows over which the
    sharpness is spread; (trial,) each.
    """
    if rows.shape[-1] < _LEAST_PULSES:
        one = torch.ones_like(phase[:, 0], dtype=torch.bool)
        return one, std_rad < largest_rad, ~one
    x = rotate(rows, phase)
    n = rows.shape[-1] // _QUARTERS // 2 * 2
    parts = [[x[..., first + k : first + n : 2] for k in (0, 1)] for first in range(0, _QUARTERS * n, n)]
    images = [[torch.fft.fft(part, n).abs() for part in pair] for pair in parts]
    alike, least, share = _likeness(images)
    changing, staying = (at_0 + slope * share for at_0, slope in (_CHANGING, _STAYING))
    steady = (alike - changing) / (staying - changing)
    bright, _, _ = _likeness([[_above(image) for image in pair] for pair in images])
    steady_bright = (bright - _BRIGHT_CHANGING) / (_BRIGHT_STAYING - _BRIGHT_CHANGING)
    steady = torch.where(share > _LITTLE_NOISE, torch.maximum(steady, steady_bright), steady)
    differ = (share > _CLEAR) & ((alike - 1).abs() > _SAME)
    steady = torch.where(differ, steady.clamp_max(1), steady)
    sure = (std_rad < largest_rad * steady) & ((alike > _STILL) | (telling_rows > _MANY_ROWS))
    hidden = least.isinf()
    return hidden | (least > _ALIKE), sure | (hidden & (std_rad < largest_rad)), differ & ~hidden


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
    energy = (rows.real.square() + rows.imag.square()).sum(-1)
    half = dealt(energy, 2)
    parts = [torch.where((half == k)[..., None], rows, 0) for k in (0, 1)]
    ends = [find(part, present, start)[0] for part in parts]
    return torch.where(unsure, std.index_copy(0, at, _half_of(parts, ends, phase, present)), 0)


def _between_scatterers(
    rows: Tensor, present: Tensor, phase: Tensor, again: Again, image: Tensor, few: Tensor
) -> Tensor:
    """Std of the phase (rad) that the difference between scatterers shows, beyond noise, (trial,).

    Zero for trials with more than few scatterers, and where noise hides all but one. Each scatterer
    of a few has a phase of its own if it moves within the target, and halves of the rows that hold
    the same one do not show it. The halves here have none in common. The difference that noise
    explains follows from the energy of each half over the median power of the image.
    """
    std = torch.zeros_like(phase[:, 0], dtype=torch.float64)
    count = host_value(few.sum(), len(few))
    if not count:
        return std
    at = true_positions(few, count)
    rows, present, phase = rows[at], present[at], phase[at]
    noise = rising((image[at].real.square() + image[at].imag.square()).flatten(1))
    noise = noise[:, (noise.shape[-1] - 1) // 2].to(torch.float64) / math.log(2)
    energy = (rows.real.square() + rows.imag.square()).sum(-1)
    half, parts, variance = dealt(energy, 2), [], torch.zeros_like(noise)
    for k in (0, 1):
        power = torch.where(half == k, energy, -1)
        power, strongest = power.sort(-1, descending=True)
        power, strongest = (x[:, : -(-x.shape[-1] // 2)] for x in (power, strongest))
        inside = power >= 0
        parts.append(rows.gather(1, strongest[..., None].expand(-1, -1, rows.shape[-1])) * inside[..., None])
        # energy of scatterers in noise variances: beyond a noise that is a tenth stronger than the
        # median says, and four deviations of its sum
        samples = inside.sum(-1) * present.sum(-1)
        seen = power.clamp_min(0).sum(-1) / or_one(noise) - 1.1 * samples - 4 * samples.sqrt()
        variance = variance + torch.where(seen > 0, present.sum(-1) / (2 * or_one(seen)), torch.inf)
    expected = variance.sqrt() / 2
    apart = _half_of(parts, [again(part, at, phase) for part in parts], phase, present)
    unlike = apart > _BEYOND_NOISE * expected  # the first step does not go all the way
    count = host_value(unlike.sum(), len(unlike))
    if count:
        far = true_positions(unlike, count)
        parts, present, phase = [part[far] for part in parts], present[far], phase[far]
        ends = _settled_apart(parts, present, phase, again, at[far])
        apart = apart.index_copy(0, far, _half_of(parts, ends, phase, present))
    found = torch.where(apart > _BEYOND_NOISE * expected, (apart.square() - expected.square()).clamp_min(0).sqrt(), 0)
    return torch.where(few, std.index_copy(0, at, found), 0)


def _above(image: Tensor) -> Tensor:
    """Moduli (trial, range, Doppler) above a multiple of their median."""
    sizes = rising(image.flatten(1))
    return (image - _BRIGHT * sizes[:, (sizes.shape[-1] - 1) // 2, None, None]).clamp_min(0)


def _likeness(images: Sequence[Sequence[Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Correlation of the quarters of the pulses, without noise: its mean over pairs of quarters,
    its least value, and the share of the scene in the moduli, (trial,) each.

    Two quarters are compared by the covariance of their moduli, at the displacement in Doppler
    where it is largest. It is related to the covariance of the images of the even and of the odd
    pulses of the same quarter, so that noise, which is independent in all of them, has no part in
    the result. Quarters that noise hides are left out; the least value is infinite without any.

    images: moduli (trial, range, Doppler) from the even and from the odd pulses of each quarter.
    """
    spectra, variances, shares = [], [], []
    for pair in images:
        even, odd = (image - image.mean((-2, -1), keepdim=True) for image in pair)
        common = (even * odd).sum((-2, -1))
        whole = (even.square().sum((-2, -1)) * odd.square().sum((-2, -1))).sqrt()
        spectra.append(torch.fft.rfft((even + odd) / 2))
        variances.append(common.clamp_min(0))
        shares.append(common / or_one(whole))
    total, count = torch.zeros_like(variances[0]), torch.zeros_like(variances[0])
    least = torch.full_like(variances[0], torch.inf)
    for i, j in combinations(range(len(images)), 2):
        common = torch.fft.irfft((spectra[i].conj() * spectra[j]).sum(-2), images[0][0].shape[-1]).amax(-1)
        both = torch.minimum(shares[i], shares[j]) > _SEEN
        alike = common / or_one((variances[i] * variances[j]).sqrt())
        total, count = total + torch.where(both, alike, 0), count + both
        least = torch.where(both, torch.minimum(alike, least), least)
    return total / or_one(count), least, torch.stack(shares).mean(0)


def _disturbance(phase: Tensor) -> Tensor:
    """Walk of phases in rad without a straight line, (pulse,): the same in every trial."""
    pulse = torch.arange(phase.shape[-1], dtype=torch.float64, device=phase.device)
    # steps that repeat nowhere: the angles are irrational parts of a turn times squares
    walk = torch.cos(math.pi * (math.sqrt(5) - 1) * pulse.square()).cumsum(-1)
    place = pulse - pulse.mean()
    walk = walk - walk.mean()
    walk = walk - place * (walk @ place) / place.square().sum()
    return (_DISTURBED_RAD / walk.square().mean().sqrt() * walk).to(phase.dtype)


def _drift(rows: Tensor, present: Tensor, phase: Tensor, again: Again) -> Tensor:
    """Distance in rad rms, (trial,), by which continuing the method moves its result on all rows.

    It is continued while the steps are large and the phase might still count as reliable, because
    it moves slowly on dense targets: PGA on 256 scatterers per row has an error of 0.8 rad, of
    which the first round reveals 0.3.
    """
    current, total = phase, torch.zeros(len(phase), dtype=torch.float64, device=phase.device)
    active = torch.ones_like(total, dtype=torch.bool)
    for _ in range(_ROUNDS):
        reached = again(rows, _EVERY, current)
        step = phase_rmse(reached, current, present)
        total = torch.where(active, phase_rmse(reached, phase, present), total)
        active = active & (step > _FAR_RAD) & (torch.exp(-total.square()) > LEAST_STREHL)
        if not bool(active.any()):
            break
        current = reached
    return total
