"""Records of reproduced items: the comparisons, their time, the versions and the computer."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping
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
