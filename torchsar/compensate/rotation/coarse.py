"""Uneven rotation from short sections of the aperture, without a start and without a box.

In a section the target turns evenly, at the rate of its middle: the Doppler axis of its spectrum is
that of any other section, stretched by the ratio of their rates. On a logarithmic Doppler axis a
stretch is a shift. Magnitude spectra of all pairs of sections are correlated there, summed over
range cells, and a global search finds the course of the rate at which all pairs agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core.warp import warp_rate

MOST_SECTIONS, LEAST_SECTIONS = 28, 8
_OCTAVES = 3.5
_STEPS_PER_UNIT = 200  # of the logarithm of Doppler
_WIDEST = 1.4  # of the logarithm of a rate over another: a factor of 4
_GRID = 0.07  # step of the search, in logarithms of rates at the middle and the end of the aperture
_BLUR = 0.03
_KEPT = 6
_ROUNDS = 6
_ROWS = 16
_LEAST_RATE = 0.1


@dataclass(frozen=True)
class _Agreement:
    """How well pairs of sections agree at a shift.

    table: (trial, pair, shift) for shifts of -reach..reach steps; first, second: the sections.
    """

    table: Tensor
    first: Tensor
    second: Tensor

    def at(self, log_rate: Tensor) -> Tensor:
        """Sum over pairs for log_rate (trial, candidate, section). Returns (trial, candidate)."""
        reach = (self.table.shape[-1] - 1) // 2
        shift = (log_rate[..., self.second] - log_rate[..., self.first]) * _STEPS_PER_UNIT + reach
        shift = shift.clamp(0, 2 * reach - 1e-3)
        whole = shift.floor().long()
        rest = (shift - whole).to(self.table.dtype)
        place = (torch.arange(len(self.first), device=shift.device) * self.table.shape[-1] + whole).flatten(1)
        flat = self.table.flatten(1)
        low, high = (torch.gather(flat, 1, place + step).view(shift.shape) for step in (0, 1))
        return (low + rest * (high - low)).sum(-1)


def coarse_warp(data: Tensor, prf_hz: float, sections: int | None = None) -> Tensor:
    """(k1, k2) of data (trial, pulse, range), good to about a percent of the rate.

    Returns float64 (trial, 2).

    Looks at all rates between a quarter and four times that of the first pulse. Needs scatterers
    off the axis in at least one range cell. sections: half-overlapping, by default half the root of
    the number of pulses, 8 to 28: the Doppler of a section then changes by about as much as it
    resolves.
    """
    pulses = data.shape[1]
    wanted = min(MOST_SECTIONS, max(LEAST_SECTIONS, round(math.sqrt(pulses) / 2))) if sections is None else sections
    sections = max(4, min(wanted, pulses // 8))
    length = 2 * (pulses // (sections + 1))
    spectra = _log_spectra(_brightest(data, _ROWS), length)
    middles = (
        torch.arange(spectra.shape[1], dtype=torch.float64, device=data.device) * (length // 2) + (length - 1) / 2
    ) / prf_hz
    duration = pulses / prf_hz
    course = _Course(middles, duration)
    step = torch.arange(-_WIDEST, _WIDEST + 1e-9, _GRID, dtype=torch.float64, device=data.device)
    best = torch.cartesian_prod(step, step).expand(data.shape[0], -1, -1)
    products = _products(spectra)
    best = _best(best, _agreement(products, _BLUR), course, _KEPT)
    agreement = _agreement(products, 0.0)
    nearby = torch.cartesian_prod(*2 * [torch.linspace(-1, 1, 5, dtype=torch.float64, device=data.device)])
    size, kept = _GRID, _KEPT
    for _ in range(_ROUNDS):
        kept = max(1, kept // 2)
        best = _best((best[:, :, None] + size * nearby).flatten(1, 2), agreement, course, kept)
        size /= 2
    return course.warp_k(best[:, 0])


@dataclass(frozen=True)
class _Course:
    """Rates of third order, told by the logarithms of the rate at the middle and at the end of the
    aperture over that at its start.
    """

    middles_s: Tensor
    duration_s: float

    def warp_k(self, logs: Tensor) -> Tensor:
        middle, end = torch.exp(logs).unbind(-1)
        k2 = 4 * (end - 2 * middle + 1) / self.duration_s**2
        return torch.stack([(end - 1) / self.duration_s - k2 * self.duration_s / 2, k2], -1)

    def log_rate(self, logs: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithm of the rate in every section (..., section), and whether the target always
        turns on (...,).
        """
        k = self.warp_k(logs)
        ends = torch.linspace(0, self.duration_s, 33, dtype=torch.float64, device=logs.device)
        return torch.log(warp_rate(self.middles_s, k).clamp_min(_LEAST_RATE)), warp_rate(ends, k).amin(-1) > _LEAST_RATE


def _best(candidates: Tensor, agreement: _Agreement, course: _Course, count: int) -> Tensor:
    """The `count` best of candidates (trial, candidate, 2), per trial."""
    log_rate, valid = course.log_rate(candidates)
    score = torch.where(valid, agreement.at(log_rate).to(torch.float64), -math.inf)
    return torch.gather(candidates, 1, score.topk(count, -1).indices[..., None].expand(-1, -1, 2))


def _brightest(data: Tensor, count: int) -> Tensor:
    """The range cells of most energy, (trial, pulse, count)."""
    if data.shape[-1] <= count:
        return data
    order = data.abs().square().sum(1).topk(count, -1).indices
    return torch.gather(data, 2, order[:, None].expand(-1, data.shape[1], -1))


def _log_spectra(data: Tensor, length: int) -> Tensor:
    """Magnitude spectra of half-overlapping sections on logarithmic axes of negative and positive
    Doppler, without their means: (trial, section, row, step).
    """
    window = torch.hann_window(length, periodic=False, dtype=data.real.dtype, device=data.device)
    spectrum = torch.fft.fft(data.unfold(1, length, length // 2) * window, 2 * length).abs()
    steps = math.ceil(_OCTAVES * math.log(2) * _STEPS_PER_UNIT)
    logs = torch.arange(steps, dtype=torch.float64, device=data.device) / _STEPS_PER_UNIT - _OCTAVES * math.log(2)
    place = torch.exp(logs) * (length - 1)
    whole = place.floor().long().clamp(0, length - 2)
    rest = (place - whole).to(spectrum.dtype)
    positive = spectrum[..., whole] * (1 - rest) + spectrum[..., whole + 1] * rest
    negative = (
        spectrum[..., (2 * length - whole) % (2 * length)] * (1 - rest) + spectrum[..., 2 * length - whole - 1] * rest
    )
    both = torch.cat([positive, negative], 2)
    return both - both.mean(-1, keepdim=True)


def _products(spectra: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Transforms of the correlations of all pairs of sections that share no pulse, (trial, pair,
    frequency), and the sections of each pair.
    """
    transform = torch.fft.rfft(spectra, 2 * spectra.shape[-1]).permute(0, 3, 1, 2).contiguous()
    first, second = torch.tril_indices(transform.shape[2], transform.shape[2], -2, device=spectra.device)
    return (transform @ transform.mH)[..., second, first].mT, first, second


def _agreement(products: tuple[Tensor, Tensor, Tensor], blur: float) -> _Agreement:
    """Correlations of the pairs, blurred by so much of the logarithm of Doppler."""
    transform, first, second = products
    n = 2 * (transform.shape[-1] - 1)
    frequency = torch.arange(transform.shape[-1], device=transform.device) / n
    smooth = torch.exp(-0.5 * (2 * math.pi * frequency * blur * _STEPS_PER_UNIT).square()).to(transform.real.dtype)
    table = torch.fft.irfft(transform * smooth, n)
    reach = min(math.ceil(_WIDEST * _STEPS_PER_UNIT), n // 2 - 1)
    return _Agreement(torch.cat([table[..., -reach:], table[..., : reach + 1]], -1), first, second)
