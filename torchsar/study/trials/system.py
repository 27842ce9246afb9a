"""What a system brings: sections of its configs, its world, its judge and its choices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Trace
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.study.names.registry import stages
from torchsar.study.output.pictures import Drawn, comparisons
from torchsar.study.settings.sections import Loaded
from torchsar.study.settings.signature import Catalogue, Section
from torchsar.study.trials.batch import IMAGE, Batch, Found, Judged, Outcome, Result, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Choice


@dataclass(frozen=True)
class Noise:
    """Receiver noise.

    Args:
        snr_db: Signal-to-noise ratio in dB, as the system defines it; None for no noise.
    """

    snr_db: Tensor | float | None = None


@dataclass(frozen=True, kw_only=True)
class World:
    """Base of the section `world` of every system: what is true and no processor may see.

    Args:
        trials: Trials of each case of a run; a sweep has its own number.
    """

    trials: int = 1

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise ValueError(f"world.trials must be at least 1, got {self.trials}")


@dataclass(frozen=True)
class Judging:
    """Section `metrics` of the systems that need no more: how results are judged.

    Args:
        reference: The method whose image of the same scene is the ideal one.
        published: Figure -> case -> method -> what the source published.
    """

    reference: str | None = None
    published: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Column:
    """A figure as reports and pictures show it.

    Args:
        label: What it is.
        unit: Its unit, for tables and axes; SI units get prefixes where they stand alone.
        digits: Digits after the point.
        drawn: How methods are compared in a picture: "" not at all, "mean" or "rms" over trials.
    """

    label: str
    unit: str = ""
    digits: int = 3
    drawn: str = ""


class System(ABC):
    """Base of the systems: what is physics. Commands, batches, stores and reports exist once.

    Class attributes:
        name: The value of the key `system`.
        about: One line for `torchsar list`.
        Radar, World, Judging: Constructors of the sections radar, world and metrics.
        impairments: What may be put into a recording by data.impairments.
        reads: What data.file holds; empty where no recordings are read.
        ending: Stages that end a chain with an image; empty where a run needs none.
        truths: Names of true values that oracles may use.
        definitions: Of figures, by name, for metrics.json and reports.
        columns: Figures that reports show, by metric.
        target_columns: Those of named targets.
        tolerance: Largest acceptable loss by metric, by default.
        exact: Where `auto` may be written (see `Choice.at`), with the keys of the exact choice.
        images: Axes of signals that count as images.
        address: The address of the random numbers of runs.
        peak: The largest tensor of a trial over its raw data, as measured.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    Radar: ClassVar[Callable[..., Any]]
    World: ClassVar[Callable[..., Any]]
    Judging: ClassVar[Callable[..., Any]] = Judging
    impairments: ClassVar[Catalogue] = Catalogue("impairment", "kind", {})
    reads: ClassVar[str] = ""
    ending: ClassVar[str] = ""
    truths: ClassVar[Sequence[str]] = ()
    definitions: ClassVar[Mapping[str, Any]]
    columns: ClassVar[Mapping[str, Column]]
    target_columns: ClassVar[Mapping[str, Column]] = {}
    tolerance: ClassVar[Mapping[str, float]] = {}
    exact: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    images: ClassVar[Sequence[tuple[str, ...]]] = (IMAGE,)
    address: ClassVar[str | int] = "run"
    peak: ClassVar[float] = 8.0

    def __reduce__(self) -> tuple[Any, ...]:
        """Other processes make the system anew from its class, which is all that there is of it."""
        return type(self), ()

    @cached_property
    def sections(self) -> dict[str, Section]:
        return {"radar": Section(self.Radar), "world": Section(self.World), "metrics": Section(self.Judging)}

    @property
    def stages(self) -> Catalogue:
        return stages()

    @property
    def recording_impairments(self) -> Catalogue:
        return self.impairments

    # physics, by every system

    @abstractmethod
    def simulate(self, bench: Bench, world: Any, draws: Draws) -> Trials:
        """Simulate the trials of the draws; numbers of the world may differ from trial to trial."""

    @abstractmethod
    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        """Compare what a method found with the truth; detail: of single targets as well."""

    @abstractmethod
    def samples(self, world: Any, radar: Any) -> int:
        """Samples of the raw data of one trial."""

    def may_differ(self, path: str, world: Mapping[str, Any]) -> bool:
        """Whether a number of the world, by dotted key, may differ between the trials of a batch.

        By default its constructor decides; one that gives arrays their shape may not.
        """
        return self.sections["world"].takes_tensor(path.split("."), world)

    def bytes_per_trial(self, bench: Bench) -> int:
        """Bytes of the largest tensor that a trial needs."""
        return int(self.peak * self.samples(bench.world(), bench.radar) * bench.dtype.itemsize)

    # physics, where a system has it

    def read(self, path: str, dtype: torch.dtype) -> Recording:
        """The recording in a file. Raises ValueError or OSError."""
        raise NotImplementedError(f"system {self.name} reads no recordings")

    def context(self, recording: Recording) -> dict[str, Any]:
        """What stages take from a recording besides its radar."""
        return {}

    def check(self, bench: Bench) -> None:
        """Refuse what the constructors cannot see. Raises ConfigError."""

    def check_sweep(self, loaded: Loaded, grid: Mapping[str, Any]) -> None:
        """Refuse a grid that contradicts itself. Raises ConfigError."""

    def compare(self, bench: Bench, outcome: Outcome, ideal: Outcome | None) -> Judged:
        """The figures of a method with those against the method that metrics.reference names."""
        judged, key = outcome.judged, "entropy_nats"
        if ideal is None or ideal is outcome or key not in judged.metrics or key not in ideal.metrics:
            return judged
        above = judged.metrics[key] - ideal.metrics[key]
        return replace(judged, metrics={**judged.metrics, "entropy_above_ideal_nats": above})

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Lower bounds of errors: metric -> name of the bound -> (trial,)."""
        return {}

    def found(self, bench: Bench, outcome: Outcome, trials: Trials) -> dict[str, Found]:
        """What the estimators of a method found, by `stage.value`."""
        n, table = trials.count, {}
        for stage, estimate in outcome.estimates.items():
            ok = estimate.ok.expand(n) if estimate.ok.numel() in (1, n) else None
            for key, value in estimate.value.items():
                std = estimate.std.get(key)
                spread = None if std is None else per_trial_first(std, n)
                table[f"{stage}.{key}"] = Found(per_trial_first(value, n), spread, ok)
        return table

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        """Limits of methods in this scene, each with the methods that it concerns."""
        return {}

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        """What each simplification neglects in this scene."""
        return ()

    def choices(self, bench: Bench) -> Sequence[Choice]:
        """Decisions that the config takes, the most important one first."""
        return ()

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        """Makers of the pictures of a run, in the order of reading; results by case."""
        yield partial(comparisons, results, self.columns)

    def pictured(self, result: Result) -> dict[str, Signal]:
        """The images of a case that are kept, those of the first trial, by path."""
        return result.images

    def theory(self, result: Result) -> Mapping[str, Mapping[str, float]]:
        """Figures of named targets without any error, by target."""
        return {}

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """(title, text) of what a reader of the report should know."""
        yield from ()

    def extra_definitions(self, bench: Bench) -> Mapping[str, Any]:
        """Definitions that depend on the config."""
        return {}


def per_trial_first(x: Tensor, count: int) -> Tensor:
    """A tensor with a leading dim of trials, made where there is none."""
    x = x.detach()
    return x if x.ndim and x.shape[0] == count else x[None].expand(count, *x.shape)
