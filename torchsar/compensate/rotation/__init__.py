"""Estimation of the rotation of a target that rotates at a changing rate.

Some estimators search for the rotation with the least image entropy; the recommended one fits the
rotation and the scatterers by maximum likelihood and needs no values to start from.
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
from torchsar.compensate.rotation.image_entropy import (
    EntropyObjective,
    ImageEntropy,
    RotationParameters,
    Unknowns,
    k_name,
)
from torchsar.compensate.rotation.recommended import (
    CoarseRotation,
    PhaseFitRotation,
    RotationAutofocus,
    UnevenRotation,
    coarse_rotation,
    phase_fit_rotation,
    rotating_autofocus,
    uneven_rotation,
)

__all__ = [
    "ChirpletClean",
    "Chirplets",
    "CoarseRotation",
    "EntropyObjective",
    "ImageEntropy",
    "PhaseFitRotation",
    "RotationAutofocus",
    "RotationDescent",
    "RotationEvolution",
    "RotationGenetic",
    "RotationNewton",
    "RotationParameters",
    "RotationSearch",
    "UnevenRotation",
    "Unknowns",
    "chirplet_clean",
    "coarse_rotation",
    "descend_rotation",
    "evolve_rotation",
    "genetic_rotation",
    "k_name",
    "newton_rotation",
    "phase_fit_rotation",
    "rotating_autofocus",
    "search_rotation",
    "uneven_rotation",
]
__dir__ = __all__.copy
