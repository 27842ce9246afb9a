"""Bright scatterers, and refinement of an estimated rotation from their phase histories.

Scatterers are local maxima of an image above the noise and above the side lobes of their
neighbours. The history of a scatterer is its signal over the aperture. It is cut out of the image
by a window about the scatterer and transformed back to slow time. If the rotation is estimated
without error, the phase of the history is a straight line. Errors add a curved phase:

- an error dk of a relative derivative k of the rotation rate adds -2 pi c (du/dk) dk, where c is
the Doppler cell of the scatterer. The warped time phi is the rotation angle over the rate at the
first pulse, and u is phi over its value at the end of the aperture.
- an error dw of the squared rotation rate w, and an error dv of v = w times the error of the
assumed rotation centre in range, add (2 pi / lambda) (y dw + dv) phi^2, where y is the range of the
scatterer from the assumed centre.

The errors are found by least squares. The fit uses the phases of products of a history with its
conjugate a sixth of the aperture earlier. They need no unwrapping, because the curved phase changes
little within a sixth of the aperture. The fit can therefore start from any rotation rate, even from
w = 0.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.compensate.rotation.motion import Motion, Sampling, chosen, image_of, warped_time
from torchsar.core import cis
from torchsar.focus.warped_sums import slow_times
from torchsar.radar.warp import warp, warp_rate

# image lines per Doppler cell, a compromise between accuracy of peaks and time found by trial
OVERSAMPLING = 2


def noise_power(power: Tensor) -> Tensor:
    """Estimate the mean power of circular Gaussian noise in an image from the median of its power.

    Assumes that scatterers leave most of the image empty.

    Args:
        power: Power of the image, shape (trial, line, range).

    Returns:
        The noise power, shape (trial,).
    """
    every = power.flatten(1)
    # the median of 65536 pixels has an error below one percent
    return every[:, :: max(1, every.shape[-1] // (1 << 16))].median(-1).values / math.log(2)


def threshold(pixels: int) -> float:
    """Compute the detection threshold that noise alone exceeds in about one of ten images.

    Args:
        pixels: Number of pixels of an image.

    Returns:
        The threshold, as a ratio of power to mean noise power.
    """
    return math.log(pixels) + 2.5


def find_peaks(
    power: Tensor, floor: Tensor, count: int, share: float, lines: int, cells: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Find local maxima of an image above the noise.

    A maximum that is weak compared with the brightest pixel near it is left out, because it may be
    a side lobe. Weak scatterers near strong ones are thus found only after the strong ones are
    subtracted from the data.

    Args:
        power: Power of the image, shape (trial, line, range).
        floor: Least power of a peak, shape (trial,).
        count: Largest number of peaks.
        share: Least amplitude of a peak, as a fraction of the largest amplitude in its
            neighbourhood.
        lines: Half width of the neighbourhood in lines.
        cells: Half width of the neighbourhood in range cells.

    Returns:
        Power of the peaks, brightest first, 0 in the places that a trial with fewer peaks does not
        fill; their image lines, int64; and their range cells, int64; shape (trial, peak) each.
    """
    n_line, n_cell = power.shape[1:]
    along, across = pad(power, (0, 0, 1, 1)), pad(power, (1, 1, 0, 0))
    maximum = (
        (power >= along[:, :-2]) & (power > along[:, 2:]) & (power >= across[..., :-2]) & (power > across[..., 2:])
    )
    maxima = torch.where(maximum & (power > floor[:, None, None]), power, 0).flatten(1)
    # four local maxima are examined for each peak wanted, a number found by trial
    level, index = maxima.topk(min(4 * count, maxima.shape[-1]), -1)
    line, cell = index // n_cell, index % n_cell
    offsets = torch.cartesian_prod(
        torch.arange(-lines, lines + 1, device=power.device), torch.arange(-cells, cells + 1, device=power.device)
    )
    near_line, near_cell = line[..., None] + offsets[:, 0], cell[..., None] + offsets[:, 1]
    inside = (near_line >= 0) & (near_line < n_line) & (near_cell >= 0) & (near_cell < n_cell)
    near = torch.gather(
        power.flatten(1), 1, (near_line.clamp(0, n_line - 1) * n_cell + near_cell.clamp(0, n_cell - 1)).flatten(1)
    ).view(inside.shape)
    around = torch.where(inside, near, 0).amax(-1)
    kept = torch.where((level > 0) & (level >= share**2 * around), level, 0)
    found, order = kept.topk(min(count, kept.shape[-1]), -1)
    return found, torch.gather(line, 1, order), torch.gather(cell, 1, order)


class Histories(NamedTuple):
    """Phase histories of bright isolated scatterers, and the change of the rotation that they
    require.

    Args:
        cells: Doppler of the scatterers in Doppler cells, shape (trial, peak).
        used: True where there is a scatterer, shape (trial, peak), bool.
        level: Greatest power of the image over the detection threshold, shape (trial,).
        least_lit: Least power of the scatterers in a quarter of the aperture over that in the
            quarter of most power, shape (trial,).
        change: Change of the parameters of the rotation (`Motion.moved`) that fits the histories
            best, shape (trial, parameter).
        inverse: Inverse of the normal matrix of this fit, shape (trial, parameter, parameter).
        pull: What the fit leaves of its normal equations, shape (trial, peak, parameter, sample).
    """

    cells: Tensor
    used: Tensor
    level: Tensor
    least_lit: Tensor
    change: Tensor
    inverse: Tensor
    pull: Tensor


def refined_by_histories(
    data: Tensor, sampling: Sampling, motion: Motion, *, free_centre: bool = True, half_cells: int = 24
) -> Motion:
    """Refine a rotation by one least-squares fit to the phase histories of bright scatterers.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation to start from.
        free_centre: True also estimates the range of the rotation centre; False keeps that of
            `motion`.
        half_cells: Half width of a window in Doppler cells, wide enough for the blur that the error
            of the start causes.

    Returns:
        The refined rotation; `motion` itself in trials without a scatterer, or where the refined
        rotation is not possible (`Motion.possible`).
    """
    found = histories_of(data, sampling, motion, free_centre=free_centre, half_cells=half_cells)
    moved = motion.moved(found.change)
    return chosen(found.used.any(-1) & moved.possible(sampling), moved, motion)


def histories_of(
    data: Tensor, sampling: Sampling, motion: Motion, *, free_centre: bool = True, half_cells: int = 24
) -> Histories:
    """Fit the change of a rotation to the phase histories of bright isolated scatterers.

    A history is the signal of one scatterer over the aperture, cut out of the image by a window.
    Peaks that may be speckle of a bright range cell, or side lobes, are left out.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation that the image compensates.
        free_centre: True also fits the range of the rotation centre.
        half_cells: Half width of a window in Doppler cells.

    Returns:
        The histories and the change of the rotation.
    """
    image = image_of(data, sampling, motion, oversampling=OVERSAMPLING)
    power = image.abs().square()
    least = threshold(power[0].numel())
    # Only lines whose Doppler the pulse rate resolves at every time are used. The fastest rotation
    # limits them: beyond them, scatterers appear aliased from the other end of the band.
    times, lines = slow_times(sampling.pulses, sampling.prf_hz, motion.k.device), image.shape[1]
    fastest = warp_rate(times, motion.k).amax(-1) * sampling.duration_s
    whole = warp(times.new_full((1,), sampling.duration_s), motion.k)[..., 0]
    doppler = torch.arange(lines, device=times.device) - lines // 2
    resolved = (doppler.abs() * (fastest / whole)[:, None] <= lines / 2)[..., None]
    speckle = torch.where(resolved, power, math.nan).nanmedian(1, keepdim=True).values / math.log(2)
    brightest, noise = power.amax((-2, -1)), noise_power(power) * least
    # farther than 24 cells, side lobes may reach 1e-3 of the power of the brightest pixel
    floor = torch.maximum(speckle * least, 1e-3 * brightest[:, None, None])
    clear = torch.where(resolved & (power > floor), power, 0)
    # up to 128 scatterers with at least half of the largest amplitude within the window, found by
    # trial
    peak, line, cell = find_peaks(clear, noise, 128, 0.5, 2 * half_cells, 1)
    cells, used = (line - image.shape[1] // 2) / OVERSAMPLING, peak > 0
    # histories of windows around the peaks, (trial, peak, 2 half_cells), and u of their samples
    offsets = torch.arange(-half_cells * OVERSAMPLING, half_cells * OVERSAMPLING, device=image.device)
    row = line[..., None] + offsets
    index = row.clamp(0, lines - 1) * image.shape[2] + cell[..., None]
    near = torch.gather(image.flatten(1), 1, index.flatten(1)).view(index.shape)
    window = torch.where((row >= 0) & (row < lines), near, 0).to(torch.complex128)
    u = (torch.arange(2 * half_cells, dtype=torch.float64, device=image.device) + 0.5) / (2 * half_cells)
    history = window @ cis(-2 * math.pi / OVERSAMPLING * offsets[:, None] * u)
    bases = _bases(motion, sampling, cells, sampling.range_m(cell), u, free_centre)
    # the window blurs both ends of a history over 1/16 of its length; they are left out
    ends = max(1, len(u) // 16)
    history, bases = history[..., ends:-ends], bases[..., ends:-ends]
    seen = torch.stack([part.mean(-1).abs().square() for part in history.tensor_split(4, -1)], -1)
    seen = (seen * used[..., None]).sum(1)
    tiny = torch.finfo(power.dtype).tiny
    level, least_lit = brightest / noise.clamp_min(tiny), seen.amin(-1) / seen.amax(-1).clamp_min(tiny)
    return Histories(cells, used, level, least_lit, *_fitted(history, bases, used))


def _bases(motion: Motion, sampling: Sampling, cells: Tensor, range_m: Tensor, u: Tensor, free_centre: bool) -> Tensor:
    """Phase (rad) per unit of each unknown, (trial, peak, unknown, sample).

    The unknowns are k1, k2, ..., w, and v if it is free.
    """
    duration_s, k = sampling.duration_s, motion.k
    whole = warp(u.new_full((1,), duration_s), k)
    times = (u * duration_s).expand(len(k), -1)
    for _ in range(8):  # Newton steps to find the times of equally spaced warped time
        times = (times - (warp(times, k) - u * whole) / warp_rate(times, k)).clamp(0, duration_s)
    phi, _, slopes = warped_time(k, times, duration_s)
    square = 2 * math.pi * (1 / sampling.wavelength_m) * phi.square()[:, None]
    rows = [-2 * math.pi * cells[..., None] * slope[:, None] for slope in slopes.unbind(1)]
    rows.append((range_m + motion.centre_m[:, None])[..., None] * square)
    if free_centre:
        rows.append(square.expand(-1, cells.shape[-1], -1))
    return torch.stack(rows, -2)


def _fitted(history: Tensor, bases: Tensor, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Robust weighted least squares on the differences of phases a sixth of the histories apart.
    Returns the last three fields of `Histories`.
    """
    lag = max(1, history.shape[-1] // 6)
    product = history[..., lag:] * history[..., :-lag].conj()
    whole = product.sum(-1, keepdim=True)
    angle = torch.angle(product * whole.conj())
    difference = bases[..., lag:] - bases[..., :-lag]
    weight = product.abs() / product.abs().mean(-1, keepdim=True).clamp_min(1e-300) * whole.abs() * used[..., None]
    total = weight.sum(-1, keepdim=True).clamp_min(1e-300)
    angle = angle - (weight * angle).sum(-1, keepdim=True) / total
    difference = difference - (weight[..., None, :] * difference).sum(-1, keepdim=True) / total[..., None]
    change, inverse, pull = angle.new_zeros(bases.shape[0], bases.shape[2]), angle.new_zeros(0), angle.new_zeros(0)
    for _ in range(3):  # three reweighted fits, found by trial, are enough to exclude outliers
        weighted = difference * weight[..., None, :]
        inverse = inverted(torch.einsum("bpij,bpkj->bik", weighted, difference))[0]
        change = (inverse @ torch.einsum("bpij,bpj->bi", weighted, angle)[..., None])[..., 0]
        residual = angle - torch.einsum("bi,bpij->bpj", change, difference)
        pull = weighted * residual[..., None, :]
        scale = 3 * residual.abs().flatten(1).median(-1).values[:, None, None].clamp_min(1e-12)
        weight = weight / (1 + (residual / scale).square())
    return change, inverse, pull


def inverted(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Invert small normal matrices, and leave out the directions that the data do not determine.

    An eigenvalue x becomes x^3 / (x^4 + l^4) instead of 1 / x, where l is the limit below which a
    direction is not determined. This is the real part of the mean of 1 / (x - p) for p = l exp(+j
    pi / 4) and l exp(+3j pi / 4). No eigenvalues are needed, for which a GPU would make the program
    wait.

    Args:
        normal: Normal matrices, shape (trial, n, n).

    Returns:
        The inverse, shape (trial, n, n); and True for unknowns that contribute to the excluded
        directions and are therefore not determined, shape (trial, n), bool.
    """
    scale = normal.diagonal(dim1=-2, dim2=-1)
    root = torch.where(scale > 0, scale, 1).rsqrt()
    unit = normal * root[:, :, None] * root[:, None]
    one = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
    # the limit is above the rounding of float64 and below any real information
    poles = [1e-7 * cmath.exp(1j * cmath.pi * turn) for turn in (0.25, 0.75)]
    inverse = torch.linalg.inv_ex(torch.stack([unit - pole * one for pole in poles])).inverse.real.mean(0)
    # An unknown counts as lost if more than 0.01 of it is in the directions that are left out. The
    # diagonal of the projection to these directions is that share.
    lost = ~(1 - (unit * inverse).sum(-1) <= 0.01)  # true also for NaN
    return inverse * root[:, :, None] * root[:, None], lost
