"""Sums of exponentials over targets, of which all echoes consist, in blocks that fit into the
cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor


def blocks(n: int, bytes_each: float, cache_bytes: int = 8 << 20, most: int | None = None) -> Iterator[slice]:
    """Yield slices of rows whose tables fit the cache of a processor.

    Let `bytes_each` be independent of the number of trials, so that sums round equally in batches
    of every size.

    Args:
        n: Number of rows.
        bytes_each: Size of the tables of one row in bytes.
        cache_bytes: Size of the tables of a block in bytes.
        most: Largest number of rows of a block, None for no limit.

    Yields:
        Slices that cover the rows.
    """
    height = max(1, min(most or n, int(cache_bytes // max(1, bytes_each))))
    for first in range(0, n, height):
        yield slice(first, min(first + height, n))


def line_tables(turns: Tensor, n: int, first: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Factor exp(2j pi turns (i + first)), i = 0, ..., n - 1, into a coarse and a fine table.

    Args:
        turns: Cycles per step, shape (..., target), float64.
        n: Number of steps.
        first: Position of the first step.
        dtype: Complex dtype of the tables.

    Returns:
        Coarse table, shape (..., target, ceil(n / m)), and fine table, shape (..., target, m).
    """
    m = 2 ** round(math.log2(max(n, 1)) / 2)
    return linear_phasor(m * turns, first / m, -(-n // m), dtype), linear_phasor(turns, 0, m, dtype)


def line_sum(tables: tuple[Tensor, Tensor], weight: Tensor, n: int) -> Tensor:
    """Compute sum_m weight_m exp(2j pi turns_m (i + first)) by a matrix product of two tables.

    This is exact to the working precision and needs no array of targets times steps.

    Args:
        tables: Coarse and fine table of `line_tables`.
        weight: Complex weights, shape (..., target).
        n: Number of steps.

    Returns:
        Sums, shape (..., n).
    """
    coarse, fine = tables
    return ((coarse * weight[..., None]).mT @ fine).flatten(-2)[..., :n]


def echo_spectrum(
    delay_s: Tensor, carrier_turns: Tensor, weight: Tensor, n: int, step_hz: float, dtype: torch.dtype
) -> Tensor:
    """Return the range spectrum of a sum of delayed echoes.

    The spectrum is the sum over targets of weight exp(-2j pi (carrier_turns + f delay_s)) at the
    frequencies f = i step_hz with i = -(n // 2), ..., n - n // 2 - 1. Differentiable.

    Args:
        delay_s: Delay in seconds, shape (..., pulse, target), float64.
        carrier_turns: Phase of the carrier in cycles, shape (..., pulse, target), float64.
        weight: Complex weight, broadcastable to (..., pulse, target).
        n: Number of frequencies.
        step_hz: Step of the frequencies in hertz.
        dtype: Complex dtype of the result.

    Returns:
        Spectrum in rising order of the frequency, shape (..., pulse, n).
    """
    tables = line_tables(-delay_s * step_hz, n, -(n // 2), dtype)
    return line_sum(tables, weight.to(dtype) * unit_phasor(-carrier_turns, dtype), n)
