"""Autofocus as stages of a chain: estimators of the phase error of every pulse, and its removal.

The estimators provide the phase as `phase_rad` and leave the signal unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchsar.compensate.pulse_phase.data import on_the_circle, rotate
from torchsar.compensate.pulse_phase.descent import sharpest_phase
from torchsar.compensate.pulse_phase.gradient import Kernel, Listed, Measured, Shrinking, Windows, pga, pga_sca, sca
from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.compensate.pulse_phase.linking import link_phases
from torchsar.compensate.pulse_phase.recommended import Scene, autofocus, entropy_fixed_point
from torchsar.core import Estimate, Signal, Stage, checked_samples, real_dtype, refuse_non_finite
from torchsar.focus import TargetImage
from torchsar.radar import FarField, InverseRadar, Spotlight


def correct_pulse_phase(data: Tensor, phase_rad: Tensor) -> Tensor:
    """Remove a phase from every pulse: the samples are multiplied by exp(-j phase).

    Whole turns are first subtracted from the phase in float64, so that large phases lose no
    accuracy. Differentiable in both arguments.

    Args:
        data: Pulses, shape (..., pulse, range), complex.
        phase_rad: Phases in rad, shape (..., pulse) or (pulse,).

    Returns:
        The corrected pulses, shape (..., pulse, range), complex.

    Raises:
        ValueError: If there is not one finite phase per pulse.

    Reference:
        Ruan et al. 2013, text after Eq. (6).
    """
    if not isinstance(phase_rad, Tensor) or phase_rad.shape[-1:] != data.shape[-2:-1]:
        got = tuple(phase_rad.shape) if isinstance(phase_rad, Tensor) else type(phase_rad).__name__
        raise ValueError(
            f"correct_pulse_phase: phase_rad must be a tensor of one phase per pulse, (..., {data.shape[-2]}), "
            f"got {got}"
        )
    data = checked_samples(data, "correct_pulse_phase", "pulse, range", finite=False)
    refuse_non_finite(phase_rad, "correct_pulse_phase: phase_rad", "in trials without an estimate, use zero", "values")
    return rotate(data.mT, on_the_circle(phase_rad.to(torch.float64)).to(real_dtype(data.dtype))).mT


class CorrectPulsePhase(Stage):
    """Stage that removes the phase `phase_rad` (rad) of every pulse.

    Every pulse is multiplied by exp(-j phase_rad), see `correct_pulse_phase`. The phase usually
    comes from an earlier stage such as `Autofocus`.
    """

    def forward(self, signal: Signal, phase_rad: Tensor) -> Signal:
        """Remove the phase from a signal of axes (pulse, range).

        Args:
            signal: Pulses, shape (..., pulse, range), complex.
            phase_rad: Phases in rad, shape (..., pulse).

        Returns:
            The corrected signal.
        """
        return signal.with_data(correct_pulse_phase(signal.data, phase_rad).contiguous())


class _Estimator(Stage):
    """An estimator of the phase of every pulse, by a function with options."""

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}

    def __init__(self, find: Callable[..., Estimate], **options: Any) -> None:
        super().__init__()
        self.find, self.options = find, options

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Returns:
            The `Estimate` of the function that the description of the stage names, with `phase_rad`
            of shape (..., pulse), to be removed.
        """
        return self.find(signal.data, **self.options)


class _FromStart(_Estimator):
    """An estimator that can start from a phase."""

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the function.

        Returns:
            The `Estimate` of the function that the description of the stage names, with `phase_rad`
            of shape (..., pulse), to be removed.
        """
        return self.find(signal.data, start=start, **self.options)


class Sca(_Estimator):
    """Phase per pulse by the spatial correlation algorithm; see `sca`.

    Args:
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(self, assess: bool = True) -> None:
        super().__init__(sca, assess=assess)


class LinkPhases(_FromStart):
    """Phase per pulse of a homogeneous scene by maximum likelihood; see `link_phases`.

    Args:
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(self, assess: bool = True) -> None:
        super().__init__(link_phases, assess=assess)


def windows_of(windows: Literal["shrinking", "measured"] | list[float]) -> Windows:
    """Make the schedule of window widths for phase gradient autofocus from its name or a list.

    Args:
        windows: "shrinking" narrows by a constant factor per iteration (`Shrinking`), "measured"
            follows the width of the blur (`Measured`), and a list gives the width for each
            iteration in Doppler cells (`Listed`).

    Returns:
        The schedule.
    """
    if isinstance(windows, str):
        return {"shrinking": Shrinking, "measured": Measured}[windows]()
    return Listed(tuple(windows))


class Pga(_FromStart):
    """Phase per pulse by phase gradient autofocus; see `pga`.

    Args:
        kernel: Method that estimates the phase from the windowed data: "lumv", "ml", "synchronised"
            or "eigenvector", see `pga`.
        windows: Window widths: "shrinking", "measured", or a list of widths in Doppler cells, see
            `windows_of`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        kernel: Kernel = "lumv",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
        assess: bool = True,
    ) -> None:
        super().__init__(
            pga,
            kernel=kernel,
            windows=windows_of(windows),
            iterations=iterations,
            patience=patience,
            assess=assess,
        )


class PgaSca(_Estimator):
    """Phase per pulse by phase gradient autofocus started from SCA; see `pga_sca`.

    Args:
        kernel: Method that estimates the phase from the windowed data: "lumv", "ml", "synchronised"
            or "eigenvector", see `pga`.
        windows: Window widths: "shrinking", "measured", or a list of widths in Doppler cells, see
            `windows_of`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        kernel: Kernel = "ml",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
        assess: bool = True,
    ) -> None:
        super().__init__(
            pga_sca,
            kernel=kernel,
            windows=windows_of(windows),
            iterations=iterations,
            patience=patience,
            assess=assess,
        )


class EntropyFixedPoint(_FromStart):
    """Phase per pulse by the entropy fixed point; see `entropy_fixed_point`.

    Args:
        floors: Power floors as multiples of the mean power of the image, used one after another;
            cells below the floor get no weight. An nn.Parameter, shape (floor,), stays tunable.
        iterations: Largest number of iterations for each floor.
        relaxation: Factor applied to the phase step. An nn.Parameter stays tunable.
        imaging: Image formation whose image is sharpened; by default a Fourier transform along
            pulses.
        assess: Whether to add the standard deviation and the outcome.

    Raises:
        ValueError: If `floors` and `iterations` differ in length.
    """

    def __init__(
        self,
        floors: list[float] | tuple[float, ...] | nn.Parameter = (5.0, 2.0),
        iterations: list[int] | tuple[int, ...] = (12, 12),
        relaxation: float | nn.Parameter = 1.8,
        imaging: Imaging | None = None,
        assess: bool = True,
    ) -> None:
        super().__init__(entropy_fixed_point, imaging=imaging, assess=assess)
        if len(floors) != len(iterations):
            raise ValueError(
                "EntropyFixedPoint: iterations must hold a number of iterations for each floor, got floors "
                f"{list(floors)} and iterations {list(iterations)}"
            )
        self.floors, self.iterations, self.relaxation = floors, iterations, relaxation

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the
                spatial correlation algorithm (function `sca`).

        Returns:
            `Estimate` by the function `entropy_fixed_point` with `phase_rad` of shape (...,
            pulse), to be removed.
        """
        floors = tuple(zip(self.floors, self.iterations))
        return self.find(signal.data, start=start, floors=floors, relaxation=self.relaxation, **self.options)


class Autofocus(_FromStart):
    """Phase per pulse by the recommended autofocus; see `autofocus`.

    Args:
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        imaging: Image formation whose image is sharpened; by default a Fourier transform along
            pulses.
        scene: Kind of the scene: "sparse", "points", "clutter" or "auto", see `autofocus`.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        search: int = 120,
        polish: int = 20,
        imaging: Imaging | None = None,
        scene: Scene = "sparse",
        assess: bool = True,
    ) -> None:
        super().__init__(autofocus, search=search, polish=polish, imaging=imaging, scene=scene, assess=assess)


class TargetAutofocus(Autofocus):
    """Phase per pulse that sharpens the image of a target; see `autofocus`.

    The image is the polar-format image of `TargetImage` if `geometry` is given, and the Fourier
    transform along pulses otherwise.

    Args:
        radar: Radar of the recording.
        geometry: Geometry of the recording; None if it is not known.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        scene: Kind of the scene: "sparse", "points", "clutter" or "auto", see `autofocus`; with a
            geometry it is taken to be sparse.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        radar: InverseRadar,
        geometry: FarField | Spotlight | None = None,
        search: int = 120,
        polish: int = 20,
        scene: Scene = "sparse",
        assess: bool = True,
    ) -> None:
        super().__init__(search, polish, scene=scene, assess=assess)
        self.target = None if geometry is None else TargetImage(radar, geometry)

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the
                spatial correlation algorithm (function `sca`).

        Returns:
            `Estimate` by the function `autofocus` with `phase_rad` of shape (..., pulse), to be
            removed.
        """
        imaging = None if self.target is None else self.target.operator(signal.data)
        return self.find(signal.data, start=start, **{**self.options, "imaging": imaging})


class SharpestPhase(_FromStart):
    """Phase per pulse of least image entropy or most contrast, by descent; see `sharpest_phase`.

    Args:
        objective: "power_entropy" or "amplitude_entropy" (minimised), or "contrast" (maximised).
        method: Gradient descent: "lbfgs", or "adam" for rough objectives.
        steps: Largest number of steps.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        objective: Literal["power_entropy", "amplitude_entropy", "contrast"] = "power_entropy",
        method: Literal["lbfgs", "adam"] = "lbfgs",
        steps: int = 100,
        assess: bool = True,
    ) -> None:
        super().__init__(sharpest_phase, objective=objective, method=method, steps=steps, assess=assess)
