"""The command `torchsar sweep`: runs the Monte Carlo sweep of a config and writes a report."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from torchsar.core import Chain, Draws
from torchsar.study.montecarlo.engines import engine
from torchsar.study.montecarlo.fingerprint import code, files_in, packages_of
from torchsar.study.montecarlo.grid import Grid, make_grid
from torchsar.study.montecarlo.loop import (
    SWEEP_FILES,
    Interrupted,
    Plan,
    Stop,
    identity_of_draws,
    open_store,
    run_plan,
)
from torchsar.study.montecarlo.record import Record, summary_of
from torchsar.study.montecarlo.report import draw_sweep, write_sweep_report
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.output.folder import opened
from torchsar.study.output.numbers import write_json
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.settings.sections import Config, Loaded, Sweep
from torchsar.study.trials.batch import OK, Processed
from torchsar.study.trials.bench import Bench

log = logging.getLogger("torchsar")
# keys that change only how much is computed or shown; results do not depend on them
_NOT_IDENTITY: Any = dict.fromkeys(("sweep", "trade", "title", "seed", "random", "cases", "beyond_limits"), True) | {
    "processor": {"__all__": {"title"}}
}
# results that change when the same trial is repeated, such as times, or that follow from other
# results
_NOT_RESULTS = ("seconds", OK)
_FIXED = ("sweep", "seed", "random", "data", "title", "trade", "system", "cases")


class SweepTrial:
    """Trial function of a config: it simulates a batch of trials, runs every method on them, and
    returns their metrics.

    Args:
        loaded: The config.
        device: Device on which batches are computed.
    """

    def __init__(self, loaded: Loaded, device: str = "cpu") -> None:
        self.loaded, self.device = loaded, device
        self._benches: dict[str, Bench] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for other processes, without benches, because each process builds its
        own.
        """
        return {"loaded": self.loaded, "device": self.device, "_benches": {}}

    def may_differ(self, key: str) -> bool:
        """Decide whether the value of a key may differ between the trials of a batch."""
        section, _, rest = key.partition(".")
        return section == "world" and self.loaded.system.may_differ(rest, self.loaded.config.world)

    def bench(self, fixed: Mapping[str, Any]) -> Bench:
        """Return the bench (radar, world and chains) of a case of the grid; it is built once."""
        key = repr(fixed)
        if key not in self._benches:
            self._benches[key] = Bench(self.loaded.changed(fixed), self.device)
        return self._benches[key]

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int:
        """Return the size in bytes of the largest tensor of a trial; batch sizes follow from it."""
        return self.bench(fixed).bytes_per_trial

    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        given = {k.removeprefix("world."): v for k, v in parameters.items() if isinstance(v, Tensor)}
        bench = self.bench({key: value for key, value in parameters.items() if not isinstance(value, Tensor)})
        save = bench.config.sweep.save
        batch = bench.batch(draws, given, keep=bench.chains if save.trials else ())
        found: dict[str, Any] = {
            name: {metric: x for metric, x in outcome.metrics.items() if metric not in _NOT_RESULTS}
            for name, outcome in batch.outcomes.items()
        }
        saved = {name: _saved(o, save.taps) for name, o in batch.outcomes.items()} if save.trials else {}
        return {**found, BOUNDS: bench.system.bounds(bench, batch), SAVED: saved}


def _saved(outcome: Processed, taps: list[str]) -> dict[str, Tensor]:
    """Return the last signal of a method, and the outputs of the stages that
    sweep.save.taps names.
    """
    if outcome.signal is None:
        return {}
    outputs = {} if outcome.trace is None else outcome.trace.outputs
    return {"last": outcome.signal.data, **{stage: outputs[stage].data for stage in taps if stage in outputs}}


def sweep(
    loaded: Loaded,
    out: Path,
    resume: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    threads: int = 1,
    device: str = "cpu",
    command: str = "torchsar sweep",
    allow_changed: bool = False,
) -> Path:
    """Run the sweep of a config, and write its results and report into a folder.

    Args:
        loaded: The config.
        out: The folder: results.zarr grows there while the sweep runs and is never replaced;
            config.yaml, summary.json, figures/ and report.html appear at the end.
        resume: Whether to continue a sweep that is in the folder.
        workers: Number of worker processes on this machine; None to compute in this process.
        cluster: Address of a running dask scheduler, whose workers are used instead.
        threads: Number of torch threads in each process.
        device: Device on which batches are computed.
        command: Command line that the report shows.
        allow_changed: Whether to go on with a sweep of other code, files or keys. The report then
            names what changed.

    Returns:
        The path of the report.

    Raises:
        ConfigError: If the config is invalid, a trial fails, or the folder cannot be written.
        Interrupted: After Ctrl-C, with a sentence that says how to go on.
    """
    settings, trial = loaded.config.sweep, SweepTrial(loaded, device)
    grid = sweep_grid(loaded, trial)
    stop = None if settings.stop is None else Stop(**settings.stop.model_dump())
    named = {"success": settings.success, "show": settings.show, "stop.metric": [stop.metric] if stop else []}
    needs = tuple((f"{loaded.file}: sweep.{key}", metric) for key, metrics in named.items() for metric in metrics)
    save = frozenset(settings.save.trials)
    plan = Plan(
        *(grid, settings.trials, loaded.config.seed, settings.chunk, stop, save, device, needs),
        random=loaded.config.random,
    )
    plan.refuse_missing(trial)
    config_text = loaded.text()
    about = {"title": loaded.config.title, "config": config_text, "dtype": loaded.config.precision}
    together, apart = (
        ", ".join(f"{p.name} ({len(p.labels)})" for p in grid.parameters if p.batched is batched) or "none"
        for batched in (True, False)
    )
    text = "%d points of %d trials; values that share batches: %s; cases of their own: %s"
    log.info(text, len(grid.points()), settings.trials, together, apart)
    try:
        with opened(out, "sweep", SWEEP_FILES) as folder, _terminated_like_interrupted():
            store = open_store(
                folder,
                plan,
                identity(loaded, (one for case in grid.cases() for one in trial.bench(case.fixed).chains.values())),
                resume,
                allow_changed,
            )
            store.note(**about)
            record = run_plan(plan, trial, store, engine(workers, cluster, threads))
            record.about = {**record.about, **about}
            with folder.staged() as new:
                report(record.select(grid.labels), loaded, new, config_text, command)
    except Interrupted as stopped:
        raise Interrupted(f"{stopped} in {out}; go on with --resume") from None
    except KeyboardInterrupt:  # a second Ctrl-C, or one while the report is written
        raise Interrupted(f"finished trials are recorded in {out}; go on with --resume") from None
    except OSError as error:
        raise ConfigError(
            f"{out}: the report cannot be written ({error.strerror or error}), but the trials are recorded; run the "
            "command again with --resume to make the report"
        ) from error
    return out / "report.html"


def sweep_grid(loaded: Loaded, trial: SweepTrial) -> Grid:
    """Return the grid of the sweep in a config, after a check of its keys and values.

    Raises:
        ConfigError: If a key or value is not accepted, or a case of the grid cannot be built.
    """
    given, file = loaded.config.sweep.grid, loaded.file
    if loaded.config.data.file is not None:
        raise ConfigError(
            f"{file}: data.file cannot be used in a sweep, which simulates its trials; give 'radar' and 'world' instead"
        )
    if loaded.config.cases:
        raise ConfigError(
            f"{file}: cases cannot be used in a sweep; sweep over the keys that they change, and add cases={{}} to "
            "remove them"
        )
    taken = next((name for name in loaded.config.processor if name in (BOUNDS, SAVED)), None)
    if taken is not None:
        raise ConfigError(
            f"{file}: processor.{taken}: a method of a sweep cannot have this name, because the results have an entry "
            "of that name; choose another name"
        )
    for key in given:
        if key.split(".")[0] in _FIXED or key == "world.trials":
            raise ConfigError(f"{file}: sweep: the key {key!r} cannot be swept")
        if "." not in key and key not in Config.model_fields:
            raise ConfigError(
                f"{file}: sweep.{key} is neither a setting of the sweep nor a key of the "
                f"config{did_you_mean(key, (*Sweep.model_fields, *Config.model_fields))}"
            )
    loaded.system.check_sweep(loaded, given)
    grid = make_grid(given, [key for key in given if trial.may_differ(key)], f"{file}: sweep")
    for parameter in grid.parameters:
        ends = {*parameter.values[:1], min(parameter.values), max(parameter.values)} if parameter.batched else ()
        # the ends of a range are tested, because all numbers between two accepted ones are accepted
        for value in ends:
            Bench(loaded.changed({parameter.name: value}), trial.device)
    for case in grid.cases():
        there = {stage for chain in trial.bench(case.fixed).chains.values() for stage in chain.stages}
        for tap in loaded.config.sweep.save.taps:
            if tap not in there:
                raise ConfigError(
                    f"{file}: sweep.save.taps names {tap!r}, which is no stage of a method{did_you_mean(tap, there)}"
                )
    return grid


def identity(loaded: Loaded, chains: Iterable[Chain] = ()) -> dict[str, Any]:
    """Return what the results depend on besides the grid.

    This includes the seed and the source of the random numbers, all other keys of the config that
    change results, and the contents of the files that it names. It also includes the code of
    torchsar and of the user's own stages in the chains, and the versions of torch and numpy.
    """
    tree = loaded.config.model_dump(exclude=_NOT_IDENTITY)
    drawn = identity_of_draws(loaded.config.seed, loaded.config.random)
    return {**drawn, "config": tree, "files": files_in([tree, loaded.config.sweep.grid]), **code(packages_of(chains))}


def report(record: Record, loaded: Loaded, out: Path, config_text: str, command: str) -> None:
    """Write config.yaml, summary.json, figures/ and report.html of a sweep to a folder."""
    titles = {f"method {name}": method.title for name, method in loaded.config.processor.items() if method.title}
    summary = summary_of(record, loaded.config.sweep.success)
    tree = summary.tree(record.about, {"snr": loaded.system.definitions["snr"], **titles})
    pictures = draw_sweep(summary, out / "figures", loaded.config.sweep.show)
    (out / "config.yaml").write_text(config_text, encoding="utf-8")
    write_json(out / "summary.json", tree)
    write_sweep_report(out / "report.html", tree, pictures, out / "figures", config_text, command)


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Handle SIGTERM, by which batch systems end jobs, as Ctrl-C: finished trials are recorded."""

    main = threading.current_thread() is threading.main_thread()
    earlier = signal.signal(signal.SIGTERM, signal.default_int_handler) if main else None
    try:
        yield
    finally:
        if main:
            signal.signal(signal.SIGTERM, earlier)
