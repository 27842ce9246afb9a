"""What became slower between two results of `scripts/benchmark.py`.

    python scripts/compare_benchmarks.py OLD.json NEW.json [--limit 1.1]

Times are compared over their floors, which were measured in turn with them, so that the results may
come from machines that differ in speed; peak memory and draws, which have no floor, by themselves.
Parts that take less than a thousandth of the batch are left out. The exit status is 1 if a part
became slower, or needs more memory, by more than the limit.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

# share of the time of a batch below which a part does not count
LEAST_SHARE = 1e-3
KEY = ("config", "threads", "device", "part", "name", "trials")

Row = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the parts that became slower and faster; 1 if one became slower."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--limit", type=float, default=1.1, help="largest ratio that is accepted")
    options = parser.parse_args(arguments)
    if not options.limit > 1:
        parser.error(f"--limit must be above 1, got {options.limit}")
    old, new = read(options.old), read(options.new)
    shared = {key: old[key] for key in new if key in old}
    if not shared:
        parser.error("the two results have no part in common")
    changes = sorted(compared(shared, new), key=lambda change: -change[0])
    slower = [change for change in changes if change[0] > options.limit]
    for title, some in (("slower", slower), ("faster", [c for c in changes if c[0] < 1 / options.limit][::-1])):
        print(f"{len(some)} of {len(changes)} parts became {title} by more than a factor {options.limit:g}")
        for ratio, key in some:
            print(f"  {ratio:7.3f}  {' '.join(str(x) for x in key if x != '')}")
    for name, gone in (("only in the old result", old.keys() - new), ("only in the new result", new.keys() - old)):
        if gone:
            print(f"{len(gone)} parts are {name}")
    return int(bool(slower))


def read(path: Path) -> dict[tuple[Any, ...], Row]:
    """Rows of a result by what they measure."""
    return {tuple(row[key] for key in KEY): row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}


def compared(
    old: dict[tuple[Any, ...], Row], new: dict[tuple[Any, ...], Row]
) -> Iterator[tuple[float, tuple[Any, ...]]]:
    """Ratio of new to old of every part that counts."""
    whole = {key[:3]: row["seconds"] for key, row in old.items() if row["part"] == "batch" and not row["name"]}
    for key, before in old.items():
        measure = next(name for name in ("over_floor", "seconds", "peak_bytes") if before.get(name) is not None)
        if before.get("seconds", 1.0) >= LEAST_SHARE * whole.get(key[:3], 0.0) and before[measure] > 0:
            yield new[key][measure] / before[measure], key


if __name__ == "__main__":
    raise SystemExit(main())
