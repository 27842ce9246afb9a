"""Estimate of a non-uniform rotation from the spectra of short sections of the aperture.

No values to start from are needed. Within a short section the target rotates almost uniformly. The
Doppler spectra of two sections differ by a stretch, the ratio of the two rotation rates; on a
logarithmic Doppler axis this is a shift. The magnitude spectra of every pair of sections are
correlated on that axis and summed over range cells. A global search finds the rotation rate as a
function of time with which the shifts of all pairs agree best. The search is repeated on
compensated data, with longer sections, which resolve scatterers better.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.rotation.motion import SEARCH_EPS
from torchsar.core import numbers_on
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.transforms import Gridding
from torchsar.metrics import entropy
from torchsar.radar.warp import warp, warp_rate

_STEPS_PER_UNIT = 200  # steps per unit of the logarithm of Doppler: half a percent each
_WIDEST = 1.4  # largest logarithm of a ratio of rotation rates that is searched: a factor of 4
# least rate relative to that at the first pulse; a slower target would nearly reverse its rotation
_LEAST_RATE = 0.1


def coarse_warp(data: Tensor, prf_hz: float) -> Tensor:
    """Estimate how the rotation rate changes, from the Doppler spectra of short sections.

    The ratio of the rotation rate at time t after the first pulse to that at the first pulse is
    modelled as 1 + k1 t + k2 t^2 / 2. In the middle and at the end of the aperture, ratios from a
    quarter to four are searched. At least one range cell must hold scatterers off the rotation
    axis.

    The first search has half the square root of the number of pulses as half-overlapping sections,
    within 8..28, so that the Doppler of a scatterer changes within a section by about the Doppler
    resolution. Compensated data change less: 6 and then twice 4 sections find what is left with a
    better resolution. Their result is used where it makes the image sharper.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.

    Returns:
        k1 in 1/s and k2 in 1/s^2, shape (trial, 2), float64.
    """
    pulses, rows = data.shape[1], data
    # the 16 range cells of most energy, a compromise between accuracy and time found by trial
    if data.shape[-1] > 16:
        order = data.abs().square().sum(1).topk(16, -1).indices
        rows = torch.gather(data, 2, order[:, None].expand(-1, pulses, -1))
    # Number of sections, found by trial: more of them follow the rate more closely, fewer resolve
    # Doppler better.
    wanted = min(28, max(8, round(math.sqrt(pulses) / 2)))
    sections = max(4, min(wanted, pulses // 8))
    duration_s = pulses / prf_hz
    times = numbers_on(data.device, duration_s / 2, duration_s)
    k = _change_of_rate(rows, prf_hz, sections, _WIDEST)
    image = _image(rows, prf_hz, k)
    # The numbers of sections, and 0.35 as the largest logarithm of a remaining ratio of rates, were
    # found by trial.
    for fewer in (6, 4, 4):
        if fewer < sections:
            # pulses at equal steps of the rotation angle, which are those of a uniform rotation if
            # k is correct
            even = torch.fft.fft(torch.fft.ifftshift(image, dim=1), dim=1, norm="forward")
            left = _change_of_rate(even, prf_hz, fewer, 0.35)
            at = duration_s * warp(times, k) / warp(times[1:], k)
            other = _third_order(warp_rate(times, k) * warp_rate(at, left), duration_s)
            formed = _image(rows, prf_hz, other)
            # the result of longer sections, which suffer more from phase errors of the pulses, is
            # used only if it lowers the entropy
            better = entropy(formed) < entropy(image)
            k = torch.where(better[:, None], other, k)
            image = torch.where(better[:, None, None], formed, image)
    return k


def _change_of_rate(rows: Tensor, prf_hz: float, sections: int, widest: float) -> Tensor:
    """Coefficients k1 and k2 (trial, 2) with which the spectra of the sections agree best.

    A candidate is a pair of logarithms: of the rates in the middle and at the end of the aperture,
    each over that at the first pulse. widest: largest logarithm that is searched.
    """
    pulses, like = rows.shape[1], {"dtype": torch.float64, "device": rows.device}
    length, duration_s = 2 * (pulses // (sections + 1)), pulses / prf_hz
    spectra = _log_spectra(rows, length)
    # correlations of all pairs of sections that share no pulse
    transform = torch.fft.rfft(spectra, 2 * spectra.shape[-1]).permute(0, 3, 1, 2).contiguous()
    first, second = torch.tril_indices(spectra.shape[1], spectra.shape[1], -2, device=rows.device)
    products = (transform @ transform.mH)[..., second, first].mT
    middles = (torch.arange(spectra.shape[1], **like) * (length // 2) + (length - 1) / 2) / prf_hz
    times = torch.linspace(0, duration_s, 33, **like)

    def best_of(candidates: Tensor, table: Tensor, count: int) -> Tensor:
        """Select the `count` best of candidates (trial, candidate, 2) for each trial."""
        k = _third_order(torch.exp(candidates), duration_s)
        rate = torch.log(warp_rate(middles, k).clamp_min(_LEAST_RATE))
        # The cost is the sum of the correlations of all pairs at these shifts. They are
        # interpolated through four points, so that the estimate is not drawn to a step of the
        # table.
        reach = (table.shape[-1] - 1) // 2
        shift = (rate[..., second] - rate[..., first]) * _STEPS_PER_UNIT + reach
        shift = shift.clamp(1, 2 * reach - 1 - 1e-3)
        whole = shift.floor().long()
        x, flat = (shift - whole).to(table.dtype), table.flatten(1)
        position = (torch.arange(table.shape[1], device=shift.device) * table.shape[-1] + whole).flatten(1)
        a, b, c, d = (torch.gather(flat, 1, position + step).view(shift.shape) for step in (-1, 0, 1, 2))
        score = b + 0.5 * x * (c - a + x * (2 * a - 5 * b + 4 * c - d + x * (3 * (b - c) + d - a)))
        score = score.sum(-1).to(torch.float64)
        score = torch.where(warp_rate(times, k).amin(-1) > _LEAST_RATE, score, -math.inf)
        return torch.gather(candidates, 1, score.topk(count, -1).indices[..., None].expand(-1, -1, 2))

    # step of the search in logarithms of rates, and number of its candidates that are refined, a
    # compromise between reliability and time found by trial
    size, kept = 0.07, 6
    step = torch.arange(-widest, widest + 1e-9, size, **like)
    best = torch.cartesian_prod(step, step).expand(rows.shape[0], -1, -1)
    # blurred by about half a step of the grid, so that no peak is missed
    best = best_of(best, _correlations(products, 0.03), kept)
    # in single precision, rounding would move the flat maximum
    table = _correlations(products.to(torch.complex128), 0.0)
    nearby = torch.cartesian_prod(*2 * [torch.linspace(-1, 1, 5, **like)])
    for _ in range(10):  # each refinement halves the step, down to 0.0001 of a rate
        kept = max(1, kept // 2)
        best = best_of((best[:, :, None] + size * nearby).flatten(1, 2), table, kept)
        size /= 2
    return _third_order(torch.exp(best[:, 0]), duration_s)


def _correlations(transform: Tensor, blur: float) -> Tensor:
    """Correlations of pairs of sections (trial, pair, shift) for shifts of -reach..reach steps.

    transform: Fourier transform of the correlations. blur: width of the blur in the logarithm of
    Doppler.
    """
    n = 2 * (transform.shape[-1] - 1)
    frequency = torch.arange(transform.shape[-1], device=transform.device) / n
    smooth = torch.exp(-0.5 * (2 * math.pi * frequency * blur * _STEPS_PER_UNIT).square()).to(transform.real.dtype)
    table = torch.fft.irfft(transform * smooth, n)
    reach = min(math.ceil(_WIDEST * _STEPS_PER_UNIT), n // 2 - 1)
    return torch.cat([table[..., -reach:], table[..., : reach + 1]], -1)


def _image(rows: Tensor, prf_hz: float, k: Tensor) -> Tensor:
    """Image (trial, line, range) of a target whose rotation rate changes by k."""
    return matched_fourier(rows, k, prf_hz, lines=DopplerLines(1.0), transform=Gridding(eps=SEARCH_EPS))


def _third_order(rates: Tensor, duration_s: float) -> Tensor:
    """Coefficients k1 (1/s) and k2 (1/s^2), shape (..., 2), of given rotation rates.

    rates: in the middle and at the end of the aperture, each over that at the first pulse, shape
    (..., 2).
    """
    middle, end = rates.unbind(-1)
    k2 = 4 * (end - 2 * middle + 1) / duration_s**2
    return torch.stack([(end - 1) / duration_s - k2 * duration_s / 2, k2], -1)


def _log_spectra(data: Tensor, length: int) -> Tensor:
    """Magnitude spectra of half-overlapping sections on logarithmic Doppler axes, with the mean
    removed.

    Negative and positive Doppler have an axis each: (trial, section, row, step).
    """
    window = torch.hann_window(length, periodic=False, dtype=data.real.dtype, device=data.device)
    spectrum = torch.fft.fft(data.unfold(1, length, length // 2) * window, 2 * length).abs()
    # extent of the logarithmic axis: 3.5 octaves below the edge of the band, found by trial
    reach = 3.5 * math.log(2)
    steps = math.ceil(reach * _STEPS_PER_UNIT)
    logs = torch.arange(steps, dtype=torch.float64, device=data.device) / _STEPS_PER_UNIT - reach
    position = torch.exp(logs) * (length - 1)
    whole = position.floor().long().clamp(0, length - 2)
    rest = (position - whole).to(spectrum.dtype)
    positive = spectrum[..., whole] * (1 - rest) + spectrum[..., whole + 1] * rest
    negative = (
        spectrum[..., (2 * length - whole) % (2 * length)] * (1 - rest) + spectrum[..., 2 * length - whole - 1] * rest
    )
    both = torch.cat([positive, negative], 2)
    return both - both.mean(-1, keepdim=True)
