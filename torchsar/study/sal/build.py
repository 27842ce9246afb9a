"""From a checked config to the ladar, the world and its recordings."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import Impairment, simulate_ladar, simulate_ladar_record
from torchsar.radar import TriangularLadar
from torchsar.scene import LadarWorld, Points, RetroAndBrokenLine, Together
from torchsar.study.build import build_impairments, carried, precision, refuse_oversize
from torchsar.study.cases import cases_of, check_judged
from torchsar.study.catalogue import Catalogue
from torchsar.study.config import Loaded
from torchsar.study.methods import build_chains
from torchsar.study.registry import (
    CALIBRATIONS,
    LOG_AMPLITUDES,
    RADIAL_MOTIONS,
    SCENES,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
    group_of,
)
from torchsar.study.sal.sections import LADAR_IMPAIRMENTS, Record
from torchsar.study.settings.errors import ConfigError, did_you_mean

log = logging.getLogger("torchsar")
# stages that work on deramped profiles, and cannot tell whether they are
_OF_DERAMPED = ("azimuth_matched_filter", "phase_polish")


def build_radar(loaded: Loaded) -> TriangularLadar:
    """The instrument."""
    try:
        return TriangularLadar(**carried(loaded.config.radar.model_dump()))
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: radar: {str(error).removeprefix('radar.')}") from None


def build_world(loaded: Loaded) -> LadarWorld:
    """The world of a simulation."""
    world, file = loaded.config.world, loaded.file
    if abs(world.noise.snr_db or 0.0) > 300:
        raise ConfigError(
            f"{file}: world.noise.snr_db is {world.noise.snr_db:g}, beyond what numbers hold; "
            "give -300 to 300 dB, or null for no noise"
        )
    scenes = {name: SCENES.make(entry, f"world.scene.{name}", file) for name, entry in world.scene.items()}
    motion = [RADIAL_MOTIONS.make(entry, f"world.motion.{name}", file) for name, entry in world.motion.items()]
    try:
        return LadarWorld(
            Together(scenes),
            motion,
            _made(LOG_AMPLITUDES, world.log_amplitude, "log_amplitude", file),
            world.noise.snr_db,
            SWEEP_FIDELITIES.make(world.fidelity, "world.fidelity", file),
            None if world.gate_m is None else tuple(world.gate_m),
            _made(SWEEP_ERRORS, world.sweep_error, "sweep_error", file),
            _made(CALIBRATIONS, world.calibration, "calibration", file),
        )
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: world: {' '.join(str(error).split())}") from None


def _made(catalogue: Catalogue, entry: dict[str, Any] | None, key: str, file: str) -> Any:
    return None if entry is None else catalogue.make(entry, f"world.{key}", file)


@dataclass(frozen=True)
class Ladar:
    """An instrument and the world that it looks at, ready to record.

    record: how, None for separated sweeps.
    """

    radar: TriangularLadar
    world: LadarWorld
    periods: int
    record: Record | None
    impairments: Mapping[str, Impairment]
    dtype: torch.dtype

    @staticmethod
    def of(loaded: Loaded) -> Ladar:
        world, radar = loaded.config.world, build_radar(loaded)
        refuse_oversize(2 * world.periods, radar.sweep_samples, loaded.file, "world.periods or radar.sample_rate_hz")
        impairments = build_impairments(world.impairments, "world.impairments", loaded.file, LADAR_IMPAIRMENTS)
        return Ladar(radar, build_world(loaded), world.periods, world.record, impairments, precision(loaded.config))

    def recorded(self, draws: Draws, device: torch.device | str | None = None) -> tuple[Recording, Truth]:
        """A recording and the truth about it, batched over the trials of the draws."""
        if self.record is None:
            return simulate_ladar(self.radar, self.world, self.periods, draws, self.impairments, self.dtype, device)
        how = self.record
        return simulate_ladar_record(
            self.radar,
            self.world,
            self.periods,
            draws,
            how.block_s,
            how.trigger_s,
            how.told,
            self.impairments,
            self.dtype,
            device,
        )


def named_targets(world: LadarWorld) -> dict[str, int]:
    """Names `part.number` of targets whose response is worth measuring, points and
    retro-reflectors, and their places among all scatterers.
    """
    assert isinstance(world.scene, Together)
    names: dict[str, int] = {}
    first = 0
    for part, scene in world.scene.parts.items():
        shown = len(scene.azimuth_m) if isinstance(scene, Points) else int(isinstance(scene, RetroAndBrokenLine))
        names.update({f"{part}.{i}": first + i for i in range(shown)})
        first += scene.scatterers(Draws(0)).range_m.shape[-1]
    return names


def check_target(loaded: Loaded, world: LadarWorld) -> None:
    """The target that metrics.target names is there. Raises ConfigError."""
    target, names = loaded.config.metrics.target, named_targets(world)
    if target is not None and target not in names:
        raise ConfigError(
            f"{loaded.file}: metrics.target names {target!r}, which is no point target of the "
            f"scene{did_you_mean(target, names)}"
        )


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything."""
    for case in cases_of(loaded).values():
        ladar = Ladar.of(case)
        check_judged(case)
        check_target(case, ladar.world)
        build_chains(case, radar=ladar.radar)
        check_deramped(case)
        if ladar.record is None and ladar.radar.detection == "real":
            log.warning(
                "warning: %s: radar.detection is 'real', but separated sweeps are complex; give "
                "world.record for what a real detector records",
                case.file,
            )


def check_deramped(loaded: Loaded) -> None:
    """Stages of deramped profiles, whose axes are those of others, follow one `deramp_azimuth`, or
    a stage from outside. Raises ConfigError.
    """
    for name, method in loaded.config.processor.items():
        before: list[str] = []
        for key, entry in (method.stages or {}).items():
            stage, times = entry["stage"], before.count("deramp_azimuth")
            foreign = any(group_of(other) == "own" for other in before)
            if stage in _OF_DERAMPED and times != 1 and not foreign:
                raise ConfigError(
                    f"{loaded.file}: processor.{name}.stages.{key}: {stage} works on profiles deramped "
                    f"once, here {times} times; put one deramp_azimuth between compress_sweeps and it"
                )
            before.append(stage)
