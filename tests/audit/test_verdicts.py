"""The audit of verdicts covers every estimator, and its bars hold at reduced size."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.audit.frame import NOTHING, audit, estimators, verdict
from tests.audit.table import LIMITS, OTHER, SAME, covered, entries
from tests.scripting import script

ENTRIES = entries()
RECORD = Path(__file__).resolve().parents[2] / "docs" / "sweeps" / "verdict_audit.json"


def test_every_estimator_is_in_the_table() -> None:
    public, tried = set(estimators()) - set(OTHER), covered(ENTRIES)
    assert set(OTHER) <= set(estimators())
    missing, private = sorted(public - tried), sorted(tried - public)
    assert not missing, f"{missing} need an entry in the file of tests/audit of their data, or a reason in its table.py"
    assert not private, f"{private} have entries, but are not public functions or stages that return an Estimate"
    assert set(SAME) <= public and not set(SAME) & set(SAME.values())


def test_the_record_misses_no_bar_without_a_reason() -> None:
    rows = json.loads(RECORD.read_text(encoding="utf-8"))["rows"]
    cells = [(row["estimator"], row["world"], row["snr_db"]) for row in rows]
    assert len(set(cells)) == len(cells) > 900
    assert set(cells) <= {(entry.name, world.name, world.snr_db) for entry in ENTRIES for world in entry.worlds}
    missed = [row for row in rows if verdict(row)]
    assert {(row["estimator"], row["world"], row["snr_db"]) for row in missed} == {
        cell for explained in LIMITS.values() for cell in explained
    }


def test_the_script_writes_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script("verdict_audit").main(["--small", "--out", str(tmp_path / "rows.json"), "--only", "PhaseIncrement"])
    rows = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))["rows"]
    assert [row["world"] for row in rows] == ["noise", "zeros", "aliased"]
    assert set(rows[0]) == {"estimator", "world", "snr_db", "trials", "ok", "false_ok", "needless", "rms_over_std"}
    assert capsys.readouterr().out.endswith("rows.json\n")


# Cells that were wrong once, with the share of ok that is expected at least: sure on pure noise, on
# targets that the record sees only in part, at an SNR that is too low, or with another's data.
CELLS = [
    ("compensate.PhaseIncrement", "noise", None, 0.0),
    ("compensate.PhaseIncrement", "own", -20.0, 0.0),
    ("compensate.PhaseIncrement", "partly lit", 10.0, 0.0),
    ("compensate.PhaseIncrement", "own", 10.0, 1.0),
    ("compensate.DopplerCentroid", "partly lit", 10.0, 0.0),
    ("compensate.EffectiveVelocity", "noise", None, 0.0),
    ("compensate.EffectiveVelocity", "partly lit", 10.0, 0.0),
    ("compensate.EffectiveVelocity", "turntable", None, 0.0),
    ("compensate.EffectiveVelocity", "own", 10.0, 1.0),
    ("compensate.EffectiveVelocity", "own", 60.0, 1.0),
    ("compensate.EffectiveVelocity", "bright cells", None, 0.0),
    ("compensate.PointDoppler", "real noise", None, 0.0),
    ("repair.EstimateResponse", "bright lines", None, 0.0),
    ("repair.BlindJitter", "noise", None, 0.0),
    ("repair.BlindJitter", "own", -10.0, 0.0),
    ("repair.BlindJitter", "own", 20.0, 1.0),
    ("repair.PilotJitter", "own", 0.0, 0.0),
    ("repair.PilotJitter", "drifting", 20.0, 0.0),
    ("repair.PilotJitter", "own", 20.0, 1.0),
    ("repair.SubtractInterference", "zeros", None, 0.0),
    ("multichannel.SignalIntensityRatio", "own", 0.0, 0.0),
    ("multichannel.SignalIntensityRatio", "own", 60.0, 1.0),
    ("multichannel.EstimateBalance", "own", 20.0, 1.0),
    ("multichannel.EstimateBalance", "other beam", 20.0, 0.0),
    ("multichannel.EstimateBalance", "own", 0.0, 0.0),
    ("multichannel.MovingPointVelocity:one channel", "direct", 20.0, 0.0),
    ("multichannel.SignalIntensityRatio", "clutter", None, 0.0),
    ("multichannel.interferometry", "aliased", 10.0, 0.0),
    ("multichannel.interferometry", "own", 10.0, 1.0),
    ("multichannel.AlongTrackAutofocus", "partly lit", 10.0, 0.0),
    ("multichannel.LikelihoodVelocity", "partly lit", 10.0, 0.0),
    ("multichannel.LikelihoodVelocity", "own", 10.0, 1.0),
    ("compensate.RadialMotion", "letter", 10.0, 1.0),
    ("compensate.PhasePolish", "noise", None, 0.0),
    ("compensate.PhasePolish", "own", -10.0, 0.0),
    ("compensate.PhasePolish", "clutter 60 %", 5.0, 0.0),
    ("compensate.PhasePolish", "own", 20.0, 1.0),
    ("compensate.Sca", "few points", 10.0, 0.0),
    ("compensate.CoarseRotation", "direct", 0.0, 0.8),
    ("compensate.EntropyRotation:descent", "direct", 0.0, 0.8),
    ("compensate.EntropyFixedPoint", "partly lit", 10.0, 0.0),
    ("compensate.Autofocus", "one point", -5.0, 1.0),
    ("compensate.LinkPhases", "another scene of 8 points", 20.0, 0.0),
    ("compensate.LinkPhases", "scintillating 8 points", 20.0, 0.0),
    ("compensate.align_envelopes:running", "direct", 40.0, 0.5),
    ("compensate.align_envelopes:single", "direct", 40.0, 0.5),
    ("compensate.align_envelopes", "direct", 10.0, 1.0),
    ("repair.EstimateImbalance", "own", -10.0, 0.0),
    ("repair.EstimateImbalance", "turntable", None, 0.0),
    ("repair.EstimateImbalance", "own", 20.0, 1.0),
    ("repair.NotchInterference", "own", 30.0, 1.0),
    ("repair.find_trigger", "many points", 10.0, 0.0),
]


@pytest.mark.slow
@pytest.mark.parametrize("name, world, snr_db, least", CELLS)
def test_cells_that_were_wrong(name: str, world: str, snr_db: float | None, least: float) -> None:
    entry = next(entry for entry in ENTRIES if entry.name == name)
    cell = replace(entry, worlds=[w for w in entry.worlds if (w.name, w.snr_db) == (world, snr_db)])
    (row,) = audit([cell], lambda entry, world: 24 if world.name in NOTHING else 6)
    assert row["ok"] >= least and row["false_ok"] == 0, row
    assert row["rms_over_std"] is None or row["rms_over_std"] < 3


@pytest.mark.parametrize(
    "name, world, snr_db",
    [
        ("compensate.EntropyFixedPoint", "own", -5.0),  # 7 % had not converged and were ok
    ],
)
def test_wrong_phases_in_noise_are_not_ok(name: str, world: str, snr_db: float) -> None:
    entry = next(entry for entry in ENTRIES if entry.name == name)
    cell = replace(entry, worlds=[w for w in entry.worlds if (w.name, w.snr_db) == (world, snr_db)])
    (row,) = audit([cell], lambda entry, world: 24)
    assert row["false_ok"] == 0, row
