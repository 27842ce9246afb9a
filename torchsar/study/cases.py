"""Cases of a run: one config, changed in a few keys a case, every method on each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

from pydantic import model_validator

from torchsar.study.config import RESERVED, Config, Loaded, check_methods
from torchsar.study.settings.errors import ConfigError

_OF_ALL_CASES = ("system", "title", "cases", "metrics", "trade", "sweep")


class CasedConfig(Config):
    """An experiment of several cases; cases: name -> dotted keys with the values that make the
    case.
    """

    cases: dict[str, dict[str, Any]] = {}


class LimitedConfig(CasedConfig):
    """Cases that limits may stop; beyond_limits: methods that the config shows beyond their limits
    on purpose, of which it only warns.
    """

    beyond_limits: list[str] = []

    @model_validator(mode="after")
    def _known_methods(self) -> Self:
        for name in self.beyond_limits:
            if name not in self.processor:
                raise ValueError(f"beyond_limits names the method {name!r}; there is {', '.join(self.processor)}")
        return self


def cases_of(loaded: Loaded) -> dict[str, Loaded]:
    """Every case of a run as a config of its own, in the order of the config; one without a name
    where there are none. Raises ConfigError.
    """
    assert isinstance(loaded.config, CasedConfig)
    cases = loaded.config.cases
    for name, values in cases.items():
        _refuse_case(name, values, loaded)
    words = {word_of(name): name for name in cases}
    for name in cases:
        if words[word_of(name)] != name:
            raise ConfigError(
                f"{loaded.file}: cases {name!r} and {words[word_of(name)]!r} would share their "
                "figures; name them apart by letters or digits"
            )
    changed = {name: loaded.changed(values, f"cases.{name}") for name, values in cases.items()}
    for name, case in changed.items():
        if list(case.config.processor) != list(loaded.config.processor):
            raise ConfigError(
                f"{loaded.file}: cases.{name} changes which methods there are; every method runs on "
                "every case, so a case may change only keys of their stages"
            )
    return changed or {"": loaded}


def word_of(case: str) -> str:
    """The name of a case as a part of names of files."""
    return "".join(c if c.isalnum() else "_" for c in case)


def key_of(case: str, name: str) -> str:
    """Path in the store of what belongs to a case; a '/' in the name of a case makes no group."""
    return name if case == "all" else f"{case.replace('/', '_')}/{name}"


def _refuse_case(name: str, values: Mapping[str, Any], loaded: Loaded) -> None:
    """A case has a name that results can go by, and changes what a case may change."""
    if not word_of(name).strip("_") or name.startswith("__") or name in (*RESERVED, "all"):
        raise ConfigError(
            f"{loaded.file}: a case cannot be called {name!r}; its name has letters or digits, "
            f"does not begin with '__', and is none of {', '.join((*RESERVED, 'all'))}"
        )
    if not values:
        raise ConfigError(
            f"{loaded.file}: cases.{name} changes nothing; give it dotted keys with values, such "
            "as world.noise.snr_db: 10.0"
        )
    for key in values:
        root = key.split(".")[0]
        if root in _OF_ALL_CASES or key == "world.trials":
            raise ConfigError(
                f"{loaded.file}: cases.{name}: the key {key!r} holds for all cases; a case may change "
                "radar, world, data, processor, seed and precision"
            )
        if root == "data" and loaded.config.data.file is None:
            raise ConfigError(
                f"{loaded.file}: cases.{name}: the key {key!r} is not used by a simulation, whose "
                "impairments are keys of the world; set data.file to work on a recording"
            )


def check_judged(loaded: Loaded) -> None:
    """Methods have stages of their own, and the reference is one of unimpaired input."""
    for name, method in loaded.config.processor.items():
        if method.rerun is not None:
            raise ConfigError(
                f"{loaded.file}: processor.{name}.rerun: system {loaded.config.system} runs no part "
                "of a chain again; give the method 'stages' of its own"
            )
    reference = loaded.config.metrics.reference
    if reference is not None and loaded.config.processor[reference].input != "clean":
        raise ConfigError(
            f"{loaded.file}: metrics.reference names {reference!r}, whose image is not the ideal "
            "one; name a method with 'input: clean'"
        )


def refuse_recordings(loaded: Loaded) -> None:
    """Raise ConfigError for a config of a recording, where a system judges by the truth of what it
    simulates.
    """
    config = loaded.config
    if config.data.file is not None or config.world is None:
        instead = (
            "leave data.file out and give the sections 'radar' and 'world'; systems stripmap and isal read recordings"
        )
        raise ConfigError(
            f"{loaded.file}: data.file: system {config.system} simulates and reads no recordings; {instead}"
        )


def check_simulated(loaded: Loaded, check: Callable[[Loaded], None], heed: Callable[[Loaded, str], None]) -> None:
    """What comes before a run that simulates: methods, no recording, all that the config names, and
    the limits of every case (heed). Raises ConfigError.
    """
    check_methods(loaded.config, loaded.file)
    refuse_recordings(loaded)
    check(loaded)
    for name, case in cases_of(loaded).items():
        heed(case, name)


def check_sweep(loaded: Loaded, grid: Mapping[str, Any], example: str) -> None:
    """Refuse a sweep over what a sweep does not use; example: a key to sweep over instead of cases.

    Raises ConfigError.
    """
    assert isinstance(loaded.config, CasedConfig)
    if loaded.config.cases:
        raise ConfigError(
            f"{loaded.file}: cases belong to runs; sweep over the keys that they change, such as "
            f"{example}, and add cases={{}} to leave them out"
        )
    for key in grid:
        if key.split(".")[0] == "cases" or key == "world.trials":
            raise ConfigError(f"{loaded.file}: sweep: the key {key!r} belongs to runs and cannot be swept")


def methods_tree(
    loaded: Loaded, by_case: Mapping[str, Mapping[str, Mapping[str, float]]], first_only: bool = False
) -> dict[str, dict[str, Any]]:
    """The part `methods` of metrics.json: by method, means over all cases as `metrics`, and every
    case under `cases`. by_case: case -> method -> metric.

    first_only: `metrics` are those of the first case instead, where cases differ too much for a
    mean.
    """
    methods = {}
    for name, method in loaded.config.processor.items():
        rows = {case: rows[name] for case, rows in by_case.items()}
        judged = list(rows.values())[:1] if first_only else list(rows.values())
        keys = dict.fromkeys(key for row in judged for key in row if not key.endswith("_sd"))
        metrics = {
            key: sum(row[key] for row in judged if key in row) / sum(key in row for row in judged) for key in keys
        }
        methods[name] = {"title": method.title, "metrics": metrics, "estimates": {}, "targets": {}, "cases": rows}
    return methods
