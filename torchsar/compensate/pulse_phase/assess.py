"""Assessment of the phases of pulses: whether they can be trusted, and how exact they are.

Six questions are asked of any phases, whatever method found them:

1. Is the image sharper than the one that autofocus makes of noise?
2. Is a homogeneous description of the scene not likelier (`describe`)?
3. Does no block of neighbouring range cells get sharper with phases of its own than noise explains?
4. How far apart are the phases of two halves of the range cells? This is the standard deviation.
5. Are the range profiles aligned (`displacement`)?
6. Does the unfocused part of the image get sharper with phases of its own (`gain_of_rest`)?
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import LARGEST_JITTER, LARGEST_MIGRATION, displacement
from torchsar.compensate.pulse_phase.data import (
    Pulses,
    by_blocks,
    on_the_circle,
    or_one,
    rotate,
    without_line,
)
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.homogeneous import describe, different_rows, occupied_band
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Through
from torchsar.compensate.pulse_phase.parts import gain_of_parts, gain_of_rest
from torchsar.compensate.pulse_phase.sharpness import scatter_of_point, sharpness_beyond_speckle, sharpness_of_noise
from torchsar.core import Estimate, Outcome, fft_lines, host_value, power_of, worst
from torchsar.metrics.phase import phase_rmse, residual_phase

# function that continues an autofocus method: (rows, indices of their trials, phase to start from)
# -> phase
Again = Callable[[Tensor, Tensor | slice, Tensor], Tensor]

# standard deviation in rad of a phase that is uniform over a turn
UNKNOWN_RAD = math.pi / math.sqrt(3)
LEAST_STREHL = 0.8  # Strehl ratio of a well-focused image, a convention (Marechal)


def conclude(
    pulses: Pulses,
    phase_rad: Tensor,
    iterations: Tensor,
    assess: bool,
    again: Again | None = None,
    through: Through | None = None,
) -> Estimate:
    """Make the estimate of phases that a method found, assessed or not.

    Args:
        pulses: The pulses.
        phase_rad: Phases that the method found in rad, shape (trial, pulse).
        iterations: Number of its iterations, shape (trial,).
        assess: Whether to assess the phases.
        again: Continues the method from a phase, on some of the rows; by default three iterations
            of the entropy fixed point (`settled`).
        through: Image formation that the method sharpens; by default a Fourier transform along
            pulses. With another one only the sharpness and the halves of the image are assessed.

    Returns:
        `phase_rad` of shape (..., pulse), zero with fewer than three pulses. If it is assessed, the
        standard deviation is half of the rms difference between the phases of two halves of the
        range cells, and at least the distance of their mean from the phase. It is divided by the
        square root of the share of the band that the data occupy. `quality` is the Strehl ratio
        that follows from it, times the share of the sharpness that noise does not explain.

        Outcomes: EMPTY; SINGULAR with fewer than three pulses; NOISE if the image is less than 1.5
        times as sharp as autofocus makes noise; INEXACT if the Strehl ratio is below 0.8;
        PARTS_DISAGREE if one of three blocks of range cells gets sharper with phases of its own by
        more than 2.2 times the sharpness of noise; AT_REST if the rest does, by more than 1.5 times
        that (`gain_of_rest`); HOMOGENEOUS; TOO_FEW if a single scatterer makes
        the sharpness and its modulus is not steady, or one gap takes more than 0.36 of the pulses;
        DISPLACED. Of a steady single scatterer the standard deviation is the scatter of its modulus
        and phase. `info` holds "present", shape (..., pulse), False for pulses of zeros; and, of
        shape (...,), "iterations", and if assessed "sharpness_nats", "noise_sharpness_nats",
        "gain_of_parts", "gain_of_rest", "jitter_cells" and "migration_cells".
    """
    trials, n = pulses.trials, pulses.n
    enough = pulses.present.sum(-1) >= 3
    value = {"phase_rad": torch.where(enough[:, None], phase_rad, 0).reshape(*trials, n)}
    info = {"present": pulses.present.reshape(*trials, n), "iterations": iterations.reshape(trials)}
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(info["iterations"]), info=info)
    if not len(pulses.rows) or n < 3:
        unknown = {"phase_rad": torch.full_like(value["phase_rad"], UNKNOWN_RAD)}
        outcome = Outcome.SINGULAR.like(info["iterations"])
        return Estimate(value, unknown, torch.zeros_like(outcome).to(phase_rad.dtype), outcome, info)
    rows, present, again = pulses.rows.detach(), pulses.present, again or settled
    seen = by_blocks(pulses, partial(_seen, rows, present, phase_rad.detach(), again, through), through is not None)
    sharp, noise, std, gain, rest, unsteady, homogeneous, jitter, migration = (x.reshape(trials) for x in seen)
    gap = longest_gap(pulses.present).reshape(trials)
    strehl = torch.exp(-std.square())
    outcome = worst(
        (Outcome.INEXACT, strehl <= LEAST_STREHL),
        # The gain was at most 2.2 in 99 % of the correct trials with 3 to 25 points. It exceeded
        # 2.4 in 90 % of the trials in which a vehicle as strong as 30 points moves independently.
        (Outcome.PARTS_DISAGREE, gain > 2.2),
        # The gain was at most 0.9 in correct trials with 1 to 100 points. It was at least 2.0 where
        # a constant, a tone or ground at rest is stronger than the target.
        (Outcome.AT_REST, rest > 1.5),
        (Outcome.HOMOGENEOUS, homogeneous > 0),
        # If a gap exceeds this fraction of the record, the phase between the pulses before and
        # after it cannot be determined in a scene of many points.
        (Outcome.TOO_FEW, (unsteady > 0) | (gap > 0.36)),
        (Outcome.DISPLACED, (jitter >= LARGEST_JITTER) | (migration >= LARGEST_MIGRATION)),
        # the prediction of the sharpness of noise is correct within 15 %
        (Outcome.NOISE, (sharp <= 1.5 * noise) & (homogeneous == 0)),
        (Outcome.EMPTY, ~present.any(-1).reshape(trials)),
        (Outcome.SINGULAR, ~enough.reshape(trials)),
    )
    beyond = (1 - noise / or_one(sharp)).clamp(0, 1)
    info |= {"sharpness_nats": sharp, "noise_sharpness_nats": noise, "gain_of_parts": gain, "gain_of_rest": rest}
    return Estimate(
        value,
        {"phase_rad": std[..., None].expand(*trials, n).to(phase_rad.dtype)},
        (strehl * beyond * (outcome < Outcome.SINGULAR)).to(phase_rad.dtype),
        outcome,
        {**info, "jitter_cells": jitter, "migration_cells": migration},
    )


def settled(rows: Tensor, which: Tensor | slice, phase: Tensor) -> Tensor:
    """Continue any method by three iterations of the entropy fixed point, see `Again`.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        which: Not used, since all trials are continued in the same way.
        phase: Phase to start from in rad, shape (trial, pulse).

    Returns:
        The phase in rad, shape (trial, pulse).
    """
    return fixed_point(rows, phase, Run(LogAbove(2.5), AlongPulses(), 3, 1.8, 0.0))[0]


def _seen(
    rows: Tensor, present: Tensor, phase: Tensor, again: Again, through: Through | None, part: slice
) -> tuple[Tensor, ...]:
    """Quantities of a block of trials from which the outcome follows, (trial,) each, float64.

    In this order: sharpness, sharpness of noise, standard deviation, gain of parts, gain of the
    rest, 1 where a single scatterer is not steady, 1 where the scene is homogeneous, jitter,
    migration.
    """
    which = torch.arange(len(rows), device=rows.device)[part]
    rows, present, phase = rows[part], present[part], phase[part]
    focused = rotate(rows, phase)
    image = torch.fft.fft(focused, norm="ortho") if through is None else through.image(focused).mT
    sharp, count, sharp_rows = sharpness_beyond_speckle(image)
    noise, zero = sharpness_of_noise(count.clamp_min(1)), torch.zeros_like(sharp)
    if through is not None:
        halves = halves_of_image(through, rows, phase)
        std = half_difference(halves, present, phase, partial(_from, again, which))
        return sharp, noise, std, *[zero] * 6
    spectrum = fft_lines(rows)
    band = occupied_band(spectrum)
    apart = half_difference(halves_of_rows(rows), present, phase, partial(_disturbed, again, which, present))
    jitter, migration = displacement(spectrum, present)
    scatter, rest = scatter_of_point(focused, present)
    # A scene counts as a single scatterer if one row makes the sharpness, or if the rows are side
    # lobes of one range. The motion of a single scatterer cannot be separated from a phase error,
    # and there are phases that focus several points into one. No phase changes the modulus,
    # however, and noise and weaker scatterers change it as much as the phase. The scatterer is
    # steady if the scatter of its modulus is far less than the 0.52 of noise.
    single = ((sharp_rows < 1.5) & (sharp > noise)) | (different_rows(rows, power_of(rows).sum(-1)) < 1.2)
    steady = (scatter < 0.25) & (present.sum(-1) >= 32) & (rows.shape[-2] > 1)
    return (
        sharp,
        noise,
        torch.where(single & steady, torch.hypot(scatter, rest), apart / band.sqrt()),
        gain_of_parts(rows, present, phase),
        gain_of_rest(rows, present, phase),
        (single & ~steady).double(),
        ((describe(rows, phase, band)[1] > 1) & ~single).double(),
        jitter,
        migration,
    )


def longest_gap(present: Tensor) -> Tensor:
    """Compute the length of the longest gap between the first and the last pulse.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        The share of the pulses from the first to the last that the gap takes, shape (trial,),
        float64; 0 without pulses.
    """
    number = torch.arange(1, present.shape[-1] + 1, device=present.device)
    last = torch.where(present, number, 0).cummax(-1).values
    first = torch.where(present, number, number[-1] + 1).amin(-1, keepdim=True)
    steps = torch.where(present[:, 1:] & (number[1:] > first), number[1:] - last[:, :-1], 1).amax(-1)
    span = (last[:, -1:] - first + 1)[:, 0]
    return torch.where(present.any(-1), (steps - 1).double() / or_one(span.double()), 0)


def halves_of_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Divide range cells, sorted by energy, alternately into two halves.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.

    Returns:
        The pulses of both halves.
    """
    order = power_of(rows).sum(-1).argsort(-1, descending=True)
    one, other = (
        rows.gather(1, order[:, part::2].sort(-1).values[..., None].expand(-1, -1, rows.shape[-1])) for part in (0, 1)
    )
    return one, other


def halves_of_image(through: Through, rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Divide pulses into those of two halves of their image.

    Range cells do not divide scatterers that migrate through them. Strips of four range lines of
    the image (fewer if there are less than eight), sorted by energy, are taken alternately.

    Args:
        through: Image formation.
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phases that focus them in rad, shape (trial, pulse).

    Returns:
        The pulses of both halves, of the shape of the rows.
    """
    image = through.image(rotate(rows, phase))
    lines = image.shape[-1]
    strip = torch.arange(lines, device=image.device) // max(1, min(4, lines // 2))
    energy = power_of(image).sum(-2)
    strips = energy.new_zeros(len(energy), int(strip[-1]) + 1).index_add_(1, strip, energy)
    place = strips.argsort(-1, descending=True).argsort(-1)[:, strip]
    one, other = (rotate(through.adjoint(torch.where(place[:, None] % 2 == half, image, 0)), -phase) for half in (0, 1))
    return one, other


def half_difference(
    halves: Sequence[Tensor],
    present: Tensor,
    phase: Tensor,
    continued: Callable[[Sequence[Tensor], Tensor], Sequence[Tensor]],
) -> Tensor:
    """Predict the error of phases from the difference between the phases of two halves.

    Args:
        halves: Rows of both, shape (trial, range of the half, pulse) each, complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phase of both together in rad, shape (trial, pulse).
        continued: Function of (halves, phase) that returns the phases of both.

    Returns:
        Half of the difference, and at least the distance of their mean from the phase, in rad rms,
        shape (trial,), float64; that of a random phase if a half is empty. Differences of more than
        2 rad count in full.
    """
    if not all(half.shape[-2] for half in halves):
        return torch.full_like(phase[:, 0], UNKNOWN_RAD, dtype=torch.float64)
    filled = torch.stack([(half != 0).flatten(1).any(-1) for half in halves]).all(0)
    one, other = continued(halves, phase)
    apart = residual_phase(one, other, present)
    moved = phase_rmse(one - apart / 2, phase, present)
    apart = torch.where(apart.abs() > 2, apart, apart / 2)
    apart = (apart.square().sum(-1) / present.sum(-1).clamp_min(1)).sqrt()
    return torch.where(filled, torch.maximum(apart, moved), UNKNOWN_RAD).double()


def _from(again: Again, which: Tensor, halves: Sequence[Tensor], phase: Tensor) -> Sequence[Tensor]:
    """Phases of both halves if the method continues from the phase of all rows."""
    return [again(half, which, phase) for half in halves]


def _disturbed(
    again: Again, which: Tensor, present: Tensor, halves: Sequence[Tensor], phase: Tensor
) -> Sequence[Tensor]:
    """Estimate the phases of the two halves again, from the phase plus and minus a fixed walk of
    0.4 rad rms, in at most two rounds.

    Components that the scene does not determine keep this difference. The others converge, also for
    weak targets.
    """
    walk = _walk(phase)
    ends: Sequence[Tensor] = (phase + walk, phase - walk)
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    for number in (1, 2):
        reached = [again(half, which, at) for half, at in zip(halves, ends, strict=True)]
        far = torch.stack([_moved(*pair, present) for pair in zip(reached, ends, strict=True)]) >= 0.04
        ends = [torch.where(active[:, None], new, old) for new, old in zip(reached, ends, strict=True)]
        active = active & far.any(0)
        if number < 2 and not host_value(active.any(), True):
            break
    return ends


def _moved(new: Tensor, old: Tensor, present: Tensor) -> Tensor:
    """Rms change of the phases (trial, pulse) in rad without its mean and its linear part,
    (trial,).
    """
    step = without_line(on_the_circle(new - old), present)
    return (torch.where(present, step, 0).square().sum(-1) / present.sum(-1).clamp_min(1)).sqrt()


def _walk(phase: Tensor) -> Tensor:
    """Fixed walk of the phase over the pulses without a linear part, 0.4 rad rms, (pulse,), the
    same in every trial.
    """
    pulse = torch.arange(phase.shape[-1], dtype=torch.float64, device=phase.device)
    # The steps do not repeat, because the angles are irrational multiples of the squared pulse
    # number.
    walk = torch.cos(math.pi * (math.sqrt(5) - 1) * pulse.square()).cumsum(-1)
    walk = without_line(walk, torch.ones_like(walk, dtype=torch.bool))
    return (0.4 / walk.square().mean().sqrt() * walk).to(phase.dtype)
