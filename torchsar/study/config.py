"""The sections of a config, read and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, model_validator

from torchsar.study.catalogue import Strict, sentence
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.settings.text import dump, find_config, override, read_tree

RESERVED = ("truth", "estimate")


class Noise(Strict):
    """Receiver noise."""

    snr_db: float | None = None


class Data(Strict):
    """Recorded data instead of a simulated world; impairments are put into the recording."""

    file: str | None = None
    impairments: dict[str, dict[str, Any]] = {}


class Rerun(Strict):
    """A part of another method's chain, run again on what entered it, with values held fixed."""

    method: str
    start: str
    given: dict[str, float]


class Method(Strict):
    """One chain: a title for the report, the input (impaired, or the unimpaired `clean`), and
    either stages by name or a rerun.
    """

    title: str = ""
    input: Literal["impaired", "clean"] = "impaired"
    stages: dict[str, dict[str, Any]] | None = None
    rerun: Rerun | None = None

    @model_validator(mode="after")
    def _one_of(self) -> Method:
        if (self.stages is None) == (self.rerun is None):
            raise ValueError("a method has either 'stages' (at least one) or 'rerun'")
        if self.stages is not None and not self.stages:
            raise ValueError("'stages' must name at least one stage")
        return self


class EarlyStop(Strict):
    """Ends a point once half of the 95 % interval of a statistic is below `relative` times the
    statistic.
    """

    metric: str
    relative: float = Field(gt=0, lt=1)
    statistic: Literal["rmse", "mean", "median"] = "rmse"


class Save(Strict):
    """Trials whose images (and the outputs of the named stages) are kept in the store."""

    trials: list[int] = []
    taps: list[str] = []


class Sweep(Strict):
    """A Monte Carlo sweep: settings, and every other key is a key of the config with the values it
    takes.

    grid: dotted key -> list of values, or mapping of labels to values. trials: per point, or the
    limit where points end early. chunk: trials a batch, chosen by bytes where it is not given.
    success: metric -> limit of its magnitude below which a trial counts as a success. show: metrics
    to draw, by default all errors. save: trials whose images are kept.
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
    """A whole experiment; a system gives the sections radar, world, metrics and trade their
    keys.
    """

    recording: ClassVar[str] = "recorded"

    system: str = "stripmap"
    title: str
    seed: int = Field(default=1, ge=0)
    precision: Literal["complex64", "complex128"] = "complex64"
    radar: Any = None
    world: Any = None
    data: Data = Data()
    processor: dict[str, Method] = Field(min_length=1)
    metrics: Any = None
    trade: Any = None
    sweep: Sweep = Sweep()

    @model_validator(mode="after")
    def _whole(self) -> Config:
        if "recommended" not in self.processor:
            raise ValueError("processor needs a method called 'recommended'")
        if self.processor["recommended"].stages is None:
            raise ValueError("processor.recommended needs stages of its own")
        for name in RESERVED:
            if name in self.processor:
                raise ValueError(f"processor.{name}: this name is taken by a group of the results; choose another")
        if (
            self.metrics is not None
            and self.metrics.reference is not None
            and self.metrics.reference not in self.processor
        ):
            raise ValueError(
                f"metrics.reference names the method {self.metrics.reference!r}; there is {', '.join(self.processor)}"
            )
        return self


@dataclass(frozen=True)
class Loaded:
    """A checked config, the file it came from and what the command line changed."""

    config: Config
    file: str
    name: str

    def changed(self, values: Mapping[str, Any], where: str = "sweep") -> Loaded:
        """The same config with other values at dotted keys, which stand at `where`.

        Raises ConfigError where a key leads nowhere or a value is not accepted.
        """
        tree = self.config.model_dump()
        for key, value in sorted(
            values.items(), key=lambda item: item[0].count(".")
        ):  # a part of a section after the section itself
            tree = _placed(tree, key.split("."), value, f"{self.file}: {where}: the key {key!r}")
        return replace(self, config=_checked(tree, f"{self.file}: {where}"))

    def text(self, tree: dict[str, Any] | None = None) -> str:
        """The resolved config as YAML."""
        return dump(self.config.model_dump() if tree is None else tree)


def _placed(tree: Any, path: list[str], value: Any, what: str) -> dict[str, Any]:
    """The tree with one value changed; all but the last part of the path must be there."""
    head, rest = path[0], path[1:]
    if not isinstance(tree, dict) or (rest and head not in tree):
        raise ConfigError(
            f"{what} leads nowhere at {head!r}{did_you_mean(head, tree if isinstance(tree, dict) else ())}"
        )
    return {**tree, head: _placed(tree[head], rest, value, what) if rest else value}


def load(name: str, assignments: Sequence[str] = ()) -> Loaded:
    """Read, override and check a config.

    Raises ConfigError: file, key, value, and what is accepted.
    """
    path = find_config(name)
    tree = override(
        read_tree(path), assignments, literal=("sweep", "grid", [name for name in Sweep.model_fields if name != "grid"])
    )
    file = str(path) + (f" with {' '.join(assignments)}" if assignments else "")
    return Loaded(_checked(tree, file), file, path.stem)


def _checked(tree: Any, file: str) -> Config:
    from torchsar.study.systems import system_named  # the systems build on this module

    kind = system_named(tree.get("system", "stripmap") if isinstance(tree, dict) else "stripmap", file).config
    try:
        config = kind.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(sentence(error, kind, file)) from None
    _check_source(config, file)
    return config


def _check_source(config: Config, file: str) -> None:
    if config.data.file is not None:
        path = Path(config.data.file)
        if not path.is_file():
            raise ConfigError(
                f"{file}: data.file: {config.data.file!r} "
                f"{'is no file' if path.exists() else 'does not exist'}; give the path of a "
                f"{config.recording} .npz file"
            )
    elif config.world is None and config.radar is None:
        raise ConfigError(
            f"{file}: data.file is not set; add data.file=PATH with the path of a {config.recording} .npz file"
        )
    elif config.world is None or config.radar is None:
        missing = "world" if config.world is None else "radar"
        raise ConfigError(
            f"{file}: section {missing!r} is missing; a simulation needs both 'radar' and "
            "'world', recorded data needs data.file"
        )


def check_methods(config: Config, file: str) -> None:
    """Reruns name an earlier method with stages, and a stage of it."""
    earlier: dict[str, Method] = {}
    for name, method in config.processor.items():
        if method.rerun is not None:
            of = earlier.get(method.rerun.method)
            if of is None or of.stages is None:
                raise ConfigError(
                    f"{file}: processor.{name}.rerun.method names {method.rerun.method!r}, which is no "
                    f"earlier method with stages{did_you_mean(method.rerun.method, earlier)}"
                )
            if method.rerun.start not in of.stages:
                raise ConfigError(
                    f"{file}: processor.{name}.rerun.start names {method.rerun.start!r}, which is no "
                    f"stage of {method.rerun.method!r}{did_you_mean(method.rerun.start, of.stages)}"
                )
        earlier[name] = method
