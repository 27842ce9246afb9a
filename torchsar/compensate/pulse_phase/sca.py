"""Spatial correlation algorithm (SCA), an autofocus by the phases between adjacent pulses."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import settled
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
        `phase_rad` of shape (..., pulse), to be removed. Its standard deviation is the larger of
        that from two halves of the range cells and the distance by which four iterations of the
        entropy fixed point move the phases, because the scene causes the same error in both halves.
        At a pulse of zeros the phase stays that of the pulse before; the next pulse is paired with
        the last one that holds samples. `ok` is False unless the image is 1.5 times as sharp as
        autofocus can make pure noise, more than one range cell or a single point makes the
        sharpness, the pulses show one scene (see `autofocus`), and the Strehl ratio predicted from
        the standard deviation exceeds 0.8. Sharpness is the amount by which the image entropy lies
        below that of speckle.

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
            settled,
        )

    return estimated(prepare(data, "sca"), None, find)
