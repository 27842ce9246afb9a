"""Window over range and kernel over cross range of the tile imager, with their errors, and
polynomial interpolation between known values.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from torchsar.core.fft import smooth_length

# Density of the nodes over cross range relative to the band of a tile, by choice. A density of 2
# has a third more nodes, and 1.25 needs wider kernels.
CROSS_OVERSAMPLING = 1.5
# Slopes of the windows in samples, and taps of the kernels, that are available. They reach the
# errors that double precision and the fit of the nodes allow.
_RISES = range(4, 65, 2)
_TAPS = range(3, 13)
# Number of frequencies, in cycles, at which the errors of kernels and windows are tabulated. It is
# dense enough for the steep rise of the errors at the edge of a band, where most of their power is.
_ENTRIES = 97
# Distances in samples from the last flat sample of a window at which its error is tabulated. A
# pixel may lie up to one sample beyond it.
_DISTANCES = 0.5 * torch.arange(50, dtype=torch.float64, device="cpu") - 0.75
# _RIDGE: regularisation of the node fit, above the rounding of double precision.
# _SHARPNESS: beta relative to that of a kernel whose band just ends at the oversampling, found by
# trial.
# _EDGE: least 1 - u^2 for gradients, because the slope of the kernel is infinite at its end.
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
def _kernel_squares(taps: int) -> Tensor:
    """Mean square errors of phasors between nodes, (turn,).

    They are tabulated at `_ENTRIES` equally spaced frequencies, in cycles per node, over the band
    of a tile.
    """
    nodes, turns = 32, torch.linspace(-0.5, 0.5, _ENTRIES, dtype=torch.float64) / CROSS_OVERSAMPLING
    low, high = taps / 2, nodes - 1 - taps / 2

    def phasors(count: int) -> tuple[Tensor, Tensor]:
        at = torch.linspace(low, high, count, dtype=torch.float64)
        return at, torch.exp(2j * math.pi * at[:, None] * turns)

    at, values = phasors(3 * nodes)
    found = node_values(at, nodes, taps).to(values.dtype) @ values
    between, truth = phasors(7 * nodes + 1)
    kernel = spread_kernel(between[:, None] - torch.arange(nodes, dtype=torch.float64), taps)
    return (kernel.to(values.dtype) @ found - truth).abs().square().mean(0)


def _shares(at: Tensor, first: float, last: float, entries: int, weight: Tensor | None = None) -> Tensor:
    """Shares of the positions that are nearest to each of some equally spaced entries of
    a table.
    """
    entry = ((at.flatten() - first) * ((entries - 1) / (last - first))).round().long().clamp(0, entries - 1)
    count = torch.bincount(entry, None if weight is None else weight.flatten(), minlength=entries)
    return count.to(torch.float64) / count.sum()


def kernel_error(taps: int, turns: Tensor, weight: Tensor) -> float:
    """Compute the error of phasors between nodes.

    Args:
        taps: Width of the kernel in nodes.
        turns: Turns per node of a sample of phasors, at most 0.5 / `CROSS_OVERSAMPLING` in size,
            any shape.
        weight: Their weights, whose sum is 1, same shape.

    Returns:
        Rms error relative to 1.
    """
    edge = 0.5 / CROSS_OVERSAMPLING
    return math.sqrt(float(_kernel_squares(taps) @ _shares(turns, -edge, edge, _ENTRIES, weight)))


def window_length(reach: float, rise: int) -> int:
    """Return the length of the spectrum of a window, an even number without prime factors above 5.

    Args:
        reach: Largest distance of a pixel from the middle of the window in samples.
        rise: Samples of either slope.

    Returns:
        Number of samples from the middle of one slope to that of the other.
    """
    return 2 * smooth_length(math.ceil((2 * reach + 1 + rise) / 2))


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
def _window_squares(rise: int, guard: float) -> Tensor:
    """Square errors of a signal between the samples of a window near the end of its flat part.

    They are tabulated at `_ENTRIES` equally spaced turns per sample over the band outside the
    guard, and at `_DISTANCES` from the last flat sample, (turn, distance). Signals at a wave number
    of the spectrum have no error, so that two lengths are averaged.
    """
    turns = torch.linspace(-0.5, 0.5, _ENTRIES, dtype=torch.float64)[:, None] * (1 - guard)
    slope, found = window_slope(rise, guard), torch.zeros(_ENTRIES, len(_DISTANCES), dtype=torch.float64)
    # two lengths of the flat part, with the largest tabulated distance in its middle
    for flat in (len(_DISTANCES), len(_DISTANCES) + 2):
        length = flat + rise
        weights = torch.cat([slope, slope.new_ones(flat), slope.flip(0)])
        m = torch.arange(flat + 2 * rise, dtype=torch.float64) - flat / 2 - rise
        j = torch.arange(length, dtype=torch.float64) - length // 2
        at = flat / 2 - 1 - _DISTANCES
        between = weights[:, None] * torch.exp(-2j * math.pi / length * m[:, None] * j)
        between = between @ torch.exp(2j * math.pi / length * j[:, None] * at) / length
        error = torch.exp(2j * math.pi * turns * m) @ between - torch.exp(2j * math.pi * turns * at)
        found += error.abs().square() / 2
    return found


def window_error(rise: int, guard: float, turns: Tensor, away: Tensor, reach: float) -> float:
    """Compute the error of a signal between the samples in the flat part of a window.

    Args:
        rise: Samples of either slope.
        guard: Share of the band without signal, 0 to 1.
        turns: Turns per sample of a sample of signals, at most (1 - guard) / 2 in size, any shape.
        away: Distances from the middle of the window in samples, of a sample of pixels, any shape.
        reach: Largest distance in samples.

    Returns:
        Rms error relative to 1.
    """
    edge = (1 - guard) / 2
    flat = window_length(reach, rise) - rise
    # windows begin at whole samples, so that pixels lie at fractions of a sample
    at = away.flatten()[:, None] + torch.tensor([-0.375, -0.125, 0.125, 0.375], dtype=torch.float64)
    # both ends contribute their error
    far = torch.cat([flat / 2 - 1 - at, flat / 2 + at])
    by_turns = _window_squares(rise, guard) @ _shares(far, float(_DISTANCES[0]), float(_DISTANCES[-1]), len(_DISTANCES))
    return math.sqrt(2 * float(_shares(turns, -edge, edge, _ENTRIES) @ by_turns))


def taps_for(error: float, turns: Tensor, weight: Tensor) -> int | None:
    """Find the narrowest kernel for an error.

    Args:
        error: Largest rms error relative to 1.
        turns: Turns per node, see `kernel_error`.
        weight: Their weights.

    Returns:
        Width in nodes, None if no kernel meets the error.
    """
    return next((taps for taps in _TAPS if kernel_error(taps, turns, weight) <= error), None)


def rise_for(error: float, guard: float, turns: Tensor, away: Tensor, reach: float) -> int | None:
    """Find the shortest slope of a window for an error.

    Args:
        error: Largest rms error relative to 1.
        guard: Share of the band without signal, 0 to 1.
        turns: Turns per sample, see `window_error`.
        away: Distances from the middle of the window in samples.
        reach: Largest distance in samples.

    Returns:
        Samples of either slope, None if no window meets the error.
    """
    if guard <= 0:
        return None
    return next((rise for rise in _RISES if window_error(rise, guard, turns, away, reach) <= error), None)


def interpolation(wanted: Tensor, known: int) -> tuple[Tensor, Tensor]:
    """Interpolate a function between as many positions as are known.

    Values at all wanted positions are taken as they are where no more are wanted than known.
    Otherwise they are those of the polynomial through the values at Chebyshev points.

    Args:
        wanted: Positions, float64 (wanted,).
        known: Number of positions at which values are known.

    Returns:
        These positions, float64 (known,), and the matrix from the values there to those at the
        positions wanted, (wanted, known).
    """
    if known >= len(wanted):
        return wanted, torch.eye(len(wanted), dtype=wanted.dtype, device=wanted.device)
    half, middle = (wanted.max() - wanted.min()) / 2, (wanted.max() + wanted.min()) / 2
    number = torch.arange(known, dtype=wanted.dtype, device=wanted.device)
    angle = (number + 0.5) * (math.pi / known)
    # sum over Chebyshev polynomials, which are orthogonal at these points
    at = torch.arccos(((wanted - middle) / half).clamp(-1, 1))
    share = torch.where(number > 0, 2 / known, 1 / known)
    matrix = (torch.cos(at[:, None] * number) * share) @ torch.cos(angle * number[:, None])
    return middle + half * torch.cos(angle), matrix
