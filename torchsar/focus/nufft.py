"""One-dimensional non-uniform Fourier transforms with points of their own in every row, and the
interpolation kernel behind them.

Type 2 evaluates the spectrum of uniform samples at arbitrary frequencies, type 1 is its adjoint: it
sums samples taken at arbitrary points into uniform frequencies. Both go over a twice oversampled
FFT grid with a Kaiser-Bessel kernel whose width follows from the wanted accuracy `eps`; the kernel
is evaluated as one small matrix product of polynomials. Differentiable in samples and points.
Source: Fessler and Sutton 2003 (gridding), Barnett et al. 2019 (kernel as piecewise polynomial);
own code.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import real_dtype

OVERSAMPLING = 2


@dataclass(frozen=True)
class Kernel:
    """Kaiser-Bessel interpolation kernel of `taps` grid points, 2..16, on a grid `oversampling`
    times as fine as the samples, 1.25..2.

    `Kernel.of(eps)` chooses the width. A grid of 1.25 needs about 1.6 times the taps of one of 2
    and an FFT of 5/8 the length.
    """

    taps: int
    oversampling: float = OVERSAMPLING

    def __post_init__(self) -> None:
        if not (isinstance(self.taps, int) and 2 <= self.taps <= 16):
            raise ValueError(f"a gridding kernel has 2 to 16 taps, got {self.taps}")
        if not 1.25 <= self.oversampling <= 2:
            raise ValueError(
                f"the grid of a gridding kernel is 1.25 to 2 times as fine as the samples, got {self.oversampling}"
            )

    @staticmethod
    def of(eps: float, oversampling: float = OVERSAMPLING, even: bool = False) -> Kernel:
        """The narrowest kernel whose relative error stays below eps.

        Raises ValueError outside 1e-13..0.1, or where 16 taps are too few.

        Odd widths unless `even`: with an even one, points on the grid lie where the set of taps
        changes, and gradients there would be one-sided.
        """
        if not 1e-13 <= eps <= 0.1:
            raise ValueError(f"a non-uniform FFT reaches relative errors of 1e-13 to 0.1, got eps={eps}")
        kernels = [Kernel(taps, oversampling) for taps in range(2 if even else 3, 17, 1 if even else 2)]
        for kernel in kernels:
            if kernel.error <= eps:
                return kernel
        raise ValueError(
            f"a kernel on a grid of oversampling {oversampling} reaches a relative error of "
            f"{kernels[-1].error:.1e}, got eps={eps}; choose a finer grid, up to 2"
        )

    @property
    def error(self) -> float:
        """Relative error: the theoretical decay at a level that measurements against the direct sum
        stay 1.2 to 5 times below.
        """
        free = 1 - 1 / self.oversampling
        return max(8 * free * math.sqrt(self.taps) * math.exp(-math.pi * self.taps * math.sqrt(free)), 3e-14)

    @property
    def shape(self) -> float:
        return math.pi * self.taps * (1 - 0.5 / self.oversampling) * 0.98

    def weights(self, offset: Tensor) -> Tensor:
        """Kernel values at the taps around a point.

        offset: real (...,), point minus nearest centre tap, -0.5..0.5. Returns (taps, ...).
        """
        coefficients = _polynomials(self).to(dtype=offset.dtype, device=offset.device)
        u = 2 * offset
        powers = [torch.ones_like(u), u]
        for _ in range(coefficients.shape[-1] - 2):
            powers.append(powers[-1] * u)
        stacked = torch.stack(powers)
        return (coefficients @ stacked.flatten(1)).unflatten(-1, offset.shape)

    def spectrum(self, cycles: Tensor) -> Tensor:
        """Fourier transform of the kernel at `cycles` per grid step, float64: what the
        interpolation multiplies its input by.
        """
        # sinh(x) / x of a real or imaginary x, scaled as weights() are
        square = self.shape**2 - (math.pi * self.taps * cycles).square()
        root = torch.sqrt(square.abs()).clamp_min(1e-12)
        return (
            self.taps
            * torch.where(square > 0, torch.sinh(root), torch.sin(root))
            / root
            / torch.special.i0(torch.tensor(self.shape, dtype=torch.float64, device=cycles.device))
        )


@functools.lru_cache
def _polynomials(kernel: Kernel) -> Tensor:
    """Coefficients of each tap's piece of the kernel in powers of twice the offset, float64 (taps,
    degree + 1).
    """
    degree = kernel.taps  # one less still reaches the kernel's own error, two less does not
    u = torch.cos(math.pi * (torch.arange(3 * degree, dtype=torch.float64) + 0.5) / (3 * degree))
    tap = torch.arange(kernel.taps, dtype=torch.float64) - (kernel.taps - 1) / 2
    z = 2 * (tap[:, None] - u / 2) / kernel.taps
    value = torch.special.i0(kernel.shape * torch.sqrt((1 - z.square()).clamp_min(0))) / torch.special.i0(
        torch.tensor(kernel.shape, dtype=torch.float64)
    )
    return torch.linalg.lstsq(u[:, None] ** torch.arange(degree + 1), value.T).solution.T.contiguous()


@dataclass(frozen=True)
class Points:
    """Where rows are evaluated: index of the first tap, periodic, int64 (..., m), and the tap
    weights (taps, ..., m).
    """

    first: Tensor
    weights: Tensor

    @staticmethod
    def of(kernel: Kernel, start: Tensor, length: int, dtype: torch.dtype, shift: Tensor | None = None) -> Points:
        """Positions start + shift in grid steps, any numbers, periodic in `length`.

        start: float64, often one (m,) for all rows; shift: real (..., m), small enough for its own
        precision. dtype: of the weights.
        """
        start = start - (kernel.taps - 1) / 2
        whole = torch.round(start.detach())
        rest = (start - whole).to(dtype)
        if shift is not None:
            rest = rest + shift
        further = torch.round(rest.detach())
        first = torch.remainder(whole.to(torch.int64) + further.to(torch.int64), length)
        return Points(first, kernel.weights(rest - further))


def interpolate(grid: Tensor, points: Points) -> Tensor:
    """Sum over taps of weight * grid[first + tap], periodic.

    grid: complex (..., length); points (..., m). Returns (..., m).
    """
    taps, m = points.weights.shape[0], points.weights.shape[-1]
    rows = torch.broadcast_shapes(grid.shape[:-1], points.first.shape[:-1])
    padded = torch.cat([grid, grid[..., : taps - 1]], -1).expand(*rows, grid.shape[-1] + taps - 1)
    flat, index = padded.reshape(-1), _flat_index(points.first.expand(*rows, m), padded.shape[-1])
    result = flat.index_select(0, index).reshape(*rows, m) * points.weights[0]
    for tap in range(1, taps):
        result += flat[tap:].index_select(0, index).reshape(*rows, m) * points.weights[tap]
    return result


def spread(values: Tensor, points: Points, length: int) -> Tensor:
    """Adjoint of interpolate: adds weight * value onto the grid. values: complex (..., m).

    Returns (..., length).
    """
    taps, m = points.weights.shape[0], points.weights.shape[-1]
    rows = torch.broadcast_shapes(values.shape[:-1], points.first.shape[:-1])
    width = length + taps - 1
    index = _flat_index(points.first.expand(*rows, m), width)
    flat = torch.zeros(math.prod(rows) * width, dtype=values.dtype, device=values.device)
    for tap, weight in enumerate(points.weights.unbind(0)):
        flat = flat.index_add(0, index + tap, (values * weight).expand(*rows, m).reshape(-1))
    padded = flat.view(*rows, width)
    return padded[..., :length] + pad(padded[..., length:], (0, length - taps + 1))


def _flat_index(first: Tensor, width: int) -> Tensor:
    row = torch.arange(math.prod(first.shape[:-1]), device=first.device) * width
    return (first + row.view(*first.shape[:-1], 1)).reshape(-1)


class Nufft:
    """Transforms between n uniform samples and points in cycles per sample, for one length and
    accuracy; build once, use for many rows.

    eps: relative error (root mean square over the points against the direct sum, for white
    samples); complex64 data end at about 1e-6.
    """

    def __init__(self, n: int, eps: float, dtype: torch.dtype, device: torch.device | str | None = None) -> None:
        self.n, self.dtype, self.kernel = n, dtype, Kernel.of(eps)
        self.length = smooth_length(max(OVERSAMPLING * n, 2 * self.kernel.taps))
        offset = torch.arange(n, dtype=torch.float64, device=device) - n // 2
        self.weight = (1 / self.kernel.spectrum(offset / self.length)).to(real_dtype(dtype))

    def points(self, cycles_per_sample: Tensor) -> Points:
        """Prepare points, float64 (..., m), any real numbers (periodic in 1); they can be used for
        several arrays.
        """
        return Points.of(self.kernel, cycles_per_sample * self.length, self.length, real_dtype(self.dtype))

    def grid(self, x: Tensor) -> Tensor:
        """The oversampled spectrum that `interpolate` takes points from.

        x: (..., n) -> (..., length).
        """
        x = x * self.weight
        half = self.n // 2
        gap = x.new_zeros((*x.shape[:-1], self.length - self.n))
        return torch.fft.fft(torch.cat([x[..., half:], gap, x[..., :half]], -1))

    def type2(self, x: Tensor, points: Points) -> Tensor:
        """sum_j x_j exp(-2j pi p (j - n//2)). x: (..., n) -> (..., m)."""
        return interpolate(self.grid(x), points)

    def type1(self, y: Tensor, points: Points) -> Tensor:
        """sum_k y_k exp(+2j pi p_k (j - n//2)), the adjoint of type2. y: (..., m) -> (..., n)."""
        x = torch.fft.ifft(spread(y, points, self.length), norm="forward")
        half = self.n // 2
        return torch.cat([x[..., self.length - half :], x[..., : self.n - half]], -1) * self.weight


def nufft_type2(x: Tensor, points: Tensor, eps: float = 1e-6) -> Tensor:
    """Spectrum of uniform samples at any frequencies, sum_j x_j exp(-2j pi p (j - n//2)).

    x: complex (..., n); points: float64 (..., m) in cycles per sample, rows of their own or shared;
    leading dims broadcast. Returns (..., m). Differentiable in both. Raises TypeError where points
    are not float64: float32 holds no fine place in a long row.
    """
    plan = Nufft(x.shape[-1], eps, x.dtype, x.device)
    return plan.type2(x, plan.points(_as_points(points)))


def nufft_type1(y: Tensor, points: Tensor, n: int, eps: float = 1e-6) -> Tensor:
    """Adjoint of nufft_type2: x_j = sum_k y_k exp(+2j pi p_k (j - n//2)), j = 0..n-1.

    y: (..., m), points: float64 (..., m) -> (..., n).
    """
    plan = Nufft(n, eps, y.dtype, y.device)
    return plan.type1(y, plan.points(_as_points(points)))


def _as_points(points: Tensor) -> Tensor:
    if points.dtype != torch.float64:
        raise TypeError(f"points of a non-uniform FFT are float64 cycles per sample, got {points.dtype}")
    return points


def smooth_length(n: int) -> int:
    """The least FFT length >= n with no prime factor above 5."""

    def is_smooth(k: int) -> bool:
        for p in (2, 3, 5):
            while k % p == 0:
                k //= p
        return k == 1

    return next(k for k in range(n, 2 * n + 1) if is_smooth(k))
