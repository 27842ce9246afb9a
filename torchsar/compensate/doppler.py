"""Doppler centroid within one PRF: mean phase increment and energy centre of the azimuth spectrum.

Neither estimator needs the velocity (Tsvetkov 2017, Doppler estimation). Both take the phase of the
first Fourier coefficient of the azimuth power spectrum. The mean phase increment computes this
coefficient in time, from products of adjacent lines; the energy centre computes it in frequency.
The results agree to rounding and are therefore not independent evidence.

Doppler is positive when closing. Lines that are all zero (missing) enter no product and bias
neither estimator.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from torchsar.compensate import doppler_assess
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    fft_lines,
    legendre,
    linear_solve,
    power_of,
    settle,
    unit_level,
)
from torchsar.radar import StripmapRadar

OVER = ("mean", "median")  # how `combine_blocks` combines the blocks
# Energy at which the weight of a range block in a fit is halved, over the energy that three
# quarters of the blocks do not exceed.
_FAINT = 0.1


def wrap_hz(frequency_hz: Tensor, prf_hz: float) -> Tensor:
    """Wrap frequencies into the interval -PRF/2 .. PRF/2.

    Args:
        frequency_hz: Frequencies in Hz, any shape.
        prf_hz: Pulse repetition frequency in Hz.

    Returns:
        The wrapped frequencies in Hz, same shape.
    """
    return frequency_hz - prf_hz * torch.round(frequency_hz / prf_hz)


def _bounds(n: int, parts: int, what: str) -> list[tuple[int, int]]:
    """First and last index of each of `parts` nearly equal parts of 0..n."""
    if not 1 <= parts <= n:
        raise ValueError(f"blocks must be 1..{n} where there are {n} {what}, got {parts}")
    edges = [round(i * n / parts) for i in range(parts + 1)]
    return list(pairwise(edges))


def lag_products(x: Tensor, blocks: tuple[int, int] = (8, 8)) -> tuple[Tensor, Tensor]:
    """Sum the products of adjacent lines, and the powers of these lines, over blocks of the data.

    The products are conj(line n) * line n+1. Every pair of adjacent lines belongs to exactly one
    block. Each trial is first divided by its peak modulus, so the results do not depend on the
    scale of the input. Differentiable.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        blocks: Number of blocks a along pulses and b along range.

    Returns:
        The sum of the products of each block, shape (..., a, b), complex128; and the sum of the
        mean power of the two lines of each pair, shape (..., a, b), float64. The modulus of a
        product never exceeds its power; their ratio is the coherence.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if there are fewer pairs of lines or range cells
            than blocks.
    """
    x = unit_level(checked_samples(x, "lag_products", "pulse, range", finite=False))
    peak = x.detach().abs().amax((-2, -1), keepdim=True)
    x = x / torch.where(peak > 0, peak, 1)
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    products, powers = [], []
    for first, last in _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines"):
        part = x[..., first : last + 1, :]
        square = power_of(part)
        present = (square.detach().amax(-1) > 0).to(square.dtype)
        both = (present[..., :-1] * present[..., 1:])[..., None]
        product = (part[..., :-1, :].conj() * part[..., 1:, :]).sum(-2)
        power = 0.5 * ((square[..., :-1, :] + square[..., 1:, :]) * both).sum(-2)
        for sums, each in ((products, product.to(torch.complex128)), (powers, power.to(torch.float64))):
            sums.append(torch.stack([some.sum(-1) for some in each.split(columns, -1)], -1))
    return torch.stack(products, -2), torch.stack(powers, -2)


def azimuth_spectrum(x: Tensor, segments: int) -> Tensor:
    """Average the azimuth power spectrum over range cells and over segments of the lines.

    Each segment shares one line with the next and is padded with zeros to an even number of lines.
    If its number of pairs is even, the first Fourier coefficient of its spectrum is the sum of the
    products of its adjacent lines; otherwise it may also contain the product of its last and first
    line.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        segments: Number of segments.

    Returns:
        Power spectrum in FFT order, shape (..., n) for n Doppler bins, float64.

    Raises:
        ValueError: If there are fewer pairs of lines than segments.
    """
    x, bounds = unit_level(x), _bounds(x.shape[-2] - 1, segments, "pairs of lines")
    n = 2 * (max(last - first for first, last in bounds) // 2 + 1)
    spectra = [power_of(fft_lines(x[..., first : last + 1, :], n=n)) for first, last in bounds]
    return torch.stack([power.to(torch.float64).sum(-1) for power in spectra]).sum(0)


def plain_energy_centre(spectrum: Tensor, prf_hz: float) -> Tensor:
    """Compute the ordinary, non-circular centre of mass of a power spectrum.

    It serves for comparison only, because it is wrong wherever the spectrum wraps at half the PRF.
    Use `energy_centre` instead.

    Args:
        spectrum: Power spectrum in FFT order, shape (..., n).
        prf_hz: Pulse repetition frequency in Hz.

    Returns:
        The centre of mass in Hz, shape (...,), float64; 0 for an empty spectrum.
    """
    spectrum = spectrum.to(torch.float64)
    frequency = torch.fft.fftfreq(spectrum.shape[-1], 1 / prf_hz, dtype=torch.float64, device=spectrum.device)
    total = spectrum.sum(-1)
    return (spectrum * frequency).sum(-1) / torch.where(total > 0, total, 1)


def combine_blocks(products: Tensor, over: str = "mean") -> Tensor:
    """Combine the products of all blocks into one phase increment per trial.

    Args:
        products: Block products, shape (..., a, b), complex.
        over: "mean" takes the phase of the sum of all products, which weights blocks by their
            energy. "median" takes the median of the phases of the products, measured from the phase
            of that sum so that they do not wrap. Each block with energy then has equal weight, so
            that one bright block cannot dominate.

    Returns:
        The phase increment from line to line in rad, shape (...,).

    Raises:
        ValueError: If `over` is neither "mean" nor "median".
    """
    if over not in OVER:
        raise ValueError(f"over must be one of {OVER} (how blocks are combined), got {over!r}")
    flat = products.flatten(-2)
    mean = torch.angle(flat.sum(-1))
    if over == "mean":
        return mean
    offset = torch.angle(flat * torch.polar(torch.ones_like(mean), -mean)[..., None])
    offset = torch.where(flat.abs() > 0, offset, torch.nan)
    return mean + settle(torch.nanquantile(offset, 0.5, dim=-1), 0.0)[0]


def phase_increment(
    x: Tensor,
    prf_hz: float,
    blocks: tuple[int, int] = (8, 8),
    over: str = "mean",
    rate_hz_s: float | None = None,
    dwell_s: float | None = None,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the baseband Doppler centroid from the mean phase increment between adjacent lines.

    >>> turns = 0.1 * torch.arange(64)[:, None] + torch.rand(32)
    >>> lines = torch.polar(torch.ones(64, 32), 2 * torch.pi * turns)
    >>> round(phase_increment(lines, prf_hz=1000.0)["doppler_baseband_hz"].item(), 2)
    100.0

    The centroid is PRF * dphi / (2 pi), where dphi is the phase increment in rad. It is ambiguous
    by multiples of the PRF; `DopplerCentroid` resolves the ambiguity.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of blocks along pulses and along range.
        over: "mean" or "median" over the blocks, see `combine_blocks`.
        rate_hz_s: Magnitude of the Doppler rate of the targets in Hz/s, for the assessment. If it
            is None, targets are assumed to be seen for half of the record.
        dwell_s: Time that a target stays in the beam, in seconds, for the assessment. If it is
            None, it follows from the rate and the width of the spectrum.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `doppler_baseband_hz` in Hz, shape (...,), positive when closing, of the samples as they
        are: where they are quantised to one bit, harmonics shift it by some tenths of a percent of
        the PRF. `info` holds "block_hz" (centroid of each block, which shows how it varies along
        the strip and over range) and "block_power", both of shape (..., a, b).
        The assessment adds info["cut_hz"], the shift by apertures that the ends of the record cut,
        which the value still contains, shape (...,); a standard deviation, of the scatter of the
        range blocks and of this shift; and the coherence of adjacent lines as `quality`. The
        outcome is EMPTY or NOISE (adjacent lines are not coherent) where nothing was found, MISFIT
        where targets are cut too strongly, and INEXACT from a standard deviation of 1.5 % of the
        PRF on.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks, or `over` is unknown.

    Reference:
        Tsvetkov 2017, text before Fig. 5.
    """
    x = checked_samples(x, "phase_increment", "pulse, range")
    products, power = lag_products(x, blocks)
    phase = combine_blocks(products, over)
    info = {"block_hz": prf_hz / (2 * math.pi) * torch.angle(products), "block_power": power}
    found = Estimate({"doppler_baseband_hz": wrap_hz(prf_hz / (2 * math.pi) * phase, prf_hz)}, info=info)
    if not assess:
        return found
    return doppler_assess.baseband(found, doppler_assess.Increments.of(x, products, power, prf_hz, rate_hz_s, dwell_s))


def energy_centre(
    x: Tensor,
    prf_hz: float,
    blocks: tuple[int, int] = (8, 8),
    rate_hz_s: float | None = None,
    dwell_s: float | None = None,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the baseband Doppler centroid as the circular energy centre of the azimuth spectrum.

    >>> turns = 0.1 * torch.arange(65)[:, None] + torch.rand(32)
    >>> lines = torch.polar(torch.ones(65, 32), 2 * torch.pi * turns)
    >>> round(energy_centre(lines, prf_hz=1000.0)["doppler_baseband_hz"].item(), 2)
    100.0

    The power spectrum is averaged over range. The result agrees with `phase_increment` to
    rounding if the blocks hold an even number of pairs of lines; see `azimuth_spectrum`.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of blocks along pulses and, for the assessment, along range.
        rate_hz_s: As for `phase_increment`.
        dwell_s: As for `phase_increment`.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `doppler_baseband_hz` in Hz, shape (...,), positive when closing. `info` holds "spectrum",
        the azimuth power spectrum in FFT order, shape (..., n) for n Doppler bins, and
        "plain_baseband_hz", its non-circular centre of mass, shape (...,), which is wrong where the
        spectrum wraps. The assessment, with its outcomes, is that of `phase_increment`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks.

    Reference:
        Tsvetkov 2017, energy centre of the azimuth spectrum.
    """
    x = checked_samples(x, "energy_centre", "pulse, range")
    spectrum = azimuth_spectrum(x, blocks[0])
    n = spectrum.shape[-1]
    # first Fourier coefficient
    turn = 2 * math.pi / n * torch.arange(n, dtype=torch.float64, device=x.device)
    phase = torch.atan2((spectrum * torch.sin(turn)).sum(-1), (spectrum * torch.cos(turn)).sum(-1))
    info = {"spectrum": spectrum, "plain_baseband_hz": plain_energy_centre(spectrum, prf_hz)}
    found = Estimate({"doppler_baseband_hz": wrap_hz(prf_hz / (2 * math.pi) * phase, prf_hz)}, info=info)
    if not assess:
        return found
    products = lag_products(x, blocks)
    return doppler_assess.baseband(found, doppler_assess.Increments.of(x, *products, prf_hz, rate_hz_s, dwell_s))


def fit_over_range(products: Tensor, power: Tensor, order: int, rounds: int = 12) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a robust polynomial to the phase increment over range blocks.

    The polynomial is a sum of Legendre polynomials of the position of the block, which runs from -1
    to 1 across the swath. Blocks are weighted with the square of their coherence, and those of much
    less energy than most, such as the sidelobes of others, count less. Blocks whose residuals are
    large compared with the median residual are weighted down (Cauchy weights), so that a few very
    bright targets do not bend the curve.

    Args:
        products: Block products, shape (..., b), complex.
        power: Mean power of the same pairs of lines, shape (..., b).
        order: Order of the polynomial.
        rounds: Number of reweighted least-squares rounds.

    Returns:
        The coefficients of the Legendre polynomials in rad, shape (..., order + 1); the residuals
        in rad, shape (..., b); and the weights, shape (..., b).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the order is negative
            or not below the number of range blocks.
    """
    products = checked_samples(products, "fit_over_range", "block")
    count = products.shape[-1]
    if not 0 <= order < count:
        raise ValueError(f"order of the polynomial must be 0 or more and below the {count} range blocks, got {order}")
    mean = torch.angle(products.sum(-1))
    angle = torch.angle(products * torch.polar(torch.ones_like(mean), -mean)[..., None])
    basis = legendre(block_centres(count, products.device), order)
    energy = products.abs()
    coherence = energy / torch.where(power > 0, power, 1)
    usual = energy.quantile(0.75, dim=-1, keepdim=True)
    floor = energy + _FAINT * usual
    weight = coherence.square() * energy / torch.where(floor > 0, floor, 1)
    coefficients, residual = weighted_fit(basis, angle, weight)
    final = weight
    for _ in range(rounds):
        scale = 1.5 * residual.abs().median(-1, keepdim=True).values.clamp_min(1e-6)
        final = weight / (1 + (residual / (2 * scale)).square())
        coefficients, residual = weighted_fit(basis, angle, final)
    constant = torch.zeros_like(coefficients)
    constant[..., 0] = mean
    return coefficients + constant, residual, final


def weighted_fit(basis: Tensor, y: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fit values by functions in the sense of weighted least squares.

    Args:
        basis: Functions, shape (b, n).
        y: Values, shape (..., b).
        weight: Weights, shape (..., b).

    Returns:
        The coefficients, shape (..., n), and the residuals, shape (..., b).
    """
    weighted = basis * weight[..., None]
    normal = weighted.mT @ basis
    ridge = 1e-12 * (normal.diagonal(dim1=-2, dim2=-1).amax(-1) + 1e-30)
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    coefficients = linear_solve(normal + ridge[..., None, None] * eye, (weighted * y[..., None]).sum(-2))
    return coefficients, y - coefficients @ basis.mT


def block_centres(count: int, device: torch.device | None = None) -> Tensor:
    """Return the centres of equal blocks of the interval -1..1, shape (count,), float64."""
    return (2 * torch.arange(count, dtype=torch.float64, device=device) + 1) / count - 1


def nominal_doppler(radar: StripmapRadar) -> dict[str, float]:
    """Return the Doppler centroid that is assumed where it cannot be estimated.

    Args:
        radar: Radar parameters.

    Returns:
        `doppler_hz`, which is `pointing_doppler_hz` of the radar, or 0 if that is None; and
        `doppler_baseband_hz`, the same wrapped into the interval -PRF/2 .. PRF/2.
    """
    nominal = radar.pointing_doppler_hz or 0.0
    wrapped = wrap_hz(torch.tensor(nominal, dtype=torch.float64), radar.prf_hz)
    return {"doppler_hz": nominal, "doppler_baseband_hz": float(wrapped)}


def swept_band(radar: StripmapRadar, n_range: int) -> tuple[float, float | None]:
    """Return the Doppler rate of targets in the middle of the swath, and their time in the beam.

    Args:
        radar: Radar parameters.
        n_range: Number of range samples.

    Returns:
        The magnitude of the rate in Hz/s, for the pointing of the radar, and `integration_s` of the
        radar in seconds, which may be None.
    """
    middle = radar.near_range_m + n_range / 2 * radar.range_step_m
    cos_square = 1 - min(1.0, float(radar.sin_squint(radar.pointing_doppler_hz or 0.0)) ** 2)
    return float(radar.azimuth_rate_hz_s(middle)) * max(cos_square, 1e-6), radar.integration_s


class PhaseIncrement(Stage):
    """Baseband Doppler centroid from the phase increment between lines.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `phase_increment`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
        over: How the phase increments of the blocks are combined: "mean" (weighted by energy) or
            "median" (robust against bright blocks).
        assess: Whether to add the standard deviation, the quality and the outcome.

    Raises:
        ValueError: If `over` is neither "mean" nor "median".
    """

    provides = ("doppler_baseband_hz",)

    def __init__(
        self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8), over: str = "mean", assess: bool = True
    ) -> None:
        super().__init__()
        if over not in OVER:
            raise ValueError(f"over must be one of {OVER} (how blocks are combined), got {over!r}")
        self.radar, self.blocks, self.over, self.assess = radar, blocks, over, assess
        self.neutral = {name: nominal_doppler(radar)["doppler_baseband_hz"] for name in self.provides}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the baseband Doppler centroid of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `phase_increment` with `doppler_baseband_hz` in Hz, shape
            (...,).
        """
        swept = swept_band(self.radar, signal.data.shape[-1])
        return phase_increment(signal.data, self.radar.prf_hz, self.blocks, self.over, *swept, assess=self.assess)


class EnergyCentre(Stage):
    """Baseband Doppler centroid as the circular energy centre of the spectrum.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `energy_centre`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("doppler_baseband_hz",)

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8), assess: bool = True) -> None:
        super().__init__()
        self.radar, self.blocks, self.assess = radar, blocks, assess
        self.neutral = {name: nominal_doppler(radar)["doppler_baseband_hz"] for name in self.provides}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the baseband Doppler centroid of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `energy_centre` with `doppler_baseband_hz` in Hz, shape
            (...,).
        """
        swept = swept_band(self.radar, signal.data.shape[-1])
        return energy_centre(signal.data, self.radar.prf_hz, self.blocks, *swept, assess=self.assess)


class RangeDependentCentroid(Stage):
    """Doppler centroid of every range cell, by a robust polynomial over range.

    Provides `doppler_range_hz` of shape (..., range), and `doppler_baseband_hz` of shape (...,) in
    the middle of the swath; leaves the signal unchanged. If an absolute `doppler_hz` is connected,
    `doppler_range_hz` is absolute too: it is raised by the multiple of the PRF that brings it
    nearest to `doppler_hz` in the middle of the swath. Otherwise it is baseband.

    Args:
        radar: Radar parameters. The values depend on the PRF only.
        order: Order of the polynomial over range, see `fit_over_range`.
        blocks: Number of blocks along pulses and along range.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("doppler_range_hz", "doppler_baseband_hz")

    def __init__(
        self, radar: StripmapRadar, order: int = 1, blocks: tuple[int, int] = (8, 16), assess: bool = True
    ) -> None:
        super().__init__()
        self.radar, self.order, self.blocks, self.assess = radar, order, blocks, assess
        self.neutral = {name: nominal_doppler(radar)["doppler_baseband_hz"] for name in self.provides}

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate the centroid of every range cell of a signal of axes (pulse, range).

        Args:
            signal: Lines, shape (..., pulse, range), complex.
            doppler_hz: Absolute centroid in Hz, shape (...,), positive when closing. Without it,
                the result is baseband.

        Returns:
            `doppler_range_hz` of every range cell, shape (..., range), and `doppler_baseband_hz` in
            the middle of the swath, shape (...,), in Hz. `info` holds "block_hz" (centroid of each
            of the b range blocks), shape (..., b), and "coefficients_hz" (of the Legendre
            polynomials), shape (..., order + 1).
            The assessment adds a standard deviation of `doppler_baseband_hz`, which includes the
            shift by apertures that the ends of the record cut. The outcomes are those of
            `phase_increment`, and TOO_FEW where fewer than order + 2 range blocks hold most of the
            energy: one target alone shows no slope over range.

        Raises:
            ValueError: If there are too few lines or range cells for the blocks, or too few blocks
                for the order.
        """
        prf_hz, scale = self.radar.prf_hz, self.radar.prf_hz / (2 * math.pi)
        products, power = lag_products(signal.data, self.blocks)
        fit = fit_over_range(products.sum(-2), power.sum(-2), self.order)
        coefficients, device = fit[0], signal.data.device
        at_middle = legendre(torch.zeros(1, dtype=torch.float64, device=device), self.order)[0]
        middle = scale * (coefficients @ at_middle)
        curve = scale * coefficients @ legendre(block_centres(signal.data.shape[-1], device), self.order).mT
        if doppler_hz is not None:
            curve = curve + (prf_hz * torch.round((doppler_hz - middle) / prf_hz))[..., None]
        found = Estimate(
            {"doppler_range_hz": curve, "doppler_baseband_hz": wrap_hz(middle, prf_hz)},
            quality=torch.ones_like(middle),
            info={"block_hz": scale * torch.angle(products.sum(-2)), "coefficients_hz": scale * coefficients},
            neutral={} if doppler_hz is None else {"doppler_range_hz": doppler_hz[..., None]},
        )
        if not self.assess:
            return found
        swept = swept_band(self.radar, signal.data.shape[-1])
        lines = doppler_assess.Increments.of(signal.data, products, power, prf_hz, *swept)
        basis = legendre(block_centres(self.blocks[1], device), self.order)
        return doppler_assess.over_range(found, lines, basis, at_middle, *fit[1:])


def point_doppler(
    x: Tensor, prf_hz: float, rate_hz_s: Tensor | float = 0.0, centre_hz: Tensor | float = 0.0, rounds: int = 6
) -> Tensor:
    """Estimate the Doppler of one point at the middle line of its history by maximum likelihood.

    The quadratic phase that `rate_hz_s` predicts is removed first. The peak of the zero-padded
    spectrum is then refined by Newton steps. The standard deviation of the result is the Cramer-Rao
    bound of a tone, 0.39 / (T sqrt(q)) in Hz, where T is the length of the history in seconds and q
    the SNR after compression as a power ratio. This bound lies below the reference curve 1 / (T
    sqrt(q)) of Tsvetkov (2017). The result is the Doppler of the point at that time, not the
    Doppler centroid of the beam.

    Args:
        x: Azimuth history of the point, shape (..., pulse), complex.
        prf_hz: Pulse repetition frequency in Hz.
        rate_hz_s: Magnitude of the Doppler rate in Hz/s, shape (...,) or a number; 0 for a tone.
        centre_hz: Middle of the interval, one PRF wide, in which the result is given, in Hz, shape
            (...,) or a number.
        rounds: Number of Newton steps.

    Returns:
        The Doppler in Hz, shape (...,), float64, positive when closing.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    x = checked_samples(x, "point_doppler", "pulse")
    n = x.shape[-1]
    t = (torch.arange(n, dtype=torch.float64, device=x.device) - (n - 1) / 2) / prf_hz
    rate = torch.as_tensor(rate_hz_s, dtype=torch.float64, device=x.device)[..., None]
    signal = unit_level(x.to(torch.complex128), 1)
    signal = signal * torch.polar(torch.ones_like(t), math.pi * torch.remainder(rate * t.square(), 2))
    size = 4 * n
    peak = torch.fft.fft(signal, size).abs().argmax(-1)
    frequency = peak.to(torch.float64) * prf_hz / size
    for _ in range(rounds):
        turned = signal * torch.polar(
            torch.ones((), dtype=torch.float64, device=x.device), -2 * math.pi * frequency[..., None] * t
        )
        s0, s1, s2 = (((-2j * math.pi * t) ** k * turned).sum(-1) for k in range(3))
        slope = 2 * (s0.conj() * s1).real
        bend = 2 * (s1.abs().square() + (s0.conj() * s2).real)
        step = torch.where(bend < 0, -slope / torch.where(bend < 0, bend, -1), 0)
        frequency = frequency + step.clamp(-prf_hz / size, prf_hz / size)
    centre = torch.as_tensor(centre_hz, dtype=torch.float64, device=x.device)
    return centre + wrap_hz(frequency - centre, prf_hz)
