"""From a checked config to chains and impairments, whatever the system."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from torchsar.core import Chain, Recording, Truth, use
from torchsar.radar import LIGHT_M_S, BistaticRadar, InverseRadar, StripmapRadar, TriangularLadar
from torchsar.study.catalogue import Catalogue
from torchsar.study.config import Config, Loaded, Method
from torchsar.study.registry import IMPAIRMENTS, stages
from torchsar.study.settings.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Case:
    """What the methods get (recording; clean is the same without impairment), and what only metrics
    may see.

    targets: names of the point targets and their indices among the scatterers of the truth.
    """

    recording: Recording
    clean: Recording
    truth: Truth | None
    targets: Mapping[str, int]


def precision(config: Config) -> torch.dtype:
    return {"complex64": torch.complex64, "complex128": torch.complex128}[config.precision]


def build_impairments(
    entries: Mapping[str, dict[str, Any]], where: str, file: str, catalogue: Catalogue = IMPAIRMENTS
) -> dict[str, Any]:
    return {name: catalogue.make(entry, f"{where}.{name}", file) for name, entry in entries.items()}


def build_chain(method: Method, where: str, file: str, **given: Any) -> Chain:
    """The chain of a method; `given` (such as radar) is what stages take from the recording.

    Raises ConfigError for an unknown stage, key or connection.
    """
    assert method.stages is not None
    built = {}
    for name, entry in method.stages.items():
        place = f"{where}.stages.{name}"
        if not name.isidentifier():
            raise ConfigError(
                f"{file}: {place}: a stage name is a word of letters, digits and '_', not starting with a digit"
            )
        uses = entry.get("uses", {}) if isinstance(entry, dict) else {}
        if not (isinstance(uses, dict) and all(isinstance(v, str) for v in uses.values())):
            raise ConfigError(f"{file}: {place}.uses must map values of the stage to 'stage.value', got {uses!r}")
        try:
            stage = stages().make(
                {k: v for k, v in entry.items() if k != "uses"} if isinstance(entry, dict) else entry,
                place,
                file,
                **given,
            )
        except AttributeError as error:
            raise ConfigError(f"{file}: {place}: {foreign(error)}") from None
        built[name] = use(stage, **uses)
    try:
        return Chain(**built)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: {where}: {' '.join(str(error).split())}") from None


def foreign(error: AttributeError) -> str:
    """The sentence for a stage that asks its radar for what only another system's has.

    Any other AttributeError is a fault of the program and goes on.
    """
    if not isinstance(error.obj, (StripmapRadar, InverseRadar, TriangularLadar, BistaticRadar)):
        raise error
    return (
        f"this stage needs radar.{error.name}, which a radar of this system does not have; it "
        "is a stage of another system"
    )


def check_given(chain: Chain, method: Method, where: str, file: str) -> None:
    """Values that a rerun holds must be values of the chain."""
    assert method.rerun is not None
    offered = {f"{name}.{key}" for name, stage in chain.stages.items() for key in getattr(stage, "provides", ())}
    for name in method.rerun.given:
        if name not in offered:
            raise ConfigError(
                f"{file}: {where}.rerun.given.{name} is no value of that chain{did_you_mean(name, offered)}"
            )


def resolved(loaded: Loaded) -> dict[str, Any]:
    """The whole config with every default filled in, catalogue entries included."""
    tree = loaded.config.model_dump(exclude_none=False)
    file = loaded.file
    if tree["world"] is not None:
        world = tree["world"]
        for section, catalogue in loaded.config.world.single.items():
            if world[section] is not None:
                world[section] = _full(catalogue, world[section], f"world.{section}", file)
        for section, catalogue in loaded.config.world.named.items():
            world[section] = {k: _full(catalogue, v, f"world.{section}.{k}", file) for k, v in world[section].items()}
    tree["data"]["impairments"] = {
        k: _full(IMPAIRMENTS, v, f"data.impairments.{k}", file) for k, v in tree["data"]["impairments"].items()
    }
    for name, method in tree["processor"].items():
        for stage, entry in (method["stages"] or {}).items():
            full = _full(
                stages(), {k: v for k, v in entry.items() if k != "uses"}, f"processor.{name}.stages.{stage}", file
            )
            method["stages"][stage] = {**full, **({"uses": entry["uses"]} if entry.get("uses") else {})}
    return tree


def _full(catalogue: Catalogue, entry: dict[str, Any], where: str, file: str) -> dict[str, Any]:
    name, parameters = catalogue.check(entry, where, file)
    return {catalogue.key: name, **parameters}


def refuse_oversize(lines: int, samples: int, file: str, smaller: str) -> None:
    """A raw matrix larger than the memory of the machine is a slip of the pen.

    smaller: the keys to make smaller.
    """
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not told on every system
        return
    if 8 * lines * samples > memory:
        raise ConfigError(
            f"{file}: world: {lines} lines of {samples} samples take "
            f"{8 * lines * samples / 1e9:.3g} GB, and this machine has {memory / 1e9:.3g} GB; "
            f"make {smaller} smaller"
        )


def carried(radar: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a section `radar` with carrier_hz in place of the wavelength_m that it may give
    instead.
    """
    values = dict(radar)
    wavelength = values.pop("wavelength_m")
    return values if wavelength is None else {**values, "carrier_hz": LIGHT_M_S / wavelength}
