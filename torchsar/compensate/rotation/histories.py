"""Refinement of an estimated rotation from the phase histories of bright isolated scatterers.

The history of a scatterer is its signal over the aperture. It is cut out of the image by a window
about the scatterer and transformed back to slow time. If the rotation is estimated without error,
the phase of the history is a straight line. Errors add a curved phase:

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

from torchsar.compensate.rotation.motion import Motion, Sampling, Warped, chosen, image_of
from torchsar.compensate.rotation.peaks import Peaks, find_peaks, noise_power, threshold
from torchsar.core.warp import warp, warp_rate

_OVERSAMPLING = 2  # image lines per Doppler cell, found by trial: accuracy of peaks against time
# least amplitude of an isolated scatterer over the largest one within its window, found by trial
_ISOLATED = 0.5
_COUNT, HALF_CELLS = 128, 24  # largest number of scatterers, and half width of a window in Doppler cells
_ENDS = 16  # a window smears a history at both ends by 1/16 of its length, which is left out
_ROBUST_ROUNDS = 3  # reweighted fits, found by trial: enough to exclude outliers
# eigenvalue of a normal matrix of unit diagonal below which its direction is not determined: above
# the rounding of float64, below any real information
_NO_INFORMATION = 1e-7
# power over that of the brightest pixel below which side lobes are to be expected more than 24
# cells away
_FAINTEST = 1e-3
_SHARE_LOST = 0.01  # share of an unknown in such a direction beyond which it is not determined


class Histories(NamedTuple):
    """Phase histories of bright isolated scatterers, and what they show about the rotation.

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
    data: Tensor, sampling: Sampling, motion: Motion, *, free_centre: bool = True, half_cells: int = HALF_CELLS
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
        The refined rotation; that to start from where there is no scatterer.
    """
    found = histories_of(data, sampling, motion, free_centre=free_centre, half_cells=half_cells)
    moved = motion.moved(found.change)
    return chosen(found.used.any(-1) & moved.possible(sampling), moved, motion)


def histories_of(
    data: Tensor, sampling: Sampling, motion: Motion, *, free_centre: bool = True, half_cells: int = HALF_CELLS
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
    image = image_of(data, sampling, motion, oversampling=_OVERSAMPLING)
    power = image.abs().square()
    least = threshold(power[0].numel())
    resolved = _unambiguous(motion, sampling, image.shape[1])[..., None]
    speckle = torch.where(resolved, power, math.nan).nanmedian(1, keepdim=True).values / math.log(2)
    brightest, noise = power.amax((-2, -1)), noise_power(power) * least
    floor = torch.maximum(speckle * least, _FAINTEST * brightest[:, None, None])
    clear = torch.where(resolved & (power > floor), power, 0)
    peaks = find_peaks(clear, noise, _COUNT, _ISOLATED, 2 * half_cells, 1)
    cells, used = (peaks.line - image.shape[1] // 2) / _OVERSAMPLING, peaks.power > 0
    history, u = _windowed(image, peaks, half_cells)
    bases = _bases(motion, sampling, cells, sampling.range_m(peaks.cell), u, free_centre)
    keep = slice(max(1, len(u) // _ENDS), -max(1, len(u) // _ENDS))
    history = history[..., keep]
    seen = torch.stack([part.mean(-1).abs().square() for part in history.tensor_split(4, -1)], -1)
    seen = (seen * used[..., None]).sum(1)
    tiny = torch.finfo(power.dtype).tiny
    level, least_lit = brightest / noise.clamp_min(tiny), seen.amin(-1) / seen.amax(-1).clamp_min(tiny)
    return Histories(cells, used, level, least_lit, *_fitted(history, bases[..., keep], used))


def _unambiguous(motion: Motion, sampling: Sampling, lines: int) -> Tensor:
    """Lines (trial, line) whose Doppler the pulse rate resolves at every time of the aperture.

    The fastest rotation limits them. Beyond them scatterers of the other end of the band return.
    """
    times = sampling.times(motion.k.device)
    fastest = warp_rate(times, motion.k).amax(-1) * sampling.duration_s
    whole = warp(times.new_full((1,), sampling.duration_s), motion.k)[..., 0]
    line = torch.arange(lines, device=times.device) - lines // 2
    return line.abs() * (fastest / whole)[:, None] <= lines / 2


def _windowed(image: Tensor, peaks: Peaks, half_cells: int) -> tuple[Tensor, Tensor]:
    """Histories (trial, peak, 2 half_cells) of windows about peaks, and u of their samples."""
    lines = torch.arange(2 * half_cells * _OVERSAMPLING, device=image.device) - half_cells * _OVERSAMPLING
    row = peaks.line[..., None] + lines
    inside = (row >= 0) & (row < image.shape[1])
    index = row.clamp(0, image.shape[1] - 1) * image.shape[2] + peaks.cell[..., None]
    window = torch.where(inside, torch.gather(image.flatten(1), 1, index.flatten(1)).view(index.shape), 0).to(
        torch.complex128
    )
    u = (torch.arange(2 * half_cells, dtype=torch.float64, device=image.device) + 0.5) / (2 * half_cells)
    angle = -2 * math.pi / _OVERSAMPLING * lines[:, None] * u
    return window @ torch.polar(torch.ones_like(angle), angle), u


def _bases(motion: Motion, sampling: Sampling, cells: Tensor, range_m: Tensor, u: Tensor, free_centre: bool) -> Tensor:
    """Phase (rad) per unit of each unknown, (trial, peak, unknown, sample).

    The unknowns are k1, k2, ..., w, and v if it is free.
    """
    warped = Warped.of(motion.k, _times_at(u, motion.k, sampling.duration_s), sampling.duration_s)
    square = 2 * math.pi * sampling.turns_per_square * warped.phi.square()[:, None]
    rows = [-2 * math.pi * cells[..., None] * slope[:, None] for slope in warped.slopes.unbind(1)]
    rows.append((range_m + motion.centre_m[:, None])[..., None] * square)
    if free_centre:
        rows.append(square.expand(-1, cells.shape[-1], -1))
    return torch.stack(rows, -2)


def _times_at(u: Tensor, k: Tensor, duration_s: float) -> Tensor:
    """Times (trial, sample) at which the normalised warp is u, by Newton steps."""
    whole = warp(u.new_full((1,), duration_s), k)
    time = (u * duration_s).expand(k.shape[0], -1)
    for _ in range(8):
        time = (time - (warp(time, k) - u * whole) / warp_rate(time, k)).clamp(0, duration_s)
    return time


def _fitted(history: Tensor, bases: Tensor, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Robust weighted least squares on phases a sixth of the histories apart.

    The last three fields of `Histories`.
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
    for _ in range(_ROBUST_ROUNDS):
        weighted = difference * weight[..., None, :]
        inverse = inverted(torch.einsum("bpij,bpkj->bik", weighted, difference))[0]
        change = (inverse @ torch.einsum("bpij,bpj->bi", weighted, angle)[..., None])[..., 0]
        residual = angle - torch.einsum("bi,bpij->bpj", change, difference)
        pull = weighted * residual[..., None, :]
        scale = 3 * residual.abs().flatten(1).median(-1).values[:, None, None].clamp_min(1e-12)
        weight = weight / (1 + (residual / scale).square())
    return change, inverse, pull


def inverted(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Invert small normal matrices without the directions that the data do not determine.

    An eigenvalue x becomes x^3 / (x^4 + l^4) instead of 1 / x, with the limit l of what counts as
    known. This is the real part of the mean of 1 / (x - p) for p = l exp(+j pi / 4) and
    l exp(+3j pi / 4), so that no eigenvalues are needed, for which a GPU would make the program
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
    poles = [_NO_INFORMATION * cmath.exp(1j * cmath.pi * turn) for turn in (0.25, 0.75)]
    inverse = torch.linalg.inv_ex(torch.stack([unit - pole * one for pole in poles])).inverse.real.mean(0)
    # diagonal of the projection to the directions that are left out
    lost = ~(1 - (unit * inverse).sum(-1) <= _SHARE_LOST)  # also where it is no number
    return inverse * root[:, :, None] * root[:, None], lost
