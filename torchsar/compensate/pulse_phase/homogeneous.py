"""Decision between two descriptions of a scene by their likelihoods: sparse or homogeneous.

In a sparse scene few cells of the image hold the energy. In a homogeneous scene every range cell is
speckle, whose power over Doppler is the same in all range cells but for a factor. Methods that
sharpen the image end with wrong phases in a homogeneous scene; function `link_phases` does not.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, rotate
from torchsar.core import power_of

# least spectral density relative to its mean, which keeps the covariance R of the pulses invertible
# where noise is weak
SPECTRAL_FLOOR = 1e-4
# least number of independent range cells of a group: with fewer, a spectrum fits single scatterers
# as well as speckle
LEAST_LOOKS = 10.0


def occupied_band(spectrum: Tensor) -> Tensor:
    """Compute the share of the range band that the data occupy.

    It is the share of the rows (range cells) that are independent: 1 / 4 in noise that is sampled
    four times too finely, for example.

    Args:
        spectrum: Fourier transform of the pulses along range, shape (trial, range, pulse), complex.

    Returns:
        The share 0..1, shape (trial,), float64.
    """
    density = power_of(spectrum).mean(-1, dtype=torch.float64)
    return torch.where(density.sum(-1) > 0, density.mean(-1).square() / or_one(density.square().mean(-1)), 1)


def power_groups(power: Tensor) -> Tensor:
    """Assign range cells to four groups of similar power, because each has its own spectrum.

    Args:
        power: Power of the range cells, shape (trial, range).

    Returns:
        True for the range cells of each group, shape (group, trial, range), bool. The first group
        holds the cells down to a quarter of the greatest power, and the last one all weaker cells.
    """
    ratio = power.amax(-1, keepdim=True) / power.clamp_min(torch.finfo(power.dtype).tiny)
    member = (ratio.log() / math.log(4)).clamp(0, 3).long()
    return torch.stack([member == group for group in range(4)])


def describe(rows: Tensor, phase_rad: Tensor, independent: Tensor) -> tuple[Tensor, Tensor]:
    """Compare the likelihoods of the two descriptions of a scene for given phases.

    The homogeneous description is judged by the greater of two gains: that of the Doppler spectra
    for the given phases, and that of the coherence of neighbouring pulses, which no phase error
    changes. The coherence must exceed that of noise in any case.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase_rad: Phases to be removed in rad, shape (trial, pulse).
        independent: Share of the range cells that are independent, shape (trial,), see
            `occupied_band`.

    Returns:
        The gain of the log likelihood of the sparse description over white noise in nats. And the
        ratio of the gain of the homogeneous description to it, both without the part that is due to
        the powers of the range cells. The ratio is above 1 if the homogeneous description is
        likelier, and 0 where the coherence of the pulses does not exceed that of noise. Shape
        (trial,) each.
    """
    n = rows.shape[-1]
    if rows.shape[-2] > 256:  # only the 256 strongest range cells are compared
        strongest = power_of(rows).sum(-1).topk(256, -1).indices
        rows = rows.gather(1, strongest[..., None].expand(-1, -1, n))
    energy = power_of(rows)
    mean = energy.mean((-2, -1), dtype=torch.float64)
    power = energy.mean(-1, dtype=torch.float64) / or_one(mean)[:, None]
    groups = power_groups(power).to(torch.float64)
    cells = groups.sum(-1)
    of_group = (groups * power).sum(-1) / or_one(cells)
    by_power = -(n * cells * or_one(of_group).log()).sum(0)

    image = torch.fft.fft(rotate(rows, phase_rad), 2 * n)
    power = power_of(image) / or_one(n * mean).to(energy.dtype)[:, None, None]
    sparse = sparse_gain_nats(power[..., ::2])
    spectra = torch.einsum("gtr,trk->gtk", groups.to(power.dtype), power).to(torch.float64)
    by_spectra = -(cells * n * (_whittle(spectra / or_one(cells)[..., None], cells * independent))).sum(0)

    gain, deviation = _coherence(rows, groups, cells, independent)
    ratio = torch.maximum(by_spectra - by_power, gain) / or_one(sparse - by_power)
    return sparse, torch.where(gain > 4 * deviation, ratio, 0)


def sparse_gain_nats(power: Tensor) -> Tensor:
    """Compute the gain of the log likelihood if the strongest cells each have a power of their own.

    All other cells share one power. The number of strong cells, K of N, is the one of the greatest
    gain. Each costs 2 + ln(N / K) nats, for its power and its place. Cells are counted in bins of
    2 % of their power, instead of sorting them.

    Args:
        power: Powers of the image with a mean of 1, shape (trial, range, Doppler).

    Returns:
        The gain over N cells of one power in nats, shape (trial,), 0 or more, float64.
    """
    # least power relative to the mean, because sums are inexact below it, and relative width of a
    # bin
    floor, width = 1e-14, 0.02
    total, least = power[0].numel() if len(power) else 1, math.log(floor)
    bins = math.ceil((math.log(total) - least) / width) + 1
    level = ((power.flatten(1).clamp_min(floor).log() - least) / width).long().clamp(0, bins - 1)
    cells = torch.zeros(len(power), bins, device=power.device)
    cells = cells.scatter_add(-1, level, torch.ones_like(power.flatten(1)).to(cells)).to(torch.float64)
    nats = least + width * (torch.arange(bins, dtype=torch.float64, device=power.device) + 0.5)
    # count, own: number of the cells in a bin and above it, and the sum of their log powers. rest:
    # mean power of the cells below.
    count, own = (x.flip(-1).cumsum(-1).flip(-1) for x in (cells, cells * nats))
    rest = (cells * nats.exp()).cumsum(-1).roll(1, -1)[:, 1:] / (total - count[:, 1:]).clamp_min(1)
    count, own = count[:, 1:], own[:, 1:]
    cost = count * (2 + torch.log(total / or_one(count)))
    gain = total - own - cost - (total - count) * (1 + rest.clamp_min(floor).log())
    filled = (power > 0).flatten(1).any(-1)
    return torch.where(filled, gain.amax(-1).clamp_min(0), 0)


def _whittle(power: Tensor, looks: Tensor) -> Tensor:
    """Mean negative log likelihood per sample minus that of white noise, (group, trial), in
    Whittle's approximation.
    """
    mean = power.mean(-1, keepdim=True)
    power = torch.where(mean > 0, torch.maximum(power, SPECTRAL_FLOOR * mean), 1)
    smooth = smoothed_spectrum(power, looks.clamp_min(1))
    return (smooth.log() + power / smooth).mean(-1) - 1


def _coherence(rows: Tensor, groups: Tensor, cells: Tensor, independent: Tensor) -> tuple[Tensor, Tensor]:
    """Gain of the log likelihood by the coherence of neighbouring pulses, and its standard
    deviation in noise, (trial,) each.

    Groups of fewer than ten independent range cells are left out, also where the cells are many but
    hold the side lobes of few points. To second order, the gain of a sample is the sum over the
    lags of the squared coherence.
    """
    n, energy = rows.shape[-1], power_of(rows)
    kinds = groups.to(energy.dtype)
    pulse = torch.einsum("gtr,trp->gtp", kinds, energy)
    row = kinds * energy.sum(-1)
    looks = row.sum(-1).square() / or_one(row.square().sum(-1)) * independent
    excess = torch.zeros_like(cells)
    lags = min(4, n - 1)  # largest number of pulses between two pulses whose coherence is used
    for lag in range(1, lags + 1):
        product = torch.einsum("gtr,trp->gtp", kinds.to(rows.dtype), rows[..., lag:] * rows[..., :-lag].conj())
        square = power_of(product).sum(-1)
        excess = excess + square / or_one((pulse[..., lag:] * pulse[..., :-lag]).sum(-1)) - 1 / looks.clamp_min(1)
    many = torch.stack([different_rows(rows, energy.sum(-1) * kind) for kind in kinds]) >= LEAST_LOOKS
    weight = torch.where((looks >= LEAST_LOOKS) & many, n * cells, 0)
    deviation = weight * math.sqrt(lags / n) / looks.clamp_min(1)
    return (weight * excess).sum(0).to(torch.float64), deviation.square().sum(0).sqrt().to(torch.float64)


def different_rows(rows: Tensor, energy: Tensor) -> Tensor:
    """Compute the effective number of different rows among the 64 strongest.

    It is (tr G)^2 / (tr G^2 - (tr G)^2 / P) for the products G of the rows over P pulses: the
    number of rows in white noise, and that of the points whose side lobes the rows are.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        energy: Energy of the rows, 0 for those that do not count, shape (trial, range).

    Returns:
        The number, shape (trial,), float64.
    """
    power, strongest = energy.topk(min(64, energy.shape[-1]), -1)
    some = rows.gather(1, strongest[..., None].expand(-1, -1, rows.shape[-1])) * (power > 0)[..., None]
    products = some @ some.mH
    total = products.diagonal(dim1=-2, dim2=-1).real.sum(-1).double().square()
    return total / or_one(power_of(products).sum((-2, -1)).double() - total / rows.shape[-1])


def smoothed_spectrum(power: Tensor, looks: Tensor) -> Tensor:
    """Smooth a mean periodogram by a Haar wavelet transform of its logarithm.

    The transform is shift-invariant (without decimation). Details, the differences of neighbouring
    means, are set to zero where they are within 3.3 standard deviations of what the scatter of
    independent exponential powers gives. Constant parts become smooth, and the edges of a band stay
    sharp.

    Args:
        power: Mean power over `looks` periodograms of n samples padded with zeros to 2 n, shape
            (..., 2 n), positive; the first and the last bin are neighbours.
        looks: Number of periodograms, 1 or more, shape (...,).

    Returns:
        The smoothed power, same shape.

    Reference:
        Coifman and Donoho, Translation-invariant de-noising, 1995.
    """
    mean, scatter, details = torch.log(power), looks.rsqrt()[..., None], []
    for level in range(int(math.log2(power.shape[-1])) - 1):
        shifted = mean.roll(2**level, -1)
        detail = (mean - shifted) / 2
        # neighbouring bins of the padded transform are correlated: two count as one
        std = scatter / math.sqrt(2 * max(1.0, 2 ** (level - 1)))
        # one of some thousand details exceeds 3.3 standard deviations by chance
        details.append(torch.where(detail.abs() > 3.3 * std, detail, 0))
        mean = (mean + shifted) / 2
    for level, detail in reversed(list(enumerate(details))):
        mean = (mean + detail + (mean - detail).roll(-(2**level), -1)) / 2
    return torch.exp(mean)
