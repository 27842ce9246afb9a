"""Errors of a phase per pulse, compared as phases must be: on the circle, without what an image
cannot tell.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import unit_phasor

_OVERSAMPLING = 8
_NEWTON = 4


def residual_phase(estimate_rad: Tensor, reference_rad: Tensor, present: Tensor | None = None) -> Tensor:
    """estimate - reference per pulse, in -pi..pi, without the constant and the linear term, (...,
    pulse) float64.

    Both terms only turn and shift an image. They are removed on the circle: the peak of the
    zero-padded spectrum of exp(j difference), then Newton steps; never by unwrapping and fitting a
    line. estimate_rad, reference_rad: (..., pulse), any number of turns, broadcast. present: (...,
    pulse) bool, pulses that count; the residual of the others is zero.
    """
    difference = estimate_rad.to(torch.float64) - reference_rad.to(torch.float64)
    z = unit_phasor(difference / (2 * math.pi), torch.complex128)
    if present is not None:
        z = torch.where(present, z, 0)
    n = z.shape[-1]
    cycles = _peak(z) / n
    k = torch.arange(n, dtype=torch.float64, device=z.device) - (n - 1) / 2
    for _ in range(_NEWTON):
        cycles = cycles + _newton_step(z, cycles, k)
    flat = z * unit_phasor(-cycles[..., None] * k, torch.complex128)
    total = flat.sum(-1, keepdim=True)
    turned = flat * torch.where(total == 0, 1, total).conj()
    return torch.where(z == 0, 0, torch.angle(torch.where(z == 0, 1, turned)))


def _peak(z: Tensor) -> Tensor:
    """Strongest frequency of exp(j difference), in cycles per record, to a fraction of 1 / 8."""
    n = _OVERSAMPLING * z.shape[-1]
    at = torch.fft.fft(z.detach(), n).abs().argmax(-1).to(torch.float64)
    return torch.where(at > n / 2, at - n, at) / _OVERSAMPLING


def _newton_step(z: Tensor, cycles: Tensor, k: Tensor) -> Tensor:
    """One Newton step (cycles per pulse) towards the maximum of |sum z exp(-2j pi cycles k)|^2, at
    most an eighth of a cell.
    """
    turned = z * unit_phasor(-cycles[..., None] * k, torch.complex128)
    w = 2 * math.pi * k
    s0, s1, s2 = turned.sum(-1), (-1j * w * turned).sum(-1), (-w.square() * turned).sum(-1)
    slope = 2 * (s0.conj() * s1).real
    bend = 2 * (s1.abs().square() + (s0.conj() * s2).real)
    step = torch.where(bend < 0, -slope / torch.where(bend < 0, bend, -1), 0)
    limit = 1 / (_OVERSAMPLING * z.shape[-1])
    return step.clamp(-limit, limit)


def phase_rmse(estimate_rad: Tensor, reference_rad: Tensor, present: Tensor | None = None) -> Tensor:
    """Root mean square of `residual_phase` over the pulses that count, rad, (...,) float64.

    White phases have 1.6 to 1.7 rad.
    """
    residual = residual_phase(estimate_rad, reference_rad, present)
    count = residual.shape[-1] if present is None else present.expand(residual.shape).sum(-1).clamp_min(1)
    return (residual.square().sum(-1) / count).sqrt()


def strehl(residual_rad: Tensor) -> Tensor:
    """Strehl ratio |mean exp(j residual)|^2 over pulses, (...,): 1 for none, 0.8 for about 0.47 rad
    rms.
    """
    return unit_phasor(residual_rad.to(torch.float64) / (2 * math.pi), torch.complex128).mean(-1).abs().square()
