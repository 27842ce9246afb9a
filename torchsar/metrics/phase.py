"""Errors of a phase per pulse, without its constant and linear terms."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import refuse_non_finite, unit_phasor
from torchsar.radar.antenna_path import broadcast


def residual_phase(estimate_rad: Tensor, reference_rad: Tensor, present: Tensor | None = None) -> Tensor:
    """Compute the phase error per pulse after removal of its constant and linear terms.

    >>> import torch
    >>> from torchsar import metrics
    >>> line = 1.0 + 0.3 * torch.arange(8.0)
    >>> error = torch.tensor([0.2, -0.2, -0.2, 0.2, 0.2, -0.2, -0.2, 0.2])
    >>> metrics.residual_phase(line + error, torch.zeros(8)).round(decimals=2).tolist()
    [0.2, -0.2, -0.2, 0.2, 0.2, -0.2, -0.2, 0.2]

    Both terms only add a phase to the image and shift it. They are estimated modulo 2 pi, from the
    peak of the zero-padded spectrum of exp(j difference) with Newton steps, not by unwrapping and
    fitting a line.

    Args:
        estimate_rad: Estimated phases, shape (..., pulse), with any number of whole turns.
        reference_rad: True phases, shape (..., pulse), broadcast against the estimate.
        present: Pulses that count, shape (..., pulse), bool; the residual of the others is zero.

    Returns:
        Estimate minus reference in -pi..pi, shape (..., pulse), float64.

    Raises:
        TypeError: If the phases are no real tensors.
        ValueError: If a phase is not finite, there are no phases, or their shapes do not fit.
    """
    _check("residual_phase", estimate_rad, reference_rad)
    difference = estimate_rad.to(torch.float64) - reference_rad.to(torch.float64)
    z = unit_phasor(difference / (2 * math.pi), torch.complex128)
    if present is not None:
        z = torch.where(present, z, 0)
    n = z.shape[-1]
    cycles = _peak(z) / n
    k = torch.arange(n, dtype=torch.float64, device=z.device) - (n - 1) / 2
    for _ in range(4):
        cycles = cycles + _newton_step(z, cycles, k)
    flat = z * unit_phasor(-cycles[..., None] * k, torch.complex128)
    total = flat.sum(-1, keepdim=True)
    turned = flat * torch.where(total == 0, 1, total).conj()
    return torch.where(z == 0, 0, torch.angle(torch.where(z == 0, 1, turned)))


def _check(what: str, *phases: Tensor) -> None:
    """Raise TypeError or ValueError unless phases are finite real tensors (..., pulse) that
    broadcast.
    """
    for phase in phases:
        if not isinstance(phase, Tensor) or not phase.is_floating_point():
            raise TypeError(
                f"{what} compares phases (rad) in real tensors (..., pulse), got "
                f"{phase.dtype if isinstance(phase, Tensor) else type(phase).__name__}"
            )
        if not phase.ndim or not phase.numel():
            raise ValueError(f"{what} needs phases (..., pulse) of at least one pulse, got shape {tuple(phase.shape)}")
        refuse_non_finite(phase, what, "leave out trials without an estimate", "phases")
    shapes = [phase.shape for phase in phases]
    if broadcast(shapes) is None:
        raise ValueError(
            f"{what} needs an estimate and a reference of the same pulses, (..., pulse), got the shapes "
            f"{' and '.join(str(tuple(shape)) for shape in shapes)}"
        )


def _peak(z: Tensor) -> Tensor:
    """Frequency of the largest peak in the spectrum of z, in cycles per record, on a grid of 1/8
    cycle.

    z: phasors of the phase difference.
    """
    n = 8 * z.shape[-1]
    at = torch.fft.fft(z.detach(), n).abs().argmax(-1).to(torch.float64)
    return torch.where(at > n / 2, at - n, at) / 8


def _newton_step(z: Tensor, cycles: Tensor, k: Tensor) -> Tensor:
    """One Newton step (cycles per pulse) to the maximum of |sum z exp(-2j pi cycles k)|^2.

    The step is at most an eighth of a frequency cell.
    """
    turned = z * unit_phasor(-cycles[..., None] * k, torch.complex128)
    w = 2 * math.pi * k
    s0, s1, s2 = turned.sum(-1), (-1j * w * turned).sum(-1), (-w.square() * turned).sum(-1)
    slope = 2 * (s0.conj() * s1).real
    bend = 2 * (s1.abs().square() + (s0.conj() * s2).real)
    step = torch.where(bend < 0, -slope / torch.where(bend < 0, bend, -1), 0)
    limit = 1 / (8 * z.shape[-1])
    return step.clamp(-limit, limit)


def phase_rmse(estimate_rad: Tensor, reference_rad: Tensor, present: Tensor | None = None) -> Tensor:
    """Compute the rms phase error over the pulses, without its constant and linear terms.

    >>> import torch
    >>> from torchsar import metrics
    >>> line = 1.0 + 0.3 * torch.arange(8.0)
    >>> error = torch.tensor([0.2, -0.2, -0.2, 0.2, 0.2, -0.2, -0.2, 0.2])
    >>> round(float(metrics.phase_rmse(line + error, torch.zeros(8))), 3)
    0.2

    Both terms only add a phase to the image and shift it; see `residual_phase`. Estimates that have
    nothing to do with the truth give 1.6 to 1.7 rad.

    Args:
        estimate_rad: Estimated phases, shape (..., pulse).
        reference_rad: True phases, shape (..., pulse).
        present: Pulses that count, shape (..., pulse), bool.

    Returns:
        Rms error in rad, shape (...,), float64.

    Raises:
        TypeError: If the phases are no real tensors.
        ValueError: If a phase is not finite, there are no phases, or their shapes do not fit.
    """
    residual = residual_phase(estimate_rad, reference_rad, present)
    count = residual.shape[-1] if present is None else present.expand(residual.shape).sum(-1).clamp_min(1)
    return (residual.square().sum(-1) / count).sqrt()


def strehl(residual_rad: Tensor, present: Tensor | None = None) -> Tensor:
    """Compute the Strehl ratio |mean exp(j residual)|^2 over pulses.

    >>> import torch
    >>> from torchsar import metrics
    >>> residual = torch.tensor([0.2, -0.2]).repeat(32)
    >>> round(float(metrics.strehl(residual)), 3)  # cos(0.2) ** 2
    0.961

    Args:
        residual_rad: Residual phase errors in radians, shape (..., pulse).
        present: False for pulses that do not count, bool, broadcastable to the phases; None if all
            pulses count.

    Returns:
        Strehl ratio, shape (...,), float64: 1 without error, 0.8 for about 0.47 rad rms; 0 where
        no pulse counts.

    Raises:
        TypeError: If the phases are no real tensor.
        ValueError: If a phase is not finite, or there are no phases.
    """
    _check("strehl", residual_rad)
    phasor = unit_phasor(residual_rad.to(torch.float64) / (2 * math.pi), torch.complex128)
    if present is None:
        return phasor.mean(-1).abs().square()
    return (torch.where(present, phasor, 0).sum(-1).abs() / present.sum(-1).clamp_min(1)).square()
