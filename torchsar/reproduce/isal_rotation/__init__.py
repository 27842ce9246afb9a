"""Remote Sens. 2025, 17, 3447: inverse synthetic aperture ladar of uneven rotation."""

from __future__ import annotations

from torchsar.reproduce.isal_rotation import cubes, profiles, satellite, snr
from torchsar.reproduce.item import Paper, in_order

__all__ = ["PAPER"]
__dir__ = __all__.copy

PAPER = Paper(
    "isal_rotation",
    "ISAL imaging of spaceborne non-uniformly rotating targets by matched Fourier transform and a genetic algorithm, "
    "Remote Sens. 2025, 17, 3447",
    in_order(*(item for part in (profiles, satellite, snr, cubes) for item in part.ITEMS)),
)
