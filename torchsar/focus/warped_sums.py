"""Four ways to compute the sum over pulses of the matched Fourier transform, and its adjoint.

The transform images a target that rotates non-uniformly. From pulses s_p it forms the image lines

    I_l = scale * sum_p s_p exp(+j 2 pi l x_p),    l = -(lines // 2), -(lines // 2) + 1, ...

where x_p is the phase step of pulse p from one line to the next in cycles. It is proportional to
the rotation angle at pulse p. `explicit` evaluates the sum directly. `gridded` and `compiled` use a
non-uniform FFT. `resampled` interpolates the pulses to equal steps of rotation angle and uses an
FFT. The settings of these methods are held by the classes of `focus.transforms`.

Reference:
    Remote Sens. 2025, 17, 3447, Eq. (9); Greengard and Lee 2004 (non-uniform FFT), see
    `focus.gridding`.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import block_bytes_of, linear_phasor, numbers_on
from torchsar.core.nufft import Kernel, cropped
from torchsar.core.spline import second_differences
from torchsar.focus.chirp_z import chirp_z
from torchsar.focus.gridding import PulseNufft
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


@dataclass(frozen=True)
class PulsesToLines:
    """Pulses and image lines between which one matched Fourier transform maps.

    Args:
        warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
            1/s^2, ..., shape (..., order - 1), float64.
        n_pulse: Number of pulses.
        prf_hz: Pulse rate in Hz.
        u: Rotation angle at each pulse over that of the whole aperture, shape (..., pulse),
            float64.
        cells_per_line: Step between image lines in Doppler cells, 1 / aperture time, shape (...,),
            float64.
        lines: Number of image lines.
        dtype: Complex type of the data.
    """

    warp_k: Tensor
    n_pulse: int
    prf_hz: float
    u: Tensor
    cells_per_line: Tensor
    lines: int
    dtype: torch.dtype

    @property
    def points(self) -> Tensor:
        """Phase step of each pulse from line to line in cycles, shape (..., pulse), float64."""
        return self.u * self.cells_per_line[..., None]

    @property
    def scale(self) -> float:
        """Factor on the sum over pulses, 1 / sqrt(number of pulses)."""
        return 1 / math.sqrt(self.n_pulse)


@dataclass(frozen=True)
class Sum:
    """Linear map from pulses to image lines by a Fourier sum over pulses, with its adjoint.

    Args:
        forward: Function of pulses (..., pulse, range), complex, that returns the image lines (...,
            line, range).
        adjoint: Function of image lines that returns pulses, the adjoint of `forward`.
    """

    forward: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]


def gridded(of: PulsesToLines, kernel: Kernel) -> Sum:
    """Form the sum by a non-uniform FFT with gridding, see `focus.gridding`.

    Args:
        of: Pulses and image lines.
        kernel: Gridding kernel.

    Returns:
        The sum and its adjoint.
    """
    plan = PulseNufft(of.lines, kernel, of.dtype, of.u.device, of.scale)
    points = plan.points(of.points)
    return Sum(partial(plan.type1, points=points), partial(plan.type2, points=points))


def explicit(of: PulsesToLines) -> Sum:
    """Form the sum directly, in blocks of lines.

    Args:
        of: Pulses and image lines.

    Returns:
        The sum and its adjoint.
    """
    points = of.points
    size = max(16, 32 * block_bytes_of(points.device) // (points.numel() * of.dtype.itemsize))
    blocks = [(at, min(size, of.lines - at)) for at in range(0, of.lines, size)]
    matrix = partial(_matrix, of, points)
    return Sum(partial(_explicit, matrix, blocks), partial(_explicit_adjoint, matrix, blocks))


def _matrix(of: PulsesToLines, points: Tensor, at: int, count: int) -> Tensor:
    """Matrix (..., pulse, line) of a block of `count` lines from line `at` on."""
    return of.scale * linear_phasor(points, at - of.lines // 2, count, of.dtype)


def _explicit(matrix: Callable[[int, int], Tensor], blocks: list[tuple[int, int]], pulses: Tensor) -> Tensor:
    """Form image lines (..., line, range) from pulses, block by block."""
    return torch.cat([matrix(*block).mT @ pulses for block in blocks], -2)


def _explicit_adjoint(matrix: Callable[[int, int], Tensor], blocks: list[tuple[int, int]], image: Tensor) -> Tensor:
    """Form pulses (..., pulse, range) from image lines, summed over the blocks."""
    parts = [matrix(at, count).conj() @ image[..., at : at + count, :] for at, count in blocks]
    return torch.stack(parts).sum(0)


def resampled(of: PulsesToLines, interpolation: str) -> Sum:
    """Form the sum by interpolation of the pulses to equal steps of rotation angle, and an FFT.

    An FFT gives equal weight to equal steps of angle, but the sum over pulses gives equal weight to
    equal steps of time. The interpolated pulses are therefore divided by the rotation rate relative
    to its mean.

    Args:
        of: Pulses and image lines.
        interpolation: "linear" or "spline".

    Returns:
        The sum and its adjoint, by automatic differentiation of the linear map.
    """
    interpolate = {"linear": _linear, "spline": _spline}[interpolation]
    time = times_of_even_angle(of.warp_k, of.n_pulse, of.prf_hz)
    duration = of.n_pulse / of.prf_hz
    rate = warp_rate(time, of.warp_k) * duration / whole_warp(of.warp_k, duration)
    position, factor = time * of.prf_hz, of.scale / rate
    forward = partial(_resampled, of=of, interpolate=interpolate, position=position, factor=factor)
    return Sum(forward, partial(_resampled_adjoint, forward=forward, shape=position.shape))


def _resampled(
    pulses: Tensor,
    of: PulsesToLines,
    interpolate: Callable[[Tensor, Tensor], Tensor],
    position: Tensor,
    factor: Tensor,
) -> Tensor:
    """Form image lines (..., line, range) from pulses, which are interpolated at positions in
    pulses and multiplied by factors.

    Positions and factors have the shape (..., pulse).
    """
    step, lines, n_pulse = of.cells_per_line, of.lines, of.n_pulse
    even = interpolate(pulses, position) * factor.to(pulses.real.dtype)[..., None]
    length = round(n_pulse / float(step)) if step.ndim == 0 and not step.requires_grad else 0
    if length < lines or abs(length * float(step) - n_pulse) > 1e-9 * n_pulse:
        per_pulse = step[..., None] / n_pulse
        return chirp_z(even.mT, lines // 2 * per_pulse, -per_pulse, lines, centre=0).mT
    return cropped(torch.fft.ifft(even.mT, length, norm="forward"), lines).mT


def _resampled_adjoint(image: Tensor, forward: Callable[[Tensor], Tensor], shape: tuple[int, ...]) -> Tensor:
    """Form pulses (..., pulse, range) from image lines. `shape` is (..., pulse)."""
    trials = np.broadcast_shapes(image.shape[:-2], shape[:-1])
    with torch.enable_grad():
        pulses = image.new_zeros(*trials, shape[-1], image.shape[-1]).requires_grad_()
        wanted = image.expand(*trials, *image.shape[-2:])
        return torch.autograd.grad(forward(pulses), pulses, wanted, create_graph=image.requires_grad)[0]


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
    """First approximation of the times of `times_of_even_angle`, linear between the values of the
    warp at the pulses.
    """
    table = warp(slow_times(n_pulse + 1, prf_hz, k.device), k)
    piece = (torch.searchsorted(table.contiguous(), angle.contiguous(), right=True) - 1).clamp(0, n_pulse - 1)
    low, high = table.gather(-1, piece), table.gather(-1, piece + 1)
    return (piece + (angle - low) / (high - low)) / prf_hz


def _linear(pulses: Tensor, position: Tensor) -> Tensor:
    """Interpolate pulses (..., pulse, range) linearly at positions (..., m) in pulses, (..., m,
    range); extrapolate at the ends.
    """
    piece, right = _piece(position, pulses)
    return (1 - right) * _pulses_at(pulses, piece) + right * _pulses_at(pulses, piece + 1)


def _spline(pulses: Tensor, position: Tensor) -> Tensor:
    """Interpolate pulses by a not-a-knot cubic spline, with the shapes of `_linear`."""
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
    """Take pulses[..., index, :] with one index per trial."""
    trials = np.broadcast_shapes(pulses.shape[:-2], index.shape[:-1])
    shape = (*trials, index.shape[-1], pulses.shape[-1])
    return pulses.expand(*trials, *pulses.shape[-2:]).gather(-2, index[..., None].expand(shape))


def compiled(of: PulsesToLines, eps: float) -> Sum:
    """Form the sum by the compiled library finufft in float64.

    Data of any precision are transformed in float64. In single precision the library would round
    points far from zero by a thousandth of a Doppler cell.

    Args:
        of: Pulses and image lines.
        eps: Relative error of the image lines.

    Returns:
        The sum and its adjoint.

    Raises:
        ModuleNotFoundError: If finufft is not installed.
    """
    _library()
    work = partial(_by_library, points=of.points, scale=of.scale, eps=eps)
    return Sum(partial(work, lines=of.lines), partial(work, lines=0))


def _by_library(x: Tensor, points: Tensor, scale: float, eps: float, lines: int) -> Tensor:
    """Form image lines from pulses if `lines` is above 0, otherwise pulses from image lines."""
    trials = np.broadcast_shapes(x.shape[:-2], points.shape[:-1])
    double = x.expand(*trials, *x.shape[-2:]).to(torch.complex128)
    made = _CompiledSum.apply(double, points.expand(*trials, points.shape[-1]), lines, eps)
    return made.to(x.dtype) * scale


class _CompiledSum(torch.autograd.Function):
    """Transform of type 1 into `lines` for lines > 0, otherwise its adjoint. It has first
    derivatives in data and points.
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
    """Lines times the derivative by the point of the exponent of the adjoint."""
    n = lines.shape[-2]
    line = torch.arange(n, dtype=torch.float64, device=lines.device) - n // 2
    return -2j * math.pi * line[:, None] * lines


def _compiled(x: Tensor, points: Tensor, lines: int, eps: float) -> Tensor:
    """Make one transform of the library per trial, because it takes one set of points at a time."""
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
    """Return the module finufft. Raises ModuleNotFoundError with the name of the extra where it is
    missing.
    """
    try:
        return importlib.import_module("finufft")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "CompiledNufft needs the package finufft: pip install 'torchsar-lab[nufft]', or choose Gridding()"
        ) from None
