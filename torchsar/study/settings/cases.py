"""Cases: one config, changed in a few keys a case; every method runs on each of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import RESERVED, Loaded

# the name that the results of a config without cases go by
ALL = "all"
_OF_ALL_CASES = ("title", "cases", "metrics", "trade", "sweep", "beyond_limits")


def cases_of(loaded: Loaded) -> dict[str, Loaded]:
    """Every case of a config as a config of its own, in order; the config itself as "all" if it
    has none.

    Raises:
        ConfigError: If a case has an unusable name, changes nothing or changes what it may not.
    """
    cases, file = loaded.config.cases, loaded.file
    words: dict[str, str] = {}
    for name, values in cases.items():
        _refuse_case(name, values, loaded)
        other = words.setdefault(word_of(name), name)
        if other != name:
            raise ConfigError(
                f"{file}: cases {name!r} and {other!r} would share their figures; name them apart by letters or digits"
            )
    changed = {name: loaded.changed(values, f"cases.{name}") for name, values in cases.items()}
    for name, case in changed.items():
        if list(case.config.processor) != list(loaded.config.processor):
            raise ConfigError(
                f"{file}: cases.{name} changes which methods there are; every method runs on every case, so a case may "
                "change only keys of their stages"
            )
    return changed or {ALL: loaded}


def word_of(case: str) -> str:
    """The name of a case as a part of names of files."""
    return "".join(c if c.isalnum() else "_" for c in case)


def key_of(case: str, name: str) -> str:
    """Path of what belongs to a case in results; a '/' in the name of a case makes no group."""
    return name if case == ALL else f"{case.replace('/', '_')}/{name}"


def titled(title: str, case: str) -> str:
    """A title with the name of its case."""
    return title if case == ALL else f"{title}: {case}"


def _refuse_case(name: str, values: Mapping[str, Any], loaded: Loaded) -> None:
    """A case has a name that results can go by, and changes what a case may change."""
    if not word_of(name).strip("_") or name.startswith("__") or name in (*RESERVED, ALL):
        raise ConfigError(
            f"{loaded.file}: a case cannot be called {name!r}; its name has letters or digits, does not begin with "
            f"'__', and is none of {', '.join((*RESERVED, ALL))}"
        )
    if not values:
        raise ConfigError(
            f"{loaded.file}: cases.{name} changes nothing; give it dotted keys with values, such as "
            "world.noise.snr_db: 10.0"
        )
    for key in values:
        root = key.split(".")[0]
        if root in _OF_ALL_CASES or key == "world.trials":
            raise ConfigError(
                f"{loaded.file}: cases.{name}: the key {key!r} holds for all cases; a case may change radar, world, "
                "data, processor, seed and precision"
            )
        if root == "data" and loaded.config.data.file is None:
            raise ConfigError(
                f"{loaded.file}: cases.{name}: the key {key!r} is not used by a simulation, whose impairments are keys "
                "of the world; set data.file to work on a recording"
            )
