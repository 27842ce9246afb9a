"""Configs of triangular-sweep ladars: run, sweep, requires and trade."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torchsar.study.case_report import tables
from torchsar.study.config import load
from torchsar.study.registry import CALIBRATIONS, LOG_AMPLITUDES, RADIAL_MOTIONS, SWEEP_ERRORS, SWEEP_FIDELITIES
from torchsar.study.sal.build import Ladar
from torchsar.study.sal.judge import course_of, finer_in_range
from torchsar.study.sal.report import entropy_traps
from torchsar.study.sal.requires import Needs, heed_limits
from torchsar.study.sal.trials import SalTrials, run_batch

from torchsar.cli import main
from torchsar.core import Axis, Draws, Signal
from torchsar.metrics import impulse_response
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems import system_of

WINDOW = [1.0, 2.0]
IMAGE = {
    "compress": {"stage": "compress_sweeps"},
    "deramp": {"stage": "deramp_azimuth"},
    "image": {"stage": "azimuth_matched_filter", "beam_rad": 114e-6},
}
PHASE = {"correct": {"stage": "pulse_phase_correct", "uses": {"phase_rad": "phase"}}}


def method(velocity: dict | None = None, phase: dict | None = None, image: bool = True) -> dict:
    stages = {}
    if velocity is not None:
        stages = {
            "velocity": velocity,
            "compensate": {"stage": "compensate_motion", "uses": {"velocity_m_s": "velocity"}},
        }
    if image:
        polish = {"phase": phase, **PHASE} if phase else {}
        stages |= {"compress": IMAGE["compress"], "deramp": IMAGE["deramp"], **polish, "image": IMAGE["image"]}
    return {"stages": stages}


MIRROR = {"stage": "mirror_product", "window_m": WINDOW}
SEGMENTED = {"stage": "segmented_interference", "window_m": WINDOW}
TINY: dict = {
    "system": "sal",
    "title": "tiny ladar",
    "seed": 2,
    "radar": {
        "wavelength_m": 1.55e-6,
        "bandwidth_hz": 5e9,
        "period_s": 16e-6,
        "sample_rate_hz": 32e6,
        "speed_m_s": 60.0,
        "reference_range_m": 3000.0,
    },
    "world": {
        "periods": 384,
        "scene": {"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [1.5]}},
        "motion": {
            "drift": {"kind": "drift", "velocity_m_s": 0.35, "acceleration_m_s2": 20.0},
            "slow": {"kind": "sinusoid", "frequency_hz": 100.0, "amplitude_m": 160e-6, "phase_deg": 17.0},
        },
        "noise": {"snr_db": 20.0},
    },
    "processor": {
        "ideal": {"input": "clean", **method()},
        "none": method(),
        "segmented": method(SEGMENTED),
        "sca": method(None, {"stage": "sca"}),
        "recommended": method(MIRROR, {"stage": "phase_polish"}),
    },
    "metrics": {
        "reference": "ideal",
        "target": "points.0",
        "published": {"pslr_azimuth_db": {"quiet": {"segmented": -12.49}}},
    },
}


def tree(**changes: object) -> dict:
    return {key: value for key, value in {**TINY, **changes}.items() if value is not None}


def world(**changes: object) -> dict:
    return {**TINY["world"], **changes}


def write(folder: Path, **changes: object) -> str:
    path = folder / "ladar.yaml"
    path.write_text(yaml.safe_dump(tree(**changes), sort_keys=False), encoding="utf-8")
    return str(path)


UNDERAMPED = {"compress": {"stage": "compress_sweeps"}, "image": {"stage": "azimuth_matched_filter"}}


def run(config: str, out: Path, *overrides: str) -> dict:
    assert main(["run", config, *overrides, "--out", str(out)]) == 0
    return json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def test_a_run_compares_methods_over_cases(tmp_path: Path) -> None:
    config = write(tmp_path, cases={"quiet": {"world.noise.snr_db": None}, "dark ends": {"radar.beam_rad": 100e-6}})
    metrics = run(config, tmp_path / "out")
    rows = {name: m["cases"] for name, m in metrics["methods"].items()}
    assert list(rows) == ["ideal", "none", "segmented", "sca", "recommended"]
    for case in ("quiet", "dark ends"):  # where the beam lights nothing, nothing is judged
        assert rows["recommended"][case]["residual_phase_rms_rad"] < 0.06 and rows["recommended"][case]["ok"] == 1.0
        assert rows["none"][case]["residual_phase_rms_rad"] > 50 and "velocity_rmse_m_s" not in rows["none"][case]
        assert rows["recommended"][case]["velocity_rmse_m_s"] < 1e-3
    quiet = {name: row["quiet"] for name, row in rows.items()}
    for name in ("ideal", "segmented", "recommended"):
        assert quiet[name]["irw_azimuth_m"] == pytest.approx(0.0060, rel=0.02) and quiet[name][
            "pslr_azimuth_db"
        ] == pytest.approx(-13.26, abs=0.15)
        assert quiet[name]["irw_range_m"] == pytest.approx(0.0266, rel=0.01) and quiet[name][
            "pslr_range_db"
        ] == pytest.approx(-13.26, abs=0.1)
    assert quiet["segmented"]["range_error_max_m"] < 2e-8
    assert (
        quiet["recommended"]["entropy_above_ideal_nats"] < 0.02 < quiet["sca"]["entropy_above_ideal_nats"]
    )  # SCA leaves the envelopes where motion took them
    assert set(metrics["methods"]["segmented"]["targets"]) == {"quiet/points.0", "dark ends/points.0"}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "quiet, published" in page and "-12.49" in page
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 4 + 2 * 4


def record(told: bool = True) -> dict:
    """A record of a real detector, its triangle starting 3 us into blocks of 20 us every second
    period.
    """
    return {
        "radar": {**TINY["radar"], "sample_rate_hz": 64e6, "keep_every": 2, "detection": "real"},
        "world": world(
            periods=192, fidelity={"kind": "every_sample"}, record={"trigger_s": 3e-6, "block_s": 20e-6, "told": told}
        ),
        "processor": {
            "recommended": {
                "stages": {
                    "split": {"stage": "split_sweeps", "trigger": "recorded", "uses": {"trigger_s": "aux.trigger_s"}},
                    **method(MIRROR)["stages"],
                }
            }
        },
        "metrics": {"target": "points.0"},
    }


def test_a_continuous_record_is_split_and_judged_at_its_own_epochs(tmp_path: Path) -> None:
    row = run(write(tmp_path, **record()), tmp_path / "out")["methods"]["recommended"]["metrics"]
    assert row["velocity_rmse_m_s"] < 1e-3 and row["range_error_max_m"] < 2e-7


def test_a_trigger_that_is_not_told_is_missed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **record(told=False)), "--out", str(tmp_path / "out")]) == 2
    assert "aux.trigger_s" in capsys.readouterr().err


def test_trials_of_a_sweep_do_not_depend_on_their_batch_and_keep_above_bounds(tmp_path: Path) -> None:
    alone = {
        name: method(stage, image=False)
        for name, stage in {
            "segmented": SEGMENTED,
            "ml_peak": {"stage": "ml_peak", "window_m": WINDOW},
            "recommended": MIRROR,
        }.items()
    }
    config = write(
        tmp_path, processor=alone, metrics=None, precision="complex128", world=world(periods=96, noise={"snr_db": 10.0})
    )
    trial = SalTrials(load(config))
    records = [
        sweep(
            trial, {"world.noise.snr_db": [10.0, 20.0]}, batched=["world.noise.snr_db"], trials=4, seed=3, chunk=chunk
        )
        for chunk in (1, 8)
    ]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], rtol=1e-6, atol=1e-12, err_msg=name)
    bounds = {name: bound.mean(-1) for name, bound in records[0].bounds["velocity_rmse_m_s"].items()}
    error = {
        name: np.sqrt((records[0].metrics["velocity_rmse_m_s"][i] ** 2).mean(-1))
        for i, name in enumerate(records[0].algorithms)
    }
    for name, bound in {
        "segmented": "segmented interference",
        "ml_peak": "unknown offsets",
        "recommended": "known offset",
    }.items():
        assert (error[name] > 0.85 * bounds[bound]).all() and (error[name] < 1.3 * bounds[bound]).all(), name
    np.testing.assert_allclose(
        bounds["unknown offsets"], 775e-9 * np.sqrt(3 / (256 * np.array([10.0, 100.0]))) / (2 * np.pi * 8e-6), rtol=1e-3
    )


def test_a_sweep_by_command(tmp_path: Path) -> None:
    grid = {"world.motion.drift.velocity_m_s": [0.1, 3.0], "trials": 2, "success": {"velocity_rmse_m_s": 0.002}}
    config = write(
        tmp_path,
        world=world(periods=64),
        processor={"recommended": method(MIRROR, image=False)},
        metrics=None,
        sweep=grid,
    )
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 0
    points = json.loads((tmp_path / "sweep" / "summary.json").read_text(encoding="utf-8"))["points"]
    assert [p["success_share"] for p in points if p["metric"] == "velocity_rmse_m_s"] == [1.0, 1.0]


def test_phases_of_pulses_count_modulo_a_turn_and_velocities_as_they_are() -> None:
    loaded = load("sal_points", ["cases={}", "world.periods=64", "world.noise.snr_db=null"])
    bench = SalTrials(loaded).bench({})
    batch = run_batch(bench, Draws(1, "test", [0]))
    # 30 turns from pulse to pulse are none to it
    assert float(batch.metrics["sca"]["residual_phase_rms_rad"]) < 0.1
    assert float(batch.metrics["none"]["residual_phase_rms_rad"]) > 5
    assert float(batch.metrics["ideal"]["range_error_max_m"]) == 0
    recording, truth = bench.ladar.recorded(Draws(1, "test", [0]))
    chain = bench.chains["recommended"]
    trace = chain.trace(
        recording,
        given={
            "motion.velocity_m_s": truth.values["velocity_m_s"] + 1e-3,
            "motion.phase_rad": torch.zeros(1, 64, dtype=torch.float64),
        },
    )
    course = course_of(chain, trace, truth, bench.ladar.radar, clean=False)
    assert course.velocity_error_m_s is not None
    assert float(course.rms(course.velocity_error_m_s)) == pytest.approx(1e-3)
    assert float(course.largest_m) == pytest.approx(63 * 16e-9, rel=1e-3) and float(course.slope_m_s) == pytest.approx(
        1e-3, rel=1e-3
    )
    assert float(course.rms(course.detrended_m)) < 1e-10


def test_slices_of_a_band_without_guard_are_read_on_half_the_step() -> None:
    u = (torch.arange(64, dtype=torch.float64) - 31.5) / 64
    cells = torch.arange(-32, 32, dtype=torch.float64)
    profile = torch.exp(2j * torch.pi * (4.3 - cells[:, None]) * u).mean(-1)
    image = Signal(
        torch.sinc((torch.arange(64, dtype=torch.float64) - 32) / 5)[:, None] * profile,
        (Axis("azimuth", 64, -32.0, 1.0, "m"), Axis("range", 64, -32.0, 1.0, "m")),
    )
    fine = finer_in_range(image)
    torch.testing.assert_close(fine.data[:, ::2], image.data)
    at = torch.arange(-64, 64, dtype=torch.float64)[:, None] / 2
    torch.testing.assert_close(fine.data[32], torch.exp(2j * torch.pi * (4.3 - at) * u).mean(-1))
    assert float(impulse_response(fine, (0.0, 4.3))["pslr_range_db"]) == pytest.approx(-13.26, abs=0.05)


def test_requires_names_limits_and_simplifications(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["requires", write(tmp_path), "--out", str(tmp_path / "needs")]) == 0
    said = capsys.readouterr().out
    assert (
        "acceleration of the gradient" in said
        and "one range per sweep" in said
        and "the simplest echo model that this scene allows" in said
    )
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["ladar"]
    limit = next(row for row in needs["limits"] if row["name"] == "acceleration of the gradient")
    assert limit["limit"] == pytest.approx(1.55e-6 / (4 * 8e-6 * 16e-6)) and limit["verdict"] == "ok"
    phase = np.deg2rad(17) + 2 * np.pi * 100 * np.linspace(0, 384 * 16e-6, 1000)
    assert limit["value"] == pytest.approx(np.abs(20 - 160e-6 * (2 * np.pi * 100) ** 2 * np.sin(phase)).max(), rel=0.01)


def test_limits_refuse_before_anything_is_computed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dense = {"scene": {"row": {"kind": "points", "azimuth_m": [0.0, 0.02], "range_m": [1.5, 1.55]}}}
    methods = {"segmented": method(SEGMENTED), "recommended": TINY["processor"]["recommended"]}
    config = write(tmp_path, world=world(**dense), processor=methods, metrics=None)
    assert main(["run", config, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert (
        "processor.segmented: spacing of scatterers is 0.05 m, and must be at least 0.05996 m" in said
        and "beyond_limits" in said
    )
    heed_limits(load(config, ["beyond_limits=[segmented]"]), "")
    config = write(tmp_path, world=world(noise={"snr_db": -15.0}), processor=methods, metrics=None)
    assert main(["run", config, "--out", str(tmp_path / "more")]) == 2
    assert "processor.segmented: SNR after compression" in capsys.readouterr().err
    heed_limits(load(config, ["processor.segmented.stages.velocity.unwrap=per_pulse"]), "")


def test_trade_sets_echoes_methods_settings_and_precisions_side_by_side(tmp_path: Path) -> None:
    small = world(periods=64, fidelity={"kind": "linear_in_sweep"})
    methods = {name: TINY["processor"][name] for name in ("ideal", "none", "recommended")}
    assert (
        main(
            [
                "trade",
                write(tmp_path, world=small, processor=methods, trade={"trials": 1, "repeats": 1}),
                "--out",
                str(tmp_path / "trade"),
            ]
        )
        == 0
    )
    found = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    assert [r["name"] for r in found["methods"]] == ["none", "recommended"]
    echo = {r["name"]: r for r in found["echo"]}
    assert echo["every_sample"]["echo_error_db"] is None or echo["every_sample"]["echo_error_db"] < -300
    assert echo["quadratic_in_sweep"]["echo_error_db"] < echo["linear_in_sweep"]["echo_error_db"] < -40
    assert (
        echo["one_per_sweep"]["velocity_rmse_m_s"] > 100 * echo["linear_in_sweep"]["velocity_rmse_m_s"]
    )  # velocity is invisible there
    settings = {r["name"]: r["velocity_rmse_m_s"] for r in found["settings"]}
    assert settings["correlation, upsampling 20"] < settings["correlation, upsampling 1"]
    assert len(list((tmp_path / "trade" / "figures").glob("*.png"))) == 4


def test_the_entropy_trap_is_a_sentence_of_the_report() -> None:
    row = {"entropy_nats": 6.5, "residual_phase_rms_rad": 4.5}
    methods = {
        "ideal": {"cases": {"equal": {"entropy_nats": 7.4, "residual_phase_rms_rad": 0.0}}},
        "wrong": {"cases": {"equal": row}},
    }
    metrics = {"methods": methods, "definitions": {"reference": "ideal"}}
    (note,) = entropy_traps(metrics)
    assert "6.50 nats with 4.5 rad" in note["text"] and "7.40" in note["text"]
    row["residual_phase_rms_rad"] = 0.1
    assert not entropy_traps(metrics)
    found = tables(
        {"methods": methods}, {"entropy_nats": ("entropy", "nats", 2)}, {"entropy_nats": {"equal": {"wrong": 11.35}}}
    )
    assert found[0]["published"] == [{"case": "equal", "cells": ["–", "11.35"]}]


@pytest.mark.parametrize(
    "catalogue", [RADIAL_MOTIONS, LOG_AMPLITUDES, SWEEP_FIDELITIES, SWEEP_ERRORS, CALIBRATIONS], ids=lambda c: c.what
)
def test_every_entry_has_keys_that_yaml_can_hold(catalogue) -> None:
    for name in catalogue.entries:
        assert catalogue.model(name).model_fields is not None


def test_everything_that_a_world_may_hold_is_built(tmp_path: Path) -> None:
    track = tmp_path / "track.csv"
    track.write_text("time_s,displacement_m\n" + "\n".join(f"{t:.6f},{1e-3 * t:.9f}" for t in np.arange(0, 0.02, 1e-4)))
    motion = {
        "air": {"kind": "path_fluctuation", "rms_m": 1e-6},
        "hum": {"kind": "vibration_spectrum", "rms_m": 1e-7, "lowest_hz": 50.0, "highest_hz": 500.0},
        "told": {"kind": "measured_track", "file": str(track)},
    }
    errors = {"kind": "sinusoid", "amplitude_hz": 1e6, "frequency_hz": 5e4}
    full = world(
        motion=motion,
        log_amplitude={"kind": "scintillation", "rms": 0.1},
        sweep_error=errors,
        calibration={"kind": "fibre", "delay_s": 5e-8},
        gate_m=[1.0, 2.0],
        impairments={"adc": {"kind": "quantiser", "bits": 8}},
    )
    chain = {
        "calibrate": {
            "stage": "calibrate_sweeps",
            "uses": {"calibration": "aux.calibration", "delay_s": "aux.calibration_delay_s"},
        },
        **method(MIRROR)["stages"],
    }
    metrics = run(
        write(tmp_path, world=full, processor={"recommended": {"stages": chain}}, metrics=None), tmp_path / "out"
    )
    assert metrics["methods"]["recommended"]["metrics"]["velocity_rmse_m_s"] < 1e-3
    # what was resolved can be run again
    again = run(str(tmp_path / "out" / "config.yaml"), tmp_path / "again")
    assert (
        again["methods"]["recommended"]["metrics"]["entropy_nats"]
        == metrics["methods"]["recommended"]["metrics"]["entropy_nats"]
    )


def test_a_carrier_may_be_given_as_a_wavelength(tmp_path: Path) -> None:
    by_length = Ladar.of(load(write(tmp_path))).radar
    by_carrier = Ladar.of(
        load(
            write(
                tmp_path,
                radar={
                    **{k: v for k, v in TINY["radar"].items() if k != "wavelength_m"},
                    "carrier_hz": by_length.carrier_hz,
                },
            )
        )
    ).radar
    assert by_carrier == by_length and by_length.wavelength_m == pytest.approx(1.55e-6, rel=1e-15)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radar": {**TINY["radar"], "carrier_hz": 2e14}}, "wavelength_m and carrier_hz say the same"),
        ({"radar": {**TINY["radar"], "sample_rate_hz": 33.3e6}}, "makes it a whole number"),
        (
            {"world": world(motion={"drift": {"kind": "drift", "velocity_m_s": 30.0}})},
            "speed in the beat band is 30 m/s",
        ),
        ({"world": world(gate_m=[3.0, 4.0])}, "no scatterer"),
        ({"world": world(motion={"told": {"kind": "measured_track", "file": "nowhere.csv"}})}, "world.motion.told"),
        ({"world": world(fidelity={"kind": "phase_only"})}, "unknown fidelity of a sweep 'phase_only'"),
        ({"metrics": {"target": "points.1"}}, "metrics.target names 'points.1', which is no point target"),
        ({"metrics": {"reference": "none"}}, "name a method with 'input: clean'"),
        ({"beyond_limits": ["segmentd"]}, "beyond_limits names the method 'segmentd'"),
        (
            {"processor": {"recommended": method(MIRROR, image=False)}, "metrics": None},
            "processor.recommended, whose last stage gives the axes ('ramp', 'pulse', 'fast_time'), not an image",
        ),
        (
            {"processor": {"recommended": {"stages": {"image": {"stage": "azimuth_transform"}}}}, "metrics": None},
            "processor.recommended",
        ),
        (
            {"processor": {"recommended": {"stages": {"image": {"stage": "target_image"}}}}, "metrics": None},
            "processor.recommended",
        ),
        ({"cases": {"odd": {"world.trials": 3}}}, "cases.odd: the key 'world.trials' holds for all cases"),
        (
            {"radar": {key: value for key, value in TINY["radar"].items() if key != "wavelength_m"}},
            "neither wavelength_m nor carrier_hz is given",
        ),
        ({"world": world(noise={"snr_db": 4000.0})}, "world.noise.snr_db is 4000, beyond what numbers hold"),
        ({"world": world(gate_m=[3.0])}, "it should be a list of at least 2 entries"),
        (
            {"world": world(motion={"drift": {"kind": "drift", "velocity_m_s": float("nan")}})},
            "it should be a finite number",
        ),
        (
            {"world": world(scene={"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [-4000.0]}})},
            "lies behind the ladar",
        ),
        (
            {"world": world(scene={"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [100.0]}})},
            "beats of relative ranges beyond",
        ),
        (
            {"processor": {"recommended": {"stages": UNDERAMPED}}, "metrics": None},
            "works on profiles deramped once, here 0 times",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_recordings_and_cases_of_sweeps_are_refused(tmp_path: Path) -> None:
    loaded = load(write(tmp_path), [f"data.file={__file__}"])
    for command in (system_of(loaded).requires, system_of(loaded).trade):
        with pytest.raises(ConfigError, match="reads no recordings"):
            command(loaded, None)
    with pytest.raises(ConfigError, match="cases belong to runs"):
        SalTrials(load(write(tmp_path, cases={"quiet": {"world.noise.snr_db": 40.0}}))).check({})


def test_bounds_of_a_motion_come_from_its_course(tmp_path: Path) -> None:
    needs = Needs.of(
        load(
            write(
                tmp_path,
                world=world(motion={"buzz": {"kind": "sinusoid", "frequency_hz": 5000.0, "amplitude_m": 10e-6}}),
            )
        )
    )
    bias = next(limit for limit in needs.limits if limit.name == "velocity bias by jerk")
    assert (
        bias.value == pytest.approx(10e-6 * (2 * np.pi * 5000) ** 3 * (16e-6) ** 2 / 27, rel=0.02)
        and bias.verdict == "warn"
    )


def test_errors_of_a_world_name_the_file_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write(tmp_path, world=world(log_amplitude={"kind": "scintillation", "rms": -1.0}))
    assert main(["run", config, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count(config) == 1 and "world.log_amplitude: rms" in said


def test_metrics_of_a_method_are_those_of_the_first_case(tmp_path: Path) -> None:
    cases = {"still": {"world.motion": {}}, "moving": {"world.noise.snr_db": 20.0}}
    metrics = run(write(tmp_path, cases=cases, world=world(periods=48)), tmp_path / "out")
    for method in metrics["methods"].values():
        assert method["metrics"] == {
            key: value for key, value in method["cases"]["still"].items() if not key.endswith("_sd")
        }
    assert "first case, 'still'" in metrics["definitions"]["metrics"]
    assert "the first case" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "changes",
    [
        {"world": world(periods=1)},
        {"radar": {**TINY["radar"], "beam_rad": 1e-9}},
        {"radar": {**TINY["radar"], "keep_every": 1000000}, "world": world(periods=2, motion={})},
    ],
)
def test_next_to_nothing_to_see_ends_in_a_report_or_a_sentence(tmp_path: Path, changes: dict) -> None:
    code = main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")])
    assert code == 2 or "NaN" not in (tmp_path / "out" / "metrics.json").read_text(encoding="utf-8")


def test_a_real_detector_without_a_record_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run(write(tmp_path, radar={**TINY["radar"], "detection": "real"}, world=world(periods=32)), tmp_path / "out")
    assert "separated sweeps are complex" in caplog.text
