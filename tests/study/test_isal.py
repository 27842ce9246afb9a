"""Configs of turning targets: run, sweep, requires and trade, simulated and recorded."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from torchsar.study.config import load
from torchsar.study.isal.trials import IsalTrials

from torchsar.cli import main
from torchsar.focus import TargetImage
from torchsar.io import read_inverse
from torchsar.radar import geometry_of
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.text import find_config, read_tree
from torchsar.study.systems import system_of

PHASES = {"sca": {"stage": "sca"}, "pga": {"stage": "pga", "kernel": "ml"}, "recommended": {"stage": "autofocus"}}
TINY: dict = {
    "system": "isal",
    "title": "tiny target",
    "seed": 3,
    "radar": {
        "carrier_hz": 193.414489e12,
        "bandwidth_hz": 150e9,
        "prf_hz": 2000.0,
        "rotation_rad_s": 0.005,
        "pulse_s": 100e-6,
        "reference_range_m": 20e3,
    },
    "world": {
        "pulses": 96,
        "samples": 64,
        "trials": 3,
        "scene": {"field": {"kind": "random_points", "count": 40, "azimuth_extent_m": 0.15, "range_extent_m": 0.05}},
        "start_phase": {"pulses": {"kind": "uniform"}},
        "noise": {"snr_db": 15.0},
    },
    "processor": {
        "ideal": {"input": "clean", "stages": {"image": {"stage": "azimuth_transform"}}},
        "none": {"stages": {"image": {"stage": "azimuth_transform"}}},
        **{
            name: {
                "stages": {
                    "phase": stage,
                    "correct": {"stage": "pulse_phase_correct", "uses": {"phase_rad": "phase"}},
                    "image": {"stage": "azimuth_transform"},
                }
            }
            for name, stage in PHASES.items()
        },
    },
    "metrics": {"reference": "ideal", "published_ideal": 7.0, "published": {"noisy": {"sca": 8.0}}},
}


def write(folder: Path, **changes: object) -> str:
    tree = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / "target.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return str(path)


def run(config: str, out: Path, *overrides: str) -> dict:
    assert main(["run", config, *overrides, "--out", str(out)]) == 0
    return json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def test_a_run_compares_methods_over_cases_and_scenes(tmp_path: Path) -> None:
    config = write(
        tmp_path,
        cases={
            "noisy": {"world.noise.snr_db": 5.0},
            "lost": {"world.impairments": {"lost": {"kind": "lost_pulses", "count": 4}}},
        },
    )
    metrics = run(config, tmp_path / "out")
    methods = metrics["methods"]
    assert list(methods) == ["ideal", "none", "sca", "pga", "recommended"]
    for case in ("noisy", "lost"):
        best, none = methods["recommended"]["cases"][case], methods["none"]["cases"][case]
        assert best["residual_phase_rms_rad"] < 0.2 and best["ok"] == 1.0
        assert best["entropy_above_ideal_nats"] < (
            0.15 if case == "noisy" else 0.3
        )  # gaps raise side lobes that no phase takes away
        assert none["residual_phase_rms_rad"] > 1.4 and none["entropy_above_ideal_nats"] > 0.3
    assert methods["recommended"]["metrics"]["strehl"] > 0.95 > methods["none"]["metrics"]["strehl"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "noisy, published" in page  # 8.0 - 7.0 beside ours
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 7
    # what was resolved can be run again
    again = run(str(tmp_path / "out" / "config.yaml"), tmp_path / "again")
    assert (
        again["methods"]["recommended"]["cases"]["noisy"]["entropy_nats"]
        == methods["recommended"]["cases"]["noisy"]["entropy_nats"]
    )


def test_seeds_make_scenes(tmp_path: Path) -> None:
    config = write(tmp_path, processor={name: TINY["processor"][name] for name in ("ideal", "recommended")})
    one, other = (
        run(config, tmp_path / f"out{seed}", f"seed={seed}")["methods"]["ideal"]["metrics"]["entropy_nats"]
        for seed in (1, 2)
    )
    assert one != other


def test_trials_of_a_sweep_do_not_depend_on_their_batch(tmp_path: Path) -> None:
    config = write(tmp_path, precision="complex128", sweep={"world.noise.snr_db": [0.0, 20.0]})
    trial = IsalTrials(load(config))
    records = [
        sweep(trial, {"world.noise.snr_db": [0.0, 20.0]}, batched=["world.noise.snr_db"], trials=3, seed=3, chunk=chunk)
        for chunk in (1, 4)
    ]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], atol=1e-9, rtol=0, err_msg=name)
    recommended = records[0].algorithms.index("recommended")
    bounds = records[0].bounds["residual_phase_rms_rad"]
    residual = np.sqrt((records[0].metrics["residual_phase_rms_rad"][recommended] ** 2).mean(-1))
    for bound in bounds.values():
        assert (residual > 0.7 * np.sqrt((bound**2).mean(-1))).all()  # no estimator knows the truth
    known, unknown = (
        np.sqrt((bounds[name] ** 2).mean(-1)) for name in ("scene known", "amplitudes unknown (Cramer-Rao)")
    )
    assert (unknown > known).all() and (unknown < 1.3 * known).all()
    np.testing.assert_allclose(known, 1 / np.sqrt(2 * 64 * np.array([1.0, 100.0])), rtol=0.05)


def test_a_sweep_by_command(tmp_path: Path) -> None:
    grid = {
        "world.noise.snr_db": [10.0],
        "world.pulses": [48, 96],
        "trials": 2,
        "success": {"residual_phase_rms_rad": 0.47},
    }
    config = write(tmp_path, sweep=grid)
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 0
    points = json.loads((tmp_path / "sweep" / "summary.json").read_text(encoding="utf-8"))["points"]
    best = [p for p in points if p["algorithm"] == "recommended" and p["metric"] == "residual_phase_rms_rad"]
    assert len(best) == 2 and all(p["success_share"] == 1.0 for p in best)


def test_requires_names_what_a_vibration_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shaken = {**TINY["world"], "motion": {"vibration": {"kind": "vibration", "name": "1_100_90", "unit": "mm"}}}
    assert main(["requires", write(tmp_path, world=shaken), "--out", str(tmp_path / "needs")]) == 0
    said = capsys.readouterr().out
    assert "intra-pulse acceleration" in said and "dechirped" in said
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["target"]
    row = next(r for r in needs["requirements"] if r["effect"] == "intra-pulse acceleration")
    assert row["phase_rad"] == pytest.approx(
        2 * math.pi / 1.55e-6 * 1e-3 * (2 * math.pi * 100) ** 2 * (50e-6) ** 2, rel=1e-3
    )
    assert main(["requires", write(tmp_path)]) == 0
    assert "the simplest echo model that this scene allows: phase_only" in capsys.readouterr().out


def test_trade_sets_methods_iterations_precisions_and_echoes_side_by_side(tmp_path: Path) -> None:
    config = write(tmp_path, trade={"trials": 2, "repeats": 1, "search": [0, 20], "polish": [0, 10]})
    assert main(["trade", config, "--out", str(tmp_path / "trade")]) == 0
    tables = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    assert [r["name"] for r in tables["methods"]] == ["none", "sca", "pga", "recommended"]
    by_name = {r["name"]: r for key in ("methods", "iterations", "precision", "echo") for r in tables[key]}
    assert by_name["search 20, polish 10"]["error_rad"] < by_name["search 0, polish 0"]["error_rad"]
    assert abs(by_name["complex64"]["error_rad"] - by_name["complex128"]["error_rad"]) < 1e-3
    assert {"phase_only", "dechirped"} <= set(by_name) and len(
        list((tmp_path / "trade" / "figures").glob("*.png"))
    ) == 3


def yak_like(folder: Path, n_pulse: int = 64, n_range: int = 96) -> Path:
    """Range profiles of a few points, as an archive."""
    rng = np.random.default_rng(5)
    k, n = np.arange(n_pulse), np.arange(n_range)
    profiles = sum(
        rng.normal()
        * np.sinc(n[:, None] - rng.uniform(20, 70))
        * np.exp(2j * np.pi * (rng.uniform(-0.4, 0.4) * k + rng.uniform()))
        for _ in range(40)
    )
    profiles = profiles + 0.05 * (rng.normal(size=profiles.shape) + 1j * rng.normal(size=profiles.shape))
    path = folder / "flight.npz"
    np.savez(path, profiles=profiles.astype(np.complex64), range_step_m=0.375, bandwidth_hz=400e6, prf_hz=100.0)
    return path


def turntable_like(folder: Path, n_pulse: int = 64, n_frequency: int = 48) -> Path:
    """A turntable sweep of a few points, as an archive."""
    rng = np.random.default_rng(6)
    f, a = 220e9 + 50e6 * np.arange(n_frequency), np.deg2rad(0.05 * np.arange(n_pulse))
    sig = np.zeros((n_frequency, n_pulse), complex)
    for _ in range(12):
        x, y = rng.uniform(-0.3, 0.3, 2)
        sig += rng.normal() * np.exp(-4j * np.pi / 299792458.0 * f[:, None] * (x * np.cos(a) + y * np.sin(a)))
    path = folder / "turntable.npz"
    np.savez(path, sig=sig.astype(np.complex64), freq_hz=f, angle_deg=np.rad2deg(a))
    return path


@pytest.mark.parametrize("made", [yak_like, turntable_like])
def test_injected_phases_are_found_in_recordings(tmp_path: Path, made) -> None:
    tree = read_tree(find_config("autofocus_recorded"))
    shorter = {
        "cases": {"white": tree["cases"]["white"]},
        "processor": {name: tree["processor"][name] for name in ("none", "pga", "recommended")},
    }
    config = tmp_path / "recorded.yaml"
    config.write_text(yaml.safe_dump({**tree, **shorter}, sort_keys=False), encoding="utf-8")
    metrics = run(str(config), tmp_path / "out", f"data.file={made(tmp_path)}", "seed=4")
    best, pga = metrics["methods"]["recommended"]["cases"]["white"], metrics["methods"]["pga"]["cases"]["white"]
    assert abs(best["entropy_above_clean_nats"]) < 0.01 and best["agreement_rad"] < 0.01 and best["ok"] == 1.0
    assert pga["agreement_rad"] > 0.3
    assert best["residual_phase_rms_rad"] < 0.3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"system": "isla"},
            "it should be one of geo, geo_ocean, isal, isal_rotation, sal, stripmap; did you mean 'isal'",
        ),
        ({"cases": {"empty": {}}}, "cases.empty changes nothing"),
        ({"cases": {"odd": {"world.nose.snr_db": 3.0}}}, "leads nowhere at 'nose'"),
        ({"cases": {"odd": {"world.noise.snr_db": "loud"}}}, "world.noise.snr_db"),
        (
            {"world": {**TINY["world"], "motion": {"v": {"kind": "vibration", "name": "1_100", "unit": "mm"}}}},
            "amplitude_frequency_phase",
        ),
        (
            {"world": {**TINY["world"], "motion": {"v": {"kind": "vibration", "name": "1_100_90"}}}},
            "key 'world.motion.v.unit' is missing",
        ),
        (
            {
                "world": {
                    **TINY["world"],
                    "scene": {"far": {"kind": "points", "azimuth_m": [0.0], "range_m": [5.0]}},
                    "fidelity": {"kind": "dechirped"},
                }
            },
            "range window",
        ),
        (
            {
                "processor": {
                    **TINY["processor"],
                    "recommended": {"stages": {"image": {"stage": "azimuth_transform"}, "phase": {"stage": "sca"}}},
                }
            },
            "works on the axes",
        ),
        ({"radar": {**TINY["radar"], "rotation_rad_s": None}}, "rotation"),
        (
            {"world": {**TINY["world"], "impairments": {"lost": {"kind": "lost_pulses", "count": 96}}}},
            "lost pulses leave nothing",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_stripmap_recording_is_no_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "raw.npz"
    np.savez(path, iq=np.zeros((4, 4, 2)))
    assert main(["run", "autofocus_recorded", f"data.file={path}", "--out", str(tmp_path / "out")]) == 2
    assert "data.file" in capsys.readouterr().err


def test_a_recording_cannot_be_swept_or_traded(tmp_path: Path) -> None:
    loaded = load("autofocus_recorded", [f"data.file={yak_like(tmp_path)}"])
    for command in (system_of(loaded).requires, system_of(loaded).trade):
        with pytest.raises(ConfigError, match="recording"):
            command(loaded, None)


CORRECT = {"stage": "pulse_phase_correct", "uses": {"phase_rad": "phase"}}
IMAGE = {"stage": "azimuth_transform"}


def test_all_corrections_of_a_chain_are_judged_together(tmp_path: Path) -> None:
    again = {
        "phase": {"stage": "sca"},
        "correct": CORRECT,
        "rest": {"stage": "autofocus"},
        "remove": {"stage": "pulse_phase_correct", "uses": {"phase_rad": "rest"}},
        "image": IMAGE,
    }
    started = {
        "first": {"stage": "sca"},
        "phase": {"stage": "pga", "kernel": "ml", "uses": {"start": "first.phase_rad"}},
        "correct": CORRECT,
        "image": IMAGE,
    }
    processor = {**TINY["processor"], "again": {"stages": again}, "started": {"stages": started}}
    methods = run(write(tmp_path, processor=processor, precision="complex128"), tmp_path / "out")["methods"]
    error = {name: method["metrics"].get("residual_phase_rms_rad") for name, method in methods.items()}
    assert error["again"] == pytest.approx(
        error["recommended"], abs=1e-6
    )  # the second estimator alone says little of the phase put in
    assert error["started"] < error["sca"]  # a phase that was only a start is not counted twice


def test_names_of_cases_may_hold_a_slash(tmp_path: Path) -> None:
    config = write(
        tmp_path,
        cases={"0.1 m/s": {"seed": 4}},
        processor={name: TINY["processor"][name] for name in ("ideal", "recommended")},
    )
    run(config, tmp_path / "out")
    assert (tmp_path / "out" / "arrays.zarr" / "0.1 m_s" / "recommended").is_dir()


def test_noise_near_the_end_of_float32_leaves_a_report(tmp_path: Path) -> None:
    run(write(tmp_path), tmp_path / "out", "world.noise.snr_db=-400")


def _method(**stages: dict) -> dict:
    return {"processor": {**TINY["processor"], "odd": {"stages": stages}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cases": {"odd": {"world.noise.snr_db": "loud"}}}, "cases.odd: key 'world.noise.snr_db'"),
        (
            {"cases": {"odd": {"metrics.reference": "sca"}}},
            "cases.odd: the key 'metrics.reference' holds for all cases",
        ),
        ({"cases": {"odd": {"world.trials": 2}}}, "the key 'world.trials' holds for all cases"),
        ({"cases": {"odd": {"data.file": __file__}}}, "is not used by a simulation"),
        (
            {"cases": {"odd": {"processor.more": {"stages": {"image": IMAGE}}}}},
            "cases.odd changes which methods there are",
        ),
        ({"cases": {"../": {"seed": 2}}}, "a case cannot be called '../'"),
        ({"cases": {"all": {"seed": 2}}}, "a case cannot be called 'all'"),
        ({"cases": {"a b": {"seed": 2}, "a_b": {"seed": 3}}}, "would share their figures"),
        ({"metrics": {"reference": "sca"}}, "name a method with 'input: clean'"),
        (
            _method(phase={"stage": "sca"}),
            "processor.odd, whose last stage gives the axes ('pulse', 'range'), not an image",
        ),
        (
            _method(doppler={"stage": "doppler_centroid"}, image=IMAGE),
            "needs radar.velocity_m_s, which a radar of this system does not have",
        ),
        (_method(compress={"stage": "range_compress"}, image=IMAGE), "processor.odd: this stage needs radar.pulse"),
        (
            _method(compress={"stage": "compress_dechirped"}, image=IMAGE),
            "processor.odd: CompressDechirped works on the axes",
        ),
        (
            {"processor": {**TINY["processor"], "odd": {"rerun": {"method": "sca", "start": "image", "given": {}}}}},
            "target.yaml: processor.odd.rerun: system isal runs no part of a chain again",
        ),
        (
            {
                "world": {
                    **TINY["world"],
                    "impairments": {"hum": {"kind": "tone", "over_signal_db": 9.0, "frequency_hz": 1e6}},
                }
            },
            "unknown impairment of a turning target 'tone'",
        ),
        (
            {"world": {**TINY["world"], "impairments": {"lost": {"kind": "lost_lines", "count": 3}}}},
            "did you mean 'lost_pulses'",
        ),
        ({"radar": {**TINY["radar"], "carrier_hz": 1e-300}}, "check the carrier"),
    ],
)
def test_what_would_mislead_is_refused(
    tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (
            ["processor.again={rerun: {method: sca, start: image, given: {}}}"],
            "system isal runs no part of a chain again",
        ),
        (
            ["cases={white: {data.impairments: {hum: {kind: tone, over_signal_db: 9, frequency_hz: 1e6}}}}"],
            "unknown impairment of a turning target",
        ),
        (["cases={white: {seed: 2}}", "processor.sca={stages: {phase: {stage: sca}}}"], "not an image"),
    ],
)
def test_what_would_mislead_is_refused_of_recordings(
    tmp_path: Path, overrides: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            ["run", "autofocus_recorded", f"data.file={yak_like(tmp_path)}", *overrides, "--out", str(tmp_path / "out")]
        )
        == 2
    )
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_recording_that_is_not_named_is_asked_for_by_its_kind() -> None:
    with pytest.raises(ConfigError, match="range profile or phase history"):
        load("autofocus_recorded")


def test_a_sweep_has_no_cases(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write(
        tmp_path, cases={"quiet": {"world.noise.snr_db": 30.0}}, sweep={"world.noise.snr_db": [10.0], "trials": 1}
    )
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 2
    assert "cases belong to runs" in capsys.readouterr().err


def test_a_stage_of_turning_targets_is_refused_by_a_stripmap() -> None:
    processor = "processor={recommended: {stages: {image: {stage: compress_dechirped}}}}"
    with pytest.raises(ConfigError, match=r"needs radar\.pulse_s"):
        loaded = load("stripmap_damaged", [processor, "metrics={}"])
        system_of(loaded).check(loaded)


def test_an_image_of_other_profiles_leaves_no_operator_behind(tmp_path: Path) -> None:
    recording = read_inverse(turntable_like(tmp_path))
    stage = TargetImage(
        recording.radar, geometry_of(recording.aux["frequency_hz"], angle_rad=recording.aux["angle_rad"])
    )
    with pytest.raises(ValueError, match="crop both to the same samples"):
        stage(recording.signal.crop(range=(0, 20)))
    fresh = TargetImage(
        recording.radar, geometry_of(recording.aux["frequency_hz"], angle_rad=recording.aux["angle_rad"])
    )
    assert stage(recording.signal).axes == fresh(recording.signal).axes


def test_trade_compares_methods_that_compress_pulses_themselves(tmp_path: Path) -> None:
    phase = {"compress": {"stage": "compress_dechirped"}, **TINY["processor"]["recommended"]["stages"]}
    ideal = {
        "input": "clean",
        "stages": {"compress": {"stage": "compress_dechirped"}, "image": {"stage": "azimuth_transform"}},
    }
    world = {**TINY["world"], "fidelity": {"kind": "dechirped"}}
    config = write(
        tmp_path,
        world=world,
        processor={"ideal": ideal, "recommended": {"stages": phase}},
        trade={"trials": 2, "repeats": 1, "search": [10], "polish": [5]},
    )
    assert main(["trade", config, "--out", str(tmp_path / "trade")]) == 0
    tables = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    assert all(
        row["error_rad"] < 0.2 and abs(row["entropy_above_ideal_nats"]) < 0.15
        for key in ("methods", "echo")
        for row in tables[key]
    )


def test_trade_knows_the_phases_of_impairments(tmp_path: Path) -> None:
    impairments = {"phase": {"kind": "white_phase"}, "lost": {"kind": "lost_pulses", "count": 6}}
    config = write(
        tmp_path,
        world={**TINY["world"], "impairments": impairments},
        trade={"trials": 2, "repeats": 1, "search": [0], "polish": [0]},
    )
    assert main(["trade", config, "--out", str(tmp_path / "trade")]) == 0
    rows = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))["methods"]
    assert next(row["error_rad"] for row in rows if row["name"] == "recommended") < 0.2


@pytest.mark.parametrize(
    ("command", "config", "overrides", "said"),
    [
        ("trade", None, ["trade.search=[]"], "trade.search"),
        ("trade", None, ["trade.search=[-1]"], "trade.search"),
        (
            "trade",
            None,
            ["processor.sca={stages: {phase: {stage: pga, iterations: 0}}}"],
            "processor.sca: pga: iterations must be a whole number of 1 or more, got 0",
        ),
        ("requires", None, ["radar.rotation_rad_s=null"], "depends on its rotation"),
    ],
)
def test_trade_and_requires_refuse_in_a_sentence(
    tmp_path: Path,
    command: str,
    config: str | None,
    overrides: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([command, config or write(tmp_path), *overrides, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
