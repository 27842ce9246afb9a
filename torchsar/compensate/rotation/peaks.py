"""Detection of bright scatterers in an image.

They are local maxima above the noise and above the side lobes of their neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad


@dataclass(frozen=True)
class Peaks:
    """Peaks of an image, brightest first.

    Args:
        power: Power, shape (trial, peak); 0 in the places that a trial with fewer peaks does not
            fill.
        line: Image line, shape (trial, peak), int64.
        cell: Range cell, shape (trial, peak), int64.
    """

    power: Tensor
    line: Tensor
    cell: Tensor


def noise_power(power: Tensor) -> Tensor:
    """Estimate the mean power of circular Gaussian noise in an image from the median of its power.

    Assumes that scatterers leave most of the image empty.

    Args:
        power: Power of the image, shape (trial, line, range).

    Returns:
        The noise power, shape (trial,).
    """
    every = power.flatten(1)
    # of 65536 pixels: its error is then below a percent
    return every[:, :: max(1, every.shape[-1] // (1 << 16))].median(-1).values / math.log(2)


def threshold(pixels: int) -> float:
    """Compute the detection threshold that noise alone exceeds in about one of ten images.

    Args:
        pixels: Number of pixels of an image.

    Returns:
        The threshold, as a ratio of power to mean noise power.
    """
    return math.log(pixels) + 2.5


def find_peaks(power: Tensor, floor: Tensor, count: int, share: float, lines: int, cells: int) -> Peaks:
    """Find local maxima of an image above the noise.

    A maximum that is weak compared with the brightest pixel near it is left out, because it may be
    a side lobe. Weak scatterers near strong ones are thus found only after the strong ones are
    subtracted from the data.

    Args:
        power: Power of the image, shape (trial, line, range).
        floor: Least power of a peak, shape (trial,).
        count: Largest number of peaks.
        share: Least amplitude of a peak, as a fraction of the largest amplitude in its
            neighbourhood.
        lines: Half width of the neighbourhood in lines.
        cells: Half width of the neighbourhood in range cells.

    Returns:
        The peaks.
    """
    n_line, n_cell = power.shape[1:]
    along, across = pad(power, (0, 0, 1, 1)), pad(power, (1, 1, 0, 0))
    maximum = (
        (power >= along[:, :-2]) & (power > along[:, 2:]) & (power >= across[..., :-2]) & (power > across[..., 2:])
    )
    maxima = torch.where(maximum & (power > floor[:, None, None]), power, 0).flatten(1)
    # four local maxima are examined for each peak that is wanted, found by trial
    level, index = maxima.topk(min(4 * count, maxima.shape[-1]), -1)
    line, cell = index // n_cell, index % n_cell
    offsets = torch.cartesian_prod(
        torch.arange(-lines, lines + 1, device=power.device), torch.arange(-cells, cells + 1, device=power.device)
    )
    near_line, near_cell = line[..., None] + offsets[:, 0], cell[..., None] + offsets[:, 1]
    inside = (near_line >= 0) & (near_line < n_line) & (near_cell >= 0) & (near_cell < n_cell)
    near = torch.gather(
        power.flatten(1), 1, (near_line.clamp(0, n_line - 1) * n_cell + near_cell.clamp(0, n_cell - 1)).flatten(1)
    ).view(inside.shape)
    around = torch.where(inside, near, 0).amax(-1)
    kept = torch.where((level > 0) & (level >= share**2 * around), level, 0)
    found, order = kept.topk(min(count, kept.shape[-1]), -1)
    return Peaks(found, torch.gather(line, 1, order), torch.gather(cell, 1, order))
