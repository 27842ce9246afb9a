"""The systems by name, and the way from a file to a checked config.

This is the only module that knows every system.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.settings.sections import Loaded, Sweep, checked
from torchsar.study.settings.text import find_config, override, read_tree
from torchsar.study.trials.system import System

# name of a system -> module that holds its class `SYSTEM`; further ones join by the entry point
# group `torchsar.systems` (name = "package.module")
SYSTEMS = {name: f"torchsar.study.systems.{name}" for name in ("stripmap", "isal", "isal_rotation", "sal")}
SYSTEMS |= {name: f"torchsar.study.systems.{name}" for name in ("geo", "geo_ocean")}


class _Systems(Mapping[str, System]):
    """Systems by name; a system is imported when it is asked for."""

    def __init__(self) -> None:
        self._made: dict[str, System] = {}

    def _modules(self) -> dict[str, str]:
        return {**SYSTEMS, **{point.name: point.value for point in entry_points(group="torchsar.systems")}}

    def __getitem__(self, name: str) -> System:
        if name not in self._made:
            self._made[name] = import_module(self._modules()[name]).SYSTEM()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules())

    def __len__(self) -> int:
        return len(self._modules())


systems: Mapping[str, System] = _Systems()


def load(name: str | Path, overrides: Sequence[str] = ()) -> Loaded:
    """Read, override and check a config.

    Args:
        name: A YAML file, or the name of a packaged config.
        overrides: key=value with dotted keys and YAML values.

    Returns:
        The checked config, every default filled in.

    Raises:
        ConfigError: In one sentence that names file, key, value and what is accepted.
    """
    path = find_config(str(name))
    settings = [field for field in Sweep.model_fields if field != "grid"]
    tree = override(read_tree(path), overrides, literal=("sweep", "grid", settings))
    file = str(path) + (f" with {' '.join(overrides)}" if overrides else "")
    system = _system_of(tree, file)
    return Loaded(checked(tree, system, file), system, file, path.stem)


def _system_of(tree: Any, file: str) -> System:
    name = tree.get("system", "stripmap")
    if not isinstance(name, str) or name not in systems:
        raise ConfigError(
            f"{file}: key 'system' has the value {name!r}; it should be one of "
            f"{', '.join(systems)}{did_you_mean(str(name), systems)}"
        )
    return systems[name]
