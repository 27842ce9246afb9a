"""How busy a GPU is while several processes compute packaged sweeps.

    python scripts/sweep_busy.py --out FILE.json [SWEEP ...] [--workers N] [--seconds S] [--batch N]

Every process computes one batch after the other: of a point of the grid, or of all points that may
share a batch, with random numbers from `torch`. A row holds the `sweep`, the number of `trials` in
a batch, the `trials_per_s` of all processes together, and `busy`, the share of the time in which
the GPU computes, as `nvidia-smi` reports it (none on a CPU). Both are counted from the moment when
as many batches are done as there are processes. The file is written after each sweep.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchsar import keep_freed_memory
from torchsar.core import device_fault
from torchsar.study.commands.sweep import SweepTrial, sweep_grid
from torchsar.study.montecarlo.engines import Engine, Task, engine
from torchsar.study.montecarlo.grid import Grid
from torchsar.study.montecarlo.loop import Plan
from torchsar.study.montecarlo.work import Chunk
from torchsar.study.table import load

SWEEPS = Path(__file__).resolve().parents[1] / "configs" / "sweeps"
READING = ("nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", "200")


class Usage:
    """Usage of the GPU in per cent, read five times a second by a thread."""

    def __init__(self) -> None:
        self.readings: list[tuple[float, float]] = []
        self._process = subprocess.Popen(READING, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.readings.append((time.perf_counter(), float(line)))

    def mean(self, began: float, ended: float) -> float:
        """Mean over a time."""
        return statistics.fmean(x for moment, x in self.readings if began <= moment <= ended)

    def stop(self) -> None:
        self._process.terminate()


def batches(points: int, trials: int) -> Iterator[Task]:
    """Batches of the first case without end."""
    for first in itertools.count(0, trials):
        rows = range(first, first + trials)
        yield Chunk(0, tuple(row % points for row in rows), tuple(rows)), None


def measured(name: str, chosen: Engine, options: argparse.Namespace, usage: Usage | None) -> dict[str, Any]:
    """The row of one sweep."""
    loaded = load(name, ["random=torch"])
    trial = SweepTrial(loaded, options.device)
    whole = sweep_grid(loaded, trial)
    first = (p if p.batched else replace(p, labels=p.labels[:1], values=p.values[:1]) for p in whole.parameters)
    work = Plan(Grid(tuple(first)), seed=loaded.config.seed, device=options.device, random="torch").work(trial)
    points = len(work.cases[0].points)
    trials = min(options.batch, -(-loaded.config.sweep.trials * points // chosen.workers))
    began, ended, done = 0.0, 0.0, 0
    for number, (chunk, _) in enumerate(chosen.results(work, batches(points, trials))):
        if number + 1 == chosen.workers:
            began = time.perf_counter()
        elif began:
            done, ended = done + len(chunk), time.perf_counter()
            if ended > began + options.seconds:
                break
    row = {"sweep": name, "trials": trials, "trials_per_s": float(f"{done / (ended - began):.3g}")}
    return row | {"busy": None if usage is None else round(usage.mean(began, ended) / 100, 3)}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    names = sorted(file.stem for file in SWEEPS.glob("*.yaml"))
    parser.add_argument("sweeps", nargs="*", default=names, help="all by default")
    parser.add_argument("--out", type=Path, required=True, help="file for the rows, .json")
    parser.add_argument("--workers", type=int, default=14)
    parser.add_argument("--seconds", type=float, default=6.0, help="how long each sweep is measured")
    parser.add_argument("--batch", type=int, default=256, help="trials of a batch at most")
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.sweeps if name not in names]
    if unknown:
        parser.error(f"{unknown[0]!r} is no packaged sweep; there are {', '.join(names)}")
    if min(options.workers, options.batch) < 1 or not options.seconds > 0:
        parser.error("--workers, --batch and --seconds must be above 0")
    reason = device_fault(options.device)
    if reason:
        parser.error(f"the device {options.device!r} cannot be used here: {reason}")
    keep_freed_memory()  # as the commands do
    on_gpu = options.device.startswith("cuda")
    gpu = torch.cuda.get_device_name() if on_gpu else None
    about = {"gpu": gpu, "torch": torch.__version__, "workers": options.workers}
    usage = Usage() if on_gpu else None
    rows: list[dict[str, Any]] = []
    with engine(workers=options.workers) as chosen:
        for name in options.sweeps:
            rows.append(measured(name, chosen, options, usage))
            print(json.dumps(rows[-1]), flush=True)
            lines = ",\n".join(json.dumps(row) for row in rows)
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(f'{{"machine": {json.dumps(about)},\n"rows": [\n{lines}\n]}}\n', encoding="utf-8")
    if usage is not None:
        usage.stop()


if __name__ == "__main__":
    main()
