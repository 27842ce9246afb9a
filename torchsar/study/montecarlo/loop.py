"""The sweep itself: points and trials in, a record out; it knows no physics."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.study.montecarlo.chunks import cut, probed_bytes, rows_by_bytes
from torchsar.study.montecarlo.engines import Engine, Task, engine, refuse_unguarded
from torchsar.study.montecarlo.grid import Grid, make_grid
from torchsar.study.montecarlo.progress import Progress
from torchsar.study.montecarlo.record import OK, Record
from torchsar.study.montecarlo.stopping import Stop, looks
from torchsar.study.montecarlo.store import Store, cut_off, empty, read_sweep
from torchsar.study.montecarlo.work import Chunk, Outcome, Trial, Work
from torchsar.study.output.folder import ResultFolder, opened
from torchsar.study.output.report import installed_version
from torchsar.study.settings.errors import ConfigError, did_you_mean

log = logging.getLogger("torchsar")
_WAITING = 256


class Interrupted(KeyboardInterrupt):
    """Stopped by the user; what had been computed is recorded."""


@dataclass(frozen=True)
class Plan:
    """What a sweep is to compute, apart from where.

    chunk: rows a batch, None to choose by bytes; save: trials whose arrays are kept.

    needs: (where it is said, metric) of what something after the sweep asks for; the first batch
    must give it.
    """

    grid: Grid
    trials: int = 200
    seed: int = 1
    chunk: int | None = None
    stop: Stop | None = None
    save: frozenset[int] = frozenset()
    device: str = "cpu"
    needs: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        for name, value, least in (("trials", self.trials, 1), ("chunk", self.chunk, 1), ("seed", self.seed, 0)):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ConfigError(f"sweep: {name} must be a whole number of at least {least}, got {value!r}")
        absent = next(
            (t for t in self.save if isinstance(t, bool) or not isinstance(t, int) or not 0 <= t < self.trials), None
        )
        if absent is not None:
            raise ConfigError(
                f"sweep: save names trial {absent!r}, and a point has the trials 0 to "
                f"{self.trials - 1}; name some of these"
            )
        try:
            torch.empty(0, device=torch.device(self.device))
        except (RuntimeError, AssertionError, TypeError) as error:
            raise ConfigError(
                f"sweep: the device {self.device!r} cannot be used here: {str(error).splitlines()[0]}"
            ) from None


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
) -> Record:
    """Run `trial(parameters, draws)` over a grid of parameters, many trials at once, and return the
    labelled results.

    trial: gets the parameters of a batch by name, and `Draws` whose trials are the rows of that
    batch; returns {metric: (rows,) tensor}, or {algorithm: {metric: tensor}} to compare algorithms
    on the same noise. `ok` (bool) is an algorithm's own verdict. Two further keys: "bounds"
    {metric: {name: (rows,) tensor}}, and "saved" {algorithm: {name: (rows, ...) tensor}}, kept for
    the trials in `save`. grid: {name: values}, or {name: {label: value}} for values that are no
    numbers or words. batched: names whose values come as one float64 tensor (rows,); any other
    value comes as it is, one case after the other. trials: per point; more trials on a finished
    sweep extend it. stop: ends a point early. chunk: rows a batch (default: by bytes). out: folder
    for results.zarr; None keeps the results in memory only. resume: go on with what is there.
    workers, cluster: processes of this machine, or the address of a dask scheduler; threads: of
    torch in each process. config: whatever else the results depend on; resuming with another one is
    refused.

    Random numbers depend on (seed, purpose, parameters, trial) alone. Raises ConfigError for bad
    input, Interrupted after Ctrl-C.
    """
    if workers is not None:
        refuse_unguarded()
    _refuse_types(trial, stop, save, config, out)
    plan = Plan(make_grid(grid, batched), trials, seed, chunk, stop, frozenset(save), device)
    identity = {
        "seed": seed,
        "trial": getattr(trial, "__qualname__", type(trial).__qualname__),
        "config": dict(config or {}),
    }
    with nullcontext() if out is None else opened(Path(out), "sweep", SWEEP_FILES) as folder:
        store = None if folder is None else open_store(folder, plan, identity, resume)
        return run_plan(plan, trial, store, engine(workers, cluster, threads)).select(plan.grid.labels)


def _refuse_types(trial: Any, stop: Any, save: Any, config: Any, out: Any) -> None:
    if not callable(trial):
        raise ConfigError(f"sweep: the trial must be a function of (parameters, draws), got {trial!r}")
    if stop is not None and not isinstance(stop, Stop):
        raise ConfigError(f"sweep: stop must be a Stop, such as Stop('error_m', 0.05), got {stop!r}")
    if not isinstance(save, Iterable):
        raise ConfigError(f"sweep: save must list the numbers of trials, got {save!r}")
    if out is None and set(save):
        raise ConfigError("sweep: save keeps arrays in the folder of the sweep; give out as well")
    if config is not None and not isinstance(config, Mapping):
        raise ConfigError(f"sweep: config must be a mapping of whatever else the results depend on, got {config!r}")


SWEEP_FILES = ("config.yaml", "summary.json", "figures", "report.html")


def open_store(folder: ResultFolder, plan: Plan, identity: Mapping[str, Any], resume: bool) -> Store:
    """The file results.zarr of a sweep: a new one, or with `resume` the one that is there.

    A sweep that ended before its first mark holds nothing to lose and is begun anew.

    Raises:
        ConfigError: If results would be lost, or the store that is there belongs to another sweep.
    """
    path = folder.path / "results.zarr"
    there = path.exists() and not (folder.claimed and cut_off(path))
    if there and resume:
        return Store.resume(path, plan.grid, plan.trials, identity)
    if there and read_sweep(path).done.any():
        raise ConfigError(
            f"{folder.path} holds a sweep already; add --resume (resume=True) to go on with it, or choose another "
            "folder"
        )
    folder.claim()
    return Store.create(path, plan.grid, plan.trials, identity)


def run_plan(
    plan: Plan, trial: Trial, store: Store | None, engine: AbstractContextManager[Engine], title: str = "sweep"
) -> Record:
    """Compute what is missing and return the whole record, which may hold more labels than the
    plan's grid after a resume.
    """
    record = empty(plan.grid.labels, plan.trials) if store is None else store.record
    cases = tuple(plan.grid.cases())
    work = Work(
        trial,
        cases,
        {p.name: p.values for p in plan.grid.parameters if p.batched},
        plan.grid.names,
        plan.seed,
        plan.device,
        plan.save,
    )
    run = _Run(plan, work, record, store)
    try:
        with engine as chosen:
            run.all_levels(chosen, title)
    except KeyboardInterrupt:
        run.settle()
        raise Interrupted(f"{int(record.done.sum())} trials are recorded") from None
    finally:
        run.settle()
    return record


class _Run:
    """The state of one session: which points go on, how many rows fit, what is recorded."""

    def __init__(self, plan: Plan, work: Work, record: Record, store: Store | None) -> None:
        self.plan, self.work, self.record, self.store = plan, work, record, store
        self.places = [[record.place(plan.grid.labels_at(p)) for p in case.points] for case in work.cases]
        self.active = [set(range(len(case.points))) for case in work.cases]
        self.fits: dict[int, int] = {}
        self.rows: dict[int, int] = {}
        self.waiting: list[tuple[Chunk, Outcome]] = []
        self.settled_at: dict[tuple[int, int], int] = {}

    def all_levels(self, engine: Engine, title: str) -> None:
        if self.record.algorithms:
            self._refuse_missing(self.record.metrics)
        levels = sorted(
            {
                *looks(self.plan.trials, self.plan.stop),
                *(n for n in self.record.about.get("finished", []) if n < self.plan.trials),
            }
        )
        progress, began, first = (
            Progress(title, self._expected(levels[-1]), self._recorded(levels[-1])),
            time.perf_counter(),
            0,
        )
        session = self._session(engine)
        try:
            for last in levels:
                for chunk, outcome in engine.results(self.work, self._tasks(first, last)):
                    self._enter(chunk, outcome)
                    progress.advance(len(chunk), outcome.seconds)
                self.settle()
                self._finished(last)
                if last in looks(self.plan.trials, self.plan.stop)[:-1]:
                    self._drop_settled(last)
                    progress.expect(self._expected(levels[-1]))
                first = last
        finally:
            progress.close()
            self._note(
                {
                    **session,
                    "seconds": time.perf_counter() - began,
                    "trials": progress.done - progress.began_with,
                    "chunk_rows": {str(k): v for k, v in self.rows.items()},
                }
            )

    def _expected(self, trials: int) -> int:
        """Trials that the sweep will hold if no further point ends early."""
        return sum(
            self.settled_at.get((case, p), trials)
            for case, places in enumerate(self.places)
            for p in range(len(places))
        )

    def _finished(self, trials: int) -> None:
        """Remember that all points got this far: batches never reach across, so that an extension
        of a sweep runs the same ones however often it is resumed.
        """
        finished = sorted({*self.record.about.get("finished", []), trials})
        self._about(finished=finished)

    def _recorded(self, trials: int) -> int:
        return sum(
            int(self.record.done[(*place, slice(0, trials))].sum()) for places in self.places for place in places
        )

    def _tasks(self, first: int, last: int) -> Iterator[Task]:
        """Chunks of one level without the rows that are done."""
        for number, case in enumerate(self.work.cases):
            missing = any(
                not self.record.done[(*self.places[number][p], slice(first, last))].all() for p in self.active[number]
            )
            if not missing:
                continue
            self.rows[number] = (
                self.plan.chunk
                or self.rows.get(number)
                or rows_by_bytes(probed_bytes(self.work, number), self.plan.device)
            )
            for whole in cut(number, case, self.active[number], first, last, self.rows[number]):
                keep = [
                    i
                    for i, (p, t) in enumerate(zip(whole.points, whole.trials))
                    if not self.record.done[(*self.places[number][p], t)]
                ]
                if keep:
                    yield (
                        Chunk(number, tuple(whole.points[i] for i in keep), tuple(whole.trials[i] for i in keep)),
                        self.fits.get(number),
                    )

    def _enter(self, chunk: Chunk, outcome: Outcome) -> None:
        """Take in a chunk; it waits with others until writing them together is cheap."""
        if not self.record.algorithms and not self.waiting:
            self._refuse_missing({metric for metrics in outcome.values.values() for metric in metrics if metric != OK})
        if outcome.fits is not None and outcome.fits < self.fits.get(chunk.case, len(chunk)):
            log.warning("warning: %d trials at once do not fit into memory; going on with %d", len(chunk), outcome.fits)
            self.fits[chunk.case] = outcome.fits
        self.waiting.append((chunk, outcome))
        if len(self.waiting) >= _WAITING or (self.store is not None and self.store.due):
            self.settle()

    def settle(self) -> None:
        """Enter what waits into the record and the store.

        The store is told first: a second Ctrl-C in between may then leave rows that are announced
        and not done, never the reverse.
        """
        while self.waiting:
            chunk, outcome = self.waiting.pop(0)
            places = [self.places[chunk.case][p] for p in chunk.points]
            if self.store is not None:
                self.store.entered(places, chunk.trials)
                points = self.work.cases[chunk.case].points
                for row, arrays in outcome.saved.items():
                    self.store.save(self.plan.grid.labels_at(points[chunk.points[row]]), chunk.trials[row], arrays)
            self.record.add(places, chunk.trials, outcome.values, outcome.bounds)
        if self.store is not None:
            self.store.flush()

    def _refuse_missing(self, given: Iterable[str]) -> None:
        """given: the metrics that trials give."""
        stop = (("stop.metric", self.plan.stop.metric),) if self.plan.stop else ()
        for where, metric in (*self.plan.needs, *stop):
            if metric not in given:
                raise ConfigError(f"{where} names {metric!r}, which no trial gives{did_you_mean(metric, given)}")

    def _drop_settled(self, trials: int) -> None:
        assert self.plan.stop is not None
        for case, (places, active) in enumerate(zip(self.places, self.active)):
            ended = {p for p in active if self.plan.stop.reached(self.record, places[p], trials, self.plan.seed)}
            self.settled_at.update({(case, p): trials for p in ended})
            active -= ended

    def _session(self, engine: Engine) -> dict[str, Any]:
        gpu = (
            {"gpu": torch.cuda.get_device_name(self.plan.device)}
            if torch.device(self.plan.device).type == "cuda"
            else {}
        )
        return {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "device": self.plan.device,
            **gpu,
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

    def _note(self, session: Mapping[str, Any]) -> None:
        """What this session was, beside those before it."""
        self._about(seed=self.plan.seed, sessions=[*self.record.about.get("sessions", []), session])

    def _about(self, **attributes: Any) -> None:
        self.record.about = {**self.record.about, **attributes}
        if self.store is not None:
            self.store.note(**attributes)
