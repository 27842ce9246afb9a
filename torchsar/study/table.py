"""The systems by name, and the reading of config files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from torchsar.study.settings.errors import ConfigError, did_you_mean, loading
from torchsar.study.settings.sections import Loaded, Sweep, checked
from torchsar.study.settings.text import find_config, override, read_tree
from torchsar.study.trials.system import System

# Modules with the class `SYSTEM` of each system, by name: all of `systems`. Other packages add
# systems by the entry point group `torchsar.systems` (name = "package.module").
_PACKAGE = "torchsar.study.systems"
SYSTEMS = {one.name: f"{_PACKAGE}.{one.name}" for one in iter_modules(import_module(_PACKAGE).__path__)}


class _Systems(Mapping[str, System]):
    """Systems by name; a system is imported on first use."""

    def __init__(self) -> None:
        self._made: dict[str, System] = {}

    def _modules(self) -> dict[str, Any]:
        added = {point.name: point for point in entry_points(group="torchsar.systems")}
        for name in added.keys() & SYSTEMS.keys():
            raise ConfigError(
                f"the entry point torchsar.systems:{name} ({added[name].value}) has the name of a built-in system; "
                "rename it, or uninstall its package"
            )
        return {**SYSTEMS, **added}

    def __getitem__(self, name: str) -> System:
        if name not in self._made:
            found = self._modules()[name]
            with nullcontext() if isinstance(found, str) else loading(found):
                self._made[name] = import_module(getattr(found, "value", found)).SYSTEM()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules())

    def __len__(self) -> int:
        return len(self._modules())


systems: Mapping[str, System] = _Systems()


def load(name: str | Path, overrides: Sequence[str] = ()) -> Loaded:
    """Read, override and check a config.

    Its files are sought from its folder, and then from the current one; those of overrides only
    from the current one.

    Args:
        name: A YAML file, or the name of a packaged config.
        overrides: key=value with dotted keys and YAML values.

    Returns:
        The checked config with all defaults.

    Raises:
        ConfigError: If the config is invalid; the message has file, key, value and the accepted
            values.
    """
    path = find_config(str(name))
    settings = [field for field in Sweep.model_fields if field != "grid"]
    tree = override(_beside(read_tree(path), path.parent), overrides, literal=("sweep", "grid", settings))
    file = str(path) + (f" with {' '.join(overrides)}" if overrides else "")
    system = _system_of(tree, file)
    return Loaded(checked(tree, system, file), system, file, path.stem)


def _beside(tree: Any, folder: Path, key: str = "") -> Any:
    """Return the config with full paths of the files that lie in its folder or below."""
    if isinstance(tree, dict):
        return {name: _beside(part, folder, name) for name, part in tree.items()}
    if isinstance(tree, list):
        return [_beside(part, folder, key) for part in tree]
    found = key.rpartition(".")[2] == "file" and isinstance(tree, str) and (folder / tree).is_file()
    return str(folder / tree) if found else tree


def _system_of(tree: Any, file: str) -> System:
    name = tree.get("system", "stripmap")
    if not isinstance(name, str) or name not in systems:
        raise ConfigError(
            f"{file}: key 'system' has the value {name!r}, which is no system{did_you_mean(str(name), systems)}"
        )
    return systems[name]
