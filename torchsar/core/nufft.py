"""One-dimensional non-uniform FFT with separate points in every row, and its interpolation kernel.

Type 2 evaluates the spectrum of uniform samples at arbitrary frequencies, the points. Type 1 is its
adjoint: it sums values at arbitrary points into uniform samples. Either type uses a twice
oversampled FFT grid and a Kaiser-Bessel kernel whose width follows from the relative error `eps`.
The kernel is evaluated as a piecewise polynomial, by one small matrix product. Differentiable in
samples and points.

Reference:
    Fessler and Sutton 2003 (gridding); Barnett et al. 2019 (kernel as piecewise polynomial).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsar.core.fft import smooth_length
from torchsar.core.host import host_largest
from torchsar.core.phase import real_dtype, unit_phasor


@dataclass(frozen=True)
class Kernel:
    """Kaiser-Bessel interpolation kernel.

    `Kernel.of(eps)` chooses the width for a relative error. For equal error, an oversampling of
    1.25 needs about 1.6 times as many taps as one of 2, but an FFT of 5/8 the length.

    Args:
        taps: Width in grid points, 2 to 16.
        oversampling: Fineness of the grid relative to the samples, 1.25 to 2.

    Raises:
        ValueError: If a value lies outside its range.
    """

    taps: int
    oversampling: float = 2

    def __post_init__(self) -> None:
        if not (isinstance(self.taps, int) and 2 <= self.taps <= 16):
            raise ValueError(f"taps of a gridding kernel must be a whole number, 2 to 16 taps, got {self.taps}")
        if not 1.25 <= self.oversampling <= 2:
            raise ValueError(
                f"oversampling of a gridding kernel must be 1.25 to 2 times the samples, got {self.oversampling}"
            )

    @staticmethod
    def of(eps: float, oversampling: float = 2, even: bool = False) -> Kernel:
        """Choose the narrowest kernel whose relative error stays below eps.

        Args:
            eps: Relative error, 1e-13 to 0.1.
            oversampling: Fineness of the grid relative to the samples, 1.25 to 2.
            even: Choose an even width. Odd widths are the default, because with an even one the set
                of taps changes at points on the grid, and gradients there would be one-sided.

        Returns:
            The kernel.

        Raises:
            ValueError: If `eps` lies outside its range, or 16 taps do not reach it.
        """
        if not 1e-13 <= eps <= 0.1:
            raise ValueError(f"the relative error eps of a non-uniform FFT must lie in 1e-13..0.1, got eps={eps}")
        kernels = [Kernel(taps, oversampling) for taps in range(2 if even else 3, 17, 1 if even else 2)]
        for kernel in kernels:
            if kernel.error <= eps:
                return kernel
        raise ValueError(
            f"the relative error eps must be at least {kernels[-1].error:.1e} at an oversampling of {oversampling}, "
            f"got eps={eps}; choose a finer grid (oversampling up to 2)"
        )

    @property
    def error(self) -> float:
        """Upper estimate of the relative error of a transform with this kernel.

        It follows the theoretical decay with the number of taps. Errors measured against the direct
        sum are 1.2 to 5 times smaller.
        """
        free = 1 - 1 / self.oversampling
        return max(8 * free * math.sqrt(self.taps) * math.exp(-math.pi * self.taps * math.sqrt(free)), 3e-14)

    def grid_length(self, n: int) -> int:
        """Return the length of the oversampled FFT grid of n samples.

        Args:
            n: Number of samples.
        """
        return smooth_length(max(math.ceil(self.oversampling * n), 2 * self.taps))

    @property
    def shape(self) -> float:
        """Shape parameter of the kernel, 0.98 pi taps (1 - 1 / (2 oversampling))."""
        return math.pi * self.taps * (1 - 0.5 / self.oversampling) * 0.98

    def weights(self, offset: Tensor) -> Tensor:
        """Evaluate the kernel at the taps around points.

        Args:
            offset: Distance of each point from the middle of its taps in grid steps, -0.5..0.5,
                real, any shape.

        Returns:
            Weight of each tap, shape (taps, *offset.shape).
        """
        coefficients = _polynomials(self, offset.device).to(offset.dtype)
        u = 2 * offset
        powers = [torch.ones_like(u), u]
        for _ in range(coefficients.shape[-1] - 2):
            powers.append(powers[-1] * u)
        stacked = torch.stack(powers)
        return (coefficients @ stacked.flatten(1)).unflatten(-1, offset.shape)

    def spectrum(self, cycles: Tensor) -> Tensor:
        """Evaluate the Fourier transform of the kernel.

        Interpolation with the kernel multiplies samples by this factor; divide by it to correct.

        Args:
            cycles: Frequencies in cycles per grid step, float64, any shape.

        Returns:
            Spectrum, same shape, float64.
        """
        # sinh(x) / x for real or imaginary x, scaled as in `weights`
        square = self.shape**2 - (math.pi * self.taps * cycles).square()
        root = torch.sqrt(square.abs()).clamp_min(1e-12)
        return (
            self.taps
            * torch.where(square > 0, torch.sinh(root), torch.sin(root))
            / root
            / torch.special.i0(torch.full((), self.shape, dtype=torch.float64, device=cycles.device))
        )


@functools.lru_cache
def _polynomials(kernel: Kernel, device: torch.device) -> Tensor:
    """Coefficients of the piece of the kernel at each tap, float64 (taps, degree + 1), in powers of
    twice the offset.
    """
    # found by trial: taps - 1 still reaches the error of the kernel, taps - 2 does not
    degree = kernel.taps
    u = torch.cos(math.pi * (torch.arange(3 * degree, dtype=torch.float64) + 0.5) / (3 * degree))
    tap = torch.arange(kernel.taps, dtype=torch.float64) - (kernel.taps - 1) / 2
    z = 2 * (tap[:, None] - u / 2) / kernel.taps
    value = torch.special.i0(kernel.shape * torch.sqrt((1 - z.square()).clamp_min(0))) / torch.special.i0(
        torch.tensor(kernel.shape, dtype=torch.float64)
    )
    return torch.linalg.lstsq(u[:, None] ** torch.arange(degree + 1), value.T).solution.T.contiguous().to(device)


@dataclass(frozen=True)
class Points:
    """Grid indices and kernel weights of non-uniform points on a periodic grid.

    Args:
        first: Grid index of the first tap of each point, shape (..., m), int64.
        weights: Weight of each tap of each point, shape (taps, ..., m).
    """

    first: Tensor
    weights: Tensor

    @staticmethod
    def of(kernel: Kernel, start: Tensor, length: int, dtype: torch.dtype, shift: Tensor | None = None) -> Points:
        """Compute grid indices and kernel weights of points at the positions start + shift.

        Args:
            kernel: Interpolation kernel.
            start: Positions in grid steps, any numbers, periodic in `length`; float64, shape (m,)
                for all trials or (..., m).
            length: Length of the grid.
            dtype: Real type of the weights.
            shift: Offsets added to `start`, in grid steps, shape (..., m). Those in float64 are
                rounded to `dtype` where they are small enough for its precision.

        Returns:
            Points for `interpolate` and `spread`.
        """
        if shift is not None and shift.dtype != dtype:
            # up to 100 grid steps, float32 keeps the error of a transform below -90 dB
            small = host_largest(shift.detach().abs(), math.inf) < 100
            start, shift = (start, shift.to(dtype)) if small else (start + shift, None)
        start = start - (kernel.taps - 1) / 2
        whole = torch.round(start.detach())
        rest = (start - whole).to(dtype)
        if shift is not None:
            rest = rest + shift
            further = torch.round(rest.detach())
            whole, rest = whole + further, rest - further
        # NaN, which checks refuse later, must not become an index
        first = (whole - length * torch.floor(whole / length)).nan_to_num(0.0).to(torch.int64)
        return Points(first, kernel.weights(rest))


def interpolate(grid: Tensor, points: Points) -> Tensor:
    """Interpolate a periodic grid at points: sum over the taps of weight * grid[first + tap].

    Args:
        grid: Grid, shape (..., length), complex.
        points: Points, shape (..., m).

    Returns:
        Values at the points, shape (..., m).
    """
    taps, m = points.weights.shape[0], points.weights.shape[-1]
    rows = np.broadcast_shapes(grid.shape[:-1], points.first.shape[:-1])
    padded = torch.cat([grid, grid[..., : taps - 1]], -1).expand(*rows, grid.shape[-1] + taps - 1)
    flat, index = padded.reshape(-1), _flat_index(points.first.expand(*rows, m), padded.shape[-1])
    result = flat.index_select(0, index).reshape(*rows, m) * points.weights[0]
    for tap in range(1, taps):
        result += flat[tap:].index_select(0, index).reshape(*rows, m) * points.weights[tap]
    return result


def spread(values: Tensor, points: Points, length: int) -> Tensor:
    """Spread values at points onto a periodic grid, the adjoint of `interpolate`.

    Each value is multiplied by the weights of its taps and added to the grid there.

    Args:
        values: Values at the points, shape (..., m), complex.
        points: Points, shape (..., m).
        length: Length of the grid.

    Returns:
        Grid, shape (..., length).
    """
    taps, m = points.weights.shape[0], points.weights.shape[-1]
    rows = np.broadcast_shapes(values.shape[:-1], points.first.shape[:-1])
    width = length + taps - 1
    index = _flat_index(points.first.expand(*rows, m), width)
    first, *parts = ((values * weight).expand(*rows, m).reshape(-1) for weight in points.weights)
    flat = first.new_zeros(math.prod(rows) * width).scatter_add(0, index, first)
    for tap, part in enumerate(parts, 1):
        flat.scatter_add_(0, index + tap, part)
    padded = flat.view(*rows, width)
    return torch.cat([padded[..., : taps - 1] + padded[..., length:], padded[..., taps - 1 : length]], -1)


def _flat_index(first: Tensor, width: int) -> Tensor:
    """Index of the first tap of each point in the flattened grid of all rows."""
    row = torch.arange(math.prod(first.shape[:-1]), device=first.device) * width
    return (first + row.view(*first.shape[:-1], 1)).reshape(-1)


class Nufft:
    """Non-uniform FFT between uniform samples and their spectrum at arbitrary frequencies.

    The frequencies are called points and given in cycles per sample. An object is built for one
    length and accuracy and can be used for many rows.

    Args:
        n: Number of samples.
        eps: Relative error against the direct sum for white samples, as the root mean square over
            the points. With complex64 data it cannot fall below about 1e-6.
        dtype: Complex type of the data.
        device: Device of the data.

    Raises:
        ValueError: If `eps` lies outside 1e-13..0.1.
    """

    def __init__(self, n: int, eps: float, dtype: torch.dtype, device: torch.device | str | None = None) -> None:
        self.n, self.eps, self.dtype, self.kernel = n, eps, dtype, Kernel.of(eps)
        self.length = self.kernel.grid_length(n)
        offset = torch.arange(n, dtype=torch.float64, device=device) - n // 2
        self._factors: dict[float, Tensor] = {}
        self.weight = (1 / self.kernel.spectrum(offset / self.length)).to(real_dtype(dtype))

    def points(self, cycles_per_sample: Tensor) -> Points:
        """Compute grid indices and kernel weights of frequencies, for use in several transforms.

        Args:
            cycles_per_sample: Frequencies in cycles per sample, shape (..., m), float64, any real
                numbers (periodic in 1).

        Returns:
            Points for `type1` and `type2`.

        Raises:
            TypeError: If the frequencies are not float64.
        """
        if cycles_per_sample.dtype != torch.float64:
            raise TypeError(
                f"points of a non-uniform FFT must be float64 cycles per sample, got {cycles_per_sample.dtype}"
            )
        return Points.of(self.kernel, cycles_per_sample * self.length, self.length, real_dtype(self.dtype))

    def grid(self, x: Tensor) -> Tensor:
        """Compute the oversampled spectrum of samples, the grid that `interpolate` takes.

        Args:
            x: Samples, shape (..., n), complex.

        Returns:
            Spectrum, shape (..., length).
        """
        return torch.fft.fft(embedded(x * self.weight, self.length))

    def type2(self, x: Tensor, points: Points) -> Tensor:
        """Evaluate the spectrum of samples at points p: sum_j x_j exp(-2j pi p (j - n//2)).

        Args:
            x: Samples, shape (..., n), complex.
            points: Points p, shape (..., m), prepared by `points`.

        Returns:
            Spectrum at the points, shape (..., m).
        """
        return interpolate(self.grid(x), points)

    def shift_spectrum(self, x: Tensor, shift: Tensor, reach: float) -> Tensor:
        """Compute the samples whose spectrum is that of given samples at shifted frequencies.

        The spectrum at bin k is that of the given samples at bin k + s_k, where phases refer to
        sample n//2.

        Args:
            x: Samples, shape (..., n), complex.
            shift: Shifts s_k in bins, in FFT order, shape (..., n), real.
            reach: Bound of their magnitude; infinite where it is not known. Where it is small, a
                power series in the shift replaces interpolation for complex64 samples.

        Returns:
            Samples, shape (..., n).
        """
        series = self._series(x, reach)
        if series is None:
            fine = self.length / self.n
            bins = fine * torch.arange(self.n, dtype=torch.float64, device=x.device)
            points = Points.of(self.kernel, bins, self.length, real_dtype(x.dtype), fine * shift)
            return torch.fft.fftshift(torch.fft.ifft(self.type2(x, points)), dim=-1)
        first, *factors = series.conj()
        if not factors:
            return x * first
        shift = shift.to(x.dtype)
        return x * first + torch.fft.ifft(_horner(x, factors, torch.fft.fft, shift) * shift)

    def shift_samples(self, x: Tensor, shift: Tensor, reach: float) -> Tensor:
        """Evaluate samples at shifted places: y_i = sum_k x_k exp(2j pi f_k (i + s_i) / n).

        Args:
            x: Spectrum of the samples in FFT order, shape (..., n), complex. Frequencies f_k are
                whole numbers with |f_k| <= n/2.
            shift: Shifts s_i in samples, shape (..., n), real.
            reach: Bound of their magnitude; infinite where it is not known. Where it is small, a
                power series in the shift replaces interpolation for complex64 samples.

        Returns:
            Values at the places i + s_i, shape (..., n).
        """
        series = self._series(x, reach)
        if series is None:
            fine = -self.length / self.n
            places = fine * torch.arange(self.n, dtype=torch.float64, device=x.device)
            points = Points.of(self.kernel, places, self.length, real_dtype(x.dtype), fine * shift)
            return self.type2(torch.fft.fftshift(x, dim=-1), points)
        inverse = functools.partial(torch.fft.ifft, norm="forward")
        return _horner(x, list(torch.fft.ifftshift(series, dim=-1)), inverse, shift.to(x.dtype))

    def _series(self, x: Tensor, reach: float, most: int = 12) -> Tensor | None:
        """Factors c_k (terms, n) of the power series exp(2j pi q s / n) = sum_k c_k(q) s^k.

        The series holds for shifts |s| <= reach, and q = -n//2, ... It is the polynomial through
        Chebyshev nodes. None if more than `most` terms are needed, which take longer than
        interpolation, and in complex128.
        """
        if x.dtype != torch.complex64 or not reach < most:
            return None
        # few values, for which factors are kept
        reach = 2 ** (math.ceil(8 * math.log2(max(reach, 1e-9))) / 8)
        # The first term left out, as root mean square over q, is a tenth of the error: the number
        # of terms may differ between blocks and batches, which this makes negligible.
        left_out = (2 * (math.pi * reach / 2) ** k / (math.factorial(k) * math.sqrt(2 * k + 1)) for k in range(1, most))
        terms = next((k for k, size in enumerate(left_out, 1) if size <= self.eps / 10), None)
        if terms is None:
            return None
        if reach not in self._factors:
            order = torch.arange(terms, dtype=torch.float64, device=x.device)
            nodes = reach * torch.cos(math.pi * (order + 0.5) / terms)
            cycles = (torch.arange(self.n, dtype=torch.float64, device=x.device) - self.n // 2) / self.n
            scaled = torch.linalg.solve(
                ((nodes / reach)[:, None] ** order).to(torch.complex128),
                unit_phasor(nodes[:, None] * cycles, torch.complex128),
            )
            self._factors[reach] = (scaled / (reach**order)[:, None]).to(x.dtype)
        return self._factors[reach]

    def type1(self, y: Tensor, points: Points) -> Tensor:
        """Apply the adjoint of `type2`: x_j = sum_k y_k exp(+2j pi p_k (j - n//2)).

        Args:
            y: Values y_k at the points p_k, shape (..., m), complex.
            points: Points p_k, shape (..., m), prepared by `points`.

        Returns:
            Samples x_j, j = 0..n-1, shape (..., n).
        """
        return cropped(torch.fft.ifft(spread(y, points, self.length), norm="forward"), self.n) * self.weight


def _horner(x: Tensor, factors: list[Tensor], transform: Callable[[Tensor], Tensor], shift: Tensor) -> Tensor:
    """Sum over k of transform(x * factors[k]) * shift^k."""
    total = transform(x * factors[-1])
    for factor in factors[-2::-1]:
        total = torch.addcmul(transform(x * factor), total, shift)
    return total


def embedded(x: Tensor, length: int, dim: int = -1) -> Tensor:
    """Embed centred samples in a longer circular array: sample n // 2 comes first.

    Args:
        x: Samples, n along `dim`.
        length: Length of the array.
        dim: Dimension of the samples.

    Returns:
        Array, `length` along `dim`.
    """
    n, shape = x.shape[dim], list(x.shape)
    shape[dim] = length - n
    return torch.cat([x.narrow(dim, n // 2, n - n // 2), x.new_zeros(shape), x.narrow(dim, 0, n // 2)], dim)


def cropped(x: Tensor, n: int, dim: int = -1) -> Tensor:
    """Cut n centred samples from a circular array, the adjoint of `embedded`.

    Args:
        x: Array whose first sample is the middle of the result.
        n: Number of samples.
        dim: Dimension of the samples.

    Returns:
        Samples, n along `dim`.
    """
    half = n // 2
    return torch.cat([x.narrow(dim, x.shape[dim] - half, half), x.narrow(dim, 0, n - half)], dim)
