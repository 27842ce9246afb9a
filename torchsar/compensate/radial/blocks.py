"""Estimators of radial velocities as stages, and as functions that process many trials.

A block of trials fits into the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.radial.assess import assessed_velocity
from torchsar.compensate.radial.bands import SWEEPS, Spectra, refuse_other_sweeps
from torchsar.compensate.radial.measured import Measured
from torchsar.core import (
    Axis,
    Estimate,
    Signal,
    Stage,
    block_bytes_of,
    over_blocks,
    refuse_non_finite,
)
from torchsar.radar import TriangularLadar

Window = tuple[float, float] | list[float] | None


def velocities(
    name: str,
    measure: Callable[[Spectra], Measured],
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    azimuth_m: Tensor | float,
    assess: bool,
) -> Estimate:
    """Estimate radial velocities in blocks of trials, and assess them if asked to.

    Args:
        name: Name of the calling function for error messages.
        measure: Method that measures the velocities in the spectra of the sweeps.
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).
        assess: Whether the estimate is assessed, see `assessed_velocity`.

    Returns:
        The estimate of `velocity_m_s`, see `Measured.estimate`.

    Raises:
        ValueError: If `azimuth_m` is not finite, or neither one number nor one per trial.
    """

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        measured = measure(Spectra.of(sweeps, radar))
        found = measured.estimate(pulse, azimuth_m)
        return assessed_velocity(found, measured, pulse, sweeps) if assess else found

    return by_trials(name, estimator, sweeps, radar, pulse, azimuth_m)


def by_trials(
    name: str,
    estimator: Callable[[Tensor, Tensor | float], Estimate],
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    azimuth_m: Tensor | float,
) -> Estimate:
    """Apply an estimator to blocks of trials, in as many threads as torch uses.

    This takes less time and memory than one call with all trials and gives the same values. All
    trials are processed at once if gradients are required.

    Args:
        name: Name of the calling function for error messages.
        estimator: Function of (sweeps, azimuth_m) that returns an estimate.
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).

    Returns:
        The estimate of all trials.

    Raises:
        TypeError: If the sweeps are not a complex tensor.
        ValueError: If the sweeps have another shape, are not finite, or do not match the axis; or
            if `azimuth_m` is not finite, or neither one number nor one per trial.
    """
    refuse_other_sweeps(sweeps, radar, name, pulse)
    trials, azimuth = sweeps.shape[:-3], torch.as_tensor(azimuth_m, dtype=torch.float64, device=sweeps.device)
    if azimuth.ndim and azimuth.shape != trials:
        raise ValueError(
            f"azimuth_m must be one number (m) or one per trial {tuple(trials)}, got shape {tuple(azimuth.shape)}"
        )
    refuse_non_finite(azimuth, "azimuth_m")
    # 16 times the size that is best for one operation, found by trial; with smaller blocks the
    # calls cost more than the cache saves
    height = max(1, 16 * block_bytes_of(sweeps.device) // (sweeps.shape[-3:].numel() * sweeps.element_size()))
    count = trials.numel()
    if count <= height or (torch.is_grad_enabled() and (sweeps.requires_grad or azimuth.requires_grad)):
        return estimator(sweeps, azimuth_m)
    flat, azimuths = sweeps.reshape(-1, *sweeps.shape[-3:]), azimuth.expand(trials).reshape(-1)
    starts = range(0, count, height)
    parts: dict[int, Estimate] = {}

    def work(first: int) -> None:
        part = slice(first, first + height)
        parts[first] = estimator(flat[part], azimuths[part])

    over_blocks(work, starts, sweeps)
    return Estimate.joined([parts[first] for first in starts], trials)


class _SweepEstimator(Stage):
    """Base of the stages that estimate the radial velocity from both sweeps of a range window.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.
        options: Further options of the function `estimator` of the stage.
    """

    works_on = SWEEPS
    provides = ("velocity_m_s",)
    neutral = {"velocity_m_s": 0.0}
    estimator: Callable[..., Estimate]
    azimuth_m: Tensor
    differentiable = "where ok"

    def __init__(
        self, radar: TriangularLadar, window_m: Window, azimuth_m: float, assess: bool, **options: Any
    ) -> None:
        super().__init__()
        if window_m is not None and len(window_m) != 2:
            raise ValueError(
                "window_m must be two ranges (low, high) in metres relative to the reference range, got "
                f"{list(window_m)}"
            )
        self.radar, self.window_m = radar, None if window_m is None else (float(window_m[0]), float(window_m[1]))
        self.assess, self.options = assess, options
        self.hold("azimuth_m", azimuth_m)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the radial motion from up and down sweeps of axes (ramp, pulse, fast_time).

        Returns:
            The values that the stage provides, shape (..., pulse) each: `velocity_m_s` at the
            turning points (ends of the up sweeps), receding positive, and for `RadialMotion` the
            residual `phase_rad` of the up sweeps.
        """
        return self.estimator(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            window_m=self.window_m,
            azimuth_m=self.azimuth_m,
            assess=self.assess,
            **self.options,
        )
