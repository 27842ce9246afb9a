"""Rotation of a target that turns unevenly: searches for the least entropy, and maximum likelihood
without a start.
"""

from torchsar.compensate.rotation.chirplet import ChirpletClean, Chirplets, chirplet_clean
from torchsar.compensate.rotation.entropy_search import (
    RotationDescent,
    RotationEvolution,
    RotationGenetic,
    RotationNewton,
    RotationSearch,
    descend_rotation,
    evolve_rotation,
    genetic_rotation,
    newton_rotation,
    search_rotation,
)
from torchsar.compensate.rotation.image_entropy import ImageEntropy
from torchsar.compensate.rotation.recommended import coarse_rotation, phase_fit_rotation, uneven_rotation
from torchsar.compensate.rotation.stages import (
    CoarseRotation,
    PhaseFitRotation,
    RotationAutofocus,
    UnevenRotation,
    rotating_autofocus,
)

__all__ = [
    "ChirpletClean",
    "Chirplets",
    "CoarseRotation",
    "ImageEntropy",
    "PhaseFitRotation",
    "RotationAutofocus",
    "RotationDescent",
    "RotationEvolution",
    "RotationGenetic",
    "RotationNewton",
    "RotationSearch",
    "UnevenRotation",
    "chirplet_clean",
    "coarse_rotation",
    "descend_rotation",
    "evolve_rotation",
    "genetic_rotation",
    "newton_rotation",
    "phase_fit_rotation",
    "rotating_autofocus",
    "search_rotation",
    "uneven_rotation",
]
