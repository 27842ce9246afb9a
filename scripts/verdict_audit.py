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

Rows that miss a bar are printed: `ok` in noise and zeros at most 1 %, `false_ok` at most 1 %, and a
predicted standard deviation of 0.7 to 1.5 times the rms error.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
SMALL = 4


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the audit and write its rows."""
    sys.path.insert(0, str(ROOT))  # the worlds stand beside the tests
    from tests.audit.frame import NOTHING, SURE, Entry, World, audit, verdict
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

    rows = []
    for row in audit(chosen, trials):
        rows.append(row)
        if missed := verdict(row):
            where = f"{row['estimator']:40s} {row['world']:20s} {row['snr_db']!s:>6s}"
            print(f"{where}  {'; '.join(missed)}", flush=True)
            write(options.out, rows, SURE)
    write(options.out, sorted(rows, key=lambda row: row["estimator"]), SURE)
    print(f"{len(rows)} rows, {sum(bool(verdict(row)) for row in rows)} of them miss a bar: {options.out}")


def write(path: Path, rows: list[dict], sure: float) -> None:
    """Write the rows, one per line."""
    text = ",\n".join(
        json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}) for row in rows
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'{{"sure_std": {sure}, "rows": [\n{text}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
