"""From a checked config to the radar, the world and the recordings of a turning target."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.core import Chain, Recording
from torchsar.io import read_inverse
from torchsar.radar import InverseRadar, geometry_of
from torchsar.scene import Together, TurntableWorld
from torchsar.study.build import build_damages, precision, refuse_oversize
from torchsar.study.config import RESERVED, Loaded
from torchsar.study.errors import ConfigError
from torchsar.study.isal.sections import TARGET_DAMAGES, IsalConfig
from torchsar.study.methods import build_chains
from torchsar.study.registry import FIDELITIES, MOTIONS, SCENES, START_PHASES

_OF_ALL_CASES = ("system", "title", "cases", "metrics", "trade", "sweep")
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
    refuse_oversize(world.pulses, world.samples, file)
    scenes = {name: SCENES.make(entry, f"world.scene.{name}", file) for name, entry in world.scene.items()}
    motion = [MOTIONS.make(entry, f"world.motion.{name}", file) for name, entry in world.motion.items()]
    phases = [START_PHASES.make(entry, f"world.start_phase.{name}", file) for name, entry in world.start_phase.items()]
    fidelity = FIDELITIES.make(world.fidelity, "world.fidelity", file)
    try:
        return TurntableWorld(Together(scenes), world.rotation_rad_s, motion, phases, world.noise.snr_db, fidelity)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: world: {' '.join(str(error).split())}") from None


def cases_of(loaded: Loaded) -> dict[str, Loaded]:
    """Every case of a run as a config of its own, in the order of the config; one without a name where there are none. Raises ConfigError."""
    assert isinstance(loaded.config, IsalConfig)
    cases = loaded.config.cases
    for name, values in cases.items():
        _refuse_case(name, values, loaded)
    words = {word_of(name): name for name in cases}
    for name in cases:
        if words[word_of(name)] != name:
            raise ConfigError(f"{loaded.file}: cases {name!r} and {words[word_of(name)]!r} would share their figures; name them apart by letters or digits")
    changed = {name: loaded.changed(values, f"cases.{name}") for name, values in cases.items()}
    for name, case in changed.items():
        if list(case.config.processor) != list(loaded.config.processor):
            raise ConfigError(f"{loaded.file}: cases.{name} changes which methods there are; every method runs on every case, so a case may change only keys of their stages")
    return changed or {"": loaded}


def word_of(case: str) -> str:
    """The name of a case as a part of names of files."""
    return "".join(c if c.isalnum() else "_" for c in case)


def _refuse_case(name: str, values: Mapping[str, Any], loaded: Loaded) -> None:
    """A case has a name that results can go by, and changes what a case may change."""
    if not word_of(name).strip("_") or name.startswith("__") or name in (*RESERVED, "all"):
        raise ConfigError(f"{loaded.file}: a case cannot be called {name!r}; its name has letters or digits, does not begin with '__', and is none of {', '.join((*RESERVED, 'all'))}")
    if not values:
        raise ConfigError(f"{loaded.file}: cases.{name} changes nothing; give it dotted keys with values, such as world.noise.snr_db: 10.0")
    for key in values:
        root = key.split(".")[0]
        if root in _OF_ALL_CASES or key == "world.trials":
            raise ConfigError(f"{loaded.file}: cases.{name}: the key {key!r} holds for all cases; a case may change radar, world, data, processor, seed and precision")
        if root == "data" and loaded.config.data.file is None:
            raise ConfigError(f"{loaded.file}: cases.{name}: the key {key!r} is not used by a simulation, whose damages are keys of the world; set data.file to work on a recording")


def check_judged(loaded: Loaded) -> None:
    """Methods have stages of their own, and the reference is one of undamaged input."""
    for name, method in loaded.config.processor.items():
        if method.rerun is not None:
            raise ConfigError(f"{loaded.file}: processor.{name}.rerun: system isal runs no part of a chain again; give the method 'stages' of its own")
    reference = loaded.config.metrics.reference
    if reference is not None and loaded.config.processor[reference].input != "clean":
        raise ConfigError(f"{loaded.file}: metrics.reference names {reference!r}, whose image is not the ideal one; name a method with 'input: clean'")


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything."""
    for case in cases_of(loaded).values():
        build_world(case)
        check_judged(case)
        build_damages(case.config.world.damages, "world.damages", case.file, TARGET_DAMAGES)
        build_chains(case, radar=build_radar(case))


def read_recording(loaded: Loaded) -> Recording:
    """The recording that data.file names."""
    assert loaded.config.data.file is not None
    try:
        return read_inverse(loaded.config.data.file, precision(loaded.config))
    except (ValueError, OSError) as error:
        raise ConfigError(f"{loaded.file}: data.file: {' '.join(str(error).split()).removeprefix('data.file: ')}") from None


def recorded_chains(loaded: Loaded, recording: Recording) -> dict[str, Chain]:
    """The chains for a recording, whose geometry shapes the images where it is told."""
    known: Mapping[str, Any] = {name: recording.aux[name] for name in _GEOMETRY if name in recording.aux}
    return build_chains(loaded, radar=recording.radar, geometry=geometry_of(**known) if known else None)
