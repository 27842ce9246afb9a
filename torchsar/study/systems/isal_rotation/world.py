"""The world of a target with non-uniform rotation: section `world` of a config, and its echoes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.radar import InverseRadar
from torchsar.scene import Points, PolynomialRotation, Scatterers, Scene, Together, TurntableWorld
from torchsar.study.systems.isal import Target


@dataclass(frozen=True)
class OneScene:
    """A random scene with a seed of its own, the same in every trial."""

    scene: Scene
    seed: int

    def scatterers(self, draws: Draws) -> Scatterers:
        return self.scene.scatterers(Draws(self.seed, source=draws.source))


@dataclass(frozen=True, kw_only=True)
class Rotating(Target):
    """Section `world`: the simulated target and its true parameters.

    Args:
        rotation: Rotation rate at the first pulse, and its time derivatives relative to that rate.
        centre_deviation_m: Range in metres from the centre of rotation to the zero of the range
            axis, yc.
        scene_seed: Seed of one scene for all trials, which then differ in noise alone; None for
            another scene in every trial.
    """

    rotation: PolynomialRotation
    centre_deviation_m: Tensor | float = 0.0
    scene_seed: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rotation_rad_s is not None:
            raise ValueError(
                "world.rotation_rad_s, the rate of a uniform rotation, is not accepted here; give world.rotation alone"
            )
        if not bool((torch.as_tensor(self.rotation.omega_rad_s) > 0).all()):
            raise ValueError(
                f"world.rotation.omega_rad_s must be positive, got {self.rotation.omega_rad_s}; a "
                "negative rate would only mirror the image in cross range"
            )

    def of(self, radar: InverseRadar) -> TurntableWorld:
        self.rotation.refuse_turning_back(self.pulses / radar.prf_hz)
        scene: Scene = Together(self.scene)
        scene = scene if self.scene_seed is None else OneScene(scene, self.scene_seed)
        effects = (self.motion, self.start_phase, self.noise.snr_db, self.fidelity)
        return TurntableWorld(scene, None, *effects, self.rotation, self.centre_deviation_m)

    @property
    def named_points(self) -> dict[str, int]:
        """Names of the point targets, `part.number`, and their indices among all scatterers."""
        names: dict[str, int] = {}
        first = 0
        for part, one in self.scene.items():
            if isinstance(one, Points):
                names.update({f"{part}.{i}": first + i for i in range(len(one.azimuth_m))})
            first += one.scatterers(Draws(0)).range_m.shape[-1]
        return names

    def noise_std(self, amplitude: Tensor) -> float:
        """Return the standard deviation of the noise in a sample; 0 without noise.

        The SNR is the total power of the scatterers, divided by the number of range cells, over the
        noise variance.

        Args:
            amplitude: Amplitudes of all scatterers.
        """
        snr_db = self.noise.snr_db
        if snr_db is None:
            return 0.0
        return math.sqrt(float(amplitude.abs().square().sum()) / self.samples) * 10 ** (-float(snr_db) / 20)


def k_of(rotation: PolynomialRotation) -> Tensor:
    """Return k1, k2, ... (relative derivatives of the rotation rate) in the first trial."""
    k = rotation.warp_k(torch.zeros(0, dtype=torch.float64))
    return k.reshape(-1, k.shape[-1])[0] if k.numel() else k.reshape(-1)[:0]


def first_values(values: Mapping[str, Tensor], *names: str) -> list[Tensor]:
    """Values of the first trial, (target,) each."""
    return [values[name].reshape(-1, values[name].shape[-1])[0].cpu() for name in names]
