"""Evaluation of an estimator on many trials, in blocks of trials that fit into the cache."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.compensate.radial.assess import assessed_velocity
from torchsar.compensate.radial.bands import Spectra
from torchsar.compensate.radial.measured import Measured
from torchsar.core import Axis, Estimate, block_bytes_of, over_blocks, refuse_non_finite
from torchsar.radar import TriangularLadar


def velocities(
    measure: Callable[[Spectra], Measured],
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    azimuth_m: Tensor | float,
    assess: bool,
) -> Estimate:
    """Estimate radial velocities in blocks of trials, and assess them if asked to.

    Args:
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
        return assessed_velocity(found, measured, pulse) if assess else found

    return by_trials(estimator, sweeps, azimuth_m)


def by_trials(
    estimator: Callable[[Tensor, Tensor | float], Estimate], sweeps: Tensor, azimuth_m: Tensor | float
) -> Estimate:
    """Apply an estimator to blocks of trials, in as many threads as torch uses.

    This takes less time and memory than one call with all trials and gives the same values. All
    trials are processed at once if gradients are required.

    Args:
        estimator: Function of (sweeps, azimuth_m) that returns an estimate.
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,).

    Returns:
        The estimate of all trials.

    Raises:
        ValueError: If `azimuth_m` is not finite, or neither one number nor one per trial.
    """
    trials, azimuth = sweeps.shape[:-3], torch.as_tensor(azimuth_m, dtype=torch.float64, device=sweeps.device)
    if azimuth.ndim and azimuth.shape != trials:
        raise ValueError(
            f"azimuth_m must be one number (m) or one per trial {tuple(trials)}, got shape {tuple(azimuth.shape)}"
        )
    refuse_non_finite(azimuth, "azimuth_m")
    # 16 times the size that is best for one operation, found by trial: smaller blocks cost more in
    # calls than they gain in the cache
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
