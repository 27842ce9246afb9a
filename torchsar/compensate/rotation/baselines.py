"""Searches for a rotation that start near the truth, to compare other estimators with.

Starting near the truth, they show the best accuracy and the least time that such searches can
reach.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.rotation.entropy_search import descend_rotation, genetic_rotation
from torchsar.compensate.rotation.image_entropy import EntropyObjective, ImageEntropy
from torchsar.compensate.rotation.unknowns import Variables
from torchsar.core import Draws, Estimate


def _entropy(data: Tensor, variables: Variables, yc_m: float | None, order: int, **known: Any) -> ImageEntropy:
    """The image entropy of a rotation whose centre is known."""
    return ImageEntropy(data, EntropyObjective(order=order, yc_m=yc_m or 0.0, variables=variables), **known)


def descent_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, assess: bool = True, **known: Any
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
    objective = _entropy(data, "shape", **known)
    return descend_rotation(objective, objective.start(0.95 * omega_rad_s, 0.95 * warp_k, None), assess=assess)


def genetic_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, assess: bool = True, **known: Any
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
    objective = _entropy(data, "raw", **known)
    centre = torch.cat([omega_rad_s[..., None], warp_k], -1)
    box = 0.1 * torch.where(centre != 0, centre.abs(), 1)
    size = {"population": 10, "generations": 4}  # short enough to compare
    return genetic_rotation(objective, centre - box, centre + box, draws=Draws(1), assess=assess, **size)
