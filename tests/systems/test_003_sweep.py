"""What the recorded sweep of system 003 claims (60 scenes and noise draws a point); a reduced form
runs in tests/systems/test_003_rotation.py.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "sweeps"
RECORDED = json.loads((FOLDER / "isal_rotation_snr.json").read_text(encoding="utf-8"))
METRICS = ("omega_error_percent", "k1_error_percent", "k2_error_percent", "yc_error_m")
LOW = [-10.0, -5.0, 0.0, 5.0]


def rms(algorithm: str, metric: str, snr_db: float) -> float:
    return next(
        p["rmse"]
        for p in RECORDED["points"]
        if (p["algorithm"], p["metric"], p["parameters"]["world.noise.snr_db"]) == (algorithm, metric, snr_db)
    )


def bound(metric: str, snr_db: float) -> float:
    return next(
        b["rms"] for b in RECORDED["bounds"] if (b["metric"], b["parameters"]["world.noise.snr_db"]) == (metric, snr_db)
    )


def test_every_point_has_its_trials() -> None:
    assert all(p["n"] == RECORDED["made_with"]["trials"] for p in RECORDED["points"] if p["algorithm"] == "recommended")


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("snr_db", LOW)
def test_the_recommended_estimator_is_within_2_5_of_its_bound_and_never_below_it(metric: str, snr_db: float) -> None:
    assert 0.75 < rms("recommended", metric, snr_db) / bound(metric, snr_db) < 2.5


@pytest.mark.parametrize("snr_db", LOW)
def test_each_step_of_the_recommended_estimator_comes_closer(snr_db: float) -> None:
    coarse, fitted, found = (
        rms(algorithm, "k1_error_percent", snr_db) for algorithm in ("coarse", "phase_fit", "recommended")
    )
    assert found < fitted < coarse


def test_the_bound_falls_with_the_noise() -> None:
    assert bound("omega_error_percent", -10.0) / bound("omega_error_percent", 10.0) == pytest.approx(10, rel=0.1)
