"""Spatial correlation algorithm (SCA), an autofocus by the phases between adjacent pulses.

The phase between two pulses is that of the product of one with the conjugate of the other, summed
over range.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, safe_angle
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate


def sca(data: Tensor) -> Estimate:
    """Estimate the phase of each pulse from the products of adjacent pulses.

    The phase between two adjacent pulses is that of the product of one with the conjugate of the
    other, summed over range. The phases between adjacent pulses are added up. The compensated data
    are data * exp(-j phase_rad)[..., None]. If a phase a[k] is added to pulse k of the data, the
    estimate grows by exactly a[k], up to a constant, so the size of the phase error has no effect.
    Noise and the scene limit the accuracy; a scene of many scatterers per range cell leaves an
    error of about 1.2 rad. Differentiable.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with a standard deviation from two halves
        of the range cells. At a pulse of zeros the phase stays that of the pulse before; the next
        pulse is paired with the last one that holds samples. `ok` is False unless the image is 1.5
        times as sharp as autofocus can make pure noise, more than one range cell contributes to the
        sharpness, and the Strehl ratio predicted from the standard deviation exceeds 0.8. Sharpness
        is the amount by which the image entropy lies below that of speckle.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite.

    Reference:
        Ruan et al. 2013, Eqs. (4)-(6).
    """

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> Found:
        return (
            pair_phase(rows, present),
            torch.ones_like(present[:, 0], dtype=torch.int64),
            lambda some, there, _: pair_phase(some, there),
        )

    return estimated(prepare(data, "sca"), None, find, at_rest=True)


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
    if bool(present.all()):
        return (rows[..., 1:] * rows[..., :-1].conj()).sum(-2)
    before = previous_present(present)
    return torch.where(
        present[:, 1:],
        (rows[..., 1:] * rows.gather(-1, before[:, None, :].expand(-1, rows.shape[-2], -1)).conj()).sum(-2),
        0,
    )


def previous_present(present: Tensor) -> Tensor:
    """Find, for each pulse after the first, the last earlier pulse that holds samples.

    Args:
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The index of that pulse, shape (trial, pulse - 1); 0 where there is none.
    """
    index = torch.arange(present.shape[-1], device=present.device)
    return torch.where(present, index, 0).cummax(-1).values[:, :-1]


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
