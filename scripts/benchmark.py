"""Time of every stage, echo simulation, metric and draw of the packaged configs over a floor.

    python scripts/benchmark.py --out benchmark.json [--small] [--only NAME] [--threads 1 2]
                                [--device cpu cuda] [--budget SECONDS] [--random SOURCE SOURCE]

Every config runs in a process of its own, so that its peak memory is its own, and once per number
of threads and device. A row holds

- `config` (its first case), `part` and `name`: what was measured. The parts are `echo` (the
  simulation of the data, draws included), `draws` (random numbers alone), `stage` (METHOD.STAGE),
  `metrics` (METHOD), `batch` (echo, recommended method and metrics) and `memory`. With `--random`
  there are further rows of `batch`, and of the `draws` in it, whose name is the source of random
  numbers;
- `seconds`: median time of one call on all trials of the batch, and `trials`: how many these are;
- `over_floor`: median of the ratio of this time to that of the floor, which is measured in turn
  with it: bare transforms of the same data, one two-dimensional FFT and its inverse. A machine that
  other programs use too slows both, so that runs can be compared by the ratio;
- `peak_bytes`: largest resident memory of the process, or its largest memory on the device, of the
  part `memory` only.

`scripts/compare_benchmarks.py OLD NEW` lists what became slower. Configs that need a recording are
left out. The file is written after each config.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from torchsar import keep_freed_memory
from torchsar.core import Draws, Trace
from torchsar.core.draws import Source
from torchsar.study.settings.sections import cases_of
from torchsar.study.settings.text import find_config
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

# configs, and the number of trials that are processed at once
CONFIGS = {
    "airborne_spotlight": 1,
    "bistatic_fixed": 1,
    "drone_stripmap": 1,
    "geo_ocean": 1,
    "geo_point_targets": 1,
    "isal_corner_cubes": 1,
    "isal_ground": 1,
    "isal_motion": 1,
    "isal_satellite": 1,
    "isal_table1": 1,
    "sal_letter_e": 1,
    "sal_points": 1,
    "stripmap_damaged": 1,
    "sweeps/geo_velocity_scnr": 8,
    "sweeps/isal_rotation_snr": 8,
    "sweeps/isal_snr": 8,
    "sweeps/path_autofocus": 2,
    "sweeps/sal_snr": 16,
    "sweeps/stripmap_doppler": 16,
}
SMALL = {"sweeps/sal_snr": 2}
# on an accelerator sweeps process so many times as many trials at once
MORE = 32
# calls are repeated until so much time is spent, and at most so often
BUDGET_S, MOST = 1.0, 15
# random numbers are drawn by these methods of `Draws`; `subset` takes those of `permutation`
DRAWN = ("normal", "uniform", "permutation")

Row = dict[str, Any]


@dataclass
class Measured:
    """Rows of one config.

    Args:
        common: Entries that all rows share.
        budget_s: Time for the repetitions of a call.
        rows: The rows so far.
        calls: Number of repetitions of the last call.
    """

    common: Row
    budget_s: float
    rows: list[Row] = field(default_factory=list)
    calls: int = 0

    def add(self, part: str, name: str, **values: float | None) -> None:
        """Add a row."""
        rounded = {key: None if x is None else float(f"{x:.4g}") for key, x in values.items()}
        self.rows.append({**self.common, "part": part, "name": name, **rounded})

    def time(self, part: str, name: str, work: Callable[[], Any], data: Tensor) -> None:
        """Measure a call in turn with transforms of the data."""
        device = data.device
        floor = transforms(data)
        times, floors = [], []
        began = time.perf_counter()
        while not times or (len(times) < MOST and time.perf_counter() - began < self.budget_s):
            floors.append(seconds(floor, device))
            times.append(seconds(work, device))
        self.calls = len(times)
        ratio = statistics.median(a / b for a, b in zip(times, floors, strict=True))
        self.add(part, name, seconds=statistics.median(times), over_floor=ratio)


def transforms(data: Tensor) -> Callable[[], Tensor]:
    """A call that transforms data over their last two dimensions, and back."""
    x = data if data.is_complex() else data.to(torch.complex64)
    return lambda: torch.fft.ifft2(torch.fft.fft2(x))


def seconds(work: Callable[[], Any], device: torch.device) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    if device.type != "cpu":
        torch.accelerator.synchronize(device)
    return time.perf_counter() - began


@contextmanager
def drawing(device: torch.device) -> Iterator[list[float]]:
    """Collect the times of the calls that draw random numbers."""
    spent: list[float] = []
    whole = {name: getattr(Draws, name) for name in DRAWN}

    def timed(method: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def call(*args: Any, **kwargs: Any) -> Tensor:
            drawn: list[Tensor] = []
            spent.append(seconds(lambda: drawn.append(method(*args, **kwargs)), device))
            return drawn[0]

        return call

    for name, method in whole.items():
        setattr(Draws, name, timed(method))
    try:
        yield spent
    finally:
        for name, method in whole.items():
            setattr(Draws, name, method)


def measured(
    config: str, count: int, budget_s: float, sources: Sequence[Source], threads: int, device: str
) -> list[Row]:
    """Rows of one config with so many trials, for one number of threads on one device."""
    torch.set_num_threads(threads)
    keep_freed_memory()  # as the commands do
    bench = Bench(next(iter(cases_of(load(find_config(config))).values())), device)
    found = Measured({"config": config, "threads": threads, "device": device, "trials": count}, budget_s)
    draws = bench.draws(trials=range(count))
    batch = bench.batch(draws, keep=list(bench.chains))
    raw = batch.trials.recording.signal.data

    with drawing(raw.device) as spent:
        found.time("echo", "", lambda: bench.trials(draws), raw)
    found.add("draws", "", seconds=sum(spent) / found.calls, over_floor=None)
    for method, outcome in batch.outcomes.items():
        trace = outcome.trace
        if outcome.failed or trace is None or bench.config.processor[method].rerun is not None:
            continue
        for stage in trace.inputs:
            call = again(bench, method, stage, trace)
            found.time("stage", f"{method}.{stage}", call, trace.inputs[stage].data)
        judge = judging(bench, method, trace, batch.trials)
        found.time("metrics", method, judge, trace.signal.data)
    found.time("batch", "", lambda: bench.batch(draws, methods=["recommended"]), raw)
    found.add("memory", "", peak_bytes=peak_bytes(bench.device))
    for source in sources:
        others = replace(draws, source=source)
        bench.trials(others)  # the first draws of a process take longer
        with drawing(raw.device) as spent:
            found.time("batch", source, lambda d=others: bench.batch(d, methods=["recommended"]), raw)
        found.add("draws", source, seconds=sum(spent) / found.calls, over_floor=None)
    return found.rows


def peak_bytes(device: str) -> int:
    """Largest memory of the process on a CUDA device, or its largest resident memory."""
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    # kilobytes on Linux, bytes on macOS
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def again(bench: Bench, method: str, stage: str, trace: Trace) -> Callable[[], Any]:
    """A call that repeats a stage with the values that it had."""
    module, signal, arguments = bench.chains[method].stages[stage], trace.inputs[stage], trace.arguments[stage]
    return lambda: module(signal, **arguments)


def judging(bench: Bench, method: str, trace: Trace, trials: Any) -> Callable[[], Any]:
    """A call that computes the metrics of a method."""
    return lambda: bench.system.judge(bench, method, trace, trials, False)


def worker(sent: Any, *about: Any) -> None:
    """Send the rows of one config, or the sentence that says why there are none."""
    try:
        with torch.no_grad():
            sent.send(measured(*about))
    except Exception as error:
        sent.send(f"{type(error).__name__}: {error}")


def machine() -> Row:
    """What the figures depend on."""
    about: Row = {"python": platform.python_version(), "torch": torch.__version__, "system": platform.platform()}
    about |= {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    about["vectors"] = torch.backends.cpu.get_cpu_capability()
    if torch.cuda.is_available():
        about["cuda"] = torch.cuda.get_device_name()
    return about


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the rows after each config."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="file for the rows, .json")
    parser.add_argument(
        "--small", action="store_true", help="one config of two trials, each part once, with one thread"
    )
    parser.add_argument("--only", default="", help="configs whose name contains this")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="seconds for the repetitions of a call")
    parser.add_argument("--device", nargs="+", default=devices, help="devices, by default all that there are")
    parser.add_argument(
        "--random", nargs="+", choices=get_args(Source), default=[], help="sources of random numbers to compare"
    )
    options = parser.parse_args(arguments)
    counts, budget_s = (SMALL, 0.0) if options.small else (CONFIGS, options.budget)
    chosen = [name for name in counts if options.only in name]
    if not chosen:
        parser.error(f"no config has {options.only!r} in its name; there are {', '.join(counts)}")
    spawn = multiprocessing.get_context("spawn")
    rows: list[Row] = []
    failed: dict[str, str] = {}
    for config in chosen:
        for device in options.device:
            for threads in options.threads[: 1 if options.small or device != "cpu" else None]:
                received, sent = spawn.Pipe(duplex=False)
                count = counts[config] * (MORE if device != "cpu" and counts[config] > 1 else 1)
                about = (config, count, budget_s, options.random, threads, device)
                process = spawn.Process(target=worker, args=(sent, *about))
                process.start()
                sent.close()
                try:
                    found = received.recv()
                except EOFError:
                    found = "the process was killed, perhaps for want of memory"
                process.join()
                if isinstance(found, str):
                    failed[f"{config}, {threads} threads, {device}"] = found
                    print(f"{config}: {found}", flush=True)
                    continue
                rows += found
                report(found)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(written(rows, failed), encoding="utf-8")
    print(f"{len(rows)} rows: {options.out}")


def report(rows: Sequence[Row]) -> None:
    """Print the batch of a config, and its slowest parts."""
    parts = {part: [row for row in rows if row["part"] == part] for part in ("batch", "draws", "stage")}
    batch, draws = parts["batch"][0], parts["draws"][0]
    print(
        f"{batch['config']}, {batch['threads']} threads, {batch['device']}: {batch['trials'] / batch['seconds']:.3g} "
        f"trials/s, draws {draws['seconds'] / batch['seconds']:.0%} of them"
    )
    for row in sorted(parts["stage"], key=lambda row: -row["seconds"])[:3]:
        print(f"    {row['name']:<40}{row['seconds']:>10.3g} s{row['over_floor']:>10.3g} times the floor", flush=True)


def written(rows: Sequence[Row], failed: Row) -> str:
    """JSON with one row per line."""
    lines = ",\n".join(json.dumps(row) for row in rows)
    return f'{{"machine": {json.dumps(machine())},\n"failed": {json.dumps(failed)},\n"rows": [\n{lines}\n]}}\n'


if __name__ == "__main__":
    main()
