"""Triangular-sweep ladars: what is theirs alone in the frame of all systems."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.study.scenes import (
    MIRROR,
    SAL,
    SEGMENTED,
    WINDOW,
    bench_of,
    ladar_method,
    loaded_as,
    radar,
    run,
    world,
    write,
)
from torchsar.cli import main
from torchsar.core import Axis, Draws, Signal
from torchsar.metrics import impulse_response
from torchsar.study.commands import run as command
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.montecarlo import sweep
from torchsar.study.names.registry import (
    CALIBRATIONS,
    LOG_AMPLITUDES,
    RADIAL_MOTIONS,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
)
from torchsar.study.systems.sal.judge import course_of, finer_in_range
from torchsar.study.table import load, systems
from torchsar.study.trials.bench import Bench

pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.mark.slow
def test_methods_reach_the_figures_of_a_point_also_where_the_beam_is_dark(tmp_path: Path) -> None:
    for changes in ({"world": world("sal", noise={"snr_db": None})}, {"radar": radar("sal", beam_rad=100e-6)}):
        bench = bench_of(tmp_path, "sal", **changes)
        batch = bench.batch(Draws(2, "run", [0]), detail=True)
        found = {n: {k: float(v[0]) for k, v in o.metrics.items()} for n, o in batch.outcomes.items()}
        best, none = found["recommended"], found["none"]
        assert best["residual_phase_rms_rad"] < 0.06 and best["velocity_rmse_m_s"] < 1e-3
        assert best["ok"] == ("world" in changes)  # phases of pulses that do not see the point are not known
        assert none["residual_phase_rms_rad"] > 50 and "velocity_rmse_m_s" not in none
        if "world" not in changes:
            continue
        for name in ("ideal", "segmented", "recommended"):
            assert found[name]["irw_azimuth_m"] == pytest.approx(0.0060, rel=0.02)
            assert found[name]["pslr_azimuth_db"] == pytest.approx(-13.26, abs=0.15)
            assert found[name]["irw_range_m"] == pytest.approx(0.0266, rel=0.01)
            assert found[name]["pslr_range_db"] == pytest.approx(-13.26, abs=0.1)
        assert found["segmented"]["range_error_max_m"] < 2e-8 and set(batch.outcomes["segmented"].judged.targets)
        # the spatial correlation leaves the envelopes where motion took them
        assert best["entropy_above_ideal_nats"] < 0.02 < found["sca"]["entropy_above_ideal_nats"]


@pytest.mark.parametrize("known", [True, False])
def test_a_continuous_record_is_split_by_the_trigger_that_it_tells(known: bool, tmp_path: Path) -> None:
    """A real detector's record, its triangle 3 us into blocks of 20 us every second period."""
    record = {"trigger_s": 3e-6, "block_s": 20e-6, "trigger_known": known}
    split = {"stage": "split_sweeps", "trigger": "recorded", "uses": {"trigger_s": "aux.trigger_s"}}
    changes = {
        "radar": radar("sal", sample_rate_hz=64e6, keep_every=2, detection="real"),
        "world": world("sal", periods=192, fidelity={"kind": "every_sample"}, record=record),
        "processor": {"recommended": {"stages": {"split": split, **ladar_method(MIRROR)["stages"]}}},
        "metrics": {"target": "points.0"},
    }
    bench = bench_of(tmp_path, "sal", **changes)
    if not known:
        with pytest.raises(ValueError, match=r"aux\.trigger_s"):
            bench.batch(Draws(2, "run", [0]), detail=True)
        return
    row = bench.batch(Draws(2, "run", [0]), detail=True).outcomes["recommended"].metrics
    assert float(row["velocity_rmse_m_s"]) < 1e-3 and float(row["range_error_max_m"]) < 2e-7


@pytest.mark.slow
def test_trials_of_a_sweep_do_not_depend_on_their_batch_and_keep_above_bounds(tmp_path: Path) -> None:
    stages = {"segmented": SEGMENTED, "ml_peak": {"stage": "ml_peak", "window_m": WINDOW}, "recommended": MIRROR}
    alone = {name: ladar_method(stage, image=False) for name, stage in stages.items()}
    changed = {"processor": alone, "metrics": None, "precision": "complex128", "world": world("sal", periods=96)}
    trial, key = SweepTrial(loaded_as(tmp_path, "sal", **changed)), "world.noise.snr_db"
    records = [sweep(trial, {key: [10.0, 20.0]}, batched=[key], trials=4, seed=3, chunk=chunk) for chunk in (1, 8)]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], rtol=1e-6, atol=1e-12, err_msg=name)
    bounds = {name: bound.mean(-1) for name, bound in records[0].bounds["velocity_rmse_m_s"].items()}
    rms = np.sqrt((records[0].metrics["velocity_rmse_m_s"] ** 2).mean(-1))
    for i, name in enumerate(("segmented interference", "unknown offsets", "known offset")):
        assert (rms[i] > 0.85 * bounds[name]).all() and (rms[i] < 1.3 * bounds[name]).all(), name
    expected = 775e-9 * np.sqrt(3 / (256 * np.array([10.0, 100.0]))) / (2 * np.pi * 8e-6)
    np.testing.assert_allclose(bounds["unknown offsets"], expected, rtol=1e-3)


def test_phases_of_pulses_count_modulo_a_turn_and_velocities_as_they_are() -> None:
    bench = Bench(load("sal_points", ["cases={}", "world.periods=64", "world.noise.snr_db=null"]))
    draws = Draws(1, "test", [0])
    found = bench.batch(draws, methods=["ideal", "none", "sca"]).outcomes
    # 30 turns from pulse to pulse are none to it
    assert float(found["sca"].metrics["residual_phase_rms_rad"]) < 0.1
    assert float(found["none"].metrics["residual_phase_rms_rad"]) > 5
    assert float(found["ideal"].metrics["range_error_max_m"]) == 0
    trials, chain = bench.trials(draws), bench.chains["recommended"]
    held = {
        "motion.velocity_m_s": trials.truth["velocity_m_s"] + 1e-3,
        "motion.phase_rad": torch.zeros(1, 64, dtype=torch.float64),
    }
    trace = chain.trace(trials.recording, given=held)
    course = course_of(chain, trace, trials.truth, bench.radar, clean=False)
    assert course.velocity_error_m_s is not None
    assert float(course.rms(course.velocity_error_m_s)) == pytest.approx(1e-3)
    assert float(course.largest_m) == pytest.approx(63 * 16e-9, rel=1e-3)
    assert float(course.slope_m_s) == pytest.approx(1e-3, rel=1e-3)
    assert float(course.rms(course.detrended_m)) < 1e-10


def test_slices_of_a_band_without_guard_are_read_on_half_the_step() -> None:
    u = (torch.arange(64, dtype=torch.float64) - 31.5) / 64
    cells = torch.arange(-32, 32, dtype=torch.float64)
    profile = torch.exp(2j * torch.pi * (4.3 - cells[:, None]) * u).mean(-1)
    along = torch.sinc((torch.arange(64, dtype=torch.float64) - 32) / 5)
    axes = (Axis("azimuth", 64, -32.0, 1.0, "m"), Axis("range", 64, -32.0, 1.0, "m"))
    image = Signal(along[:, None] * profile, axes)
    fine = finer_in_range(image)
    torch.testing.assert_close(fine.data[:, ::2], image.data)
    at = torch.arange(-64, 64, dtype=torch.float64)[:, None] / 2
    torch.testing.assert_close(fine.data[32], torch.exp(2j * torch.pi * (4.3 - at) * u).mean(-1))
    assert float(impulse_response(fine, (0.0, 4.3))["pslr_range_db"]) == pytest.approx(-13.26, abs=0.05)


def test_the_entropy_trap_is_a_sentence_of_the_report() -> None:
    row = {"entropy_nats": 6.5, "residual_phase_rms_rad": 4.5}
    ideal = {"cases": {"equal": {"entropy_nats": 7.4, "residual_phase_rms_rad": 0.0}}}
    metrics = {"methods": {"ideal": ideal, "wrong": {"cases": {"equal": row}}}, "definitions": {"reference": "ideal"}}
    ((title, text),) = systems["sal"].notes(metrics)
    assert "equal" in title and "6.50 nats with 4.5 rad" in text and "7.40" in text
    row["residual_phase_rms_rad"] = 0.1
    assert not list(systems["sal"].notes(metrics))


CATALOGUES = (RADIAL_MOTIONS, LOG_AMPLITUDES, SWEEP_FIDELITIES, SWEEP_ERRORS, CALIBRATIONS)


@pytest.mark.parametrize("catalogue", CATALOGUES, ids=lambda catalogue: catalogue.what)
def test_every_entry_has_keys_that_yaml_can_hold(catalogue) -> None:
    for section in catalogue.sections.values():
        assert section.keys is not None and section.model.model_fields is not None


def test_everything_that_a_world_may_hold_is_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "draw_all", lambda *_, **__: [])
    track = tmp_path / "track.csv"
    rows = "\n".join(f"{t:.6f},{1e-3 * t:.9f}" for t in np.arange(0, 0.02, 1e-4))
    track.write_text(f"time_s,displacement_m\n{rows}")
    motion = {
        "air": {"kind": "path_fluctuation", "rms_m": 1e-6},
        "hum": {"kind": "vibration_spectrum", "rms_m": 1e-7, "lowest_hz": 50.0, "highest_hz": 500.0},
        "track": {"kind": "measured_track", "file": str(track)},
    }
    full = world(
        "sal",
        motion=motion,
        log_amplitude={"kind": "log_amplitude", "rms": 0.1},
        sweep_error={"kind": "sinusoid_sweep_error", "amplitude_hz": 1e6, "frequency_hz": 5e4},
        calibration={"kind": "calibration_fibre", "delay_s": 5e-8},
        gate_m=[1.0, 2.0],
        impairments={"adc": {"kind": "quantiser", "bits": 8}},
    )
    known = {"calibration": "aux.calibration", "delay_s": "aux.calibration_delay_s"}
    chain = {"calibrate": {"stage": "calibrate_sweeps", "uses": known}, **ladar_method(MIRROR)["stages"]}
    processor = {"recommended": {"stages": chain}}
    metrics = run(write(tmp_path, "sal", world=full, processor=processor, metrics=None), tmp_path / "out")
    assert metrics["methods"]["recommended"]["metrics"]["velocity_rmse_m_s"] < 1e-3
    again = Bench(load(tmp_path / "out" / "config.yaml")).batch(Draws(2, "run", [0])).outcomes["recommended"]
    entropy = metrics["methods"]["recommended"]["metrics"]["entropy_nats"]
    assert float(again.metrics["entropy_nats"]) == pytest.approx(entropy, rel=1e-6)


def test_a_carrier_may_be_given_as_a_wavelength(tmp_path: Path) -> None:
    by_length = bench_of(tmp_path, "sal").radar
    changed = radar("sal", wavelength_m=None, carrier_hz=by_length.carrier_hz)
    assert bench_of(tmp_path, "sal", radar=changed).radar == by_length
    assert by_length.wavelength_m == pytest.approx(1.55e-6, rel=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"world": world("sal", periods=1)},
        {"radar": radar("sal", beam_rad=1e-9)},
        {"radar": radar("sal", keep_every=1000000), "world": world("sal", periods=2, motion={})},
    ],
)
def test_next_to_nothing_to_see_ends_in_a_report_or_a_sentence(tmp_path: Path, changes: dict) -> None:
    few = {name: SAL["processor"][name] for name in ("ideal", "recommended")}
    config = write(tmp_path, "sal", processor=few, **changes)
    code = main(["run", config, "--out", str(tmp_path / "out")])
    assert code == 2 or "NaN" not in (tmp_path / "out" / "metrics.json").read_text(encoding="utf-8")


def test_a_real_detector_without_a_record_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bench_of(tmp_path, "sal", radar=radar("sal", detection="real"))
    assert "separated sweeps are complex" in caplog.text


def test_a_point_outside_the_image_is_named(tmp_path: Path) -> None:
    two = {"points": {"kind": "points", "azimuth_m": [0.0, 0.4], "range_m": [1.5, 1.5]}}
    few = {"recommended": ladar_method(MIRROR)}
    bench = bench_of(tmp_path, "sal", world=world("sal", scene=two), processor=few, metrics={})
    judged = bench.batch(Draws(2, "run", [0]), detail=True).outcomes["recommended"].judged
    assert list(judged.outside) == ["points.1"] and set(judged.targets) == {"points.0"}
