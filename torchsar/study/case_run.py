"""What the runs over cases and the tables of requirements have in common: the folder that they are
written into, and errors that name the case.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

from torch import Tensor

from torchsar.core import Signal
from torchsar.study.build import resolved
from torchsar.study.cases import cases_of, key_of
from torchsar.study.config import Loaded
from torchsar.study.output.arrays import write_arrays, write_json
from torchsar.study.output.folder import fresh_result
from torchsar.study.pictures import Picture
from torchsar.study.settings.errors import ConfigError

log = logging.getLogger("torchsar")
RUN_FILES = ("config.yaml", "metrics.json", "arrays.zarr", "figures", "report.html")
Result = TypeVar("Result", bound="CaseArrays")


class CaseArrays(Protocol):
    """What of a case goes into arrays.zarr: images by method, named truths, and estimates by method
    and name.
    """

    @property
    def images(self) -> Mapping[str, Signal]: ...

    def truths(self) -> Mapping[str, Tensor]: ...

    def estimates(self) -> Mapping[str, Mapping[str, Tensor]]: ...


def run_cases(
    loaded: Loaded,
    out: Path,
    command: str,
    prepare: Callable[[], None],
    one: Callable[[Loaded, str], Result],
    metrics_tree: Callable[[Loaded, Mapping[str, Result]], dict[str, Any]],
    draw: Callable[[Mapping[str, Result], Path], list[Picture]],
    write_report: Callable[..., None],
) -> Path:
    """Run every case and write config.yaml, metrics.json, arrays.zarr, figures/ and report.html
    into OUT, which appears whole or not at all.

    prepare: checks that come before any computing; one(case, its name or ""): the result of a case.
    What a case refuses is a ConfigError that names it. Returns the path of the report.
    """
    began = time.perf_counter()
    with fresh_result(out, "run", RUN_FILES) as folder:
        prepare()
        results = {name or "all": _one(loaded, case, name, one) for name, case in cases_of(loaded).items()}
        metrics = metrics_tree(loaded, results)
        config_text = loaded.text(resolved(loaded))
        (folder / "config.yaml").write_text(config_text, encoding="utf-8")
        write_json(folder / "metrics.json", metrics)
        write_arrays(
            folder / "arrays.zarr",
            _keyed(results, lambda r: r.images),
            _keyed(results, lambda r: r.truths()),
            _estimates(results),
        )
        pictures = draw(results, folder / "figures")
        write_report(
            folder / "report.html", loaded.config.title, metrics, pictures, folder / "figures", config_text, command
        )
    log.info("finished in %.0f s", time.perf_counter() - began)
    return out / "report.html"


def _one(loaded: Loaded, case: Loaded, name: str, one: Callable[[Loaded, str], Result]) -> Result:
    started = time.perf_counter()
    try:
        result = one(case, name)
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        text, place = " ".join(str(error).split()), f"{loaded.file}: {f'cases.{name}: ' if name else ''}"
        raise ConfigError(text if text.startswith(loaded.file) else f"{place}{text}") from error
    log.info("%s: %.1f s", name or loaded.name, time.perf_counter() - started)
    return result


def _keyed(results: Mapping[str, Result], part: Callable[[Result], Mapping[str, Any]]) -> dict[str, Any]:
    return {key_of(case, name): value for case, result in results.items() for name, value in part(result).items()}


def _estimates(results: Mapping[str, CaseArrays]) -> dict[str, dict[str, Tensor]]:
    """By method, then by case and name."""
    found: dict[str, dict[str, Tensor]] = {}
    for case, result in results.items():
        for method, values in result.estimates().items():
            found.setdefault(method, {}).update({key_of(case, name): value for name, value in values.items()})
    return found


def write_requirements(loaded: Loaded, out: Path | None, find: Callable[[], tuple[str, Mapping[str, Any]]]) -> str:
    """The text of the tables that `find` gives; with `out` also config.yaml, requires.txt and
    requires.json (its tree) in that folder.
    """
    if out is None:
        return find()[0]
    with fresh_result(out, "requires", ("config.yaml", "requires.json", "requires.txt")) as folder:
        text, tree = find()
        (folder / "config.yaml").write_text(loaded.text(resolved(loaded)), encoding="utf-8")
        (folder / "requires.txt").write_text(text + "\n", encoding="utf-8")
        write_json(folder / "requires.json", tree)
    return f"{text}\n{out}"
