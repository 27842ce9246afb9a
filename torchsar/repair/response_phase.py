"""Phase-frequency response from bright places of the focused image: the sharpest fit (recommended)
and the point average (baseline).

Both look at short range windows about the brightest points. The point average takes each for one
point: its spectrum, less its own constant and linear phase, is averaged coherently. The sharpest
fit asks for no single points: it finds the phase, as a sum of Legendre polynomials, whose removal
gives the range responses of least entropy, so that ships, houses and doubles count as well. Source:
brief 004, item 9 and its table of recorded data.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, cis, linear_phasor
from torchsar.radar import StripmapRadar
from torchsar.repair.response import (
    GRID,
    band_axis,
    band_grid,
    band_power,
    correct_response,
    estimate_amplitude_response,
    unit_legendre,
)

ORDERS = (2, 4, 8, 16, 40)


def brightest_windows(image: Tensor, points: int, width: int, apart: int = 8) -> Tensor:
    """Range windows about the brightest local maxima of each trial, (trial, azimuth, range) ->
    (trial, points, width).

    Maxima are at least `apart` samples from any brighter one in their own and the next lines; those
    closer than half a window to the ends of a line are not taken. Where there are fewer maxima than
    points, the other windows are zero.
    """
    n, half = image.shape[-1], width // 2
    if width < 16 or n < 2 * width:
        raise ValueError(
            f"windows of {width} samples (at least 16) need at least {max(32, 2 * width)} valid "
            f"range samples, got {n}; give longer lines"
        )
    size = torch.nn.functional.pad(image.abs()[..., half:-half], (half, half))
    highest = torch.nn.functional.max_pool2d(size[:, None], (3, 2 * apart + 1), 1, (1, apart))[:, 0]
    peaks = torch.where((size == highest) & (size > 0), size, 0).flatten(-2)
    level, index = peaks.topk(min(points, peaks.shape[-1]), -1)
    place = index[..., None] + torch.arange(-half, width - half, device=image.device)
    windows = torch.gather(image.flatten(-2), -1, place.clamp(0, peaks.shape[-1] - 1).flatten(-2)).unflatten(
        -1, place.shape[-2:]
    )
    return windows * (level > 0)[..., None]


def window_weights(windows: Tensor, image: Tensor, floor: float = 20.0, full: float = 100.0) -> Tensor:
    """Trust in each window by its peak power s over the background of the image, s / (s + full),
    and 0 below floor. (..., point).

    The background is the mean power that Gaussian speckle of the image's median power would have;
    of a million of its pixels none exceeds the floor by chance. It is taken at least 50 dB below
    the brightest peak: weaker maxima are its side lobes.
    """
    background = image.abs().flatten(-2).median(-1).values.square().to(torch.float64) / math.log(2)
    peak = windows.abs().amax(-1).square().to(torch.float64)
    s = peak / torch.maximum(background[..., None], 1e-5 * peak.amax(-1, keepdim=True)).clamp_min(1e-300)
    return torch.where(s > floor, s / (s + full), 0)


def window_entropy(spectra: Tensor, phase_rad: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean entropy of the windows after removing a phase, and its gradient to the phase of
    each frequency.

    spectra: (trial, point, n) complex128, unit energy each (or zero); phase_rad: (trial, n);
    weight: (trial, point). Returns (trial,), (trial, n). Responses are sampled twice as finely as
    the image, so that it matters less where a point lies between samples. The removal is unitary,
    so p = |y|^2 sums to one and dH/dy* = -(ln p + 1) y.
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
    """Quasi-Newton (BFGS) descent of every trial on its own.

    start: (trial, p); cost gives (trial,) and the gradient (trial, p).

    A step is halved until the cost falls enough (Armijo); a trial that cannot improve, or improves
    by less than rtol, stays.
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
    """Legendre coefficients (degrees 2..orders[-1]) of the phase that leaves the sharpest windows.

    (trial, point, n) -> (trial, p).

    The orders are admitted in stages, each starting from the last, so that a large smooth phase is
    found before fine ripple.
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
    """Phase response by least entropy of the range windows about bright points.

    image: (..., azimuth, range), range spectrum centred.

    band: pulse bandwidth over sampling rate; width: window in samples, many times the spread of the
    response (shortened to half the valid columns where these are few); valid: number of fully
    compressed columns. After each pass the image is corrected and the points are chosen anew. The
    last pass fits two halves of the points apart: their mean is the estimate, less what chance
    makes of it, their difference its std. Gives `phase_rad` (..., GRID), see `repair.response` for
    the conventions, `amplitude` ones. quality falls with the difference of the halves, 1 / (1 +
    std^2). Not ok, with zero phase: no bright places (halves that differ by more than 0.25 rad
    rms).
    """
    used = image.detach()[..., :valid] if valid else image.detach()
    rows = used.reshape(-1, *used.shape[-2:])
    basis = unit_legendre(band_grid(image.device), orders[-1])[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for i in range(passes):
        sharper = correct_response(rows, total @ basis, None, band) if i else rows
        windows = brightest_windows(sharper, points, min(width, sharper.shape[-1] // 4 * 2))
        weight = window_weights(windows, sharper)
        if i < passes - 1:
            total = total + sharpest_coefficients(windows, weight, band, orders if i == 0 else orders[-1:])
    halves, weights = (torch.cat([x[:, 0::2], x[:, 1::2]]) for x in (windows, weight))
    first, second = sharpest_coefficients(halves, weights, band, orders[-1:]).chunk(2)
    total = total + (first + second) / 2
    std = torch.where(
        (weights.sum(-1) > 0).reshape(2, -1).all(0), torch.linalg.vector_norm(first - second, dim=-1) / 2, torch.inf
    )
    return _phase_estimate(_significant(total, std) @ basis, std, image.shape[:-2])


def _significant(c: Tensor, std: Tensor, times: float = 4.0) -> Tensor:
    """Coefficients (trial, p) less what chance makes of them: c max(0, 1 - (times * deviation /
    c)^2), deviation = std / sqrt(p).
    """
    limit = times * std[:, None] / math.sqrt(c.shape[-1])
    return c * (1 - (limit / c.abs().clamp_min(1e-300)).square()).clamp_min(0)


def _phase_estimate(phase_rad: Tensor, std: Tensor, trials: torch.Size) -> Estimate:
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
    """Coherent average of the spectra of single points, each less its own constant and linear
    phase. (trial, point, n) -> (trial, p).

    Starts from the spectrum of the brightest point, aligns every other one to it in slope (the peak
    of their correlation) and constant, and repeats with the average. The phase of the average is
    the running sum of its increments, fitted with Legendre polynomials.
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
    sure = (average.abs() + 1e-12)[..., None]
    return torch.linalg.lstsq(sure * unit_legendre(u[inside], order).mT, sure * phase[..., None]).solution[..., 2:, 0]


def _align(spectra: Tensor, reference: Tensor) -> Tensor:
    """Spectra (..., point, n) turned by the linear and constant phase that bring them closest to
    reference (..., 1, n).
    """
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
    """Phase response by the average of isolated bright points: the baseline.

    Arguments and result as estimate_response_sharpest.

    Takes one line for each point, so that noise tells more than there. Fails where the brightest
    places are not single points and where the response spreads them over much of the window.
    """
    used = image.detach()[..., :valid] if valid else image.detach()
    rows = used.reshape(-1, *used.shape[-2:])
    width = min(width, rows.shape[-1] // 4 * 2)
    basis = unit_legendre(band_grid(image.device), order)[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for i in range(passes):
        sharper = correct_response(rows, total @ basis, None, band) if i else rows
        windows = brightest_windows(sharper, points, width, apart=width // 2)
        weight = (window_weights(windows, sharper) > 0).to(torch.float64)
        total = total + point_average_coefficients(windows, weight, band, order)
    first, second = (
        point_average_coefficients(windows[:, part], weight[:, part], band, order)
        for part in (slice(0, None, 2), slice(1, None, 2))
    )
    std = torch.where((weight.sum(-1) > 1), torch.linalg.vector_norm(first - second, dim=-1) / 2, torch.inf)
    return _phase_estimate(total @ basis, std, image.shape[:-2])


class EstimateResponse(Stage):
    """Phase response of the channel from its focused image; amplitude too where an expected
    spectrum is given.

    method: `estimate_response_sharpest` (default) or `estimate_response_points`, or any function of
    (image, band, valid=columns). expected_power (n,): range power spectrum, FFT order, that a clean
    image of this kind has (`band_power(clean)`); without it the amplitude is one, because the
    spectrum of scene and noise is not known.
    """

    works_on = ("azimuth", "range")
    provides = ("phase_rad", "amplitude")

    expected_power: Tensor | None

    def __init__(
        self,
        radar: StripmapRadar,
        method: Callable[..., Estimate] = estimate_response_sharpest,
        expected_power: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.radar, self.method = radar, method
        self.register_buffer("expected_power", expected_power)

    def forward(self, signal: Signal) -> Estimate:
        band = self.radar.pulse.bandwidth_hz / self.radar.sampling_hz
        estimate = self.method(signal.data, band, valid=max(1, signal.data.shape[-1] - self.radar.pulse_samples))
        if self.expected_power is None:
            return estimate
        amplitude = estimate_amplitude_response(band_power(signal.data), self.expected_power, band)
        return Estimate(
            {**estimate.value, "amplitude": amplitude}, estimate.quality, estimate.ok, estimate.std, estimate.info
        )
