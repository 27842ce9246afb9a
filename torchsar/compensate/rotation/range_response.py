"""Range response of range-compressed pulses of which it is not known how the samples were taken.

The band of the pulses is flat and fills the sampled band. Two responses are then possible, and they
agree near their peak. Where a pulse of finite length is compressed as a whole, the response is a
sinc, whose side lobes leave the range window. Where the window is a Fourier transform of as many
samples as it has cells, the side lobes return at the other end of the window. Cropped windows lie
between the two. The response of a recording is therefore described as a mixture of the two, and
the share of the periodic one is found from the data.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.core import cis


class Envelopes(NamedTuple):
    """Range responses to scatterers.

    Args:
        value: Response in each range cell, of unit peak, shape (trial, scatterer, range),
            complex128.
        slope: Its derivative with respect to the range of the scatterer in cells, same shape.
        difference: Its derivative with respect to the share of the periodic response, same shape.
    """

    value: Tensor
    slope: Tensor
    difference: Tensor


def envelopes(share: Tensor, row: Tensor, cells: int) -> Envelopes:
    """Compute the responses to scatterers in all range cells.

    Args:
        share: Share of the periodic response, from 0 to 1, shape (trial,), float64; the rest is
            that of a sinc.
        row: Range of the scatterers in range cells, shape (trial, scatterer), float64.
        cells: Number of range cells of the window.

    Returns:
        The responses.
    """
    cell = torch.arange(cells, dtype=row.dtype, device=row.device)
    x = cell - row[..., None]
    sinc, near = torch.sinc(x), x.abs() < 1e-4
    # near the peak the slope follows from the series: the error of either form is below 1e-10
    slope = torch.where(near, math.pi**2 / 3 * x, (sinc - torch.cos(math.pi * x)) / torch.where(near, 1, x))
    # the periodic response is the mean of the FFT frequencies of as many samples
    frequency = 2 * math.pi * (cell - cells // 2) / cells
    phasor, lines = cis(row[..., None] * -frequency) / cells, cis(torch.outer(frequency, cell))
    periodic = phasor @ lines
    difference = periodic - sinc
    weight = share[:, None, None]
    return Envelopes(
        sinc + weight * difference, slope + weight * ((phasor * (-1j * frequency)) @ lines - slope), difference
    )
