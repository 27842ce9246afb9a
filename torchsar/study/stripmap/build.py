"""From a checked config to a stripmap radar and a recording with its truth."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import apply_impairments, simulate
from torchsar.io import read_stripmap
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Points, RandomPoints, Scene, StripmapWorld, Together
from torchsar.study.build import Case, build_impairments, precision, refuse_oversize
from torchsar.study.config import Loaded
from torchsar.study.registry import BEAMS, PATHS, SCENES
from torchsar.study.settings.errors import ConfigError


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
    return (
        world.doppler_hz
        if world.squint_deg is None
        else float(squint_doppler_hz(build_radar(loaded), world.squint_deg, world.velocity_m_s))
    )


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
    """Doppler of the beam centre at a squint, 2 v sin(squint) / lambda; the velocity is the true
    one, by default the nominal.
    """
    velocity = radar.velocity_m_s if velocity_m_s is None else velocity_m_s
    return (
        2 * velocity * torch.sin(torch.deg2rad(torch.as_tensor(squint_deg, dtype=torch.float64))) / radar.wavelength_m
    )


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
        raise ConfigError(
            f"{loaded.file}: data.file: {' '.join(str(error).split()).removeprefix('data.file: ')}"
        ) from None


def build_case(loaded: Loaded) -> Case:
    """Simulate, or read and optionally impairment a recording.

    Everything that the config says about it is checked first.
    """
    config = loaded.config
    draws = Draws(config.seed)
    if config.data.file is not None:
        impairments = build_impairments(config.data.impairments, "data.impairments", loaded.file)
        clean = read_recording(loaded)
        try:
            recording, told = apply_impairments(clean, impairments, draws)
        except ValueError as error:
            raise ConfigError(f"{loaded.file}: data.impairments: {' '.join(str(error).split())}") from None
        return Case(recording, clean, Truth(told, clean) if impairments else None, {})
    world, radar = build_world(loaded), build_radar(loaded)
    assert config.world is not None
    refuse_oversize(config.world.lines, config.world.samples, loaded.file, "world.lines or world.samples")
    impairments = build_impairments(config.world.impairments, "world.impairments", loaded.file)
    try:
        recording, truth = simulate(
            radar, world, config.world.lines, config.world.samples, draws, impairments, precision(config)
        )
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: world: {' '.join(str(error).split())}") from None
    assert truth.clean is not None and isinstance(world.scene, Together)
    clean, _ = apply_impairments(truth.clean, {}, draws)
    return Case(recording, clean, truth, point_targets(world.scene.parts))
