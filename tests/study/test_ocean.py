"""Configs of ships on a sea: run, sweep, requires and trade of a small scene; figures by their
definitions.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torchsar.study.config import load
from torchsar.study.ocean.build import Ocean
from torchsar.study.ocean.judge import Place, shown_at
from torchsar.study.ocean.requires import heed_limits, needs_of
from torchsar.study.ocean.trials import OceanTrials

from torchsar.cli import main
from torchsar.core import Axis, Draws, Signal
from torchsar.multichannel.motion import PointMotion
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems import system_of

FLOW = {
    "stage": "movers_image",
    "bands": 2,
    "integration_s": 2.0,
    "segment_s": 0.4,
    "half_along_m": 60.0,
    "half_range_m": 30.0,
    "u_a_reach_m_s": 12.0,
    "suppressed_m_s": [],
}
TRUE = {name: f"aux.true_{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")}


def chain(image: dict) -> dict:
    return {"stages": {"transmit": {"stage": "transmit_range_remove"}, "image": image}}


SHIP = {"u_r_m_s": 8.0, "scr_db": 20.0, "length_m": 40.0, "range_cells": 2, "count": 6}
TINY: dict = {
    "system": "geo_ocean",
    "title": "tiny",
    "seed": 1,
    "radar": {
        "carrier_hz": 1.25e9,
        "bandwidth_hz": 50e6,
        "pulse_s": 10e-6,
        "sampling_hz": 60e6,
        "prf_hz": 180.0,
        "speed_m_s": 300.0,
        "reference_range_m": 5000.0,
        "wave_speed_m_s": 3e8,
        "orbit": {},
    },
    "world": {
        "pulses": 540,
        "samples": 120,
        "targets": {"one": SHIP},
        "gate": {"kind": "band_limited", "duration_s": 2.0},
        "sea": {"kind": "k_sea", "cnr_db": 30.0},
    },
    "processor": {
        "conventional": chain({"stage": "stationary_image"}),
        "oracle": chain({**FLOW, "uses": TRUE}),
        "recommended": chain(FLOW),
    },
    "metrics": {"published_targets": {"displacement_vt_m": {"one": {"conventional": 133.0}}}},
    "trade": {"segments_s": [0.4], "half_ranges_m": [30.0], "precisions": ["complex64"]},
}


def write(folder: Path, **changes: object) -> str:
    tree = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / "ocean.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return str(path)


def world(**changes: object) -> dict:
    return {**TINY["world"], **changes}


def test_a_run_measures_every_ship(tmp_path: Path) -> None:
    assert main(["run", write(tmp_path), "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text(encoding="utf-8"))
    rest, oracle, best = (
        metrics["methods"][name]["targets"]["one"] for name in ("conventional", "oracle", "recommended")
    )
    assert rest["displacement_vt_m"] == pytest.approx(8 * 5000 / 300, abs=1.0) and rest[
        "displacement_m"
    ] == pytest.approx(rest["displacement_vt_m"], abs=5.0)
    assert (
        rest["position_error_m"] == pytest.approx(abs(rest["displacement_m"]), rel=0.05)
        and "u_r_error_m_s" not in rest
        and "found" not in rest
    )
    assert rest["replica_distance_vt_m"] == pytest.approx(720.0, abs=1.0)
    assert (
        oracle["u_r_error_m_s"] == 0
        and oracle["position_error_m"] < 1
        and oracle["found"] == best["found"] == best["ok"] == 1
    )
    assert 0 < abs(best["u_r_error_m_s"]) < 0.3 and best["position_error_m"] < 6
    assert best["along_error_m"] == pytest.approx(-5000 / 300 * best["u_r_error_m_s"], abs=1.0)
    assert (
        rest["sea_error_db"] == rest["sea_error_before_db"] == best["sea_error_before_db"] > best["sea_error_db"] + 18
    )
    assert best["contrast_db"] > rest["contrast_db"] + 10 and abs(best["hole_db"]) < 3 and best["replica_left_db"] < -10
    whole = metrics["methods"]["recommended"]["metrics"]
    assert (
        whole["false_targets"] == 0
        and whole["condition_number"] < 1.42
        and whole["noise_gain_db"] < 0.6
        and whole["seconds"] > 0
    )
    assert metrics["methods"]["recommended"]["estimates"]["one.u_r_m_s"]["value"] == pytest.approx(
        [8 + best["u_r_error_m_s"]]
    )
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "one, published" in page and "133" in page and len(list((tmp_path / "out" / "figures").glob("*.png"))) >= 5


def test_what_is_not_found_counts_as_at_rest(tmp_path: Path) -> None:
    faint = world(targets={"one": {**SHIP, "scr_db": -20.0}})
    trials = OceanTrials(
        load(write(tmp_path, world=faint, processor={"recommended": TINY["processor"]["recommended"]}, metrics=None))
    )
    found = trials({}, Draws(1, "a", [0, 1]))["recommended"]
    assert found["one.found"].tolist() == [0, 0] and found["ok"].tolist() == [False, False]
    assert found["one.u_r_error_m_s"].tolist() == [-8, -8] and float(found["one.position_error_m"].min()) > 100
    assert all(bool(torch.isfinite(value.double()).all()) for value in found.values())
    alone = trials({}, Draws(1, "a", [1]))["recommended"]
    for name, value in alone.items():
        if name != "seconds":
            assert float(value[0]) == float(found[name][1]), name


def test_scenes_follow_seed_trial_and_ship(tmp_path: Path) -> None:
    loaded = load(write(tmp_path), ["world.targets.one.u_r_m_s=-5.0"])
    ocean = Ocean.of(loaded)
    one, other = ocean.sighted(Draws(1, "run/0")), ocean.sighted(Draws(2, "run/0"))
    assert float(one.ships["one"].motion.u_r_m_s) == -5 and one.recording.aux["true_u_r_m_s"].tolist() == [-5]
    assert not torch.equal(one.still.data, other.still.data) and torch.equal(
        one.still.data, ocean.sighted(Draws(1, "run/0")).still.data
    )
    torch.testing.assert_close(
        one.still.data + one.ships["one"].echo.data, one.recording.signal.data, atol=1e-5, rtol=0
    )
    power = float(one.still.data.abs().square().mean())
    assert 0.3 < power < 3
    lines = (one.ships["one"].echo.data.abs().square().amax(-1) > 0).to(torch.float64).mean()
    assert 0.5 < float(lines) < 0.75  # lit for 2 of 3 s


def test_places_and_powers(tmp_path: Path) -> None:
    axes = (Axis("azimuth", 200, -100.0, 1.0, "m"), Axis("range", 40, 5000.0, 5.0, "m"))
    data = torch.ones(200, 40, dtype=torch.complex128)
    data[150, 10:12] = 10.0
    image = Signal(data, axes)
    place = Place(48.0, 5052.0)
    assert place.power(image, (0.5, 500.0)) == 1 and Place(1e4, 5000.0).power(image, (5.0, 5.0)) == 0
    found = place.centroid(image.with_data(data - 1), (10.0, 20.0))
    assert found.azimuth_m == 50 and found.range_m == pytest.approx(5052.5)
    assert place.centroid(image.with_data(0 * data), (10.0, 20.0)) == place
    still = PointMotion.of(Ocean.of(load(write(tmp_path))).radar, torch.zeros(1), y0_m=30.0)
    assert shown_at(still) == Place(30.0, 5000.0)


def test_a_sweep_by_command(tmp_path: Path) -> None:
    methods = {"oracle": TINY["processor"]["oracle"], "recommended": TINY["processor"]["oracle"]}
    config = write(
        tmp_path,
        sweep={"world.targets.one.u_r_m_s": [-6.0, 6.0], "trials": 1, "show": ["one.position_error_m"]},
        processor=methods,
        metrics=None,
    )
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 0
    points = json.loads((tmp_path / "sweep" / "summary.json").read_text(encoding="utf-8"))["points"]
    rows = [p for p in points if p["algorithm"] == "oracle" and p["metric"] == "one.position_error_m"]
    assert len(rows) == 2 and all(row["rmse"] < 1 for row in rows)


def test_requires_names_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["requires", write(tmp_path), "--out", str(tmp_path / "needs")]) == 0
    assert "half of the swath about the ships" in capsys.readouterr().out
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["ocean"]
    (swath,) = [row for row in needs["limits"] if row["name"].startswith("half of the swath")]
    assert (
        swath["verdict"] == "ok"
        and swath["methods"] == ["oracle", "recommended"]
        and swath["value"] == pytest.approx(300.0)
    )
    assert swath["limit"] == pytest.approx(30 + 21.6 * 1.0 + 600**2 / 40000, rel=1e-3)


def test_trade_changes_one_setting_at_a_time(tmp_path: Path) -> None:
    assert main(["trade", write(tmp_path), "--out", str(tmp_path / "trade")]) == 0
    tables = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    subtract, zero = tables["removal"]
    assert (
        subtract["found"] == zero["found"] == 1
        and subtract["sea_error_db"] + 3 < zero["sea_error_db"] < 3
        and zero["hole_db"] < -3
    )
    assert {key: len(tables[key]) for key in ("segment", "lines", "precision")} == {
        "segment": 1,
        "lines": 1,
        "precision": 1,
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"world": world(targets={"one": {**SHIP, "range_cells": 9}})}, "9 range cells need as many scatterers"),
        ({"world": world(pulses=180)}, "record is 1 s, and must be at least 2 s"),
        (
            {"processor": {"recommended": chain({"stage": "rebuild_bands"})}},
            "end the chain with movers_image or stationary_image",
        ),
        (
            {"processor": {"recommended": chain({"stage": "stationary_image", "bands": 4})}},
            "4 Doppler bands cannot be separated by 3 channels",
        ),
        ({"processor": {"recommended": chain({**FLOW, "removal": "paint"})}}, "removal"),
        (
            {"radar": {**TINY["radar"], "prf_hz": 187.5}, "processor": {"recommended": chain({**FLOW, "bands": 3})}},
            "at a pulse rate of 187.5 Hz and 300 m/s channels sample the same positions",
        ),
        ({"metrics": {"reference": "oracle"}}, "metrics.reference"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_values_of_a_flow_come_together(tmp_path: Path) -> None:
    some = {"processor": {"recommended": chain({**FLOW, "uses": {"u_r_m_s": "aux.true_u_r_m_s"}})}, "metrics": None}
    with pytest.raises(ConfigError, match="connect all four, or none"):
        OceanTrials(load(write(tmp_path, **some)))({}, Draws(1, "a", [0]))


def test_the_published_experiment_can_be_built() -> None:
    loaded = load("geo_ocean", ["world.targets.ship2.u_r_m_s=12.0", "seed=3"])
    system_of(loaded).check(loaded)
    heed_limits(loaded, "")
    assert all(limit.verdict != "refuse" for limit in needs_of(loaded).limits)
    names = ["conventional", "inverse_n3", "least_squares_n2", "mmse", "oracle", "recommended"]
    assert list(loaded.config.processor) == names and math.isclose(Ocean.of(loaded).cnr_db, 30.0)
    assert np.isclose(loaded.config.world.targets["ship2"].u_r_m_s, 12.0)


def test_the_script_of_the_figure_runs(tmp_path: Path) -> None:
    script = Path(__file__).resolve().parents[2] / "scripts" / "geo_ocean.py"
    done = subprocess.run(
        [sys.executable, str(script), "--small", "--out", "out"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-1000:]
    found = re.search(r"found +([-\d.]+) +([-\d.]+) +([-\d.]+) +([-\d.]+)", done.stdout)
    assert found and abs(float(found[1]) - 10) < 0.5 and abs(float(found[4]) - 5700) < 5
    assert (tmp_path / "out" / "figure_18.png").read_bytes().startswith(b"\x89PNG")
