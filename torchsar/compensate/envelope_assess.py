"""Assessment of range shifts of envelopes: their standard deviation from two halves of the band.

The speckle and the noise of the lower and the upper half of the band are independent. A half has
cells twice as wide, and half as many of them. The mean of both shifts therefore has twice the error
of the whole band, and their difference four to six times as much. Shifts of single pulses that are
not the likeliest ones also have an error by their distance from these.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.envelope_fit import Course, Envelopes, robust_std, single_shifts
from torchsar.core import Estimate, Outcome, worst, wrapped

# standard deviation of a shift in cells from which an alignment is inexact, a convention
GOOD_CELLS = 0.5
_LEAST_RANGE_CELLS = 4


def deviation(
    lines: Tensor, shift: Tensor, std: Tensor | None, find: Callable[[Envelopes], Course]
) -> tuple[Tensor, Tensor]:
    """Predict the deviation of shifts, by estimates from two halves of the band.

    Args:
        lines: Pulses, shape (trial, pulse, range), complex.
        shift: Their shifts in cells, shape (trial, pulse).
        std: Standard deviation of a polynomial by the scatter of its blocks, shape (trial,); None
            for the shifts of single pulses.
        find: The estimator, which returns shifts of envelopes.

    Returns:
        The standard deviation in cells, shape (trial,), and whether the halves confirm the shifts,
        of all but a twentieth of single pulses, bool, shape (trial,).
    """
    n = lines.shape[-1]
    if n < _LEAST_RANGE_CELLS:
        return shift.new_full(shift.shape[:1], n / math.sqrt(12)), torch.ones_like(shift[:, 0], dtype=torch.bool)
    half, present = n // 2, (lines != 0).any(-1)
    spectrum = torch.fft.fftshift(torch.fft.fft(lines), dim=-1)
    ends = (torch.fft.ifft(torch.fft.ifftshift(part, dim=-1)) for part in (spectrum[..., :half], spectrum[..., -half:]))
    lower, upper = (find(Envelopes.of(end))[0] * (n / half) for end in ends)
    phasor = torch.where(present, torch.polar(torch.ones_like(lower), 2 * math.pi / n * (lower - upper)), 0)
    apart = wrapped(lower - upper - torch.angle(phasor.sum(-1, keepdim=True)) * (n / (2 * math.pi)), n)
    # The ratio to the error of the whole band is 4 by the number and the width of the cells. It was
    # 4.5 to 6.5 in speckle and among points.
    apart = torch.where(present, apart, 0) / 5.0
    count = (present.sum(-1) - 1).clamp_min(1)
    if std is not None:
        agree = (apart.square().sum(-1) / count).sqrt() < GOOD_CELLS
        return (std.square() + 1e-6).sqrt(), agree & (std < GOOD_CELLS / 4)
    # a larger difference between the shifts of both halves of the band means that one of them was
    # found at a wrong maximum
    usual = 4.0 * robust_std(apart.abs(), present)
    agree = (apart.abs() > usual).sum(-1) <= 0.05 * count
    envelopes = Envelopes.of(lines)
    likeliest = single_shifts(envelopes, single_shifts(envelopes, shift, "likelihood", 3), "refined", 2)
    terms = torch.minimum(apart.abs(), usual).square() + torch.where(present, wrapped(likeliest - shift, n), 0).square()
    # without noise, the parabola through samples a quarter of a cell apart has an error of 1e-3
    # cells
    return (terms.sum(-1) / count + 1e-6).sqrt(), agree


def assessed(found: Estimate, std: Tensor, agree: Tensor, cells: int) -> Estimate:
    """Add the standard deviation, the quality and the outcome to shifts.

    Args:
        found: Estimate of `shift_cells`.
        std: Standard deviation in cells, shape (...,).
        agree: Whether halves of the band confirm the shifts, bool, shape (...,).
        cells: Number of range cells.

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    count, random = found.info["present"].sum(-1), cells / math.sqrt(12)
    std = torch.where(count < 2, random, std)
    outcome = worst(
        (Outcome.INEXACT, std >= GOOD_CELLS),
        (Outcome.PARTS_DISAGREE, ~agree),
        (Outcome.TOO_FEW, (count < 2) | (cells < _LEAST_RANGE_CELLS)),
        # In pure noise, a fitted polynomial has 0.6 of the standard deviation of random positions
        # in the window. Shifts of single pulses from both halves of the band have 0.28.
        (Outcome.NOISE, (std > 0.15 * random) & (count >= 2) & (cells >= _LEAST_RANGE_CELLS)),
        (Outcome.EMPTY, count == 0),
    )
    wide = std[..., None].expand_as(found["shift_cells"])
    return replace(found, std={"shift_cells": wide}, quality=1 / (1 + (std / GOOD_CELLS).square()), outcome=outcome)
