"""Check whether the range profiles of pulses are aligned, which every estimate of their phases
requires.

A pulse that is displaced in range puts the echo of a scatterer into other range cells, where the
phases of other scatterers are. The image can then be sharpened, and two halves of the range cells
agree, although the phases are wrong. Displacements of 0.3 cell rms from pulse to pulse suffice in a
scene of six scatterers at 15 dB.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.core import fft_lines, power_of

# Rms displacements in cells from which profiles count as not aligned: from pulse to pulse (jitter),
# and slow ones (migration). Found by trial on 2 to 300 scatterers: the phases may be wrong from 0.2
# and 0.45 on. Interference of unresolved scatterers displaces aligned profiles by 0.25 at most.
LARGEST_JITTER, LARGEST_MIGRATION = 0.25, 0.4
# least number of range cells, and of pulses, from which displacements are estimated
_LEAST = 8


@torch.no_grad()
def displacement(spectrum: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Estimate the rms displacement in range of the profiles of pulses from their mean.

    The displacement of a pulse is the projection of its profile |s| on the derivative of the mean
    profile. It is estimated from each half of the band separately, because their noise and the
    speckle of unresolved scatterers are independent: only what both halves have in common is a
    displacement. Both halves of the range cells must show it as well, because scatterers in one
    range cell change its power in both halves of the band. The jitter is that of pulses within 16
    groups, the migration that of the mean power of the groups, in which noise is weaker.
    Displacements of more than a cell are underestimated, but remain above one cell. Displacements
    that weak echoes hide, such as a drift by tens of cells of a dense scene at 0 dB, are not found;
    the standard deviation of the phases is large there.

    Args:
        spectrum: Fourier transform of the pulses along range, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).

    Returns:
        The displacement from pulse to pulse (jitter), and that of the mean of neighbouring pulses
        (migration), rms in range cells, shape (trial,) each. They are 0 where they do not differ
        from zero by 3 standard deviations, and where there are fewer than 8 range cells or 8
        pulses.
    """
    cells, n = spectrum.shape[-2:]
    if cells < _LEAST or n < _LEAST:
        none = torch.zeros(len(spectrum), dtype=torch.float64, device=spectrum.device)
        return none, none
    one, other = _halves(spectrum)
    whole = one + other
    length = -(-n // 16)

    def grouped(x: Tensor, dim: int = -1) -> Tensor:
        more = [0] * (-2 * dim - 1) + [-n % length]
        return torch.nn.functional.pad(x, more).unflatten(dim, (-1, length))

    count = grouped(present).sum(-1)
    fast, near = _four_displacements(one, other, whole, present)
    groups = [grouped(power, -2).sum(-2) for power in (one, other, whole)]
    slow, _ = _four_displacements(groups[0], groups[1], groups[2], count > 0, near)

    def within(single: Tensor) -> Tensor:
        parts = grouped(single)
        return torch.where(grouped(present), parts - _mean(parts, grouped(present))[..., None], 0).flatten(-2)

    free = present.sum(-1) - (count > 0).sum(-1), (count > 0).sum(-1)
    return _shared([within(x) for x in fast], free[0]), _shared(slow, free[1])


def _four_displacements(
    one: Tensor, other: Tensor, whole: Tensor, present: Tensor, near: Tensor | None = None
) -> tuple[list[Tensor], Tensor]:
    """Displacements of the pulses by four parts of the data, (trial, pulse) each, float64.

    The parts are both halves of the band, and the nearer and the farther range cells of the whole
    band. Also returns True for the nearer cells, (trial, cell).

    The nearer cells have half of the sum of the squared slopes of the mean profile, and therefore
    half of the information about displacements.

    one, other, whole: powers by both halves and by the whole band, (trial, pulse, cell).
    """
    profiles = [_profiles(power) for power in (one, other, whole)]
    if near is None:
        weight = profiles[2][2].square()
        near = 2 * (weight.cumsum(-1) - weight / 2) < weight.sum(-1, keepdim=True)
    parts = [torch.ones_like(near)[:, None]] * 2 + [torch.stack([near, ~near], -2)]
    found = [_displacements(*profile, cells, present) for profile, cells in zip(profiles, parts, strict=True)]
    return [x for of_profile in found for x in of_profile], near


def _shared(parts: list[Tensor], count: Tensor) -> Tensor:
    """Rms displacement in cells that both halves of the band have in common, (trial,). It is zero
    unless the two halves of the range cells agree. parts: displacements from `_four_displacements`.
    """
    return torch.where(_agreement(parts[2:], count) > 3, _common(parts[:2], count), 0)


@torch.no_grad()
def coherent_jitter(rows: Tensor, present: Tensor) -> Tensor:
    """Estimate the rms displacement in range between adjacent pulses of homogeneous clutter.

    The profile of clutter is speckle without features, but that of the next pulse is coherent with
    it. A displacement between both is the slope of the phase of their conjugate product over range
    frequency. As in `displacement`, only what both halves of the band have in common counts.
    In Doppler bands of more than 0.7 PRF adjacent pulses are hardly coherent, and half of the
    displacements or more are not found; the standard deviation of the phases is large there.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).

    Returns:
        Jitter in cells rms, shape (trial,); 0 where it does not differ from none by 3 standard
        deviations, and where there are fewer than 8 range cells or 8 pulses.
    """
    cells, n = rows.shape[-2:]
    if cells < _LEAST or n < _LEAST:
        return torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    spectrum = fft_lines(rows)
    offset = _about_centroid(spectrum)
    products = spectrum[..., 1:] * spectrum[..., :-1].conj()
    both = present[:, 1:] & present[:, :-1]
    # trial displacements in cells
    steps = torch.linspace(-1.5, 1.5, 61, dtype=offset.dtype, device=rows.device)
    slopes = []
    for half in (offset > 0, offset <= 0):
        turns = torch.exp(2j * torch.pi * steps[:, None] * offset[:, None]) * half[:, None]
        slope = steps[power_of(turns.to(products.dtype) @ products).argmax(-2)] * both
        slopes.append(torch.where(both, slope - _mean(slope, both)[:, None], 0))
    return _common(slopes, both.sum(-1)) / 2**0.5


def _halves(spectrum: Tensor) -> list[Tensor]:
    """Power profiles (trial, pulse, cell) of the upper and the lower half of the band, divided at
    its centroid, on the same range cells.
    """
    offset, lines = _about_centroid(spectrum), spectrum.mT
    return [power_of(torch.fft.ifft(lines * half[:, None])) for half in (offset > 0, offset <= 0)]


def _about_centroid(spectrum: Tensor) -> Tensor:
    """Frequencies relative to the centroid of the band within -0.5 to 0.5 cycles per cell, (trial,
    range).

    spectrum: Fourier transform along range, (trial, range, pulse).
    """
    frequency = torch.fft.fftfreq(spectrum.shape[-2], dtype=torch.float64, device=spectrum.device)
    density = power_of(spectrum).sum(-1, dtype=torch.float64)
    turn = torch.exp(2j * torch.pi * frequency)
    centre = (density.to(turn.dtype) @ turn)[:, None]
    return (turn * centre.conj()).angle() / (2 * torch.pi)


def _common(halves: list[Tensor], count: Tensor) -> Tensor:
    """Rms displacement in cells that both halves have in common, (trial,). It is zero unless their
    correlation exceeds 3 standard deviations. count: number of free values.
    """
    shared = (halves[0] * halves[1]).sum(-1)
    return torch.where(_agreement(halves, count) > 3, (shared / count.clamp_min(1)).sqrt(), 0)


def _agreement(halves: list[Tensor], count: Tensor) -> Tensor:
    """Correlation between the values of both halves in standard deviations of uncorrelated values,
    (trial,). count: number of free values.
    """
    one, other = halves
    scatter = (one.square().sum(-1) * other.square().sum(-1)).sqrt()
    correlation = ((one * other).sum(-1) / or_one(scatter)).clamp(-1 + 1e-12, 1 - 1e-12)
    return torch.atanh(correlation) * (count - 3).clamp_min(0).sqrt()


def _profiles(power: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Moduli of the profiles (trial, pulse, cell), the factors (trial, pulse) that give pulses unit
    energy, and the slope (trial, cell) along range of the sum of the scaled profiles.
    """
    profile, scale = power.sqrt(), or_one(power.sum(-1)).rsqrt()
    mean = (scale[:, None] @ profile)[:, 0]
    return profile, scale, (mean.roll(-1, -1) - mean.roll(1, -1)) / 2


def _displacements(profile: Tensor, scale: Tensor, slope: Tensor, parts: Tensor, present: Tensor) -> list[Tensor]:
    """Displacements in cells that are estimated from each of several parts of the range cells,
    (trial, pulse) each.

    Their mean is zero, and they are zero where no pulse is present. profile, scale, slope: see
    `_profiles`. parts: the cells that are used, (trial, part, cell).
    """
    slopes = slope[:, None] * parts
    count = present.sum(-1, keepdim=True).clamp_min(1)
    found = -(slopes @ profile.mT * scale[:, None]).double() * count[:, None]
    found = found / or_one(slopes.square().sum(-1, keepdim=True)).double()
    return [torch.where(present, x - _mean(x, present)[..., None], 0) for x in found.unbind(-2)]


def _mean(values: Tensor, present: Tensor) -> Tensor:
    """Mean of the values that are present, along the last dim."""
    return (values * present).sum(-1) / present.sum(-1).clamp_min(1)
