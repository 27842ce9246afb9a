"""The sweep itself: computes the trials of every point of a grid with any trial function."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from torchsar.core import Draws, Source, device_fault
from torchsar.metrics.intervals import half_width_ratio
from torchsar.study.montecarlo.engines import Engine, Task, engine
from torchsar.study.montecarlo.fingerprint import code, fingerprint, name_of
from torchsar.study.montecarlo.grid import Grid, make_grid
from torchsar.study.montecarlo.record import OK, OUTCOME, Record
from torchsar.study.montecarlo.store import Store, cut_off, empty, read_sweep
from torchsar.study.montecarlo.work import Chunk, Computed, Trial, Work, cut, rows_of
from torchsar.study.output.folder import ResultFolder, opened
from torchsar.study.output.progress import progress
from torchsar.study.output.report import installed_version
from torchsar.study.settings.errors import ConfigError, did_you_mean

log = logging.getLogger("torchsar")
# number of trials after which points are first checked; confidence intervals of fewer trials are
# too uncertain
FIRST_LOOK = 50
SWEEP_FILES = ("config.yaml", "summary.json", "figures", "report.html")


class Interrupted(KeyboardInterrupt):
    """The user stopped the sweep. All results computed so far are recorded."""


@dataclass(frozen=True)
class Stop:
    """Criterion that ends the trials of a grid point once a statistic is known precisely enough.

    It is met when half the width of the 95 % confidence interval of the statistic is less than
    `relative` times the magnitude of the statistic, for every algorithm that has the metric. Points
    are checked after their first 50, 100, 200, 400, ... trials, and never in between.

    An rmse that is dominated by rare outliers may meet the criterion before the first outlier. For
    example, if one error in 100 is 100 times as large as the others and `relative` is 0.19, four
    points of ten end at 50 trials without an outlier. Below a threshold SNR choose the median, or a
    smaller `relative` (0.1 takes 100 trials or more).

    Args:
        metric: Name of the metric.
        relative: Ratio of half the width of the interval to the statistic, between 0 and 1.
        statistic: "rmse", "mean" or "median".

    Raises:
        ConfigError: If `relative` or `statistic` is not one of the accepted values.
    """

    metric: str
    relative: float
    statistic: Literal["rmse", "mean", "median"] = "rmse"

    def __post_init__(self) -> None:
        if self.statistic not in ("rmse", "mean", "median"):
            raise ConfigError(f"stop.statistic must be rmse, mean or median, got {self.statistic!r}")
        if not isinstance(self.relative, (int, float)) or not 0 < self.relative < 1:
            raise ConfigError(f"stop.relative must lie between 0 and 1, got {self.relative!r}")

    def reached(self, record: Record, point: tuple[int, ...], trials: int, seed: int) -> bool:
        """Return whether the first `trials` trials of a point meet the criterion."""
        values = record.metrics[self.metric][(slice(None), *point, slice(0, trials))]
        values = values[np.isfinite(values).any(-1)]
        return bool(len(values)) and bool((half_width_ratio(values, self.statistic, seed) < self.relative).all())


def looks(trials: int, stop: Stop | None) -> list[int]:
    """Return the numbers of trials after which points are checked for an early end by `stop`.

    The last is the largest number of trials; without `stop` it is the only one.
    """
    levels = [FIRST_LOOK << i for i in range(trials.bit_length()) if stop is not None]
    return [*(level for level in levels if level < trials), trials]


@dataclass(frozen=True)
class Plan:
    """Settings of the computations of a sweep.

    Args:
        grid: The points, which are combinations of values of the parameters.
        trials: Number of trials of each point; with `stop` the largest number.
        seed: Seed of all random numbers.
        chunk: Number of trials of a batch; None to choose it by the memory that a trial needs.
        stop: Criterion that ends the trials of a point early; None for no early end.
        save: Numbers of the trials whose arrays are kept.
        device: Device on which batches are computed.
        needs: (key of the config, metric) of each metric that the trial function must return.
        random: Source of the random numbers; see `torchsar.Draws`.

    Raises:
        ConfigError: If a number is out of range, or the device cannot be used.
    """

    grid: Grid
    trials: int = 200
    seed: int = 1
    chunk: int | None = None
    stop: Stop | None = None
    save: frozenset[int] = frozenset()
    device: str = "cpu"
    needs: tuple[tuple[str, str], ...] = ()
    random: Source = "numpy"

    def __post_init__(self) -> None:
        for name, value, least in (("trials", self.trials, 1), ("chunk", self.chunk, 1), ("seed", self.seed, 0)):
            whole = isinstance(value, int) and not isinstance(value, bool) and value >= least
            if not whole and (name, value) != ("chunk", None):
                raise ConfigError(f"sweep: {name} must be a whole number of at least {least}, got {value!r}")
        absent = next((t for t in self.save if type(t) is not int or not 0 <= t < self.trials), None)
        if absent is not None:
            raise ConfigError(
                f"sweep: save must list numbers of trials, which are 0 to {self.trials - 1}, got {absent!r}"
            )
        reason = device_fault(self.device)
        if reason:
            raise ConfigError(f"sweep: the device {self.device!r} cannot be used here: {reason}")

    def work(self, trial: Trial) -> Work:
        """Return all data that a process needs to compute its chunks."""
        return Work(trial, self.grid, Draws(self.seed, source=self.random), self.device, self.save)

    def refuse_missing(self, trial: Trial) -> None:
        """Compute the first trial, and check that it returns every metric in `needs`.

        Raises:
            ConfigError: If a metric is missing; the message names the first one.
        """
        parts = self.work(trial).compute(Chunk(0, (0,), (0,))).parts if self.needs else []
        given = {
            metric
            for part in parts
            for metrics in part.values.values()
            for metric in metrics
            if metric not in (OK, OUTCOME)
        }
        for where, metric in self.needs:
            if metric not in given:
                raise ConfigError(
                    f"{where} names {metric!r}, which is no metric of the trials{did_you_mean(metric, given)}"
                )


def sweep(
    trial: Trial,
    grid: Mapping[str, Sequence[Any] | Mapping[str, Any]],
    *,
    trials: int = 200,
    seed: int = 1,
    batched: Sequence[str] = (),
    out: Path | str | None = None,
    resume: bool = False,
    chunk: int | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    threads: int = 1,
    stop: Stop | None = None,
    save: Iterable[int] = (),
    device: str = "cpu",
    config: Mapping[str, Any] | None = None,
    version: str | int | None = None,
    random: Source = "numpy",
    allow_changed: bool = False,
) -> Record:
    """Run a trial function over a grid of parameters, many trials at once.

    The random numbers of a trial depend only on the seed, their purpose, the parameters of the grid
    point and the number of the trial; batches and processes do not change them.

    Args:
        trial: Function of (parameters, draws), called for a batch of trials, one per row. It gets
            the parameters by name, and `Draws` with the random numbers of the rows. It returns
            {metric: (rows,) tensor}, or {algorithm: {metric: tensor}} to compare algorithms on the
            same noise. The metric `ok` (bool) says whether an estimate is reliable; in its place,
            `outcome` (codes of `torchsar.Outcome`) says also why not. Two further keys are
            optional: "bounds", {metric: {name: (rows,) tensor}}, and "saved", {algorithm: {name:
            (rows, ...) tensor}}, arrays that are kept for the trials in `save`.
        grid: {name: values} of each parameter, or {name: {label: value}} for values that are
            neither numbers nor words.
        trials: Number of trials of each point. With `resume`, a larger number extends a finished
            sweep.
        seed: Seed of all random numbers.
        batched: Names of the parameters that `trial` gets as float64 tensors (rows,). A batch has
            one value of any other parameter, which is passed unchanged.
        out: Folder for results.zarr; None keeps the results in memory only.
        resume: Whether to continue a sweep that is in the folder. One of another version of
            torchsar, torch or numpy is refused, and so is one whose files of torchsar differ.
        chunk: Number of trials of a batch; None to choose it by the memory that a trial needs.
        workers: Number of worker processes on this machine; None to compute in this process.
        cluster: Address of a running dask scheduler, whose workers are used instead.
        threads: Number of torch threads in each process.
        stop: Criterion that ends the trials of a point early; None for no early end.
        save: Numbers of the trials whose arrays are kept.
        device: Device on which batches are computed.
        config: Everything else that the results depend on; a sweep is resumed only if it is
            unchanged.
        version: Version of `trial`. A sweep is resumed only by the same version. Without a version,
            it is resumed only if the code of `trial`, what it closes over and the global names that
            it uses are unchanged (see `torchsar.study.montecarlo.fingerprint`). Give a version if
            these change without an effect on the results, or if results depend on more than these.
        allow_changed: Whether to continue such a sweep nevertheless, or that of another trial
            function; the attribute `about` of the record then says what changed, under `changed`.
        random: Source of the random numbers: "numpy" draws them on the CPU, "torch" other ones on
            the device where they are used; see `torchsar.Draws`.

    Returns:
        The results, with the dims (algorithm, *parameters, trial).

    Raises:
        ConfigError: If an argument is invalid or the trial function fails. Also, with `out` and
            without `version`, if the trial function uses a value that cannot be compared with that
            of a later run, such as an open file or a lock.
        Interrupted: After Ctrl-C; finished trials are recorded in `out`, if that is given.
    """
    for name, good, expected, given in (
        ("trial", callable(trial), "be a function of (parameters, draws)", trial),
        ("stop", stop is None or isinstance(stop, Stop), "be a Stop, such as Stop('error_m', 0.05)", stop),
        ("save", isinstance(save, Iterable), "list the numbers of trials", save),
        ("config", isinstance(config or {}, Mapping), "be a mapping of what else results depend on", config),
        ("random", random in get_args(Source), f"be one of {', '.join(get_args(Source))}", random),
        ("version", version is None or isinstance(version, (str, int)), "be a word or a whole number", version),
        ("out", out is None or isinstance(out, (str, Path)), "be the path of a folder", out),
    ):
        if not good:
            raise ConfigError(f"sweep: {name} must {expected}, got {given!r}")
    if out is None and set(save):
        raise ConfigError("sweep: save needs out, the folder in which the arrays are kept; give out as well")
    needs = () if stop is None else (("stop.metric", stop.metric),)
    plan = Plan(make_grid(grid, batched), trials, seed, chunk, stop, frozenset(save), device, needs, random)
    plan.refuse_missing(trial)
    with nullcontext() if out is None else opened(Path(out), "sweep", SWEEP_FILES) as folder:
        store = None
        if folder is not None:
            about = fingerprint(trial) if version is None else {"name": name_of(trial), "version": version}
            identity = {**identity_of_draws(seed, random), "trial": about, "config": dict(config or {}), **code()}
            store = open_store(folder, plan, identity, resume, allow_changed)
        return run_plan(plan, trial, store, engine(workers, cluster, threads)).select(plan.grid.labels)


def identity_of_draws(seed: int, random: Source) -> dict[str, Any]:
    """Return the values besides their addresses on which the random numbers of a sweep depend.

    Sweeps that were recorded when numpy was the only source continue with it.
    """
    return {"seed": seed, **({} if random == "numpy" else {"random": random})}


def open_store(
    folder: ResultFolder, plan: Plan, identity: Mapping[str, Any], resume: bool, allow_changed: bool = False
) -> Store:
    """Open results.zarr in the folder of a sweep: with `resume` the existing store, else a new one.

    A new store may replace an existing one in which no trial is marked as done. With
    `allow_changed`, a store of another identity is continued, and holds both.

    Raises:
        ConfigError: If a new store would replace results, or the existing one belongs to another
            sweep.
    """
    path = folder.store("results.zarr")
    there = path.exists() and not (folder.claimed and cut_off(path))
    if there and resume:
        return Store.resume(path, plan.grid, plan.trials, identity, allow_changed)
    if there and read_sweep(path).done.any():
        raise ConfigError(
            f"{folder.path} holds a sweep already; add --resume (resume=True) to go on with it, or choose another "
            "folder"
        )
    folder.claim()
    return Store.create(path, plan.grid, plan.trials, identity)


def run_plan(plan: Plan, trial: Trial, store: Store | None, engine: AbstractContextManager[Engine]) -> Record:
    """Compute the trials of a plan that the store does not hold yet.

    Args:
        plan: What to compute.
        trial: The trial function; see `sweep`.
        store: Store in which results are kept; None keeps them in memory only.
        engine: Context manager of the engine that computes batches.

    Returns:
        All results. After a resume they may include parameter values beyond the grid of the plan.

    Raises:
        Interrupted: After Ctrl-C; finished trials are in the store, if there is one.
    """
    record = empty(plan.grid.labels, plan.trials) if store is None else store.record
    held = {} if store is None else record.about["identity"]
    work = replace(plan.work(trial), programs={key: held[key] for key in ("code", "versions") if key in held} or code())
    run = _Run(plan, work, record, store)
    try:
        with engine as chosen:
            run.all_levels(chosen)
    except KeyboardInterrupt:
        run.flush()
        raise Interrupted(f"{int(record.done.sum())} trials are recorded") from None
    finally:
        run.flush()
    return record


class _Run:
    """The state of one session: active points, rows that fit into memory, and the record."""

    def __init__(self, plan: Plan, work: Work, record: Record, store: Store | None) -> None:
        self.plan, self.work, self.record, self.store = plan, work, record, store
        self.points = [[record.index_of(plan.grid.labels_at(p)) for p in case.points] for case in work.cases]
        self.active = [set(range(len(case.points))) for case in work.cases]
        self.fits: dict[int, int] = {}
        self.rows: dict[int, int] = {}
        self.warned: set[str] = set()
        self.known = int(record.done.sum())

    def _written(self) -> int:
        """Number of trials written since the last call; without a store, the number of computed
        ones.
        """
        before, waiting = self.known, 0 if self.store is None else self.store.waiting
        self.known = int(self.record.done.sum()) - waiting
        return self.known - before

    def all_levels(self, engine: Engine) -> None:
        """Compute all trials in steps, after each of which points are checked for an early end.

        A point that meets the criterion of the plan gets no further trials.
        """
        stops = looks(self.plan.trials, self.plan.stop)
        known = (n for n in self.record.about.get("finished", []) if n < self.plan.trials)
        levels = sorted({*stops, *known})
        done = sum(int(self.record.done[(*p, slice(0, levels[-1]))].sum()) for points in self.points for p in points)
        count = progress(self.plan.trials * sum(map(len, self.points)), "trials", done)
        session, began = self._session(engine), time.perf_counter()
        try:
            with count:
                for first, last in pairwise((0, *levels)):
                    for chunk, computed in engine.results(self.work, self._tasks(first, last, engine.workers)):
                        self._enter(chunk, computed)
                        count.update(self._written())
                    self.flush()
                    count.update(self._written())
                    # No batch extends across a number of trials that all points have completed. A
                    # sweep that is resumed or extended therefore has the same batches.
                    self._about(finished=sorted({*self.record.about.get("finished", []), last}))
                    if last in stops[:-1]:
                        count.total -= (self.plan.trials - last) * self._drop_settled(last)
        finally:
            rows = {str(case): n for case, n in self.rows.items()}
            session |= {"seconds": time.perf_counter() - began, "trials": count.n - done, "chunk_rows": rows}
            self._about(
                **identity_of_draws(self.plan.seed, self.plan.random),
                sessions=[*self.record.about.get("sessions", []), session],
            )

    def _tasks(self, first: int, last: int, workers: int) -> Iterator[Task]:
        """Generate the chunks of one level, without the rows that are already computed."""
        done, level = self.record.done, slice(first, last)
        waiting = [
            number
            for number, (at, active) in enumerate(zip(self.points, self.active))
            if not all(done[(*at[p], level)].all() for p in active)
        ]
        # all batch sizes are found before the first batch, because workers of a GPU hold its memory
        # from then on
        for number in set(waiting) - set(self.rows):
            self.rows[number] = self.plan.chunk or rows_of(self.work, number, self.plan.trials, workers)
        for number in waiting:
            at, rows = self.points[number], self.rows[number]
            # each process gets a part of the memory
            if torch.device(self.plan.device).type == "cuda":
                rows = min(rows, -(-(last - first) * len(self.active[number]) // workers))
            for whole in cut(number, self.work.cases[number], self.active[number], first, last, rows):
                missing = [(p, t) for p, t in zip(whole.points, whole.trials) if not done[(*at[p], t)]]
                if missing:
                    points, trials = zip(*missing)
                    yield Chunk(number, points, trials), self.fits.get(number)

    def _enter(self, chunk: Chunk, computed: Computed) -> None:
        """Enter a chunk into the record and the store, which decides when to write.

        The store is informed first. An interrupt in between may then leave rows that are announced
        and not done, but never the reverse.
        """
        for text in computed.warnings:
            if text not in self.warned:
                log.warning("warning: %s", text)
                self.warned.add(text)
        fits = computed.fits
        if fits is not None and fits < self.fits.get(chunk.case, len(chunk)):
            log.warning("warning: %d trials at once do not fit into memory; going on with %d", len(chunk), fits)
            self.fits[chunk.case] = fits
        known = self.work.cases[chunk.case].points
        for part in computed.parts:
            points, trials = [self.points[chunk.case][p] for p in part.chunk.points], part.chunk.trials
            if self.store is not None:
                self.store.entered(points, trials)
                for row, arrays in part.saved.items():
                    labels = self.plan.grid.labels_at(known[part.chunk.points[row]])
                    self.store.save(labels, trials[row], arrays)
            self.record.add(points, trials, part.values, part.bounds)
        if self.store is not None and self.store.due:
            self.store.flush()

    def flush(self) -> None:
        """Write all results that the store has not written yet."""
        if self.store is not None:
            self.store.flush()

    def _drop_settled(self, trials: int) -> int:
        """End the points that meet the criterion after `trials` trials, and return their number."""
        stop, before = self.plan.stop, sum(map(len, self.active))
        for points, active in zip(self.points, self.active):
            ended = {p for p in active if stop and stop.reached(self.record, points[p], trials, self.plan.seed)}
            active -= ended
        return before - sum(map(len, self.active))

    def _session(self, engine: Engine) -> dict[str, Any]:
        device = torch.device(self.plan.device)
        return {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "device": self.plan.device,
            **({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {}),
            "workers": engine.workers,
            "threads": engine.threads,
            "machine": platform.machine(),
            "versions": {
                "torchsar-lab": installed_version(),
                "torch": torch.__version__,
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
        }

    def _about(self, **attributes: Any) -> None:
        self.record.about = {**self.record.about, **attributes}
        if self.store is not None:
            self.store.note(**attributes)
