"""Phase least squares: the phase histories of bright isolated scatterers, fitted by what an error
of the motion does to each of them.

A window about a focused scatterer, transformed back, is its history over the aperture. What is left
in it beyond a constant and a line is -2 pi c du/dk dk at Doppler cell c, and (c4/2) (y dw + dv)
phi^2 at range y. Products of a history with itself a sixth of the aperture later need no
unwrapping, and start from any rate: even the range term of a motion that is not known at all, w =
0, bends phases by little in that time.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.rotation.motion import Motion, Sampling, Warped, image_of
from torchsar.compensate.rotation.peaks import Peaks, find_peaks, noise_power, threshold
from torchsar.core.warp import warp, warp_rate

_OVERSAMPLING = 2
_ISOLATED = 0.5  # of the amplitude of the brightest within the windows
_ENDS = 16  # the window smears a history at both ends, by this part of it
_ROBUST_ROUNDS = 3
_NOTHING = 1e-7  # of an eigenvalue of a normal matrix of unit diagonal
_SHARE_LOST = 0.01  # of an unknown in a direction


def refined_by_histories(
    data: Tensor,
    sampling: Sampling,
    motion: Motion,
    *,
    free_centre: bool = True,
    count: int = 128,
    half_cells: int = 24,
) -> tuple[Motion, Tensor]:
    """One step of phase least squares from `motion`, on data (trial, pulse, range).

    Returns the motion and the number of scatterers used (trial,).

    count: scatterers at most; half_cells: half width of a window in Doppler cells, wide enough for
    the error of the start.
    """
    image = image_of(data, sampling, motion, oversampling=_OVERSAMPLING)
    power = image.abs().square()
    peaks = find_peaks(power, noise_power(power) * threshold(power), count, _ISOLATED, 2 * half_cells, 1)
    cells = (peaks.line - image.shape[1] // 2) / _OVERSAMPLING
    history, u = _histories(image, peaks, half_cells)
    bases = _bases(motion, sampling, cells, sampling.range_m(peaks.cell), u, free_centre)
    keep = slice(max(1, len(u) // _ENDS), -max(1, len(u) // _ENDS))
    change = _fitted(history[..., keep], bases[..., keep], peaks.power > 0)
    order = motion.k.shape[-1]
    v = change[:, -1] if free_centre else 0
    found = (peaks.power > 0).sum(-1)
    moved = replace(motion, k=motion.k + change[:, :order], w=motion.w + change[:, order], v=motion.v + v)
    return moved.where((found > 0) & moved.possible(sampling), motion), found


def _histories(image: Tensor, peaks: Peaks, half_cells: int) -> tuple[Tensor, Tensor]:
    """Histories (trial, peak, 2 half_cells) of windows about peaks, and where on the aperture their
    samples lie, u (sample,).
    """
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
    """Phase (rad) per unit of each unknown, (trial, peak, unknown, sample): k1, k2, ..., w, then v
    where it is free.
    """
    warped = Warped.of(motion.k, _times_at(u, motion.k, sampling.duration_s), sampling.duration_s)
    square = 2 * math.pi * sampling.turns_per_square * warped.phi.square()[:, None]
    rows = [-2 * math.pi * cells[..., None] * slope[:, None] for slope in warped.slopes.unbind(1)]
    rows.append((range_m + motion.centre_m[:, None])[..., None] * square)
    if free_centre:
        rows.append(square.expand(-1, cells.shape[-1], -1))
    return torch.stack(rows, -2)


def _times_at(u: Tensor, k: Tensor, duration_s: float) -> Tensor:
    """Times at which the normalised warp is u, by Newton steps. (trial, sample)."""
    whole = warp(torch.tensor([duration_s], dtype=torch.float64, device=k.device), k)
    time = (u * duration_s).expand(k.shape[0], -1)
    for _ in range(8):
        time = (time - (warp(time, k) - u * whole) / warp_rate(time, k)).clamp(0, duration_s)
    return time


def _fitted(history: Tensor, bases: Tensor, used: Tensor) -> Tensor:
    """Robust weighted least squares on phases between samples a sixth of the histories apart.

    (trial, unknown).
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
    change = angle.new_zeros(bases.shape[0], bases.shape[2])
    for _ in range(_ROBUST_ROUNDS):
        weighted = difference * weight[..., None, :]
        change = solved(
            torch.einsum("bpij,bpkj->bik", weighted, difference), torch.einsum("bpij,bpj->bi", weighted, angle)
        )
        rest = angle - torch.einsum("bi,bpij->bpj", change, difference)
        scale = 3 * rest.abs().flatten(1).median(-1).values[:, None, None].clamp_min(1e-12)
        weight = weight / (1 + (rest / scale).square())
    return change


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Solution of small normal equations (trial, n, n), (trial, n); directions that nothing is
    known about stay at zero.
    """
    inverse, _ = inverted(normal)
    return (inverse @ right[..., None])[..., 0]


def inverted(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of small normal matrices (trial, n, n) without the directions that nothing is known
    about, and which unknowns have a part in those, (trial, n) bool.
    """
    scale = normal.diagonal(dim1=-2, dim2=-1)
    root = torch.where(scale > 0, scale, 1).rsqrt()
    value, vector = torch.linalg.eigh(normal * root[:, :, None] * root[:, None])
    known = value > _NOTHING
    inverse = (vector * torch.where(known, 1 / torch.where(known, value, 1), 0)[:, None]) @ vector.mT
    lost = (~known[:, None] & (vector.square() > _SHARE_LOST)).any(-1)
    return inverse * root[:, :, None] * root[:, None], lost
