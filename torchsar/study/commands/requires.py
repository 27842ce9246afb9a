"""The command `torchsar requires`: makes predictions for a scene without processing it. It predicts
which limits of methods the scene exceeds, which errors simplified models have, and which
alternatives suffice.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torchsar.focus.requirements import Limit
from torchsar.study.output.folder import fresh_result
from torchsar.study.output.numbers import write_json
from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import ALL, Loaded, cases_of
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Choice, cheapest, choices_of, tolerance_of, within

log = logging.getLogger("torchsar")
FILES = ("config.yaml", "requires.json", "requires.txt")


def requires(loaded: Loaded, out: Path, device: str = "cpu") -> tuple[str, str]:
    """Write the limits of methods, neglected phases and recommended choices of each case to files.

    Args:
        loaded: The config.
        out: The folder of config.yaml, requires.json and requires.txt.
        device: Device on which the Doppler centroid and the velocity of a recording are estimated.

    Returns:
        The text of requires.txt, and a sentence that says why `run` refuses the config; empty if it
        does not.

    Raises:
        ConfigError: If the config is invalid, or the system cannot predict losses of a recording.
    """
    with fresh_result(out, "requires", FILES) as folder:
        benches = {name: Bench(case, device) for name, case in cases_of(loaded).items()}
        trees = {name: needs(bench) for name, bench in benches.items()}
        text = "\n\n".join(_text(loaded.name if name == ALL else name, tree) for name, tree in trees.items())
        (folder / "config.yaml").write_text(loaded.text(), encoding="utf-8")
        (folder / "requires.txt").write_text(text + "\n", encoding="utf-8")
        write_json(folder / "requires.json", trees)
    refused = next((f"{_where(name)}{tree['refused']}" for name, tree in trees.items() if tree["refused"]), "")
    return text, refused and f"`torchsar run` refuses this config: {refused}"


def needs(bench: Bench) -> dict[str, Any]:
    """Return the requirements of one case, as in requires.json."""
    tolerance = tolerance_of(bench.loaded)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            limits = bench.system.limits(bench)
            rows, choices = bench.system.requirements(bench), choices_of(bench)
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{bench.file}: {one_line(error)}") from None
    losses = {
        one.effect: (loss, tolerance[metric])
        for choice in choices
        for one in choice.alternatives
        for metric, loss in (one.loss or {}).items()
    }
    rows = [
        replace(row, error_db=losses[row.effect][0], tolerance_db=losses[row.effect][1])
        if row.effect in losses
        else row
        for row in rows
    ]
    return {
        "limits": [{**asdict(one), "verdict": one.verdict, "methods": list(names)} for one, names in limits.items()],
        "requirements": [{**asdict(row), "ok": row.ok, "verdict": row.verdict} for row in rows],
        "choices": [_choice(choice, tolerance) for choice in choices],
        "refused": _refusal(bench, limits),
        "warnings": [one_line(w.message) for w in caught if isinstance(w.message, Warning)],
    }


def _choice(choice: Choice, tolerance: Mapping[str, float]) -> dict[str, Any]:
    alternatives = [
        {"name": one.name, "neglects": one.neglects, "loss": one.loss, "within_tolerance": within(one.loss, tolerance)}
        for one in choice.alternatives
        if one.loss is not None
    ]
    taken = cheapest(choice, tolerance).name if alternatives else None
    return {"name": choice.name, "at": choice.at, "alternatives": alternatives, "recommended": taken}


def refuse_beyond_limits(bench: Bench, case: str) -> None:
    """Check the limits of the methods of a case, and log a warning for each limit that is exceeded.

    Args:
        bench: Bench of the case: its radar, world and chains.
        case: Name of the case.

    Raises:
        ConfigError: If a limit excludes a method that the config does not name in beyond_limits;
            the message has the limit, its value and a remedy.
    """
    where = _where(case)
    try:
        limits = bench.system.limits(bench)
    except ValueError as error:
        raise ConfigError(f"{bench.file}: {where}{one_line(error)}") from None
    if refused := _refusal(bench, limits):
        raise ConfigError(f"{bench.file}: {where}{refused}")
    for limit in limits:
        if limit.verdict != "ok":
            log.warning("warning: %s%s", where, limit.sentence)


def _where(case: str) -> str:
    return "" if case == ALL else f"cases.{case}: "


def _refusal(bench: Bench, limits: Mapping[Limit, Sequence[str]]) -> str:
    """The first limit that excludes a method which the config does not name in beyond_limits, in a
    sentence; empty if there is none.
    """
    shown = (*bench.config.beyond_limits, *(n for n, m in bench.config.processor.items() if m.input == "clean"))
    stopped = ((limit, n) for limit, names in limits.items() if limit.verdict == "refuse" for n in names)
    found = (
        f"processor.{n}: {limit.sentence} (or name the method in beyond_limits)"
        for limit, n in stopped
        if n not in shown
    )
    return next(found, "")


def _text(name: str, tree: Mapping[str, Any]) -> str:
    parts = [name]
    if tree["limits"]:
        head = ("limit", "value", "limit", "unit", "verdict", "consequence; remedy (methods)")
        parts += [*aligned([head, *_limit_rows(tree["limits"])], right=(1, 2)), ""]
    if tree["requirements"]:
        head = ("simplification", "neglected phase", "range cells", "verdict", "neglects")
        cells = ["" if math.isnan(x := row["range_cells"]) else f"{x:.3g}" for row in tree["requirements"]]
        rows = [
            (row["effect"], f"{row['phase_rad']:.3g} rad", cell, row["verdict"], row["neglects"])
            for row, cell in zip(tree["requirements"], cells, strict=True)
        ]
        parts += aligned([head, *rows], right=(1, 2))
    for choice in tree["choices"]:
        if choice["alternatives"]:
            parts += ["", f"{choice['name']} (auto at {choice['at']}): {choice['recommended']}"]
            losses = [
                ", ".join(f"{name} {value:.3g}" for name, value in row["loss"].items()) or "exact"
                for row in choice["alternatives"]
            ]
            parts += aligned(
                [
                    (f"  {row['name']}", loss, "enough" if row["within_tolerance"] else "too much", row["neglects"])
                    for row, loss in zip(choice["alternatives"], losses, strict=True)
                ]
            )
    return "\n".join([*parts, *(f"warning: {text}" for text in tree["warnings"])])


def aligned(rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> list[str]:
    """Return the lines of a table as text; `right` lists the indices of right-aligned columns."""
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [[x.rjust(w) if i in right else x.ljust(w) for i, (x, w) in enumerate(zip(row, wide))] for row in rows]
    return ["  ".join(line).rstrip() for line in lines]


def _limit_rows(limits: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, ...]]:
    names = [row["name"] for row in limits]
    for row in limits:
        concerned = f"({', '.join(row['methods'])})"
        then = concerned if names.count(row["name"]) > 1 else ""
        if row["verdict"] != "ok":
            then = f"{row['consequence']}; {row['remedy']} {concerned}"
        least = f"{'>=' if row['at_least'] else '<'} {row['limit']:.4g}"
        yield row["name"], f"{row['value']:.4g}", least, row["unit"], row["verdict"], then
