"""Non-uniform FFT along pulses, with the same points for all range cells.

A point is the frequency at which a pulse is evaluated. The transform needs three operations: to
spread pulses onto a uniform grid, to interpolate the grid at the points, and the derivative of the
other two with respect to the kernel weights. They are the partial derivatives (`trilinear`) of the
sum, over point m, tap and column, of

    weights[m, tap] * values[m, column] * grid[first[m] + tap, column]

with respect to grid, values and weights. The gradients of one operation are therefore given by the
other two, to any order. Each operation is computed as a sum of weighted rows (`embedding_bag`),
which on a CPU core takes a tenth of the time of adding complex rows by index.

Reference:
    Fessler and Sutton 2003 (gridding); Barnett et al. 2019 (kernel, error against width and
    oversampling).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from torchsar.core import block_bytes_of, host_largest, host_value, is_traced, over_blocks, real_dtype
from torchsar.core.nufft import Kernel

# the three factors of the trilinear form, in the order of the arguments of `_Trilinear`
_PARTS = ("weights", "values", "grid")


class LinearMap(torch.autograd.Function):
    """A linear map of a tensor, given as two functions: the map, and its adjoint for gradients.

    Both take and return tensors with one leading dimension of trials. Differentiable any number of
    times; the tensors that the functions refer to are constants.
    """

    @staticmethod
    def forward(x: Tensor, forth: Callable[[Tensor], Tensor], back: Callable[[Tensor], Tensor]) -> Tensor:
        return forth(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.forth, ctx.back = inputs[1:]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return LinearMap.apply(gradient, ctx.back, ctx.forth), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return LinearMap.apply(tangent, ctx.forth, ctx.back)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor, forth: Callable, back: Callable) -> tuple[Tensor, int]:
        every = LinearMap.apply(_in_front(x, in_dims[0], info.batch_size), forth, back)
        return every.unflatten(0, (info.batch_size, -1)), 0


def trilinear(wanted: str, size: int, first: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Compute one partial derivative of the trilinear form, see the head of this module.

    Differentiable any number of times in the two factors.

    Args:
        wanted: "grid" to spread values (fastest where `first` rises along m), "values" to
            interpolate a grid, "weights" to correlate values with a grid.
        size: Number of grid rows of "grid" or of taps of "weights"; not used for "values".
        first: First grid row of each point, shape (b, m), int64.
        a: First of the other two factors in the order weights (b, m, tap), values (b, m, column),
            grid (b, row, column), real.
        b: Second of the other two factors.

    Returns:
        The factor that is wanted, in its shape.
    """
    return _Trilinear.apply(wanted, size, first, a, b)


class _Trilinear(torch.autograd.Function):
    """Partial derivative of the trilinear form by one of its factors, as an operation of autograd;
    arguments as in `trilinear`.
    """

    @staticmethod
    def forward(wanted: str, size: int, first: Tensor, a: Tensor, b: Tensor) -> Tensor:
        a, b = a.contiguous(), b.contiguous()
        if wanted == "grid":
            return _spread(a, b, first, size)
        return _interpolate(a, b, first) if wanted == "values" else _correlate(a, b, first, size)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.wanted, ctx.size, first, a, b = inputs
        ctx.save_for_backward(first, a, b)
        ctx.save_for_forward(first, a, b)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        first, *factors = ctx.saved_tensors
        names = [part for part in _PARTS if part != ctx.wanted]
        parts = dict(zip(names, factors)) | {ctx.wanted: gradient}
        sizes = {"grid": parts["grid"].shape[-2], "weights": parts["weights"].shape[-1], "values": 0}
        slopes = [
            _Trilinear.apply(name, sizes[name], first, *(parts[part] for part in _PARTS if part != name))
            if ctx.needs_input_grad[3 + i]
            else None
            for i, name in enumerate(names)
        ]
        return None, None, None, *slopes

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        first, a, b = ctx.saved_tensors
        of_a, of_b = (torch.zeros_like(x) if slope is None else slope for slope, x in zip(tangents[3:], (a, b)))
        terms = [_Trilinear.apply(ctx.wanted, ctx.size, first, *pair) for pair in ((of_a, b), (a, of_b))]
        return terms[0] + terms[1]

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, wanted: str, size: int, first: Tensor, a: Tensor, b: Tensor
    ) -> tuple[Tensor, int]:
        joined = [_in_front(x, dim, info.batch_size) for x, dim in zip((first, a, b), in_dims[2:])]
        return _Trilinear.apply(wanted, size, *joined).unflatten(0, (info.batch_size, -1)), 0


def _in_front(x: Tensor, dim: int | None, count: int) -> Tensor:
    """Join the dimension that vmap maps over with the trials."""
    x = x.expand(count, *x.shape) if dim is None else x.movedim(dim, 0)
    return x.flatten(0, 1)


def _rows(first: Tensor, taps: int, length: int) -> Tensor:
    """Grid row of each tap, (b * m, tap); the rows of the trials follow each other."""
    trial = length * torch.arange(first.shape[0], device=first.device)
    return (first + trial[:, None]).reshape(-1, 1) + torch.arange(taps, device=first.device)


def _interpolate(weights: Tensor, grid: Tensor, first: Tensor) -> Tensor:
    """Weighted sum of grid rows for each point."""
    rows = _rows(first, weights.shape[-1], grid.shape[-2])
    return embedding_bag(rows, grid.flatten(0, 1), mode="sum", per_sample_weights=weights.flatten(0, 1)).unflatten(
        0, first.shape
    )


def _correlate(values: Tensor, grid: Tensor, first: Tensor, taps: int) -> Tensor:
    """Derivative of the weighted sums by their weights, as one torch operation.

    Gathering all taps of all rows first takes four times as long.
    """
    count = first.numel()
    starts = torch.arange(0, count * taps, taps, device=first.device)
    bag = torch.arange(count, device=first.device).repeat_interleave(taps)
    rows = _rows(first, taps, grid.shape[-2]).flatten()
    slopes = torch.ops.aten._embedding_bag_per_sample_weights_backward(
        values.flatten(0, 1), grid.flatten(0, 1), rows, starts, bag, 0
    )
    return slopes.view(*first.shape, taps)


def _spread(weights: Tensor, values: Tensor, first: Tensor, length: int) -> Tensor:
    """Weighted sum of values for each grid row. The entries of a row are contiguous in `source`,
    beginning at `starts`.
    """
    b, m, taps = weights.shape
    rank, start = _ranks(first), _rows(first, 1, length).flatten()
    # number of points that start at or before a row
    below = _numbers_of(start, b * length).cumsum(0)
    before = torch.cat([below.new_zeros(taps), below[:-taps]])
    entries = below - before
    starts = entries.cumsum(0) - entries
    rows = _rows(first, taps, length)
    slot = ((starts - before).index_select(0, rows.flatten()).view(-1, taps) + rank[:, None]).flatten()
    point = torch.arange(b * m, device=first.device).repeat_interleave(taps)
    source = torch.empty_like(point).scatter_(0, slot, point)
    ordered = torch.empty_like(weights).flatten().scatter_(0, slot, weights.flatten())
    return embedding_bag(source, values.flatten(0, 1), starts, mode="sum", per_sample_weights=ordered).unflatten(
        0, (b, length)
    )


def _numbers_of(values: Tensor, length: int) -> Tensor:
    """Number of times that each of the numbers 0 to length - 1 occurs, (length,) int64."""
    if values.device.type == "cpu" and not is_traced(values):
        return torch.bincount(values, minlength=length)
    # the length of the result of `bincount` depends on the largest value, for which other devices
    # would have to be awaited
    return torch.zeros(length, dtype=torch.int64, device=values.device).index_add_(0, values, torch.ones_like(values))


def _ranks(first: Tensor) -> Tensor:
    """Position of each point in the order of trial and grid row, (b * m,)."""
    every = torch.arange(first.numel(), device=first.device)
    # on other devices, sorting takes less time than waiting for a value
    if first.device.type == "cpu" and not host_value((first.diff(dim=-1) < 0).any(), True):
        return every
    order = first.argsort(dim=-1, stable=True)
    start = first.shape[-1] * torch.arange(first.shape[0], device=first.device)
    return torch.empty_like(every).scatter_(0, (order + start[:, None]).flatten(), every)


@dataclass(frozen=True)
class PulsePoints:
    """Positions of the pulses on the grid of a `PulseNufft`.

    Args:
        first: Index of the first grid row onto which each pulse is spread, shape (..., m), int64.
        weights: Kernel weights of each pulse at its grid rows, shape (..., m, tap).
        rows: Number of grid rows, up to the last one onto which a pulse is spread.
    """

    first: Tensor
    weights: Tensor
    rows: int


class PulseNufft:
    """Non-uniform FFT that sums pulses into uniform image lines (type 1), and its adjoint (type 2).

    Pulse m is summed with the phase 2 pi p[m] per line, where p[m] is its point. An object is built
    for one dtype and device; the points are arguments of each transform.

    Args:
        lines: Number of lines; line `lines // 2` is frequency zero.
        kernel: Interpolation kernel, `Kernel.of(eps)` or `Kernel(taps, oversampling)`.
        dtype: Complex type of the data.
        device: Device of the data.
        scale: Factor on the results of `type1` and `type2`.
    """

    def __init__(
        self,
        lines: int,
        kernel: Kernel,
        dtype: torch.dtype,
        device: torch.device | str | None = None,
        scale: float = 1.0,
    ) -> None:
        self.lines, self.kernel, self.dtype = lines, kernel, dtype
        self.length = kernel.grid_length(lines)
        line = torch.arange(lines, dtype=torch.float64, device=device) - lines // 2
        # The taps start at the row of their point instead of half a width before it. A point on a
        # row then has its taps about the middle of the kernel for any width. The factor corrects
        # the shift.
        late = (kernel.taps - 1) / 2 / self.length
        self._factor = torch.polar(scale / kernel.spectrum(line / self.length), -2 * math.pi * late * line).to(dtype)

    def points(self, cycles_per_line: Tensor) -> PulsePoints:
        """Compute grid rows and kernel weights of the points of pulses; differentiable.

        A trial with points that are not finite gives NaN and leaves the other trials unchanged.

        Args:
            cycles_per_line: Phase step of each pulse from line to line in cycles, shape (..., m),
                float64, any real numbers (periodic in 1).

        Returns:
            Points for `type1` and `type2`.

        Raises:
            TypeError: If the points are not float64.
        """
        if cycles_per_line.dtype != torch.float64:
            raise TypeError(f"points of a non-uniform FFT must be float64 cycles per line, got {cycles_per_line.dtype}")
        whole = torch.floor(cycles_per_line.detach())
        position = (cycles_per_line - whole) * self.length
        first = torch.nan_to_num(torch.round(position.detach()), 0.0, 0.0, 0.0)
        weights = self.kernel.weights((position - first).to(real_dtype(self.dtype)))
        # Rows beyond the last tap are not processed. All rows are processed inside vmap, where
        # values cannot be read, and on an accelerator, where waiting for values takes longer.
        last = self.length + 1
        last = host_largest(first, last) if first.device.type == "cpu" else last
        return PulsePoints(first.to(torch.int64), weights.movedim(0, -1), last + self.kernel.taps)

    def type1(self, y: Tensor, points: PulsePoints) -> Tensor:
        """Sum pulses into image lines q: sum_m y[m] exp(+2j pi p[m] (q - lines // 2)).

        The lines are q = 0..lines - 1. Differentiable in `y` and in the points.

        Args:
            y: Pulses, shape (..., m, range), complex.
            points: Points p of the pulses.

        Returns:
            Lines, shape (..., lines, range).
        """
        trials = np.broadcast_shapes(y.shape[:-2], points.first.shape[:-1])
        first, weights = _joined(points.first, trials, 1), _joined(points.weights, trials, 2)
        values = _joined(torch.view_as_real(y.resolve_conj()).flatten(-2), trials, 2)
        grid = torch.view_as_complex(trilinear("grid", points.rows, first, weights, values).unflatten(-1, (-1, 2)))
        image = LinearMap.apply(grid, self._to_lines, partial(self._to_grid, points.rows))
        return image.view(*trials, *image.shape[-2:])

    def type2(self, x: Tensor, points: PulsePoints) -> Tensor:
        """Transform image lines into pulses m: sum_q x[q] exp(-2j pi p[m] (q - lines // 2)).

        It is the adjoint of `type1`. Differentiable in `x` and in the points.

        Args:
            x: Lines, shape (..., lines, range), complex.
            points: Points p of the pulses.

        Returns:
            Pulses, shape (..., m, range).
        """
        trials = np.broadcast_shapes(x.shape[:-2], points.first.shape[:-1])
        first, weights = _joined(points.first, trials, 1), _joined(points.weights, trials, 2)
        grid = LinearMap.apply(_joined(x, trials, 2), partial(self._to_grid, points.rows), self._to_lines)
        rows = trilinear("values", 0, first, weights, torch.view_as_real(grid).flatten(-2)).unflatten(-1, (-1, 2))
        return torch.view_as_complex(rows).view(*trials, *rows.shape[-3:-1])

    # The two transforms work on blocks of columns that fit into the cache and are contiguous while
    # they are transformed. Lines have a strided range dimension.

    def _to_lines(self, grid: Tensor) -> Tensor:
        """Inverse FFT of grid rows (b, row, range), cropped to the image lines and multiplied by
        the factor.
        """
        b, rows, columns = grid.shape
        length, lines, half, inside = self.length, self.lines, self.lines // 2, min(rows, self.length)
        out = grid.new_empty(b, columns, lines)

        def work(part: tuple[slice, slice]) -> None:
            block, target = grid[part[0], :, part[1]].mT, out[part]
            padded = grid.new_empty(*block.shape[:2], length)
            padded[..., :inside] = block[..., :inside]
            padded[..., inside:] = 0
            padded[..., : rows - inside] += block[..., inside:]  # the grid is periodic
            whole = torch.fft.ifft(padded, norm="forward")
            torch.mul(whole[..., length - half :], self._factor[:half], out=target[..., :half])
            torch.mul(whole[..., : lines - half], self._factor[half:], out=target[..., half:])

        over_blocks(work, _blocks(grid, length), out)
        return out.mT

    def _to_grid(self, rows: int, x: Tensor) -> Tensor:
        """Adjoint of `_to_lines`: image lines (b, line, range) to some rows of the grid, (b, row,
        range).
        """
        b, lines, columns = x.shape
        length, half, inside = self.length, lines // 2, min(rows, self.length)
        conj, out = self._factor.conj().resolve_conj(), x.new_empty(b, rows, columns)

        def work(part: tuple[slice, slice]) -> None:
            block, target = x[part[0], :, part[1]].mT, out[part[0], :, part[1]].mT
            padded = x.new_empty(*block.shape[:2], length)
            padded[..., lines - half : length - half] = 0
            torch.mul(block[..., :half], conj[:half], out=padded[..., length - half :])
            torch.mul(block[..., half:], conj[half:], out=padded[..., : lines - half])
            whole = torch.fft.fft(padded)
            target[..., :inside] = whole[..., :inside]
            target[..., inside:] = whole[..., : rows - inside]

        over_blocks(work, _blocks(x, length), out)
        return out


def _joined(x: Tensor, trials: tuple[int, ...], trailing: int) -> Tensor:
    """Expand x to all trials, with one leading dimension."""
    return x.expand(*trials, *x.shape[x.ndim - trailing :]).reshape(-1, *x.shape[x.ndim - trailing :])


def _blocks(x: Tensor, length: int) -> list[tuple[slice, slice]]:
    """Parts (trial, column) of x (b, n, column) whose transforms fit into the cache: several
    trials, or columns of one trial.
    """
    b, _, columns = x.shape
    room = max(8, 4 * block_bytes_of(x.device) // (length * x.element_size()))
    if columns <= room:
        height = room // columns
        return [(slice(at, at + height), slice(None)) for at in range(0, b, height)]
    return [(slice(trial, trial + 1), slice(at, at + room)) for trial in range(b) for at in range(0, columns, room)]
