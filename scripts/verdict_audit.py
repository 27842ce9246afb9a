"""How often an estimator says that it is reliable and is wrong: one table over all estimators.

    python scripts/verdict_audit.py --out verdicts.json [--small] [--trials 200] [--only NAME]

Every public estimator with a verdict `ok` is run on a fixed set of data: pure noise, zeros, its own
simulated world at several SNRs, homogeneous clutter, too few or too many scatterers, partly lit
targets, aliased motion, data of another system, and data of an independent generator. A row holds

- `ok`: share of the trials in which the estimator says that it is reliable;
- `false_ok`: share of the trials in which it says so and is wrong, that is by more than 5 predicted
  standard deviations or by more than the tolerance of use; in noise and zeros nothing can be found,
  and every `ok` is wrong;
- `needless`: share in which it says that it is not reliable, but its error is within the tolerance;
- `rms_over_std`: rms error over rms predicted standard deviation of the trials that are ok, of the
  value for which it is farthest from 1; null where no standard deviation is predicted;
- `refused`: the sentence with which the estimator rejects such data, if it does.

Rows that miss a bar are printed: the lower end of the 95 % interval of the share that is ok and
wrong, in noise and zeros of the share that is ok, above 2 %; a predicted standard deviation beyond
0.5 to 2 times the rms error; and, for information, `needless` above 5 % from 10 dB above the SNR at
which the estimate is of use, because doubtful values are used. With `--only`, rows of other
estimators that the file already holds are kept. The file is written after each row.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
SMALL = 4


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the audit and write its rows."""
    sys.path.insert(0, str(ROOT))  # the worlds stand beside the tests
    from tests.audit.frame import NOTHING, SURE, Entry, World, audit, doubted, verdict
    from tests.audit.table import entries

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="file for the rows, .json")
    parser.add_argument("--small", action="store_true", help=f"{SMALL} trials, in few worlds")
    parser.add_argument("--trials", type=int, default=200, help="trials of a row; of noise and zeros 1.5 times as many")
    parser.add_argument("--only", default="", help="estimators whose name contains this")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    chosen = [entry for entry in entries() if options.only in entry.name]
    if options.small:
        chosen = [replace(entry, worlds=[*entry.worlds[:2], *entry.worlds[-1:]]) for entry in chosen]

    def trials(entry: Entry, world: World) -> int:
        many = options.trials * (1.5 if world.name in NOTHING else 1.0) * entry.share
        return SMALL if options.small else max(20, round(many))

    tried = {entry.name for entry in chosen}
    kept = [row for row in read(options.out) if row["estimator"] not in tried] if options.only else []
    rows: list[dict[str, Any]] = []
    for row in audit(chosen, trials):
        rows.append(row)
        for missed in verdict(row):
            report(row, missed)
        write(options.out, sorted([*kept, *rows], key=lambda row: row["estimator"]), SURE)
    needless = list(doubted(rows))
    for row in needless:
        report(row, f"needless doubt {row['needless']:.2f}")
    missed = sum(bool(verdict(row)) for row in rows)
    print(f"{len(rows)} rows, {missed} of them miss a bar: {options.out}")


def report(row: dict[str, Any], missed: str) -> None:
    """Print a row that misses a bar."""
    print(f"{row['estimator']:40s} {row['world']:20s} {row['snr_db']!s:>6s}  {missed}", flush=True)


def read(path: Path) -> list[dict[str, Any]]:
    """Read the rows of an earlier run; none where there is no file."""
    return json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []


def write(path: Path, rows: list[dict[str, Any]], sure: float) -> None:
    """Write the rows, one per line."""
    text = ",\n".join(
        json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}) for row in rows
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'{{"sure_std": {sure}, "rows": [\n{text}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
