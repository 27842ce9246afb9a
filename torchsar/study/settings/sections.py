"""A checked config: the sections that every system has, and those of the system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field, ValidationError, model_validator

from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.settings.plausible import refuse_implausible
from torchsar.study.settings.sentences import Strict, sentence
from torchsar.study.settings.signature import Catalogue, Section
from torchsar.study.settings.text import dump

# how true values were named before they had a name of their own
_OLD_TRUTH = "aux.true_"
# names that group results, and therefore cannot be those of methods
RESERVED = ("truth", "estimate")


class Data(Strict):
    """Recorded data instead of a simulated world; impairments are put into the recording."""

    file: str | None = None
    impairments: dict[str, Any] = {}


class Rerun(Strict):
    """A part of another method's chain, run again on what entered it, with values held fixed."""

    method: str
    start: str
    given: dict[str, float]


class Method(Strict):
    """One chain.

    Fields:
        title: For the report.
        input: What the chain gets: the impaired recording or the clean one.
        oracle: Whether its stages may use true values, `truth.NAME`: it shows what could be had at
            best.
        stages: Stages by name.
        rerun: Instead of stages, a part of another method's chain.
    """

    title: str = ""
    input: Literal["impaired", "clean"] = "impaired"
    oracle: bool = False
    stages: dict[str, dict[str, Any]] | None = None
    rerun: Rerun | None = None

    @model_validator(mode="after")
    def _one_of(self) -> Method:
        if (self.stages is None) == (self.rerun is None):
            raise ValueError("a method has either 'stages' (at least one) or 'rerun'")
        if self.stages is not None and not self.stages:
            raise ValueError("'stages' must name at least one stage")
        return self


class Trade(Strict):
    """How `torchsar trade` and `torchsar requires` decide, and how often alternatives are timed.

    Fields:
        tolerance: Largest loss that is acceptable, by metric; those of the system by default.
        trials: Trials on which estimators are compared.
        repeats: Timings of each alternative, interleaved with those of the others.
    """

    tolerance: dict[str, float] = {}
    trials: int = Field(default=4, ge=1)
    repeats: int = Field(default=3, ge=1)


class EarlyStop(Strict):
    """Ends a point once half of the 95 % interval of a statistic is below `relative` times it."""

    metric: str
    relative: float = Field(gt=0, lt=1)
    statistic: Literal["rmse", "mean", "median"] = "rmse"


class Save(Strict):
    """Trials whose images, and the outputs of the named stages, are kept in the store."""

    trials: list[int] = []
    taps: list[str] = []


class Sweep(Strict):
    """A Monte Carlo sweep. Keys that are not settings are keys of the config with their values.

    Fields:
        grid: Dotted key -> list of values, or mapping of labels to values.
        trials: Trials of each point, or their limit where points end early.
        chunk: Trials of a batch, chosen by memory where it is not given.
        success: Metric -> largest magnitude with which a trial counts as a success.
        show: Metrics to draw, by default all errors.
        save: Trials whose images are kept.
    """

    grid: dict[str, Any] = {}
    trials: int = Field(default=200, ge=1)
    chunk: int | None = Field(default=None, ge=1)
    stop: EarlyStop | None = None
    success: dict[str, Annotated[float, Field(ge=0)]] = {}
    show: list[str] = []
    save: Save = Save()

    @model_validator(mode="before")
    @classmethod
    def _keys_into_grid(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        loose = {key: value for key, value in given.items() if key not in cls.model_fields}
        known = {key: value for key, value in given.items() if key in cls.model_fields}
        return {**known, "grid": {**(known.get("grid") or {}), **loose}} if loose else known


class Config(Strict):
    """A whole experiment. The system gives `radar`, `world` and `metrics` their keys.

    Fields:
        cases: Name -> dotted keys with the values that make the case.
        beyond_limits: Methods that the config shows beyond their limits on purpose.
    """

    system: str = "stripmap"
    title: str
    seed: int = Field(default=1, ge=0)
    precision: Literal["complex64", "complex128"] = "complex64"
    radar: dict[str, Any] | None = None
    world: dict[str, Any] | None = None
    data: Data = Data()
    processor: dict[str, Method] = Field(min_length=1)
    metrics: dict[str, Any] = {}
    trade: Trade = Trade()
    sweep: Sweep = Sweep()
    cases: dict[str, dict[str, Any]] = {}
    beyond_limits: list[str] = []

    @model_validator(mode="after")
    def _whole(self) -> Config:
        if "recommended" not in self.processor:
            raise ValueError("processor needs a method called 'recommended'")
        if self.processor["recommended"].stages is None:
            raise ValueError("processor.recommended needs stages of its own")
        taken = next((name for name in RESERVED if name in self.processor), None)
        if taken is not None:
            raise ValueError(f"processor.{taken}: this name is taken by a group of the results; choose another")
        for key, names in (
            ("beyond_limits", self.beyond_limits),
            ("metrics.reference", [self.metrics.get("reference")]),
        ):
            unknown = next((name for name in names if name is not None and name not in self.processor), None)
            if unknown is not None:
                raise ValueError(f"{key} names the method {unknown!r}; there is {', '.join(self.processor)}")
        return self


class Sections(Protocol):
    """What a system says of the keys of its sections."""

    @property
    def sections(self) -> Mapping[str, Section]: ...

    @property
    def stages(self) -> Catalogue: ...

    @property
    def recording_impairments(self) -> Catalogue: ...

    @property
    def reads(self) -> str: ...


@dataclass(frozen=True)
class Loaded:
    """A checked config: what its file and the command line say, every default filled in.

    Args:
        config: The sections; `radar`, `world`, `metrics` and stages are mappings of complete keys.
        system: The system that it belongs to.
        file: Name of the file with the overrides, for messages.
        name: Name of the file without its ending.
    """

    config: Config
    system: Any
    file: str
    name: str

    def changed(self, values: Mapping[str, Any], where: str = "sweep") -> Loaded:
        """The same config with other values at dotted keys.

        Args:
            values: Values by dotted key; numbers in a path count the entries of a list.
            where: Where the values stand, for messages.

        Raises:
            ConfigError: If a key leads nowhere, a value is not accepted, or the system changes.
        """
        tree = self.config.model_dump()
        for key, value in sorted(values.items(), key=lambda item: item[0].count(".")):  # sections before their parts
            if key == "system":
                raise ConfigError(f"{self.file}: {where}: the key 'system' cannot be changed")
            tree = _placed(tree, key.split("."), value, f"{self.file}: {where}: the key {key!r}")
        return replace(self, config=checked(tree, self.system, f"{self.file}: {where}"))

    def text(self) -> str:
        """The resolved config as YAML."""
        return dump(self.config.model_dump())


def _placed(tree: Any, path: list[str], value: Any, what: str) -> Any:
    """The tree with one value changed; all but the last part of the path must be there."""
    head, rest = path[0], path[1:]
    if isinstance(tree, list) and head.isdecimal() and int(head) < len(tree):
        index = int(head)
        return [*tree[:index], _placed(tree[index], rest, value, what) if rest else value, *tree[index + 1 :]]
    if not isinstance(tree, dict) or (rest and head not in tree):
        raise ConfigError(
            f"{what} leads nowhere at {head!r}{did_you_mean(head, tree if isinstance(tree, dict) else ())}"
        )
    return {**tree, head: _placed(tree[head], rest, value, what) if rest else value}


def checked(tree: Any, system: Sections, file: str) -> Config:
    """The config in a tree, its sections completed.

    Raises:
        ConfigError: In one sentence that names file, key, value and what is accepted.
    """
    try:
        config = Config.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(sentence(error, Config, file)) from None
    _check_source(config, system, file)
    sections = {name: getattr(config, name) for name in system.sections}
    made = {n: None if tree is None else system.sections[n].check(tree, n, file) for n, tree in sections.items()}
    refuse_implausible(config.system, made["radar"], made["world"], file)
    found = config.data.impairments
    kept = {n: system.recording_impairments.check(entry, f"data.impairments.{n}", file) for n, entry in found.items()}
    methods = {name: _method(method, f"processor.{name}", system, file) for name, method in config.processor.items()}
    check_reruns(methods, file)
    data = config.data.model_copy(update={"impairments": kept})
    return config.model_copy(update={**made, "data": data, "processor": methods})


def _method(method: Method, where: str, system: Sections, file: str) -> Method:
    """The method with all keys of its stages."""
    stages = {}
    for name, entry in (method.stages or {}).items():
        uses = entry.get("uses", {})
        if not (isinstance(uses, dict) and all(isinstance(source, str) for source in uses.values())):
            raise ConfigError(f"{file}: {where}.stages.{name}.uses must map values to 'stage.value', got {uses!r}")
        old = next((source for source in uses.values() if source.startswith(_OLD_TRUTH)), None)
        if old is not None:
            new = f"truth.{old.removeprefix(_OLD_TRUTH)}"
            raise ConfigError(f"{file}: {where}.stages.{name}.uses: {old!r} is now called {new!r}; rename it")
        rest = {key: value for key, value in entry.items() if key != "uses"}
        stages[name] = {**system.stages.check(rest, f"{where}.stages.{name}", file), **({"uses": uses} if uses else {})}
    return method.model_copy(update={"stages": stages or None})


def _check_source(config: Config, system: Sections, file: str) -> None:
    """A config has a file of recorded data, or both radar and world."""
    recorded = config.data.file
    if recorded is None:
        missing = [name for name in ("radar", "world") if getattr(config, name) is None]
        if len(missing) == 2 and system.reads:
            raise ConfigError(f"{file}: data.file is not set; add data.file=PATH, a {system.reads} .npz file")
        if missing:
            raise ConfigError(f"{file}: section {missing[0]!r} is missing; a simulation needs 'radar' and 'world'")
    elif not system.reads:
        raise ConfigError(f"{file}: data.file: system {config.system} simulates and reads no recordings; leave it out")
    elif not Path(recorded).is_file():
        what = "is no file" if Path(recorded).exists() else "does not exist"
        raise ConfigError(f"{file}: data.file: {recorded!r} {what}; give the path of a {system.reads} .npz file")


def check_reruns(methods: Mapping[str, Method], file: str) -> None:
    """Reruns name an earlier method with stages, and a stage of it.

    Raises:
        ConfigError: If one does not.
    """
    earlier: dict[str, Method] = {}
    for name, method in methods.items():
        if method.rerun is not None:
            of, start = earlier.get(method.rerun.method), method.rerun.start
            where = f"{file}: processor.{name}.rerun"
            if of is None or of.stages is None:
                raise ConfigError(
                    f"{where}.method names {method.rerun.method!r}, which is no earlier method with "
                    f"stages{did_you_mean(method.rerun.method, earlier)}"
                )
            if start not in of.stages:
                raise ConfigError(
                    f"{where}.start names {start!r}, which is no stage of "
                    f"{method.rerun.method!r}{did_you_mean(start, of.stages)}"
                )
        earlier[name] = method
