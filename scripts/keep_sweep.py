"""Write the record of a finished sweep, a small file that tests check: RMSE, intervals, bounds and
shares of its errors (and of the metrics named), and the first trials of one point.

    python scripts/keep_sweep.py out/stripmap_doppler docs/sweeps/stripmap_doppler.json
    python scripts/keep_sweep.py out/isal_snr docs/sweeps/isal_snr.json \\
        residual_phase_rms_rad entropy_above_ideal_nats
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from torchsar.study import Record, read_sweep

KEPT = ("algorithm", "parameters", "metric", "n", "median", "rmse", "interval", "ok_share", "success_share")


def rounded(x: Any) -> Any:
    """Five digits are more than any interval here is worth."""
    if isinstance(x, list):
        return [rounded(v) for v in x]
    return float(f"{x:.5g}") if isinstance(x, float) else x


def sample(record: Record, wanted: set[str], point: int, trials: int) -> dict[str, Any]:
    """The first trials of one point of the grid, by method and metric."""
    at = np.unravel_index(range(record.done[..., 0].size)[point], record.done.shape[:-1])
    values: dict[str, dict[str, list[float]]] = {}
    for number, name in enumerate(record.algorithms):
        for metric in sorted(wanted):
            found = record.metrics[metric][(number, *at, slice(0, trials))]
            if np.isfinite(found).all():
                values.setdefault(name, {})[metric] = [float(f"{x:.7g}") for x in found]
    parameters = {name: labels[i] for (name, labels), i in zip(record.labels.items(), at, strict=True)}
    return {"parameters": parameters, "trials": list(range(trials)), "values": values}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("metrics", nargs="*")
    parser.add_argument("--point", type=int, default=-1, help="the point whose first trials are kept, by number")
    parser.add_argument("--trials", type=int, default=2, help="how many of its trials")
    options = parser.parse_args()
    summary = json.loads((options.folder / "summary.json").read_text(encoding="utf-8"))
    session = summary["about"]["sessions"][-1]
    wanted = {
        point["metric"]
        for point in summary["points"]
        if "error" in point["metric"] or point["metric"] in options.metrics
    }
    kept = {
        "title": summary["title"],
        "made_with": {
            "seed": summary["about"]["seed"],
            "hash": summary["about"]["hash"],
            "versions": session["versions"],
            "trials": summary["trials"],
        },
        "sample": sample(read_sweep(options.folder), wanted, options.point, options.trials),
        "points": [
            {key: rounded(point[key]) for key in KEPT if key in point}
            for point in summary["points"]
            if point["metric"] in wanted and point["n"]
        ],
        "bounds": [
            rounded_bound
            for rounded_bound in ({**bound, "rms": rounded(bound["rms"])} for bound in summary["bounds"])
            if rounded_bound["rms"] is not None
        ],
    }
    lines = [f'"{key}": {json.dumps(value)}' for key, value in kept.items() if not isinstance(value, list)]
    lines += [
        f'"{key}": [\n' + ",\n".join(json.dumps(row) for row in value) + "\n]"
        for key, value in kept.items()
        if isinstance(value, list)
    ]
    options.file.parent.mkdir(parents=True, exist_ok=True)
    options.file.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
