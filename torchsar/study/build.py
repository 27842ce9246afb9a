"""From a checked config to a radar, a recording with its truth, and chains."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Draws, Recording, Truth, use
from torchsar.echo import apply_damages, simulate
from torchsar.io import read_stripmap
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Points, RandomPoints, Scene, StripmapWorld, Together
from torchsar.study.config import Config, Loaded, Method
from torchsar.study.errors import ConfigError, did_you_mean
from torchsar.study.registry import BEAMS, DAMAGES, PATHS, SCENES, stages


@dataclass(frozen=True)
class Case:
    """What the methods get (recording; clean is the same without damage), and what only metrics may see.

    targets: names of the point targets and their indices among the scatterers of the truth.
    """

    recording: Recording
    clean: Recording
    truth: Truth | None
    targets: Mapping[str, int]


def precision(config: Config) -> torch.dtype:
    return {"complex64": torch.complex64, "complex128": torch.complex128}[config.precision]


def build_radar(loaded: Loaded) -> StripmapRadar:
    """The instrument of a simulation."""
    assert loaded.config.radar is not None
    values = loaded.config.radar.model_dump()
    try:
        return StripmapRadar(**{**values, "pulse": LinearFM(**values["pulse"])})
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: radar: {error}") from None


def true_doppler_hz(loaded: Loaded) -> float | None:
    """Doppler of the beam centre, from world.doppler_hz or from the squint at the true velocity."""
    world = loaded.config.world
    assert world is not None
    return world.doppler_hz if world.squint_deg is None else float(squint_doppler_hz(build_radar(loaded), world.squint_deg, world.velocity_m_s))


def build_world(loaded: Loaded) -> StripmapWorld:
    """The world of a simulation."""
    world = loaded.config.world
    assert world is not None
    scenes = {name: SCENES.make(entry, f"world.scene.{name}", loaded.file) for name, entry in world.scene.items()}
    return StripmapWorld(
        scene=Together(scenes),
        beam=BEAMS.make(world.beam, "world.beam", loaded.file),
        path=PATHS.make(world.path, "world.path", loaded.file),
        velocity_m_s=world.velocity_m_s,
        doppler_hz=true_doppler_hz(loaded),
        snr_db=world.noise.snr_db,
    )


def squint_doppler_hz(radar: StripmapRadar, squint_deg: Tensor | float, velocity_m_s: Tensor | float | None) -> Tensor:
    """Doppler of the beam centre at a squint, 2 v sin(squint) / lambda; the velocity is the true one, by default the nominal."""
    velocity = radar.velocity_m_s if velocity_m_s is None else velocity_m_s
    return 2 * velocity * torch.sin(torch.deg2rad(torch.as_tensor(squint_deg, dtype=torch.float64))) / radar.wavelength_m


def build_damages(entries: Mapping[str, dict[str, Any]], where: str, file: str) -> dict[str, Any]:
    return {name: DAMAGES.make(entry, f"{where}.{name}", file) for name, entry in entries.items()}


def point_targets(scenes: Mapping[str, Scene]) -> dict[str, int]:
    """Names of the point targets, `part.number`, and their places among all scatterers."""
    names: dict[str, int] = {}
    first = 0
    for part, scene in scenes.items():
        count = len(scene.azimuth_m) if isinstance(scene, Points) else getattr(scene, "count", 0)
        if isinstance(scene, (Points, RandomPoints)):
            names.update({f"{part}.{i}": first + i for i in range(count)})
        first += count
    return names


def read_recording(loaded: Loaded) -> Recording:
    """The recording that data.file names."""
    assert loaded.config.data.file is not None
    try:
        return read_stripmap(loaded.config.data.file, precision(loaded.config))
    except (ValueError, OSError) as error:
        raise ConfigError(f"{loaded.file}: data.file: {' '.join(str(error).split()).removeprefix('data.file: ')}") from None


def build_case(loaded: Loaded) -> Case:
    """Simulate, or read and optionally damage a recording. Everything that the config says about it is checked first."""
    config = loaded.config
    draws = Draws(config.seed)
    if config.data.file is not None:
        damages = build_damages(config.data.damages, "data.damages", loaded.file)
        clean = read_recording(loaded)
        try:
            recording, told = apply_damages(clean, damages, draws)
        except ValueError as error:
            raise ConfigError(f"{loaded.file}: data.damages: {' '.join(str(error).split())}") from None
        return Case(recording, clean, Truth(told, clean) if damages else None, {})
    world, radar = build_world(loaded), build_radar(loaded)
    assert config.world is not None
    _refuse_oversize(config.world.lines, config.world.samples, loaded.file)
    damages = build_damages(config.world.damages, "world.damages", loaded.file)
    try:
        recording, truth = simulate(radar, world, config.world.lines, config.world.samples, draws, damages, precision(config))
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: world: {' '.join(str(error).split())}") from None
    assert truth.clean is not None and isinstance(world.scene, Together)
    clean, _ = apply_damages(truth.clean, {}, draws)
    return Case(recording, clean, truth, point_targets(world.scene.parts))


def _refuse_oversize(lines: int, samples: int, file: str) -> None:
    """A raw matrix larger than the memory of the machine is a slip of the pen."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not told on every system
        return
    if 8 * lines * samples > memory:
        raise ConfigError(
            f"{file}: world: {lines} lines of {samples} samples take {8 * lines * samples / 1e9:.3g} GB, and this machine has {memory / 1e9:.3g} GB; make world.lines or world.samples smaller"
        )


def build_chain(method: Method, where: str, file: str, radar: StripmapRadar) -> Chain:
    """The chain of a method. Raises ConfigError for an unknown stage, key or connection."""
    assert method.stages is not None
    built = {}
    for name, entry in method.stages.items():
        place = f"{where}.stages.{name}"
        if not name.isidentifier():
            raise ConfigError(f"{file}: {place}: a stage name is a word of letters, digits and '_', not starting with a digit")
        uses = entry.get("uses", {}) if isinstance(entry, dict) else {}
        if not (isinstance(uses, dict) and all(isinstance(v, str) for v in uses.values())):
            raise ConfigError(f"{file}: {place}.uses must map values of the stage to 'stage.value', got {uses!r}")
        stage = stages().make({k: v for k, v in entry.items() if k != "uses"} if isinstance(entry, dict) else entry, place, file, radar=radar)
        built[name] = use(stage, **uses)
    try:
        return Chain(**built)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: {where}: {' '.join(str(error).split())}") from None


def check_given(chain: Chain, method: Method, where: str, file: str) -> None:
    """Values that a rerun holds must be values of the chain."""
    assert method.rerun is not None
    offered = {f"{name}.{key}" for name, stage in chain.stages.items() for key in getattr(stage, "provides", ())}
    for name in method.rerun.given:
        if name not in offered:
            raise ConfigError(f"{file}: {where}.rerun.given.{name} is no value of that chain{did_you_mean(name, offered)}")


def resolved(loaded: Loaded) -> dict[str, Any]:
    """The whole config with every default filled in, catalogue entries included."""
    tree = loaded.config.model_dump(exclude_none=False)
    file = loaded.file
    if tree["world"] is not None:
        world = tree["world"]
        world["scene"] = {k: _full(SCENES, v, f"world.scene.{k}", file) for k, v in world["scene"].items()}
        world["beam"], world["path"] = _full(BEAMS, world["beam"], "world.beam", file), _full(PATHS, world["path"], "world.path", file)
        world["damages"] = {k: _full(DAMAGES, v, f"world.damages.{k}", file) for k, v in world["damages"].items()}
    tree["data"]["damages"] = {k: _full(DAMAGES, v, f"data.damages.{k}", file) for k, v in tree["data"]["damages"].items()}
    for name, method in tree["processor"].items():
        for stage, entry in (method["stages"] or {}).items():
            full = _full(stages(), {k: v for k, v in entry.items() if k != "uses"}, f"processor.{name}.stages.{stage}", file)
            method["stages"][stage] = {**full, **({"uses": entry["uses"]} if entry.get("uses") else {})}
    return tree


def _full(catalogue: Any, entry: dict[str, Any], where: str, file: str) -> dict[str, Any]:
    name, parameters = catalogue.check(entry, where, file)
    return {catalogue.key: name, **parameters}
