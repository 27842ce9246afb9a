"""Turning targets: what is theirs alone in the frame of all systems, and recordings of them."""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.study.scenes import CORRECT, IMAGE, ISAL, bench_of, loaded_as, run, world, write
from torchsar.cli import main
from torchsar.compensate import Autofocus, Sca
from torchsar.core import Draws, Outcome
from torchsar.focus import TargetImage
from torchsar.io import read_inverse
from torchsar.radar import geometry_of
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.commands.trade import trade
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.text import find_config, read_tree
from torchsar.study.table import load

pytestmark = pytest.mark.usefixtures("blank_pictures")


def metrics_of(folder: Path, *overrides: str, trials: int = 3, **changes: object) -> dict[str, dict[str, float]]:
    """Means over the trials of every method."""
    bench = bench_of(folder, "isal", *overrides, **changes)
    outcomes = bench.batch(Draws(bench.config.seed, "run", range(trials)), detail=True).outcomes
    return {n: {k: float(v.double().mean()) for k, v in o.metrics.items()} for n, o in outcomes.items()}


@pytest.mark.parametrize("case", ["noisy", "lost"])
def test_phases_are_found_in_noise_and_with_lost_pulses(case: str, tmp_path: Path) -> None:
    """Gaps raise side lobes that no phase takes away."""
    lost = {"lost": {"kind": "lost_pulses", "count": 4}}
    changed = {"noisy": world("isal", noise={"snr_db": 5.0}), "lost": world("isal", impairments=lost)}
    found = metrics_of(tmp_path, world=changed[case])
    best, none = found["recommended"], found["none"]
    assert best["residual_phase_rms_rad"] < 0.2
    # lost pulses raise side lobes, by which few points look like clutter: a needless doubt
    assert best["ok"] == (case == "noisy")
    assert best["entropy_above_ideal_nats"] < (0.15 if case == "noisy" else 0.3)
    assert none["residual_phase_rms_rad"] > 1.4 and none["entropy_above_ideal_nats"] > 0.3
    assert best["strehl"] > 0.95 > none["strehl"]


def test_trials_of_a_sweep_do_not_depend_on_their_batch_and_keep_above_bounds(tmp_path: Path) -> None:
    loaded, key = loaded_as(tmp_path, "isal", precision="complex128"), "world.noise.snr_db"
    trial = SweepTrial(loaded)
    records = [sweep(trial, {key: [0.0, 20.0]}, batched=[key], trials=3, seed=3, chunk=chunk) for chunk in (1, 4)]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], atol=1e-9, rtol=0, err_msg=name)
    recommended = records[0].algorithms.index("recommended")
    bounds = {n: np.sqrt((b**2).mean(-1)) for n, b in records[0].bounds["residual_phase_rms_rad"].items()}
    residual = np.sqrt((records[0].metrics["residual_phase_rms_rad"][recommended] ** 2).mean(-1))
    for bound in bounds.values():
        assert (residual > 0.7 * bound).all()  # no estimator knows the truth
    known, unknown = (bounds[name] for name in ("scene known", "amplitudes unknown (Cramer-Rao)"))
    assert (unknown > known).all() and (unknown < 1.3 * known).all()
    np.testing.assert_allclose(known, 1 / np.sqrt(2 * 64 * np.array([1.0, 100.0])), rtol=0.05)


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


@pytest.mark.slow
@pytest.mark.parametrize("made", [yak_like, turntable_like])
def test_injected_phases_are_found_in_recordings(tmp_path: Path, made) -> None:
    tree = read_tree(find_config("autofocus_recorded"))
    methods = {name: tree["processor"][name] for name in ("none", "pga", "recommended")}
    config = tmp_path / "recorded.yaml"
    shorter = {**tree, "cases": {"white": tree["cases"]["white"]}, "processor": methods}
    config.write_text(yaml.safe_dump(shorter, sort_keys=False), encoding="utf-8")
    metrics = run(str(config), tmp_path / "out", f"data.file={made(tmp_path)}", "seed=4")
    best, pga = (metrics["methods"][name]["cases"]["white"] for name in ("recommended", "pga"))
    assert abs(best["entropy_above_clean_nats"]) < 0.01 and best["agreement_rad"] < 0.01 and best["ok"] == 1.0
    assert pga["agreement_rad"] > 0.3
    assert best["residual_phase_rms_rad"] < 0.3


def test_a_stripmap_recording_is_no_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "raw.npz"
    np.savez(path, iq=np.zeros((4, 4, 2)))
    assert main(["run", "autofocus_recorded", f"data.file={path}", "--out", str(tmp_path / "out")]) == 2
    assert "data.file" in capsys.readouterr().err


def test_a_recording_cannot_be_traded(tmp_path: Path) -> None:
    loaded = load("autofocus_recorded", [f"data.file={yak_like(tmp_path)}"])
    with pytest.raises(ConfigError, match="recording"):
        trade(loaded, tmp_path / "trade")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (
            ["cases={white: {data.impairments: {hum: {kind: tone, over_signal_db: 9, frequency_hz: 1e6}}}}"],
            "unknown impairment of range profiles of a target",
        ),
        (["cases={white: {seed: 2}}", "processor.sca={stages: {phase: {stage: sca}}}"], "not an image"),
    ],
)
def test_what_would_mislead_is_refused_of_recordings(
    tmp_path: Path, overrides: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert main(["run", "autofocus_recorded", f"data.file={yak_like(tmp_path)}", *overrides, "--out", str(out)]) == 2
    assert said in capsys.readouterr().err and not out.exists()


def test_a_recording_that_is_not_named_is_asked_for_by_its_kind() -> None:
    with pytest.raises(ConfigError, match="range profile or phase history"):
        load("autofocus_recorded")


def test_all_corrections_of_a_chain_are_judged_together(tmp_path: Path) -> None:
    rest = {"stage": "correct_pulse_phase", "uses": {"phase_rad": "rest"}}
    again = {"phase": {"stage": "sca"}, "correct": CORRECT, "rest": {"stage": "autofocus"}, "remove": rest}
    pga = {"stage": "pga", "kernel": "ml", "uses": {"start": "first.phase_rad"}}
    started = {"first": {"stage": "sca"}, "phase": pga, "correct": {**CORRECT, "in_doubt": "apply"}}
    more = {"again": {"stages": {**again, "image": IMAGE}}, "started": {"stages": {**started, "image": IMAGE}}}
    found = metrics_of(tmp_path, processor={**ISAL["processor"], **more}, precision="complex128")
    error = {name: row["residual_phase_rms_rad"] for name, row in found.items()}
    # the second estimator alone says little of the phase that was put in
    assert error["again"] == pytest.approx(error["recommended"], abs=1e-6)
    assert error["started"] < error["sca"]  # a phase that was only a start is not counted twice


def test_a_run_tells_the_reasons_and_where_doubtful_and_neutral_values_were_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first trial is doubtful, and the second one failed."""
    found = Autofocus.forward
    codes = torch.tensor([Outcome.MISFIT, Outcome.NOISE])
    monkeypatch.setattr(Autofocus, "forward", lambda self, *x, **y: replace(found(self, *x, **y), outcome=codes))
    careful = {"phase": {"stage": "autofocus"}, "correct": {**CORRECT, "in_doubt": "neutral"}, "image": IMAGE}
    config = write(tmp_path, "isal", processor={**ISAL["processor"], "careful": {"stages": careful}})
    tree = run(config, tmp_path / "out", "world.trials=2")
    best, other = tree["methods"]["recommended"], tree["methods"]["careful"]
    assert (
        best["outcomes"]
        == other["outcomes"]
        == {"phase": {code.name: {"trials": 1, "message": code.message} for code in (Outcome.MISFIT, Outcome.NOISE)}}
    )
    assert (best["doubtful"], best["neutral"]) == ({"correct.phase_rad": 1}, {"correct.phase_rad": 1})
    assert (other["doubtful"], other["neutral"]) == ({}, {"correct.phase_rad": 2})
    assert (best["in_doubt"], other["in_doubt"]) == ([], ["correct"])
    entry = best["estimates"]["phase.phase_rad"]
    assert entry["ok"] == [False, False] and entry["outcome"] == ["MISFIT", "NOISE"]
    said = capsys.readouterr().err
    for code in (Outcome.MISFIT, Outcome.NOISE):
        assert f"warning: recommended.phase, not ok in 1 of 2 trials: {code.message}" in said
    report = html.unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    row = '<td>phase</td><td>1 of 2</td><td class="long">{}</td>'
    assert report.count(row.format(Outcome.MISFIT.message)) == 3 <= report.count(row.format(Outcome.NOISE.message))
    assert "<p>Doubtful values were used: correct.phase_rad in 1 of 2 trials.</p>" in report
    assert "the signal was left unchanged: correct.phase_rad in 1 of 2 trials.</p>" in report
    assert "Neutral values also where an estimate is doubtful, in the stages: correct</li>" in report


def test_methods_that_are_not_assessed_have_no_share_of_trials_that_are_ok(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Sca.forward
    codes = Outcome.NOT_ASSESSED.like(torch.zeros(2))
    monkeypatch.setattr(Sca, "forward", lambda self, *x, **y: replace(found(self, *x, **y), outcome=codes))
    methods = run(write(tmp_path, "isal"), tmp_path / "out", "world.trials=2")["methods"]
    assert methods["sca"]["metrics"]["ok"] is None and methods["recommended"]["metrics"]["ok"] == 1
    assert list(methods["sca"]["outcomes"]["phase"]) == ["NOT_ASSESSED"] and not methods["sca"]["neutral"]
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert report.count("Its estimates were not assessed</li>") == 1 and "Estimates that are not ok" not in report


def test_noise_near_the_end_of_float32_leaves_figures(tmp_path: Path) -> None:
    found = metrics_of(tmp_path, "world.noise.snr_db=-400", trials=1)
    assert set(found) == set(ISAL["processor"]) and found["recommended"]["ok"] == 0


def test_an_image_of_other_profiles_leaves_no_operator_behind(tmp_path: Path) -> None:
    recording = read_inverse(turntable_like(tmp_path))
    known = {"frequency_hz": recording.aux["frequency_hz"], "angle_rad": recording.aux["angle_rad"]}
    stage, fresh = (TargetImage(recording.radar, geometry_of(**known)) for _ in range(2))
    with pytest.raises(ValueError, match="crop profiles and geometry to the same samples"):
        stage(recording.signal.isel(range=slice(0, 20)))
    assert stage(recording.signal).axes == fresh(recording.signal).axes
    assert torch.equal(stage(recording.signal).data, fresh(recording.signal).data)
