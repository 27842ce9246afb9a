"""Phases between adjacent pulses, and their sums.

The phase between two pulses is that of the product of one with the conjugate of the other, summed
over range.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import safe_angle


def pair_phase(rows: Tensor, present: Tensor) -> Tensor:
    """Estimate the phase of each pulse by adding up the phases between successive pulses.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The phases in rad, shape (trial, pulse); that of the first pulse is 0.
    """
    return running_sum(pair_products(rows, present))


def pair_products(rows: Tensor, present: Tensor) -> Tensor:
    """Sum over range the product of each pulse and the conjugate of the pulse before it.

    Pulses without samples are skipped: the next pulse that holds samples is paired with the last
    one that does.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The products, shape (trial, pulse - 1), complex; zero for a pulse without samples.
    """
    if present.device.type == "cpu" and bool(present.all()):
        return (rows[..., 1:] * rows[..., :-1].conj()).sum(-2)
    # the last earlier pulse that holds samples; 0 where there is none
    index = torch.arange(present.shape[-1], device=present.device)
    before = torch.where(present, index, 0).cummax(-1).values[:, :-1]
    return torch.where(
        present[:, 1:],
        (rows[..., 1:] * rows.gather(-1, before[:, None, :].expand(-1, rows.shape[-2], -1)).conj()).sum(-2),
        0,
    )


def running_sum(products: Tensor) -> Tensor:
    """Add up the phases of products of successive pulses, in float64.

    Args:
        products: Product of each pulse but the first with the conjugate of the pulse before it,
            shape (trial, pulse - 1), complex.

    Returns:
        The phase of every pulse in rad, shape (trial, pulse); that of the first pulse is 0.
    """
    steps = safe_angle(products)
    total = steps.to(torch.float64).cumsum(-1).to(steps.dtype)
    return torch.cat([torch.zeros_like(total[..., :1]), total], -1)
