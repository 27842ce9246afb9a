"""Phase of every pulse by fixed-point iterations that lower the entropy of the image."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import find_phases, prepare, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, in_turn
from torchsar.core import Estimate


def entropy_fixed_point(
    data: Tensor,
    *,
    start: Tensor | None = None,
    floors: Sequence[tuple[Tensor | float, int]] = ((5.0, 12), (2.0, 12)),
    relaxation: Tensor | float = 1.8,
    tolerance_rad: float = 1e-3,
    imaging: Imaging | None = None,
    assess: bool = True,
) -> Estimate:
    r"""Estimate the phase of each pulse by a fixed-point iteration that lowers the image entropy.

    >>> import torch
    >>> from torchsar.compensate import entropy_fixed_point
    >>> points = torch.eye(8, dtype=torch.complex64).repeat(4, 1)  # of 32 pulses, 8 range cells
    >>> entropy_fixed_point(points, assess=False)["phase_rad"].shape
    torch.Size([32])

    Each iteration forms the image and weights its cells with ln(max(p, floor) / floor), where p is
    the power of a cell over the mean power. It transforms the weighted image back to pulses and
    takes the phase of each pulse relative to the result. An iteration takes two transforms and,
    unlike PGA, needs no peaks and no windows. Differentiable, also in the floors and the
    relaxation, which may be tensors of one number.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`). With this default the size of the phase errors
            has no effect on the result.
        floors: Pairs (floor, largest number of iterations), used one after another. A floor is a
            multiple of the mean power. A trial proceeds to the next pair once its phase steps are
            below `tolerance_rad`.
        relaxation: Factor applied to the phase step. Above 1 it helps to pass local minima; at 2 or
            more the iteration need not converge.
        tolerance_rad: Phase step in rad, rms over the pulses, below which a trial ends its
            iterations with a floor.
        imaging: Image formation whose image is sharpened, by default a Fourier transform along
            pulses; any object with the methods `image` and `adjoint` for profiles of shape (...,
            pulse, range), such as `torchsar.focus.PolarOperator`.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a floor, an iteration count or the relaxation is invalid.
    """
    pulses = prepare(data, "entropy_fixed_point")
    if not floors or not all(floor > 0 and count >= 1 for floor, count in floors) or not 0 < relaxation < 2:
        raise ValueError(
            "entropy_fixed_point: floors must be pairs of a floor above 0 and a number of iterations of 1 or more, "
            f"and relaxation must lie between 0 and 2, got floors {list(floors)} and relaxation {relaxation}"
        )
    through = None if imaging is None else Through(imaging)
    operator = AlongPulses() if through is None else through
    runs = [Run(LogAbove(floor), operator, count, relaxation, tolerance_rad) for floor, count in floors]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)

    begin = starting_phase(start, pulses, "entropy_fixed_point")
    tuned = (relaxation, *(floor for floor, _ in floors))
    found = find_phases(pulses, find, begin, tuned, through is not None)
    return conclude(pulses, *found, assess, through=through)
