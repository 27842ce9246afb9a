"""The command `torchsar trade`: measures the computing time of alternative stages, models and
settings, and the accuracy that each loses relative to an exact one.
"""

from __future__ import annotations

import logging
import math
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from torchsar import plot
from torchsar.study.commands.requires import aligned
from torchsar.study.memory import PeakMemory, wait_for_devices
from torchsar.study.output.folder import fresh_result
from torchsar.study.output.numbers import MISSING, number, write_json
from torchsar.study.output.progress import progress
from torchsar.study.output.report import installed_version
from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import Loaded, cases_of
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import EXACT_DB, Alternative, Choice, Measured, choices_of, tolerance_of, within

log = logging.getLogger("torchsar")
FILES = ("config.yaml", "trade.json", "trade.txt", "figures")
# errors that an alternative raises if it is not possible for this scene
_FAILURES = (ValueError, TypeError, KeyError, RuntimeError, ArithmeticError)
# losses below this level (dB) are due to rounding in double precision, and are drawn at this level
_DRAWN_DB = -150.0
Row = dict[str, Any]


def trade(loaded: Loaded, out: Path, device: str = "cpu") -> str:
    """Measure time and loss of the alternatives for each choice in the first case of a config.

    Every alternative is timed `trade.repeats` times, in turn with the others. Its loss, by
    metric, is measured against an exact result at the worst position of the scene. The alternative
    with the least CPU time among those with all losses within `trade.tolerance` is recommended.

    Args:
        loaded: The config.
        out: The folder for config.yaml, trade.json, trade.txt and figures/.
        device: Device on which the alternatives are run.

    Returns:
        The text of trade.txt.

    Raises:
        ConfigError: If the config is invalid, or there is nothing to compare.
    """
    with fresh_result(out, "trade", FILES) as folder:
        bench = Bench(next(iter(cases_of(loaded).values())), device)
        tolerance = tolerance_of(loaded)
        choices = [choice for choice in choices_of(bench) if choice.measured is not None]
        if not choices:
            raise ConfigError(f"{loaded.file}: there are no alternatives to compare for this config")
        tables = {choice.name: compared(choice, bench, tolerance) for choice in choices}
        text = "\n\n".join(_text(name, rows) for name, rows in tables.items())
        (folder / "config.yaml").write_text(loaded.text(), encoding="utf-8")
        (folder / "trade.txt").write_text(text + "\n", encoding="utf-8")
        first, *others = tables
        machine = {"machine": platform.processor() or platform.machine(), "torch": torch.__version__}
        machine |= {"threads": torch.get_num_threads(), "device": device, "torchsar-lab": installed_version()}
        tree = {"choice": first, "alternatives": tables[first], "others": {name: tables[name] for name in others}}
        write_json(
            folder / "trade.json", {**tree, "tolerance": tolerance, "seed": loaded.config.seed, "machine": machine}
        )
        (folder / "figures").mkdir()
        for number_, (name, rows) in enumerate(tables.items(), 1):
            _draw(name, rows, tolerance, folder / "figures" / f"{number_:02d}_{'_'.join(name.split())}.png")
    return text


@torch.no_grad()
def compared(choice: Choice, bench: Bench, tolerance: Mapping[str, float]) -> list[Row]:
    """Return times and losses of the alternatives of one choice, one row each.

    The row with the least CPU time among those with acceptable losses is marked as recommended.
    """
    repeats = bench.config.trade.repeats
    order = [*choice.alternatives, *([] if choice.yardstick is None else [choice.yardstick])]
    with progress(len(order) * repeats, choice.name) as runs:
        assert choice.measured is not None
        try:
            measured = choice.measured()
        except _FAILURES as error:
            raise ConfigError(f"{bench.file}: {one_line(error)}") from error
        found = [_Tried(one, measured, bench.device) for one in order]
        for _ in range(repeats):
            for tried in found:
                if not tried.failed:
                    tried.again()
                runs.update()
    rows = [tried.row(tolerance) for tried in found]
    kept = [row for row in rows if row["within_tolerance"]]
    for row in rows:
        row["recommended"] = bool(kept) and row is min(kept, key=lambda r: r["cpu_s"])
    return rows


@dataclass
class _Tried:
    """Measurements of one alternative. `failed` is an error, or a loss that is not finite."""

    one: Alternative
    measured: Measured
    device: str = "cpu"
    times: list[tuple[float, float]] = field(default_factory=list)
    peak_bytes: int | None = None
    loss: dict[str, float] = field(default_factory=dict)
    failed: str = ""

    def again(self) -> None:
        """Run the alternative once more; the first run measures its loss as well."""
        try:
            # memory is returned to the system before the peak is measured, which takes time
            with nullcontext() if self.times else PeakMemory(self.device) as peak:
                # the work is repeated for this time in seconds, so that the time of one run is
                # known to about a percent
                spent, result = _spent(lambda: self.measured.run(self.one), 0.1 if self.times else 0.0)
            if peak is not None:
                self.peak_bytes = peak.bytes
                self.loss = {name: float(value) for name, value in self.measured.loss(self.one, result).items()}
        except _FAILURES as error:
            self.failed = one_line(error)
        else:
            share = self.measured.share(self.one)
            self.times.append((spent[0] / share, spent[1] / share))
            wrong = next((name for name, x in self.loss.items() if math.isnan(x) or x == math.inf), None)
            self.failed = "" if wrong is None else f"{wrong} is not finite"
        if len(self.times) < 2:
            log.info("%s", self._line())

    def row(self, tolerance: Mapping[str, float]) -> Row:
        """Return the row of the alternative in trade.json."""
        cpu, wall = (statistics.median(part) for part in zip(*self.times)) if self.times else (None, None)
        row = {"name": self.one.name, "neglects": self.one.neglects, "cpu_s": cpu, "wall_s": wall}
        row |= {"peak_bytes": self.peak_bytes, "loss": self.loss, "predicted": self.one.loss}
        return {**row, "failed": self.failed, "within_tolerance": not self.failed and within(self.loss, tolerance)}

    def _line(self) -> str:
        losses = ", ".join(f"{name} {_loss(value)}" for name, value in self.loss.items())
        return f"{self.one.name}: " + (f"failed: {self.failed}" if self.failed else losses)


def _spent(work: Callable[[], Any], least_s: float) -> tuple[tuple[float, float], Any]:
    """Mean CPU and wall time of as many runs of the work as fill a given time, and the result of
    the work.
    """
    began, runs = (time.process_time(), time.perf_counter()), 0
    while True:
        result, runs = work(), runs + 1
        wait_for_devices()
        spent = (time.process_time() - began[0], time.perf_counter() - began[1])
        if spent[0] >= least_s:
            return (spent[0] / runs, spent[1] / runs), result


def _loss(value: float) -> str:
    return "exact" if value <= EXACT_DB else number(value)


def _text(name: str, rows: Sequence[Row]) -> str:
    metrics = list(dict.fromkeys(metric for row in rows for metric in row["loss"]))
    table = [("alternative", "CPU (ms)", "wall (ms)", *metrics, "verdict"), *(_cells(row, metrics) for row in rows)]
    return "\n".join([name.upper(), *aligned(table, right=range(1, 3 + len(metrics)))])


def _cells(row: Row, metrics: Sequence[str]) -> tuple[str, ...]:
    verdict = "recommended" if row["recommended"] else "within tolerance" if row["within_tolerance"] else "too much"
    times = [MISSING if row[key] is None else f"{1e3 * row[key]:.2f}" for key in ("cpu_s", "wall_s")]
    losses = [_loss(row["loss"][metric]) if metric in row["loss"] else MISSING for metric in metrics]
    return row["name"], *times, *losses, f"failed: {row['failed']}" if row["failed"] else verdict


def _draw(name: str, rows: Sequence[Row], tolerance: Mapping[str, float], path: Path) -> None:
    """Draw the loss over time, with the Pareto front and the tolerance."""
    metric = next((metric for row in rows for metric in row["loss"] if metric in tolerance), None)
    kept = [row for row in rows if not row["failed"] and metric in row["loss"]]
    if metric is not None and kept:
        loss = [max(row["loss"][metric], _DRAWN_DB) for row in kept]
        figure = plot.trade(
            [r["name"] for r in kept], [r["cpu_s"] for r in kept], loss, metric, name, tolerance[metric]
        )
        plot.save(figure, path)
