"""Polar format by gridding: the image of plane waves as one two-dimensional non-uniform FFT, and
its exact adjoint.

image(x, y) = sum_k sum_f s_k(f) exp(+4j pi f / c (u_k . (x, y) + offset_k)), which is
backprojection with `FarField` ranges. The samples lie on a polar raster of wave vectors 2 f / c
u_k; a Kaiser-Bessel kernel spreads them onto a twice oversampled rectangular grid, an FFT makes the
image, a division removes the kernel. Where the spreading goes is worked out once, as a sparse
matrix. Source: Fessler and Sutton 2003 (gridding); Carrara, Goodman and Majewski 1995, ch. 3 (polar
format); own code.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Axis, block_bytes_of, real_dtype, unit_phasor
from torchsar.focus.nufft import OVERSAMPLING, Kernel, Points, smooth_length
from torchsar.focus.spotlight import GroundImager, aperture_weights, refuse_other_size
from torchsar.radar.spotlight import FarField, Spotlight, frequency_samples, range_profiles


@dataclass(frozen=True, eq=False)
class SparseRows:
    """A real sparse matrix of `size` by compressed rows.

    Plain tensors, so that it can be copied and pickled, which sparse ones cannot.
    """

    starts: Tensor
    columns: Tensor
    weights: Tensor
    size: tuple[int, int]

    def __matmul__(self, x: Tensor) -> Tensor:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
            matrix = torch.sparse_csr_tensor(self.starts, self.columns, self.weights, self.size, check_invariants=False)
        return matrix @ x


@dataclass(frozen=True, eq=False)
class SparsePair:
    """A real sparse matrix and its transpose. Applied to complex vectors along the last dim."""

    matrix: SparseRows
    transpose: SparseRows

    @staticmethod
    def of_columns(row: Tensor, weight: Tensor, rows: int) -> SparsePair:
        """From the entries of each column: row numbers and weights, (column, entry)."""
        columns, entries = row.shape
        kind = torch.int32 if max(row.numel(), rows) < 2**31 else torch.int64
        order = torch.argsort(row.reshape(-1).to(kind), stable=True)
        starts = torch.cat([row.new_zeros(1), torch.bincount(row.reshape(-1), minlength=rows).cumsum(0)])
        every = entries * torch.arange(columns + 1, device=row.device)
        matrix = SparseRows(starts.to(kind), (order // entries).to(kind), weight.reshape(-1)[order], (rows, columns))
        return SparsePair(
            matrix, SparseRows(every.to(kind), row.reshape(-1).to(kind), weight.reshape(-1), (columns, rows))
        )

    def flipped(self) -> SparsePair:
        return SparsePair(self.transpose, self.matrix)

    def __call__(self, x: Tensor) -> Tensor:
        """Matrix times vectors, complex (..., columns) -> (..., rows). Differentiable in x."""
        return _Apply.apply(x, self)


class _Apply(torch.autograd.Function):
    """A sparse matrix on complex vectors: real and imaginary parts of all trials are the columns of
    one product.
    """

    @staticmethod
    def forward(x: Tensor, pair: SparsePair) -> Tensor:
        vectors = torch.view_as_real(x.reshape(-1, x.shape[-1]).resolve_conj())
        rows, (count, columns, _) = pair.matrix.size[0], vectors.shape
        product = pair.matrix @ vectors.movedim(0, 1).reshape(columns, 2 * count)
        out = product.view(rows, count, 2).movedim(1, 0).contiguous()
        return torch.view_as_complex(out).view(*x.shape[:-1], rows)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.pair = inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Apply.apply(gradient, ctx.pair.flipped()), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Apply.apply(tangent, ctx.pair)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor, pair: SparsePair) -> tuple[Tensor, int]:
        return _Apply.apply(x.movedim(in_dims[0], 0), pair), 0


class _GridAxis:
    """One image axis: where wave numbers lie on its oversampled grid, and the crop and division
    that undo the oversampling.
    """

    def __init__(self, axis: Axis, kernel: Kernel, dtype: torch.dtype, device: torch.device) -> None:
        self.n, self.kernel, self.step_m, self.dtype = axis.n, kernel, axis.step, dtype
        self.centre_m = axis.start + (axis.n // 2) * axis.step
        self.length = smooth_length(max(OVERSAMPLING * axis.n, 2 * kernel.taps))
        offset = torch.arange(axis.n, dtype=torch.float64, device=device) - axis.n // 2
        self.weight = (1 / kernel.spectrum(offset / self.length)).to(dtype)

    def taps(self, cycles_m: Tensor) -> tuple[Tensor, Tensor]:
        """Grid index and weight of every tap of every wave number (sample,), both (sample, tap)."""
        points = Points.of(self.kernel, cycles_m * (self.step_m * self.length), self.length, self.dtype)
        tap = torch.arange(self.kernel.taps, device=cycles_m.device)
        return (points.first[:, None] + tap) % self.length, points.weights.T

    def crop(self, grid: Tensor, dim: int) -> Tensor:
        half = self.n // 2
        return torch.cat([grid.narrow(dim, self.length - half, half), grid.narrow(dim, 0, self.n - half)], dim)

    def embed(self, image: Tensor, dim: int) -> Tensor:
        """Adjoint of crop."""
        half, shape = self.n // 2, list(image.shape)
        shape[dim] = self.length - self.n
        return torch.cat(
            [image.narrow(dim, half, self.n - half), image.new_zeros(shape), image.narrow(dim, 0, half)], dim
        )


class PolarOperator:
    """The linear map from range profiles (..., pulse, range) to an image (..., azimuth, range), and
    its exact adjoint.

    geometry: plane waves; the image's range axis is the first ground direction (x), its azimuth
    axis the second (y): turn the geometry (`FarField.turned`) for other directions. azimuth,
    range_: axes in metres. window: "none" or "hann", over pulses and over frequencies. eps:
    relative error against the direct sum. Built for one dtype and device (that of the geometry) and
    one geometry, shared by all trials; building takes under a second and 20 bytes x kernel taps^2 a
    sample (complex64). A unit point gives the sum of the window weights. Differentiable in its
    argument.
    """

    def __init__(
        self,
        geometry: FarField,
        azimuth: Axis,
        range_: Axis,
        *,
        window: str = "none",
        eps: float = 1e-3,
        dtype: torch.dtype = torch.complex64,
    ) -> None:
        self.geometry, self.azimuth, self.range, self.dtype = geometry, azimuth, range_, dtype
        device, real = geometry.direction.device, real_dtype(dtype)
        self._y, self._x = (_GridAxis(axis, Kernel.of(eps), real, device) for axis in (azimuth, range_))
        wave_number = 2 / geometry.wave_speed_m_s * geometry.frequency_hz  # cycles a metre
        self._spread = self._layout(geometry.direction[:, :, None] * wave_number)
        centre = (
            geometry.direction @ geometry.direction.new_tensor([self._x.centre_m, self._y.centre_m]) + geometry.offset_m
        )
        self._factor = aperture_weights(window, geometry).to(real) * unit_phasor(centre[:, None] * wave_number, dtype)
        self._unkernel = self._y.weight[:, None] * self._x.weight

    def _layout(self, cycles_m: Tensor) -> SparsePair:
        """Samples (pulse, 2, frequency) onto the flattened grid."""
        column, across = self._x.taps(cycles_m[:, 0].reshape(-1))
        row, down = self._y.taps(cycles_m[:, 1].reshape(-1))
        cell = row[:, :, None] * self._x.length + column[:, None, :]
        return SparsePair.of_columns(
            cell.flatten(1), (down[:, :, None] * across[:, None, :]).flatten(1), self._y.length * self._x.length
        )

    def image(self, profiles: Tensor) -> Tensor:
        """Profiles (..., pulse, range) to the image (..., azimuth, range)."""
        refuse_other_size(profiles, self.geometry)
        self._refuse_other_dtype(profiles)
        return self._by_trials(self._image, profiles)

    def _image(self, profiles: Tensor) -> Tensor:
        samples = frequency_samples(profiles) * self._factor
        grid = self._spread(samples.flatten(-2)).unflatten(-1, (self._y.length, self._x.length))
        columns = self._y.crop(torch.fft.ifft(grid, dim=-2, norm="forward"), -2)
        return self._x.crop(torch.fft.ifft(columns, norm="forward"), -1) * self._unkernel

    def adjoint(self, image: Tensor) -> Tensor:
        """Image (..., azimuth, range) to profiles (..., pulse, range): <image(p), i> = <p,
        adjoint(i)> with <a, b> = sum a conj(b).
        """
        self._refuse_other_dtype(image)
        if tuple(image.shape[-2:]) != (self.azimuth.n, self.range.n):
            raise ValueError(
                f"image of shape {tuple(image.shape)} does not end in the (azimuth, range) = "
                f"({self.azimuth.n}, {self.range.n}) of the operator"
            )
        return self._by_trials(self._adjoint, image)

    def _adjoint(self, image: Tensor) -> Tensor:
        columns = torch.fft.fft(self._x.embed(image * self._unkernel, -1))
        grid = torch.fft.fft(self._y.embed(columns, -2), dim=-2)
        samples = self._spread.flipped()(grid.flatten(-2)).unflatten(-1, self._factor.shape)
        return range_profiles(samples * self._factor.conj())

    def _by_trials(self, work: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
        """work on blocks of trials whose grids stay in the cache."""
        count = max(1, 8 * block_bytes_of(x.device) // (self._y.length * self._x.length * x.element_size()))
        flat = x.reshape(-1, *x.shape[-2:])
        out = work(flat) if flat.shape[0] <= count else torch.cat([work(part) for part in flat.split(count)])
        return out.view(*x.shape[:-2], *out.shape[-2:])

    def _refuse_other_dtype(self, x: Tensor) -> None:
        if x.dtype != self.dtype:
            raise TypeError(
                f"this polar operator was built for {self.dtype}, got {x.dtype}; build it with dtype={x.dtype}"
            )


class PolarFormat(GroundImager):
    """Image the ground plane by polar format.

    Arguments as `GroundImager`; neglects the curvature of the wavefront (`plane_wave_loss`).

    The operator of the last geometry is kept: `operator(profiles, geometry)` gives it to autofocus
    loops.
    """

    _kept: tuple[list[Tensor], PolarOperator] | None = None

    def operator(self, profiles: Tensor, geometry: FarField | Spotlight) -> PolarOperator:
        """The operator for this geometry, in turned coordinates, and the dtype of the profiles."""
        waves = geometry.far_field() if isinstance(geometry, Spotlight) else geometry
        key = [waves.frequency_hz, waves.direction, waves.offset_m]
        kept = self._kept
        if kept is None or kept[1].dtype != profiles.dtype or not _same(kept[0], key):
            kept = self._kept = (
                key,
                PolarOperator(waves, *self.grid.axes(), window=self.window, eps=self.eps, dtype=profiles.dtype),
            )
        return kept[1]

    def form(self, profiles: Tensor, geometry: FarField | Spotlight, azimuth: Axis, range_: Axis) -> Tensor:
        return self.operator(profiles, geometry).image(profiles)


def _same(kept: list[Tensor], now: list[Tensor]) -> bool:
    return all(a.device == b.device and torch.equal(a, b) for a, b in zip(kept, now))
