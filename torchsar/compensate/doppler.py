"""Doppler centroid within one PRF: mean phase increment and energy centre of the azimuth spectrum.

Neither estimator needs the velocity (Tsvetkov 2017, Doppler estimation). Both take the phase of the
first Fourier coefficient of the azimuth power spectrum. The mean phase increment computes this
coefficient in time, from products of adjacent lines; the energy centre computes it in frequency.
The results agree to rounding where no line is missing, and are therefore not independent evidence.

Doppler is positive when closing. Lines that are all zero (missing) enter no product. Where many
lines in a row are missing, the mean phase increment gives their place to the pairs beside them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from torchsar.compensate import doppler_assess
from torchsar.compensate.pulse_phase.data import or_one
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    cis,
    differentiable,
    fft_lines,
    power_of,
    unit_level,
    wrapped,
)
from torchsar.radar import StripmapRadar


def _bounds(n: int, parts: int, what: str) -> list[tuple[int, int]]:
    """First and last index of each of `parts` nearly equal parts of 0..n."""
    if not 1 <= parts <= n:
        raise ValueError(f"blocks must be 1..{n} where there are {n} {what}, got {parts}")
    edges = [round(i * n / parts) for i in range(parts + 1)]
    return list(pairwise(edges))


def _pair_weights(held: Tensor) -> Tensor:
    """Weights of pairs of lines, 0 where one of the lines is missing.

    A gap cuts the dwells of targets, and the lines that are left of them have another mean Doppler.
    The pairs before and after a gap, as many as it has on each side, therefore count for those in
    it by a half each. The middle of these is that of the gap.

    Args:
        held: Whether both lines of a pair are there, shape (..., pair), bool.

    Returns:
        The weights, of the same shape, from 0 to 2.
    """

    def beside(held: Tensor) -> Tensor:
        """Pairs that follow a gap by no more than its length."""
        index = torch.arange(held.shape[-1], device=held.device)
        last = torch.where(held, -1, index).cummax(-1).values  # of the gap before a pair
        before = torch.where(held, index, -1).cummax(-1).values.gather(-1, last.clamp_min(0))
        # a gap at the end of the record has no pairs on its other side
        return held & (last >= 0) & (before >= 0) & (index - last <= last - before)

    return held.double() + 0.5 * beside(held) + 0.5 * beside(held.flip(-1)).flip(-1)


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
        mean power of the two lines of each pair, shape (..., a, b), float64. Pairs beside a gap
        count for those that the gap has taken. The modulus of a
        product never exceeds its power; their ratio is the coherence.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if there are fewer pairs of lines or range cells
            than blocks.
    """
    x = unit_level(checked_samples(x, "lag_products", "pulse, range", finite=False))
    columns = [last - first for first, last in _bounds(x.shape[-1], blocks[1], "range samples")]
    products, powers, peaks = [], [], []
    held = (x.detach() != 0).any(-1)
    weights = _pair_weights(held[..., :-1] & held[..., 1:]).to(x.real.dtype)[..., None]
    for first, last in _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines"):
        part, weight = x[..., first : last + 1, :], weights[..., first:last, :]
        square = power_of(part)
        peaks.append(square.detach().amax((-2, -1)))
        product = (part[..., :-1, :].conj() * part[..., 1:, :] * weight).sum(-2)
        power = 0.5 * ((square[..., :-1, :] + square[..., 1:, :]) * weight).sum(-2)
        for sums, each in ((products, product.to(torch.complex128)), (powers, power.to(torch.float64))):
            sums.append(torch.stack([some.sum(-1) for some in each.split(columns, -1)], -1))
    # the products of zeros are zero whatever they are divided by
    peak = torch.stack(peaks).amax(0).to(torch.float64)[..., None, None].clamp_min(1e-300)
    return torch.stack(products, -2) / peak, torch.stack(powers, -2) / peak


def agreeing_cells(x: Tensor) -> Tensor:
    """Weight range cells so that none decides a centroid alone.

    Cells whose phase increment between adjacent lines departs from the median of all cells by more
    than three robust standard deviations are set to zero, such as those of a target that moves on
    its own. The power of the others is limited to the median.

    Args:
        x: Lines, shape (..., pulse, range), complex.

    Returns:
        The lines with weighted range cells, in the same shape.
    """
    x = unit_level(x)
    products = torch.linalg.vecdot(x[..., :-1, :], x[..., 1:, :], dim=-2)
    middle = torch.angle((products / or_one(products.abs())).sum(-1, keepdim=True))
    away = torch.angle(products * cis(-middle))
    away = (away - away.median(-1, keepdim=True).values).abs()
    power = power_of(x).sum(-2)
    limit = (power.median(-1, keepdim=True).values / or_one(power)).clamp_max(1).sqrt()
    return x * (limit * (away <= 3 * 1.4826 * away.median(-1, keepdim=True).values))[..., None, :]


def phase_increment(
    x: Tensor,
    prf_hz: float,
    blocks: tuple[int, int] = (8, 8),
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
        outcome is EMPTY or NOISE (adjacent lines are not coherent) where nothing was found, AT_REST
        where a constant or a tone holds the energy, MISFIT where targets are cut too strongly,
        PARTS_DISAGREE where range cells ask for another centroid, and INEXACT from a standard
        deviation of 1.5 % of the PRF on. A target that moves on its own among few others is not
        named if it changes the centroid by less than half of the band of the beam, or if its side
        lobes hide them (rates on the page of outcomes).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks.

    Reference:
        Tsvetkov 2017, text before Fig. 5.
    """
    x = checked_samples(x, "phase_increment", "pulse, range")
    products, power = lag_products(x, blocks)
    scale = prf_hz / (2 * math.pi)
    info = {"block_hz": scale * torch.angle(products), "block_power": power}
    value = wrapped(scale * torch.angle(products.sum((-2, -1))), prf_hz)
    found = Estimate({"doppler_baseband_hz": value}, info=info)
    if not assess:
        return found
    return doppler_assess.baseband(found, doppler_assess.Increments.of(x, products, power, prf_hz, rate_hz_s, dwell_s))


@differentiable("where ok")
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
    rounding if the blocks hold an even number of pairs of lines.

    Each of the segments of the lines, of which the spectra are averaged, shares one line with the
    next and is padded with zeros to an even number of lines. If its number of pairs is even, the
    first Fourier coefficient of its spectrum is the sum of the products of its adjacent lines;
    otherwise it may also contain the product of its last and first line.

    Args:
        x: Lines, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        blocks: Number of segments along pulses and, for the assessment, of blocks along range.
        rate_hz_s: As for `phase_increment`.
        dwell_s: As for `phase_increment`.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `doppler_baseband_hz` in Hz, shape (...,), positive when closing. `info` holds "spectrum",
        the azimuth power spectrum in FFT order, shape (..., n) for n Doppler bins. The
        assessment, with its outcomes, is that of `phase_increment`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer pairs
            of lines or range cells than blocks.

    Reference:
        Tsvetkov 2017, energy centre of the azimuth spectrum.
    """
    x = checked_samples(x, "energy_centre", "pulse, range")
    lines, bounds = unit_level(x), _bounds(x.shape[-2] - 1, blocks[0], "pairs of lines")
    n = 2 * (max(last - first for first, last in bounds) // 2 + 1)
    spectra = [power_of(fft_lines(lines[..., first : last + 1, :], n=n)) for first, last in bounds]
    spectrum = torch.stack([power.to(torch.float64).sum(-1) for power in spectra]).sum(0)
    # phase of the first Fourier coefficient of the azimuth spectrum
    turn = 2 * math.pi / n * torch.arange(n, dtype=torch.float64, device=x.device)
    phase = torch.atan2((spectrum * torch.sin(turn)).sum(-1), (spectrum * torch.cos(turn)).sum(-1))
    value = {"doppler_baseband_hz": wrapped(prf_hz / (2 * math.pi) * phase, prf_hz)}
    found = Estimate(value, info={"spectrum": spectrum})
    if not assess:
        return found
    lines = doppler_assess.Increments.of(x, *lag_products(x, blocks), prf_hz, rate_hz_s, dwell_s)
    return doppler_assess.baseband(found, lines)


def nominal_doppler(radar: StripmapRadar) -> dict[str, float]:
    """Return the Doppler centroid that is assumed where it cannot be estimated.

    Args:
        radar: Radar parameters.

    Returns:
        `doppler_hz`, which is `pointing_doppler_hz` of the radar, or 0 if that is None; and
        `doppler_baseband_hz`, the same wrapped into the interval -PRF/2 .. PRF/2.
    """
    nominal = radar.pointing_doppler_hz or 0.0
    baseband = wrapped(torch.tensor(nominal, dtype=torch.float64), radar.prf_hz)
    return {"doppler_hz": nominal, "doppler_baseband_hz": float(baseband)}


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


class _Baseband(Stage):
    """Base class of the stages that estimate the baseband Doppler centroid of lines."""

    provides = ("doppler_baseband_hz",)
    # function of lines, PRF, blocks, rate, dwell
    find: Callable[..., Estimate]
    differentiable = "where ok"

    def __init__(self, radar: StripmapRadar, blocks: tuple[int, int] = (8, 8), assess: bool = True) -> None:
        super().__init__()
        self.radar, self.blocks, self.assess = radar, blocks, assess
        self.neutral = {name: nominal_doppler(radar)["doppler_baseband_hz"] for name in self.provides}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the baseband Doppler centroid of a signal of axes (pulse, range).

        Returns:
            `Estimate` with `doppler_baseband_hz` in Hz, shape (...,).
        """
        swept = swept_band(self.radar, signal.data.shape[-1])
        return type(self).find(signal.data, self.radar.prf_hz, self.blocks, *swept, assess=self.assess)


class PhaseIncrement(_Baseband):
    """Baseband Doppler centroid from the phase increment between lines.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `phase_increment`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    find = staticmethod(phase_increment)


class EnergyCentre(_Baseband):
    """Baseband Doppler centroid as the circular energy centre of the spectrum.

    Provides `doppler_baseband_hz` and leaves the signal unchanged. See `energy_centre`.

    Args:
        radar: Radar parameters. The value depends on the PRF only.
        blocks: Number of blocks along pulses and along range.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    find = staticmethod(energy_centre)


@differentiable("where ok")
def point_doppler(
    x: Tensor, prf_hz: float, rate_hz_s: Tensor | float = 0.0, centre_hz: Tensor | float = 0.0, rounds: int = 6
) -> Tensor:
    """Estimate the Doppler of one point at the middle line of its history by maximum likelihood.

    >>> import torch
    >>> from torchsar.compensate import point_doppler
    >>> history = torch.exp(0.2j * torch.pi * torch.arange(64))  # a tenth of a cycle per pulse
    >>> point_doppler(history, prf_hz=1000.0).round(decimals=2)
    tensor(100., dtype=torch.float64)

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
    return centre + wrapped(frequency - centre, prf_hz)
