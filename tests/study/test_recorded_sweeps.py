"""Recorded sweeps in docs/sweeps: the same addresses give the same numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from torchsar.core import Draws
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.montecarlo.grid import address
from torchsar.study.table import load

ROOT = Path(__file__).resolve().parents[2]
# share of the largest value by which another processor may differ: data are in single precision,
# and autofocus of the path decides by them when to end (4 % between two processors)
LEEWAY = {"path_autofocus": 0.1}
RECORDS = sorted((ROOT / "docs" / "sweeps").glob("*.json"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:at a pulse rate")
@pytest.mark.parametrize("file", RECORDS, ids=[file.stem for file in RECORDS])
def test_trials_of_a_record_come_out_again(file: Path) -> None:
    """The last recorded trial of one point."""
    sample = json.loads(file.read_text(encoding="utf-8"))["sample"]
    loaded = load(str(ROOT / "configs" / "sweeps" / f"{file.stem}.yaml"))
    trial, trials = SweepTrial(loaded), sample["trials"][-1:]
    grid = loaded.config.sweep.grid
    values = {
        key: grid[key][label] if isinstance(grid[key], dict) else next(v for v in grid[key] if v == label)
        for key, label in sample["parameters"].items()
    }
    given = {
        key: torch.full((len(trials),), value, dtype=torch.float64) if trial.may_differ(key) else value
        for key, value in values.items()
    }
    found = trial(given, Draws(loaded.config.seed, (address(values),) * len(trials), trials))
    for method, metrics in sample["values"].items():
        for metric, recorded in metrics.items():
            expected = torch.tensor(recorded, dtype=torch.float64)
            error = (found[method][metric].double() - expected[-1:]).abs().max()
            largest = LEEWAY.get(file.stem, 0.01) * expected.abs().max()
            assert error <= largest, (method, metric, found[method][metric], recorded)
