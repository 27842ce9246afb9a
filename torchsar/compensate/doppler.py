"""Doppler centroid within one PRF: phase increment and energy centre, blind to velocity (brief 004,
item 5; Tsvetkov 2017).

Both estimators are the first Fourier coefficient of the azimuth power spectrum, once taken in time
(the products of adjacent lines) and once in frequency, so they agree to rounding and are not
independent evidence. Doppler is positive when closing. Lines that are all zero (missing) take part
in no product and bias neither.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, fft_lines, legendre, settle
from torchsar.radar import StripmapRadar

OVER = ("mean", "median")


def wrap_hz(frequency_hz: Tensor, prf_hz: float) -> Tensor:
    """Into -prf/2 .. prf/2."""
    return frequency_hz - prf_hz * torch.round(frequency_hz / prf_hz)


def unit_peak(x: Tensor) -> Tensor:
    """x over its detached peak modulus per trial, so that squares neither under- nor overflow.

    (..., pulse, range).
    """
    peak = x.detach().abs().amax((-2, -1), keepdim=True)
    return x / torch.where(peak > 0, peak, 1)


def _bounds(n: int, parts: int, what: str) -> list[tuple[int, int]]:
    if not 1 <= parts <= n:
        raise ValueError(f"{parts} blocks do not fit {n} {what}; choose 1..{n}")
    edges = [round(i * n / parts) for i in range(parts + 1)]
    return list(pairwise(edges))


def lag_products(x: Tensor, blocks: tuple[int, int] = (8, 8)) -> tuple[Tensor, Tensor]:
    """Sums of conj(line n) * line n+1 over blocks of (pulse, range), and the mean power of the same
    pairs.

    x: (..., pulse, range). Returns products (..., a, b) complex128 and power (..., a, b) float64
    with |product| <= power; every pair of adjacent lines belongs to exactly one block. Scale free:
    x is divided by its peak per trial. Differentiable.
    """
    x = unit_peak(x)
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    products, powers = [], []
    for first, last in _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines"):
        part = x[..., first : last + 1, :]
        square = part.real.square() + part.imag.square()
        present = (square.detach().amax(-1) > 0).to(square.dtype)
        both = (present[..., :-1] * present[..., 1:])[..., None]
        product = (part[..., :-1, :].conj() * part[..., 1:, :]).sum(-2)
        power = 0.5 * ((square[..., :-1, :] + square[..., 1:, :]) * both).sum(-2)
        products.append(_sums(product.to(torch.complex128), columns))
        powers.append(_sums(power.to(torch.float64), columns))
    return torch.stack(products, -2), torch.stack(powers, -2)


def _sums(x: Tensor, sizes: list[int]) -> Tensor:
    return torch.stack([part.sum(-1) for part in x.split(sizes, -1)], -1)


def block_spectra(x: Tensor, blocks: tuple[int, int] = (8, 8)) -> Tensor:
    """Azimuth power spectra of blocks of lines, summed over the range blocks: (..., a, b, n)
    float64 in FFT order.

    Blocks share one line with the next one and are zero-padded, so that their first Fourier
    coefficients are `lag_products`.
    """
    x = unit_peak(x)
    segments = _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines")
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    n = 2 * (max(last - first for first, last in segments) // 2 + 1)
    spectra = []
    for first, last in segments:
        part = fft_lines(x[..., first : last + 1, :], n=n)
        power = (part.real.square() + part.imag.square()).to(torch.float64)
        spectra.append(_sums(power, columns).mT)
    return torch.stack(spectra, -3)


def circular_centre(spectrum: Tensor) -> Tensor:
    """First Fourier coefficient of a power spectrum (..., n) in FFT order; its argument over 2 pi
    is the energy centre in sampling rates.
    """
    n = spectrum.shape[-1]
    turns = torch.arange(n, dtype=torch.float64, device=spectrum.device) / n
    weights = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    return (spectrum.to(torch.complex128) * weights).sum(-1) / n


def plain_energy_centre(spectrum: Tensor, prf_hz: float) -> Tensor:
    """Ordinary centre of mass of a spectrum (..., n) in FFT order, Hz.

    The baseline that is wrong wherever the spectrum wraps.
    """
    spectrum = spectrum.to(torch.float64)
    frequency = torch.fft.fftfreq(spectrum.shape[-1], 1 / prf_hz, dtype=torch.float64, device=spectrum.device)
    total = spectrum.sum(-1)
    return (spectrum * frequency).sum(-1) / torch.where(total > 0, total, 1)


def combine_blocks(products: Tensor, over: str = "mean") -> Tensor:
    """One phase increment (rad) from the products of all blocks, (..., a, b) -> (...,).

    "mean": argument of their sum, weighted by energy. "median": of the blocks' angles, measured
    from that mean so that they do not wrap; each block with energy counts once, so that one bright
    block cannot rule.
    """
    if over not in OVER:
        raise ValueError(f"blocks are combined by one of {OVER}, got {over!r}")
    flat = products.flatten(-2)
    mean = torch.angle(flat.sum(-1))
    if over == "mean":
        return mean
    deviation = torch.angle(flat * torch.polar(torch.ones_like(mean), -mean)[..., None])
    deviation = torch.where(flat.abs() > 0, deviation, torch.nan)
    return mean + settle(torch.nanquantile(deviation, 0.5, dim=-1), 0.0)[0]


def increment_std_rad(products: Tensor, phase_rad: Tensor) -> Tensor:
    """Predicted deviation of a combined increment from the scatter of the blocks about it, (..., a,
    b), (...,) -> (...,).

    Holds whatever makes blocks differ: noise, speckle and scene content. pi where there is no
    energy.
    """
    flat = products.flatten(-2) * torch.polar(torch.ones_like(phase_rad), -phase_rad)[..., None]
    count = (flat.abs() > 0).sum(-1)
    gain = torch.where(count > 1, count / (count - 1).clamp_min(1), 1)
    total = flat.real.sum(-1)
    return torch.where(
        total > 0, torch.sqrt(gain * flat.imag.square().sum(-1)) / torch.where(total > 0, total, 1), math.pi
    ).clamp_max(math.pi)


def baseband_estimate(products: Tensor, power: Tensor, phase_rad: Tensor, prf_hz: float, **info: Tensor) -> Estimate:
    """Estimate of `doppler_baseband_hz` from block products: quality is the lag-1 coherence, ok
    where the increment is known to a tenth of a turn.
    """
    scale = prf_hz / (2 * math.pi)
    std = increment_std_rad(products, phase_rad)
    total = power.sum((-2, -1))
    quality = (products.sum((-2, -1)).abs() / torch.where(total > 0, total, 1)).clamp(0, 1)
    return Estimate(
        {"doppler_baseband_hz": wrap_hz(scale * phase_rad, prf_hz)},
        quality,
        (total > 0) & (std < 0.2 * math.pi),
        {"doppler_baseband_hz": scale * std},
        {"block_hz": scale * torch.angle(products), "block_power": power, **info},
    )


def phase_increment(x: Tensor, prf_hz: float, blocks: tuple[int, int] = (8, 8), over: str = "mean") -> Estimate:
    """Doppler centroid from the mean phase increment between adjacent lines, f = prf * dphi / (2
    pi). x: (..., pulse, range).

    info: block_hz, block_power (..., a, b), the increments along the strip and over range.
    """
    products, power = lag_products(x, blocks)
    return baseband_estimate(products, power, combine_blocks(products, over), prf_hz)


def energy_centre(x: Tensor, prf_hz: float, blocks: tuple[int, int] = (8, 8)) -> Estimate:
    """Doppler centroid as the circular energy centre of the azimuth power spectrum averaged over
    range. x: (..., pulse, range).

    info: as phase_increment, and spectrum (..., n) in FFT order, plain_baseband_hz (the
    non-circular centre, a baseline that is wrong).
    """
    spectra = block_spectra(x, blocks)
    products, power = circular_centre(spectra), spectra.mean(-1)
    spectrum = spectra.sum((-3, -2))
    return baseband_estimate(
        products,
        power,
        torch.angle(circular_centre(spectrum)),
        prf_hz,
        spectrum=spectrum,
        plain_baseband_hz=plain_energy_centre(spectrum, prf_hz),
    )


def fit_over_range(products: Tensor, power: Tensor, order: int, rounds: int = 12) -> tuple[Tensor, Tensor]:
    """Robust polynomial of the phase increment over range blocks. products, power: (..., b).

    Returns coefficients (..., order + 1), residuals (..., b), rad.

    Legendre polynomials of the block centre u in -1..1. Blocks weigh with their coherence; those
    that lie off the curve by more than the common scatter lose weight (Cauchy), so a few very
    bright targets cannot bend it.
    """
    count = products.shape[-1]
    if not 0 <= order < count:
        raise ValueError(f"a polynomial of order {order} needs more than {order} range blocks, got {count}")
    mean = torch.angle(products.sum(-1))
    angle = torch.angle(products * torch.polar(torch.ones_like(mean), -mean)[..., None])
    basis = legendre(block_centres(count, products.device), order)
    coherence = products.abs() / torch.where(power > 0, power, 1)
    weight = coherence.square()
    coefficients, residual = _weighted_fit(basis, angle, weight)
    for _ in range(rounds):
        scale = 1.5 * residual.abs().median(-1, keepdim=True).values.clamp_min(1e-6)
        coefficients, residual = _weighted_fit(basis, angle, weight / (1 + (residual / (2 * scale)).square()))
    constant = torch.zeros_like(coefficients)
    constant[..., 0] = mean
    return coefficients + constant, residual


def _weighted_fit(basis: Tensor, y: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    weighted = basis * weight[..., None]
    normal = weighted.mT @ basis
    ridge = 1e-12 * (normal.diagonal(dim1=-2, dim2=-1).amax(-1) + 1e-30)
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    coefficients = torch.linalg.solve(normal + ridge[..., None, None] * eye, (weighted * y[..., None]).sum(-2))
    return coefficients, y - coefficients @ basis.mT


def block_centres(count: int, device: torch.device | None = None) -> Tensor:
    """Centres of `count` equal blocks of -1..1, float64."""
    return (2 * torch.arange(count, dtype=torch.float64, device=device) + 1) / count - 1


class PhaseIncrement(Stage):
    """`doppler_baseband_hz` from the mean (or median over blocks) phase increment between lines;
    leaves the signal alone.
    """

    provides = ("doppler_baseband_hz",)

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8), over: str = "mean") -> None:
        super().__init__()
        if over not in OVER:
            raise ValueError(f"blocks are combined by one of {OVER}, got {over!r}")
        self.prf_hz, self.blocks, self.over = radar.prf_hz, blocks, over

    def forward(self, signal: Signal) -> Estimate:
        return phase_increment(signal.data, self.prf_hz, self.blocks, self.over)


class EnergyCentre(Stage):
    """`doppler_baseband_hz` from the circular energy centre of the azimuth spectrum; leaves the
    signal alone.
    """

    provides = ("doppler_baseband_hz",)

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8)) -> None:
        super().__init__()
        self.prf_hz, self.blocks = radar.prf_hz, blocks

    def forward(self, signal: Signal) -> Estimate:
        return energy_centre(signal.data, self.prf_hz, self.blocks)


class RangeDependentCentroid(Stage):
    """Doppler centroid of every range sample, a robust polynomial over range blocks.

    Values: doppler_range_hz (..., range), and doppler_baseband_hz (...,) at the middle of the
    swath. Connected to an absolute `doppler_hz`, the curve is absolute too (the multiple of the PRF
    nearest to it at mid-swath); otherwise it is baseband. info: block_hz (..., b), coefficients_hz
    (..., order + 1) of Legendre polynomials.
    """

    provides = ("doppler_range_hz", "doppler_baseband_hz")

    def __init__(self, radar: StripmapRadar, order: int = 1, blocks: tuple[int, int] = (8, 16)) -> None:
        super().__init__()
        self.prf_hz, self.order, self.blocks = radar.prf_hz, order, blocks

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        products, power = (part.sum(-2) for part in lag_products(signal.data, self.blocks))
        coefficients, residual = fit_over_range(products, power, self.order)
        scale = self.prf_hz / (2 * math.pi)
        n = products.shape[-1]
        std = scale * residual.square().mean(-1).sqrt() / math.sqrt(max(1, n - self.order - 1))
        middle = (
            scale
            * (coefficients @ legendre(torch.zeros(1, dtype=torch.float64, device=products.device), self.order).mT)[
                ..., 0
            ]
        )
        curve = scale * coefficients @ legendre(block_centres(signal.data.shape[-1], products.device), self.order).mT
        if doppler_hz is not None:
            curve = curve + (self.prf_hz * torch.round((doppler_hz - middle) / self.prf_hz))[..., None]
        total = power.sum(-1)
        quality = (products.abs().sum(-1) / torch.where(total > 0, total, 1)).clamp(0, 1)
        return Estimate(
            {"doppler_range_hz": curve, "doppler_baseband_hz": wrap_hz(middle, self.prf_hz)},
            quality,
            (total > 0) & (std < 0.1 * self.prf_hz),
            {"doppler_baseband_hz": std},
            {"block_hz": scale * torch.angle(products), "coefficients_hz": scale * coefficients},
        )


def point_doppler(
    x: Tensor, prf_hz: float, rate_hz_s: Tensor | float = 0.0, centre_hz: Tensor | float = 0.0, rounds: int = 6
) -> Tensor:
    """Doppler of one point at the middle line of its aperture, from its azimuth history x (...,
    pulse): maximum likelihood.

    rate_hz_s: magnitude of its Doppler rate, (...,) or a number, taken out first (0 for a tone).
    The peak of the zero-padded spectrum is refined by Newton steps; reaches the Cramer-Rao bound of
    a tone, 0.39 / (T sqrt(q)), below the paper's curve 1 / (T sqrt(q)). The result lies within half
    a PRF of centre_hz. It is the Doppler of that point at that time, not the centroid of the beam.
    """
    n = x.shape[-1]
    t = (torch.arange(n, dtype=torch.float64, device=x.device) - (n - 1) / 2) / prf_hz
    rate = torch.as_tensor(rate_hz_s, dtype=torch.float64, device=x.device)[..., None]
    signal = x.to(torch.complex128) / x.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(x.real.dtype).tiny)
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
