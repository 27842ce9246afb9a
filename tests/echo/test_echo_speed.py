"""The echo speed script runs at reduced size and states its error correctly."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from torchsar.scene import AlwaysLit, Dwell

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "echo_speed.py"


@pytest.mark.parametrize("beam", [AlwaysLit(), Dwell(0.004)])
def test_script_measures_rate_and_error(beam):
    seconds, lit, error = runpy.run_path(str(SCRIPT))["measure"](beam, 100, 32, 512, repeats=1)
    assert seconds > 0 and 0 < lit <= 100 * 32 * 512
    assert error < -120
