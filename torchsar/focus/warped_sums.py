"""Four ways to compute the sum over pulses of the matched Fourier transform, and its adjoint.

The transform images a target that rotates non-uniformly. From pulses s_p it forms the image lines

    I_l = scale * sum_p s_p exp(+j 2 pi l x_p),    l = -(lines // 2), -(lines // 2) + 1, ...

where x_p is the phase step of pulse p from one line to the next in cycles. It is proportional to
the rotation angle at pulse p. `Explicit` evaluates the sum directly. `Gridded` and `Compiled` use a
non-uniform FFT. `Resampled` interpolates the pulses to equal steps of rotation angle and uses an
FFT. The settings of these methods are held by the classes of `focus.transforms`.

Reference:
    Remote Sens. 2025, 17, 3447, Eq. (9); Greengard and Lee 2004 (non-uniform FFT), see
    `focus.gridding`.
"""

from __future__ import annotations

import importlib
import math
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchsar.core import block_bytes_of, linear_phasor, numbers_on
from torchsar.core.spline import second_differences
from torchsar.focus.chirp_z import chirp_z
from torchsar.focus.gridding import PulseNufft
from torchsar.focus.nufft import Kernel
from torchsar.radar.warp import warp, warp_rate


def slow_times(n_pulse: int, prf_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Return the time of each pulse since the first pulse.

    Args:
        n_pulse: Number of pulses.
        prf_hz: Pulse rate in Hz.
        device: Device of the result.

    Returns:
        Times in seconds, shape (n_pulse,), float64.
    """
    return torch.arange(n_pulse, dtype=torch.float64, device=device) / prf_hz


def normalised_warp(k: Tensor, n_pulse: int, prf_hz: float) -> tuple[Tensor, Tensor]:
    """Compute the normalised warp u = phi(t) / phi(T) and its rate du/d(t/T) at the pulses.

    The warp phi(t) is the rotation angle divided by the rotation rate at the first pulse, and T is
    the aperture time n_pulse / prf_hz. The rate du/d(t/T) is 1 for uniform rotation.
    Differentiable.

    Args:
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1).
        n_pulse: Number of pulses.
        prf_hz: Pulse rate in Hz.

    Returns:
        u and its rate, shape (..., pulse) each, float64.
    """
    k = k.to(torch.float64)
    total = whole_warp(k, n_pulse / prf_hz)
    times = slow_times(n_pulse, prf_hz, k.device)
    return warp(times, k) / total, warp_rate(times, k) * (n_pulse / prf_hz) / total


def whole_warp(k: Tensor, duration_s: float) -> Tensor:
    """Compute the warped time phi(T) at the end of an aperture of duration T.

    It is the rotation angle of the whole aperture divided by the rotation rate at the first pulse.

    Args:
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1).
        duration_s: Aperture time T in seconds.

    Returns:
        phi(T) in seconds, shape (..., 1), float64.
    """
    return warp(numbers_on(k.device, duration_s), k)


class Sum(Protocol):
    """Linear map from pulses to image lines by a Fourier sum over pulses, with its adjoint."""

    def forward(self, pulses: Tensor) -> Tensor:
        """Transform pulses into image lines.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image lines, shape (..., line, range).
        """
        ...

    def adjoint(self, image: Tensor) -> Tensor:
        """Transform image lines into pulses by the adjoint of `forward`.

        Args:
            image: Image lines, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range).
        """
        ...


class Gridded:
    """Image lines as Fourier sums over pulses, by a non-uniform FFT with gridding.

    See `focus.gridding`.

    Args:
        points: Phase step of each pulse from one image line to the next in cycles, shape (...,
            pulse), float64.
        lines: Number of image lines.
        kernel: Gridding kernel.
        dtype: Complex type of the data.
        scale: Factor on the sum.
    """

    def __init__(self, points: Tensor, lines: int, kernel: Kernel, dtype: torch.dtype, scale: float) -> None:
        self.plan = PulseNufft(lines, kernel, dtype, points.device, scale)
        self.points = self.plan.points(points)

    def forward(self, pulses: Tensor) -> Tensor:
        """Transform pulses into image lines.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image lines, shape (..., line, range).
        """
        return self.plan.type1(pulses, self.points)

    def adjoint(self, image: Tensor) -> Tensor:
        """Transform image lines into pulses by the adjoint of `forward`.

        Args:
            image: Image lines, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range).
        """
        return self.plan.type2(image, self.points)


class Explicit:
    """Image lines as Fourier sums over pulses, evaluated directly in blocks of lines.

    Args:
        points: Phase step of each pulse from one image line to the next in cycles, shape (...,
            pulse), float64.
        lines: Number of image lines.
        dtype: Complex type of the data.
        scale: Factor on the sum.
    """

    def __init__(self, points: Tensor, lines: int, dtype: torch.dtype, scale: float) -> None:
        self.points, self.lines, self.dtype, self.scale = points, lines, dtype, scale

    def _blocks(self) -> list[tuple[int, int]]:
        """First line and number of lines of each block."""
        size = max(16, 32 * block_bytes_of(self.points.device) // (self.points.numel() * self.dtype.itemsize))
        return [(at, min(size, self.lines - at)) for at in range(0, self.lines, size)]

    def _matrix(self, at: int, count: int) -> Tensor:
        """Matrix (..., pulse, line) of a block of lines."""
        return self.scale * linear_phasor(self.points, at - self.lines // 2, count, self.dtype)

    def forward(self, pulses: Tensor) -> Tensor:
        """Transform pulses into image lines.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image lines, shape (..., line, range).
        """
        return torch.cat([self._matrix(*block).mT @ pulses for block in self._blocks()], -2)

    def adjoint(self, image: Tensor) -> Tensor:
        """Transform image lines into pulses by the adjoint of `forward`.

        Args:
            image: Image lines, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range).
        """
        parts = [self._matrix(at, count).conj() @ image[..., at : at + count, :] for at, count in self._blocks()]
        return torch.stack(parts).sum(0)


class Resampled:
    """Image lines as Fourier sums over pulses, by interpolation of the pulses and an FFT.

    The pulses are interpolated to equal steps of rotation angle. An FFT of them gives equal weight
    to equal steps of angle, but the sum over pulses gives equal weight to equal steps of time. The
    interpolated pulses are therefore divided by the rotation rate relative to its mean.

    Args:
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1), float64.
        n_pulse: Number of pulses.
        prf_hz: Pulse rate in Hz.
        step: Step between image lines in Doppler cells, shape (...,), float64. A Doppler cell is
            the inverse of the aperture time.
        lines: Number of image lines.
        interpolation: "linear" or "spline".
        scale: Factor on the sum.
    """

    def __init__(
        self, k: Tensor, n_pulse: int, prf_hz: float, step: Tensor, lines: int, interpolation: str, scale: float
    ) -> None:
        self.step, self.lines, self.n_pulse = step, lines, n_pulse
        self.interpolate = {"linear": _linear, "spline": _spline}[interpolation]
        time = times_of_even_angle(k, n_pulse, prf_hz)
        rate = warp_rate(time, k) * (n_pulse / prf_hz) / whole_warp(k, n_pulse / prf_hz)
        self.position, self.factor = time * prf_hz, scale / rate

    def forward(self, pulses: Tensor) -> Tensor:
        """Transform pulses into image lines.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image lines, shape (..., line, range).
        """
        even = self.interpolate(pulses, self.position) * self.factor.to(pulses.real.dtype)[..., None]
        length = round(self.n_pulse / float(self.step)) if self.step.ndim == 0 and not self.step.requires_grad else 0
        if length < self.lines or abs(length * float(self.step) - self.n_pulse) > 1e-9 * self.n_pulse:
            step = self.step[..., None] / self.n_pulse
            return chirp_z(even.mT, self.lines // 2 * step, -step, self.lines, centre=0).mT
        whole, half = torch.fft.ifft(even.mT, length, norm="forward"), self.lines // 2
        return torch.cat([whole[..., length - half :], whole[..., : self.lines - half]], -1).mT

    def adjoint(self, image: Tensor) -> Tensor:
        """Transform image lines into pulses by the adjoint of `forward`.

        The adjoint is found by automatic differentiation of the linear map.

        Args:
            image: Image lines, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range).
        """
        trials = np.broadcast_shapes(image.shape[:-2], self.position.shape[:-1])
        with torch.enable_grad():
            pulses = image.new_zeros(*trials, self.n_pulse, image.shape[-1]).requires_grad_()
            return torch.autograd.grad(
                self.forward(pulses), pulses, image.expand(*trials, *image.shape[-2:]), create_graph=image.requires_grad
            )[0]


def times_of_even_angle(k: Tensor, n_pulse: int, prf_hz: float) -> Tensor:
    """Compute the times at which the rotation angle has grown by equal steps.

    From the first pulse to time j the target turns by j / n_pulse of the rotation angle of the
    whole aperture, j = 0..n_pulse - 1. The times are found by Newton steps. Differentiable twice,
    since the last two steps carry gradients.

    Args:
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1), float64.
        n_pulse: Number of pulses.
        prf_hz: Pulse rate in Hz.

    Returns:
        Times since the first pulse in seconds, shape (..., n_pulse), float64.
    """
    duration = n_pulse / prf_hz
    angle = torch.arange(n_pulse, dtype=torch.float64, device=k.device) / n_pulse * whole_warp(k, duration)
    time = _table_times(angle.detach(), k.detach(), n_pulse, prf_hz)
    for step in range(4):
        at = k.detach() if step < 2 else k
        time = time - (warp(time, at) - (angle.detach() if step < 2 else angle)) / warp_rate(time, at)
    return time


def _table_times(angle: Tensor, k: Tensor, n_pulse: int, prf_hz: float) -> Tensor:
    """First approximation of these times, linear between the values of the warp at the pulses."""
    table = warp(slow_times(n_pulse + 1, prf_hz, k.device), k)
    piece = (torch.searchsorted(table.contiguous(), angle.contiguous(), right=True) - 1).clamp(0, n_pulse - 1)
    low, high = table.gather(-1, piece), table.gather(-1, piece + 1)
    return (piece + (angle - low) / (high - low)) / prf_hz


def _linear(pulses: Tensor, position: Tensor) -> Tensor:
    """Linear interpolation of pulses (..., pulse, range) at positions (..., m) in pulses, (..., m,
    range); extrapolated at the ends.
    """
    piece, right = _piece(position, pulses)
    return (1 - right) * _pulses_at(pulses, piece) + right * _pulses_at(pulses, piece + 1)


def _spline(pulses: Tensor, position: Tensor) -> Tensor:
    """Not-a-knot cubic spline through the pulses, with the shapes of `_linear`."""
    piece, right = _piece(position, pulses)
    parts = torch.view_as_real(pulses.resolve_conj()).movedim(-3, -1).to(torch.float64)
    bend = torch.view_as_complex(second_differences(parts).movedim(-1, -3).contiguous()).to(pulses.dtype)
    left = 1 - right
    straight = left * _pulses_at(pulses, piece) + right * _pulses_at(pulses, piece + 1)
    curved = (left**3 - left) * _pulses_at(bend, piece) + (right**3 - right) * _pulses_at(bend, piece + 1)
    return straight + curved / 6


def _piece(position: Tensor, pulses: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the pulse before each position, and the distance from it, (..., m, 1), in the
    precision of the pulses.
    """
    piece = torch.floor(position.detach()).clamp(0, pulses.shape[-2] - 2)
    return piece.to(torch.int64), (position - piece).to(pulses.real.dtype)[..., None]


def _pulses_at(pulses: Tensor, index: Tensor) -> Tensor:
    """pulses[..., index, :] with one index per trial."""
    trials = np.broadcast_shapes(pulses.shape[:-2], index.shape[:-1])
    shape = (*trials, index.shape[-1], pulses.shape[-1])
    return pulses.expand(*trials, *pulses.shape[-2:]).gather(-2, index[..., None].expand(shape))


class Compiled:
    """Image lines as Fourier sums over pulses, by the compiled library finufft in float64.

    Data of any precision are transformed in float64. In single precision the library would round
    points far from zero by a thousandth of a Doppler cell.

    Args:
        points: Phase step of each pulse from one image line to the next in cycles, shape (...,
            pulse), float64.
        lines: Number of image lines.
        eps: Relative error of the image lines.
        scale: Factor on the sum.

    Raises:
        ModuleNotFoundError: If finufft is not installed.
    """

    def __init__(self, points: Tensor, lines: int, eps: float, scale: float) -> None:
        _library()
        self.points, self.lines, self.eps, self.scale = points, lines, eps, scale

    def forward(self, pulses: Tensor) -> Tensor:
        """Transform pulses into image lines.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image lines, shape (..., line, range).
        """
        return _CompiledSum.apply(*self._together(pulses), self.lines, self.eps).to(pulses.dtype) * self.scale

    def adjoint(self, image: Tensor) -> Tensor:
        """Transform image lines into pulses by the adjoint of `forward`.

        Args:
            image: Image lines, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range).
        """
        return _CompiledSum.apply(*self._together(image), 0, self.eps).to(image.dtype) * self.scale

    def _together(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Data and points with the same trials, in double precision."""
        trials = np.broadcast_shapes(x.shape[:-2], self.points.shape[:-1])
        return x.expand(*trials, *x.shape[-2:]).to(torch.complex128), self.points.expand(*trials, self.points.shape[-1])


class _CompiledSum(torch.autograd.Function):
    """Type 1 into `lines` for lines > 0, otherwise its adjoint; first derivatives in data and
    points.
    """

    @staticmethod
    def forward(x: Tensor, points: Tensor, lines: int, eps: float) -> Tensor:
        return _compiled(x, points, lines, eps)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        x, points, ctx.lines, ctx.eps = inputs
        ctx.save_for_backward(x, points)
        ctx.save_for_forward(x, points)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        x, points = ctx.saved_tensors
        back = _compiled(gradient, points, 0 if ctx.lines else x.shape[-2], ctx.eps)
        image, pulses = (gradient, x) if ctx.lines else (x, gradient)
        slope = _compiled(_slope(image), points, 0, ctx.eps)
        return back, (pulses * slope.conj()).real.sum(-1), None, None

    @staticmethod
    def jvp(ctx: Any, of_x: Tensor | None, of_points: Tensor | None, *_: None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        x, points = ctx.saved_tensors
        out = 0 if of_x is None else _compiled(of_x, points, ctx.lines, ctx.eps)
        if of_points is None:
            return out  # pyright: ignore[reportReturnType]
        rate = of_points[..., None]
        if ctx.lines:
            return out - _slope(_compiled(rate * x, points, ctx.lines, ctx.eps))
        return out + rate * _compiled(_slope(x), points, 0, ctx.eps)


def _slope(lines: Tensor) -> Tensor:
    """Lines times the derivative of the exponent of the adjoint by the point."""
    n = lines.shape[-2]
    line = torch.arange(n, dtype=torch.float64, device=lines.device) - n // 2
    return -2j * math.pi * line[:, None] * lines


def _compiled(x: Tensor, points: Tensor, lines: int, eps: float) -> Tensor:
    """One transform of the library per trial, since it takes one set of points at a time."""
    library, n, columns = _library(), lines or points.shape[-1], x.shape[-1]
    rows = x.detach().mT.reshape(-1, columns, x.shape[-2]).contiguous().cpu().numpy()
    angles = (
        (2 * math.pi * torch.remainder(points.detach() + 0.5, 1) - math.pi).reshape(-1, points.shape[-1]).cpu().numpy()
    )
    options = {"eps": eps, "isign": 1 if lines else -1, "nthreads": torch.get_num_threads()}
    out = torch.empty(len(rows), columns, n, dtype=x.dtype)
    for row, angle, target in zip(rows, angles, out):
        made = library.nufft1d1(angle, row, (lines,), **options) if lines else library.nufft1d2(angle, row, **options)
        target.copy_(torch.from_numpy(made).reshape(columns, n))
    return out.to(x.device).view(*x.shape[:-2], columns, n).mT


def _library() -> Any:
    """The module finufft; raises ModuleNotFoundError with the name of the extra where it is
    missing.
    """
    try:
        return importlib.import_module("finufft")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "CompiledNufft needs the package finufft: pip install 'torchsar-lab[nufft]', or choose Gridding()"
        ) from None
