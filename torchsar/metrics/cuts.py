"""Cuts through an impulse response, for drawing."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Signal, cis
from torchsar.metrics.impulse import impulse_response

_REACH, _FACTOR = 32, 16


def impulse_cuts(image: Signal, at_m: tuple[float, float]) -> dict[str, tuple[Tensor, Tensor]]:
    """Per axis of an unbatched image: offsets (m) from the peak nearest to at_m, and the
    interpolated complex cut through it.

    Band-limited interpolation by 16 about the centre of the local spectrum, over 32 samples to each
    side (less at the edges).
    """
    measured = impulse_response(image, at_m)
    places = [float(axis.index_of(measured[f"position_{axis.name}_m"])) for axis in image.axes]
    firsts = [max(0, min(round(p) - _REACH, axis.n - 2 * _REACH)) for p, axis in zip(places, image.axes)]
    patch = image.data[firsts[0] : firsts[0] + 2 * _REACH, firsts[1] : firsts[1] + 2 * _REACH].to(torch.complex128)
    tones = [_centre_turns(patch, dim) for dim in (0, 1)]
    local = [p - first for p, first in zip(places, firsts)]
    cuts: dict[str, tuple[Tensor, Tensor]] = {}
    for dim, axis in enumerate(image.axes):
        other = 1 - dim
        through = _kernel(torch.tensor([local[other]], dtype=torch.float64), patch.shape[other], tones[other])[0]
        line = (patch * (through[None, :] if dim == 0 else through[:, None])).sum(other)
        offsets = torch.arange(-(_REACH - 8) * _FACTOR, (_REACH - 8) * _FACTOR + 1, dtype=torch.float64) / _FACTOR
        cuts[axis.name] = (offsets * axis.step, _kernel(local[dim] + offsets, line.shape[0], tones[dim]) @ line)
    return cuts


def _centre_turns(patch: Tensor, dim: int) -> float:
    """Centre of the spectrum along dim in turns per sample."""
    n = patch.shape[dim]
    return float(torch.angle((patch.narrow(dim, 1, n - 1) * patch.narrow(dim, 0, n - 1).conj()).sum())) / (2 * math.pi)


def _kernel(places: Tensor, n: int, tone: float) -> Tensor:
    """Weights (place, n) that read a band about `tone` at fractional places."""
    distance = places[:, None] - torch.arange(n, dtype=torch.float64)
    return torch.sinc(distance) * cis(2 * math.pi * tone * distance)
