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
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    cis,
    fft_lines,
    legendre,
    linear_solve,
    matrix_inverse,
    power_of,
    settle,
    unit_level,
)
from torchsar.radar import StripmapRadar

OVER = ("mean", "median")  # how `combine_blocks` combines the blocks
# Largest standard deviation of an estimate that is ok, in PRF. Noise alone has a predicted standard
# deviation about ten times as large, since the sum of its products is no larger than their scatter.
MOST_STD = 0.015
# Least extent of the energy along the record, as a share of its length: targets seen for less are
# cut by the end of the record, or nearly as short as their own drift of Doppler.
_LEAST_EXTENT = 0.3
# Least power of the sum of the products of adjacent lines over the sum of their powers, one product
# per pair of lines. It is exponentially distributed with mean 1 where the lines are independent,
# whatever the range cells have in common; more than 9 then occurs once in 8000 records.
_LEAST_COHERENCE = 9.0
_FINE = (2, 4)  # parts of a block along pulses and range, for the power at its edges
# Least number of range blocks whose scatter is taken as the standard deviation; with fewer, it is
# the scatter of all blocks, which the sweep of the targets makes too large.
_LEAST_BLOCKS = 4
# Energy at which the weight of a range block in a fit is halved, over the energy that three
# quarters of the blocks do not exceed.
_FAINT = 0.1
# Relative scatter of the first moment of a cut target about its mean over targets of even density,
# for a beam of constant gain: sqrt(1/5).
_UNEVEN = 0.45


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
    x = x / _peak(x)
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    products, powers = [], []
    for first, last in _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines"):
        part = x[..., first : last + 1, :]
        square = power_of(part)
        present = (square.detach().amax(-1) > 0).to(square.dtype)
        both = (present[..., :-1] * present[..., 1:])[..., None]
        product = (part[..., :-1, :].conj() * part[..., 1:, :]).sum(-2)
        power = 0.5 * ((square[..., :-1, :] + square[..., 1:, :]) * both).sum(-2)
        products.append(_sums(product.to(torch.complex128), columns))
        powers.append(_sums(power.to(torch.float64), columns))
    return torch.stack(products, -2), torch.stack(powers, -2)


def _peak(x: Tensor) -> Tensor:
    """Peak modulus (..., 1, 1) of lines (..., pulse, range); 1 where it is 0."""
    peak = x.detach().abs().amax((-2, -1), keepdim=True)
    return torch.where(peak > 0, peak, 1)


def _sums(x: Tensor, sizes: list[int]) -> Tensor:
    """Sums over consecutive parts of the last dimension with the given sizes."""
    return torch.stack([part.sum(-1) for part in x.split(sizes, -1)], -1)


def block_spectra(x: Tensor, blocks: tuple[int, int] = (8, 8)) -> Tensor:
    """Compute azimuth power spectra of blocks of lines, summed over the range cells of each block.

    Each block shares one line with the next and is padded with zeros to an even number of lines. If
    its number of pairs is even, the first Fourier coefficient of its spectrum is the sum of the
    products of its adjacent lines, as `lag_products` computes it; otherwise it may also contain the
    product of its last and first line.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        blocks: Number of blocks a along pulses and b along range.

    Returns:
        Power spectra in FFT order, shape (..., a, b, n) for n Doppler bins, float64.

    Raises:
        ValueError: If there are fewer pairs of lines or range cells than blocks.
    """
    x = unit_level(x)
    segments = _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines")
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    n = 2 * (max(last - first for first, last in segments) // 2 + 1)
    spectra = []
    for first, last in segments:
        part = fft_lines(x[..., first : last + 1, :], n=n)
        power = power_of(part).to(torch.float64)
        spectra.append(_sums(power, columns).mT)
    return torch.stack(spectra, -3)


def circular_centre(spectrum: Tensor) -> Tensor:
    """Compute the first Fourier coefficient of a power spectrum.

    The phase of this coefficient divided by 2 pi is the circular energy centre of the spectrum, as
    a fraction of the sampling rate.

    Args:
        spectrum: Power spectrum in FFT order, shape (..., n).

    Returns:
        The coefficient, shape (...,), complex128.
    """
    n = spectrum.shape[-1]
    turns = torch.arange(n, dtype=torch.float64, device=spectrum.device) / n
    weights = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    return (spectrum.to(torch.complex128) * weights).sum(-1) / n


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


class Increments(NamedTuple):
    """Products of adjacent lines, and what the error of their phase depends on.

    Args:
        products: Sums over blocks, shape (..., a, b), complex128, see `lag_products`.
        power: Mean power of the same pairs of lines, shape (..., a, b).
        ends: Mean product of a pair of lines at the first and at the last line, shape (..., 2, b).
        sides: Products, summed over pulses, of a narrow strip of range cells at the b + 1 edges of
            the range blocks, shape (..., b + 1), in any unit.
        lines: What the power of a pair of lines at an end adds to the sum of the phase increments,
            see `cut_lines`; in lines, shape (...,).
        half_band_rad: Half of the band that a target sweeps in the beam, as a phase increment in
            rad, shape (...,).
        coherence: Power of the sum of the products of all pairs of lines over the sum of their
            powers, 0 to the number of pairs, shape (...,); about 1 for lines that are independent.
    """

    products: Tensor
    power: Tensor
    ends: Tensor
    sides: Tensor
    lines: Tensor
    half_band_rad: Tensor
    coherence: Tensor


def increments(
    x: Tensor, prf_hz: float, blocks: tuple[int, int], rate_hz_s: float | None = None, dwell_s: float | None = None
) -> Increments:
    """Compute the products of adjacent lines, and what the error of their phase depends on.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of blocks a along pulses and b along range.
        rate_hz_s: Magnitude of the Doppler rate of the targets in Hz/s. If it is None, targets are
            assumed to be seen for half of the record.
        dwell_s: Time that a target stays in the beam, in seconds. If it or the rate is None, the
            band that targets sweep is measured from the products of lines two apart.

    Returns:
        The products.
    """
    pairs, columns = x.shape[-2] - 1, x.shape[-1]
    split = [max(1, min(most, n // (2 * b))) for most, n, b in zip(_FINE, (pairs, columns), blocks, strict=True)]
    fine, power = lag_products(x, (split[0] * blocks[0], split[1] * blocks[1]))
    sizes = [last - first for first, last in _bounds(pairs, fine.shape[-2], "pairs of lines")]
    ends = torch.stack([fine[..., i, :] / sizes[i] for i in (0, -1)], -2)
    strips, k = fine.sum(-2), split[1]
    sides = [strips[..., :1], 0.5 * (strips[..., k - 1 : -1 : k] + strips[..., k::k]), strips[..., -1:]]
    total = fine.sum((-2, -1))
    x = unit_level(x)
    x = x / _peak(x)
    if rate_hz_s is None or dwell_s is None:
        half_band = _half_band_rad(x, total)
    else:
        half_band = torch.full_like(total.real, math.pi * rate_hz_s * dwell_s / prf_hz)
    half_band = half_band.clamp(1e-3, 0.95 * math.pi)
    if rate_hz_s is None:
        dwell_lines: Tensor | float = pairs / 2
    else:
        dwell_lines = half_band * prf_hz**2 / (math.pi * rate_hz_s)
    return Increments(
        _grouped(_grouped(fine, split[0], -2), k, -1),
        _grouped(_grouped(power, split[0], -2), k, -1),
        _grouped(ends, k, -1),
        torch.cat(sides, -1),
        cut_lines(half_band, dwell_lines),
        half_band,
        _coherence_of_pairs(x),
    )


def _grouped(x: Tensor, count: int, dim: int) -> Tensor:
    """Sums of `count` neighbours along a dimension."""
    return x.unflatten(dim, (-1, count)).sum(dim)


def _coherence_of_pairs(x: Tensor) -> Tensor:
    """Power of the sum of the products of pairs of lines over the sum of their powers, (...,)."""
    pairs = torch.linalg.vecdot(x[..., :-1, :], x[..., 1:, :]).to(torch.complex128)
    scatter = pairs.abs().square().sum(-1)
    return pairs.sum(-1).abs().square() / torch.where(scatter > 0, scatter, 1)


def _half_band_rad(x: Tensor, total: Tensor) -> Tensor:
    """Half width (...,) of a band of constant density, from products of lines two apart.

    x: Lines as in `lag_products`, of unit peak. total: Sum of the products of adjacent lines, as
    from there, shape (...,).
    """
    second = torch.linalg.vecdot(x[..., :-2, :].flatten(-2), x[..., 2:, :].flatten(-2)).to(torch.complex128)
    size = total.abs()
    direction = total / torch.where(size > 0, size, 1)
    return torch.acos(((second * direction.conj().square()).real / torch.where(size > 0, size, 1)).clamp(-1, 1))


def cut_lines(half_band_rad: Tensor, dwell_lines: Tensor | float) -> Tensor:
    """Compute how strongly apertures cut by an end of a record shift the sum of phase increments.

    A target whose aperture is cut shows only a part of its band. For targets of even density on
    both sides of an end of the record, which cross a beam of constant gain in N lines with phase
    increments up to b rad from the centroid, the imaginary part of the products of adjacent lines,
    turned by the centroid and summed over the record, is (1 - b cot b) N / (2 b) times the real
    part of one pair of lines at the last line, and minus this at the first line.

    Args:
        half_band_rad: b in rad, shape (...,).
        dwell_lines: N in lines, shape (...,) or a number.

    Returns:
        The factor in lines, shape (...,); b N / 6 for a small band.
    """
    return (1 - half_band_rad / torch.tan(half_band_rad)) * dwell_lines / (2 * half_band_rad)


def increment_std_rad(found: Increments, phase_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Predict the scatter of a combined phase increment, and its shift by cut apertures.

    The scatter is that of the range blocks, which is due to noise, speckle and the apertures of
    single targets, without the shifts of the blocks by cut apertures and without what a change of
    Doppler along the pulse and along the range walk of a target adds to a block and takes from the
    next. Where few blocks hold most of the energy, the difference of few cut targets from an even
    density is added. With fewer than four range blocks it is the scatter of all blocks.

    Args:
        found: Products of adjacent lines.
        phase_rad: Combined increment in rad, shape (...,).

    Returns:
        The standard deviation that the scatter causes, and the shift, in rad, shape (...,) each; pi
        and 0 where there is no energy.
    """
    total = (found.products.sum((-2, -1)) * cis(-phase_rad)).real
    some = total > 0
    total = torch.where(some, total, 1)

    def by_ends(phase: Tensor) -> Tensor:
        power = (found.ends * cis(-phase)[..., None, None]).real
        return power * (found.lines / total)[..., None, None]

    shift = by_ends(phase_rad).sum(-1).diff(dim=-1)[..., 0].clamp(-1, 1)
    turn = cis(shift - phase_rad)
    cut = by_ends(phase_rad - shift)
    turned = found.products * (turn / total)[..., None, None]
    blocks, count = turned.sum(-2), turned.shape[-1]
    if count < _LEAST_BLOCKS:
        variance = turned.imag.square().sum((-2, -1))
    else:
        residual = blocks.imag - cut.diff(dim=-2)[..., 0, :]
        along = (found.sides * turn[..., None]).real.diff(dim=-1)
        size = along.square().sum(-1, keepdim=True)
        slope = (residual * along).sum(-1, keepdim=True) / torch.where(size > 0, size, 1)
        variance = count / (count - 2) * (residual - slope * along).square().sum(-1)
    share = blocks.real.clamp(0, 1).square().sum(-1).clamp_max(1)
    variance = variance + (_UNEVEN * share).square() * cut.square().sum((-2, -1))
    return torch.where(some, variance.sqrt().clamp_max(math.pi), math.pi), torch.where(some, shift, 0)


def reliable_increment(found: Increments, phase_rad: Tensor, scatter_rad: Tensor, shift_rad: Tensor) -> Tensor:
    """Decide whether a phase increment between adjacent lines shows the Doppler centroid.

    The scatter must be below 1.5 % of the PRF, and the shift by cut apertures below an eighth of
    the band of the beam. The products of adjacent lines, each summed over all range cells, must
    add up to more than three times the root of the sum of their powers: in independent lines they
    do not, but a bright range cell, or interference that all range cells share, hides this from the
    scatter of the range blocks. If the record is divided into four blocks or more along pulses, the
    energy must also fill 0.3 of the record: where targets are seen only at an end of the record,
    nothing shows how much of their apertures is cut.

    Args:
        found: Products of adjacent lines.
        phase_rad: Phase increment in rad, shape (...,).
        scatter_rad: Its standard deviation from the scatter of the blocks in rad, shape (...,).
        shift_rad: Its shift by cut apertures in rad, shape (...,).

    Returns:
        Bool, shape (...,).
    """
    real = (found.products.sum(-1) * cis(-phase_rad)[..., None]).real.clamp_min(0)
    square = real.square().sum(-1)
    extent = real.sum(-1).square() / torch.where(square > 0, square, 1) / real.shape[-1]
    filled = (square > 0) & ((extent >= _LEAST_EXTENT) | (real.shape[-1] < 4))
    filled = filled & (found.coherence > _LEAST_COHERENCE)
    return filled & (scatter_rad < 2 * math.pi * MOST_STD) & (shift_rad.abs() < found.half_band_rad / 4)


def baseband_estimate(found: Increments, phase_rad: Tensor, prf_hz: float, **info: Tensor) -> Estimate:
    """Convert a phase increment between adjacent lines to a baseband Doppler centroid.

    Args:
        found: Products of adjacent lines, from which the standard deviation and the quality follow.
        phase_rad: Phase increment from line to line, combined from all blocks, in rad, shape
            (...,).
        prf_hz: Pulse repetition frequency in Hz.
        info: Further entries for `info` of the estimate.

    Returns:
        `doppler_baseband_hz` of shape (...,), positive when closing, with its standard deviation in
        Hz, which includes the shift by apertures that the ends of the record cut. `quality` is the
        coherence of adjacent lines. `ok` is False where there is no energy, where the scatter of
        the blocks gives a standard deviation of 1.5 % of the PRF or more, where the shift by cut
        apertures is an eighth of the band of the beam or more, where adjacent lines are not
        significantly coherent, or where the energy fills less than 0.3 of the record, see
        `reliable_increment`. The centroid is that of the samples as they are: where they are
        quantised to one bit, harmonics shift it by some tenths of a percent of the PRF, which the
        standard deviation does not contain. `info` holds "block_hz" (centroid of each block) and
        "block_power", both of shape (..., a, b), "cut_hz" (the estimated shift by cut apertures,
        which the value still contains), shape (...,), and the entries given.
    """
    scale = prf_hz / (2 * math.pi)
    scatter, shift = increment_std_rad(found, phase_rad)
    total = found.power.sum((-2, -1))
    quality = (found.products.sum((-2, -1)).abs() / torch.where(total > 0, total, 1)).clamp(0, 1)
    return Estimate(
        {"doppler_baseband_hz": wrap_hz(scale * phase_rad, prf_hz)},
        {"doppler_baseband_hz": scale * torch.hypot(scatter, shift)},
        quality,
        Outcome.of(reliable_increment(found, phase_rad, scatter, shift), Outcome.NOISE),
        info={
            "block_hz": scale * torch.angle(found.products),
            "block_power": found.power,
            "cut_hz": scale * shift,
            **info,
        },
    )


def phase_increment(
    x: Tensor,
    prf_hz: float,
    blocks: tuple[int, int] = (8, 8),
    over: str = "mean",
    rate_hz_s: float | None = None,
    dwell_s: float | None = None,
) -> Estimate:
    """Estimate the baseband Doppler centroid from the mean phase increment between adjacent lines.

    The centroid is PRF * dphi / (2 pi), where dphi is the phase increment in rad. It is ambiguous
    by multiples of the PRF; `DopplerCentroid` resolves the ambiguity.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of blocks along pulses and along range.
        over: "mean" or "median" over the blocks, see `combine_blocks`.
        rate_hz_s: Magnitude of the Doppler rate of the targets in Hz/s. It serves for the standard
            deviation only. If it is None, targets are assumed to be seen for half of the record.
        dwell_s: Time that a target stays in the beam, in seconds. It serves for the standard
            deviation only. If it is None, it follows from the rate and the width of the spectrum.

    Returns:
        `doppler_baseband_hz` in Hz, shape (...,), positive when closing, with its standard
        deviation. `quality` is the coherence of adjacent lines; `ok` and `info` are those of
        `baseband_estimate`. info["block_hz"] shows how the centroid varies along the strip and over
        range.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks, or `over` is unknown.

    Reference:
        Tsvetkov 2017, text before Fig. 5.
    """
    x = checked_samples(x, "phase_increment", "pulse, range")
    found = increments(x, prf_hz, blocks, rate_hz_s, dwell_s)
    return baseband_estimate(found, combine_blocks(found.products, over), prf_hz)


def energy_centre(
    x: Tensor,
    prf_hz: float,
    blocks: tuple[int, int] = (8, 8),
    rate_hz_s: float | None = None,
    dwell_s: float | None = None,
) -> Estimate:
    """Estimate the baseband Doppler centroid as the circular energy centre of the azimuth spectrum.

    The power spectrum is averaged over range. The result agrees with `phase_increment` to
    rounding if the blocks hold an even number of pairs of lines; see `block_spectra`.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of blocks along pulses and along range.
        rate_hz_s: Magnitude of the Doppler rate of the targets in Hz/s. It serves for the standard
            deviation only. If it is None, targets are assumed to be seen for half of the record.
        dwell_s: Time that a target stays in the beam, in seconds. It serves for the standard
            deviation only. If it is None, it follows from the rate and the width of the spectrum.

    Returns:
        `doppler_baseband_hz` in Hz, shape (...,), positive when closing, with its standard
        deviation. `quality`, `ok` and `info` are those of `baseband_estimate`. `info` also holds
        "spectrum", the azimuth power spectrum in FFT order, shape (..., n) for n Doppler bins, and
        "plain_baseband_hz", its non-circular centre of mass, shape (...,), which is wrong where the
        spectrum wraps.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks.

    Reference:
        Tsvetkov 2017, energy centre of the azimuth spectrum.
    """
    x = checked_samples(x, "energy_centre", "pulse, range")
    spectrum = block_spectra(x, blocks).sum((-3, -2))
    return baseband_estimate(
        increments(x, prf_hz, blocks, rate_hz_s, dwell_s),
        torch.angle(circular_centre(spectrum)),
        prf_hz,
        spectrum=spectrum,
        plain_baseband_hz=plain_energy_centre(spectrum, prf_hz),
    )


def fit_over_range(
    products: Tensor, power: Tensor, order: int, rounds: int = 12
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
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
        The coefficients of the Legendre polynomials in rad, shape (..., order + 1); their
        covariance in rad^2, shape (..., order + 1, order + 1), from the residuals of the blocks
        with their weights; the residuals in rad, shape (..., b); and the weights, shape (..., b).

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
    coefficients, residual = _weighted_fit(basis, angle, weight)
    final = weight
    for _ in range(rounds):
        scale = 1.5 * residual.abs().median(-1, keepdim=True).values.clamp_min(1e-6)
        final = weight / (1 + (residual / (2 * scale)).square())
        coefficients, residual = _weighted_fit(basis, angle, final)
    constant = torch.zeros_like(coefficients)
    constant[..., 0] = mean
    return coefficients + constant, _fit_covariance(basis, final, residual), residual, final


def _fit_covariance(basis: Tensor, weight: Tensor, residual: Tensor) -> Tensor:
    """Covariance of the coefficients of `_weighted_fit` from its residuals, whatever their spread.

    The square of each residual is divided by 1 minus its leverage, the share that the block has in
    its own fit.
    """
    influence = _influence(basis, weight)
    leverage = (influence * basis).sum(-1)
    terms = influence * (residual / (1 - leverage).clamp_min(0.1).sqrt())[..., None]
    return terms.mT @ terms


def _influence(basis: Tensor, weight: Tensor) -> Tensor:
    """Derivatives (..., b, n) of the coefficients of `_weighted_fit` with respect to the values."""
    normal = (basis * weight[..., None]).mT @ basis
    size = normal.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None] + 1e-30
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    return basis @ matrix_inverse(normal / size + 1e-12 * eye) * weight[..., None] / size


def _weighted_fit(basis: Tensor, y: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients and residuals of a weighted least-squares fit of y (..., b) by basis (b, n)."""
    weighted = basis * weight[..., None]
    normal = weighted.mT @ basis
    ridge = 1e-12 * (normal.diagonal(dim1=-2, dim2=-1).amax(-1) + 1e-30)
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    coefficients = linear_solve(normal + ridge[..., None, None] * eye, (weighted * y[..., None]).sum(-2))
    return coefficients, y - coefficients @ basis.mT


def _cut_shifts_rad(found: Increments, turn: Tensor) -> Tensor:
    """Shifts (..., 2, b) in rad of each range block by apertures cut at the first and last line.

    turn: Phasor of the negative phase increment, shape (...,).
    """
    ends = (found.ends * turn[..., None, None]).real * found.ends.real.new_tensor([-1.0, 1.0])[:, None]
    total = (found.products.sum(-2) * turn[..., None]).real[..., None, :]
    shift = found.lines[..., None, None] * ends / torch.where(total > 0, total, 1)
    return torch.where(total > 0, shift.clamp(-1, 1), 0)


def _uneven_rad(found: Increments, turn: Tensor, at: Tensor) -> Tensor:
    """Deviation (...,) in rad of a weighted sum over blocks, by few cut targets of uneven density.

    Targets that are seen at a time and cross a beam of constant gain have independent phase
    increments of even density. The scatter over time of their mean shows their number, and the
    shift at each end deviates from that of even density the less, the more targets are cut there.
    A target may fill several blocks, which then deviate together.

    turn: Phasor of the negative phase increment, shape (...,). at: Weights of the blocks, (..., b).
    """
    band = found.half_band_rad
    total = (found.products.sum(-2) * turn[..., None]).real
    weight = torch.where(total > 0, at / torch.where(total > 0, total, 1), 0)
    mean = (found.products * (turn[..., None] * weight)[..., None, :]).sum(-1)
    level = mean.real.mean(-1).square()
    alone = (1 - torch.sin(2 * band) / (2 * band)) / 2 * (band / torch.sin(band)).square()  # of one target
    per_target = mean.imag.square().mean(-1) / torch.where(level > 0, alone * level, 1)
    by_ends = (_cut_shifts_rad(found, turn) * at[..., None, :]).sum(-1).square().sum(-1)
    return _UNEVEN * (by_ends * per_target.clamp_max(1)).sqrt()


def block_centres(count: int, device: torch.device | None = None) -> Tensor:
    """Compute the centres of equal blocks of the interval -1..1.

    Args:
        count: Number of blocks.
        device: Device of the result.

    Returns:
        The centres, shape (count,), float64.
    """
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


def _nominal_baseband(radar: StripmapRadar, names: Iterable[str]) -> dict[str, float]:
    return dict.fromkeys(names, nominal_doppler(radar)["doppler_baseband_hz"])


class PhaseIncrement(Stage):
    """Baseband Doppler centroid from the phase increment between lines.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `phase_increment`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
        over: How the phase increments of the blocks are combined: "mean" (weighted by energy) or
            "median" (robust against bright blocks).

    Raises:
        ValueError: If `over` is neither "mean" nor "median".
    """

    provides = ("doppler_baseband_hz",)

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8), over: str = "mean") -> None:
        super().__init__()
        if over not in OVER:
            raise ValueError(f"over must be one of {OVER} (how blocks are combined), got {over!r}")
        self.radar, self.blocks, self.over = radar, blocks, over
        self.neutral = _nominal_baseband(radar, self.provides)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the baseband Doppler centroid of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `phase_increment` with `doppler_baseband_hz` in Hz, shape
            (...,).
        """
        rate, dwell = swept_band(self.radar, signal.data.shape[-1])
        return phase_increment(signal.data, self.radar.prf_hz, self.blocks, self.over, rate, dwell)


class EnergyCentre(Stage):
    """Baseband Doppler centroid as the circular energy centre of the spectrum.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `energy_centre`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
    """

    provides = ("doppler_baseband_hz",)

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8)) -> None:
        super().__init__()
        self.radar, self.blocks = radar, blocks
        self.neutral = _nominal_baseband(radar, self.provides)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the baseband Doppler centroid of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `energy_centre` with `doppler_baseband_hz` in Hz, shape
            (...,).
        """
        rate, dwell = swept_band(self.radar, signal.data.shape[-1])
        return energy_centre(signal.data, self.radar.prf_hz, self.blocks, rate, dwell)


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
    """

    provides = ("doppler_range_hz", "doppler_baseband_hz")

    def __init__(self, radar: StripmapRadar, order: int = 1, blocks: tuple[int, int] = (8, 16)) -> None:
        super().__init__()
        self.radar, self.order, self.blocks = radar, order, blocks
        self.neutral = _nominal_baseband(radar, self.provides)

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate the centroid of every range cell of a signal of axes (pulse, range).

        Args:
            signal: Lines, shape (..., pulse, range), complex.
            doppler_hz: Absolute centroid in Hz, shape (...,), positive when closing. Without it,
                the result is baseband.

        Returns:
            `doppler_range_hz` of every range cell, shape (..., range), and `doppler_baseband_hz` in
            the middle of the swath, shape (...,), in Hz. The latter has a standard deviation, which
            includes the shift by apertures that the ends of the record cut, and what this shift may
            differ by where few targets are cut. `ok` is False under the conditions of
            `reliable_increment`, and where fewer than order + 2 range blocks hold most of the
            energy: one target alone shows no slope over range.
            `info` holds "block_hz" (centroid of each of the b range blocks), shape
            (..., b), and "coefficients_hz" (of the Legendre polynomials), shape (..., order + 1).

        Raises:
            ValueError: If there are too few lines or range cells for the blocks, or too few blocks
                for the order.
        """
        prf_hz = self.radar.prf_hz
        found = increments(signal.data, prf_hz, self.blocks, *swept_band(self.radar, signal.data.shape[-1]))
        products, power = found.products.sum(-2), found.power.sum(-2)
        coefficients, _, residual, weight = fit_over_range(products, power, self.order)
        scale = prf_hz / (2 * math.pi)
        basis = legendre(block_centres(self.blocks[1], products.device), self.order)
        at_middle = legendre(torch.zeros(1, dtype=torch.float64, device=products.device), self.order)[0]
        middle = coefficients @ at_middle
        # cut apertures shift each block; the rest of its residual is scatter
        turn = cis(-middle)
        cut, rest = _weighted_fit(basis, residual - _cut_shifts_rad(found, turn).sum(-2), weight)
        shift = -cut @ at_middle
        uneven = _uneven_rad(found, turn, _influence(basis, weight) @ at_middle)
        scatter = ((_fit_covariance(basis, weight, rest) @ at_middle) @ at_middle).clamp_min(0).sqrt()
        energy = products.abs()
        square = energy.square().sum(-1)
        count = energy.sum(-1).square() / torch.where(square > 0, square, 1)
        ok = reliable_increment(found, middle, scatter, shift) & (count >= self.order + 2)
        std = scale * (scatter.square() + shift.square() + uneven.square()).sqrt()
        middle = scale * middle
        curve = scale * coefficients @ legendre(block_centres(signal.data.shape[-1], products.device), self.order).mT
        if doppler_hz is not None:
            curve = curve + (prf_hz * torch.round((doppler_hz - middle) / prf_hz))[..., None]
        total = power.sum(-1)
        quality = (products.abs().sum(-1) / torch.where(total > 0, total, 1)).clamp(0, 1)
        return Estimate(
            {"doppler_range_hz": curve, "doppler_baseband_hz": wrap_hz(middle, prf_hz)},
            {"doppler_baseband_hz": std},
            quality,
            Outcome.of(ok, Outcome.NOISE),
            info={"block_hz": scale * torch.angle(products), "coefficients_hz": scale * coefficients},
            neutral={} if doppler_hz is None else {"doppler_range_hz": doppler_hz[..., None]},
        )


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
