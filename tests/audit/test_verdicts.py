"""The audit of verdicts covers every estimator, and its bars hold at reduced size."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.audit.frame import estimators
from tests.audit.table import SAME, covered, entries
from tests.scripting import script

ENTRIES = entries()


def test_every_estimator_is_in_the_table() -> None:
    public = set(estimators())
    assert not public - covered(ENTRIES), "estimators without an entry in tests/audit and without a written reason"
    assert not covered(ENTRIES) - public, "entries of estimators that are not public"
    assert set(SAME) <= public and not set(SAME) & set(SAME.values())


def test_the_script_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script("verdict_audit").main(["--small", "--out", str(tmp_path / "rows.json"), "--only", "PhaseIncrement"])
    rows = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))["rows"]
    assert [row["world"] for row in rows] == ["noise", "zeros", "aliased"]
    assert set(rows[0]) == {"estimator", "world", "snr_db", "trials", "ok", "false_ok", "needless", "rms_over_std"}
    assert capsys.readouterr().out.endswith("rows.json\n")
