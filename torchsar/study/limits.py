"""Limits of methods and simplifications of a scene, as the commands heed and show them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.study.case_run import write_requirements
from torchsar.study.cases import cases_of
from torchsar.study.config import Loaded
from torchsar.study.montecarlo.record import OK
from torchsar.study.settings.errors import ConfigError

log = logging.getLogger("torchsar")


class Needs(Protocol):
    """What a case needs: its content for requires.json, and the table for the screen."""

    def tree(self) -> dict[str, object]: ...

    def text(self, name: str) -> str: ...


def write_needs(loaded: Loaded, out: Path | None, needs_of: Callable[[Loaded], Needs]) -> str:
    """The tables of every case of a config as text.

    With `out`: config.yaml, requires.json and requires.txt there.
    """

    def find() -> tuple[str, dict[str, object]]:
        found = {name or loaded.name: needs_of(case) for name, case in cases_of(loaded).items()}
        return "\n\n".join(needs.text(name) for name, needs in found.items()), {
            name: needs.tree() for name, needs in found.items()
        }

    return write_requirements(loaded, out, find)


def heed(loaded: Loaded, case: str, limits: Sequence[Limit], stopped: Callable[[Limit], Sequence[str]]) -> None:
    """Refuse a case beyond a limit that stops a method, unless the config shows the method beyond
    its limits on purpose; warn of the other limits.

    stopped: the methods that a limit stops. Raises ConfigError with the limit, what it comes to and
    what helps.
    """
    where = f"cases.{case}: " if case else ""
    for limit in limits:
        methods = stopped(limit) if limit.verdict == "refuse" else []
        if methods:
            raise ConfigError(
                f"{loaded.file}: {where}processor.{methods[0]}: {limit.sentence} (or name the method in beyond_limits)"
            )
        if limit.verdict != "ok":
            log.warning("warning: %s%s", where, limit.sentence)


def warn_of_doubt(case: str, metrics: Mapping[str, Mapping[str, Tensor]], count: int) -> None:
    """Warn where the recommended method does not trust its estimates in some of `count` trials."""
    verdicts = metrics["recommended"].get(OK)
    doubted = 0 if verdicts is None else int((~verdicts).sum())
    if doubted:
        log.warning(
            "warning: %srecommended does not trust its estimate in %d of %d trials",
            f"{case}: " if case else "",
            doubted,
            count,
        )


def limit_rows(limits: Sequence[Limit]) -> list[dict[str, Any]]:
    """For requires.json."""
    return [{**asdict(limit), "verdict": limit.verdict} for limit in limits]


def requirement_rows(rows: Sequence[Requirement]) -> list[dict[str, Any]]:
    """For requires.json."""
    return [{**asdict(row), "ok": row.ok, "verdict": row.verdict} for row in rows]


def limit_lines(limits: Sequence[Limit]) -> list[str]:
    """A table for the screen."""
    wide = 2 + max(len(row.name) for row in limits)
    lines = [f"{'limit':<{wide}}{'value':>12}{'limit':>14} {'unit':<8}{'verdict':<9}what then"]
    for row in limits:
        then = "" if row.ok else f"{row.consequence}; {row.remedy}"
        lines.append(
            (
                f"{row.name:<{wide}}{row.value:>12.4g}"
                f"{('>= ' if row.at_least else '< ') + format(row.limit, '.4g'):>14} "
                f"{row.unit:<8}{row.verdict:<9}{then}"
            ).rstrip()
        )
    return lines


def requirement_lines(rows: Sequence[Requirement]) -> list[str]:
    """A table for the screen."""
    wide = 2 + max((len(row.verdict) for row in rows), default=0)
    lines = [f"{'simplification':<34}{'neglected phase':>16}{'range cells':>13}  {'verdict':<{wide}}neglects"]
    for row in rows:
        cells = "" if math.isnan(row.range_cells) else f"{row.range_cells:.3g}"
        lines.append(f"{row.effect:<34}{row.phase_rad:>12.3g} rad{cells:>13}  {row.verdict:<{wide}}{row.neglects}")
    return lines
