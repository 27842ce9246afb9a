"""Ships on a sea: what is theirs alone in the frame; figures by their definitions."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.study.scenes import FLOW, GEO_OCEAN, SHIP, bench_of, world
from torchsar.core import Axis, Draws, Outcome, Signal
from torchsar.multichannel.motion import PointMotion
from torchsar.study.commands.requires import refuse_beyond_limits
from torchsar.study.systems.geo_ocean import judge as figures
from torchsar.study.systems.geo_ocean.judge import ImagePosition
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench


@pytest.mark.slow
def test_every_ship_is_measured(tmp_path: Path) -> None:
    bench = bench_of(tmp_path, "geo_ocean")
    outcomes = bench.batch(Draws(1, "run", [0]), detail=True).outcomes
    rows = {n: {k: float(v[0]) for k, v in o.judged.targets["one"].items()} for n, o in outcomes.items()}
    rest, oracle, best = (rows[name] for name in ("conventional", "oracle", "recommended"))
    assert rest["displacement_vt_m"] == pytest.approx(8 * 5000 / 300, abs=1.0)
    assert rest["displacement_m"] == pytest.approx(rest["displacement_vt_m"], abs=5.0)
    assert rest["position_error_m"] == pytest.approx(abs(rest["displacement_m"]), rel=0.05)
    assert "u_r_error_m_s" not in rest and "found" not in rest
    assert rest["replica_distance_vt_m"] == pytest.approx(720.0, abs=1.0)
    assert oracle["u_r_error_m_s"] == 0 and oracle["position_error_m"] < 1
    assert oracle["found"] == best["found"] == best["ok"] == 1
    assert 0 < abs(best["u_r_error_m_s"]) < 0.3 and best["position_error_m"] < 6
    assert best["along_error_m"] == pytest.approx(-5000 / 300 * best["u_r_error_m_s"], abs=1.0)
    assert rest["sea_error_db"] == rest["sea_error_before_db"] == best["sea_error_before_db"]
    assert best["sea_error_before_db"] > best["sea_error_db"] + 18
    assert best["contrast_db"] > rest["contrast_db"] + 10 and abs(best["hole_db"]) < 3
    assert best["replica_left_db"] < -10
    whole, codes = outcomes["recommended"].metrics, outcomes["recommended"].marks["outcomes"]
    assert codes["image"].tolist() == [Outcome.OK]  # places without a ship do not count
    assert float(whole["false_targets"]) == 0 and float(whole["condition_number"]) < 1.42
    assert float(whole["noise_gain_db"]) < 0.6
    found = bench.system.found(bench, outcomes["recommended"], bench.trials(Draws(1, "run", [0])))
    assert float(found["one.u_r_m_s"].value) == pytest.approx(8 + best["u_r_error_m_s"])


TRANSMIT = {"transmit": {"stage": "remove_transmit_range"}}
BALANCE = {
    "differences": {"stage": "estimate_balance", "prior": {"kind": "flat_band", "bandwidth_hz": 180.0}, "bands": 1},
    "balance": {
        "stage": "correct_balance",
        "uses": dict.fromkeys(("phase_rad", "gain_db", "delay_s"), "differences"),
    },
}
DIRECT = {
    "drift": {"stage": "estimate_synchronisation", "uses": {"direct_path": "aux.direct_path"}},
    "clocks": {"stage": "remove_synchronisation", "uses": {"phase_rad": "drift", "delay_s": "drift"}},
}
AT_REST = {
    "drift": {"stage": "clutter_synchronisation", "band_hz": 180.0},
    "clocks": DIRECT["clocks"],
}
ERRORS = {
    "channels": {
        "kind": "channel_errors",
        "phase_rad": [0.6, 0.0, -0.9],
        "gain_db": [0.8, 0.0, -1.1],
        "delay_s": [1.5e-9, 0.0, -2e-9],
    },
    "clocks": {
        "kind": "synchronisation_error",
        "phase_rad": [0.3, 1.0, 0.8],
        "phase_sinusoid_rad": 1.0,
        "delay_sinusoid_s": 3e-9,
        "direct_snr_db": 30.0,
    },
}


@pytest.mark.slow
@pytest.mark.slow
def test_errors_of_clocks_and_channels_are_removed(tmp_path: Path) -> None:
    """The sea fills a Doppler band; more of them, as published, take minutes."""
    image = {**FLOW, "integration_s": 2.35, "bands": 1, "threshold_db": 13.0}
    chains = {
        "uncorrected": {**TRANSMIT, **DIRECT},
        "at_rest": {**TRANSMIT, **BALANCE, **AT_REST},
        "recommended": {**TRANSMIT, **DIRECT, **BALANCE},
    }
    processor = {name: {"stages": {**stages, "image": image}} for name, stages in chains.items()}
    scene = {
        "samples": 160,
        "gate": {"kind": "band_limited", "duration_s": 2.35},
        "targets": {
            "one": {**SHIP, "scr_db": 10.0},
            "still": {**SHIP, "u_r_m_s": 0.0, "scr_db": 10.0, "range_m": -60.0},
        },
    }
    alone = {"recommended": {"stages": {**TRANSMIT, "image": image}}}
    right, bench = (
        bench_of(
            tmp_path, "geo_ocean", world=world("geo_ocean", **scene, impairments=errors), processor=of, metrics=None
        )
        for errors, of in (({}, alone), (ERRORS, processor))
    )
    draws = Draws(1, "run", [0, 1])
    true, batch = right.batch(draws).outcomes["recommended"], bench.batch(draws, detail=True)
    assert not bool(batch.outcomes["uncorrected"].metrics["ok"].any())
    for name, near_m in (("recommended", 2.0), ("at_rest", 3.0)):
        outcome = batch.outcomes[name]
        assert bool(outcome.metrics["ok"].all()), name
        for key, most in (
            ("u_r_error_m_s", 0.1),
            ("u_a_error_m_s", 0.1),
            ("along_error_m", near_m),
            ("range_error_m", 2.0),
        ):
            for ship, own in true.judged.targets.items():
                off = outcome.judged.targets[ship][key] - own[key]
                assert float(off.abs().max()) < most, (name, ship, key, off)
    result = SimpleNamespace(bench=bench, first=batch)
    ((_, _, _, panels),) = figures._flow(result)  # pyright: ignore[reportArgumentType]
    titles = [panel.axes[0].get_title() for panel in panels]
    assert titles[:4] == ["after transmit", "after clocks", "one channel", "everything at rest"]
    assert titles[4:] == ["detected", "without moving ships", "fused"]


def test_what_is_not_found_counts_as_at_rest(tmp_path: Path) -> None:
    faint = world("geo_ocean", targets={"one": {**SHIP, "scr_db": -20.0}})
    processor = {"recommended": GEO_OCEAN["processor"]["recommended"]}
    bench = bench_of(tmp_path, "geo_ocean", world=faint, processor=processor, metrics=None)
    both, alone = (bench.batch(Draws(1, "a", trials)).outcomes["recommended"].metrics for trials in ([0, 1], [1]))
    assert both["one.found"].tolist() == [0, 0] and both["ok"].tolist() == [False, False]
    assert both["one.u_r_error_m_s"].tolist() == [-8, -8] and float(both["one.position_error_m"].min()) > 100
    assert all(bool(torch.isfinite(value.double()).all()) for value in both.values())
    for name, value in alone.items():
        if name != "seconds":
            assert float(value[0]) == float(both[name][1]), name


def test_scenes_follow_seed_trial_and_ship(tmp_path: Path) -> None:
    bench = bench_of(tmp_path, "geo_ocean", "world.targets.one.u_r_m_s=-5.0")
    one, other, again = (bench.trials(Draws(seed, "run/0", [0])) for seed in (1, 2, 1))
    ((name, shown),) = one.own[0].ships.items()
    ship = shown.ship
    still = one.recording.signal.data[0] - ship.echo.data
    assert name == "one" and float(ship.motion.u_r_m_s) == -5 and float(one.truth["u_r_m_s"]) == -5
    assert not torch.equal(one.recording.signal.data, other.recording.signal.data)
    assert torch.equal(one.recording.signal.data, again.recording.signal.data)
    assert 0.3 < float(still.abs().square().mean()) < 3
    lines = (ship.echo.data.abs().square().amax(-1) > 0).to(torch.float64).mean()
    assert 0.5 < float(lines) < 0.75  # lit for 2 of 3 s


def test_positions_and_powers(tmp_path: Path) -> None:
    axes = (Axis("azimuth", 200, -100.0, 1.0, "m"), Axis("range", 40, 5000.0, 5.0, "m"))
    data = torch.ones(200, 40, dtype=torch.complex128)
    data[150, 10:12] = 10.0
    image = Signal(data, axes)
    at = ImagePosition(48.0, 5052.0)
    assert at.power(image, (0.5, 500.0)) == 1 and ImagePosition(1e4, 5000.0).power(image, (5.0, 5.0)) == 0
    found = at.centroid(image.with_data(data - 1), (10.0, 20.0))
    assert found.azimuth_m == 50 and found.range_m == pytest.approx(5052.5)
    assert at.centroid(image.with_data(0 * data), (10.0, 20.0)) == at
    still = PointMotion.of(bench_of(tmp_path, "geo_ocean").radar, torch.zeros(1), y0_m=30.0)
    assert ImagePosition.of(still) == ImagePosition(30.0, 5000.0)


def test_the_published_experiment_can_be_built() -> None:
    bench = Bench(load("geo_ocean", ["world.targets.ship2.u_r_m_s=12.0", "seed=3"]))
    refuse_beyond_limits(bench, "all")
    assert all(limit.verdict != "refuse" for limit in bench.system.limits(bench))
    names = ["conventional", "inverse_n3", "least_squares_n2", "mmse", "oracle", "recommended"]
    assert list(bench.chains) == names and bench.world().targets["ship2"].u_r_m_s == 12.0
    assert float(bench.world().sea.power_db) == pytest.approx(30.0)
