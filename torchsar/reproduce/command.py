"""The command `torchsar reproduce`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchsar.reproduce import record
from torchsar.reproduce.catalogue import PAPERS, paper
from torchsar.reproduce.item import Item, Paper

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
    known = [record.read(out / f"{one.name}.json") for one in chosen]
    tables = [
        _made(one, wanted, entries, out, small) for one, wanted, entries in zip(chosen, items, known, strict=True)
    ]
    return "\n\n".join(tables)


def _made(one: Paper, wanted: Sequence[Item], entries: dict[str, Any], out: Path, small: bool) -> str:
    """Make some items of a paper, and return their table as text."""
    folder, results = out / one.name, dict[Callable[[bool], Any], Any]()
    folder.mkdir(parents=True, exist_ok=True)
    for item in wanted:
        entries[item.label] = _entry(item, folder / item.file, results, small)
        record.write(out / f"{one.name}.json", one, entries)
    return table(one, [entries[item.label] for item in wanted])


def _entry(item: Item, path: Path, results: dict[Callable[[bool], Any], Any], small: bool) -> dict[str, Any]:
    """Make one item. If another item already has the result of its experiment, the result is
    reused.
    """
    if item.make is None or item.of is None:
        return record.entry(item, [], None)
    log.info("%s: %s", item.label, item.subject)
    began = time.perf_counter()
    with torch.no_grad():
        if item.of not in results:
            results[item.of] = item.of(small)
        checks = list(item.make(results[item.of], path))
    return record.entry(item, checks, record.made_with(small, time.perf_counter() - began))


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
