"""Stages that estimate the non-uniform rotation of a target, and autofocus of such a target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase import autofocus
from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import find_phases, prepare, refuse_odd_counts, starting_phase
from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, Wiener, fixed_point, in_turn
from torchsar.compensate.rotation.histories import HALF_CELLS
from torchsar.compensate.rotation.motion import SEARCH_EPS
from torchsar.compensate.rotation.recommended import HISTORY_STEPS, coarse_rotation, phase_fit_rotation, uneven_rotation
from torchsar.compensate.rotation.scatterers import ROUNDS
from torchsar.compensate.rotation.unknowns import k_name, uniform_rotation
from torchsar.core import Estimate, Signal, Stage
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import MatchedFourierOperator, range_phase
from torchsar.focus.transforms import Gridding
from torchsar.radar import InverseRadar


class _Rotation(Stage):
    """An estimator of the rotation; a connected yc_m takes precedence over its own.

    yc_m: the range centre deviation (m) known a priori, or None to estimate it.
    """

    def __init__(
        self,
        radar: InverseRadar,
        order: int,
        yc_m: float | None,
        find: Callable[..., Estimate],
        **options: Any,
    ) -> None:
        super().__init__()
        if order < 1:
            raise ValueError(f"order of the rotation must be 1 (uniform rotation) or more, got {order}")
        self.radar, self.order, self.yc_m, self.find, self.options = radar, order, yc_m, find, options
        self.provides = ("omega_rad_s", "warp_k", "yc_m", *(k_name(i) for i in range(1, order)))
        self.neutral = uniform_rotation(radar, self.provides, yc_m)

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        """Estimate the rotation from a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), known a priori, shape (...,).

        Returns:
            The `Estimate` of the function that the description of the stage names.
        """
        return self.find(
            signal.data,
            wavelength_m=self.radar.wavelength_m,
            prf_hz=1 / signal.axis("pulse").step,
            range_m=signal.axis("range").values(torch.device("cpu")),  # only their spacing is read, by the host
            order=self.order,
            yc_m=self.yc_m if yc_m is None else yc_m,
            **self.options,
        )


class UnevenRotation(_Rotation):
    """Non-uniform rotation by the recommended estimator; see `uneven_rotation`.

    Provides `omega_rad_s` (rotation rate at the first pulse), `warp_k` (its relative derivatives)
    with its entries `k1_per_s`, `k2_per_s2`, ..., and `yc_m` (range centre deviation).

    Args:
        radar: Radar parameters.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori; None estimates it.
        scatterers: Largest number of scatterers that are fitted, by default as in
            `uneven_rotation`.
        rounds: Largest number of maximum-likelihood steps.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If the order is below 1.
    """

    def __init__(
        self,
        radar: InverseRadar,
        order: int = 3,
        yc_m: float | None = None,
        scatterers: int | None = None,
        rounds: int = ROUNDS,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, order, yc_m, uneven_rotation, scatterers=scatterers, rounds=rounds, assess=assess)


class CoarseRotation(_Rotation):
    """Relative derivatives k1 and k2 of the rotation rate, without the rate; see `coarse_rotation`.

    They are found from the Doppler spectra of short sections of the aperture.

    Args:
        radar: Radar parameters.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If the order is below 1.
    """

    def __init__(self, radar: InverseRadar, order: int = 3, assess: bool = True) -> None:
        super().__init__(radar, order, None, coarse_rotation, assess=assess)


class PhaseFitRotation(_Rotation):
    """Non-uniform rotation from the phase histories of bright scatterers; see `phase_fit_rotation`.

    Args:
        radar: Radar parameters.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori; None estimates it.
        steps: Number of times that the least-squares fit to the phase histories is repeated.
        half_cells: Half width of the windows about scatterers in Doppler cells.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If the order is below 1.
    """

    def __init__(
        self,
        radar: InverseRadar,
        order: int = 3,
        yc_m: float | None = None,
        steps: int = HISTORY_STEPS,
        half_cells: int = HALF_CELLS,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, order, yc_m, phase_fit_rotation, steps=steps, half_cells=half_cells, assess=assess)


class RotationAutofocus(Stage):
    """Phase error of each pulse of a rotating target, common to all its scatterers.

    Provides `phase_rad`. If another stage provides `warp_k`, the phases are found by
    `rotating_autofocus`, otherwise by `autofocus`.

    The phase of every pulse is free and therefore also takes up the effect of the range centre
    deviation yc. If an estimator of the rotation alternates with this stage, give it a fixed yc.

    Args:
        radar: Radar parameters.
        search: Largest number of fixed-point iterations that minimise the image entropy, with and
            without a rotation.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: False leaves out the assessment.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}

    def __init__(self, radar: InverseRadar, search: int = 60, polish: int = 20, assess: bool = True) -> None:
        super().__init__()
        self.radar, self.search, self.polish, self.assess = radar, search, polish, assess

    def forward(
        self,
        signal: Signal,
        phase_rad: Tensor | None = None,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            phase_rad: Phase to start from in rad, shape (..., pulse).
            omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,); without it the
                phase that depends on the range of a scatterer is not compensated.
            warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
                1/s^2, ..., shape (..., order - 1).
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), shape (...,); by default 0.

        Returns:
            `phase_rad` of shape (..., pulse), to be removed: the estimate of `rotating_autofocus`,
            or of `autofocus` if `warp_k` is None.

        Raises:
            TypeError: If the data are not complex or the start is not a tensor.
            ValueError: As from the two functions.
        """
        options = {"search": self.search, "polish": self.polish, "assess": self.assess}
        if warp_k is None:
            return autofocus(signal.data, start=phase_rad, **options)
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
        return rotating_autofocus(data, prf_hz, k, phase_rad, **options)


def rotating_autofocus(
    data: Tensor,
    prf_hz: float,
    warp_k: Tensor,
    start: Tensor | None = None,
    search: int = 60,
    polish: int = 20,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase error of each pulse of a target whose non-uniform rotation is known.

    The phases are those with which the image, formed by the matched Fourier transform for this
    rotation, is sharpest.

    Args:
        data: Range-compressed pulses from which `range_phase` has removed the phase that depends on
            the range of a scatterer, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
            1/s^2, ..., shape (trial, order - 1), with all trial dimensions of the data as one.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`): the phases
            between adjacent pulses, added up.
        search: Largest number of fixed-point iterations that minimise the image entropy.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: False leaves out the assessment.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation, quality and
        info as from `autofocus`. Outcomes: EMPTY, SINGULAR, NOISE if the image is less than 1.5
        times as sharp as autofocus makes noise, and INEXACT if the Strehl ratio predicted from the
        standard deviation is below 0.8.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a number of iterations is not a whole number of 0 or more.
    """
    pulses = prepare(data, "rotating_autofocus", empty=False)
    refuse_odd_counts("rotating_autofocus", 0, search=search, polish=polish)
    through = Through(
        MatchedFourierOperator(
            warp_k, pulses.n, prf_hz, dtype=data.dtype, lines=DopplerLines(1.0), transform=Gridding(eps=SEARCH_EPS)
        )
    )
    # the last floor of `entropy_fixed_point` and the relaxation of `autofocus`
    runs = [Run(LogAbove(2.0), through, search, 1.8, 0.01), Run(Wiener(), through, polish, 1.0, 1e-3)]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)

    def continued(rows: Tensor, which: Tensor | slice, at: Tensor) -> Tensor:
        return fixed_point(rows, at, replace(runs[1], iterations=6))[0]

    with torch.no_grad():
        begin = starting_phase(start, pulses, "rotating_autofocus")
        return conclude(pulses, *find_phases(pulses, find, begin, whole=True), assess, continued, through)
