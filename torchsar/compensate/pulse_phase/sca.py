"""Spatial correlation algorithm (SCA), an autofocus by the phases between adjacent pulses."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import find_phases, prepare
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.core import Estimate


def sca(data: Tensor, *, assess: bool = True) -> Estimate:
    r"""Estimate the phase of each pulse from the products of adjacent pulses.

    >>> import torch
    >>> from torchsar.compensate import sca
    >>> phase = torch.tensor([0.0, 1.0, 3.0, 2.0])
    >>> point = torch.exp(1j * phase)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    >>> sca(point, assess=False)["phase_rad"]
    tensor([0., 1., 3., 2.])

    The phase between two adjacent pulses is that of the product of one with the conjugate of the
    other, summed over range, :math:`\arg \sum_n s_{k,n} s_{k-1,n}^*`; these phases are added up.
    The compensated data are data * exp(-j phase_rad)[..., None]. If a phase a[k] is added to pulse
    k of the data, the estimate grows by exactly a[k], up to a constant, so that the size of the
    phase errors has no effect. Noise and the scene limit the accuracy; a scene of many scatterers
    per range cell leaves an error of about 1.2 rad. Differentiable.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        assess: Whether to add the standard deviation and the outcome, which takes many times as
            long as the estimate.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, from 0 at the first pulse. At a pulse of
        zeros the phase stays that of the pulse before; the next pulse is paired with the last one
        that holds samples. With `assess`, standard deviation, quality, outcome and info as by
        `autofocus`; the error that the scene causes is seen because further iterations move the
        phases.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite.

    Reference:
        Ruan et al. 2013, Eqs. (4)-(6).
    """

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> tuple[Tensor, Tensor]:
        return pair_phase(rows, present), torch.ones_like(present[:, 0], dtype=torch.int64)

    pulses = prepare(data, "sca")
    return conclude(pulses, *find_phases(pulses, find), assess)
