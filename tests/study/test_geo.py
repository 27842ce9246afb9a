"""Configs of moving targets before several channels: run, sweep, requires and trade; published
experiments load; figures by their definitions.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torchsar.study.config import load
from torchsar.study.geo.build import Echoes, row_draws
from torchsar.study.geo.judge import theory
from torchsar.study.geo.requires import Needs, heed_limits
from torchsar.study.geo.trials import GeoTrials, clutter_covariance, run_batch

from torchsar.cli import main
from torchsar.core import Draws, Signal
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import condition_number
from torchsar.scene import BandLimited, Pattern
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems import system_of

TRUE = {name: f"aux.true_{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}
FOUND = dict.fromkeys(("u_r_m_s", "u_a_m_s", "y0_m"), "velocity")
VELOCITY = {"stage": "moving_point_velocity", "dwell_s": 4.5, "u_r_reach_m_s": 15.0, "u_a_reach_m_s": 3.0}


def chain(uses: dict, bands: int = 2, *, before: dict | None = None, **rebuild: object) -> dict:
    migration = {"stage": "migration_correct", "kind": "static_bulk", "whole_swath": False, "uses": uses}
    stages = {"transmit": {"stage": "transmit_range_remove"}, **(before or {}), "migration": migration}
    stages["rebuild"] = {"stage": "rebuild_bands", "bands": bands, **rebuild, "uses": uses}
    return {"stages": {**stages, "focus": {"stage": "focus_target", "bandwidth_hz": 337.5, "uses": uses}}}


TINY: dict = {
    "system": "geo",
    "title": "tiny",
    "seed": 3,
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
        "pulses": 1024,
        "trials": 2,
        "targets": {"slow": {"u_a_m_s": 2.0}, "fast": {"u_r_m_s": 10.0, "azimuth_m": 20.0}},
        "noise": {"raw_scnr_db": -10.0},
    },
    "processor": {
        "conventional": chain({}),
        "inverse_n3": chain(FOUND, 3, before={"velocity": VELOCITY}),
        "oracle": chain(TRUE),
        "recommended": chain(FOUND, before={"velocity": VELOCITY}),
    },
    "metrics": {"published_targets": {"mfta_db": {"fast": {"recommended": -56.7}}}},
    "trade": {"samples": 32, "repeats": 1, "bands": [2], "transmit_orders": [1], "receive_orders": [2]},
}
ALONE = {"p1": {"u_r_m_s": 10.0}}
ESTIMATORS = {
    "ati": {
        "stages": {
            "transmit": {"stage": "transmit_range_remove"},
            "velocity": {"stage": "interferometry", "dwell_s": 4.5},
        }
    },
    "recommended": {
        "stages": {"transmit": {"stage": "transmit_range_remove"}, "velocity": {**VELOCITY, "u_a_m_s": 0.0}}
    },
}


def write(folder: Path, **changes: object) -> str:
    tree = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / "moving.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return str(path)


def world(**changes: object) -> dict:
    return {**TINY["world"], **changes}


def run(config: str, out: Path, *overrides: str) -> dict:
    assert main(["run", config, *overrides, "--out", str(out)]) == 0
    return json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def test_a_run_measures_every_target_beside_theory(tmp_path: Path) -> None:
    metrics = run(write(tmp_path), tmp_path / "out")
    methods, expected = metrics["methods"], metrics["theory"]
    for target in ("slow", "fast"):
        for name in ("oracle", "recommended"):
            row = methods[name]["targets"][target]
            assert row["irw_azimuth_m"] == pytest.approx(expected[target]["irw_azimuth_m"], rel=0.02), (name, target)
            assert row["pslr_azimuth_db"] == pytest.approx(-13.26, abs=0.15) and row[
                "islr_azimuth_db"
            ] == pytest.approx(-9.8, abs=0.3)
            assert row["mfta_db"] < -60 and row["condition_number"] < 1.42 and row["noise_gain_db"] < 0.6
    oracle, best, three = (methods[name]["targets"]["fast"] for name in ("oracle", "recommended", "inverse_n3"))
    assert abs(oracle["position_error_m"]) < 0.01 and "u_r_error_m_s" not in oracle
    assert (
        abs(best["u_r_error_m_s"]) < 0.2
        and abs(best["u_a_error_m_s"]) < 0.01
        and abs(best["position_error_m"]) < 3
        and best["ok"] == 1
    )
    # 16.7 m a metre per second: the image is moved by what u_r is wrong by
    assert best["position_error_m"] == pytest.approx(-5000 / 300 * best["u_r_error_m_s"], rel=0.1)
    assert three["condition_number"] == pytest.approx(9.9, rel=0.03) and three["mfta_db"] > best["mfta_db"]
    assert methods["conventional"]["targets"]["fast"]["mfta_db"] == pytest.approx(-19.4, abs=1.0)
    assert methods["conventional"]["targets"]["fast"]["position_error_m"] == pytest.approx(166.6, abs=2.0)
    told = methods["recommended"]["estimates"]["fast.u_r_m_s"]
    assert (
        len(told["value"]) == len(told["std"]) == 2
        and np.allclose(told["value"], 10, atol=0.3)
        and told["std"][0] == pytest.approx(0.036, rel=0.2)
    )
    assert metrics["definitions"]["snr_db"] == pytest.approx(16.99, abs=0.01) and metrics["definitions"][
        "raw_scnr_db"
    ] == pytest.approx(-10)
    assert abs(metrics["definitions"]["transmit_range_k2"]) < 0.0215
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "fast, published" in page and "16.99 dB above the noise" in page and "-10 dB before compression" in page
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 7
    again = load(str(tmp_path / "out" / "config.yaml"))
    system_of(again).check(again)


def test_two_dimensions_give_the_figures_of_one(tmp_path: Path) -> None:
    processor = {"recommended": TINY["processor"]["oracle"]}
    given = {
        "processor": processor,
        "metrics": None,
        "world": world(pulses=900, trials=1, targets={"p3": {"u_r_m_s": 10.0, "u_a_m_s": 5.0}}, noise={}),
    }
    flat = run(write(tmp_path, **given), tmp_path / "one")["methods"]["recommended"]["targets"]["p3"]
    deep = run(write(tmp_path, **given), tmp_path / "two", "world.samples=48")["methods"]["recommended"]["targets"][
        "p3"
    ]
    assert deep["irw_azimuth_m"] == pytest.approx(flat["irw_azimuth_m"], rel=0.005) and deep[
        "pslr_azimuth_db"
    ] == pytest.approx(flat["pslr_azimuth_db"], abs=0.1)
    assert deep["irw_range_m"] == pytest.approx(2.6577, rel=0.01) and deep["pslr_range_db"] == pytest.approx(
        -13.26, abs=0.15
    )
    assert abs(deep["range_error_m"]) < 0.05 and abs(deep["position_error_m"]) < 0.05 and "irw_range_m" not in flat


def test_fast_targets_keep_one_line_by_their_walk(tmp_path: Path) -> None:
    velocity = {"stage": "moving_point_velocity", "dwell_s": 4.5, "u_r_reach_m_s": 40.0, "u_a_reach_m_s": 1.0}
    given = {
        "world": world(pulses=900, samples=64, trials=1, targets={"p": {"u_r_m_s": 25.0}}, noise={"snr_db": 5.0}),
        "metrics": None,
    }
    bench = GeoTrials(
        load(write(tmp_path, **given, processor={"recommended": chain(FOUND, before={"velocity": velocity})}))
    ).bench({})
    row = run_batch(bench, Draws(1, "run", [0])).metrics["recommended"]
    assert abs(float(row["u_r_error_m_s"])) < 0.5 and bool(row["ok"])


def test_targets_keep_their_noise_and_trials_their_rows(tmp_path: Path) -> None:
    both = Echoes.of(load(write(tmp_path))).recorded(Draws(1, "run", range(2)))
    one = Echoes.of(load(write(tmp_path, world=world(targets={"fast": TINY["world"]["targets"]["fast"]})))).recorded(
        Draws(1, "run", [1])
    )
    assert torch.equal(both.noisy.signal.data[3], one.noisy.signal.data[0]) and both.truth["u_r_m_s"].tolist() == [
        0,
        10,
        0,
        10,
    ]
    assert torch.equal(both.clean.signal.data[0], both.clean.signal.data[2]) and not torch.equal(
        both.noisy.signal.data[0], both.noisy.signal.data[2]
    )
    assert row_draws(Draws(1, ("a", "b"), [0, 5]), {"x": 0, "y": 0}).case == ("a/x", "a/y", "b/x", "b/y")
    moved = Echoes.of(load(write(tmp_path), ["world.targets.fast.u_r_m_s=12.0", "seed=4"])).recorded(
        Draws(4, "run", range(2))
    )
    assert moved.truth["u_r_m_s"].tolist() == [0, 12, 0, 12]


def test_impairment_stays_in_the_clean_image(tmp_path: Path) -> None:
    impairments = {"channels": {"kind": "channel_errors", "phase_rad": [0.1, -0.2, 0.1]}}
    given = {"processor": {"recommended": TINY["processor"]["oracle"]}, "metrics": None}
    level = [
        float(
            run_batch(
                GeoTrials(load(write(tmp_path, **given, world=world(trials=1, impairments=one)))).bench({}),
                Draws(1, "run", [0]),
            ).metrics["recommended"]["mfta_db"][1]
        )
        for one in ({}, impairments)
    ]
    assert level[0] < -60 and level[1] > -35


def test_trials_of_a_sweep_do_not_depend_on_their_batch_and_keep_to_the_bound(tmp_path: Path) -> None:
    given = {"processor": ESTIMATORS, "metrics": None, "precision": "complex128", "world": world(targets=ALONE)}
    trial = GeoTrials(load(write(tmp_path, **given)))
    levels = [-30.0, -10.0]
    records = [
        sweep(
            trial,
            {"world.noise.raw_scnr_db": levels},
            batched=["world.noise.raw_scnr_db"],
            trials=12,
            seed=3,
            chunk=chunk,
        )
        for chunk in (5, 24)
    ]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], atol=1e-6, rtol=1e-4, err_msg=name)
    bound = records[0].bounds["u_r_error_m_s"]["Cramer-Rao, u_a known"][:, 0]
    np.testing.assert_allclose(bound, [0.2099, 0.02099], rtol=1e-3)
    rms = np.sqrt((records[0].metrics["u_r_error_m_s"] ** 2).mean(-1))
    assert (rms[1] / bound > 0.55).all() and (rms[1] / bound < 1.6).all() and (rms[0] < 3 * bound).all()
    assert "Cramer-Rao" not in records[0].bounds["u_r_error_m_s"]


def test_a_sweep_by_command(tmp_path: Path) -> None:
    grid = {"world.targets.p1.u_r_m_s": [-5.0, 5.0], "trials": 2}
    config = write(tmp_path, sweep=grid, processor=ESTIMATORS, metrics=None, world=world(targets=ALONE))
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 0
    points = json.loads((tmp_path / "sweep" / "summary.json").read_text(encoding="utf-8"))["points"]
    rows = [p for p in points if p["algorithm"] == "recommended" and p["metric"] == "u_r_error_m_s"]
    assert len(rows) == 2 and all(row["rmse"] < 0.2 for row in rows)


def test_the_sea_is_as_strong_as_said(tmp_path: Path) -> None:
    sea = {
        "sea": {"kind": "k_sea", "cnr_db": 20.0, "shape": 10.0},
        "sea_gate": {"kind": "band_limited", "duration_s": 4.5},
        "gate": {"kind": "pattern"},
        "noise": {"scr_db": -10.0},
    }
    echoes = Echoes.of(load(write(tmp_path, world=world(targets=ALONE, **sea), processor=ESTIMATORS, metrics=None)))
    recorded = echoes.recorded(Draws(2, "run", range(6)))
    left = (recorded.noisy.signal.data - recorded.clean.signal.data).abs().square().mean()
    assert echoes.snr_db == pytest.approx(10.0) and 10 * math.log10(float(left)) == pytest.approx(10.04, abs=1.0)
    bounds = GeoTrials(load(write(tmp_path, world=world(targets=ALONE, **sea), processor=ESTIMATORS, metrics=None)))(
        {}, Draws(2, "run", [0])
    )["bounds"]
    assert 0 < float(bounds["u_r_error_m_s"]["Cramer-Rao, u_a known"]) < 1


def test_clutter_is_coherent_over_channels(tmp_path: Path) -> None:
    radar = Echoes.of(load(write(tmp_path))).radar
    for gate in (BandLimited(4.5), Pattern()):
        covariance = clutter_covariance(radar, 256, gate, 100.0)
        power = covariance.diagonal(dim1=-2, dim2=-1).real.mean(0)
        np.testing.assert_allclose(power, 101.0, rtol=1e-6)
        assert torch.linalg.eigvalsh(covariance).min() > 0.999
    assert float(
        condition_number(radar, PointMotion.of(radar, torch.zeros((), dtype=torch.float64)), 2)
    ) == pytest.approx(1.41, rel=0.01)


def test_theory_follows_its_formulas(tmp_path: Path) -> None:
    radar = Echoes.of(load(write(tmp_path))).radar
    found = theory(radar, {"u_r_m_s": 0.0, "u_a_m_s": 10.0, "y0_m": 0.0}, 4.5, 337.5, 64)
    assert found["irw_azimuth_m"] == pytest.approx(0.886 * 0.24 * 5000 / (290 * 4.5), rel=1e-3) and found[
        "irw_range_m"
    ] == pytest.approx(0.886 * 3.0, rel=1e-3)
    assert theory(radar, {"u_r_m_s": 0.0, "u_a_m_s": 0.0, "y0_m": 0.0}, None, 337.5, None)[
        "irw_azimuth_m"
    ] == pytest.approx(0.886 * 300 / 337.5, rel=1e-3)


def test_requires_names_the_simplest_chain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["requires", write(tmp_path), "--out", str(tmp_path / "needs")]) == 0
    assert (
        "transmit range order 2, receive range by the hyperbola, range migration: deramp and keystone"
        in capsys.readouterr().out
    )
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["moving"]
    worst = [
        row
        for row in needs["limits"]
        if row["name"] == "condition number within the velocities" and row["verdict"] == "warn"
    ]
    assert [row["methods"] for row in worst] == [["inverse_n3"]] and worst[0]["value"] == pytest.approx(12.5, rel=0.1)


def test_trade_sets_histories_dimensions_and_reconstructions_side_by_side(tmp_path: Path) -> None:
    small = {
        "radar": {**TINY["radar"], "pulse_s": 1e-6},
        "world": world(pulses=900, targets={"p": {"u_r_m_s": 10.0}}),
        "processor": {"recommended": TINY["processor"]["oracle"]},
        "metrics": None,
    }
    assert main(["trade", write(tmp_path, **small), "--out", str(tmp_path / "trade")]) == 0
    tables = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    rows = {
        row["name"]: row
        for name in ("history", "dimensions", "migration", "rebuild", "precision")
        for row in tables[name]
    }
    assert rows["transmit range of order 1"]["irw_azimuth_m"] > 0.9 > rows["exact"]["irw_azimuth_m"]
    assert rows["echo with a receive range of order 2"]["peak_db"] < -2
    assert (
        rows["none"]["peak_db"] < -8
        and rows["static bulk, as if at rest"]["peak_db"] < -1 < rows["keystone, as if at rest"]["peak_db"]
    )
    assert rows["full chirps, 152 samples"]["irw_range_m"] == pytest.approx(2.66, rel=0.03)
    assert rows["complex64"]["image_error_db"] < -100
    assert len(list((tmp_path / "trade" / "figures").glob("*.png"))) == 5


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radar": {**TINY["radar"], "transmit_range": [1.0]}}, "give one of transmit_range and orbit"),
        ({"radar": {**TINY["radar"], "channel_m": []}}, "key 'radar.channel_m'"),
        ({"radar": {**TINY["radar"], "prf_hz": 0.0}}, "key 'radar.prf_hz' has the value 0.0"),
        ({"radar": {**TINY["radar"], "reference_range_m": 2000.0}}, "radar.height_m must lie in 0..reference_range_m"),
        (
            {"world": world(noise={"snr_db": 0.0, "raw_scnr_db": 0.0})},
            "give at most one of snr_db, raw_scnr_db and scr_db",
        ),
        ({"world": world(noise={"scr_db": 0.0})}, "noise.scr_db is the level of targets over a sea"),
        ({"world": world(sea={"kind": "k_sea"}, noise={})}, "the level of a sea counts from the noise"),
        ({"world": world(targets={"p": {"range_m": 10.0}})}, "azimuth-only data (samples: null) know one range"),
        ({"world": world(targets={"p": {"u_a_m_s": 300.0}})}, "speed past the fastest target is 0 m/s"),
        ({"world": world(pulses=600)}, "record is 3.333 s, and must be at least 4.5 s"),
        ({"processor": {"recommended": chain(TRUE, 4)}}, "4 Doppler bands cannot be separated by 3 channels"),
        (
            {"radar": {**TINY["radar"], "prf_hz": 187.5}, "processor": {"recommended": chain(TRUE, 3)}},
            "at a pulse rate of 187.5 Hz and 300 m/s channels sample the same positions",
        ),
        (
            {
                "world": world(targets={"p": {"u_a_m_s": 12.0}}),
                "processor": {"recommended": chain(TRUE, 3)},
                "metrics": None,
            },
            "a speed past the target of 288 m/s the channels sample",
        ),
        (
            {
                "processor": {
                    "recommended": {"stages": {"velocity": {"stage": "intensity_ratio", "bandwidth_hz": 600.0}}}
                }
            },
            "3 bands of 180 Hz leave nothing outside 600 Hz",
        ),
        (
            {"processor": {"recommended": {"stages": {"image": {"stage": "omega_k"}}}}},
            "a radar of this system does not have",
        ),
        ({"metrics": {"reference": "recommended"}}, "metrics.reference"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_method_may_be_shown_beyond_its_limits(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    given = {
        "radar": {**TINY["radar"], "prf_hz": 187.5},
        "processor": {"recommended": chain(TRUE), "inverse_n3": chain(TRUE, 3)},
    }
    with pytest.raises(ConfigError, match=r"processor\.inverse_n3: condition number at rest"):
        heed_limits(load(write(tmp_path, **given)), "")
    heed_limits(load(write(tmp_path, **given, beyond_limits=["inverse_n3"])), "odd")
    assert "cases.odd: condition number at rest" in caplog.text


def test_a_sweep_follows_one_target(tmp_path: Path) -> None:
    trials = GeoTrials(load(write(tmp_path)))
    with pytest.raises(ConfigError, match="a sweep follows one target, and there are slow, fast"):
        trials.check({"world.noise.raw_scnr_db": [0.0]})
    alone = GeoTrials(load(write(tmp_path, world=world(targets=ALONE))))
    with pytest.raises(ConfigError, match="both say how strong the target is"):
        alone.check({"world.noise.raw_scnr_db": [0.0], "world.noise.snr_db": [0.0]})


@pytest.mark.parametrize(
    "name",
    [
        "geo_point_targets",
        "geo_pattern",
        "geo_velocity_scnr",
        "geo_velocity_u_r",
        "geo_velocity_u_a",
        "geo_velocity_prf",
        "geo_velocity_clutter",
    ],
)
def test_recorded_experiments_can_be_built(name: str) -> None:
    loaded = load(name)
    system_of(loaded).check(loaded)
    needs = Needs.of(loaded)
    assert all(limit.verdict != "refuse" for limit in needs.limits)
    if loaded.config.sweep.grid:
        GeoTrials(loaded).check(loaded.config.sweep.grid)


def test_singular_speeds_are_refused_or_crossed_unharmed(tmp_path: Path) -> None:
    paper = {"stage": "alternate_velocity", "bandwidth_hz": 337.5, "dwell_s": 4.5, "step_m_s": 2.0}
    best, first = (
        chain(FOUND, before={"velocity": {**VELOCITY, "u_a_reach_m_s": 14.0}}),
        {"transmit": {"stage": "transmit_range_remove"}},
    )
    given = {"world": world(targets={"p": {"u_r_m_s": 10.0, "u_a_m_s": 12.0}}, trials=1), "metrics": None}
    with pytest.raises(
        ConfigError, match="processor.paper: at a pulse rate of 180 Hz and a speed past the target of 288 m/s"
    ):
        run_batch(
            GeoTrials(
                load(
                    write(
                        tmp_path,
                        **given,
                        processor={"paper": {"stages": {**first, "velocity": paper}}, "recommended": best},
                    )
                )
            ).bench({}),
            Draws(1, "run", [0]),
        )
    given["processor"] = {"paper": {"stages": {**first, "velocity": {**paper, "method": "mmse"}}}, "recommended": best}
    batch = run_batch(GeoTrials(load(write(tmp_path, **given))).bench({}), Draws(1, "run", [0]))
    assert all(
        bool(torch.isfinite(value.double()).all())
        for outcome in batch.outcomes.values()
        for value in outcome.metrics.values()
    )
    assert abs(float(batch.metrics["recommended"]["u_r_error_m_s"])) < 0.2 and isinstance(
        batch.outcomes["recommended"].clean.signal, Signal
    )  # type: ignore[union-attr]
