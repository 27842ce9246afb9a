"""World of a stripmap acquisition."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from torchsar.scene.path import AlwaysLit, Beam, Hyperbola, Path
from torchsar.scene.targets import Scene
from torchsar.scene.trials import refuse_unless_finite


@dataclass(frozen=True)
class StripmapWorld:
    """Scene seen from a straight path.

    Args:
        scene: Scatterers.
        beam: Illumination.
        path: Range history.
        velocity_m_s: True effective velocity in m/s, None for the nominal one of the radar.
        doppler_hz: True Doppler frequency of the beam centre in hertz, None for the nominal
            pointing of the radar.
        snr_db: Mean signal power of the illuminated raw samples over the noise variance in
            decibels, None for no noise.

    Raises:
        ValueError: If a number is not finite.
    """

    scene: Scene
    beam: Beam = field(default_factory=AlwaysLit)
    path: Path = field(default_factory=Hyperbola)
    velocity_m_s: Tensor | float | None = None
    doppler_hz: Tensor | float | None = None
    snr_db: Tensor | float | None = None

    def __post_init__(self) -> None:
        for name in ("velocity_m_s", "doppler_hz", "snr_db"):
            refuse_unless_finite(name, getattr(self, name))
