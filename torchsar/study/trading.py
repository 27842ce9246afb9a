"""What the tables of `torchsar trade` have in common: timing, and the folder that they are written
into.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch

from torchsar import plot
from torchsar.study.build import resolved
from torchsar.study.cases import cases_of, refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.output.arrays import write_json
from torchsar.study.output.folder import fresh_result
from torchsar.study.settings.errors import ConfigError

Result = TypeVar("Result")
Tables = Mapping[str, Sequence[Any]]


def timed(work: Callable[[], Result], repeats: int) -> tuple[Result, list[float]]:
    """The last result of `work`, and the seconds of every repeat."""
    times = []
    for _ in range(repeats - 1):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    began = time.perf_counter()
    result = work()
    return result, [*times, time.perf_counter() - began]


def written(
    loaded: Loaded,
    out: Path | None,
    tables: Callable[[], Mapping[str, Sequence[Any]]],
    text: Callable[[Mapping[str, Sequence[Any]]], str],
    figures: Callable[[Mapping[str, Sequence[Any]]], Mapping[str, plot.Figure]],
) -> str:
    """The text of the tables; with `out` also config.yaml, trade.json, trade.txt and
    figures/trade_NAME.png in that folder. Rows are dataclasses.
    """
    if out is None:
        return text(tables())
    with fresh_result(out, "trade", ("config.yaml", "trade.json", "trade.txt", "figures")) as folder:
        found = tables()
        said = text(found)
        (folder / "config.yaml").write_text(loaded.text(resolved(loaded)), encoding="utf-8")
        (folder / "trade.txt").write_text(said + "\n", encoding="utf-8")
        machine = {
            "machine": platform.processor() or platform.machine(),
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
            "seed": loaded.config.seed,
        }
        write_json(
            folder / "trade.json",
            {**{key: [asdict(row) for row in rows] for key, rows in found.items()}, "made_on": machine},
        )
        (folder / "figures").mkdir()
        for name, figure in figures(found).items():
            plot.save(figure, folder / "figures" / f"trade_{name}.png")
    return f"{said}\n{out}"


def traded(
    loaded: Loaded,
    out: Path | None,
    check: Callable[[Loaded], None],
    tables: Callable[[Loaded], Tables],
    titles: Mapping[str, str],
    columns: Mapping[str, tuple[str, str]],
    figures: Callable[[Tables], Mapping[str, plot.Figure]],
) -> str:
    """The tables of the first case of a config that simulates, as `table_text` and `written` have
    them. Raises ConfigError for what the config, or then the simulation or a stage, refuses.
    """
    refuse_recordings(loaded)
    check(loaded)
    name, case = next(iter(cases_of(loaded).items()))

    def made() -> Tables:
        try:
            return tables(case)
        except (ValueError, TypeError, RuntimeError) as error:
            raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from error

    return written(loaded, out, made, lambda found: table_text(name, found, titles, columns), figures)


def table_text(case: str, tables: Tables, titles: Mapping[str, str], columns: Mapping[str, tuple[str, str]]) -> str:
    """Tables for the screen: a line an alternative, columns (field -> heading and format) that any
    row of a table has. -inf reads "exact".
    """
    parts = [f"case {case!r}" if case else "one case"]
    for key, rows in tables.items():
        kept = [name for name in columns if any(getattr(row, name) is not None for row in rows)]
        parts += [
            "",
            titles[key],
            f"{'alternative':<36}{'ms a trial':>12}{'spread':>9}" + "".join(f"{columns[name][0]:>18}" for name in kept),
        ]
        parts += [
            f"{row.name:<36}{1e3 * row.seconds:>12.2f}{1e3 * row.spread_s:>9.2f}"
            + "".join(f"{_cell(getattr(row, name), columns[name][1]):>18}" for name in kept)
            for row in rows
        ]
    return "\n".join(parts)


def _cell(value: float | None, form: str) -> str:
    return "–" if value is None else "exact" if value == -math.inf else format(value, form)
