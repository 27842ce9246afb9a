"""What the recorded sweep of system 002 claims (200 trials a point); a reduced sweep runs in
tests/study/test_isal.py.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

RECORDED = json.loads(
    (Path(__file__).resolve().parents[2] / "docs" / "sweeps" / "isal_snr.json").read_text(encoding="utf-8")
)
# median phase error of the entropy fixed point by SNR, of an independent prototype, 12 trials
BRIEF = {-10.0: 0.229, -7.5: 0.159, -5.0: 0.117, 0.0: 0.080, 10.0: 0.057, 30.0: 0.056}
METRIC = "residual_phase_rms_rad"


def point(algorithm: str, snr_db: float, metric: str = METRIC) -> dict:
    return next(
        p
        for p in RECORDED["points"]
        if (p["algorithm"], p["metric"], p["parameters"]["world.noise.snr_db"]) == (algorithm, metric, snr_db)
    )


def bound(name: str, snr_db: float) -> float:
    return next(
        b["rms"]
        for b in RECORDED["bounds"]
        if (b["metric"], b["bound"], b["parameters"]["world.noise.snr_db"]) == (METRIC, name, snr_db)
    )


def test_every_point_has_its_trials() -> None:
    assert all(p["n"] == 200 for p in RECORDED["points"])


@pytest.mark.parametrize("snr_db", BRIEF)
def test_the_recommended_method_is_at_or_below_the_entropy_fixed_point_of_the_reference(snr_db: float) -> None:
    best = point("recommended", snr_db)
    assert best["median"] <= BRIEF[snr_db]
    assert best["median"] < point("entropy_fixed_point", snr_db)["median"]
    assert best["success_share"] >= 0.9
    assert best["ok_share"] >= 0.9


@pytest.mark.parametrize("snr_db", [0.0, 10.0, 20.0, 30.0])
def test_its_floor_lies_below_that_of_the_least_entropy(snr_db: float) -> None:
    assert point("recommended", snr_db)["median"] < 0.9 * point("least_entropy", snr_db)["median"]


@pytest.mark.parametrize("snr_db", [-20.0, -15.0])
def test_failure_is_not_called_success(snr_db: float) -> None:
    for algorithm in ("sca", "pga", "pga_sca", "entropy_fixed_point", "least_entropy", "recommended"):
        found = point(algorithm, snr_db)
        assert found["median"] > 1.4 and found["ok_share"] <= 0.01
    # lower entropy than the error-free image, and wrong; the recommended method is in doubt and
    # removes no phase
    assert point("least_entropy", snr_db, "entropy_above_ideal_nats")["median"] < 0
    assert 0 < point("recommended", snr_db, "entropy_above_ideal_nats")["median"] < 0.05


@pytest.mark.parametrize("snr_db", BRIEF)
def test_nobody_knows_the_truth(snr_db: float) -> None:
    for algorithm in ("entropy_fixed_point", "least_entropy", "recommended"):
        assert (
            point(algorithm, snr_db)["median"]
            > 0.95 * bound("amplitudes unknown (Cramer-Rao)", snr_db)
            > 0.95 * bound("scene known", snr_db)
        )


def test_the_papers_methods_keep_their_order_above_0_db() -> None:
    for snr_db in (10.0, 30.0):
        medians = [
            point(algorithm, snr_db)["median"] for algorithm in ("sca", "pga_sca", "entropy_fixed_point", "recommended")
        ]
        assert medians == sorted(medians, reverse=True)
        assert point("sca", snr_db)["success_share"] < 0.1 and point("pga", snr_db)["success_share"] < 0.1
