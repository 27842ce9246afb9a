"""Time and loss of the alternatives of one config per system, kept as small files that tests check
and the documentation shows.

python scripts/keep_trade.py [docs/trade] [--systems sal geo]
"""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
import time
from pathlib import Path
from typing import Any

from torchsar import keep_freed_memory
from torchsar.study.commands.trade import trade
from torchsar.study.table import load

# the config of each system that shows its alternatives
CONFIGS = {
    "stripmap": "stripmap_damaged",
    "isal": "isal_table1",
    "isal_rotation": "isal_corner_cubes",
    "sal": "sal_points",
    "geo": "geo_point_targets",
    "geo_ocean": "geo_ocean",
    "path": "airborne_spotlight",
}
# what is kept of each alternative
KEPT = ("name", "cpu_s", "wall_s", "peak_bytes", "loss", "within_tolerance", "recommended", "failed")
# losses below this (dB) are rounding
FLOOR = -300.0


def measured(system: str) -> dict[str, Any]:
    """The table of `torchsar trade`, rounded to the digits that mean something."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        trade(load(CONFIGS[system], []), Path(folder) / "trade")
        spent = time.process_time() - began
        found = json.loads((Path(folder) / "trade" / "trade.json").read_text(encoding="utf-8"))
    about = {"system": system, "config": CONFIGS[system], "seed": found["seed"], "cpu_s_in_all": rounded(spent, 3)}
    about |= {"tolerance": found["tolerance"], "machine": found["machine"]}
    tables = {"choice": found["choice"], "alternatives": kept(found["alternatives"])}
    return {**about, **tables, "others": {name: kept(rows) for name, rows in found["others"].items()}}


def kept(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Times to three digits, losses to four."""
    found = []
    for row in rows:
        short = {key: row[key] for key in KEPT}
        short |= {key: rounded(row[key], 3) for key in ("cpu_s", "wall_s")}
        found.append({**short, "loss": {name: rounded(x, 4) for name, x in row["loss"].items()}})
    return found


def rounded(x: float | None, digits: int) -> float | None:
    """A number to so many digits; None stays."""
    return None if x is None else max(float(f"{x:.{digits}g}"), FLOOR)


def written(tree: dict[str, Any]) -> str:
    """JSON with one alternative per line."""

    def lines(rows: list[dict[str, Any]]) -> str:
        return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]"

    parts = [f'"{key}": {json.dumps(value)}' for key, value in tree.items() if key not in ("alternatives", "others")]
    others = ",\n".join(f"{json.dumps(name)}: {lines(rows)}" for name, rows in tree["others"].items())
    parts += [f'"alternatives": {lines(tree["alternatives"])}', f'"others": {{\n{others}\n}}']
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs/trade"))
    parser.add_argument("--systems", nargs="+", choices=list(CONFIGS), default=list(CONFIGS))
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    keep_freed_memory()  # as the commands do
    options.folder.mkdir(parents=True, exist_ok=True)
    for system in options.systems:
        (options.folder / f"{system}.json").write_text(written(measured(system)), encoding="utf-8")


if __name__ == "__main__":
    main()
