"""What the recorded sweep of system 004 claims (200 trials a point); the reduced version runs in
tests/study/test_sweep_config.py.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

RECORDED = json.loads(
    (Path(__file__).resolve().parents[2] / "docs" / "sweeps" / "stripmap_doppler.json").read_text(encoding="utf-8")
)
BOUND, CURVE = "Cramer-Rao bound of a point of known position", "1/(T sqrt q), Tsvetkov 2017"
SNRS, SQUINTS = (-20.0, -10.0, 0.0, 10.0, 20.0), (0.15, 0.25, 0.35)


def place(scene: str, squint_deg: float, snr_db: float) -> dict:
    return {"world.scene": scene, "world.squint_deg": squint_deg, "world.noise.snr_db": snr_db}


def point(algorithm: str, metric: str, at: dict) -> dict:
    return next(
        p for p in RECORDED["points"] if (p["algorithm"], p["metric"], p["parameters"]) == (algorithm, metric, at)
    )


def bound(metric: str, name: str, at: dict) -> float:
    return next(
        b["rms"] for b in RECORDED["bounds"] if (b["metric"], b["bound"], b["parameters"]) == (metric, name, at)
    )


def test_every_point_has_its_trials() -> None:
    assert len({json.dumps(p["parameters"]) for p in RECORDED["points"]}) == 30
    assert all(p["n"] == 200 and p["interval"][0] <= p["rmse"] <= p["interval"][1] for p in RECORDED["points"])


@pytest.mark.parametrize("squint_deg", SQUINTS)
@pytest.mark.parametrize("snr_db", SNRS)
def test_a_point_of_known_place_lies_between_its_bound_and_the_papers_curve(squint_deg: float, snr_db: float) -> None:
    """The error of the velocity adds up to 6 mHz for each m/s, which shows from 10 dB on."""
    at = place("point", squint_deg, snr_db)
    rmse = point("point", "doppler_error_hz", at)["rmse"]
    of_velocity = 6e-3 * point("point", "velocity_error_m_s", at)["rmse"] if snr_db >= 10 else 0.0
    assert rmse >= 0.85 * bound("doppler_error_hz", BOUND, at)
    if snr_db <= 10:
        assert rmse <= math.hypot(1.25 * bound("doppler_error_hz", BOUND, at), of_velocity)
        assert rmse <= math.hypot(0.5 * bound("doppler_error_hz", CURVE, at), of_velocity)
    assert rmse <= math.hypot(bound("doppler_error_hz", CURVE, at), of_velocity)


@pytest.mark.parametrize("scene", ["point", "speckle"])
@pytest.mark.parametrize("squint_deg", SQUINTS)
def test_complete_apertures_beat_the_plain_increment_in_noise(scene: str, squint_deg: float) -> None:
    at = place(scene, squint_deg, -10.0)
    assert (
        point("recommended", "doppler_baseband_error_hz", at)["rmse"]
        < 0.7 * point("phase_increment", "doppler_baseband_error_hz", at)["rmse"]
    )


@pytest.mark.parametrize("squint_deg", SQUINTS)
def test_squint_is_found_to_a_hundredth_of_a_degree_once_there_is_signal(squint_deg: float) -> None:
    for scene, snr_db in (("speckle", 10.0), ("speckle", 20.0), ("point", 20.0)):
        assert point("recommended", "doppler_error_hz", place(scene, squint_deg, snr_db))["success_share"] >= 0.95
