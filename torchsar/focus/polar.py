"""Polar format by gridding: the image as one two-dimensional non-uniform FFT.

    image(x, y) = sum_k sum_f s_k(f) exp(+4j pi f / c (u_k . (x, y) + offset_k)),

where s_k(f) is the sample of pulse k at frequency f. The range of a ground point (x, y) in pulse k
is that of a plane wave, the scalar product with the direction u_k plus offset_k (`FarField`). The
sum is backprojection with these ranges. The samples lie on a polar raster of wave vectors
2 f / c u_k. A Kaiser-Bessel kernel spreads them onto a twice oversampled rectangular grid, an FFT
forms the image, and a division by the spectrum of the kernel corrects the spreading. The spreading
is stored as a sparse matrix, whose transpose gives the exact adjoint.

Reference:
    Fessler and Sutton 2003 (gridding); Carrara, Goodman and Majewski 1995, ch. 3 (polar format).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, block_bytes_of, real_dtype, unit_phasor
from torchsar.core.nufft import Nufft, cropped, embedded
from torchsar.focus.gridding import LinearMap
from torchsar.focus.spotlight import GroundImager, aperture_weights, refuse_other_size
from torchsar.radar.spotlight import FarField, Spotlight, frequency_samples, range_profiles


@dataclass(frozen=True, eq=False)
class SparseRows:
    """A real sparse matrix in compressed rows, as plain tensors that can be copied and pickled.

    Args:
        starts: First entry of each row, shape (rows + 1,).
        columns: Column of each entry.
        weights: Value of each entry, real.
        size: Number of rows and columns.
    """

    starts: Tensor
    columns: Tensor
    weights: Tensor
    size: tuple[int, int]

    def __call__(self, x: Tensor) -> Tensor:
        """Multiply the matrix with complex vectors (trial, columns), giving (trial, rows).

        The real and imaginary parts of all trials are the columns of one product.
        """
        vectors = torch.view_as_real(x.resolve_conj()).movedim(0, 1)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
            matrix = torch.sparse_csr_tensor(self.starts, self.columns, self.weights, self.size, check_invariants=False)
        product = (matrix @ vectors.flatten(1)).view(self.size[0], -1, 2)
        return torch.view_as_complex(product.movedim(1, 0).contiguous())


def sparse_pair(row: Tensor, weight: Tensor, rows: int) -> tuple[SparseRows, SparseRows]:
    """Build a sparse matrix and its transpose from the entries of each column of the matrix.

    Args:
        row: Row of each entry, shape (column, entry), int64.
        weight: Value of each entry, shape (column, entry), real.
        rows: Number of rows of the matrix.

    Returns:
        The matrix and its transpose.
    """
    columns, entries = row.shape
    kind = torch.int32 if max(row.numel(), rows) < 2**31 else torch.int64
    flat = row.reshape(-1)
    order = torch.argsort(flat.to(kind), stable=True)
    starts = torch.cat([row.new_zeros(1), torch.bincount(flat, minlength=rows).cumsum(0)])
    every = entries * torch.arange(columns + 1, device=row.device)
    values = weight.reshape(-1)
    matrix = SparseRows(starts.to(kind), (order // entries).to(kind), values[order], (rows, columns))
    return matrix, SparseRows(every.to(kind), flat.to(kind), values, (columns, rows))


class PolarOperator:
    """Linear map from range profiles to an image by polar format, with its exact adjoint.

    >>> import torch
    >>> from torchsar import Axis, focus, radar
    >>> geometry = radar.FarField.turntable(
    ...     1e10 + 2e7 * torch.arange(32).double(), 0.01 * torch.arange(16).double())
    >>> azimuth, range_ = (Axis(name, 17, -4.0, 0.5, "m") for name in ("azimuth", "range"))
    >>> operator = focus.PolarOperator(geometry, azimuth, range_)
    >>> float(operator.image(radar.range_profiles(torch.ones(16, 32) + 0j))[8, 8].abs().round())
    512.0

    The operator is built for one geometry, which all trials share, for one dtype and for the device
    of the geometry. Building takes under a second; the operator occupies 20 bytes x kernel taps^2
    per sample (complex64). A point of unit amplitude has a peak of the sum of the window weights.
    Differentiable in the profiles.

    Args:
        geometry: Plane waves. The range axis of the image is the first ground direction (x), the
            azimuth axis the second (y); use `FarField.turned` for other directions.
        azimuth: Azimuth axis of the image in metres.
        range_: Range axis of the image in metres.
        window: "none" or "hann", over pulses and over frequencies.
        eps: Relative error of the image against the direct sum.
        dtype: Complex type of the data.

    Raises:
        ValueError: If `window` is not known or `eps` lies outside 1e-13..0.1.
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
        self._y, self._x = (Nufft(axis.n, eps, dtype, device) for axis in (azimuth, range_))
        wave_number = 2 / geometry.wave_speed_m_s * geometry.frequency_hz  # cycles per metre
        cycles = (geometry.direction[:, :, None] * wave_number).unbind(1)
        (column, across), (row, down) = (
            _taps(plan, of.reshape(-1) * axis.step)
            for plan, of, axis in zip((self._x, self._y), cycles, (range_, azimuth), strict=True)
        )
        cell = row[:, :, None] * self._x.length + column[:, None, :]
        weight = down[:, :, None] * across[:, None, :]
        self._spread = sparse_pair(cell.flatten(1), weight.flatten(1), self._y.length * self._x.length)
        middle = [axis.start + (axis.n // 2) * axis.step for axis in (range_, azimuth)]
        centre = geometry.direction @ geometry.direction.new_tensor(middle) + geometry.offset_m
        self._factor = aperture_weights(window, geometry).to(real) * unit_phasor(centre[:, None] * wave_number, dtype)
        self._unkernel = self._y.weight[:, None] * self._x.weight

    def image(self, profiles: Tensor) -> Tensor:
        """Form the polar-format image of range profiles.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.

        Returns:
            Image, shape (..., azimuth, range).

        Raises:
            TypeError: If the dtype is not that of the operator.
            ValueError: If the size is not that of the geometry.
        """
        refuse_other_size(profiles, self.geometry)
        self._check_dtype(profiles)
        return self._by_trials(self._image, profiles)

    def _image(self, profiles: Tensor) -> Tensor:
        """Image of one block of trials."""
        samples = frequency_samples(profiles) * self._factor
        grid = LinearMap.apply(samples.flatten(-2), *self._spread).unflatten(-1, (self._y.length, self._x.length))
        columns = cropped(torch.fft.ifft(grid, dim=-2, norm="forward"), self._y.n, -2)
        return cropped(torch.fft.ifft(columns, norm="forward"), self._x.n) * self._unkernel

    def adjoint(self, image: Tensor) -> Tensor:
        """Map an image to range profiles by the adjoint of `image`.

        Args:
            image: Image, shape (..., azimuth, range), complex.

        Returns:
            Range profiles, shape (..., pulse, range), with <image(p), i> = <p, adjoint(i)> and
            <a, b> = sum a conj(b).

        Raises:
            TypeError: If the dtype is not that of the operator.
            ValueError: If the image does not have the size of the axes of the operator.
        """
        self._check_dtype(image)
        if tuple(image.shape[-2:]) != (self.azimuth.n, self.range.n):
            raise ValueError(
                f"image of shape {tuple(image.shape)} does not end in the (azimuth, range) = "
                f"({self.azimuth.n}, {self.range.n}) sizes of the operator"
            )
        return self._by_trials(self._adjoint, image)

    def _adjoint(self, image: Tensor) -> Tensor:
        """Adjoint of `_image` for one block of trials."""
        columns = torch.fft.fft(embedded(image * self._unkernel, self._x.length))
        grid = torch.fft.fft(embedded(columns, self._y.length, -2), dim=-2)
        samples = LinearMap.apply(grid.flatten(-2), *self._spread[::-1]).unflatten(-1, self._factor.shape)
        return range_profiles(samples * self._factor.conj())

    def _by_trials(self, work: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
        """Apply `work` to blocks of trials whose grids fit into the cache."""
        count = max(1, 8 * block_bytes_of(x.device) // (self._y.length * self._x.length * x.element_size()))
        flat = x.reshape(-1, *x.shape[-2:])
        out = work(flat) if flat.shape[0] <= count else torch.cat([work(part) for part in flat.split(count)])
        return out.view(*x.shape[:-2], *out.shape[-2:])

    def _check_dtype(self, x: Tensor) -> None:
        """Raise TypeError for data of another dtype."""
        if x.dtype != self.dtype:
            raise TypeError(
                f"this polar operator was built for {self.dtype}, got {x.dtype}; build it with dtype={x.dtype}"
            )


class PolarFormat(GroundImager):
    """Stage that images the ground plane by polar format; arguments as in `GroundImager`.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> geometry = radar.FarField.turntable(
    ...     1e10 + 2e7 * torch.arange(32).double(), 0.01 * torch.arange(16).double())
    >>> signal = Signal(radar.range_profiles(torch.ones(16, 32) + 0j),
    ...     radar.InverseRadar(1.032e10, 6.4e8, 100.0).raw_axes(16, 32))
    >>> image = focus.PolarFormat(extent_m=8.0, step_m=0.5, geometry=geometry)(signal)
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    The curvature of the wavefront is neglected; `Spotlight.neglected_range_m` gives the error. The
    operator of the last geometry is stored; `operator` returns it for use in autofocus loops.
    """

    _kept: tuple[list[Tensor], PolarOperator] | None = None

    def operator(self, profiles: Tensor, geometry: FarField | Spotlight) -> PolarOperator:
        """Return the polar-format operator for a geometry and the dtype of the profiles.

        A repeated call with the same geometry and dtype returns the stored operator.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            geometry: Geometry in ground coordinates with x along the range axis of the image, as
                from `FarField.turned`.

        Returns:
            Map from range profiles to the image, with its adjoint.
        """
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
        """Form the image of range profiles by polar format.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            geometry: Geometry in ground coordinates with x along the range axis of the image.
            azimuth: Azimuth axis of the image.
            range_: Range axis of the image.

        Returns:
            Image, shape (..., azimuth, range).
        """
        return self.operator(profiles, geometry).image(profiles)


def _taps(plan: Nufft, cycles: Tensor) -> tuple[Tensor, Tensor]:
    """Grid index and weight of all taps, (sample, tap), for wave numbers in cycles per pixel."""
    points = plan.points(cycles)
    tap = torch.arange(plan.kernel.taps, device=cycles.device)
    return (points.first[:, None] + tap) % plan.length, points.weights.T


def _same(kept: list[Tensor], now: list[Tensor]) -> bool:
    """True if two geometries are equal."""
    return all(a.device == b.device and torch.equal(a, b) for a, b in zip(kept, now))
