"""The recommended estimate of a phase per pulse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, refuse_odd_counts, rotate, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, Wiener, fixed_point, in_turn, settled
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate
from torchsar.metrics import entropy

_FLOOR = 2.5
_FIRST_FLOOR, _FIRST_ITERATIONS = 5.0, 6
_RELAXATION = 1.8
_SLOPES = 48


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
    """The recommended autofocus, with value["phase_rad"] (..., pulse) to be removed.

    data: (..., pulse, range) complex, range-compressed and aligned.

    Adjacent pulses (`sca`), then the entropy fixed point with one low floor (for six iterations a
    higher one, where noise is weak) until a trial stands still (at most about `search` iterations:
    hard cases of low SNR use them), then at most `polish` iterations against a Wiener estimate of
    the scene on an image of twice as many cells, which lowers the floor that the entropy leaves by
    half and more. start: (..., pulse) rad, by default that of `sca`, with which the result is
    equivariant: any phase per pulse is removed, whatever its size.

    imaging: an image formation in which scatterers keep still where they migrate through range
    cells here, see `entropy_fixed_point`. It tells the slope of the phase over pulses as well,
    since an image in a wrong place migrates wrongly: after the steps above, 48 slopes over one turn
    a pulse are tried, the best refined, and both kinds of iterations run through `imaging`. Its
    image must cover the whole unambiguous cross range.

    std: from two halves of the rows, close to the true error on targets of points. ok is False for
    noise, for images no sharper than noise can be made, and for one row alone. Differentiable
    without `imaging`. Raises TypeError or ValueError for samples that are not finite and complex,
    or a start of another shape.
    """
    pulses = prepare(data, "autofocus")
    refuse_odd_counts("autofocus", 0, search=search, polish=polish)
    again = Run(Wiener(), AlongPulses(2), 6, 1.0, tolerance_rad)

    def runs(coarse: Imaging, fine: Imaging) -> list[Run]:
        return [
            Run(LogAbove(_FLOOR), coarse, search, _RELAXATION, search_tolerance_rad),
            Run(Wiener(), fine, polish, 1.0, tolerance_rad),
        ]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> Found:
        first = Run(
            LogAbove(_first_floor(rows)),
            AlongPulses(),
            min(search, _FIRST_ITERATIONS),
            _RELAXATION,
            search_tolerance_rad,
        )
        phase, taken = in_turn(
            rows, pair_phase(rows, present) if begin is None else begin, [first, *runs(AlongPulses(), AlongPulses(2))]
        )
        if imaging is not None:
            through = Through(imaging)
            phase, more = _Placed(through, runs(through, through))(rows, phase)
            taken = taken + more
        return phase, taken, (lambda some, _, at: fixed_point(some, at, again)[0]) if polish else settled

    return estimated(pulses, starting_phase(start, pulses, "autofocus"), find, at_rest=True)


def _first_floor(rows: Tensor) -> Tensor:
    """Floor of the first iterations, (trial, 1, 1): higher where less than half of the range cells
    hold the energy, that is little of it is noise.

    From there, a low floor ends in a wrong minimum in one scene of two hundred; in much noise, a
    high one hides the target.
    """
    energy = (rows.detach().real.square() + rows.detach().imag.square()).sum(-1)
    share = energy / energy.sum(-1, keepdim=True).clamp_min(torch.finfo(energy.dtype).tiny)
    filled = 1 / share.square().sum(-1).clamp_min(torch.finfo(energy.dtype).tiny) / rows.shape[-2]
    return torch.where(filled < 0.5, _FIRST_FLOOR, _FLOOR)[:, None, None].to(energy.dtype)


@dataclass(frozen=True)
class _Placed:
    """Slope and phase through an image formation in which scatterers do not migrate: the slope over
    a turn, the phase, the slope again, the phase.
    """

    through: Through
    runs: list[Run]

    def __call__(self, rows: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        step = 2 * math.pi / _SLOPES
        phase = self._best_slope(rows, phase, step, _SLOPES)
        total = torch.zeros_like(phase[:, 0], dtype=torch.int64)
        for _ in range(2):
            phase = self._best_slope(rows, phase, step / 8, 17)
            phase, taken = in_turn(rows, phase, self.runs)
            total = total + taken
        return self._best_slope(rows, self._best_slope(rows, phase, step / 8, 17), step / 64, 17), total

    @torch.no_grad()
    def _best_slope(self, rows: Tensor, phase: Tensor, step_rad: float, count: int) -> Tensor:
        """The phase with the one of `count` slopes (rad per pulse) about its own that gives the
        least entropy, per trial.
        """
        n = rows.shape[-1]
        ramp = torch.arange(n, dtype=phase.dtype, device=phase.device) - (n - 1) / 2
        best, least = phase, torch.full_like(phase[:, 0], torch.inf)
        for index in range(count):
            candidate = phase + (index - count // 2) * step_rad * ramp
            cost = entropy(self.through.image(rotate(rows, candidate)))
            better = cost < least
            best, least = torch.where(better[:, None], candidate, best), torch.where(better, cost, least)
        return best
