"""Sweeps of a config: what is checked before anything runs, and what lies in the folder."""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.study.tiny import TINY, write_tiny
from torchsar.cli import main
from torchsar.study.commands import sweep as sweep_module
from torchsar.study.commands.sweep import SweepTrial, identity, sweep_grid
from torchsar.study.montecarlo import Record, differences, read_sweep
from torchsar.study.montecarlo.engines import InProcess
from torchsar.study.montecarlo.loop import Plan, run_plan
from torchsar.study.montecarlo.report import SweepPictures
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded
from torchsar.study.table import load
from torchsar.study.trials.batch import error_name
from torchsar.study.trials.bench import Bench

SWEEP = {"world.noise.snr_db": [0.0, 20.0], "world.doppler_hz": [-20.0, 30.0], "trials": 6}
SMALL = ["sweep.world.noise.snr_db=[-10.0, 10.0]", "sweep.world.squint_deg=[0.25]"]


def record_of(loaded: Loaded, chunk: int | None, trials: int) -> Record:
    trial = SweepTrial(loaded)
    plan = Plan(sweep_grid(loaded, trial), trials, loaded.config.seed, chunk)
    return run_plan(plan, trial, None, nullcontext(InProcess()))


def one_picture(patch: pytest.MonkeyPatch) -> None:
    """The first picture alone is drawn; test_sweep_report.py draws all of a sweep."""
    every = SweepPictures.all
    patch.setattr(SweepPictures, "all", lambda pictures, wanted: itertools.islice(every(pictures, wanted), 1))


@pytest.fixture
def load_tree(tmp_path: Path) -> Callable[[dict], Loaded]:
    def from_file(tree: dict) -> Loaded:
        (tmp_path / "tree.yaml").write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
        return load(str(tmp_path / "tree.yaml"))

    return from_file


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, name = tmp_path_factory.mktemp("sweep"), "doppler_baseband_error_hz"
    config = write_tiny(
        folder,
        sweep={**SWEEP, "show": [name], "success": {name: 10.0}, "save": {"trials": [1], "taps": ["doppler"]}},
    )
    with pytest.MonkeyPatch.context() as patch:
        one_picture(patch)
        assert main(["sweep", str(config), "--resume", "--out", str(folder / "result")]) == 0
    return folder / "result"


@pytest.mark.slow
def test_the_folder_holds_what_is_promised(out: Path) -> None:
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} == {
        "results.zarr",
        "config.yaml",
        "summary.json",
        "figures",
        "report.html",
    }
    summary = json.loads((out / "summary.json").read_text())
    assert summary["parameters"] == {"world.noise.snr_db": [0, 20], "world.doppler_hz": [-20, 30]}
    asked = {
        "algorithm": "recommended",
        "metric": "doppler_baseband_error_hz",
        "parameters": {"world.noise.snr_db": 20.0, "world.doppler_hz": 30.0},
    }
    point = next(p for p in summary["points"] if asked.items() <= p.items())
    assert {"n", "mean", "median", "rmse", "interval", "ok_share", "success_share"} <= set(point) and point["n"] == 6
    values = read_sweep(out).metrics["doppler_baseband_error_hz"][1, 1, 1]
    assert point["rmse"] == pytest.approx(float(np.sqrt(np.mean(values**2))))
    assert point["interval"][0] <= point["rmse"] <= point["interval"][1]


def test_the_config_left_behind_runs_again(out: Path) -> None:
    again = load(str(out / "config.yaml"))
    assert again.config.sweep.grid == {k: v for k, v in SWEEP.items() if "." in k} and again.config.sweep.trials == 6


def test_images_of_chosen_trials_are_kept(out: Path) -> None:
    import zarr

    saved = zarr.open_group(str(out / "results.zarr"), mode="r")["saved"]
    groups = [saved[name]["1"] for name in saved.group_keys()]
    assert len(groups) == 4 and all(
        g["recommended.last"].shape == (192, 128) and g["recommended.doppler"].shape == (192, 128) for g in groups
    )


def test_a_batched_key_gives_what_a_config_of_that_value_gives(load_tree) -> None:
    tiny = load_tree({**TINY, "sweep": SWEEP})
    swept = record_of(tiny, 5, 3)
    alone = record_of(
        tiny.changed({"sweep": {"grid": {"world.noise.snr_db": [20.0], "world.doppler_hz": [30.0]}}}), 1, 3
    )
    np.testing.assert_allclose(
        swept.metrics["doppler_baseband_hz"][1, 1, 1], alone.metrics["doppler_baseband_hz"][1, 0, 0], rtol=1e-5
    )


def test_keys_of_any_kind_make_cases(load_tree) -> None:
    found = record_of(
        load_tree({**TINY, "sweep": {"world.beam.dwell_s": [0.1, 0.2], "precision": ["complex64", "complex128"]}}),
        None,
        2,
    )
    assert (
        found.labels == {"world.beam.dwell_s": (0.1, 0.2), "precision": ("complex64", "complex128")}
        and found.done.all()
    )
    entropy = found.metrics["entropy_nats"]
    assert (np.abs(entropy[:, 0] - entropy[:, 1]) > 0.01).any()


@pytest.mark.slow
def test_the_log_says_what_is_batched(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_picture(monkeypatch)
    config = write_tiny(
        tmp_path, sweep={"world.noise.snr_db": [0.0], "precision": ["complex64", "complex128"], "trials": 1}
    )
    with caplog.at_level(logging.INFO, "torchsar"):
        assert main(["sweep", str(config), "--out", str(tmp_path / "result")]) == 0
    assert "values that share batches: world.noise.snr_db (1); cases of their own: precision (2)" in caplog.text


@pytest.mark.parametrize(
    "sweep, said",
    [
        ({"world.noise.snr": [1.0]}, "world.noise.snr"),
        ({"world.nose.snr_db": [1.0]}, "did you mean 'noise'"),
        ({"world.noise.snr_db": ["loud"]}, "finite numbers"),
        ({"world.velocity_m_s": [-3.0]}, "velocity_m_s"),
        ({"world.noise.snr_db": []}, "has no values"),
        ({"world.noise.snr_db": 3.0}, "must be a list of values"),
        ({"processor.recommended.stages.focus.reference": ["matcht"]}, "matcht"),
        ({"processor.recommended.stages.fokus.reference": ["flat"]}, "did you mean 'focus'"),
        ({"trails": 5}, "did you mean 'trials'"),
        ({"trials": 0}, "sweep.trials"),
        ({"seed": [1, 2]}, "cannot be swept"),
        ({"data.file": ["x"]}, "cannot be swept"),
        ({"world.doppler_hz": [1.0], "world.squint_deg": [1.0]}, "both give the direction of the beam"),
        ({"trials": 2, "success": {"dopler_hz": 1.0}}, "did you mean 'doppler"),
        ({"trials": 2, "show": ["entropy"]}, "did you mean 'entropy_nats'"),
        ({"trials": 2, "save": {"trials": [0], "taps": ["fokus"]}}, "did you mean 'focus'"),
        ({"trials": 2, "stop": {"metric": "entropi_nats", "relative": 0.1}}, "did you mean 'entropy_nats'"),
        ({"world.scene": [{"kind": "points"}]}, "write {label: value"),
    ],
)
def test_mistakes_are_one_sentence(sweep: dict, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_tiny(tmp_path, sweep=sweep)
    assert main(["sweep", str(config), "--out", str(tmp_path / "result")]) == 2
    last = [line for line in capsys.readouterr().err.splitlines() if line.strip()][-1]
    assert last.startswith("torchsar: ") and said in last
    assert not (tmp_path / "result" / "report.html").exists()


def test_a_recording_cannot_be_swept(load_tree, tmp_path: Path) -> None:
    loaded = load_tree({**TINY, "sweep": SWEEP})
    assert sweep_grid(loaded, SweepTrial(loaded)).shape == (2, 2)
    rest = {key: value for key, value in TINY.items() if key not in ("world", "radar")}
    (tmp_path / "raw.npz").touch()
    recorded = load_tree({**rest, "data": {"file": str(tmp_path / "raw.npz")}, "sweep": SWEEP})
    with pytest.raises(ConfigError, match="data.file cannot be used in a sweep"):
        sweep_grid(recorded, SweepTrial(recorded))


def test_titles_and_trials_do_not_stop_a_resume() -> None:
    """Keys that change no result are not part of the identity of a sweep."""
    config = load("isal_snr")
    same = config.changed({"title": "another", "processor.sca.title": "another", "sweep.trials": 3})
    assert identity(config) == identity(same)
    assert identity(config) != identity(config.changed({"world.pulses": 77}))


@pytest.mark.parametrize("what", ["code", "versions"])
def test_a_sweep_does_not_go_on_with_other_programs_unless_told_so(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, load_tree
) -> None:
    """It would mix the results of two versions; a mixed store says so."""
    config = load_tree({**TINY, "sweep": {**SWEEP, "trials": 1}})
    one_picture(monkeypatch)
    sweep_module.sweep(config, tmp_path / "out")
    sweep_module.sweep(config, tmp_path / "out", resume=True)
    now = sweep_module.code()
    changed = {**now, what: {**now[what], "torchsar" if what == "code" else "torch": "other"}}
    monkeypatch.setattr(sweep_module, "code", lambda packages: changed)
    with pytest.raises(ConfigError, match=rf"{what}\.torch\w* was .* and is other; .*--allow-changed"):
        sweep_module.sweep(config, tmp_path / "out", resume=True)
    report = sweep_module.sweep(config.changed({"sweep.trials": 2}), tmp_path / "out", resume=True, allow_changed=True)
    about = read_sweep(tmp_path / "out").about
    assert len(about["changed"]) == 1 and what in about["changed"][0] and about["earlier"][0][what] == now[what]
    assert about["changed"][0].startswith("after ") and "and is other" in report.read_text(encoding="utf-8")


def test_contents_of_files_are_part_of_the_identity(tmp_path: Path) -> None:
    """Another track under the same name is another sweep."""
    track = tmp_path / "track.csv"
    track.write_text("0.0\n1.0\n")
    config = load("path_autofocus")
    named = replace(config, config=config.config.model_copy(update={"world": {"motion": [{"file": str(track)}]}}))
    was = identity(named)
    assert list(was["files"]) == [str(track)] and not identity(config)["files"]
    track.write_text("0.0\n1.5\n")
    assert identity(named)["files"] != was["files"]


def test_the_source_of_random_numbers_is_part_of_the_identity() -> None:
    """That of numpy is not named, so that sweeps recorded before the key go on."""
    config = load("isal_snr")
    assert "random" not in identity(config) and "random" not in identity(config)["config"]
    other = load("isal_snr", ["random=torch"])
    assert identity(other) == {**identity(config), "random": "torch"}
    with pytest.raises(ConfigError, match="'random' cannot be swept"):
        sweep_grid(config.changed({"sweep.grid": {"random": ["numpy", "torch"]}}), SweepTrial(config))


def test_squint_is_the_doppler_of_the_true_velocity(load_tree) -> None:
    tree = {**TINY, "world": {**TINY["world"], "squint_deg": 0.6, "velocity_m_s": 121.0}, "sweep": {"trials": 1}}
    found = record_of(load_tree(tree), 1, 1)
    expected = 2 * 121.0 * np.sin(np.deg2rad(0.6)) / (299792458.0 / 3.2e9)
    name = "doppler_baseband"
    truth = found.metrics[f"{name}_hz"][1, 0] - found.metrics[f"{name}_error_hz"][1, 0]
    assert truth == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("key", ["sweep.world.noise.snr_db", "sweep.grid.world.noise.snr_db"])
def test_the_command_line_reaches_the_grid_and_its_settings(key: str, tmp_path: Path) -> None:
    loaded = load(str(write_tiny(tmp_path, sweep=SWEEP)), [f"{key}=[3.0]", "sweep.trials=9", "sweep.save.trials=[2]"])
    assert loaded.config.sweep.grid["world.noise.snr_db"] == [3.0] and loaded.config.sweep.grid["world.doppler_hz"] == [
        -20.0,
        30.0,
    ]
    assert loaded.config.sweep.trials == 9 and loaded.config.sweep.save.trials == [2]


def test_names_of_errors() -> None:
    assert [error_name(n) for n in ("doppler_hz", "velocity_m_s", "gain")] == [
        "doppler_error_hz",
        "velocity_error_m_s",
        "gain_error",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("precision, tolerance", [("complex64", 1e-5), ("complex128", 1e-12)])
def test_chunks_change_the_stripmap_chain_only_by_rounding(precision: str, tolerance: float) -> None:
    """All metrics of all methods, two noises in one batch or each alone; trials in which a choice
    depends on rounding would be named here, and there are none.
    """
    loaded = load("stripmap_doppler", [*SMALL, "world.lines=400", "world.samples=128", f"precision={precision}"])
    records = {chunk: record_of(loaded, chunk, 1) for chunk in (1, None)}
    assert differences(records[1], records[None], tolerance) == []


@pytest.mark.slow
def test_the_point_estimator_of_the_stripmap_sweep_stands_on_its_bound(load_tree) -> None:
    tree = yaml.safe_load(load("stripmap_doppler", SMALL).text())
    point = {"target": {"kind": "points", "azimuth_m": [0.0], "range_m": [0.0], "random_phase": True}}
    tree["processor"] = {"recommended": tree["processor"]["point"]}
    tree["sweep"] = {"world.scene": {"point": point}, "world.squint_deg": [0.25], "world.noise.snr_db": [-10.0, 10.0]}
    loaded = load_tree(tree)
    record = record_of(loaded, None, 30)
    row = record.algorithms.index("recommended")
    rmse = np.sqrt((record.metrics["doppler_error_hz"][row, 0, 0] ** 2).mean(-1))
    bound = record.bounds["doppler_error_hz"]["Cramer-Rao bound of a point of known position"][0, 0, :, 0]
    assert ((0.7 * bound < rmse) & (rmse < 1.45 * bound)).all()
    assert (rmse < record.bounds["doppler_error_hz"]["1/(T sqrt q), Tsvetkov 2017"][0, 0, :, 0]).all()


def test_a_simulation_that_is_too_large_for_memory_is_halved_as_well(
    monkeypatch: pytest.MonkeyPatch, load_tree: Callable[..., Any]
) -> None:
    bench = Bench(load_tree(TINY), "cpu")
    monkeypatch.setattr(type(bench.system), "simulate", too_large)
    with pytest.raises(MemoryError, match="full"):
        bench.trials(bench.draws(trials=[0, 1]))


def too_large(*_: object) -> None:
    raise MemoryError("full")
