"""Sums of exponentials over targets, of which all echoes consist, in blocks that fit into the
cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from torchsar.core.nufft import Nufft
from torchsar.core.phase import check_resolution, linear_phasor, unit_phasor


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


def summed_by_transform(targets: int, n: int, device: torch.device | None = None, few: int = 64) -> bool:
    """Decide whether sums over targets are computed by a non-uniform FFT.

    On a processor it is as fast as the matrix product at 20 to 30 targets, and at 4,096 targets
    ten times as fast. Sums of few targets remain exact to rounding. Accelerators, on which the
    crossing was not measured, always use the matrix product.

    Args:
        targets: Number of targets.
        n: Number of steps.
        device: Device of the sum, None for a processor.
        few: Largest number of targets, and of steps, for the matrix product.

    Returns:
        True for the non-uniform FFT.
    """
    return (device is None or device.type == "cpu") and min(targets, n) > few


def row_bytes(targets: int, n: int, dtype: torch.dtype) -> int:
    """Return the size of the tables of a sum over targets for one row on a processor.

    Args:
        targets: Number of targets.
        n: Number of steps.
        dtype: Complex dtype of the sum.

    Returns:
        Size in bytes.
    """
    return dtype.itemsize * (
        25 * targets + 8 * n if summed_by_transform(targets, n) else 4 * targets * (1 + math.isqrt(n))
    )


class LineSum:
    """Sums of phasors of linear phase over targets.

    Few targets are summed by a matrix product of two tables (`line_tables`), which is exact to the
    working precision; many by a non-uniform FFT with an error of the order of that precision, -135
    dB for complex64. Neither needs an array of targets times steps.

    Args:
        turns: Cycles per step, shape (..., target), float64.
        n: Number of steps.
        first: Position of the first step.
        dtype: Complex dtype of the sums.
        by_transform: Whether to use the non-uniform FFT; None for the rule of
            `summed_by_transform`.

    Raises:
        ValueError: If the phase of a step exceeds 4e11 turns, see `unit_phasor`.
    """

    def __init__(
        self, turns: Tensor, n: int, first: float, dtype: torch.dtype, by_transform: bool | None = None
    ) -> None:
        self.n, self.start = n, None
        self.by_transform = (
            summed_by_transform(turns.shape[-1], n, turns.device) if by_transform is None else by_transform
        )
        if self.by_transform:
            check_resolution(max(-first, first + n) * turns)
            self.transform = Nufft(n, 1e-7 if dtype == torch.complex64 else 1e-13, dtype, turns.device)
            self.points = self.transform.points(turns)
            if first != -(n // 2):
                self.start = unit_phasor((first + n // 2) * turns, dtype)
        else:
            self.coarse, self.fine = line_tables(turns, n, first, dtype)

    def __call__(self, weight: Tensor) -> Tensor:
        """Compute sum_m weight_m exp(2j pi turns_m (i + first)) for i = 0, ..., n - 1.

        Args:
            weight: Complex weights, shape (..., target).

        Returns:
            Sums, shape (..., n).
        """
        if self.by_transform:
            return self.transform.type1(weight if self.start is None else weight * self.start, self.points)
        return ((self.coarse * weight[..., None]).mT @ self.fine).flatten(-2)[..., : self.n]


def echo_spectrum(
    delay_s: Tensor,
    carrier_turns: Tensor,
    weight: Tensor,
    n: int,
    step_hz: float,
    dtype: torch.dtype,
    by_transform: bool | None = None,
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
        by_transform: See `LineSum`.

    Returns:
        Spectrum in rising order of the frequency, shape (..., pulse, n).
    """
    lines = LineSum(-delay_s * step_hz, n, -(n // 2), dtype, by_transform)
    return lines(weight.to(dtype) * unit_phasor(-carrier_turns, dtype))
