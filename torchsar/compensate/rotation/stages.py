"""Estimators of uneven rotation as stages, and the uniform autofocus of a target that turns
unevenly.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, rotate, starting_phase
from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, Wiener, in_turn
from torchsar.compensate.rotation.motion import SEARCH_EPS
from torchsar.compensate.rotation.recommended import coarse_rotation, phase_fit_rotation, uneven_rotation
from torchsar.compensate.rotation.scatterers import ROUNDS
from torchsar.compensate.rotation.unknowns import k_name
from torchsar.core import Estimate, Signal, Stage
from torchsar.focus.matched_fourier import MatchedFourierOperator, range_phase
from torchsar.metrics import entropy
from torchsar.radar import InverseRadar

_FLOOR, _RELAXATION = 2.0, 1.8  # of the entropy fixed point, as in `autofocus`
_SEARCH_TOLERANCE_RAD, _TOLERANCE_RAD = 0.01, 1e-3


class _Rotation(Stage):
    """yc_m: the known range centre deviation (m), or None to estimate it; a connected value goes
    before it.
    """

    def __init__(self, radar: InverseRadar, order: int, yc_m: float | None) -> None:
        super().__init__()
        if order < 1:
            raise ValueError(f"a rotation needs an order of 1 (even) or more, got {order}")
        self.radar, self.order, self.yc_m = radar, order, yc_m
        self.provides = ("omega_rad_s", "warp_k", "yc_m", *(k_name(i) for i in range(1, order)))

    def told(self, signal: Signal, yc_m: Tensor | None) -> dict[str, Any]:
        """What the function is told about the signal."""
        place = signal.axis("range").values(signal.data.device)
        centre = self.yc_m if yc_m is None else yc_m
        return {
            "wavelength_m": self.radar.wavelength_m,
            "prf_hz": 1 / signal.axis("pulse").step,
            "range_m": place,
            "order": self.order,
            "yc_m": centre,
        }


class UnevenRotation(_Rotation):
    """`uneven_rotation`, the recommended estimator.

    scatterers, rounds: what it may spend, see there.
    """

    def __init__(
        self,
        radar: InverseRadar,
        order: int = 3,
        yc_m: float | None = None,
        scatterers: int | None = None,
        rounds: int = ROUNDS,
    ) -> None:
        super().__init__(radar, order, yc_m)
        self.scatterers, self.rounds = scatterers, rounds

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        return uneven_rotation(signal.data, **self.told(signal, yc_m), scatterers=self.scatterers, rounds=self.rounds)


class CoarseRotation(_Rotation):
    """`coarse_rotation`: k1 and k2 from sections of the aperture, without a rate."""

    def __init__(self, radar: InverseRadar, order: int = 3) -> None:
        super().__init__(radar, order, None)

    def forward(self, signal: Signal) -> Estimate:
        return coarse_rotation(signal.data, **self.told(signal, None))


class PhaseFitRotation(_Rotation):
    """`phase_fit_rotation`: coarse, then phase least squares of bright scatterers."""

    def __init__(
        self, radar: InverseRadar, order: int = 3, yc_m: float | None = None, steps: int = 4, half_cells: int = 24
    ) -> None:
        super().__init__(radar, order, yc_m)
        self.steps, self.half_cells = steps, half_cells

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        return phase_fit_rotation(signal.data, **self.told(signal, yc_m), steps=self.steps, half_cells=self.half_cells)


class RotationAutofocus(Stage):
    """A phase per pulse that all scatterers share, sharpened on the image with the rotation taken
    out; by `autofocus` where no rotation is connected yet.

    Connected: omega_rad_s, warp_k, yc_m, and phase_rad (..., pulse) to start from. search, polish:
    iterations of the entropy fixed point and of the Wiener estimate. A phase that is free in every
    pulse takes all of the range centre deviation with it: fix yc in estimators that take turns with
    this one.
    """

    provides = ("phase_rad",)

    def __init__(self, radar: InverseRadar, search: int = 60, polish: int = 20) -> None:
        super().__init__()
        self.radar, self.search, self.polish = radar, search, polish

    def forward(
        self,
        signal: Signal,
        phase_rad: Tensor | None = None,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        if warp_k is None:
            return autofocus(signal.data, start=phase_rad)
        prf_hz, data = 1 / signal.axis("pulse").step, signal.data
        if omega_rad_s is not None:
            data = range_phase(
                data,
                signal.axis("range").values(data.device),
                self.radar.wavelength_m,
                prf_hz,
                omega_rad_s,
                warp_k,
                0.0 if yc_m is None else yc_m,
            )
        k = warp_k.expand(*signal.trials, warp_k.shape[-1]).reshape(-1, warp_k.shape[-1])
        return rotating_autofocus(data, prf_hz, k, phase_rad, self.search, self.polish)


def rotating_autofocus(
    data: Tensor, prf_hz: float, warp_k: Tensor, start: Tensor | None = None, search: int = 60, polish: int = 20
) -> Estimate:
    """Phase per pulse (..., pulse) of data (..., pulse, range) without its range term, judged by
    the matched Fourier transform with warp_k (trial, order - 1).

    start: (..., pulse) rad, by default that of adjacent pulses. quality: by which share the cells
    that the image fills fall; ok: they do not grow.
    """
    pulses = prepare(data, "rotating_autofocus")
    through = Through(
        MatchedFourierOperator(warp_k, pulses.n, prf_hz, dtype=data.dtype, oversampling=1.0, eps=SEARCH_EPS)
    )
    begin = starting_phase(start, pulses, "rotating_autofocus")
    begin = pair_phase(pulses.rows, pulses.present) if begin is None else begin
    runs = [
        Run(LogAbove(_FLOOR), through, search, _RELAXATION, _SEARCH_TOLERANCE_RAD),
        Run(Wiener(), through, polish, 1.0, _TOLERANCE_RAD),
    ]
    with torch.no_grad():
        phase, taken = in_turn(pulses.rows, begin, runs)
        before, after = (entropy(through.image(x)) for x in (pulses.rows, rotate(pulses.rows, phase)))
    quality = (1 - torch.exp(after - before)).clamp(0, 1)
    value = {"phase_rad": phase.reshape(*pulses.trials, pulses.n)}
    return Estimate(
        value,
        quality.reshape(pulses.trials),
        (after <= before).reshape(pulses.trials),
        info={"iterations": taken.reshape(pulses.trials)},
    )
