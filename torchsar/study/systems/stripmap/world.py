"""The world of a stripmap radar: section `world` of a config, and its echoes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import Impairment, apply_impairments, simulate
from torchsar.radar import StripmapRadar
from torchsar.scene import AlwaysLit, Beam, Hyperbola, Path, Points, RandomPoints, Scene, StripmapWorld, Together
from torchsar.study.names.registry import BEAMS, IMPAIRMENTS, PATHS, SCENES
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.system import Noise, World


@dataclass(frozen=True, kw_only=True)
class Strip(World):
    """Section `world`: the simulated strip and its true parameters.

    Args:
        lines: Number of pulses of the record.
        samples: Number of range samples of each pulse.
        scene: Scenes by name, whose echoes add up.
        beam: Illumination of the scene by the antenna.
        path: Model of the range to a target over time.
        velocity_m_s: True effective velocity in m/s; None for the nominal one of the radar.
        doppler_hz: True Doppler centroid in Hz; None for the nominal pointing of the radar.
        squint_deg: True squint of the beam in degrees, as an alternative to doppler_hz.
        noise: Receiver noise; the SNR is that of raw samples that contain signal.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    lines: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    beam: Annotated[Beam, BEAMS] = field(default_factory=AlwaysLit)
    path: Annotated[Path, PATHS] = field(default_factory=Hyperbola)
    velocity_m_s: Tensor | float | None = None
    doppler_hz: Tensor | float | None = None
    squint_deg: Tensor | float | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lines < 2 or self.samples < 2 or not self.scene:
            raise ValueError(
                f"world needs at least one scene, 2 lines and 2 samples, got {len(self.scene)} scenes, "
                f"{self.lines} lines and {self.samples} samples"
            )
        if self.doppler_hz is not None and self.squint_deg is not None:
            raise ValueError("doppler_hz and squint_deg both give the direction of the beam; give one of them")
        if self.velocity_m_s is not None and bool((torch.as_tensor(self.velocity_m_s) <= 0).any()):
            raise ValueError(f"velocity_m_s must be positive, got {self.velocity_m_s}")
        if self.squint_deg is not None and bool((torch.as_tensor(self.squint_deg).abs() >= 90).any()):
            raise ValueError(f"squint_deg must lie between -90 and 90 degrees, got {self.squint_deg}")

    def doppler(self, radar: StripmapRadar) -> Tensor | float | None:
        """True Doppler of the beam centre, 2 v sin(squint) / lambda where a squint is given."""
        if self.squint_deg is None:
            return self.doppler_hz
        velocity = radar.velocity_m_s if self.velocity_m_s is None else self.velocity_m_s
        squint = torch.deg2rad(torch.as_tensor(self.squint_deg, dtype=torch.float64))
        return 2 * velocity * torch.sin(squint) / radar.wavelength_m

    def of(self, radar: StripmapRadar) -> StripmapWorld:
        """The parameters of the echo simulation."""
        doppler, scene = self.doppler(radar), Together(self.scene)
        return StripmapWorld(scene, self.beam, self.path, self.velocity_m_s, doppler, self.noise.snr_db)

    def trials_of(self, radar: StripmapRadar, draws: Draws, dtype: torch.dtype, device: str) -> Trials:
        """Simulate trials: recordings with and without impairments, and what is true of them."""
        world, size = self.of(radar), (self.lines, self.samples)
        recording, truth = simulate(radar, world, *size, draws, self.impairments, dtype, device)
        assert truth.clean is not None
        clean, _ = apply_impairments(truth.clean, {}, draws)
        return Trials(recording, clean, truth.values, len(draws.trials or (0,)), world)

    @property
    def named_points(self) -> dict[str, int]:
        """Names of the point targets and their indices among all scatterers.

        A name is the key of the scene part in the config and the number of the target in this part,
        such as `points.0`.
        """
        names: dict[str, int] = {}
        first = 0
        for part, scene in self.scene.items():
            count = len(scene.azimuth_m) if isinstance(scene, Points) else getattr(scene, "count", 0)
            if isinstance(scene, (Points, RandomPoints)):
                names.update({f"{part}.{i}": first + i for i in range(count)})
            first += count
        return names
