"""Window over range and kernel over cross range of the tile imager, with their errors."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

# fineness of the nodes over cross range relative to the band of a tile, by choice
CROSS_OVERSAMPLING = 1.5
# width and guard of the windows, and taps of the kernels, that are offered
_RISES = range(4, 65, 2)
_TAPS = range(3, 13)
# ridge of the fit of the nodes; beta relative to that of a kernel whose band just ends at the
# oversampling, found by trial; 1 - u^2 below which the slope of the kernel is cut
_RIDGE, _SHARPNESS, _EDGE = 1e-13, 0.96, 1e-12


def spread_kernel(x: Tensor, taps: int) -> Tensor:
    """Kernel exp(beta (sqrt(1 - u^2) - 1)) with u = 2 x / taps; 0 beyond half its width.

    Args:
        x: Distance from the centre in nodes, any shape.
        taps: Width in nodes.

    Returns:
        Values of at most 1, same shape and precision.

    Reference:
        Barnett et al. 2019.
    """
    beta = _SHARPNESS * math.pi * taps * (1 - 0.5 / CROSS_OVERSAMPLING)
    inside = 1 - (x * (2 / taps)).square()
    return torch.exp(beta * (inside.clamp_min(_EDGE).sqrt() - 1)) * (inside >= 0)


def node_values(at: Tensor, nodes: int, taps: int) -> Tensor:
    """Matrix that gives the values of the nodes from samples of a function of the position.

    The sum of the node values, weighted by the kernel at their distance from any position, is the
    function at this position, in the least-squares sense over the samples. It replaces the division
    by the spectrum of the kernel, holds for any smooth function and up to the last position.

    Args:
        at: Positions of the samples in nodes, shape (sample,), float64; the first node is 0.
        nodes: Number of nodes.
        taps: Width of the kernel in nodes.

    Returns:
        Matrix (node, sample), float64.
    """
    kernel = spread_kernel(at[:, None] - torch.arange(nodes, dtype=at.dtype, device=at.device), taps)
    normal = kernel.mT @ kernel
    normal.diagonal().add_(_RIDGE * normal.diagonal().max())
    return torch.linalg.solve(normal, kernel.mT)


@functools.cache
def kernel_error(taps: int) -> float:
    """Compute the error of phasors between nodes, over all frequencies of the band of a tile.

    Args:
        taps: Width of the kernel in nodes.

    Returns:
        Rms error relative to 1.
    """
    nodes, turns = 32, torch.linspace(-0.5, 0.5, 41, dtype=torch.float64) / CROSS_OVERSAMPLING
    low, high = taps / 2, nodes - 1 - taps / 2

    def phasors(count: int) -> tuple[Tensor, Tensor]:
        at = torch.linspace(low, high, count, dtype=torch.float64)
        return at, torch.exp(2j * math.pi * at[:, None] * turns)

    at, values = phasors(3 * nodes)
    found = node_values(at, nodes, taps).to(values.dtype) @ values
    between, truth = phasors(7 * nodes + 1)
    kernel = spread_kernel(between[:, None] - torch.arange(nodes, dtype=torch.float64), taps)
    return float((kernel.to(values.dtype) @ found - truth).abs().square().mean().sqrt())


def window_slope(rise: int, guard: float) -> Tensor:
    """Smooth rise of a window over range from 0 to 1.

    It is the integral of a Kaiser-Bessel function whose spectrum ends in the guard band.

    Args:
        rise: Number of samples.
        guard: Share of the band without signal, 0 to 1.

    Returns:
        Weights (rise,), float64.
    """
    u = torch.linspace(-1, 1, 2049, dtype=torch.float64)
    density = torch.special.i0(math.pi * rise * guard / 2 * (1 - u.square()).clamp_min(0).sqrt())
    total = torch.cat([density.new_zeros(1), ((density[1:] + density[:-1]) / 2).cumsum(0)])
    at = (torch.arange(rise, dtype=torch.float64) + 0.5) / rise * (len(u) - 1)
    below = at.long()
    return (total[below] + (at - below) * (total[below + 1] - total[below])) / total[-1]


@functools.cache
def window_error(rise: int, guard: float) -> float:
    """Compute the error of a signal between the samples in the flat part of a window.

    Args:
        rise: Samples of either slope.
        guard: Share of the band without signal, 0 to 1.

    Returns:
        Rms error relative to 1.
    """
    flat = 24
    slope = window_slope(rise, guard)
    weights = torch.cat([slope, slope.new_ones(flat), slope.flip(0)])
    m = torch.arange(flat + 2 * rise, dtype=torch.float64) - flat / 2 - rise
    turns = torch.linspace(-(1 - guard) / 2, (1 - guard) / 2, 41, dtype=torch.float64)
    at = torch.linspace(-flat / 2 + 0.5, flat / 2 - 0.5, 53, dtype=torch.float64)
    length = flat + rise
    j = torch.arange(length, dtype=torch.float64) - length // 2
    signal = torch.exp(2j * math.pi * turns[:, None] * m) * weights
    spectrum = signal @ torch.exp(-2j * math.pi * m[:, None] * j / length) / length
    found = spectrum @ torch.exp(2j * math.pi * j[:, None] * at / length)
    return float((found - torch.exp(2j * math.pi * turns[:, None] * at)).abs().square().mean().sqrt())


def taps_for(error: float) -> int | None:
    """Find the narrowest kernel for an error.

    Args:
        error: Largest rms error relative to 1.

    Returns:
        Width in nodes, None if no kernel meets the error.
    """
    return next((taps for taps in _TAPS if kernel_error(taps) <= error), None)


def rise_for(error: float, guard: float) -> int | None:
    """Find the shortest slope of a window for an error.

    Args:
        error: Largest rms error relative to 1.
        guard: Share of the band without signal, 0 to 1.

    Returns:
        Samples of either slope, None if no window meets the error.
    """
    if guard <= 0:
        return None
    return next((rise for rise in _RISES if window_error(rise, guard) <= error), None)
