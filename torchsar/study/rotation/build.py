"""From a checked config to the radar, the world and its recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import Impairment, simulate_turntable
from torchsar.radar import InverseRadar
from torchsar.scene import Points, PolynomialRotation, Scatterers, Scene, Together, TurntableWorld
from torchsar.study.build import build_impairments, carried, precision, refuse_oversize
from torchsar.study.cases import cases_of, check_judged
from torchsar.study.config import Loaded
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.methods import build_chains
from torchsar.study.registry import FIDELITIES, MOTIONS, SCENES, START_PHASES
from torchsar.study.settings.errors import ConfigError


@dataclass(frozen=True)
class OneScene:
    """The scene that a seed draws, the same in every trial."""

    scene: Scene
    seed: int

    def scatterers(self, draws: Draws) -> Scatterers:
        return self.scene.scatterers(Draws(self.seed))


@dataclass(frozen=True)
class Turntable:
    """All that simulates the trials of one case."""

    radar: InverseRadar
    world: TurntableWorld
    impairments: Mapping[str, Impairment]
    pulses: int
    samples: int
    dtype: torch.dtype

    @staticmethod
    def of(loaded: Loaded) -> Turntable:
        """Raises ConfigError for what radar, world or impairments refuse."""
        size = loaded.config.world
        impairments = build_impairments(size.impairments, "world.impairments", loaded.file, TARGET_IMPAIRMENTS)
        return Turntable(
            build_radar(loaded), build_world(loaded), impairments, size.pulses, size.samples, precision(loaded.config)
        )

    @property
    def duration_s(self) -> float:
        return self.pulses / self.radar.prf_hz

    @property
    def rotation(self) -> PolynomialRotation:
        assert self.world.rotation is not None
        return self.world.rotation

    def recorded(self, draws: Draws, device: str = "cpu", dtype: torch.dtype | None = None) -> tuple[Recording, Truth]:
        """The trials of the draws; dtype: of the samples, by default that of the config."""
        return simulate_turntable(
            self.radar, self.world, self.pulses, self.samples, draws, self.impairments, dtype or self.dtype, device
        )


def build_radar(loaded: Loaded) -> InverseRadar:
    """The instrument."""
    try:
        return InverseRadar(**carried(loaded.config.radar.model_dump()))
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: radar: {error}") from None


def build_world(loaded: Loaded) -> TurntableWorld:
    """The world of a simulation.

    Raises ConfigError, for a rotation that turns back during the record too.
    """
    world, file = loaded.config.world, loaded.file
    refuse_oversize(world.pulses, world.samples, file, "world.pulses or world.samples")
    scenes = Together({name: SCENES.make(entry, f"world.scene.{name}", file) for name, entry in world.scene.items()})
    motion = [MOTIONS.make(entry, f"world.motion.{name}", file) for name, entry in world.motion.items()]
    phases = [START_PHASES.make(entry, f"world.start_phase.{name}", file) for name, entry in world.start_phase.items()]
    fidelity = FIDELITIES.make(world.fidelity, "world.fidelity", file)
    scene = scenes if world.scene_seed is None else OneScene(scenes, world.scene_seed)
    try:
        rotation = PolynomialRotation(world.rotation.omega_rad_s, tuple(world.rotation.k))
        rotation.refuse_turning_back(world.pulses / loaded.config.radar.prf_hz)
        return TurntableWorld(
            scene, None, motion, phases, world.noise.snr_db, fidelity, rotation, world.centre_deviation_m
        )
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: world: {' '.join(str(error).split())}") from None


def named_targets(world: TurntableWorld) -> dict[str, int]:
    """Names `part.number` of explicit points, whose response is worth measuring, and their places
    among all scatterers.
    """
    scene = world.scene.scene if isinstance(world.scene, OneScene) else world.scene
    assert isinstance(scene, Together)
    names: dict[str, int] = {}
    first = 0
    for part, one in scene.parts.items():
        if isinstance(one, Points):
            names.update({f"{part}.{i}": first + i for i in range(len(one.azimuth_m))})
        first += one.scatterers(Draws(0)).range_m.shape[-1]
    return names


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything."""
    for case in cases_of(loaded).values():
        check_judged(case)
        table = Turntable.of(case)
        build_chains(case, radar=table.radar)
