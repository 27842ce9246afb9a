"""Cases: variants of a config that differ in a few keys. Every method runs on every case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import LONGEST_NAME, RESERVED, Loaded
from torchsar.study.settings.text import fault_of_name

# name of the only case of a config that lists none
ALL = "all"
# sections that are common to all cases
_COMMON = ("title", "cases", "metrics", "trade", "sweep", "beyond_limits")


def cases_of(loaded: Loaded) -> dict[str, Loaded]:
    """Return the config of every case.

    Args:
        loaded: The config.

    Returns:
        Configs by the name of the case, in order. A config that lists no cases is its own only
        case, with the name "all".

    Raises:
        ConfigError: If the name of a case is not valid, a case changes nothing, or it changes a key
            that is common to all cases.
    """
    cases, file = loaded.config.cases, loaded.file
    words: dict[str, str] = {}
    for name, values in cases.items():
        _check_case(name, values, loaded)
        other = words.setdefault(word_of(name), name)
        if other != name:
            raise ConfigError(
                f"{file}: the files of the cases {name!r} and {other!r} would have the same names; choose names that "
                "differ in letters or digits"
            )
    changed = {name: loaded.changed(values, f"cases.{name}") for name, values in cases.items()}
    for name, case in changed.items():
        if list(case.config.processor) != list(loaded.config.processor):
            raise ConfigError(
                f"{file}: cases.{name} adds or removes a method, but every method runs on every case; a case may "
                "change only keys of stages"
            )
    return changed or {ALL: loaded}


def word_of(case: str) -> str:
    """Return the name of a case in a form that is valid within the name of a file."""
    return "".join(c if c.isalnum() else "_" for c in case)


def key_of(case: str, name: str) -> str:
    """Return the path of a result of a case; a '/' in the name of the case is replaced."""
    return name if case == ALL else f"{case.replace('/', '_')}/{name}"


def titled(title: str, case: str) -> str:
    """Return a title with the name of the case."""
    return title if case == ALL else f"{title}: {case}"


def _check_case(name: str, values: Mapping[str, Any], loaded: Loaded) -> None:
    """Raise ConfigError if the name of a case is not valid, or it changes a common key."""
    unusable = fault_of_name(name.replace("/", "_"), LONGEST_NAME)
    if not word_of(name).strip("_") or unusable or name in (*RESERVED, ALL):
        raise ConfigError(
            f"{loaded.file}: {name[:40]!r} is not a valid name of a case; it must contain letters or digits, must not "
            f"begin with '__', must be printable with {LONGEST_NAME} bytes at most, and must be none of "
            f"{', '.join((*RESERVED, ALL))}"
        )
    if not values:
        raise ConfigError(
            f"{loaded.file}: cases.{name} changes nothing; give it dotted keys with values, such as "
            "world.noise.snr_db: 10.0"
        )
    for key in values:
        root = key.split(".")[0]
        if root in _COMMON or key == "world.trials":
            raise ConfigError(
                f"{loaded.file}: cases.{name}: the key {key!r} is common to all cases; a case may change radar, world, "
                "data, processor, seed, random and precision"
            )
        if root == "data" and loaded.config.data.file is None:
            raise ConfigError(
                f"{loaded.file}: cases.{name}: a simulation does not use the key {key!r}; change the section world "
                "instead, or set data.file for all cases to process a recording"
            )
