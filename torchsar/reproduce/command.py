"""The command `torchsar reproduce`.

Records of reproduced items: the comparisons, their time, the versions and the computer.

All papers whose figures and tables are reproduced.
"""

from __future__ import annotations

import importlib
import json
import logging
import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchsar
from torchsar.reproduce.item import NOT_REPRODUCED, Check, Fact, Item, Made, Paper, settled

# significant digits of a recorded number
DIGITS = 6


def made_with(small: bool, seconds: float) -> dict[str, Any]:
    """Describe a computation.

    Args:
        small: Whether it was the reduced form.
        seconds: Its wall time.

    Returns:
        Form, date, commit of the source tree (None outside of one), machine and versions.
    """
    versions = {"torchsar-lab": torchsar.__version__, "torch": torch.__version__, "numpy": np.__version__}
    return {
        "form": "reduced" if small else "full",
        "date": datetime.now(UTC).date().isoformat(),
        "seconds": round(seconds, 1),
        "commit": commit(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "versions": {**versions, "python": platform.python_version()},
    }


@cache
def commit() -> str | None:
    """Return the commit of the source tree that the package is in.

    Returns:
        Its abbreviated hash, with "-dirty" after it if files differ; None without a source tree.
    """
    tree = Path(torchsar.__file__).resolve().parents[1]
    if not (tree / ".git").exists():
        return None
    command = ["git", "-C", str(tree), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def entry(item: Item, found: Made, made: Mapping[str, Any] | None) -> dict[str, Any]:
    """Describe a reproduced item.

    Args:
        item: The item.
        found: What was compared of it, and the facts of its reason.
        made: How it was made; None where nothing was computed.

    Returns:
        A tree that JSON can hold.
    """
    checks, facts = [one for one in found if isinstance(one, Check)], [one for one in found if isinstance(one, Fact)]
    result = settled(item, checks)
    said = item.reason(facts) if result in (NOT_REPRODUCED, "unpublished") else ""
    trees = {
        name: [{key: _rounded(value) for key, value in asdict(one).items()} for one in rows]
        for name, rows in (("facts", facts if said else []), ("checks", checks))
    }
    about = {"item": item.label, "kind": item.kind, "subject": item.subject, "verdict": result, "why": said}
    return {**about, "made": made, **trees}


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def read(path: Path) -> dict[str, Any]:
    """Read the entries of a record.

    Args:
        path: File; one that does not exist has no entries.

    Returns:
        Entries by label.

    Raises:
        ValueError: If the file is not such a record.
    """
    if not path.exists():
        return {}
    try:
        return {one["item"]: one for one in json.loads(path.read_text(encoding="utf-8"))["items"]}
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError):
        raise ValueError(
            f"{path} is not a record of reproduced figures; move it away, or choose another folder"
        ) from None


def write(path: Path, paper: Paper, entries: Mapping[str, Any]) -> None:
    """Write a record, whole or not at all, one item per line.

    Args:
        path: File.
        paper: The paper.
        entries: Entries by label; the others of the paper are left out.
    """
    rows = ",\n".join(json.dumps(entries[one.label]) for one in paper.items if one.label in entries)
    text = f'{{\n"paper": {json.dumps(paper.name)},\n"source": {json.dumps(paper.source)},\n"items": [\n{rows}\n]\n}}\n'
    beside = path.with_suffix(".part")
    beside.write_text(text, encoding="utf-8")
    beside.replace(path)


# names of the papers, each that of the system that reproduces it
PAPERS = ("sal", "geo", "isal", "isal_rotation", "stripmap")


def paper(name: str) -> Paper:
    """Return a paper with its figures and tables.

    Args:
        name: One of `PAPERS`.

    Returns:
        The paper.
    """
    return importlib.import_module(f"torchsar.reproduce.{name}").PAPER


log = logging.getLogger("torchsar.reproduce")


def reproduce(papers: str | None, label: str | None, out: Path, small: bool = False) -> str:
    """Make figures and tables of papers and compare them with the published ones.

    Args:
        papers: Name of a paper; None for all.
        label: Number of a figure or table of this paper; None for all.
        out: Folder of the records (one JSON file per paper) and of the pictures (a folder per
            paper). Entries that a record there already has of other items are kept.
        small: Whether to make the reduced form, which takes seconds and compares less.

    Returns:
        A table: item, published, ours with its uncertainty, verdict.

    Raises:
        ValueError: If there is no such paper or item, or a record in the folder cannot be read.
    """
    if papers is not None and papers not in PAPERS:
        raise ValueError(f"there is no paper {papers!r}; choose one of {', '.join(PAPERS)}")
    chosen = [paper(name) for name in (PAPERS if papers is None else [papers])]
    items = [one.items if label is None else (one.find(label),) for one in chosen]
    known = [read(out / f"{one.name}.json") for one in chosen]
    tables = [
        _made(one, wanted, entries, out, small) for one, wanted, entries in zip(chosen, items, known, strict=True)
    ]
    return "\n\n".join(tables)


def _made(one: Paper, wanted: Sequence[Item], entries: dict[str, Any], out: Path, small: bool) -> str:
    """Make the wanted figures and tables of a paper, and record each of them in its JSON file.

    Returns the comparison with the published values, as a table in text form.
    """
    folder, results = out / one.name, dict[Callable[[bool], Any], Any]()
    folder.mkdir(parents=True, exist_ok=True)
    for item in wanted:
        entries[item.label] = _entry(item, folder / item.file, results, small)
        write(out / f"{one.name}.json", one, entries)
    return table(one, [entries[item.label] for item in wanted])


def _entry(item: Item, path: Path, results: dict[Callable[[bool], Any], Any], small: bool) -> dict[str, Any]:
    """Make one item. If another item already has the result of its experiment, the result is
    reused.
    """
    if item.make is None or item.of is None:
        return entry(item, [], None)
    log.info("%s: %s", item.label, item.subject)
    began = time.perf_counter()
    with torch.no_grad():
        if item.of not in results:
            results[item.of] = item.of(small)
        checks = list(item.make(results[item.of], path))
    return entry(item, checks, made_with(small, time.perf_counter() - began))


def table(one: Paper, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a paper as text.

    Args:
        one: The paper.
        entries: Entries of a record.

    Returns:
        A line per comparison, with the label and the verdict of the item in the first one.
    """
    lines = [f"{one.name}: {one.source}", f"{'':12}{'published':>14}{'ours':>24}  verdict"]
    for found in entries:
        lines.append(f"{found['item']:12}{found['verdict']:>38}  {found['subject']}")
        for check in found["checks"]:
            if isinstance(check["published"], str):
                lines.append(f"  {check['verdict']}: {check['name']}: {check['published']}; ours: {check['ours']}")
            else:
                ours = shown(check["ours"]) + (f" +- {shown(check['std'])}" if check["std"] else "")
                lines.append(f"{'':12}{shown(check['published']):>14}{ours:>24}  {check['verdict']}: {check['name']}")
        if found["why"]:
            lines.append(f"  why: {found['why']}")
    return "\n".join(lines)


def shown(value: float | None) -> str:
    """Return a number to four digits.

    Args:
        value: Number; None where it was not finite.

    Returns:
        Its digits, or a dash.
    """
    return "-" if value is None else f"{value:.4g}"
