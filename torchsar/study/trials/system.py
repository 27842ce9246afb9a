"""Base of the systems, the kinds of experiments: their sections, metrics, limits and pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Trace
from torchsar.echo import Simulate
from torchsar.focus.requirements import Limit, Requirement
from torchsar.study.names.registry import stages
from torchsar.study.output.report import Column, Drawn, comparisons
from torchsar.study.settings.sections import ALL, MAGNITUDES, Loaded, Magnitudes, titled, word_of
from torchsar.study.settings.signature import Catalogue, Section
from torchsar.study.trials.batch import IMAGE, Batch, Found, Judged, Processed, Result, Trials
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
    """Base of the section `world` of every system: the true scene, which no processor may use.

    Class attributes:
        least: Least size of fields that are whole numbers or collections.

    Args:
        trials: Number of trials of each case of a run; a sweep has its own number.
    """

    least: ClassVar[Mapping[str, int]] = {}
    trials: int = 1

    def __post_init__(self) -> None:
        for name, least in {"trials": 1, **self.least}.items():
            value = getattr(self, name)
            size = value if isinstance(value, int) else len(value)
            if size < least:
                raise ValueError(f"world needs at least {least} {name}, got {size}")

    def simulation(self, radar: Any, dtype: torch.dtype) -> Simulate:
        """Return the stage that simulates this world, if there is one for `trials_of`."""
        raise NotImplementedError(f"{type(self).__name__} has no stage that simulates it")

    def trials_of(self, radar: Any, draws: Draws, dtype: torch.dtype, device: str = "cpu") -> Trials:
        """Simulate recordings with and without impairments, and the true values."""
        stage = self.simulation(radar, dtype).to(device)
        recording, truth = stage(None, draws)
        assert truth.clean is not None
        return Trials(recording, truth.clean, truth.values, len(draws.trials or (0,)), stage.world)


def named_points(scene: Mapping[str, Any], shown: Mapping[type, int | None]) -> dict[str, int]:
    """Return names of point targets, such as `points.0`, and their indices among all scatterers.

    Args:
        scene: Parts of the scene by name.
        shown: Kinds of parts whose scatterers have names, with the largest number of them; None for
            all.
    """
    names: dict[str, int] = {}
    first = 0
    for part, one in scene.items():
        count = one.scatterers(Draws(0)).range_m.shape[-1]
        names |= {f"{part}.{i}": first + i for i in range(count)[: shown.get(type(one), 0)]}
        first += count
    return names


@dataclass(frozen=True, kw_only=True)
class Judging:
    """The section `metrics` of systems with a reference method, to which they may add settings.

    Args:
        reference: The method with the ideal image of the same scene.
        published: Published values by metric, case and method.
    """

    reference: str | None = None
    published: Mapping[str, Mapping[str, Mapping[str, float | str]]] = field(default_factory=dict)


Draw = Callable[[Result], Drawn]


class System(ABC):
    """Base class of the systems. A system is a kind of experiment, such as stripmap SAR.

    It contains the physics of the experiment; all other code is common to the systems.

    Class attributes:
        name: Value of the key `system`.
        about: One line for `torchsar list`.
        Radar, World, Judging: Constructors of the sections radar, world and metrics.
        impairments: Impairments that data.impairments may add to a recording.
        reads: Content of data.file; empty if the system reads no recordings.
        ending: Stages that end a chain with an image; empty if a run needs no images.
        truths: Names of true values that oracles may use.
        definitions: Definitions of metrics, by name, for metrics.json and reports.
        columns: Metrics in reports.
        target_columns: Metrics of named targets in reports.
        tolerance: Default of the largest acceptable loss, by metric.
        magnitudes: Units and accepted magnitudes of the numbers of radar and world, by the ending
            of their keys.
        exact: For each key that may be `auto` (see `Choice.at`), the keys and values that select
            the exact alternative.
        images: Axes of signals that are images.
        settings: Settings of the metrics that metrics.json defines, by their names there.
        draw_first: Functions of the result of the first case that draw its scene.
        draw_case: Functions of a result that draw the pictures of a case.
        plain_names: Whether these have no ending where a config has no cases.
        address: Case of the random draws of runs (see `Draws`).
        peak: Size of the largest tensor of a trial relative to that of its raw data, as measured.
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
    magnitudes: ClassVar[Magnitudes] = MAGNITUDES
    exact: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    images: ClassVar[Sequence[tuple[str, ...]]] = (IMAGE,)
    settings: ClassVar[Mapping[str, str]] = {}
    draw_first: ClassVar[Sequence[Draw]] = ()
    draw_case: ClassVar[Sequence[Draw]] = ()
    plain_names: ClassVar[bool] = False
    address: ClassVar[str | int] = "run"
    peak: ClassVar[float] = 8.0

    def __reduce__(self) -> tuple[Any, ...]:
        """Systems have no state, so that other processes build them from their class."""
        return type(self), ()

    @cached_property
    def sections(self) -> dict[str, Section]:
        return {"radar": Section(self.Radar), "world": Section(self.World), "metrics": Section(self.Judging)}

    @property
    def stages(self) -> Catalogue:
        return stages()

    # methods that simulate and judge, which every system has

    def simulate(self, bench: Bench, world: Any, draws: Draws) -> Trials:
        """Simulate the trials in `draws`; numbers of the world may differ between trials.

        By default the world does so by its method `trials_of`.
        """
        return world.trials_of(bench.radar, draws, bench.dtype, bench.device)

    @abstractmethod
    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        """Compute the metrics of a method; with `detail` those of single targets as well."""

    def samples(self, world: Any, radar: Any) -> int:
        """Return the number of samples of the raw data of one trial.

        By default it is the product of `pulses` and `samples` of the world. A system whose world
        lacks them overrides this method.
        """
        return world.pulses * world.samples

    def may_differ(self, path: str, world: Mapping[str, Any]) -> bool:
        """Return whether a number of the world, by dotted key, may differ between trials.

        By default this is so if the constructor accepts a tensor. A number that determines the
        shape of arrays may not.
        """
        return self.sections["world"].takes_tensor(path.split("."), world)

    def bytes_per_trial(self, bench: Bench) -> int:
        """Return the size of the largest tensor of a trial in bytes."""
        return int(self.peak * self.samples(bench.world(), bench.radar) * bench.dtype.itemsize)

    # methods that a system may override

    def read(self, path: str, dtype: torch.dtype) -> Recording:
        """Return the recording in a file. Raises ValueError or OSError."""
        raise NotImplementedError(f"system {self.name} reads no recordings")

    def context(self, recording: Recording) -> dict[str, Any]:
        """Return the values that constructors of stages need from a recording, in addition to its
        radar.
        """
        return {}

    def check(self, bench: Bench) -> None:
        """Check values that no constructor checks. Raises ConfigError."""

    def check_sweep(self, loaded: Loaded, grid: Mapping[str, Any]) -> None:
        """Check that the axes of a grid are consistent. Raises ConfigError."""

    def compare(self, bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
        """Return the metrics of a method, with those relative to the reference method."""
        judged, key = outcome.judged, "entropy_nats"
        if ideal is None or ideal is outcome or key not in judged.metrics or key not in ideal.metrics:
            return judged
        above = judged.metrics[key] - ideal.metrics[key]
        return replace(judged, metrics={**judged.metrics, "entropy_above_ideal_nats": above})

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return lower bounds of errors, (trial,), by metric and name of the bound."""
        return {}

    def found(self, bench: Bench, outcome: Processed, trials: Trials) -> dict[str, Found]:
        """Return the estimates of a method by `stage.value`."""
        n, table = trials.count, {}
        for stage, estimate in outcome.estimates.items():
            codes = estimate.outcome.expand(n) if estimate.outcome.numel() in (1, n) else None
            for key, value in estimate.value.items():
                std = estimate.std.get(key)
                spread = None if std is None else per_trial_first(std, n)
                table[f"{stage}.{key}"] = Found(per_trial_first(value, n), spread, codes)
        return table

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        """Return the limits of methods in this scene, with the methods that each concerns."""
        return {}

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        """Return the effects that each simplification neglects in this scene."""
        return ()

    def choices(self, bench: Bench) -> Sequence[Choice]:
        """Return the choices of the config, the most important one first."""
        return ()

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        """Yield functions that draw the pictures of a run, in order, from the results by case."""
        yield from (partial(draw, next(iter(results.values()))) for draw in self.draw_first)
        yield partial(comparisons, results, self.columns)
        yield from self.case_pictures(results)

    def case_pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        """Yield functions that draw the pictures of every case, with its name in their titles."""
        for case, result in results.items():
            yield from (partial(_of_case, draw, case, result) for draw in self.draw_case)

    def pictured(self, result: Result) -> dict[str, Signal]:
        """Return the images of the first trial of a case that are stored, by path."""
        return result.images

    def theory(self, result: Result) -> Mapping[str, Mapping[str, float]]:
        """Return the theoretical metrics of named targets without errors, by target."""
        return {}

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield notes for the report, as (title, text)."""
        yield from ()

    def extra_definitions(self, bench: Bench) -> Mapping[str, Any]:
        """Return definitions that depend on the config."""
        return {shown: getattr(bench.judging, name) for shown, name in self.settings.items()}


def per_trial_first(x: Tensor, count: int) -> Tensor:
    """Return a tensor with trials as the first dim; a value without this dim is repeated."""
    x = x.detach()
    return x if x.ndim and x.shape[0] == count else x[None].expand(count, *x.shape)


def _of_case(draw: Draw, case: str, result: Result) -> Drawn:
    end = "" if case == ALL and result.bench.system.plain_names else f"_{word_of(case)}"
    for name, title, caption, figure in draw(result):
        yield name + end, titled(title, case), caption, figure


def by_limit(found: Iterable[tuple[Limit, str]]) -> dict[Limit, list[str]]:
    """Return the methods that each limit concerns, from pairs of a limit and a method."""
    table: dict[Limit, list[str]] = {}
    for limit, name in found:
        table.setdefault(limit, []).append(name)
    return table
