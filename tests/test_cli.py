"""The command line, as a user meets it."""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import mind_interrupts
from tests.study.tiny import write_tiny
from torchsar.cli import main


def spoken(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capsys.readouterr().err.splitlines() if line.strip()]


def test_list_names_experiments_stages_and_data_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    text = capsys.readouterr().out
    for name in ("stripmap_damaged", "radarsat1", "omega_k", "doppler_centroid", "points", "dwell", "chirp_rate_hz_s"):
        assert name in text


def test_run_prints_where_the_report_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "result"
    assert main(["run", str(write_tiny(tmp_path)), "world.noise.snr_db=30", "seed=5", "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out / "report.html")
    assert "snr_db: 30" in (out / "config.yaml").read_text()
    assert "seed: 5" in (out / "config.yaml").read_text()


@pytest.mark.parametrize("extra", [["--out", "{out}", "seed=5"], ["seed=5", "--out", "{out}"]])
def test_options_may_stand_before_or_after_overrides(tmp_path: Path, extra: list[str]) -> None:
    out = tmp_path / "result"
    assert main(["run", str(write_tiny(tmp_path)), *(e.format(out=out) for e in extra)]) == 0
    assert "seed: 5" in (out / "config.yaml").read_text()


@pytest.mark.parametrize("command", ["run", "requires", "trade"])
def test_a_mistake_is_one_sentence_and_status_two(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result"
    assert main([command, str(write_tiny(tmp_path)), "radar.prf=3", "--out", str(out)]) == 2
    lines = spoken(capsys)
    assert len(lines) == 1 and lines[0].startswith("torchsar: ") and "radar.prf" in lines[0] and "prf_hz" in lines[0]
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


def recording(path: Path, **changes: object) -> Path:
    rng = np.random.default_rng(1)
    arrays: dict = {
        "iq": rng.normal(size=(96, 160, 2)).astype(np.float32),
        "fs_hz": 50e6,
        "prf_hz": 400.0,
        "f0_hz": 3.2e9,
        "chirp_rate_hz_s": 80e12,
        "pulse_s": 0.5e-6,
        "slant_range_cell1_m": 4000.0,
        "v_eff_m_s": 120.0,
    }
    np.savez(path, **{key: value for key, value in {**arrays, **changes}.items() if value is not None})
    return path


FOCUS = {"recommended": {"stages": {"focus": {"stage": "omega_k"}}}}


def test_own_recording_runs(tmp_path: Path) -> None:
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor=FOCUS)
    assert (
        main(["run", str(config), f"data.file={recording(tmp_path / 'raw.npz')}", "--out", str(tmp_path / "result")])
        == 0
    )
    assert (
        "entropy_nats"
        in json.loads((tmp_path / "result" / "metrics.json").read_text())["methods"]["recommended"]["metrics"]
    )


@pytest.mark.parametrize(
    "changes, expected",
    [
        ({"prf_hz": None}, ["raw.npz", "prf_hz"]),
        ({"iq": np.full((96, 160, 2), np.nan, np.float32)}, ["raw.npz", "NaN"]),
        ({"iq": np.zeros((96, 160), np.float32)}, ["raw.npz", "iq"]),
        ({"agc_db": np.zeros(5)}, ["agc_db", "96 lines"]),
        ({"line_number": np.zeros((2, 96), int)}, ["raw.npz", "line_number", "(2, 96)"]),
    ],
)
def test_bad_recordings_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict, expected: list[str]
) -> None:
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor=FOCUS)
    file = recording(tmp_path / "raw.npz", **changes)
    assert main(["run", str(config), f"data.file={file}", "--out", str(tmp_path / "result")]) == 2
    last = spoken(capsys)[-1]
    for part in ("data.file", *expected):
        assert part in last
    assert sorted(path.name for path in tmp_path.iterdir()) == ["raw.npz", "tiny.yaml"]


@pytest.mark.parametrize(
    "changes, expected",
    [
        (
            {"iq": np.concatenate([np.ones((90, 160, 2), np.float32), np.zeros((6, 160, 2), np.float32)])},
            ["raw.npz", "6 of 96 lines hold only zeros", "line 90"],
        ),
        ({"pilot": np.zeros(4096, np.complex64)}, ["recommended", "'pilot' found nothing to trust"]),
    ],
)
def test_doubtful_recordings_are_named_in_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict, expected: list[str]
) -> None:
    stages = {
        **({"pilot": {"stage": "jitter_pilot", "uses": {"pilot": "aux.pilot"}}} if "pilot" in changes else {}),
        **FOCUS["recommended"]["stages"],
    }
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor={"recommended": {"stages": stages}})
    # one of an earlier test writes to that test's stderr
    logging.getLogger("torchsar").handlers.clear()
    assert (
        main(
            [
                "run",
                str(config),
                f"data.file={recording(tmp_path / 'raw.npz', **changes)}",
                "--out",
                str(tmp_path / "result"),
            ]
        )
        == 0
    )
    said = [line for line in spoken(capsys) if "warning: " in line]
    assert len(said) == 1 and all(part in said[0] for part in expected)


def test_aliasing_is_named_with_both_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logging.getLogger("torchsar").handlers.clear()
    assert main(["run", str(write_tiny(tmp_path)), "radar.prf_hz=10.0", "--out", str(tmp_path / "result")]) == 0
    assert "warning: PRF 10 Hz is below the Doppler band 14.67" in capsys.readouterr().err


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    config = write_tiny(tmp_path)
    command = [
        sys.executable,
        "-m",
        "torchsar.cli",
        "run",
        str(config),
        "world.lines=60000",
        "world.samples=1024",
        "--out",
        str(tmp_path / "result"),
    ]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=mind_interrupts)
    assert running.stderr is not None and "simulating" in running.stderr.readline()
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130 and said.strip() == "torchsar: interrupted, nothing was written"
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


@pytest.mark.parametrize("word", ["0", "-3", "many"])
def test_threads_are_a_number_above_zero(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["--threads", word, "list"])
    assert f"{word!r} is not a whole number above 0" in capsys.readouterr().err


def test_a_level_that_the_log_does_not_know(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TORCHSAR_LOG", "loud")
    assert main(["list"]) == 2
    assert "TORCHSAR_LOG=LOUD" in spoken(capsys)[-1]


def test_a_file_that_is_no_archive_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "raw.npz").write_text("not an archive")
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor=FOCUS)
    assert main(["run", str(config), f"data.file={tmp_path / 'raw.npz'}", "--out", str(tmp_path / "result")]) == 2
    assert "raw.npz" in spoken(capsys)[-1]


def test_the_command_is_installed() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "torchsar.cli", "run", "nowhere"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and "nowhere" in done.stderr and "Traceback" not in done.stderr


def test_requires_prints_the_table_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "needs"
    assert main(["requires", str(write_tiny(tmp_path)), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "squint ignored" in text and "omega_k" in text and text.strip().endswith(str(out))
    table = json.loads((out / "requires.json").read_text())
    assert {"effect", "phase_rad", "verdict"} <= set(table["requirements"][0])


def test_requires_follows_the_scene(tmp_path: Path) -> None:
    def squint_phase(doppler_hz: float) -> float:
        assert (
            main(
                [
                    "requires",
                    str(write_tiny(tmp_path)),
                    f"world.doppler_hz={doppler_hz}",
                    "--out",
                    str(tmp_path / "needs"),
                ]
            )
            == 0
        )
        rows = json.loads((tmp_path / "needs" / "requires.json").read_text())["requirements"]
        return next(row["phase_rad"] for row in rows if row["effect"] == "squint ignored")

    assert squint_phase(100.0) == pytest.approx(2 * squint_phase(50.0), rel=0.05)


def test_trade_starts_with_the_yardstick(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "trade"
    beam = "world.beam.dwell_s=1.0"
    assert (
        main(
            [
                "trade",
                str(write_tiny(tmp_path)),
                beam,
                "world.lines=640",
                "world.samples=256",
                "trade.repeats=1",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    table = json.loads((out / "trade.json").read_text())
    assert table["focusing"][0]["name"].startswith("backprojection") and table["jitter"][0]["name"] == "uncorrected"
    errors = {row["name"]: row["error_db"] for row in table["focusing"] + table["jitter"]}
    assert errors["omega_k_stolt, complex128"] < -20
    assert errors["exact"] < errors["Lagrange, 12 points"] < errors["Lagrange, 4 points"] < errors["uncorrected"]
    assert {path.name for path in (out / "figures").iterdir()} == {"trade_focusing.png", "trade_jitter.png"}
    assert "backprojection" in capsys.readouterr().out


def test_trade_refuses_what_it_cannot_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trade", str(write_tiny(tmp_path)), "trade.focusers=[omega]"]) == 2
    assert "did you mean 'omega_k'" in spoken(capsys)[-1]
