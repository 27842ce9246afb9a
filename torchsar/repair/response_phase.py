"""Phase response of the channel from bright points of the focused image.

Two methods use short range windows about the brightest points. The point average (the simpler one)
assumes that each window holds a single point: the constant and the linear phase of the spectrum of
each window are removed, and the spectra are averaged coherently. The sharpest fit (recommended)
does not need single points, so that ships, houses and close pairs of points are useful as well. It
models the phase as a sum of Legendre polynomials and finds the phase whose removal gives range
responses of least entropy.

Reference:
    Tsvetkov 2017, Figs. 8 and 9 (point average).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, checked_samples, cis, linear_phasor, unit_level
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.repair.response import (
    GRID,
    band_axis,
    band_grid,
    band_power,
    correct_response,
    estimate_amplitude_response,
    unit_legendre,
)

# Highest Legendre degrees of the stages of a fit, by choice: a large smooth phase first, then
# ripple of up to about 20 periods over the band.
ORDERS = (2, 4, 8, 16, 40)
# Legendre degree to which the phase of the edges of the pulse is taken, by choice.
_EDGE_DEGREE = 24


def brightest_windows(image: Tensor, points: int, width: int, apart: int = 8) -> tuple[Tensor, Tensor]:
    """Cut range windows about the brightest local maxima of each trial.

    Maxima closer than half a window to the ends of a line are not used. If there are fewer maxima
    than points, the remaining windows are zero.

    Args:
        image: Image, shape (trial, azimuth, range), complex.
        points: Number of windows.
        width: Length of the windows in samples.
        apart: Least distance in range, in samples, of a maximum from any brighter one in the same
            line and in the two adjacent lines.

    Returns:
        Windows, the brightest first, shape (trial, points, width), and their lines, shape (trial,
        points).

    Raises:
        ValueError: If the width is below 16 samples or above half a line.
    """
    n, half = image.shape[-1], width // 2
    if width < 16 or n < 2 * width:
        raise ValueError(
            f"width of a window must be 16 samples or more and at most half of the {n} valid range samples, "
            f"got {width}; give longer lines"
        )
    size = torch.nn.functional.pad(image.abs()[..., half:-half], (half, half))
    highest = torch.nn.functional.max_pool2d(size[:, None], (3, 2 * apart + 1), 1, (1, apart))[:, 0]
    peaks = torch.where((size == highest) & (size > 0), size, 0).flatten(-2)
    level, index = peaks.topk(min(points, peaks.shape[-1]), -1)
    index_in_line = index[..., None] + torch.arange(-half, width - half, device=image.device)
    windows = torch.gather(image.flatten(-2), -1, index_in_line.clamp(0, peaks.shape[-1] - 1).flatten(-2)).unflatten(
        -1, index_in_line.shape[-2:]
    )
    return windows * (level > 0)[..., None], index // n


def window_weights(windows: Tensor, image: Tensor, floor: float = 20.0, full: float = 100.0) -> Tensor:
    """Weight each window by the ratio s of its peak power to the background power of the image.

    The weight is s / (s + full), and 0 where s is below `floor`. The background is the mean power
    of Gaussian speckle that has the median power of the image; the floor is so high that hardly one
    of a million speckle pixels exceeds it. The background is taken to be 1e-5 (-50 dB) of the
    brightest peak or more, since weaker maxima are side lobes of that peak.

    Args:
        windows: Windows, shape (..., point, width), complex.
        image: Image, shape (..., azimuth, range), complex.
        floor: Lowest ratio s with a weight above zero.
        full: Ratio s at which the weight is one half.

    Returns:
        Weights 0..1, shape (..., point), float64.
    """
    background = image.abs().flatten(-2).median(-1).values.square().to(torch.float64) / math.log(2)
    peak = windows.abs().amax(-1).square().to(torch.float64)
    s = peak / torch.maximum(background[..., None], 1e-5 * peak.amax(-1, keepdim=True)).clamp_min(1e-300)
    return torch.where(s > floor, s / (s + full), 0)


def halved(windows: Tensor, weight: Tensor, line: Tensor) -> tuple[Tensor, Tensor]:
    """Divide windows into two halves that share few targets.

    A target has windows in several lines. The windows are therefore divided into quarters by their
    line; the outer two are one half, the inner two the other.

    Args:
        windows: Windows, shape (trial, points, width).
        weight: Weights of the windows, shape (trial, points); windows of weight 0 go anywhere.
        line: Lines of the windows, shape (trial, points).

    Returns:
        Windows and weights, the first halves of all trials before the second ones, shapes (2 trial,
        points // 2, width) and (2 trial, points // 2).
    """
    used = weight > 0
    place = torch.where(used, line, line.amax() + 1).argsort(dim=-1, stable=True).argsort(dim=-1, stable=True)
    quarter = 4 * place // used.sum(-1, keepdim=True).clamp_min(1)
    inner = torch.where(used, (quarter == 1) | (quarter == 2), place % 2 == 0)
    order = inner.to(torch.int64).argsort(dim=-1, stable=True)[..., : windows.shape[-2] // 2 * 2]
    order = torch.cat(order.chunk(2, -1))
    windows, weight = torch.cat([windows, windows]), torch.cat([weight, weight])
    return windows.gather(-2, order[..., None].expand(*order.shape, windows.shape[-1])), weight.gather(-1, order)


def window_entropy(spectra: Tensor, phase_rad: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean entropy of windows after removal of a phase, and its gradient.

    The entropy of a window is H = -sum p ln p with p = |y|^2, where y is the range response,
    sampled twice as finely as the image so that the position of a point between samples has less
    influence. Since the removal of a phase is unitary, p sums to one and dH/dy* = -(ln p + 1) y.

    Args:
        spectra: Spectra of unit energy, or zero, shape (trial, point, n), complex128.
        phase_rad: Phase to be removed, in radians, FFT order, shape (trial, n), float64.
        weight: Weights of the windows, shape (trial, point), float64.

    Returns:
        Weighted mean entropy in nats, shape (trial,), and its derivative with respect to the phase
        of each frequency, shape (trial, n).
    """
    n = spectra.shape[-1]
    turned = spectra * cis(-phase_rad)[:, None]
    zeros = torch.zeros_like(turned)
    y = torch.fft.ifft(torch.cat([turned[..., : n // 2], zeros, turned[..., n // 2 :]], -1), norm="ortho")
    p = y.real.square() + y.imag.square()
    log = torch.log(p.clamp_min(1e-30))
    slope = torch.fft.fft(-log * y, norm="ortho")
    slope = torch.cat([slope[..., : n // 2], slope[..., -(n - n // 2) :]], -1)
    weight = (weight / weight.sum(-1, keepdim=True).clamp_min(1e-300))[..., None]
    return -(weight * p * log).sum((-2, -1)), 2 * (weight * (slope.conj() * turned).imag).sum(-2)


def minimise(
    cost: Callable[[Tensor], tuple[Tensor, Tensor]],
    start: Tensor,
    steps: int,
    first_step: float = 0.3,
    rtol: float = 1e-7,
) -> Tensor:
    """Minimise a cost by quasi-Newton (BFGS) descent, for each trial separately.

    A step is halved until the cost falls enough (Armijo rule). A trial stops when no step lowers
    its cost, or when a step lowers the cost by less than the fraction rtol.

    Args:
        cost: Function of parameters (trial, p) that returns costs (trial,) and gradients (trial,
            p).
        start: First parameters, shape (trial, p), float64.
        steps: Largest number of steps.
        first_step: Length of the first step.
        rtol: Relative improvement below which a trial stops.

    Returns:
        Parameters, shape (trial, p).
    """
    x, (value, slope) = start, cost(start)
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    inverse = eye * (first_step / torch.linalg.vector_norm(slope, dim=-1).clamp_min(1e-12))[:, None, None]
    active = torch.ones_like(value, dtype=torch.bool)
    for _ in range(steps):
        step = -(inverse @ slope[..., None])[..., 0]
        fall = (step * slope).sum(-1)
        taken, new, new_value, new_slope = torch.zeros_like(active), x, value, slope
        for halving in range(12):
            here = x + step * 0.5**halving
            v, g = cost(here)
            good = active & ~taken & (v <= value + 1e-4 * 0.5**halving * fall)
            new, new_value, new_slope = (
                torch.where(good[:, None], here, new),
                torch.where(good, v, new_value),
                torch.where(good[:, None], g, new_slope),
            )
            taken = taken | good
            if bool((taken | ~active).all()):
                break
        inverse = _bfgs(inverse, new - x, new_slope - slope, eye)
        active = taken & (value - new_value > rtol * value.abs())
        x, value, slope = new, new_value, new_slope
        if not bool(active.any()):
            break
    return x


def _bfgs(inverse: Tensor, moved: Tensor, turned: Tensor, eye: Tensor) -> Tensor:
    """Update of the inverse Hessian; trials without positive curvature keep theirs."""
    curvature = (moved * turned).sum(-1)
    good = curvature > 1e-12 * torch.linalg.vector_norm(moved, dim=-1) * torch.linalg.vector_norm(turned, dim=-1)
    good = good & (curvature > 0)
    r = torch.where(good, 1 / torch.where(good, curvature, 1), 0)[:, None, None]
    left = eye - r * moved[..., :, None] * turned[..., None, :]
    new = left @ inverse @ left.mT + r * moved[..., :, None] * moved[..., None, :]
    return torch.where(good[:, None, None], new, inverse)


def sharpest_coefficients(
    windows: Tensor, weight: Tensor, band: float, orders: tuple[int, ...] = ORDERS, steps: int = 40
) -> Tensor:
    """Find the Legendre coefficients of the phase whose removal leaves the sharpest windows.

    The sharpest windows are those of least mean entropy. Higher degrees are added in stages, each
    starting from the result of the stage before, so that a large smooth phase is found before fine
    ripple.

    Args:
        windows: Range windows, shape (trial, point, n), complex.
        weight: Weights of the windows, shape (trial, point), float64.
        band: Bandwidth of the pulse over the sampling rate.
        orders: Highest degree of each stage, rising.
        steps: Largest number of steps of a stage.

    Returns:
        Coefficients in radians of the degrees 2 to orders[-1], shape (trial, orders[-1] - 1).
    """
    n = windows.shape[-1]
    spectra = torch.fft.fft(windows.to(torch.complex128), norm="ortho")
    energy = torch.linalg.vector_norm(spectra, dim=-1, keepdim=True)
    spectra = spectra / torch.where(energy > 0, energy, 1)
    basis = unit_legendre(band_axis(n, band, windows.device).clamp(-1, 1), orders[-1])[2:]
    c = torch.zeros((windows.shape[0], 0), dtype=torch.float64, device=windows.device)
    for order in orders:
        part = basis[: order - 1]

        def cost(c: Tensor, part: Tensor = part) -> tuple[Tensor, Tensor]:
            value, slope = window_entropy(spectra, c @ part, weight)
            return value, slope @ part.mT

        c = minimise(cost, torch.nn.functional.pad(c, (0, order - 1 - c.shape[-1])), steps)
    return c


def estimate_response_sharpest(
    image: Tensor,
    band: float,
    points: int = 800,
    width: int = 256,
    orders: tuple[int, ...] = ORDERS,
    passes: int = 3,
    valid: int | None = None,
) -> Estimate:
    """Estimate the phase response as that whose removal makes bright points sharpest in range.

    Sharpness is measured by the entropy of range windows about the points. After each pass the
    image is corrected and the points are chosen again. The last pass fits two halves of the points
    separately, which share few targets. The estimate is the mean of both fits; the standard
    deviation follows from their difference and from the size of the highest two degrees, since a
    finer ripple needs higher ones. Not differentiable.

    Args:
        image: Image whose pulse band is centred at zero range frequency, shape (..., azimuth,
            range), complex.
        band: Bandwidth of the pulse over the sampling rate.
        points: Number of windows.
        width: Length of the windows in samples, many times the width of the distorted impulse
            response; at most half the valid columns are used.
        orders: Highest Legendre degree of each stage.
        passes: Number of passes.
        valid: Number of range columns, from the first on, that are fully compressed and may be
            used; by default all.

    Returns:
        Estimate with `phase_rad` in radians and its standard deviation, at GRID = 1025 equally
        spaced frequencies of the pulse band, shape (..., GRID), without constant and linear part;
        and `amplitude` of the same shape, all ones. `quality` is 1 / (1 + variance in rad^2). `ok`
        is False, and the phase is zero, where the fits of the two halves differ by more than 0.25
        rad rms: the image has too few bright points.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than 32
            valid columns, or the width is below 16 samples.
    """
    image = checked_samples(image, "estimate_response_sharpest", "azimuth, range")
    used = image.detach()[..., :valid] if valid else image.detach()
    rows = unit_level(used.reshape(-1, *used.shape[-2:]))
    basis = unit_legendre(band_grid(image.device), orders[-1])[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for i in range(passes):
        sharper = correct_response(rows, total @ basis, None, band) if i else rows
        windows, line = brightest_windows(sharper, points, min(width, sharper.shape[-1] // 4 * 2))
        weight = window_weights(windows, sharper)
        if i < passes - 1:
            total = total + sharpest_coefficients(windows, weight, band, orders if i == 0 else orders[-1:])
    halves, weights = halved(windows, weight, line)
    first, second = sharpest_coefficients(halves, weights, band, orders[-1:]).chunk(2)
    total = total + (first + second) / 2
    std = torch.where(
        (weights.sum(-1) > 0).reshape(2, -1).all(0), torch.linalg.vector_norm(first - second, dim=-1) / 2, torch.inf
    )
    return _phase_estimate(total @ basis, torch.hypot(std, _beyond(total)), image.shape[:-2])


def _beyond(c: Tensor) -> Tensor:
    """Phase in rad, (trial,), that higher degrees may add: that of the highest two."""
    return torch.linalg.vector_norm(c[:, -2:], dim=-1)


def _phase_estimate(phase_rad: Tensor, std: Tensor, trials: torch.Size) -> Estimate:
    """Estimate of a phase response with its reliability."""
    ok = torch.isfinite(std) & (std < 0.125) & torch.isfinite(phase_rad).all(-1)
    phase_rad = torch.where(ok[:, None], phase_rad, 0).reshape(*trials, GRID)
    std = torch.where(torch.isfinite(std), std, math.pi)[:, None].expand(-1, GRID).reshape(*trials, GRID)
    quality = torch.where(ok.reshape(trials), 1 / (1 + std[..., 0].square()), 0)
    return Estimate(
        {"phase_rad": phase_rad, "amplitude": torch.ones_like(phase_rad)},
        quality,
        ok.reshape(trials),
        {"phase_rad": std},
    )


def point_average_coefficients(
    windows: Tensor, weight: Tensor, band: float, order: int = 24, rounds: int = 6
) -> Tensor:
    """Average the spectra of single points coherently, and fit the phase of the average.

    All spectra are first aligned with that of the first point: the slope of their phase is found
    from the peak of their correlation, then the constant. This is repeated with the average of the
    spectra in place of the first. The phase of the average is the running sum of its increments
    from frequency to frequency.

    Args:
        windows: Range windows, the brightest first, shape (trial, point, n), complex.
        weight: Weights of the windows, shape (trial, point), float64.
        band: Bandwidth of the pulse over the sampling rate.
        order: Highest Legendre degree.
        rounds: Number of averages.

    Returns:
        Legendre coefficients in radians of the degrees 2 to `order`, shape (trial, order - 1).
    """
    n = windows.shape[-1]
    u = torch.fft.fftshift(band_axis(n, band, windows.device))
    inside = (u.abs() <= 1).nonzero()[:, 0]
    away = (torch.arange(n, device=windows.device) - n // 2).abs() / n
    taper = torch.cos(math.pi / 2 * ((away - 0.3) / 0.2).clamp(0, 1)).square()
    spectra = torch.fft.fftshift(
        torch.fft.fft(torch.fft.ifftshift((windows * taper).to(torch.complex128), dim=-1)), dim=-1
    )[..., inside]
    norm = torch.linalg.vector_norm(spectra, dim=-1, keepdim=True)
    spectra = spectra / torch.where(norm > 0, norm, 1) * weight[..., None]
    average = spectra[..., :1, :]
    for _ in range(rounds):
        spectra = _align(spectra, average)
        average = spectra.mean(-2, keepdim=True)
    average = average[..., 0, :]
    steps = torch.angle(average[..., 1:] * average[..., :-1].conj())
    phase = torch.nn.functional.pad(torch.cumsum(steps, -1), (1, 0))
    magnitude = (average.abs() + 1e-12)[..., None]
    return torch.linalg.lstsq(magnitude * unit_legendre(u[inside], order).mT, magnitude * phase[..., None]).solution[
        ..., 2:, 0
    ]


def _align(spectra: Tensor, reference: Tensor) -> Tensor:
    """Spectra (..., point, n), with linear and constant phase aligned with the reference."""
    n = 8 * spectra.shape[-1]
    correlation = torch.fft.fft(spectra * reference.conj(), n)
    index = correlation.abs().argmax(-1, keepdim=True)
    slope = (index - n * (2 * index >= n)).to(torch.float64) / n
    turned = torch.gather(correlation, -1, index)
    return spectra * linear_phasor(-slope[..., 0], 0, spectra.shape[-1], spectra.dtype) * cis(-torch.angle(turned))


def estimate_response_points(
    image: Tensor,
    band: float,
    points: int = 200,
    width: int = 128,
    order: int = 24,
    passes: int = 3,
    valid: int | None = None,
) -> Estimate:
    """Estimate the phase response by the coherent average of the spectra of isolated bright points.

    This is the simpler method. It uses one line of the image for each point and is more sensitive
    to noise than `estimate_response_sharpest`. It fails if the brightest maxima are not single
    points, or if the response spreads them over much of the window. The standard deviation is
    formed as there. Not differentiable.

    Args:
        image: Image whose pulse band is centred at zero range frequency, shape (..., azimuth,
            range), complex.
        band: Bandwidth of the pulse over the sampling rate.
        points: Number of windows.
        width: Length of the windows in samples; at most half the valid columns are used.
        order: Highest Legendre degree.
        passes: Number of passes.
        valid: Number of range columns, from the first on, that are fully compressed and may be
            used; by default all.

    Returns:
        Estimate with `phase_rad` in radians and its standard deviation, at GRID = 1025 equally
        spaced frequencies of the pulse band, shape (..., GRID), and `amplitude` of the same shape,
        all ones. `quality` is 1 / (1 + variance in rad^2). `ok` is False, and the phase is zero,
        where the results of two halves of the points differ by more than 0.25 rad rms.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than 32
            valid columns, or the width is below 16 samples.
    """
    image = checked_samples(image, "estimate_response_points", "azimuth, range")
    used = image.detach()[..., :valid] if valid else image.detach()
    rows = unit_level(used.reshape(-1, *used.shape[-2:]))
    width = min(width, rows.shape[-1] // 4 * 2)
    basis = unit_legendre(band_grid(image.device), order)[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for i in range(passes):
        sharper = correct_response(rows, total @ basis, None, band) if i else rows
        windows, line = brightest_windows(sharper, points, width, apart=width // 2)
        weight = (window_weights(windows, sharper) > 0).to(torch.float64)
        total = total + point_average_coefficients(windows, weight, band, order)
    first, second = point_average_coefficients(*halved(windows, weight, line), band, order).chunk(2)
    std = torch.where((weight.sum(-1) > 1), torch.linalg.vector_norm(first - second, dim=-1) / 2, torch.inf)
    return _phase_estimate(total @ basis, torch.hypot(std, _beyond(total)), image.shape[:-2])


_METHODS = {"sharpest": estimate_response_sharpest, "points": estimate_response_points}


def _edge_phase(pulse: LinearFM, sampling_hz: float) -> Tensor:
    """Phase in rad, (GRID,), that the estimators find in an echo whose edge lies on a sample.

    The abrupt edges of the pulse have frequencies that alias. What they add to the phase of an echo
    depends on where its edges lie between samples, and no image shows it apart from a response.
    """
    n = 4 * pulse.n_samples(sampling_hz)
    u = band_axis(n, pulse.bandwidth_hz / sampling_hz)
    mean = pulse.band_spectrum(n, sampling_hz)
    phase, size = torch.angle(pulse.spectrum(n, sampling_hz) * mean.conj())[u.abs() <= 1], mean.abs()[u.abs() <= 1]
    degree = min(_EDGE_DEGREE, phase.shape[-1] // 4)
    fit = torch.linalg.lstsq(size[:, None] * unit_legendre(u[u.abs() <= 1], degree).mT, (size * phase)[:, None])
    return (fit.solution[2:, 0] @ unit_legendre(band_grid(), degree)[2:]).abs()


class EstimateResponse(Stage):
    """Estimator of the channel's phase and amplitude response from a focused image.

    The standard deviation of the phase includes that of the method and the phase that the edges of
    the pulse, which lie between samples, leave in the image.

    The amplitude is estimated only if the range power spectrum of scene and noise is given as
    `expected_power`.

    Args:
        radar: Radar; gives bandwidth, sampling rate and length of the pulse.
        method: "sharpest" for `estimate_response_sharpest` (default), "points" for
            `estimate_response_points`, or any function of (image, band, valid=columns) that returns
            such an Estimate, where `columns` is the number of fully compressed range columns.
        expected_power: Range power spectrum of an image of this kind without the response (see
            `band_power`), FFT order, shape (n,); None: the amplitude is one.
    """

    works_on = ("azimuth", "range")
    provides = ("phase_rad", "amplitude")
    neutral = {"phase_rad": 0.0, "amplitude": 1.0}

    expected_power: Tensor | None

    def __init__(
        self,
        radar: StripmapRadar,
        method: Literal["sharpest", "points"] | Callable[..., Estimate] = "sharpest",
        expected_power: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.radar = radar
        self.method = _METHODS[method] if isinstance(method, str) else method
        self.register_buffer("expected_power", expected_power)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the phase and amplitude response of the channel along range.

        Args:
            signal: Image, shape (..., azimuth, range).

        Returns:
            Estimate with `phase_rad` in radians and `amplitude` at 1025 equally spaced frequencies
            of the pulse band. The amplitude is one unless the constructor received
            `expected_power`.
        """
        band = self.radar.pulse.bandwidth_hz / self.radar.sampling_hz
        estimate = self.method(signal.data, band, valid=max(1, signal.data.shape[-1] - self.radar.pulse_samples))
        edges = _edge_phase(self.radar.pulse, self.radar.sampling_hz).to(signal.data.device)
        estimate = replace(estimate, std={"phase_rad": torch.hypot(estimate.std["phase_rad"], edges)})
        if self.expected_power is None:
            return estimate
        amplitude = estimate_amplitude_response(band_power(unit_level(signal.data)), self.expected_power, band)
        return Estimate(
            {**estimate.value, "amplitude": amplitude}, estimate.quality, estimate.ok, estimate.std, estimate.info
        )


class EstimateFlatResponse(EstimateResponse):
    """Estimator of the response from images with a flat range spectrum.

    The range compression must have used the reference "flat", which divides by the pulse spectrum
    inside the pulse band. Without an amplitude response, the image then has the same mean power at
    all frequencies of this band. The amplitude is therefore estimated as well as the phase.

    Args:
        radar: Radar; gives bandwidth, sampling rate and length of the pulse.
        method: "sharpest", "points" or a function; see `EstimateResponse`.
    """

    def __init__(
        self, radar: StripmapRadar, method: Literal["sharpest", "points"] | Callable[..., Estimate] = "sharpest"
    ) -> None:
        super().__init__(radar, method)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the phase and amplitude response of the channel along range.

        Args:
            signal: Image, shape (..., azimuth, range), compressed in range with the reference
                "flat".

        Returns:
            Estimate with `phase_rad` in radians and `amplitude`, relative to a flat spectrum, at
            1025 equally spaced frequencies of the pulse band.
        """
        flat = torch.ones(signal.data.shape[-1], dtype=torch.float64, device=signal.data.device)
        return EstimateResponse(self.radar, self.method, flat)(signal)
