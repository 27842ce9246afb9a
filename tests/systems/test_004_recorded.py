"""System 004 on a recording: impairments injected, repaired, and compared with the unimpaired image
(the cheaper rows of the table of `scripts/recorded_impairments.py`).
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from torchsar.core import Draws
from torchsar.echo import apply_impairments
from torchsar.io import read_stripmap

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "recorded_impairments.py"
_spec = importlib.util.spec_from_file_location("recorded_impairments", SCRIPT)
assert _spec is not None and _spec.loader is not None
table = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = table
_spec.loader.exec_module(table)

ROWS = {row.name: row for row in table.rows(30.116e6, 32.317e6)}


@pytest.fixture(scope="module")
def bench(recorded):
    recording = read_stripmap(recorded("radarsat1_squamish.npz"))
    return table.Bench(recording, torch.tensor(-6993.0, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "lost lines 1%",
        "tone 20 dB",
        "tone on 20 % of lines, 30 dB",
        "clean through subtraction",
        "jitter period 8, pilot",
        "jitter period 8, blind",
        "range phase 3 rad cubic",
        "range phase 12 rad quadratic, 8 rad cubic",
        "amplitude 6 dB slope, 3 dB ripple",
        "two channels, 1.2 at 60 deg",
    ],
)
def test_row_reaches_its_figure(bench, name):
    row = ROWS[name]
    impaired, _ = apply_impairments(bench.recording, row.impairments, Draws(11, case=name))
    assert bench.rho(row.repair(bench, impaired)) >= row.at_least
    if row.impairments:
        assert bench.rho(table.nothing(bench, impaired)) < row.at_least
