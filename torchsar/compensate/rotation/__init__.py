"""Estimation of the rotation of a target that rotates at a changing rate.

`entropy_rotation` searches for the rotation with the least image entropy by one of five methods.
The recommended estimator, `uneven_rotation`, fits the rotation and the scatterers by maximum
likelihood and needs no values to start from; `coarse_rotation` makes its first steps.
"""

from torchsar.compensate.rotation.chirplet import ChirpletClean, chirplet_clean
from torchsar.compensate.rotation.entropy_search import EntropyRotation, entropy_rotation
from torchsar.compensate.rotation.image_entropy import EntropyObjective, ImageEntropy
from torchsar.compensate.rotation.recommended import (
    CoarseRotation,
    RotationAutofocus,
    UnevenRotation,
    coarse_rotation,
    rotation_autofocus,
    uneven_rotation,
)

__all__ = [
    "ChirpletClean",
    "CoarseRotation",
    "EntropyObjective",
    "EntropyRotation",
    "ImageEntropy",
    "RotationAutofocus",
    "UnevenRotation",
    "chirplet_clean",
    "coarse_rotation",
    "entropy_rotation",
    "rotation_autofocus",
    "uneven_rotation",
]
__dir__ = __all__.copy
