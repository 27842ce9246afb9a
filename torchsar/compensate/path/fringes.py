"""Whole half wavelengths of the line of sight: fringes, which the phases of pulses leave open."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import wrapped

# by choice: most standard deviations by which a measurement of a smooth line of sight counts; one
# of a rough line is wrong if its distance from the median exceeds 6 times the median distance and 2
# fringes
_MOST_STD, _FAR, _FAR_FRINGES = 3.0, 6.0, 2.0


def roughness(carrier_m: Tensor, fringe_m: float) -> Tensor:
    """Measure the bends of the line of sight from pulse to pulse, as far as phases show them.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (..., pulse).
        fringe_m: Half a wavelength in metres.

    Returns:
        Rms of the second differences, reduced to the nearest fringe, over that of arbitrary ones,
        shape (...,): 1 for rough motion, which says nothing about fringes.
    """
    bends = wrapped(carrier_m.diff(n=2, dim=-1), fringe_m)
    return bends.square().mean(-1).sqrt() * (math.sqrt(12) / fringe_m)


def smoothest(carrier_m: Tensor, fringe_m: float) -> Tensor:
    """Choose fringes so that all second differences are below half a fringe.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (..., pulse).
        fringe_m: Half a wavelength in metres.

    Returns:
        Line of sight in metres, up to a constant and a linear term, shape (..., pulse).
    """
    bends = wrapped(carrier_m.diff(n=2, dim=-1), fringe_m)
    first = wrapped(carrier_m[..., 1:2] - carrier_m[..., :1], fringe_m)
    steps = torch.cat([first, first + bends.cumsum(-1)], -1)
    return torch.cat([carrier_m[..., :1], carrier_m[..., :1] + steps.cumsum(-1)], -1)


def smooth_near(
    carrier_m: Tensor,
    near_m: Tensor,
    before_m: Tensor,
    fringe_m: float,
    near_std_m: float,
    bend_std_m: Tensor,
    reach: int = 6,
) -> Tensor:
    """Choose fringes of a smooth line of sight, given a rough measurement of it.

    The Viterbi algorithm minimises the sum of the squared differences from the measurement and of
    the squared second differences, each over its variance. A measurement of one pulse may be wrong
    by any amount: fringes are sought about the median of what it and its neighbours add to the line
    of sight that was known before, and a difference counts by at most three standard deviations.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (trial, pulse).
        near_m: Measured line of sight in metres, shape (trial, pulse).
        before_m: Line of sight known before the measurement in metres, shape (trial, pulse).
        fringe_m: Half a wavelength in metres.
        near_std_m: Standard deviation of the measurement in metres.
        bend_std_m: Standard deviation of the second differences in metres, shape (trial,).
        reach: Largest number of fringes from the median.

    Returns:
        Line of sight in metres, shape (trial, pulse).
    """
    n = fringe_m * torch.arange(-reach, reach + 1, dtype=carrier_m.dtype, device=carrier_m.device)
    about = before_m + _local_median(near_m - before_m)
    places = (carrier_m + fringe_m * torch.round((about - carrier_m) / fringe_m))[..., None] + n
    far = ((places - near_m[..., None]) / near_std_m).square().clamp_max(_MOST_STD**2)
    weight = bend_std_m.clamp_min(1e-3 * fringe_m)[:, None, None, None].square().reciprocal()
    cost, back = far[:, 0, :, None] + far[:, 1, None, :], []  # (trial, last but one, last)
    for p in range(2, places.shape[1]):
        here, before, earlier = (places[:, p - i] for i in range(3))
        bend = here[:, None, None] - 2 * before[:, None, :, None] + earlier[:, :, None, None]
        total, chosen = (cost[..., None] + weight * bend.square()).min(1)
        cost = total + far[:, p, None, :]
        back.append(chosen)
    best = cost.flatten(1).argmin(-1)
    path = [best % len(n), best // len(n)]
    rows = torch.arange(len(cost), device=cost.device)
    for chosen in reversed(back):
        path.append(chosen[rows, path[-1], path[-2]])
    return places.gather(-1, torch.stack(path[::-1], -1)[..., None])[..., 0]


def rough_near(carrier_m: Tensor, near_m: Tensor, before_m: Tensor, fringe_m: float) -> Tensor:
    """Replace measurements of a rough line of sight that lie far from those of their neighbours.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (trial, pulse).
        near_m: Measured line of sight in metres, shape (trial, pulse).
        before_m: Line of sight known before the measurement in metres, shape (trial, pulse). What
            a measurement adds to it is compared.
        fringe_m: Half a wavelength in metres.

    Returns:
        The measurements; where they lie six times as far from the median of their neighbours as
        usual, and two fringes or more, the place of the carrier that is nearest to that median.
    """
    median = before_m + _local_median(near_m - before_m)
    apart = (near_m - median).abs()
    limit = (_FAR * apart.median(-1, keepdim=True).values).clamp_min(_FAR_FRINGES * fringe_m)
    return torch.where(apart > limit, median + wrapped(carrier_m - median, fringe_m), near_m)


def _local_median(x: Tensor) -> Tensor:
    """Median of each value (trial, pulse) and its neighbours; at the ends of the nearest ones.

    There are 25 of them: at the ends of recordings ten envelopes in a row were wrong.
    """
    pulses = x.shape[-1]
    width = min(25, pulses)
    medians = x.unfold(-1, width, 1).median(-1).values
    at = torch.arange(pulses, device=x.device) - width // 2
    return medians[..., at.clamp(0, pulses - width)]
