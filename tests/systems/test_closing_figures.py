"""The figure that each system is known for, as recorded or, where it is cheap, run again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from torchsar.core import Draws
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "sweeps"
SNR = "world.noise.snr_db"


def recorded(name: str, metric: str, snr_db: float, statistic: str, bound: str = "") -> float:
    """A statistic of the recommended method, relative to a bound where one is named."""
    tree = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    rows = [p for p in tree["points"] if (p["algorithm"], p["metric"]) == ("recommended", metric)]
    value = next(p[statistic] for p in rows if p["parameters"][SNR] == snr_db)
    least = [b for b in tree["bounds"] if (b["metric"], b["bound"], b["parameters"][SNR]) == (metric, bound, snr_db)]
    return value / (least[0]["rms"] if bound else 1.0)


def test_phases_of_a_turning_target_are_found_to_0_024_rad_at_10_db() -> None:
    assert recorded("isal_snr", "residual_phase_rms_rad", 10.0, "median") == pytest.approx(0.024, abs=0.0005)


def test_radial_velocities_are_found_within_1_04_bounds_at_5_db() -> None:
    assert recorded("sal_snr", "velocity_rmse_m_s", 5.0, "median", "known offset") == pytest.approx(1.04, abs=0.01)


@pytest.mark.parametrize("metric", ["omega_error_percent", "k1_error_percent", "k2_error_percent"])
def test_rotations_are_found_to_their_bound_at_0_db(metric: str) -> None:
    assert recorded("isal_rotation_snr", metric, 0.0, "rmse", "Cramer-Rao") == pytest.approx(1.0, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (["world.samples=null"], ["P1", "P2", "P3", "P4"]),
        # 10 s hold the replicas of one PRF, the strongest; those farther off need no range samples
        (["world.targets={P4: {u_r_m_s: 5.0, u_a_m_s: 10.0}}", "world.pulses=1800"], ["P4"]),
    ],
    ids=["azimuth only", "with range samples"],
)
def test_false_targets_of_moving_points_stay_below_65_db(overrides: list[str], names: list[str]) -> None:
    bench = Bench(load("geo_point_targets", overrides))
    batch = bench.batch(Draws(bench.config.seed, "run", [0]), methods=["recommended"], detail=True)
    targets = batch.outcomes["recommended"].judged.targets
    assert list(targets) == names
    assert all(float(row["ok"]) == 1 and float(row["mfta_db"]) < -65 for row in targets.values())


@pytest.mark.slow
def test_trials_of_a_recorded_sweep_run_again_with_that_median() -> None:
    """Six trials of the phases of a turning target at 10 dB: their median is within a tenth."""
    bench = Bench(load("isal_snr", [f"{SNR}=10.0"]))
    batch = bench.batch(Draws(7, "again", range(6)), methods=["recommended"])
    median = float(batch.outcomes["recommended"].metrics["residual_phase_rms_rad"].median())
    assert median == pytest.approx(0.024, rel=0.1)
