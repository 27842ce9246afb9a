"""`torchsar sweep`: a Monte Carlo sweep, from config to report."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from torchsar.study.build import resolved
from torchsar.study.config import Config, Loaded, Sweep
from torchsar.study.montecarlo.engines import engine
from torchsar.study.montecarlo.grid import Grid, make_grid
from torchsar.study.montecarlo.loop import SWEEP_FILES, Interrupted, Plan, open_store, run_plan
from torchsar.study.montecarlo.pictures import draw_sweep
from torchsar.study.montecarlo.record import Record
from torchsar.study.montecarlo.report import write_sweep_report
from torchsar.study.montecarlo.stopping import Stop
from torchsar.study.montecarlo.summary import summary_tree
from torchsar.study.montecarlo.work import BOUNDS, SAVED
from torchsar.study.output.arrays import write_json
from torchsar.study.output.folder import opened
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.systems import Trials, system_of

log = logging.getLogger("torchsar")
_NOT_IDENTITY = ("sweep", "trade", "title", "seed")
_FIXED = ("sweep", "seed", "data", "title", "trade", "system")


def sweep_config(
    loaded: Loaded,
    out: Path,
    resume: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    threads: int = 1,
    device: str = "cpu",
    command: str = "torchsar sweep",
) -> Path:
    """Run the sweep of a config and write results.zarr, config.yaml, summary.json, figures/ and
    report.html into OUT; returns the report's path.

    results.zarr grows while it runs and is never replaced; the other files appear at the end.
    Raises ConfigError for what the user can put right, Interrupted after Ctrl-C with a sentence
    that says how to go on.
    """
    settings = loaded.config.sweep
    grid = sweep_grid(loaded)
    stop = None if settings.stop is None else Stop(**settings.stop.model_dump())
    needs = [(f"{loaded.file}: sweep.success", metric) for metric in settings.success] + [
        (f"{loaded.file}: sweep.show", metric) for metric in settings.show
    ]
    plan = Plan(
        grid,
        settings.trials,
        loaded.config.seed,
        settings.chunk,
        stop,
        frozenset(settings.save.trials),
        device,
        tuple(needs),
    )
    config_text = loaded.text(resolved(loaded))
    about = {"title": loaded.config.title, "config": config_text, "dtype": loaded.config.precision}
    _announce(grid, settings.trials)
    try:
        with opened(out, "sweep", SWEEP_FILES) as folder, _terminated_like_interrupted():
            store = open_store(folder, plan, identity(loaded), resume)
            store.note(**about)
            trials = system_of(loaded).trials(loaded, device)
            record = run_plan(plan, trials, store, engine(workers, cluster, threads), loaded.name)
            record.about = {**record.about, **about}
            with folder.staged() as new:
                report(record.select(grid.labels), loaded, new, config_text, command)
    except Interrupted as stopped:
        raise Interrupted(f"{stopped} in {out}; go on with --resume") from None
    except KeyboardInterrupt:  # a second Ctrl-C, or one while the report was made
        raise Interrupted(f"what is marked done is in {out}; go on with --resume") from None
    except OSError as error:
        raise ConfigError(
            f"{out}: the report cannot be written ({error.strerror or error}); the trials are "
            "recorded, make it with --resume"
        ) from error
    return out / "report.html"


def sweep_grid(loaded: Loaded) -> Grid:
    """The grid of a config's sweep, every key and value checked and every case built once.

    Raises ConfigError.
    """
    given, trials = loaded.config.sweep.grid, system_of(loaded).trials(loaded)
    if loaded.config.world is None or loaded.config.data.file is not None:
        raise ConfigError(
            f"{loaded.file}: a sweep simulates its trials; give the sections 'radar' and 'world' and no data.file"
        )
    taken = [name for name in loaded.config.processor if name in (BOUNDS, SAVED)]
    if taken:
        raise ConfigError(
            f"{loaded.file}: processor.{taken[0]}: in a sweep this name is taken by a part of the "
            "results; choose another"
        )
    for key in given:
        _refuse_fixed(key, loaded)
    grid = make_grid(given, [key for key in given if key in trials.batched], f"{loaded.file}: sweep")
    for parameter in grid.parameters:
        for value in parameter.values:
            loaded.changed({parameter.name: value})
    trials.check(given)
    for case in grid.cases():
        _refuse_missing_taps(trials, case.fixed, loaded)
    return grid


def _refuse_fixed(key: str, loaded: Loaded) -> None:
    if key.split(".")[0] in _FIXED:
        raise ConfigError(f"{loaded.file}: sweep: the key {key!r} cannot be swept")
    if "." not in key and key not in Config.model_fields:
        raise ConfigError(
            f"{loaded.file}: sweep.{key} is neither a setting of the sweep nor a key of the "
            f"config{did_you_mean(key, (*Sweep.model_fields, *Config.model_fields))}"
        )


def _refuse_missing_taps(trials: Trials, fixed: Mapping[str, Any], loaded: Loaded) -> None:
    there = trials.stages(fixed)
    for tap in loaded.config.sweep.save.taps:
        if tap not in there:
            raise ConfigError(
                f"{loaded.file}: sweep.save.taps names {tap!r}, which is no stage of a method{did_you_mean(tap, there)}"
            )


def identity(loaded: Loaded) -> dict[str, Any]:
    """What the results depend on besides the grid: the resolved config without what only says how
    much is computed or shown.
    """
    tree = resolved(loaded)
    return {
        "seed": loaded.config.seed,
        "config": {key: value for key, value in tree.items() if key not in _NOT_IDENTITY},
    }


def report(record: Record, loaded: Loaded, out: Path, config_text: str, command: str) -> None:
    """Write config.yaml, summary.json, figures/ and report.html of a record into a folder."""
    titles = {f"method {name}": method.title for name, method in loaded.config.processor.items() if method.title}
    summary = summary_tree(record, loaded.config.sweep.success, {"snr": system_of(loaded).definitions["snr"], **titles})
    pictures = draw_sweep(summary, out / "figures", loaded.config.sweep.show)
    (out / "config.yaml").write_text(config_text, encoding="utf-8")
    write_json(out / "summary.json", summary)
    write_sweep_report(out / "report.html", summary, pictures, out / "figures", config_text, command)


def _announce(grid: Grid, trials: int) -> None:
    together = [f"{p.name} ({len(p.labels)})" for p in grid.parameters if p.batched]
    apart = [f"{p.name} ({len(p.labels)})" for p in grid.parameters if not p.batched]
    log.info(
        "%d points of %d trials; per-trial tensors, which share batches: %s; cases of their own: %s",
        len(grid.points()),
        trials,
        ", ".join(together) or "none",
        ", ".join(apart) or "none",
    )


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """A batch system ends jobs with SIGTERM: record what there is, as after Ctrl-C."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        earlier = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, earlier)
