"""Searches for a rotation that start near the truth, to compare other estimators with.

Starting near the truth, they show the best accuracy and the least time that such searches can
reach.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.rotation.entropy_search import descend_rotation, genetic_rotation
from torchsar.compensate.rotation.image_entropy import EntropyObjective, ImageEntropy
from torchsar.compensate.rotation.unknowns import Variables
from torchsar.core import Draws, Estimate

# a genetic search that is short enough to compare: population, generations, part of the truth to
# each side
_POPULATION, _GENERATIONS, _PART = 10, 4, 0.1


def _entropy(
    data: Tensor,
    variables: Variables,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    yc_m: float | None,
    order: int,
) -> ImageEntropy:
    settings = EntropyObjective(order=order, yc_m=yc_m or 0.0, variables=variables)
    return ImageEntropy(data, settings, wavelength_m=wavelength_m, prf_hz=prf_hz, range_m=range_m)


def descent_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, assess: bool = True, **known: object
) -> Estimate:
    """Estimate a rotation by a descent of the image entropy that starts at 0.95 of the true values.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range).
        omega_rad_s: True rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: True derivatives k1, k2, ... of the rotation rate at the first pulse, divided by
            that rate, in 1/s, 1/s^2, ..., shape (..., coefficient).
        assess: False leaves out the assessment.
        known: The arguments wavelength_m, prf_hz, range_m, yc_m and order of `uneven_rotation`.

    Returns:
        The `Estimate` that the function `descend_rotation` returns.
    """
    objective = _entropy(data, "shape", **known)  # pyright: ignore[reportArgumentType]
    return descend_rotation(objective, objective.start(0.95 * omega_rad_s, 0.95 * warp_k, None), assess=assess)


def genetic_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, assess: bool = True, **known: object
) -> Estimate:
    """Estimate a rotation by a genetic algorithm that searches within 10 % of the true values.

    The image entropy is minimised with 10 individuals in 4 generations.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range).
        omega_rad_s: True rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: True derivatives k1, k2, ... of the rotation rate at the first pulse, divided by
            that rate, in 1/s, 1/s^2, ..., shape (..., coefficient).
        assess: False leaves out the assessment.
        known: The arguments wavelength_m, prf_hz, range_m, yc_m and order of `uneven_rotation`.

    Returns:
        The `Estimate` that the function `genetic_rotation` returns.
    """
    objective = _entropy(data, "raw", **known)  # pyright: ignore[reportArgumentType]
    centre = torch.cat([omega_rad_s[..., None], warp_k], -1)
    box = _PART * torch.where(centre != 0, centre.abs(), 1)
    size = {"population": _POPULATION, "generations": _GENERATIONS}
    return genetic_rotation(objective, centre - box, centre + box, draws=Draws(1), assess=assess, **size)
