"""Matched Fourier transform: azimuth focusing of a target whose rotation is uneven, as a Fourier
transform over the warped time.

Data (..., pulse, range) hold exp(-j c4 x Om phi(t)) exp(+j (c4/2) (y_n + yc) Om^2 phi(t)^2) for
each scatterer, c4 = 4 pi / wavelength, with the warp phi(t) = `core.warp.warp(t, k)`, t = 0 at the
first pulse. `range_phase` takes out the second factor, `matched_fourier` focuses the first: I(q, n)
= sum_m w_m s(m, n) exp(+2j pi c_q u_m) / sqrt(pulses), u = phi(t) / phi(T) in [0, 1), T = pulses /
prf, c_q = (q - lines // 2) / oversampling. The line axis is c / T, Doppler at the mean rate; cross
range is x = wavelength c / (2 Om phi(T)). Only Om^2 shows in the data: images may be mirrored in x.
Source: Remote Sens. 2025, 17, 3447, Eqs. (7)-(10), with the warp of `core.warp`; Greengard and Lee
2004 (non-uniform FFT).
"""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, outer_phasor, per_trial, phasor_tables, real_dtype, unit_phasor
from torchsar.core.warp import least_rate, warp, warp_rate
from torchsar.focus.nufft import Kernel, smooth_length
from torchsar.focus.warped_sums import (
    Compiled,
    Explicit,
    Gridded,
    Resampled,
    Sum,
    normalised_warp,
    slow_times,
    whole_warp,
)
from torchsar.radar import InverseRadar

METHODS = ("nufft", "explicit", "linear", "spline", "finufft")
EPS = 1e-6
MIN_PULSES = 8


def lines_for(cells: float, oversampling: float = 2.0) -> int:
    """Lines that cover Doppler -cells..cells, in cells of 1 / T, where a target needs less than the
    pulse rate: an even number with a fast FFT.
    """
    if not (math.isfinite(cells) and cells > 0 and oversampling > 0):
        raise ValueError(
            f"lines need a positive number of cells and a positive oversampling, got {cells} and {oversampling}"
        )
    return 2 * smooth_length(math.ceil(cells * oversampling) + 1)


def mean_rate(omega_rad_s: Tensor | float, k: Tensor, duration_s: float) -> Tensor:
    """Mean rotation rate over the aperture (rad/s), Om phi(T) / T, (...,): what scales an image
    formed without the warp, and the line axis here.
    """
    total = whole_warp(k.to(torch.float64), duration_s)[..., 0]
    return per_trial(omega_rad_s, 0, total) * total / duration_s


def cross_range_of(
    doppler_hz: Tensor | float, omega_rad_s: Tensor | float, k: Tensor, wavelength_m: float, duration_s: float
) -> Tensor:
    """Cross range (m) of Doppler frequencies on the line axis, wavelength f / (2 mean rate).

    doppler_hz: (f,) or a number; others (...,). Returns (..., f) or (...,).

    Its relative error is minus that of the rate. The sign of Om cannot be seen in the data: x may
    be mirrored.
    """
    rate = mean_rate(omega_rad_s, k, duration_s)
    doppler = torch.as_tensor(doppler_hz, dtype=torch.float64, device=rate.device)
    return wavelength_m / 2 * doppler / (rate[..., None] if doppler.ndim else rate)


def range_phase(
    data: Tensor,
    range_m: Tensor,
    wavelength_m: float,
    prf_hz: float,
    omega_rad_s: Tensor | float,
    k: Tensor,
    yc_m: Tensor | float = 0.0,
) -> Tensor:
    """Take out what range adds to the phase of turning scatterers: multiply by exp(-j (c4/2) (y_n +
    yc) Om^2 phi^2), c4 = 4 pi / wavelength.

    data: complex (..., pulse, range); range_m: y_n, float64 (range,), evenly spaced, from the
    rotation centre but for yc; omega_rad_s, yc_m: (...,); k: (..., order - 1). Before
    `matched_fourier`. Differentiable in all but range_m. Remote Sens. 2025, 17, 3447, Eqs. (7)-(8).
    """
    n_pulse, n_range = data.shape[-2:]
    phi = warp(slow_times(n_pulse, prf_hz, data.device), k.to(torch.float64))
    # turns a metre of range
    slope = -(per_trial(omega_rad_s, 1, data) * phi).square() / wavelength_m
    start, step = float(range_m[0]), float(range_m[1] - range_m[0]) if n_range > 1 else 1.0
    fine, coarse = phasor_tables(slope * step, start / step, n_range, data.dtype)
    offset = unit_phasor(slope * per_trial(yc_m, 1, data), data.dtype)
    return data * outer_phasor(fine, coarse * offset[..., None], n_range)


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
    """Image (..., lines, range) of pulses (..., pulse, range) whose Doppler follows the warp.

    Differentiable twice in data, k and omega.

    warp_k: (..., order - 1), an empty last dim for even rotation; leading dims broadcast with those
    of the data. oversampling: lines per Doppler cell 1 / T. lines: by default round(oversampling *
    pulses), the whole pulse rate; fewer are the frequencies about zero (`lines_for`), line `lines
    // 2` is zero. weight: "matched" (1: best signal-to-noise ratio) or "warped" (the integral in d
    phi). cross_range_m: (step, count) for lines at x = (i - count // 2) step in metres, the same
    for all trials; needs omega_rad_s (...,) and wavelength_m, and takes the place of oversampling
    and lines.

    method: "nufft" (gridding; accuracy by `taps` 2..16, or by `eps`, 1e-6 by default; see
    `kernel_of`), "explicit" (the sum itself: the yardstick), "linear", "spline" (interpolation to
    even angles and an FFT: the classical way, lossy near the band edge), "finufft" (compiled
    library, first derivatives only, extra `nufft`).
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
    """`matched_fourier` for one warp per trial, and its exact adjoint: what
    `compensate.pulse_phase.Through` asks of an image formation.

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
            step, self.lines = (
                torch.as_tensor(1 / oversampling, dtype=torch.float64, device=u.device),
                lines or round(oversampling * n_pulse),
            )
        else:
            step, self.lines = (
                _metre_step(k, n_pulse / prf_hz, cross_range_m, omega_rad_s, wavelength_m),
                cross_range_m[1],
            )
        self.weight = rate.to(real_dtype(dtype)) if weight == "warped" else None
        kernel = kernel_of(taps, eps, kernel_oversampling)
        scale = 1 / math.sqrt(n_pulse)
        if method == "nufft":
            self.transform: Sum = Gridded(u * step[..., None], self.lines, kernel, dtype, scale)
        elif method == "explicit":
            self.transform = Explicit(u * step[..., None], self.lines, dtype, scale)
        elif method == "finufft":
            self.transform = Compiled(u * step[..., None], self.lines, kernel.error if eps is None else eps, scale)
        else:
            self.transform = Resampled(k, n_pulse, prf_hz, step, self.lines, method, scale)

    def image(self, pulses: Tensor) -> Tensor:
        """Pulses (..., pulse, range) to the image (..., lines, range)."""
        self._refuse_other(pulses, self.n_pulse, "pulses")
        return self.transform.forward(pulses if self.weight is None else pulses * self.weight[..., None])

    def adjoint(self, image: Tensor) -> Tensor:
        """Image (..., lines, range) to pulses: <image(p), i> = <p, adjoint(i)> with <a, b> = sum a
        conj(b).
        """
        self._refuse_other(image, self.lines, "lines")
        pulses = self.transform.adjoint(image)
        return pulses if self.weight is None else pulses * self.weight[..., None]

    def _refuse_other(self, x: Tensor, n: int, what: str) -> None:
        if x.dtype != self.dtype:
            raise TypeError(
                f"this matched Fourier transform was built for {self.dtype}, got {x.dtype}; build it "
                f"with dtype={x.dtype}"
            )
        if x.ndim < 2 or x.shape[-2] != n:
            raise ValueError(
                f"a matched Fourier transform of {n} {what} got the shape {tuple(x.shape)}; its last "
                f"dims are ({what}, range)"
            )


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
    """The gridding kernel of `matched_fourier`: of so many taps on a grid of 2, or else the
    narrowest of relative error eps on one of 1.5, the cheapest.
    """
    if taps is not None and eps is not None:
        raise ValueError(f"give the kernel's taps or its eps, not both, got taps={taps} and eps={eps}")
    if taps is not None:
        return Kernel(taps, 2.0 if oversampling is None else oversampling)
    eps = EPS if eps is None else eps
    if oversampling is None:
        oversampling = 1.5 if eps > Kernel(16, 1.5).error else 2.0
    return Kernel.of(eps, oversampling, even=True)


def _metre_step(
    k: Tensor,
    duration_s: float,
    cross_range_m: tuple[float, int],
    omega_rad_s: Tensor | float | None,
    wavelength_m: float | None,
) -> Tensor:
    """Cycles a line over the whole aperture of lines step_m apart, (...,)."""
    if omega_rad_s is None or wavelength_m is None:
        raise ValueError("lines in metres need omega_rad_s and wavelength_m; without them images have a Doppler axis")
    step, count = cross_range_m
    if not (math.isfinite(step) and step > 0 and count >= 1):
        raise ValueError(f"cross_range_m is a positive step in metres and a number of lines, got {cross_range_m}")
    return 2 * step / wavelength_m * duration_s * mean_rate(omega_rad_s, k, duration_s)


class RangePhase(Stage):
    """Take out the phase that range adds as the target turns, before MatchedFourier: see
    `range_phase`.

    omega_rad_s: rate at the first pulse, by default that of the radar; warp_k: (..., order - 1),
    even rotation where absent; yc_m: range centre deviation, 0 where absent; connected values go
    before those given here. Range coordinates are those of the signal's range axis. Raises
    ValueError where no rate is known or the warp does not rise over the aperture.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None
    yc_m: Tensor | None

    def __init__(
        self,
        radar: InverseRadar,
        omega_rad_s: Tensor | float | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | float | None = None,
    ) -> None:
        super().__init__()
        self.radar = radar
        _hold_given(
            self, omega_rad_s=radar.rotation_rad_s if omega_rad_s is None else omega_rad_s, warp_k=warp_k, yc_m=yc_m
        )

    def forward(
        self,
        signal: Signal,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Signal:
        pulse, range_ = signal.axes
        omega, yc = self.omega_rad_s if omega_rad_s is None else omega_rad_s, self.yc_m if yc_m is None else yc_m
        if omega is None:
            raise ValueError(
                "range_phase needs a rotation rate: set radar.rotation_rad_s, give omega_rad_s, or "
                "connect an estimate of it"
            )
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        return signal.with_data(
            range_phase(
                signal.data,
                range_.values(),
                self.radar.wavelength_m,
                1 / pulse.step,
                omega,
                k,
                0.0 if yc is None else yc,
            )
        )


class MatchedFourier(Stage):
    """Pulses (pulse, range) of an unevenly turning target to an image (azimuth, range): see
    `matched_fourier`, also for what is not named here.

    Azimuth is Doppler at the mean rate (Hz), the same axis for all trials; with cross_range_m =
    (step, count) it is cross range in metres, which takes a rate: omega_rad_s, by default that of
    the radar. warp_k: (..., order - 1), even rotation where absent. Connected values go before
    those given here. Raises ValueError where the warp does not rise over the aperture, or where
    lines in metres reach twice as far as the pulse rate carries; warns from 0.95 of what it carries
    on.
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

    def operator(
        self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None
    ) -> MatchedFourierOperator:
        """The linear map from pulses of this signal to the image, for autofocus."""
        pulse = signal.axis("pulse")
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        omega = self.omega_rad_s if omega_rad_s is None else omega_rad_s
        if self.cross_range_m is not None and omega is not None:
            _mind_pulse_rate(omega, k, pulse, self.cross_range_m, self.radar.wavelength_m)
        choice = {
            "oversampling": self.oversampling,
            "lines": self.lines,
            "weight": self.weight,
            "method": self.method,
            "taps": self.taps,
            "eps": self.eps,
        }
        metres = {"cross_range_m": self.cross_range_m, "omega_rad_s": omega, "wavelength_m": self.radar.wavelength_m}
        return MatchedFourierOperator(k, pulse.n, 1 / pulse.step, dtype=signal.data.dtype, **choice, **metres)

    def forward(self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None) -> Signal:
        operator = self.operator(signal, warp_k, omega_rad_s)
        return Signal(
            operator.image(signal.data), (self._azimuth(signal.axis("pulse"), operator.lines), signal.axis("range"))
        )

    def _azimuth(self, pulse: Axis, lines: int) -> Axis:
        step, unit = (
            (1 / (self.oversampling * pulse.n * pulse.step), "Hz")
            if self.cross_range_m is None
            else (self.cross_range_m[0], "m")
        )
        return Axis("azimuth", lines, -(lines // 2) * step, step, unit)


def _hold_given(stage: Stage, **values: Tensor | float | None) -> None:
    for name, value in values.items():
        if value is None:
            setattr(stage, name, None)
        else:
            stage.hold(name, value)


def _warp_of(signal: Signal, k: Tensor | None) -> Tensor:
    """k on the device of the signal, an empty one where there is none.

    Raises ValueError where it does not fit or does not rise over the aperture.
    """
    if k is None:
        return torch.zeros(0, dtype=torch.float64, device=signal.data.device)
    if k.ndim == 0 or not _broadcasts(k.shape[:-1], signal.trials):
        raise ValueError(
            f"warp_k is (..., order - 1) with the trials {tuple(signal.trials)} of the data in "
            f"front, or (order - 1,) for all of them, got the shape {tuple(k.shape)}"
        )
    k, pulse = k.to(device=signal.data.device, dtype=torch.float64), signal.axis("pulse")
    least = least_rate(k.detach(), pulse.n * pulse.step)
    try:
        bad = int((~(least > 0)).sum())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return k
    if bad:
        raise ValueError(
            f"the warp does not rise over the aperture in {bad} of {least.numel()} trials: two "
            "times share an angle, and no image can be formed; check warp_k"
        )
    return k


def _broadcasts(a: torch.Size, b: torch.Size) -> bool:
    return all(m == n or 1 in (m, n) for m, n in zip(reversed(a), reversed(b)))


def _mind_pulse_rate(
    omega_rad_s: Tensor, k: Tensor, pulse: Axis, cross_range_m: tuple[float, int], wavelength_m: float
) -> None:
    """Doppler of the outermost line at the fastest turn, over half the pulse rate: lines beyond 1
    show aliases of others.
    """
    step, count = cross_range_m
    fastest = warp_rate(pulse.offsets(k.device), k.detach()).amax(-1)
    share = (
        4 * (per_trial(omega_rad_s.detach(), 0, k).abs() * fastest) * (step * (count // 2)) / wavelength_m * pulse.step
    )
    try:
        worst = float(share.max())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    reach = f"the outermost of {count} lines {step:g} m apart has a Doppler of {worst:.3g} times half the pulse rate"
    if worst > 2:
        raise ValueError(f"{reach}: every scatterer would show more than once; choose fewer lines")
    if worst > 0.95:
        warnings.warn(f"{reach}: scatterers there are aliased; choose fewer lines or a higher pulse rate", stacklevel=4)
