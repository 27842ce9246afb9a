"""Matched Fourier transform: azimuth focusing of a target whose rotation is uneven, as a Fourier transform over the warped time.

Data (..., pulse, range) hold exp(-j c4 x Om phi(t)) exp(+j (c4/2) (y_n + yc) Om^2 phi(t)^2) for each scatterer, c4 = 4 pi / wavelength, with the warp
phi(t) = `core.warp.warp(t, k)`, t = 0 at the first pulse. `range_phase` takes out the second factor, `matched_fourier` focuses the first:
I(q, n) = sum_m w_m s(m, n) exp(+2j pi c_q u_m) / sqrt(pulses), u = phi(t) / phi(T) in [0, 1), T = pulses / prf, c_q = (q - lines // 2) / oversampling.
The line axis is c / T, Doppler at the mean rate; cross range is x = wavelength c / (2 Om phi(T)). Only Om^2 shows in the data: images may be mirrored in x.
Source: Remote Sens. 2025, 17, 3447, Eqs. (7)-(10), with the warp of `core.warp`; Greengard and Lee 2004 (non-uniform FFT).
"""

from __future__ import annotations

import importlib
import math
import warnings
from typing import Any, Protocol

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, block_bytes_of, linear_phasor, outer_phasor, per_trial, phasor_tables, real_dtype, unit_phasor
from torchsar.core.spline import second_differences
from torchsar.core.warp import least_rate, warp, warp_rate
from torchsar.focus.chirp_z import chirp_z
from torchsar.focus.gridding import PulseNufft
from torchsar.focus.nufft import Kernel, smooth_length
from torchsar.radar import InverseRadar

METHODS = ("nufft", "explicit", "linear", "spline", "finufft")
EPS = 1e-6
MIN_PULSES = 8


def lines_for(cells: float, oversampling: float = 2.0) -> int:
    """Lines that cover Doppler -cells..cells, in cells of 1 / T, where a target needs less than the pulse rate: an even number with a fast FFT."""
    if not (math.isfinite(cells) and cells > 0 and oversampling > 0):
        raise ValueError(f"lines need a positive number of cells and a positive oversampling, got {cells} and {oversampling}")
    return 2 * smooth_length(math.ceil(cells * oversampling) + 1)


def slow_times(n_pulse: int, prf_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Time since the first pulse (s), float64 (n_pulse,)."""
    return torch.arange(n_pulse, dtype=torch.float64, device=device) / prf_hz


def normalised_warp(k: Tensor, n_pulse: int, prf_hz: float) -> tuple[Tensor, Tensor]:
    """u = phi(t) / phi(T) and its rate du/d(t/T), 1 for even rotation. k: (..., order - 1). Returns two float64 (..., pulse). Differentiable."""
    k = k.to(torch.float64)
    total = _whole_warp(k, n_pulse / prf_hz)
    times = slow_times(n_pulse, prf_hz, k.device)
    return warp(times, k) / total, warp_rate(times, k) * (n_pulse / prf_hz) / total


def _whole_warp(k: Tensor, duration_s: float) -> Tensor:
    """phi(T), (..., 1)."""
    return warp(torch.tensor([duration_s], dtype=torch.float64, device=k.device), k)


def mean_rate(omega_rad_s: Tensor | float, k: Tensor, duration_s: float) -> Tensor:
    """Mean rotation rate over the aperture (rad/s), Om phi(T) / T, (...,): what scales an image formed without the warp, and the line axis here."""
    total = _whole_warp(k.to(torch.float64), duration_s)[..., 0]
    return per_trial(omega_rad_s, 0, total) * total / duration_s


def cross_range_of(doppler_hz: Tensor | float, omega_rad_s: Tensor | float, k: Tensor, wavelength_m: float, duration_s: float) -> Tensor:
    """Cross range (m) of Doppler frequencies on the line axis, wavelength f / (2 mean rate). doppler_hz: (f,) or a number; others (...,). Returns (..., f) or (...,).

    Its relative error is minus that of the rate. The sign of Om cannot be seen in the data: x may be mirrored.
    """
    rate = mean_rate(omega_rad_s, k, duration_s)
    doppler = torch.as_tensor(doppler_hz, dtype=torch.float64, device=rate.device)
    return wavelength_m / 2 * doppler / (rate[..., None] if doppler.ndim else rate)


def range_phase(data: Tensor, range_m: Tensor, wavelength_m: float, prf_hz: float, omega_rad_s: Tensor | float, k: Tensor, yc_m: Tensor | float = 0.0) -> Tensor:
    """Take out what range adds to the phase of turning scatterers: multiply by exp(-j (c4/2) (y_n + yc) Om^2 phi^2), c4 = 4 pi / wavelength.

    data: complex (..., pulse, range); range_m: y_n, float64 (range,), evenly spaced, from the rotation centre but for yc; omega_rad_s, yc_m: (...,);
    k: (..., order - 1). Before `matched_fourier`. Differentiable in all but range_m. Remote Sens. 2025, 17, 3447, Eqs. (7)-(8).
    """
    n_pulse, n_range = data.shape[-2:]
    phi = warp(slow_times(n_pulse, prf_hz, data.device), k.to(torch.float64))
    slope = -(per_trial(omega_rad_s, 1, data) * phi).square() / wavelength_m  # turns a metre of range
    start, step = float(range_m[0]), float(range_m[1] - range_m[0]) if n_range > 1 else 1.0
    fine, coarse = phasor_tables(slope * step, start / step, n_range, data.dtype)
    offset = unit_phasor(slope * per_trial(yc_m, 1, data), data.dtype)
    return data * outer_phasor(fine, coarse * offset[..., None], n_range)


class _Transform(Protocol):
    """Pulses (..., pulse, range) into lines (..., line, range), and the adjoint."""

    def forward(self, pulses: Tensor) -> Tensor: ...

    def adjoint(self, image: Tensor) -> Tensor: ...


def matched_fourier(
    data: Tensor,
    warp_k: Tensor,
    prf_hz: float,
    *,
    oversampling: float = 2.0,
    lines: int | None = None,
    weight: str = "matched",
    method: str = "nufft",
    taps: int | None = None,
    eps: float | None = None,
    kernel_oversampling: float | None = None,
    cross_range_m: tuple[float, int] | None = None,
    omega_rad_s: Tensor | float | None = None,
    wavelength_m: float | None = None,
) -> Tensor:
    """Image (..., lines, range) of pulses (..., pulse, range) whose Doppler follows the warp. Differentiable twice in data, k and omega.

    warp_k: (..., order - 1), an empty last dim for even rotation; leading dims broadcast with those of the data. oversampling: lines per Doppler cell 1 / T.
    lines: by default round(oversampling * pulses), the whole pulse rate; fewer are the frequencies about zero (`lines_for`), line `lines // 2` is zero.
    weight: "matched" (1: best signal-to-noise ratio) or "warped" (the integral in d phi). cross_range_m: (step, count) for lines at
    x = (i - count // 2) step in metres, the same for all trials; needs omega_rad_s (...,) and wavelength_m, and takes the place of oversampling and lines.

    method: "nufft" (gridding; accuracy by `taps` 2..16, or by `eps`, 1e-6 by default; see `kernel_of`), "explicit" (the sum itself: the yardstick), "linear", "spline"
    (interpolation to even angles and an FFT: the classical way, lossy near the band edge), "finufft" (compiled library, first derivatives only, extra `nufft`).
    """
    operator = MatchedFourierOperator(
        warp_k.to(data.device),
        data.shape[-2],
        prf_hz,
        dtype=data.dtype,
        oversampling=oversampling,
        lines=lines,
        weight=weight,
        method=method,
        taps=taps,
        eps=eps,
        kernel_oversampling=kernel_oversampling,
        cross_range_m=cross_range_m,
        omega_rad_s=omega_rad_s,
        wavelength_m=wavelength_m,
    )
    return operator.image(data)


class MatchedFourierOperator:
    """`matched_fourier` for one warp per trial, and its exact adjoint: what `compensate.pulse_phase.Through` asks of an image formation.

    Arguments as there; n_pulse: pulses of the data. The points of the transform are prepared once.
    """

    def __init__(
        self,
        warp_k: Tensor,
        n_pulse: int,
        prf_hz: float,
        *,
        dtype: torch.dtype = torch.complex64,
        oversampling: float = 2.0,
        lines: int | None = None,
        weight: str = "matched",
        method: str = "nufft",
        taps: int | None = None,
        eps: float | None = None,
        kernel_oversampling: float | None = None,
        cross_range_m: tuple[float, int] | None = None,
        omega_rad_s: Tensor | float | None = None,
        wavelength_m: float | None = None,
    ) -> None:
        _refuse_bad_choice(n_pulse, oversampling, lines, weight, method)
        self.n_pulse, self.dtype = n_pulse, dtype
        k = warp_k.to(torch.float64)
        u, rate = normalised_warp(k, n_pulse, prf_hz)
        if cross_range_m is None:
            step, self.lines = torch.as_tensor(1 / oversampling, dtype=torch.float64, device=u.device), lines or round(oversampling * n_pulse)
        else:
            step, self.lines = _metre_step(k, n_pulse / prf_hz, cross_range_m, omega_rad_s, wavelength_m), cross_range_m[1]
        self.weight = rate.to(real_dtype(dtype)) if weight == "warped" else None
        kernel = kernel_of(taps, eps, kernel_oversampling)
        scale = 1 / math.sqrt(n_pulse)
        if method == "nufft":
            self.transform: _Transform = _Gridded(u * step[..., None], self.lines, kernel, dtype, scale)
        elif method == "explicit":
            self.transform = _Explicit(u * step[..., None], self.lines, dtype, scale)
        elif method == "finufft":
            self.transform = _Finufft(u * step[..., None], self.lines, kernel.error if eps is None else eps, scale)
        else:
            self.transform = _Resampled(k, n_pulse, prf_hz, step, self.lines, method, scale)

    def image(self, pulses: Tensor) -> Tensor:
        """Pulses (..., pulse, range) to the image (..., lines, range)."""
        self._refuse_other(pulses, self.n_pulse, "pulses")
        return self.transform.forward(pulses if self.weight is None else pulses * self.weight[..., None])

    def adjoint(self, image: Tensor) -> Tensor:
        """Image (..., lines, range) to pulses: <image(p), i> = <p, adjoint(i)> with <a, b> = sum a conj(b)."""
        self._refuse_other(image, self.lines, "lines")
        pulses = self.transform.adjoint(image)
        return pulses if self.weight is None else pulses * self.weight[..., None]

    def _refuse_other(self, x: Tensor, n: int, what: str) -> None:
        if x.dtype != self.dtype:
            raise TypeError(f"this matched Fourier transform was built for {self.dtype}, got {x.dtype}; build it with dtype={x.dtype}")
        if x.ndim < 2 or x.shape[-2] != n:
            raise ValueError(f"a matched Fourier transform of {n} {what} got the shape {tuple(x.shape)}; its last dims are ({what}, range)")


def _refuse_bad_choice(n_pulse: int, oversampling: float, lines: int | None, weight: str, method: str) -> None:
    if n_pulse < MIN_PULSES:
        raise ValueError(f"a matched Fourier transform needs at least {MIN_PULSES} pulses, got {n_pulse}")
    if not (math.isfinite(oversampling) and oversampling > 0) or (lines is not None and lines < 1):
        raise ValueError(f"oversampling must be positive and lines at least 1, got {oversampling} and {lines}")
    if weight not in ("matched", "warped"):
        raise ValueError(f"weight {weight!r} is not known; choose 'matched' or 'warped'")
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not known; choose one of {METHODS}")


def kernel_of(taps: int | None, eps: float | None, oversampling: float | None = None) -> Kernel:
    """The gridding kernel of `matched_fourier`: of so many taps on a grid of 2, or else the narrowest of relative error eps on one of 1.5, the cheapest."""
    if taps is not None and eps is not None:
        raise ValueError(f"give the kernel's taps or its eps, not both, got taps={taps} and eps={eps}")
    if taps is not None:
        return Kernel(taps, 2.0 if oversampling is None else oversampling)
    eps = EPS if eps is None else eps
    if oversampling is None:
        oversampling = 1.5 if eps > Kernel(16, 1.5).error else 2.0
    return Kernel.of(eps, oversampling, even=True)


def _metre_step(k: Tensor, duration_s: float, cross_range_m: tuple[float, int], omega_rad_s: Tensor | float | None, wavelength_m: float | None) -> Tensor:
    """Cycles a line over the whole aperture of lines step_m apart, (...,)."""
    if omega_rad_s is None or wavelength_m is None:
        raise ValueError("lines in metres need omega_rad_s and wavelength_m; without them images have a Doppler axis")
    step, count = cross_range_m
    if not (math.isfinite(step) and step > 0 and count >= 1):
        raise ValueError(f"cross_range_m is a positive step in metres and a number of lines, got {cross_range_m}")
    return 2 * step / wavelength_m * duration_s * mean_rate(omega_rad_s, k, duration_s)


class _Gridded:
    """By gridding, see `focus.gridding`."""

    def __init__(self, points: Tensor, lines: int, kernel: Kernel, dtype: torch.dtype, scale: float) -> None:
        self.plan = PulseNufft(lines, kernel, dtype, points.device, scale)
        self.points = self.plan.points(points)

    def forward(self, pulses: Tensor) -> Tensor:
        return self.plan.type1(pulses, self.points)

    def adjoint(self, image: Tensor) -> Tensor:
        return self.plan.type2(image, self.points)


class _Explicit:
    """The sum itself, by blocks of lines."""

    def __init__(self, points: Tensor, lines: int, dtype: torch.dtype, scale: float) -> None:
        self.points, self.lines, self.dtype, self.scale = points, lines, dtype, scale

    def _blocks(self) -> list[tuple[int, int]]:
        size = max(16, 32 * block_bytes_of(self.points.device) // (self.points.numel() * self.dtype.itemsize))
        return [(at, min(size, self.lines - at)) for at in range(0, self.lines, size)]

    def _matrix(self, at: int, count: int) -> Tensor:
        """(..., pulse, line)."""
        return self.scale * linear_phasor(self.points, at - self.lines // 2, count, self.dtype)

    def forward(self, pulses: Tensor) -> Tensor:
        return torch.cat([self._matrix(*block).mT @ pulses for block in self._blocks()], -2)

    def adjoint(self, image: Tensor) -> Tensor:
        parts = [self._matrix(at, count).conj() @ image[..., at : at + count, :] for at, count in self._blocks()]
        return torch.stack(parts).sum(0)


class _Resampled:
    """Pulses interpolated to times of even angle, then a transform over those: the classical way. Over du, so that a sum over pulses takes 1 / rate."""

    def __init__(self, k: Tensor, n_pulse: int, prf_hz: float, step: Tensor, lines: int, method: str, scale: float) -> None:
        self.step, self.lines, self.n_pulse = step, lines, n_pulse
        self.interpolate = {"linear": _linear, "spline": _spline}[method]
        time = times_of_even_angle(k, n_pulse, prf_hz)
        rate = warp_rate(time, k) * (n_pulse / prf_hz) / _whole_warp(k, n_pulse / prf_hz)
        self.position, self.factor = time * prf_hz, scale / rate

    def forward(self, pulses: Tensor) -> Tensor:
        even = self.interpolate(pulses, self.position) * self.factor.to(pulses.real.dtype)[..., None]
        length = round(self.n_pulse / float(self.step)) if self.step.ndim == 0 and not self.step.requires_grad else 0
        if length < self.lines or abs(length * float(self.step) - self.n_pulse) > 1e-9 * self.n_pulse:
            step = self.step[..., None] / self.n_pulse
            return chirp_z(even.mT, self.lines // 2 * step, -step, self.lines, centre=0).mT
        whole, half = torch.fft.ifft(even.mT, length, norm="forward"), self.lines // 2
        return torch.cat([whole[..., length - half :], whole[..., : self.lines - half]], -1).mT

    def adjoint(self, image: Tensor) -> Tensor:
        """By automatic differentiation of the linear map."""
        trials = torch.broadcast_shapes(image.shape[:-2], self.position.shape[:-1])
        with torch.enable_grad():
            pulses = image.new_zeros(*trials, self.n_pulse, image.shape[-1]).requires_grad_()
            return torch.autograd.grad(self.forward(pulses), pulses, image.expand(*trials, *image.shape[-2:]), create_graph=image.requires_grad)[0]


def times_of_even_angle(k: Tensor, n_pulse: int, prf_hz: float) -> Tensor:
    """Times (s) at which the warp reaches j phi(T) / n_pulse, float64 (..., n_pulse). Differentiable twice: the last two Newton steps carry gradients."""
    duration = n_pulse / prf_hz
    angle = torch.arange(n_pulse, dtype=torch.float64, device=k.device) / n_pulse * _whole_warp(k, duration)
    time = _table_times(angle.detach(), k.detach(), n_pulse, prf_hz)
    for step in range(4):
        at = k.detach() if step < 2 else k
        time = time - (warp(time, at) - (angle.detach() if step < 2 else angle)) / warp_rate(time, at)
    return time


def _table_times(angle: Tensor, k: Tensor, n_pulse: int, prf_hz: float) -> Tensor:
    """The same to within a pulse's bend, from a table of the warp at the pulses."""
    table = warp(slow_times(n_pulse + 1, prf_hz, k.device), k)
    piece = (torch.searchsorted(table.contiguous(), angle.contiguous(), right=True) - 1).clamp(0, n_pulse - 1)
    low, high = table.gather(-1, piece), table.gather(-1, piece + 1)
    return (piece + (angle - low) / (high - low)) / prf_hz


def _linear(pulses: Tensor, position: Tensor) -> Tensor:
    """Straight lines between pulses. pulses: (..., pulse, range), position in pulses (..., m). Returns (..., m, range); the end pieces go on."""
    piece, right = _piece(position, pulses)
    return (1 - right) * _pulses_at(pulses, piece) + right * _pulses_at(pulses, piece + 1)


def _spline(pulses: Tensor, position: Tensor) -> Tensor:
    """The not-a-knot cubic spline through the pulses; shapes as _linear."""
    piece, right = _piece(position, pulses)
    parts = torch.view_as_real(pulses.resolve_conj()).movedim(-3, -1).to(torch.float64)
    bend = torch.view_as_complex(second_differences(parts).movedim(-1, -3).contiguous()).to(pulses.dtype)
    left = 1 - right
    straight = left * _pulses_at(pulses, piece) + right * _pulses_at(pulses, piece + 1)
    curved = (left**3 - left) * _pulses_at(bend, piece) + (right**3 - right) * _pulses_at(bend, piece + 1)
    return straight + curved / 6


def _piece(position: Tensor, pulses: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the pulse before each position, and how far it is behind, (..., m, 1) in the precision of the pulses."""
    piece = torch.floor(position.detach()).clamp(0, pulses.shape[-2] - 2)
    return piece.to(torch.int64), (position - piece).to(pulses.real.dtype)[..., None]


def _pulses_at(pulses: Tensor, index: Tensor) -> Tensor:
    """pulses[..., index, :] with one index per trial."""
    trials = torch.broadcast_shapes(pulses.shape[:-2], index.shape[:-1])
    shape = (*trials, index.shape[-1], pulses.shape[-1])
    return pulses.expand(*trials, *pulses.shape[-2:]).gather(-2, index[..., None].expand(shape))


class _Finufft:
    """The compiled library, in float64 whatever the data: its single-precision points lose a thousandth of a cell far from zero."""

    def __init__(self, points: Tensor, lines: int, eps: float, scale: float) -> None:
        _library()
        self.points, self.lines, self.eps, self.scale = points, lines, eps, scale

    def forward(self, pulses: Tensor) -> Tensor:
        return _Compiled.apply(*self._together(pulses), self.lines, self.eps).to(pulses.dtype) * self.scale

    def adjoint(self, image: Tensor) -> Tensor:
        return _Compiled.apply(*self._together(image), 0, self.eps).to(image.dtype) * self.scale

    def _together(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Data and points with the same trials, in double precision."""
        trials = torch.broadcast_shapes(x.shape[:-2], self.points.shape[:-1])
        return x.expand(*trials, *x.shape[-2:]).to(torch.complex128), self.points.expand(*trials, self.points.shape[-1])


class _Compiled(torch.autograd.Function):
    """Type 1 into `lines` for lines > 0, else its adjoint. First derivatives, in data and points."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, points: Tensor, lines: int, eps: float) -> Tensor:
        ctx.save_for_backward(x, points)
        ctx.eps, ctx.lines = eps, lines
        return _compiled(x, points, lines, eps)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        x, points = ctx.saved_tensors
        back = _compiled(gradient, points, 0 if ctx.lines else x.shape[-2], ctx.eps)
        image, pulses = (gradient, x) if ctx.lines else (x, gradient)
        line = torch.arange(image.shape[-2], dtype=torch.float64, device=x.device) - image.shape[-2] // 2
        slope = _compiled(-2j * math.pi * line[:, None] * image, points, 0, ctx.eps)
        return back, (pulses * slope.conj()).real.sum(-1), None, None


def _compiled(x: Tensor, points: Tensor, lines: int, eps: float) -> Tensor:
    """One plan a trial: the library takes one set of points at a time."""
    library, n, columns = _library(), lines or points.shape[-1], x.shape[-1]
    rows = x.detach().mT.reshape(-1, columns, x.shape[-2]).contiguous().cpu().numpy()
    angles = (2 * math.pi * torch.remainder(points.detach() + 0.5, 1) - math.pi).reshape(-1, points.shape[-1]).cpu().numpy()
    options = {"eps": eps, "isign": 1 if lines else -1, "nthreads": torch.get_num_threads()}
    out = torch.empty(len(rows), columns, n, dtype=x.dtype)
    for row, angle, target in zip(rows, angles, out):
        made = library.nufft1d1(angle, row, (lines,), **options) if lines else library.nufft1d2(angle, row, **options)
        target.copy_(torch.from_numpy(made).reshape(columns, n))
    return out.to(x.device).view(*x.shape[:-2], columns, n).mT


def _library() -> Any:
    try:
        return importlib.import_module("finufft")
    except ModuleNotFoundError:
        raise ModuleNotFoundError("method 'finufft' needs the package finufft: pip install 'torchsar-lab[nufft]', or choose method 'nufft'") from None


class RangePhase(Stage):
    """Take out the phase that range adds as the target turns, before MatchedFourier: see `range_phase`.

    omega_rad_s: rate at the first pulse, by default that of the radar; warp_k: (..., order - 1), even rotation where absent; yc_m: range centre
    deviation, 0 where absent; connected values go before those given here. Range coordinates are those of the signal's range axis.
    Raises ValueError where no rate is known or the warp does not rise over the aperture.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None
    yc_m: Tensor | None

    def __init__(self, radar: InverseRadar, omega_rad_s: Tensor | float | None = None, warp_k: Tensor | None = None, yc_m: Tensor | float | None = None) -> None:
        super().__init__()
        self.radar = radar
        _hold_given(self, omega_rad_s=radar.rotation_rad_s if omega_rad_s is None else omega_rad_s, warp_k=warp_k, yc_m=yc_m)

    def forward(self, signal: Signal, omega_rad_s: Tensor | None = None, warp_k: Tensor | None = None, yc_m: Tensor | None = None) -> Signal:
        pulse, range_ = signal.axes
        omega, yc = self.omega_rad_s if omega_rad_s is None else omega_rad_s, self.yc_m if yc_m is None else yc_m
        if omega is None:
            raise ValueError("range_phase needs a rotation rate: set radar.rotation_rad_s, give omega_rad_s, or connect an estimate of it")
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        return signal.with_data(range_phase(signal.data, range_.values(), self.radar.wavelength_m, 1 / pulse.step, omega, k, 0.0 if yc is None else yc))


class MatchedFourier(Stage):
    """Pulses (pulse, range) of an unevenly turning target to an image (azimuth, range): see `matched_fourier`, also for what is not named here.

    Azimuth is Doppler at the mean rate (Hz), the same axis for all trials; with cross_range_m = (step, count) it is cross range in metres, which takes a
    rate: omega_rad_s, by default that of the radar. warp_k: (..., order - 1), even rotation where absent. Connected values go before those given here.
    Raises ValueError where the warp does not rise over the aperture, or where lines in metres reach twice as far as the pulse rate carries; warns from 0.95
    of what it carries on.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None

    def __init__(
        self,
        radar: InverseRadar,
        oversampling: float = 2.0,
        lines: int | None = None,
        weight: str = "matched",
        method: str = "nufft",
        taps: int | None = None,
        eps: float | None = None,
        cross_range_m: tuple[float, int] | None = None,
        warp_k: Tensor | None = None,
        omega_rad_s: Tensor | float | None = None,
    ) -> None:
        super().__init__()
        _refuse_bad_choice(MIN_PULSES, oversampling, lines, weight, method)
        kernel_of(taps, eps)
        self.radar, self.oversampling, self.lines, self.cross_range_m = radar, oversampling, lines, cross_range_m
        self.weight, self.method, self.taps, self.eps = weight, method, taps, eps
        _hold_given(self, omega_rad_s=radar.rotation_rad_s if omega_rad_s is None else omega_rad_s, warp_k=warp_k)

    def operator(self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None) -> MatchedFourierOperator:
        """The linear map from pulses of this signal to the image, for autofocus."""
        pulse = signal.axis("pulse")
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        omega = self.omega_rad_s if omega_rad_s is None else omega_rad_s
        if self.cross_range_m is not None and omega is not None:
            _mind_pulse_rate(omega, k, pulse, self.cross_range_m, self.radar.wavelength_m)
        choice = {"oversampling": self.oversampling, "lines": self.lines, "weight": self.weight, "method": self.method, "taps": self.taps, "eps": self.eps}
        metres = {"cross_range_m": self.cross_range_m, "omega_rad_s": omega, "wavelength_m": self.radar.wavelength_m}
        return MatchedFourierOperator(k, pulse.n, 1 / pulse.step, dtype=signal.data.dtype, **choice, **metres)

    def forward(self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None) -> Signal:
        operator = self.operator(signal, warp_k, omega_rad_s)
        return Signal(operator.image(signal.data), (self._azimuth(signal.axis("pulse"), operator.lines), signal.axis("range")))

    def _azimuth(self, pulse: Axis, lines: int) -> Axis:
        step, unit = (1 / (self.oversampling * pulse.n * pulse.step), "Hz") if self.cross_range_m is None else (self.cross_range_m[0], "m")
        return Axis("azimuth", lines, -(lines // 2) * step, step, unit)


def _hold_given(stage: Stage, **values: Tensor | float | None) -> None:
    for name, value in values.items():
        if value is None:
            setattr(stage, name, None)
        else:
            stage.hold(name, value)


def _warp_of(signal: Signal, k: Tensor | None) -> Tensor:
    """k on the device of the signal, an empty one where there is none. Raises ValueError where it does not fit or does not rise over the aperture."""
    if k is None:
        return torch.zeros(0, dtype=torch.float64, device=signal.data.device)
    if k.ndim == 0 or not _broadcasts(k.shape[:-1], signal.trials):
        raise ValueError(f"warp_k is (..., order - 1) with the trials {tuple(signal.trials)} of the data in front, or (order - 1,) for all of them, got the shape {tuple(k.shape)}")
    k, pulse = k.to(device=signal.data.device, dtype=torch.float64), signal.axis("pulse")
    least = least_rate(k.detach(), pulse.n * pulse.step)
    try:
        bad = int((~(least > 0)).sum())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return k
    if bad:
        raise ValueError(f"the warp does not rise over the aperture in {bad} of {least.numel()} trials: two times share an angle, and no image can be formed; check warp_k")
    return k


def _broadcasts(a: torch.Size, b: torch.Size) -> bool:
    return all(m == n or 1 in (m, n) for m, n in zip(reversed(a), reversed(b)))


def _mind_pulse_rate(omega_rad_s: Tensor, k: Tensor, pulse: Axis, cross_range_m: tuple[float, int], wavelength_m: float) -> None:
    """Doppler of the outermost line at the fastest turn, over half the pulse rate: lines beyond 1 show aliases of others."""
    step, count = cross_range_m
    fastest = warp_rate(pulse.offsets(k.device), k.detach()).amax(-1)
    share = 4 * (per_trial(omega_rad_s.detach(), 0, k).abs() * fastest) * (step * (count // 2)) / wavelength_m * pulse.step
    try:
        worst = float(share.max())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    reach = f"the outermost of {count} lines {step:g} m apart has a Doppler of {worst:.3g} times half the pulse rate"
    if worst > 2:
        raise ValueError(f"{reach}: every scatterer would show more than once; choose fewer lines")
    if worst > 0.95:
        warnings.warn(f"{reach}: scatterers there are aliased; choose fewer lines or a higher pulse rate", stacklevel=4)
