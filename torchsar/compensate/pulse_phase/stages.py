"""The autofocus family as stages: estimators of `phase_rad` that leave the signal alone, and the
corrector that takes it out.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import on_the_circle, rotate
from torchsar.compensate.pulse_phase.descent import sharpest_phase
from torchsar.compensate.pulse_phase.gradient import Kernel, Listed, Measured, Shrinking, Windows, pga, pga_sca
from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.compensate.pulse_phase.pairs import sca
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.sharpen import entropy_fixed_point
from torchsar.core import Estimate, Signal, Stage, real_dtype, refuse_non_finite


def correct_pulse_phase(data: Tensor, phase_rad: Tensor) -> Tensor:
    """data * exp(-j phase).

    data: (..., pulse, range) complex; phase_rad: (..., pulse) or (pulse,), whole turns of which are
    dropped in float64.

    Differentiable in both (Ruan et al. 2013, text after Eq. 6). Raises ValueError where there is
    not one phase a pulse.
    """
    if not isinstance(phase_rad, Tensor) or phase_rad.shape[-1:] != data.shape[-2:-1]:
        got = tuple(phase_rad.shape) if isinstance(phase_rad, Tensor) else type(phase_rad).__name__
        raise ValueError(
            f"correct_pulse_phase needs a tensor of one phase per pulse, (..., {data.shape[-2]}), got {got}"
        )
    refuse_non_finite(phase_rad, "correct_pulse_phase")
    return rotate(data.mT, on_the_circle(phase_rad.to(torch.float64)).to(real_dtype(data.dtype))).mT


class CorrectPulsePhase(Stage):
    """Takes a phase per pulse out of the data; the value `phase_rad` (..., pulse) comes from an
    estimator before it.
    """

    def forward(self, signal: Signal, phase_rad: Tensor) -> Signal:
        return signal.with_data(correct_pulse_phase(signal.data, phase_rad).contiguous())


class Sca(Stage):
    """`sca`: phases between adjacent pulses, summed over range."""

    provides = ("phase_rad",)

    def forward(self, signal: Signal) -> Estimate:
        return sca(signal.data)


def windows_of(windows: Literal["shrinking", "measured"] | list[float]) -> Windows:
    """A window schedule by name, or a list of widths in cells."""
    if isinstance(windows, str):
        return {"shrinking": Shrinking, "measured": Measured}[windows]()
    return Listed(tuple(windows))


class Pga(Stage):
    """`pga`: phase gradient autofocus from the data as they are, or from the value `start` (...,
    pulse) where one is connected.
    """

    provides = ("phase_rad",)

    def __init__(
        self,
        kernel: Kernel = "lumv",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
    ) -> None:
        super().__init__()
        self.kernel: Kernel = kernel
        self.windows, self.iterations, self.patience = windows_of(windows), iterations, patience

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        return pga(
            signal.data,
            kernel=self.kernel,
            start=start,
            windows=self.windows,
            iterations=self.iterations,
            patience=self.patience,
        )


class PgaSca(Pga):
    """`pga_sca`: phase gradient autofocus started from SCA."""

    def __init__(
        self,
        kernel: Kernel = "ml",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
    ) -> None:
        super().__init__(kernel, windows, iterations, patience)

    def forward(self, signal: Signal) -> Estimate:  # pyright: ignore[reportIncompatibleMethodOverride]
        return pga_sca(
            signal.data, kernel=self.kernel, windows=self.windows, iterations=self.iterations, patience=self.patience
        )


class EntropyFixedPoint(Stage):
    """`entropy_fixed_point` with one floor after another: floors[i] for iterations[i]."""

    provides = ("phase_rad",)

    def __init__(
        self,
        floors: list[float] | tuple[float, ...] = (5.0, 2.0),
        iterations: list[int] | tuple[int, ...] = (12, 12),
        relaxation: float = 1.8,
        imaging: Imaging | None = None,
    ) -> None:
        super().__init__()
        if len(floors) != len(iterations):
            raise ValueError(
                f"entropy_fixed_point needs a number of iterations for each floor, got {list(floors)} "
                f"and {list(iterations)}"
            )
        self.schedule, self.relaxation, self.imaging = tuple(zip(floors, iterations)), relaxation, imaging

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        return entropy_fixed_point(
            signal.data, start=start, floors=self.schedule, relaxation=self.relaxation, imaging=self.imaging
        )


class Autofocus(Stage):
    """`autofocus`, the recommended estimator: adjacent pulses, entropy fixed point, Wiener estimate
    of the scene.
    """

    provides = ("phase_rad",)

    def __init__(self, search: int = 120, polish: int = 20, imaging: Imaging | None = None) -> None:
        super().__init__()
        self.search, self.polish, self.imaging = search, polish, imaging

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        return autofocus(signal.data, start=start, search=self.search, polish=self.polish, imaging=self.imaging)


class SharpestPhase(Stage):
    """`sharpest_phase`: the phases of least power or amplitude entropy, or of most contrast, by
    descent from SCA or the value `start`.
    """

    provides = ("phase_rad",)

    def __init__(
        self,
        objective: Literal["power_entropy", "amplitude_entropy", "contrast"] = "power_entropy",
        method: Literal["lbfgs", "adam"] = "lbfgs",
        steps: int = 100,
    ) -> None:
        super().__init__()
        self.objective: Literal["power_entropy", "amplitude_entropy", "contrast"] = objective
        self.method: Literal["lbfgs", "adam"] = method
        self.steps = steps

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        return sharpest_phase(signal.data, objective=self.objective, method=self.method, steps=self.steps, start=start)
