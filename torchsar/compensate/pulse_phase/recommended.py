"""The recommended estimate of a phase per pulse."""

from __future__ import annotations

from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, Wiener, fixed_point, in_turn
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate

_FLOOR = 2.5
_RELAXATION = 1.8


def autofocus(
    data: Tensor,
    *,
    start: Tensor | None = None,
    search: int = 120,
    polish: int = 20,
    search_tolerance_rad: float = 0.01,
    tolerance_rad: float = 1e-3,
    imaging: Imaging | None = None,
) -> Estimate:
    """The recommended autofocus, with value["phase_rad"] (..., pulse) to be removed. data: (..., pulse, range) complex, range-compressed and aligned.

    Adjacent pulses (`sca`), then the entropy fixed point with one low floor until a trial stands still (at most `search` iterations: hard cases
    of low SNR use them), then at most `polish` iterations against a Wiener estimate of the scene on an image of twice as many cells, which lowers the floor
    that the entropy leaves by half and more. start: (..., pulse) rad, by default that of `sca`, with which the result is equivariant: any phase
    per pulse is removed, whatever its size. imaging: the image formation to sharpen, see `entropy_fixed_point`. std: from even against odd range
    cells, close to the true error on targets of points. ok is False for noise, for images no sharper than noise can be made, and for one row alone.
    Raises TypeError or ValueError for samples that are not finite and complex, or a start of another shape.
    """
    pulses = prepare(data, "autofocus")
    if search < 0 or polish < 0:
        raise ValueError(f"autofocus needs numbers of iterations of 0 or more, got search={search} and polish={polish}")
    coarse, fine = (AlongPulses(), AlongPulses(2)) if imaging is None else (Through(imaging), Through(imaging))
    runs = [Run(LogAbove(_FLOOR), coarse, search, _RELAXATION, search_tolerance_rad), Run(Wiener(), fine, polish, 1.0, tolerance_rad)]
    again = Run(Wiener(), AlongPulses(2), 6, 1.0, tolerance_rad)

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> Found:
        phase, taken = in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)
        return phase, taken, lambda some, _, at: fixed_point(some, at, again)[0]

    return estimated(pulses, starting_phase(start, pulses, "autofocus"), find, at_rest=True)
