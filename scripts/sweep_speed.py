"""Trials a second of a sweep: one trial at a time, all trials at once, automatic chunks, and two
processes; one thread of torch each.

    python scripts/sweep_speed.py [CONFIG] [--trials N] [--rounds N] [key=value ...]

The alternatives take turns, so that a machine that others use too is equally slow for all; the
median round counts. Only the first point of the config's grid is run, without a store. On two idle
cores two workers reach at least 1.6 times the automatic chunks.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from contextlib import nullcontext
from dataclasses import replace

import torch

from torchsar import keep_freed_memory
from torchsar.study.commands.sweep import SweepTrial, sweep_grid
from torchsar.study.montecarlo.engines import Engine, InProcess, engine
from torchsar.study.montecarlo.grid import Grid
from torchsar.study.montecarlo.loop import Plan, run_plan
from torchsar.study.montecarlo.work import rows_by_bytes
from torchsar.study.table import load


def first_point(grid: Grid) -> Grid:
    """The grid with the first value of every parameter."""
    return Grid(tuple(replace(p, labels=p.labels[:1], values=p.values[:1]) for p in grid.parameters))


def rate(plan: Plan, trial: SweepTrial, chosen: Engine) -> float:
    """Trials a second of one run."""
    began = time.perf_counter()
    run_plan(plan, trial, None, nullcontext(chosen))
    return plan.trials / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("config", nargs="?", default="stripmap_doppler")
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--trials", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as the commands do
    loaded = load(options.config, options.overrides)
    trial = SweepTrial(loaded)
    grid = first_point(sweep_grid(loaded, trial))
    automatic = rows_by_bytes(trial.bytes_per_trial(grid.cases()[0].fixed))
    chunks = {"one by one": 1, "one batch": options.trials, "automatic": automatic, "automatic, 2 workers": automatic}
    rates: dict[str, list[float]] = {name: [] for name in chunks}
    with engine(workers=2) as two:
        for turn in range(options.rounds + 1):
            for name, chunk in chunks.items():
                plan = Plan(grid, options.trials, seed=turn, chunk=chunk)
                found = rate(plan, trial, two if "workers" in name else InProcess())
                if turn:  # the first round builds chains and plans transforms
                    rates[name].append(found)
    print(
        f"{loaded.name}, {options.trials} trials, torch {torch.__version__}, {platform.machine()}, one thread a process"
    )
    reference = statistics.median(rates["automatic"])
    print(f"{'alternative':<24}{'trials a batch':>15}{'trials/s':>12}{'of automatic':>14}{'spread':>16}")
    for name, found in rates.items():
        middle = statistics.median(found)
        print(
            f"{name:<24}{chunks[name]:>15}{middle:>12.2f}{middle / reference:>14.2f}"
            f"{min(found):>8.2f}..{max(found):.2f}"
        )


if __name__ == "__main__":
    main()
