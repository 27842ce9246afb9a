"""Config sections: those that are the same for every system, and the checks of a whole config."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from torchsar.core import Source
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.settings.signature import Strict, sentence
from torchsar.study.settings.text import dump, fault_of_name

# prefix of true values in configs of earlier versions
_OLD_TRUTH = "aux.true_"
# names of groups in the results, which methods and cases must not have
RESERVED = ("truth", "estimate")
# largest number of bytes in the name of a method, a stage or a case, because names of files contain
# all three
LONGEST_NAME = 60


class Data(Strict):
    """Recorded data instead of a simulated world; `impairments` are added to the recording.

    `channel` is that of a file with several, such as CPHD.
    """

    file: str | None = None
    channel: str | None = None
    impairments: dict[str, Any] = {}


class Rerun(Strict):
    """A repetition of the last stages of another method, with given values for some estimates.

    Fields:
        method: The other method.
        start: The first stage that is run again, on the same input as before.
        given: Values that replace estimates of that method, by `stage.value`.
    """

    method: str
    start: str
    given: dict[str, float]


# keys of a stage that describe its connections in the chain and are no arguments of its constructor
OF_CHAIN = ("uses", "in_doubt")


class Method(Strict):
    """One processing chain.

    Fields:
        title: Title in the report.
        input: Input of the chain: the impaired recording or the clean one.
        oracle: Whether the stages may use true values, `truth.NAME`. Such a method shows the best
            possible result.
        stages: Stages by name.
        rerun: A part of the chain of another method, instead of stages.
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
    """Settings of the comparison of alternatives by `torchsar trade` and `torchsar requires`.

    Fields:
        tolerance: Largest acceptable loss by metric; by default those of the system.
        trials: Number of trials on which estimators are compared.
        repeats: Number of timings of each alternative, interleaved with those of the others.
    """

    tolerance: dict[str, float] = {}
    trials: int = Field(default=4, ge=1)
    repeats: int = Field(default=3, ge=1)


class EarlyStop(Strict):
    """Condition that ends the trials of a grid point before their largest number is reached.

    It holds if half the width of the 95 % confidence interval of a statistic of a metric is below
    `relative` times the statistic.
    """

    metric: str
    relative: float = Field(gt=0, lt=1)
    statistic: Literal["rmse", "mean", "median"] = "rmse"


class Save(Strict):
    """Numbers of the trials whose images are kept in the store, and names of stages (`taps`) whose
    outputs are kept with them.
    """

    trials: list[int] = []
    taps: list[str] = []


class Sweep(Strict):
    """Section `sweep` of a config: a Monte Carlo sweep. A dotted key of the config, such as
    `world.noise.snr_db: [0, 10]`, may stand in this section directly or below `grid`; it is an axis
    of the grid of swept values.

    Fields:
        grid: Values of each axis, a list or a mapping of labels to values, by dotted key.
        trials: Number of trials of each point, or the largest number if `stop` is given.
        chunk: Number of trials of a batch; None to choose it by the memory.
        stop: Condition that ends the trials of a point early; see `EarlyStop`.
        success: Largest magnitude of a metric for a trial to count as a success, by metric.
        show: Metrics that are drawn; by default all errors.
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
        grid = known.get("grid") or {}
        return {**known, "grid": {**grid, **loose}} if loose and isinstance(grid, dict) else known


class Config(Strict):
    """A whole experiment. The system defines the keys of `radar`, `world` and `metrics`.

    Fields:
        seed: Seed of all random numbers of the world.
        random: Source of these numbers: `numpy` draws them on the CPU, `torch` other ones on the
            device of the trials; see `torchsar.Draws`.
        cases: Values by dotted key that each case changes, by name of the case.
        beyond_limits: Methods that are deliberately used beyond their limits.
    """

    system: str = "stripmap"
    title: str
    seed: int = Field(default=1, ge=0)
    random: Source = "numpy"
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
            raise ValueError(
                "one method of the processor must be called 'recommended': `requires`, `trade` and the reports go by "
                f"it; rename one of {', '.join(self.processor)}, whose `title` stays what readers see"
            )
        if self.processor["recommended"].stages is None:
            raise ValueError("processor.recommended needs stages of its own")
        for name in self.processor:
            why = fault_of_name(name, LONGEST_NAME)
            if why:
                raise ValueError(f"processor: a method cannot be called {name[:40]!r}, {why}")
        taken = next((name for name in RESERVED if name in self.processor), None)
        if taken is not None:
            raise ValueError(
                f"processor.{taken}: a method cannot have this name, because the results have an entry of that name; "
                "choose another name"
            )
        reference = self.metrics.get("reference")
        named = [*(("beyond_limits", name) for name in self.beyond_limits), ("metrics.reference", reference)]
        for key, name in named:
            if name is not None and name not in tuple(self.processor):
                raise ValueError(
                    f"{key} names {name!r}, which is no method of the processor ({', '.join(self.processor)})"
                )
        return self


@dataclass(frozen=True)
class Loaded:
    """A checked config with all defaults.

    Args:
        config: The sections; `radar`, `world`, `metrics` and stages are mappings with all keys.
        system: Its system, with the keys of these sections and of the stages.
        file: Name of the config file, with the overrides of the call behind it, for messages.
        name: Name of the file without its suffix.
    """

    config: Config
    system: Any
    file: str
    name: str

    def changed(self, values: Mapping[str, Any], where: str = "sweep") -> Loaded:
        """Return the config with other values at dotted keys.

        Args:
            values: Values by dotted key; a number in a key is an index of a list.
            where: Section that holds the values, for messages.

        Raises:
            ConfigError: If a key does not exist, a value is not accepted, or the system changes.
        """
        tree = self.config.model_dump()
        # a section is changed before its parts
        for key, value in sorted(values.items(), key=lambda item: item[0].count(".")):
            if key == "system":
                raise ConfigError(f"{self.file}: {where}: the key 'system' cannot be changed")
            tree = _placed(tree, key.split("."), value, f"{self.file}: {where}: the key {key!r}")
        return replace(self, config=checked(tree, self.system, f"{self.file}: {where}"))

    def text(self) -> str:
        """Return the config with all defaults as YAML."""
        return dump(self.config.model_dump())


def _placed(tree: Any, path: list[str], value: Any, what: str) -> Any:
    """Return the tree with one value changed. All parts of the path except the last one
    must exist.
    """
    head, rest = path[0], path[1:]
    if isinstance(tree, list) and head.isdecimal() and int(head) < len(tree):
        index = int(head)
        return [*tree[:index], _placed(tree[index], rest, value, what) if rest else value, *tree[index + 1 :]]
    if not isinstance(tree, dict) or (rest and head not in tree):
        raise ConfigError(
            f"{what} does not exist, because there is no part "
            f"{head!r}{did_you_mean(head, tree if isinstance(tree, dict) else ())}"
        )
    return {**tree, head: _placed(tree[head], rest, value, what) if rest else value}


def checked(tree: Any, system: Any, file: str) -> Config:
    """Check a config and fill in all defaults.

    Args:
        tree: Content of the config.
        system: Its system.
        file: Name of the file, for messages.

    Returns:
        The complete config.

    Raises:
        ConfigError: If the config is not valid. The message is one sentence that names file, key,
            value and what is accepted.
    """
    try:
        config = Config.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(sentence(error, Config, file)) from None
    _check_source(config, system, file)
    sections = {name: getattr(config, name) for name in system.sections}
    made = {n: None if tree is None else system.sections[n].check(tree, n, file) for n, tree in sections.items()}
    refuse_implausible(system.magnitudes, made["radar"], made["world"], file)
    found = config.data.impairments
    kept = {n: system.impairments.check(entry, f"data.impairments.{n}", file) for n, entry in found.items()}
    methods = {name: _method(method, f"processor.{name}", system, file) for name, method in config.processor.items()}
    _check_reruns(methods, file)
    data = config.data.model_copy(update={"impairments": kept})
    return config.model_copy(update={**made, "data": data, "processor": methods})


def _method(method: Method, where: str, system: Any, file: str) -> Method:
    """Return the method with all keys of its stages."""
    stages = {}
    for name, entry in (method.stages or {}).items():
        uses = entry.get("uses", {})
        if not (isinstance(uses, dict) and all(isinstance(source, str) for source in uses.values())):
            raise ConfigError(
                f"{file}: {where}.stages.{name}.uses must map keys of the stage to 'stage.value', got {uses!r}"
            )
        old = next((source for source in uses.values() if source.startswith(_OLD_TRUTH)), None)
        if old is not None:
            new = f"truth.{old.removeprefix(_OLD_TRUTH)}"
            raise ConfigError(f"{file}: {where}.stages.{name}.uses: {old!r} is now called {new!r}; rename it")
        if entry.get("in_doubt", "apply") not in ("neutral", "apply"):
            raise ConfigError(
                f"{file}: {where}.stages.{name}.in_doubt must be 'apply' (estimated values in trials where an estimate "
                f"is doubtful) or 'neutral' (neutral ones), got {entry['in_doubt']!r}"
            )
        rest = {key: value for key, value in entry.items() if key not in OF_CHAIN}
        kept = {key: entry[key] for key in OF_CHAIN if entry.get(key)}
        stages[name] = {**system.stages.check(rest, f"{where}.stages.{name}", file), **kept}
    return method.model_copy(update={"stages": stages or None})


def _check_source(config: Config, system: Any, file: str) -> None:
    """Raise ConfigError unless the config has a recording, or both radar and world."""
    recorded = config.data.file
    if recorded is None:
        missing = [name for name in ("radar", "world") if getattr(config, name) is None]
        if len(missing) == 2 and system.reads:
            raise ConfigError(
                f"{file}: data.file is not set; write data.file=PATH after the command, the path of a "
                f"{system.reads} file"
            )
        if missing:
            raise ConfigError(f"{file}: section {missing[0]!r} is missing; a simulation needs 'radar' and 'world'")
    elif not system.reads:
        raise ConfigError(f"{file}: data.file: system {config.system} reads no recordings; omit this key")
    elif not Path(recorded).is_file():
        what = "is no file" if Path(recorded).exists() else "does not exist"
        raise ConfigError(f"{file}: data.file: {recorded!r} {what}; give the path of a {system.reads} file")


def _check_reruns(methods: Mapping[str, Method], file: str) -> None:
    """Raise ConfigError unless every rerun names a stage of an earlier method with stages."""
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


Magnitudes = Mapping[str, tuple[str, float, float]]
# Unit, least and largest magnitude of numbers other than zero, by the ending of their key. The
# first ending that fits is used.
MAGNITUDES: Magnitudes = {
    "wave_speed_m_s": ("m/s", 1e8, 3.1e8),
    "carrier_hz": ("Hz", 2e7, 1e16),
    "wavelength_m": ("m", 3e-8, 15.0),
    "bandwidth_hz": ("Hz", 1e4, 1e13),
    "sampling_hz": ("Hz", 1e4, 1e13),
    "prf_hz": ("Hz", 1.0, 1e8),
    "period_s": ("s", 1e-8, 1e-2),
    "pulse_s": ("s", 1e-10, 1e-1),
    "pulse.duration_s": ("s", 1e-10, 1e-1),
    "reference_range_m": ("m", 10.0, 1e9),
    "near_range_m": ("m", 1.0, 1e8),
    "element_m": ("m", 1e-4, 1e2),
    "_hz_s": ("Hz/s", 0.0, 1e18),
    "_rad_s": ("rad/s", 0.0, 1e3),
    "_m_s2": ("m/s^2", 0.0, 1e6),
    "_m_s": ("m/s", 0.0, 3e4),
    "_hz": ("Hz", 0.0, 1e13),
    "_rad": ("rad", 0.0, 1e4),
    "_deg": ("degrees", 0.0, 720.0),
    "_db": ("dB", 0.0, 400.0),
    "_m": ("m", 0.0, 1e9),
    "_s": ("s", 0.0, 1e5),
}


def refuse_implausible(magnitudes: Magnitudes, radar: Any, world: Any, file: str) -> None:
    """Check that all numbers with a unit have a magnitude that occurs.

    Args:
        magnitudes: Units and limits by the ending of a key, as in `MAGNITUDES`.
        radar: The section radar with all defaults; None for recorded data.
        world: The section world.
        file: Name of the config, for messages.

    Raises:
        ConfigError: If a number has not. The message gives the unit, the accepted range and, if
            there is one, a likely correction.
    """
    for key, value in _numbers({"radar": radar, "world": world}, ""):
        unit, low, high = next((row for ending, row in magnitudes.items() if key.endswith(ending)), ("", 0.0, 1e300))
        if value and not low <= abs(value) <= high:
            prefixes = {"k": 1e3, "m": 1e-3, "M": 1e6, "u": 1e-6, "G": 1e9, "n": 1e-9}
            fits = {p: value * x for p, x in prefixes.items() if max(low, 1e-12 * high) <= abs(value) * x <= high}
            hint = next((f"; did you mean {value:g} {p}{unit}, which is {x:g}?" for p, x in fits.items()), "")
            raise ConfigError(
                f"{file}: {key} is {value:g} {unit}, and should be {low:g} {unit} to {high:g} {unit} in magnitude{hint}"
            )


def _numbers(tree: Any, path: str) -> Iterator[tuple[str, float]]:
    """Generate every number of a tree with its dotted key. Entries of a list have the key of the
    list.
    """
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _numbers(value, f"{path}.{key}".lstrip("."))
    elif isinstance(tree, list | tuple):
        for value in tree:
            yield from _numbers(value, path)
    elif isinstance(tree, int | float) and not isinstance(tree, bool):
        yield path, tree


# name of the case of a config that lists no cases
ALL = "all"
# sections that all cases have in common
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
