"""Shear-average (SCA) estimate: the phase between adjacent pulses, summed over range."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, safe_angle
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate


def sca(data: Tensor) -> Estimate:
    """Phase of each pulse from products of adjacent pulses (Ruan et al. 2013, Eqs.

    4-6), with value["phase_rad"] (..., pulse) to be removed.

    data: (..., pulse, range) complex, range-compressed and aligned; the compensated data are data *
    exp(-j phase_rad)[..., None]. Exactly equivariant: on data * exp(j a) the estimate is larger by
    a, up to a constant, whatever a is, so that the severity of the error is of no account. Its own
    error comes from the scene (about 1.2 rad for a target of many scatterers a row) and from noise.
    A pulse of zeros is bridged by the product of its neighbours and keeps the phase of the one
    before. Differentiable. ok is False for noise. std: from two halves of the rows. Raises
    TypeError or ValueError for what are no finite complex samples.
    """

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> Found:
        return (
            pair_phase(rows, present),
            torch.ones_like(present[:, 0], dtype=torch.int64),
            lambda some, there, _: pair_phase(some, there),
        )

    return estimated(prepare(data, "sca"), None, find, at_rest=True)


def pair_phase(rows: Tensor, present: Tensor) -> Tensor:
    """Running sum of the phases between pulses that follow each other, (trial, pulse) from rows
    (trial, range, pulse).
    """
    return running_sum(pair_products(rows, present))


def pair_products(rows: Tensor, present: Tensor) -> Tensor:
    """Sum over range of s[k] conj(s[the pulse before k that is there]), (trial, pulse - 1) complex;
    zero for a pulse that is not.
    """
    if bool(present.all()):
        return (rows[..., 1:] * rows[..., :-1].conj()).sum(-2)
    before = previous_present(present)
    return torch.where(
        present[:, 1:],
        (rows[..., 1:] * rows.gather(-1, before[:, None, :].expand(-1, rows.shape[-2], -1)).conj()).sum(-2),
        0,
    )


def previous_present(present: Tensor) -> Tensor:
    """Index of the last pulse with samples before each pulse but the first (0 where there is none),
    (trial, pulse - 1).
    """
    index = torch.arange(present.shape[-1], device=present.device)
    return torch.where(present, index, 0).cummax(-1).values[:, :-1]


def running_sum(products: Tensor) -> Tensor:
    """Phase of every pulse from the products with the one before, summed in float64; the first has
    0. (trial, pulse).
    """
    steps = safe_angle(products)
    total = steps.to(torch.float64).cumsum(-1).to(steps.dtype)
    return torch.cat([torch.zeros_like(total[..., :1]), total], -1)
