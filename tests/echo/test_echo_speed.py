"""The echo speed script runs at reduced size and states its error correctly."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch

from torchsar.metrics import error_db
from torchsar.scene import AlwaysLit, Dwell

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parents[2] / "scripts" / "echo_speed.py"))


@pytest.mark.parametrize("beam", [AlwaysLit(), Dwell(0.004)])
def test_script_measures_rate_and_error(beam):
    seconds, lit, error = SCRIPT["measure"](beam, 100, 32, 512, repeats=1)
    assert seconds > 0 and 0 < lit <= 100 * 32 * 512
    assert error < -120


def test_every_system_has_an_echo():
    for count, echo in SCRIPT["echoes"](100, 4, 128).values():
        assert echo(torch.complex64).numel() * 100 == count
        assert float(error_db(echo(torch.complex64), echo(torch.complex128)).max()) < -120


def test_finufft_computes_the_same_history():
    pytest.importorskip("finufft")
    (_, echo), history = SCRIPT["echoes"](100, 4, 128)["path"], SCRIPT["by_finufft"](100, 4, 128)
    assert error_db(torch.from_numpy(history()), echo(torch.complex128)) < -60
