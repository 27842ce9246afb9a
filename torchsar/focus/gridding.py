"""A non-uniform FFT along pulses whose points are shared by all range cells: range stays
contiguous, and only short tables depend on the points.

Spreading, interpolating and the derivative of either in the tap weights are the three partial
derivatives of one trilinear form, so that they are each other's gradients to any order: sum over m,
tap and column of weights[m, tap] * values[m, column] * grid[first[m] + tap, column]. Each is one
bag of weighted rows (`embedding_bag`), which on a CPU core takes a tenth of the time of adding
complex rows by index. Source: Fessler and Sutton 2003 (gridding), Barnett et al. 2019 (kernel,
error against width and oversampling); own code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from torchsar.core import block_bytes_of, over_blocks, real_dtype
from torchsar.focus.nufft import Kernel, smooth_length

_PARTS = ("weights", "values", "grid")


def spread_rows(weights: Tensor, values: Tensor, first: Tensor, length: int) -> Tensor:
    """Add weights[m, tap] * values[m] onto row first[m] + tap of a grid.

    Real (b, m, tap), (b, m, column), int64 (b, m) -> (b, length, column).

    Fastest where `first` rises along m. Differentiable any number of times in weights and values,
    as the other two.
    """
    return _Trilinear.apply("grid", length, first, weights, values)


def interpolate_rows(weights: Tensor, grid: Tensor, first: Tensor) -> Tensor:
    """Adjoint of spread_rows in the values: sum over taps of weights[m, tap] * grid[first[m] +
    tap], (b, m, column).
    """
    return _Trilinear.apply("values", 0, first, weights, grid)


def correlate_rows(values: Tensor, grid: Tensor, first: Tensor, taps: int) -> Tensor:
    """Adjoint of spread_rows in the weights: sum over columns of values[m] * grid[first[m] + tap],
    (b, m, tap).
    """
    return _Trilinear.apply("weights", taps, first, values, grid)


class _Trilinear(torch.autograd.Function):
    """One partial derivative of the trilinear form; a and b are the other two parts, in the order
    of _PARTS. size: taps or grid rows, where wanted.
    """

    @staticmethod
    def forward(wanted: str, size: int, first: Tensor, a: Tensor, b: Tensor) -> Tensor:
        a, b = a.contiguous(), b.contiguous()
        if wanted == "grid":
            return _spread(a, b, first, size)
        return _interpolate(a, b, first) if wanted == "values" else _correlate(a, b, first, size)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.wanted, _, first, a, b = inputs
        ctx.save_for_backward(first, a, b)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        first, a, b = ctx.saved_tensors
        names = [part for part in _PARTS if part != ctx.wanted]
        parts = dict(zip(names, (a, b))) | {ctx.wanted: gradient}
        slopes = [_partial(name, parts, first) if ctx.needs_input_grad[3 + i] else None for i, name in enumerate(names)]
        return None, None, None, *slopes

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, wanted: str, size: int, first: Tensor, a: Tensor, b: Tensor
    ) -> tuple[Tensor, int]:
        joined = [_in_front(x, dim, info.batch_size) for x, dim in zip((first, a, b), in_dims[2:])]
        return _Trilinear.apply(wanted, size, *joined).unflatten(0, (info.batch_size, -1)), 0


def _partial(name: str, parts: dict[str, Tensor], first: Tensor) -> Tensor:
    """Derivative of the form in the named part, which lends its size."""
    others = [parts[part] for part in _PARTS if part != name]
    size = {"grid": parts["grid"].shape[-2], "weights": parts["weights"].shape[-1], "values": 0}[name]
    return _Trilinear.apply(name, size, first, *others)


def _in_front(x: Tensor, dim: int | None, count: int) -> Tensor:
    """The mapped dim joined with the trials."""
    x = x.expand(count, *x.shape) if dim is None else x.movedim(dim, 0)
    return x.flatten(0, 1)


def _rows(first: Tensor, taps: int, length: int) -> Tensor:
    """Grid row of each tap, trials one after another, (b * m, tap)."""
    trial = length * torch.arange(first.shape[0], device=first.device)
    return (first + trial[:, None]).reshape(-1, 1) + torch.arange(taps, device=first.device)


def _interpolate(weights: Tensor, grid: Tensor, first: Tensor) -> Tensor:
    rows = _rows(first, weights.shape[-1], grid.shape[-2])
    return embedding_bag(rows, grid.flatten(0, 1), mode="sum", per_sample_weights=weights.flatten(0, 1)).unflatten(
        0, first.shape
    )


def _correlate(values: Tensor, grid: Tensor, first: Tensor, taps: int) -> Tensor:
    """The derivative of the bags in their weights: torch has it as one operation, gathering all
    taps of all rows first takes four times as long.
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
    """Every grid row gathers the values that reach it: the entries of a row follow one another in
    `source`, from `starts` on.
    """
    b, m, taps = weights.shape
    rank, start = _ranks(first), _rows(first, 1, length).flatten()
    # how many points start at or before a row
    below = torch.bincount(start, minlength=b * length).cumsum(0)
    before = torch.cat([below.new_zeros(taps), below[:-taps]])
    entries = below - before
    starts = entries.cumsum(0) - entries
    rows = _rows(first, taps, length)
    place = ((starts - before).index_select(0, rows.flatten()).view(-1, taps) + rank[:, None]).flatten()
    point = torch.arange(b * m, device=first.device).repeat_interleave(taps)
    source = torch.empty_like(point).scatter_(0, place, point)
    ordered = torch.empty_like(weights).flatten().scatter_(0, place, weights.flatten())
    return embedding_bag(source, values.flatten(0, 1), starts, mode="sum", per_sample_weights=ordered).unflatten(
        0, (b, length)
    )


def _ranks(first: Tensor) -> Tensor:
    """Place of each point in the order of its trial and grid row, (b * m,)."""
    every = torch.arange(first.numel(), device=first.device)
    if not bool((first.diff(dim=-1) < 0).any()):
        return every
    order = first.argsort(dim=-1, stable=True)
    start = first.shape[-1] * torch.arange(first.shape[0], device=first.device)
    return torch.empty_like(every).scatter_(0, (order + start[:, None]).flatten(), every)


@dataclass(frozen=True)
class PulsePoints:
    """Where pulses lie on the grid: index of the first row, int64 (..., m), tap weights (..., m,
    tap), and the number of rows that they reach.
    """

    first: Tensor
    weights: Tensor
    rows: int


class PulseNufft:
    """Sums of pulses at points of their own into uniform lines, and the adjoint: for data (...,
    pulse, range) and points (..., pulse) in cycles a line.

    lines: output lines, of which number `lines // 2` is frequency zero. kernel: width and
    oversampling, `Kernel.of(eps)` or `Kernel(taps, oversampling)`. Built for one dtype and device;
    no points are kept. scale: factor on all results of type1 and type2.
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
        self.length = smooth_length(max(math.ceil(kernel.oversampling * lines), 2 * kernel.taps))
        line = torch.arange(lines, dtype=torch.float64, device=device) - lines // 2
        # taps start at the row of their point, half a width late; so a point on a row has its taps
        # about the middle of the kernel at any width
        late = (kernel.taps - 1) / 2 / self.length
        self._factor = torch.polar(scale / kernel.spectrum(line / self.length), -2 * math.pi * late * line).to(dtype)

    def points(self, cycles_per_line: Tensor) -> PulsePoints:
        """Prepare points, float64 (..., m), any real numbers (periodic in 1). Differentiable.

        Raises TypeError unless float64.

        A trial with points that are not finite transforms into NaN, its neighbours do not: searches
        try any warp.
        """
        if cycles_per_line.dtype != torch.float64:
            raise TypeError(f"points of a non-uniform FFT are float64 cycles, got {cycles_per_line.dtype}")
        whole = torch.floor(cycles_per_line.detach())
        position = (cycles_per_line - whole) * self.length
        first = torch.nan_to_num(torch.round(position.detach()), 0.0, 0.0, 0.0)
        weights = self.kernel.weights((position - first).to(real_dtype(self.dtype)))
        return PulsePoints(first.to(torch.int64), weights.movedim(0, -1), self._reach(first))

    def _reach(self, first: Tensor) -> int:
        """Rows that the taps reach, so that what lies behind is never handled; all of them inside
        vmap, where a value cannot be looked at.
        """
        try:
            return int(first.max()) + self.kernel.taps
        except RuntimeError:
            return self.length + self.kernel.taps + 1

    def type1(self, y: Tensor, points: PulsePoints) -> Tensor:
        """sum_m y[m] exp(+2j pi p[m] (q - lines // 2)), q = 0..lines - 1.

        y: (..., m, range) -> (..., lines, range). Differentiable in y and points.
        """
        trials = torch.broadcast_shapes(y.shape[:-2], points.first.shape[:-1])
        first, weights = _joined(points.first, trials, 1), _joined(points.weights, trials, 2)
        grid = spread_rows(
            weights, _joined(torch.view_as_real(y.resolve_conj()).flatten(-2), trials, 2), first, points.rows
        )
        image = _Lines.apply(torch.view_as_complex(grid.unflatten(-1, (-1, 2))), self._factor, self.length, 0)
        return image.view(*trials, *image.shape[-2:])

    def type2(self, x: Tensor, points: PulsePoints) -> Tensor:
        """Adjoint of type1: sum_q x[q] exp(-2j pi p[m] (q - lines // 2)).

        x: (..., lines, range) -> (..., m, range).
        """
        trials = torch.broadcast_shapes(x.shape[:-2], points.first.shape[:-1])
        first, weights = _joined(points.first, trials, 1), _joined(points.weights, trials, 2)
        grid = _Lines.apply(_joined(x, trials, 2), self._factor, self.length, points.rows)
        rows = interpolate_rows(weights, torch.view_as_real(grid).flatten(-2), first).unflatten(-1, (-1, 2))
        return torch.view_as_complex(rows).view(*trials, *rows.shape[-3:-1])


def _joined(x: Tensor, trials: torch.Size, trailing: int) -> Tensor:
    """x for all trials, as one leading dim."""
    return x.expand(*trials, *x.shape[x.ndim - trailing :]).reshape(-1, *x.shape[x.ndim - trailing :])


class _Lines(torch.autograd.Function):
    """Grid rows to lines, (b, row, range) -> (b, line, range): inverse FFT along rows, crop,
    factor; with rows > 0 its adjoint, onto so many rows.

    Works on blocks of columns that stay in the cache and lie along memory while they are
    transformed. Lines come back with range strided.
    """

    @staticmethod
    def forward(x: Tensor, factor: Tensor, length: int, rows: int) -> Tensor:
        return _lines_to_grid(x, factor, length, rows) if rows else _grid_to_lines(x, factor, length)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        x, factor, length, rows = inputs
        ctx.length, ctx.rows = length, 0 if rows else x.shape[-2]
        ctx.save_for_backward(factor)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Lines.apply(gradient, *ctx.saved_tensors, ctx.length, ctx.rows), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor, factor: Tensor, length: int, rows: int) -> tuple[Tensor, int]:
        return _Lines.apply(_in_front(x, in_dims[0], info.batch_size), factor, length, rows).unflatten(
            0, (info.batch_size, -1)
        ), 0


def _blocks(x: Tensor, length: int) -> list[tuple[slice, slice]]:
    """Parts (trial, column) of x (b, n, column) whose transforms stay in the cache: trials where
    several fit, else columns of one.
    """
    b, _, columns = x.shape
    room = max(8, 4 * block_bytes_of(x.device) // (length * x.element_size()))
    if columns <= room:
        height = room // columns
        return [(slice(at, at + height), slice(None)) for at in range(0, b, height)]
    return [(slice(trial, trial + 1), slice(at, at + room)) for trial in range(b) for at in range(0, columns, room)]


def _grid_to_lines(grid: Tensor, factor: Tensor, length: int) -> Tensor:
    b, rows, columns = grid.shape
    lines, half, inside = factor.shape[0], factor.shape[0] // 2, min(rows, length)
    out = grid.new_empty(b, columns, lines)

    def work(part: tuple[slice, slice]) -> None:
        block, target = grid[part[0], :, part[1]].mT, out[part]
        padded = grid.new_empty(*block.shape[:2], length)
        padded[..., :inside] = block[..., :inside]
        padded[..., inside:] = 0
        padded[..., : rows - inside] += block[..., inside:]  # periodic
        whole = torch.fft.ifft(padded, norm="forward")
        torch.mul(whole[..., length - half :], factor[:half], out=target[..., :half])
        torch.mul(whole[..., : lines - half], factor[half:], out=target[..., half:])

    over_blocks(work, _blocks(grid, length), out)
    return out.mT


def _lines_to_grid(x: Tensor, factor: Tensor, length: int, rows: int) -> Tensor:
    b, lines, columns = x.shape
    half, inside, conj = lines // 2, min(rows, length), factor.conj().resolve_conj()
    out = x.new_empty(b, rows, columns)

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
