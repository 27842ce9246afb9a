"""Phases of two halves of the pulses, whose difference tells how wrong the phases of all are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import on_the_circle, without_line
from torchsar.core import host_value, power_of, true_positions
from torchsar.metrics.phase import phase_rmse, residual_phase

UNKNOWN_RAD = math.pi / math.sqrt(3)  # standard deviation of a random phase
# Difference of halves of the rows from which on a phase counts as unknown: half of the difference
# of uniformly distributed phases is half of their error. In normal errors of the largest standard
# deviation that is ok, 3 % of the differences are larger.
_APART_RAD = 2.0
# Phases from which halves of the rows start are apart by a walk of so many rad rms; they go on for
# so many rounds at most, until a round moves them by less than this. Found by trial: what the scene
# does not hold stays apart, and weak targets are found again.
_DISTURBED_RAD, _RETURNED_RAD, _RETURNS = 0.4, 0.04, 6
EVERY = slice(None)

# continues a method: (rows, which of the trials that it found these are, phase) -> phase
Which = Tensor | slice
Again = Callable[[Tensor, Which, Tensor], Tensor]
Halves = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def halves_of_rows(rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Divide the rows, sorted by energy, alternately into two halves.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase in rad, shape (trial, pulse); not used.

    Returns:
        Both halves, shape (trial, range of the half, pulse).
    """
    order = power_of(rows).sum(-1).argsort(-1, descending=True)
    one, other = (
        rows.gather(1, order[:, part::2].sort(-1).values[..., None].expand(-1, -1, rows.shape[-1])) for part in (0, 1)
    )
    return one, other


def half_difference(
    rows: Tensor, present: Tensor, phase: Tensor, again: Again, halves: Halves, disturbed: bool, which: Tensor | None
) -> Tensor:
    """Predict the error of phases from the difference between two halves of the pulses.

    It is at least the distance of their mean from the phase, and pi / sqrt(3), as for a random
    phase, if there is only one row or a half is empty.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phase in rad of all rows, shape (trial, pulse).
        again: Continues the method.
        halves: Divides the pulses.
        disturbed: True if the halves start on either side of the phase (see `settled_apart`).
        which: True for the trials to examine, shape (trial,); None for all.

    Returns:
        The standard deviation in rad, shape (trial,), float64; 0 for trials not examined.
    """
    if rows.shape[-2] < 2:
        return torch.full_like(phase[:, 0], UNKNOWN_RAD, dtype=torch.float64)
    std = torch.zeros_like(phase[:, 0], dtype=torch.float64)
    count = len(std) if which is None else host_value(which.sum(), len(std))
    if not count:
        return std
    at = EVERY if which is None or count == len(std) else true_positions(which, count)
    present, phase = present[at], phase[at]
    parts = halves(rows[at], phase)
    if disturbed:
        ends = settled_apart(parts, present, phase, again, at)
    else:
        ends = [again(part, at, phase) for part in parts]
    apart = half_of(parts, ends, phase, present)
    apart = apart if isinstance(at, slice) else std.index_copy(0, at, apart)
    return apart if which is None else torch.where(which, apart, 0)


def half_of(parts: Sequence[Tensor], ends: Sequence[Tensor], phase: Tensor, present: Tensor) -> Tensor:
    """Take half of the difference between the phases of two halves as the error of both.

    Args:
        parts: Pulses of both halves, shape (trial, range of the half, pulse) each, complex.
        ends: Phases of both halves in rad, shape (trial, pulse) each.
        phase: Phase of both together in rad, shape (trial, pulse).
        present: False where a pulse holds only zeros, shape (trial, pulse).

    Returns:
        Half of the difference, or the distance of their mean from the phase if that is more, in
        rad rms, shape (trial,), float64; that of a random phase if a half is empty. Differences of
        more than 2 rad count in full.
    """
    filled = torch.stack([(part != 0).flatten(1).any(-1) for part in parts]).all(0)
    one, other = ends
    apart = residual_phase(one, other, present)
    moved = phase_rmse(one - apart / 2, phase, present)
    apart = torch.where(apart.abs() > _APART_RAD, apart, apart / 2)
    apart = (apart.square().sum(-1) / present.sum(-1).clamp_min(1)).sqrt()
    return torch.where(filled, torch.maximum(apart, moved), UNKNOWN_RAD)


def settled_apart(
    parts: Sequence[Tensor], present: Tensor, phase: Tensor, again: Again, which: Which
) -> Sequence[Tensor]:
    """Continue the method on two halves from phases on either side of that of both.

    Args:
        parts: Pulses of both halves, shape (trial, range of the half, pulse) each, complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phase of both together in rad, shape (trial, pulse).
        again: Continues the method.
        which: Which of the trials of the method these are.

    Returns:
        Phases of both halves in rad, shape (trial, pulse) each: from a walk of 0.4 rad about the
        phase, until a round moves them by less than 0.04 rad or six rounds are over.
    """
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


def _disturbance(phase: Tensor) -> Tensor:
    """Walk of phases in rad without a straight line, (pulse,): the same in every trial."""
    pulse = torch.arange(phase.shape[-1], dtype=torch.float64, device=phase.device)
    # steps that repeat nowhere: the angles are irrational parts of a turn times squares
    walk = torch.cos(math.pi * (math.sqrt(5) - 1) * pulse.square()).cumsum(-1)
    place = pulse - pulse.mean()
    walk = walk - walk.mean()
    walk = walk - place * (walk @ place) / place.square().sum()
    return (_DISTURBED_RAD / walk.square().mean().sqrt() * walk).to(phase.dtype)
