"""Assessment of a Doppler centroid: its standard deviation, quality and outcome.

Five questions are asked of the lines. Does a constant or a tone hold the energy? Are adjacent lines
coherent, so that there is anything but noise? Are the dwells of the targets complete, or do the
ends of the record cut so many that the centroid is that of the cut ones? How far do the range
blocks scatter? Does a block of range cells ask for a centroid that no target of the beam shows? Of
an absolute centroid it is also asked whether another multiple of the PRF explains the data as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.core import Estimate, Outcome, cis, power_of, unit_level, worst
from torchsar.core.tone import strongest_tone
from torchsar.metrics.bounds import tone_frequency_bound_hz

# Largest standard deviation of a good estimate in units of the PRF. That predicted for noise is
# about ten times as large, because the sum of the products of noise is no larger than their
# scatter.
MOST_STD = 0.015
# least probability of the ambiguity of the PRF with which it counts as known, by choice
LEAST_PROBABILITY = 0.9


class Increments(NamedTuple):
    """Quantities that determine the error of the phase increment between adjacent lines.

    Args:
        products: Sums of the products of adjacent lines over blocks, shape (..., a, b), complex128.
        power: Mean power of the same pairs of lines, shape (..., a, b).
        half_band_rad: Half of the band that a target sweeps in the beam, as a phase increment in
            rad, shape (...,).
        ends: What the mean product of a pair of lines at the first and at the last held line (one
            that is not zero) adds to the sum of the phase increments, shape (..., 2, b),
            complex128, see below.
        tone: What the strongest tone adds to the sum of all products, shape (...,), complex128; 0
            where no tone stands out.
        coherent: True where the products of adjacent lines, or the changes of these products, add
            up to more than in noise, shape (...,).
        noise: Coherence of adjacent lines of noise that all range cells share.
        scale: Frequency of a phase increment of 1 rad, in Hz.

    A target whose aperture is cut by an end of the record shows only a part of its band. Consider
    targets of even density on both sides of the end, which cross a beam of constant gain in N
    lines. Their phase increments differ by up to b rad from the centroid. The products of adjacent
    lines are turned by the centroid and summed over the record. Their imaginary part is then (1 - b
    cot b) N / (2 b) times the real part of one pair of lines at the last line, and minus this at
    the first line.
    """

    products: Tensor
    power: Tensor
    half_band_rad: Tensor
    ends: Tensor
    tone: Tensor
    coherent: Tensor
    noise: float
    scale: float

    @staticmethod
    def of(
        x: Tensor, products: Tensor, power: Tensor, prf_hz: float, rate_hz_s: float | None, dwell_s: float | None
    ) -> Increments:
        """Measure the band of the targets and the coherence of lines.

        Args:
            x: Lines, shape (..., pulse, range), complex.
            products: Their products, see `torchsar.compensate.doppler.lag_products`.
            power: Their mean powers.
            prf_hz: Pulse repetition frequency in Hz.
            rate_hz_s: Magnitude of the Doppler rate of the targets in Hz/s. If it is None, targets
                are assumed to be seen for half of the record.
            dwell_s: Time that a target stays in the beam, in seconds. If it or the rate is None,
                the band is measured from the products of lines two apart: cos b over their ratio.
        """
        x = unit_level(x)
        x = x / or_one(x.abs().amax((-2, -1), keepdim=True))  # scaled as in `lag_products`
        step = torch.linalg.vecdot(x[..., :-1, :], x[..., 1:, :]).to(torch.complex128)
        coherent = _adds_up(step) | _adds_up(step[..., :-1].conj() * step[..., 1:])
        pairs = x.shape[-2] - 1
        if rate_hz_s is None or dwell_s is None:
            total = step.sum(-1)
            two_apart = torch.linalg.vecdot(x[..., :-2, :].flatten(-2), x[..., 2:, :].flatten(-2))
            ratio = (two_apart.to(total.dtype) * total.conj().square()).real / or_one(total.abs() ** 3)
            half_band = torch.acos(ratio.clamp(-1, 1))
        else:
            half_band = torch.full_like(step[..., 0].real, math.pi * rate_hz_s * dwell_s / prf_hz)
        half_band = half_band.clamp(1e-3, 0.95 * math.pi)
        dwell = pairs / 2 if rate_hz_s is None else half_band * prf_hz**2 / (math.pi * rate_hz_s)
        last = max(1, pairs // (2 * products.shape[-2]))  # half of the lines of a block
        held = (x != 0).any(-1).int()
        first, end = held.argmax(-1).clamp_max(pairs - last), held.flip(-1).argmax(-1).clamp_max(pairs - last)
        number = torch.arange(last + 1, device=x.device)[:, None]
        starts = (-1, first), (1, pairs - last - end)
        parts = [(sign, x.take_along_dim(at[..., None, None] + number, -2)) for sign, at in starts]
        mean = [sign * (part[..., :-1, :].conj() * part[..., 1:, :]).sum(-2) / last for sign, part in parts]
        ends = torch.stack(mean, -2).to(torch.complex128).tensor_split(products.shape[-1], -1)
        # number of lines that the ends affect; about half_band * dwell / 6 for a narrow band
        lines = (1 - half_band / torch.tan(half_band)) * dwell / (2 * half_band)
        ends = torch.stack([some.sum(-1) for some in ends], -1) * lines[..., None, None]
        # a spur, or a constant, of which the scene knows nothing
        spur = strongest_tone(x, rounds=1)
        energy = torch.where(spur.excess > 20, spur.share.double(), 0) * power.sum((-2, -1))
        tone = torch.polar(energy, 2 * math.pi * spur.pulse_cycles)
        noise = max(1, pairs) ** -0.5
        return Increments(products, power, half_band, ends, tone, coherent, noise, prf_hz / (2 * math.pi))


def several_motions(lines: Increments, phase_rad: Tensor) -> Tensor:
    """Find where a block of range cells asks for another centroid, because targets move on their
    own.

    Of the targets that share the motion, one whose aperture is cut shows up to half of the band
    beside the centroid.

    Args:
        lines: Products of adjacent lines.
        phase_rad: Phase increment of the centroid, shape (...,).

    Returns:
        True where a block does, shape (...,).
    """
    blocks = (lines.products * cis(-phase_rad)[..., None, None]).sum(-2)
    # noise exceeds this coherence once in ten million blocks, also if range cells share it
    seen = blocks.abs() > 4 * lines.noise * lines.power.sum(-2)
    return (seen & (blocks.angle().abs() > lines.half_band_rad[..., None])).any(-1)


def _adds_up(products: Tensor) -> Tensor:
    """True where products (..., n) add up to more than products of random phases.

    In noise, the power of their sum over the sum of their powers is exponentially distributed with
    mean 1. More than 9 then occurs once in 8000 records.
    """
    return products.sum(-1).abs().square() > 9.0 * products.abs().square().sum(-1)


def baseband(found: Estimate, lines: Increments) -> Estimate:
    """Assess a centroid that follows from the sum of the products of all blocks.

    Args:
        found: The estimate of `doppler_baseband_hz`.
        lines: Products of adjacent lines.

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    phase = found["doppler_baseband_hz"] / lines.scale
    total = (lines.products.sum((-2, -1)) * cis(-phase)).real
    some = total > 0
    total = torch.where(some, total, 1)[..., None]
    shift = ((lines.ends * cis(-phase)[..., None, None]).real.sum((-2, -1)) / total[..., 0]).clamp(-1, 1)
    turn = cis(shift - phase)
    cuts = (lines.ends * turn[..., None, None]).real / total[..., None]
    blocks = lines.products.sum(-2) * turn[..., None] / total
    terms = blocks.imag - cuts.sum(-2)
    if terms.shape[-1] >= 4:
        # range walk, and the change of Doppler along a pulse, add to one block what they take from
        # the next
        power = blocks.real.clamp_min(0)
        along = torch.nn.functional.pad((power[..., 1:] * power[..., :-1]).sqrt(), (1, 1)).diff(dim=-1)
        slope = (terms * along).sum(-1, keepdim=True) / or_one(along.square().sum(-1, keepdim=True))
        terms = (terms - slope * along) * math.sqrt(terms.shape[-1] / (terms.shape[-1] - 2))
    # If most of the energy is in few blocks, few targets are cut by the ends of the record, and
    # they are not distributed evenly. For a beam of constant gain, the first moment of a cut target
    # has a standard deviation of sqrt(1/5).
    share = blocks.real.clamp(0, 1).square().sum(-1)
    scatter = (terms.square() + (0.45 * share[..., None] * cuts.sum(-2)).square()).sum(-1).sqrt().clamp_max(math.pi)
    scatter, shift = torch.where(some, scatter, math.pi), cuts.sum((-2, -1)).clamp(-1, 1)
    # the centroid without the tone, for which it must be a small part of the energy
    without = lines.products.sum((-2, -1)) - lines.tone
    away = torch.angle(without * cis(-phase)).abs()
    power = lines.power.sum((-2, -1))
    along = (lines.products.sum(-1) * cis(-phase)[..., None]).real.clamp_min(0)
    extent = along.sum(-1).square() / or_one(along.square().sum(-1)) / along.shape[-1]
    # Targets illuminated in an effective share below 0.3 of the record are cut by an end of the
    # record. Otherwise their dwell is nearly as short as the time in which their Doppler drifts.
    short = (extent < 0.3) & (along.shape[-1] >= 4)
    return replace(
        found,
        std={"doppler_baseband_hz": lines.scale * torch.hypot(torch.hypot(scatter, shift), away)},
        quality=(lines.products.sum((-2, -1)).abs() / or_one(power)).clamp(0, 1),
        outcome=worst(
            (Outcome.INEXACT, scatter >= 2 * math.pi * MOST_STD),
            (Outcome.PARTS_DISAGREE, several_motions(lines, phase)),
            (Outcome.MISFIT, short | (shift.abs() >= lines.half_band_rad / 4)),
            (Outcome.AT_REST, (away > math.pi * MOST_STD) | (lines.tone.abs() > 0.2 * power)),
            (Outcome.NOISE, ~lines.coherent),
            (Outcome.EMPTY, power == 0),
        ),
        info={**found.info, "cut_hz": lines.scale * shift},
    )


def absolute(
    found: Estimate, lines: Increments, base_hz: Tensor, refined_std_hz: Tensor, log_likelihood: Tensor
) -> Estimate:
    """Assess an absolute centroid; see `DopplerCentroid`.

    Args:
        found: The estimate of `doppler_hz` and `doppler_baseband_hz`.
        lines: Products of adjacent lines.
        base_hz: Baseband centroid that follows from these products, shape (...,).
        refined_std_hz: Standard deviation in Hz by the targets whose whole dwell lies in the
            record, shape (...,); infinite where there are none.
        log_likelihood: Of the candidates for the ambiguity, shape (..., candidate).

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    plain, unit = baseband(replace(found, value={"doppler_baseband_hz": base_hz}), lines), 2 * math.pi * lines.scale
    turned, shift = cis((found["doppler_hz"] - base_hz) / lines.scale), plain.info["cut_hz"].abs()
    moved = lines.scale * torch.atan2(turned.imag, turned.real)
    std = torch.minimum(refined_std_hz, torch.hypot(plain.std["doppler_baseband_hz"], moved))
    probability = torch.softmax(log_likelihood, -1).amax(-1)
    scatter = (plain.std["doppler_baseband_hz"].square() - shift.square()).clamp_min(0).sqrt()
    inexact = torch.minimum(refined_std_hz, scatter) >= unit * MOST_STD
    outcome = worst(
        (Outcome.INEXACT, ~lines.coherent | inexact),
        (Outcome.PARTS_DISAGREE, several_motions(lines, found["doppler_hz"] / lines.scale)),
        (Outcome.MISFIT, shift >= lines.scale * lines.half_band_rad / 4),
        (Outcome.AMBIGUOUS, probability <= LEAST_PROBABILITY),
        # lines are incoherent, and the deviation is at least a third of that of random frequencies,
        # by choice
        (Outcome.NOISE, ~lines.coherent & (std >= 0.1 * unit)),
        (Outcome.AT_REST, plain.outcome == Outcome.AT_REST),
        (Outcome.EMPTY, plain.outcome == Outcome.EMPTY),
    )
    best = log_likelihood.topk(min(2, log_likelihood.shape[-1])).values
    return replace(
        found,
        std={"doppler_hz": std, "doppler_baseband_hz": std},
        quality=probability,
        outcome=outcome,
        info={**plain.info, "margin": best[..., 0] - best[..., -1], "coherence": plain.quality},
    )


def of_point(
    found: Estimate,
    image: Tensor,
    at: tuple[Tensor, Tensor],
    cell: tuple[Tensor, float],
    history: tuple[Tensor, Tensor],
    visible_s: float,
    sees: Tensor,
) -> Estimate:
    """Assess the Doppler of the brightest point of an image; see `PointDoppler`.

    Args:
        found: The estimate.
        image: The image, shape (..., azimuth, range).
        at: Line and sample of the brightest pixel, shape (...,) each.
        cell: Size of a resolution cell in lines, shape (...,), and in samples.
        history: Azimuth history of the point, and the phasor of its Doppler, see `point_history`.
        visible_s: Time for which the point is observed, in seconds.
        sees: True where the record holds the time at which the beam centre crosses the point.

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    power, (tone, phasor), (line, sample) = power_of(image), history, at
    ordered, n = power.flatten(-2), power.shape[-2]
    # The power of noise has an exponential distribution, with the mean median / ln 2. In 99 of 100
    # samples it exceeds the median by no more than mean * ln 50. In noise with a longer tail, such
    # as that of real samples, it exceeds that.
    median, count = ordered.median(-1).values.double(), ordered.shape[-1]
    floor, highest = median / math.log(2), math.log(count) + 10
    tail = (ordered.kthvalue(count - count // 100, -1).values.double() - median) / math.log(50)
    # Four resolution cells to each side belong to the response of a point. Among equal points or in
    # speckle, it is not known which point the beam centre crosses at the given time. Therefore no
    # other one may have more than a quarter of the power, beyond the peaks of noise.
    off = (torch.arange(n, device=power.device) - line[..., None]).abs()
    rows = torch.minimum(off, n - off) <= 4 * cell[0][..., None]  # the image is circular in azimuth
    columns = (torch.arange(power.shape[-1], device=power.device) - sample[..., None]).abs() <= 4 * cell[1]
    rival = power.masked_fill(rows[..., :, None] & columns[..., None, :], 0).amax((-2, -1)).double()
    # The peak is the largest of many samples, whose noise has the bandwidth of the whole PRF. The
    # sum over the history has only the noise of its own band. It has a mean power of 1 if there is
    # only noise.
    peak, total = ordered.amax(-1).double(), (tone * phasor.conj()).sum(-1).abs().square()
    q = (total / ((tone != 0).sum(-1).clamp_min(1) * or_one(floor)) - 1).clamp_min(0)
    # without noise, the error of the interpolation of the response is 2.5e-4 cycles per dwell
    std = torch.hypot(tone_frequency_bound_hz(q.clamp_min(1e-12), visible_s), q.new_tensor(2.5e-4 / visible_s))
    outcome = worst(
        (Outcome.AMBIGUOUS, peak <= 4.0 * (rival - highest * floor)),
        (Outcome.MISFIT, ~sees),
        (Outcome.NOISE, peak <= highest * torch.maximum(floor, tail)),
        (Outcome.EMPTY, floor == 0),
    )
    return replace(found, std=dict.fromkeys(found.value, std), quality=1 - 1 / (1 + q), outcome=outcome, info={"q": q})
