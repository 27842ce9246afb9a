"""From a checked config to the radar, the world and the recordings of a turning target."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.core import Chain, Recording
from torchsar.io import read_inverse
from torchsar.radar import InverseRadar, geometry_of
from torchsar.scene import Together, TurntableWorld
from torchsar.study.build import build_impairments, precision, refuse_oversize
from torchsar.study.cases import cases_of, check_judged
from torchsar.study.config import Loaded
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.methods import build_chains
from torchsar.study.registry import FIDELITIES, MOTIONS, SCENES, START_PHASES
from torchsar.study.settings.errors import ConfigError

_GEOMETRY = ("frequency_hz", "angle_rad", "position_m", "reference_m")


def build_radar(loaded: Loaded) -> InverseRadar:
    """The instrument of a simulation."""
    try:
        return InverseRadar(**loaded.config.radar.model_dump())
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: radar: {error}") from None


def build_world(loaded: Loaded) -> TurntableWorld:
    """The world of a simulation."""
    world, file = loaded.config.world, loaded.file
    refuse_oversize(world.pulses, world.samples, file, "world.pulses or world.samples")
    scenes = {name: SCENES.make(entry, f"world.scene.{name}", file) for name, entry in world.scene.items()}
    motion = [MOTIONS.make(entry, f"world.motion.{name}", file) for name, entry in world.motion.items()]
    phases = [START_PHASES.make(entry, f"world.start_phase.{name}", file) for name, entry in world.start_phase.items()]
    fidelity = FIDELITIES.make(world.fidelity, "world.fidelity", file)
    try:
        return TurntableWorld(Together(scenes), world.rotation_rad_s, motion, phases, world.noise.snr_db, fidelity)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: world: {' '.join(str(error).split())}") from None


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything."""
    for case in cases_of(loaded).values():
        build_world(case)
        check_judged(case)
        build_impairments(case.config.world.impairments, "world.impairments", case.file, TARGET_IMPAIRMENTS)
        build_chains(case, radar=build_radar(case))


def read_recording(loaded: Loaded) -> Recording:
    """The recording that data.file names."""
    assert loaded.config.data.file is not None
    try:
        return read_inverse(loaded.config.data.file, precision(loaded.config))
    except (ValueError, OSError) as error:
        raise ConfigError(
            f"{loaded.file}: data.file: {' '.join(str(error).split()).removeprefix('data.file: ')}"
        ) from None


def recorded_chains(loaded: Loaded, recording: Recording) -> dict[str, Chain]:
    """The chains for a recording, whose geometry shapes the images where it is told."""
    known: Mapping[str, Any] = {name: recording.aux[name] for name in _GEOMETRY if name in recording.aux}
    return build_chains(loaded, radar=recording.radar, geometry=geometry_of(**known) if known else None)
