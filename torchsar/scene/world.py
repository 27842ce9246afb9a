"""Everything that is true about a stripmap acquisition."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from torchsar.scene.path import AlwaysLit, Beam, Hyperbola, Path
from torchsar.scene.targets import Scene


@dataclass(frozen=True)
class StripmapWorld:
    """A scene seen from a straight path.

    Numbers or per-trial tensors (...,) for velocity, Doppler and SNR.

    velocity_m_s: true effective velocity, None for the radar's nominal one. doppler_hz: true
    Doppler of the beam centre, None for the nominal pointing. snr_db: mean signal power per lit raw
    sample over noise variance, None for no noise.
    """

    scene: Scene
    beam: Beam = field(default_factory=AlwaysLit)
    path: Path = field(default_factory=Hyperbola)
    velocity_m_s: Tensor | float | None = None
    doppler_hz: Tensor | float | None = None
    snr_db: Tensor | float | None = None
