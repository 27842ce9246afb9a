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

# distance from the peak, in cells, within which the slope of a sinc is computed from its series:
# the error of either form is below 1e-10 there
_NEAR = 1e-4


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
    open_ended, periodic = _sinc(row, cells), _periodic(row, cells)
    value, slope = (x + share[:, None, None] * (y - x) for x, y in zip(open_ended, periodic))
    return Envelopes(value, slope, periodic[0] - open_ended[0])


def _sinc(row: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """A sinc about each row, and its derivative with respect to the row, (..., cells)."""
    x = torch.arange(cells, dtype=row.dtype, device=row.device) - row[..., None]
    value = torch.sinc(x)
    near = x.abs() < _NEAR
    safe = torch.where(near, 1, x)
    slope = torch.where(near, math.pi**2 / 3 * x, (value - torch.cos(math.pi * x)) / safe)
    return value.to(torch.complex128), slope.to(torch.complex128)


def _periodic(row: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """Mean of the FFT frequencies of `cells` samples about each row, and its derivative."""
    frequency = 2 * math.pi * (torch.arange(cells, dtype=row.dtype, device=row.device) - cells // 2) / cells
    angle = row[..., None] * -frequency
    phasor = torch.polar(torch.ones_like(angle), angle) / cells
    angle = torch.outer(frequency, torch.arange(cells, dtype=row.dtype, device=row.device))
    lines = torch.polar(torch.ones_like(angle), angle)
    return phasor @ lines, (phasor * (-1j * frequency)) @ lines
