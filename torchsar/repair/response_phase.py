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

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    cis,
    differentiable,
    linear_phasor,
    power_of,
    unit_level,
)
from torchsar.optim import lbfgs
from torchsar.radar import StripmapRadar
from torchsar.repair.assess import assess_response, of_trials
from torchsar.repair.response import (
    GRID,
    band_axis,
    band_grid,
    band_power,
    correct_response,
    estimate_amplitude_response,
    unit_legendre,
)

# Highest Legendre degrees of the stages of a fit, by choice. A large smooth phase is found first,
# then ripple of up to about 20 periods over the band.
ORDERS = (2, 4, 8, 16, 40)
# ratio of the power of a peak to that of the noise at which its weight is one half, by choice
_FULL = 100.0
# number of windows that are computed at once, by measurement: so few that they stay in the cache
_BLOCK = 128


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
    highest = _running_maximum(_running_maximum(size, apart).mT, 1).mT
    peaks = torch.where((size == highest) & (size > 0), size, 0).flatten(-2)
    level, index = peaks.topk(min(points, peaks.shape[-1]), -1)
    index_in_line = index[..., None] + torch.arange(-half, width - half, device=image.device)
    windows = torch.gather(image.flatten(-2), -1, index_in_line.clamp(0, peaks.shape[-1] - 1).flatten(-2)).unflatten(
        -1, index_in_line.shape[-2:]
    )
    return windows * (level > 0)[..., None], index // n


def _running_maximum(x: Tensor, reach: int) -> Tensor:
    """Largest one of zero and the values up to `reach` samples away, along the last dimension."""
    x, span = torch.nn.functional.pad(x, (reach, reach)), 1
    while span < 2 * reach + 1:
        more = min(span, 2 * reach + 1 - span)
        x, span = torch.maximum(x[..., :-more], x[..., more:]), span + more
    return x


def window_weights(windows: Tensor, image: Tensor, floor: float = 20.0) -> Tensor:
    """Weight each window by the ratio s of its peak power to the background power of the image.

    The weight is s / (s + 100), and 0 where s is below `floor`. The background is the mean power
    of Gaussian speckle that has the median power of the image; the floor is so high that hardly one
    of a million speckle pixels exceeds it. The background is taken to be 1e-5 (-50 dB) of the
    brightest peak or more, since weaker maxima are side lobes of that peak.

    Args:
        windows: Windows, shape (..., point, width), complex.
        image: Image, shape (..., azimuth, range), complex.
        floor: Lowest ratio s with a weight above zero.

    Returns:
        Weights 0..1, shape (..., point), float64.
    """
    background = image.abs().flatten(-2).median(-1).values.square().to(torch.float64) / math.log(2)
    peak = windows.abs().amax(-1).square().to(torch.float64)
    s = peak / torch.maximum(background[..., None], 1e-5 * peak.amax(-1, keepdim=True)).clamp_min(1e-300)
    return torch.where(s > floor, s / (s + _FULL), 0)


def halved(weight: Tensor, line: Tensor) -> Tensor:
    """Divide windows into two halves that share few targets and no samples.

    A target has windows in several lines, and windows of one line overlap. The windows are
    therefore divided into quarters by their line; the outer two are one half, the inner two the
    other. All windows of a line belong to the quarter of the first of them.

    Args:
        weight: Weights of the windows, shape (trial, points); windows of weight 0 do not count.
        line: Lines of the windows, shape (trial, points).

    Returns:
        Weights of the windows in the first halves, then in the second ones, shape (2 trial,
        points): 0 for windows of the other half. If all windows lie in one line, a half has none.
    """
    used = weight > 0
    place = torch.where(used, line, line.amax() + 1)
    # number of windows in the lines before the line of each window
    first = torch.searchsorted(place.sort(-1).values, place)
    quarter = 4 * first // used.sum(-1, keepdim=True).clamp_min(1)
    inner = (quarter == 1) | (quarter == 2)
    return torch.cat([weight * ~inner, weight * inner])


def _spectra(windows: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Spectra of unit energy (window, n) of those windows (trial, point, n) that have a weight
    above zero, complex128.

    Also returns their weights, with the sum 1 in each trial, and their trials, in rising order.
    """
    used = (weight > 0) & (windows != 0).any(-1)
    spectra = _transformed(windows[used].to(torch.complex128))
    share = weight / weight.sum(-1, keepdim=True).clamp_min(1e-300)
    return spectra / torch.linalg.vector_norm(spectra, dim=-1, keepdim=True), share[used], used.nonzero()[:, 0]


def _transformed(windows: Tensor) -> Tensor:
    """Unitary FFT of windows (window, n), of which there may be none."""
    return torch.fft.fft(windows, norm="ortho") if windows.shape[0] else windows


def window_entropy(spectra: tuple[Tensor, Tensor, Tensor], phase_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean entropy of windows after removal of a phase, and its gradient.

    The entropy of a window is H = -sum p ln p with p = |y|^2, where y is the range response,
    sampled twice as finely as the image so that the position of a point between samples has less
    influence. Since the removal of a phase is unitary, p sums to one and dH/dy* = -(ln p + 1) y.

    Args:
        spectra: Spectra of unit energy, shape (window, n), their weights and their trials, shape
            (window,) each.
        phase_rad: Phase to be removed, in radians, FFT order, shape (trial, n), float64.

    Returns:
        Weighted mean entropy in nats, shape (trial,), and its derivative with respect to the phase
        of each frequency, shape (trial, n); zeros for trials without windows.
    """
    total, gradient = torch.zeros_like(phase_rad[:, 0]), torch.zeros_like(phase_rad)
    turn = cis(-phase_rad)
    for first in range(0, spectra[2].numel(), _BLOCK):
        unit, weight, trial = (x[first : first + _BLOCK] for x in spectra)
        entropy, slope = _entropy_slope(unit * turn[trial])
        total.index_add_(0, trial, weight * entropy)
        gradient.index_add_(0, trial, weight[:, None] * slope)
    return total, gradient


def _entropy_slope(turned: Tensor) -> tuple[Tensor, Tensor]:
    """Entropy (window,) of the range responses with given spectra (window, n), and its slope
    (window, n) by a phase that is removed.
    """
    n = turned.shape[-1]
    y = torch.fft.ifft(
        torch.cat([turned[:, : n // 2], torch.zeros_like(turned), turned[:, n // 2 :]], -1), norm="ortho"
    )
    p = power_of(y)
    log = torch.log(p.clamp_min(1e-30))
    slope = torch.fft.fft(-log * y, norm="ortho")
    slope = torch.cat([slope[:, : n // 2], slope[:, -(n - n // 2) :]], -1)
    return -(p * log).sum(-1), 2 * (slope.real * turned.imag - slope.imag * turned.real)


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
    spectra = _spectra(windows, weight)
    basis = unit_legendre(band_axis(windows.shape[-1], band, windows.device).clamp(-1, 1), orders[-1])[2:]
    c = torch.zeros((windows.shape[0], 0), dtype=torch.float64, device=windows.device)
    for order in orders:
        part = basis[: order - 1]

        def cost(c: Tensor, part: Tensor = part) -> tuple[Tensor, Tensor]:
            value, slope = window_entropy(spectra, c @ part)
            return value, slope @ part.mT

        start = torch.nn.functional.pad(c, (0, order - 1 - c.shape[-1]))
        c = lbfgs(cost, start, steps=steps, history=12, value_tolerance=1e-7, first_step=0.3, with_gradient=True).x
    return c


@differentiable("no")
def estimate_response_sharpest(
    image: Tensor,
    band: float,
    points: int = 800,
    width: int = 256,
    orders: tuple[int, ...] = ORDERS,
    passes: int = 3,
    valid: int | None = None,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase response as that whose removal makes bright points sharpest in range.

    >>> import torch
    >>> image = torch.zeros(8, 64, dtype=torch.complex64)
    >>> image[2, 20] = image[5, 40] = 1
    >>> found = estimate_response_sharpest(image, band=0.8, width=16, orders=(4,), assess=False)
    >>> found["phase_rad"].shape
    torch.Size([1025])

    Sharpness is measured by the entropy of range windows about the points. After each pass the
    image is corrected and the points are chosen again. The last pass fits two halves of the points
    separately, which share few targets. The estimate is the mean of both fits; the standard
    deviation follows from their difference, and from what both have in common that a finer ripple
    of up to twice the highest degree would explain. Not differentiable.

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
        assess: Whether to add standard deviations, quality and outcome.

    Returns:
        Estimate with `phase_rad` in radians and its standard deviation, at GRID = 1025 equally
        spaced frequencies of the pulse band, shape (..., GRID), and `amplitude` of the same shape,
        all ones. `quality` is 1 / (1 + variance in rad^2). The outcome is NOISE
        where no point rises so far above the background that the search finds the right phase (the
        phase is that of noise), TOO_FEW where one of the two halves has no point, MISFIT where
        finer ripple is left in both halves, and INEXACT where the standard deviation is 0.125 rad
        or more.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than 32
            valid columns, or the width is below 16 samples.
    """
    rows = _rows(image, "estimate_response_sharpest", valid)
    basis = unit_legendre(band_grid(image.device), orders[-1])[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for i in range(passes):
        windows, line, weight = _windows(rows, total @ basis, band, points, width, 8)
        if i < passes - 1:
            total = total + sharpest_coefficients(windows, weight, band, orders if i == 0 else orders[-1:])
    halves, weights = windows.repeat(2, 1, 1), halved(weight, line)
    found = sharpest_coefficients(halves, weights, band, orders[-1:])
    phase_rad = (total + sum(found.chunk(2)) / 2) @ basis
    return _estimate(phase_rad, image, (halves, weights, found, weight, band) if assess else None)


def _rows(image: Tensor, name: str, valid: int | None) -> Tensor:
    """Images in a row, (trial, azimuth, range), of unit level, with the valid columns only."""
    image = checked_samples(image, name, "azimuth, range").detach()[..., :valid]
    return unit_level(image.reshape(-1, *image.shape[-2:]))


def _windows(
    rows: Tensor, phase_rad: Tensor, band: float, points: int, width: int, apart: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Windows around the brightest points after removal of a phase, their lines, and
    their weights.
    """
    sharper = correct_response(rows, phase_rad, None, band) if bool(phase_rad.any()) else rows
    width = min(width, rows.shape[-1] // 4 * 2)
    windows, line = brightest_windows(sharper, points, width, min(apart, width // 2))
    return windows, line, window_weights(windows, sharper)


def _estimate(phase_rad: Tensor, image: Tensor, fit: tuple[Tensor, Tensor, Tensor, Tensor, float] | None) -> Estimate:
    """Estimate of a phase response (trial, GRID), assessed from the fit of two halves of the
    windows.

    fit: Windows and weights of the halves (2 trial, ...); their coefficients; the weights of all
    windows, from which the ratio of their peaks to the noise follows; and the band. None for no
    assessment.
    """
    trials = image.shape[:-2]
    value = {"phase_rad": phase_rad.reshape(*trials, GRID), "amplitude": torch.ones(*trials, GRID).to(phase_rad)}
    if fit is None:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(value["phase_rad"][..., 0]))
    halves, weights, found, strength, band = fit
    spectra, count = _spectra(halves, weights), found.shape[-1]
    basis = unit_legendre(band_axis(halves.shape[-1], band, halves.device).clamp(-1, 1), 2 * (count + 1))[2:]

    def slope(coefficients: Tensor) -> Tensor:
        return window_entropy(spectra, coefficients @ basis)[1] @ basis[count:].mT

    # a window whose peak has s times the power of the noise contributes a variance of 1 / (2 s) to
    # each coefficient
    s = _FULL * strength / (1 - strength)
    bound = (count / (2 * s.sum(-1))).sqrt()
    sided = (weights.sum(-1) > 0).reshape(2, -1).all(0)
    fields = assess_response(found, basis.shape[0], slope, bound, sided, phase_rad)
    return Estimate(value, **of_trials(fields, trials))


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
    used = (weight > 0) & (windows != 0).any(-1)
    trial = used.nonzero()[:, 0]
    spectra = torch.fft.ifftshift((windows[used] * taper).to(torch.complex128), dim=-1)
    spectra = torch.fft.fftshift(_transformed(spectra), dim=-1)[:, inside]
    spectra = spectra / torch.linalg.vector_norm(spectra, dim=-1, keepdim=True)
    average = spectra.new_zeros(windows.shape[0], spectra.shape[-1])
    # True at the first window of each trial
    first = torch.diff(trial, prepend=trial.new_full((1,), -1)) > 0
    average[trial[first]] = spectra[first]
    for _ in range(rounds if trial.numel() else 0):
        spectra = _align(spectra, average[trial])
        average = torch.zeros_like(average).index_add(0, trial, spectra * weight[used][:, None])
    steps = torch.angle(average[..., 1:] * average[..., :-1].conj())
    phase = torch.nn.functional.pad(torch.cumsum(steps, -1), (1, 0))
    magnitude = (average.abs() + 1e-12)[..., None]
    return torch.linalg.lstsq(
        magnitude * unit_legendre(u[inside], order).mT, magnitude * phase[..., None], driver="gels"
    ).solution[..., 2:, 0]


def _align(spectra: Tensor, reference: Tensor) -> Tensor:
    """Align the linear and the constant phase of spectra (window, n) with those of the
    references.
    """
    n = 8 * spectra.shape[-1]
    correlation = torch.fft.fft(spectra * reference.conj(), n)
    index = power_of(correlation).argmax(-1, keepdim=True)
    slope = (index - n * (2 * index >= n)).to(torch.float64) / n
    constant = cis(-torch.angle(torch.gather(correlation, -1, index)))
    return spectra * linear_phasor(-slope[..., 0], 0, spectra.shape[-1], spectra.dtype) * constant


@differentiable("no")
def estimate_response_points(
    image: Tensor,
    band: float,
    points: int = 200,
    width: int = 128,
    order: int = 24,
    passes: int = 3,
    valid: int | None = None,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase response by the coherent average of the spectra of isolated bright points.

    >>> import torch
    >>> from torchsar import repair
    >>> phase_rad = torch.linspace(-1, 1, 1025).double().square()
    >>> image = repair.correct_response(torch.eye(2, 64).roll(20, 1) + 0j, -phase_rad, None, 0.8)
    >>> found = repair.estimate_response_points(image, band=0.8, width=32, order=2)
    >>> found["phase_rad"][[0, 512, 1024]].round(decimals=2).tolist()  # the mean is zero
    [0.67, -0.33, 0.67]

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
        assess: Whether to add standard deviations, quality and outcome.

    Returns:
        Estimate with `phase_rad` in radians and its standard deviation, at GRID = 1025 equally
        spaced frequencies of the pulse band, shape (..., GRID), and `amplitude` of the same shape,
        all ones. `quality` is 1 / (1 + variance in rad^2). The outcomes are those of
        `estimate_response_sharpest`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than 32
            valid columns, or the width is below 16 samples.
    """
    rows = _rows(image, "estimate_response_points", valid)
    basis = unit_legendre(band_grid(image.device), order)[2:]
    total = torch.zeros((rows.shape[0], basis.shape[0]), dtype=torch.float64, device=image.device)
    for _ in range(passes):
        windows, line, strength = _windows(rows, total @ basis, band, points, width, width // 2)
        weight = (strength > 0).to(torch.float64)
        total = total + point_average_coefficients(windows, weight, band, order)
    if not assess:
        return _estimate(total @ basis, image, None)
    halves, weights = windows.repeat(2, 1, 1), halved(weight, line)
    found = point_average_coefficients(halves, weights, band, order)
    return _estimate(total @ basis, image, (halves, weights, found, strength, band))


class EstimateResponse(Stage):
    """Estimator of the channel's phase and amplitude response from a focused image.

    >>> import torch
    >>> from torchsar import Signal, radar, repair
    >>> sensor = radar.StripmapRadar(3.2e9, radar.LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4e3)
    >>> image = Signal(torch.eye(64, 256) + 0j, sensor.image_axes(sensor.raw_axes(64, 256)))
    >>> found = repair.EstimateResponse(sensor, method="points")(image)
    >>> found["phase_rad"].shape, round(found["phase_rad"].abs().max().item(), 2), bool(found.ok)
    (torch.Size([1025]), 0.0, True)

    The abrupt edges of the pulse have frequencies that alias. The phase that they leave in the
    image depends on where they lie between samples; it is about 0.01 rad, and no part of the
    predicted standard deviation.

    The amplitude is estimated only if the range power spectrum of scene and noise is given as
    `expected_power`.

    Args:
        radar: Radar; gives bandwidth, sampling rate and length of the pulse.
        method: "sharpest" for `estimate_response_sharpest` (default), "points" for
            `estimate_response_points`, or any function of (image, band, valid=columns) that returns
            such an Estimate, where `columns` is the number of fully compressed range columns; also
            with `assess=False` if the stage is not to assess it.
        expected_power: Range power spectrum of an image of this kind without the response (see
            `band_power`), FFT order, shape (n,); None: the amplitude is one.
        assess: Whether to add standard deviations, quality and outcome.
    """

    works_on = ("azimuth", "range")
    provides = ("phase_rad", "amplitude")
    neutral = {"phase_rad": 0.0, "amplitude": 1.0}
    differentiable = "no"

    expected_power: Tensor | None

    def __init__(
        self,
        radar: StripmapRadar,
        method: Literal["sharpest", "points"] | Callable[..., Estimate] = "sharpest",
        expected_power: Tensor | None = None,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__()
        self.radar, self.assess = radar, assess
        methods = {"sharpest": estimate_response_sharpest, "points": estimate_response_points}
        self.method = methods[method] if isinstance(method, str) else method
        self.register_buffer("expected_power", expected_power)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the phase and amplitude response of the channel along range.

        Args:
            signal: Image, shape (..., azimuth, range).

        Returns:
            Estimate with `phase_rad` in radians and `amplitude` at 1025 equally spaced frequencies
            of the pulse band. The amplitude is one unless the constructor received
            `expected_power`; that of `EstimateFlatResponse` is relative to a flat spectrum.
        """
        expected = self._expected(signal.data)
        band = self.radar.pulse.bandwidth_hz / self.radar.sampling_hz
        asked = {} if self.assess else {"assess": False}
        valid = max(1, signal.data.shape[-1] - self.radar.pulse_samples)
        estimate = self.method(signal.data, band, valid=valid, **asked)
        if expected is None:
            return estimate
        amplitude = estimate_amplitude_response(band_power(unit_level(signal.data)), expected, band)
        return replace(estimate, value={**estimate.value, "amplitude": amplitude})

    def _expected(self, image: Tensor) -> Tensor | None:
        return self.expected_power


class EstimateFlatResponse(EstimateResponse):
    """Estimator of the response from images with a flat range spectrum.

    >>> import torch
    >>> from torchsar import Signal, radar, repair
    >>> sensor = radar.StripmapRadar(3.2e9, radar.LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4e3)
    >>> image = Signal(torch.eye(64, 256) + 0j, sensor.image_axes(sensor.raw_axes(64, 256)))
    >>> found = repair.EstimateFlatResponse(sensor, method="points")(image)
    >>> [round(x.item(), 2) for x in found["amplitude"].aminmax()]  # a flat spectrum
    [1.0, 1.0]

    The range compression must have used the reference "flat", which divides by the pulse spectrum
    inside the pulse band. Without an amplitude response, the image then has the same mean power at
    all frequencies of this band. The amplitude is therefore estimated as well as the phase.

    Args:
        radar: Radar; gives bandwidth, sampling rate and length of the pulse.
        method: "sharpest", "points" or a function; see `EstimateResponse`.
        assess: Whether to add standard deviations, quality and outcome.
    """

    def __init__(
        self,
        radar: StripmapRadar,
        method: Literal["sharpest", "points"] | Callable[..., Estimate] = "sharpest",
        *,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, method, assess=assess)

    def _expected(self, image: Tensor) -> Tensor | None:
        return torch.ones(image.shape[-1], dtype=torch.float64, device=image.device)
