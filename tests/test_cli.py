"""The command line, as a user meets it."""

from __future__ import annotations

import json
import logging
import os
import re
import resource
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import enable_interrupts
from tests.study.tiny import write_tiny
from torchsar.cli import main
from torchsar.study.commands import run
from torchsar.study.output.progress import progress


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are drawn in the other tests of runs."""
    monkeypatch.setattr(run, "draw_all", lambda *_, **__: [])


def spoken(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capsys.readouterr().err.splitlines() if line.strip()]


def test_list_explains_experiments_systems_stages_keys_and_data(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    brief = capsys.readouterr().out
    assert len(brief.splitlines()) < 130 and "doppler_centroid" in brief and "torchsar list --all" in brief
    assert main(["list", "--all"]) == 0
    text = capsys.readouterr().out
    for name in ("stripmap_damaged", "radarsat1", "omega_k", "doppler_centroid", "points", "dwell", "chirp_rate_hz_s"):
        assert name in text
    for line in ("noise.snr_db*=null", "targets.NAME.u_r_m_s*=0.0", "prf_hz", "geo_ocean"):
        assert f"  {line} " in text, line
    keys = [line.split() for line in text.splitlines() if line.startswith("      ") and line[6] != " "]
    silent = [words[0] for words in keys if len(words) == 1]
    assert len(keys) > 500 and not silent, silent
    assert "c1 t + c2 t^2 + ...\n" in text and not re.search(r"[^.]\.\.\n", text)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words, lines",
    [
        (
            ["pga_sca"],
            [
                "STAGES, compensate",
                "  pga_sca ",
                "      kernel",
                "      windows",
                "      iter",
                "      pat",
                "      assess",
            ],
        ),
        (["isal_SNR"], ["EXPERIMENTS", "  isal_snr "]),
        (["velocity", "stripmap_doppler"], ["EXPERIMENTS", "  stripmap_doppler "]),
        (
            ["sampling_hz", "pulse"],
            ["SYSTEMS", "  stripmap ", "    radar", "      sampling_hz"],
        ),
    ],
)
def test_list_with_words_shows_the_entries_that_contain_them(
    words: list[str], lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["list", *words]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == len(lines), shown
    assert all(line.startswith(begin) for line, begin in zip(shown, lines, strict=True)), shown


def test_list_with_a_word_that_no_entry_contains_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "omega_k", "xyzzy"]) == 2
    assert spoken(capsys) == ["torchsar: no entry of `torchsar list` contains 'omega_k' and 'xyzzy'"]


def test_a_method_that_uses_true_values_says_that_a_recording_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = {"uses": {"doppler_hz": "truth.doppler_hz"}}
    ideal = {"oracle": True, "stages": {"focus": {"stage": "omega_k", **truth}}}
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor={"recommended": ideal})
    file = recording(tmp_path / "raw.npz")
    assert main(["run", str(config), f"data.file={file}", "--out", str(tmp_path / "result")]) == 2
    assert "recommended: it uses truth.doppler_hz, which is known of simulated data only" in spoken(capsys)[-1]


def child_seconds(*arguments: str) -> tuple[float, subprocess.CompletedProcess[str]]:
    """CPU time of the command in a process of its own, and what it said."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "torchsar", *arguments], capture_output=True, text=True, timeout=120)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done


@pytest.mark.parametrize(
    "arguments, status, said",
    [
        (["--help"], 0, "usage: torchsar"),
        (["run", "--help"], 0, "--device"),
        (["--version"], 0, "torchsar-lab "),
        (
            [],
            2,
            "a command is missing: choose one of run, focus, sweep, requires, trade, import, export, bench, reproduce",
        ),
        (["walk"], 2, "invalid choice: 'walk'"),
        (["requires"], 2, "arguments are required: config\n"),
        (["run", "stripmap_damaged", "--speed"], 2, "unrecognized arguments: --speed"),
        (["run", "nowhere"], 2, "there is no config file 'nowhere'"),
        (["run", "sal_points", "--out", ""], 2, "the name of the folder is empty"),
        (["import", "a.h5", "--out", "b.npz"], 2, "arguments are required: --sidecar"),
        (["export", "run", "--to", "png", "--out", "b"], 2, "invalid choice: 'png'"),
    ],
)
def test_help_and_usage_errors_answer_at_once(arguments: list[str], status: int, said: str) -> None:
    spent, done = child_seconds(*arguments)
    assert done.returncode == status and said in done.stdout + done.stderr and "Traceback" not in done.stderr
    assert spent < 0.5


def test_progress_has_a_rate_and_a_remaining_time_once_work_is_long(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(40, "trials", done=4) as count:
        count.update(6)
        assert capsys.readouterr().err == ""
        count.start_t = count.last_print_t = count.start_t - 12.0  # as after 12 seconds
        count.update(6)
    assert re.search(r"16/40 \[00:12<00:2\d, +[.\d]+ ?(trials/s|s/ trials)", capsys.readouterr().err)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "sweep", "requires", "trade", "import", "list"])
def test_the_first_line_comes_before_anything_heavy_is_imported(command: str, tmp_path: Path) -> None:
    """torch cannot be imported here at all, and the first line is there, in a pipe."""
    program = "import sys; sys.modules['torch'] = None; from torchsar.cli import main; main(sys.argv[1:])"
    words = [command] if command == "list" else [command, str(write_tiny(tmp_path))]
    words += ["--sidecar", words[-1], "--out", "recording.npz"] if command == "import" else []
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, timeout=60)
    assert ("EXPERIMENTS" in done.stdout) if command == "list" else (f"torchsar: {command} " in done.stderr)


@pytest.mark.parametrize("device, said", [("cuda:99", "--device cuda:99"), ("meta", "--device meta"), ("best", "best")])
def test_devices_that_cannot_compute_are_refused(
    device: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(write_tiny(tmp_path)), "--device", device, "--out", str(tmp_path / "result")]) == 2
    line = spoken(capsys)[-1]
    assert said in line and "cannot be used here" in line and "leave it out" in line
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


@pytest.mark.parametrize(
    "words, said",
    [([], "random=torch"), (["random=torch"], "with --workers 6\n"), (["--workers", "2"], ""), (["cpu"], "")],
)
def test_a_sweep_of_one_process_on_a_gpu_tells_of_workers(
    words: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchsar.study.commands import sweep

    monkeypatch.setattr("torchsar.core.device_fault", lambda device: "")
    monkeypatch.setattr(sweep, "sweep", lambda *_: "no sweep")
    device, words = ("cpu", []) if words == ["cpu"] else ("cuda", words)
    assert main(["sweep", "isal_snr", "--device", device, "--out", str(tmp_path / "out"), *words]) == 0
    found = capsys.readouterr()
    assert said in found.err and ("busy only in part" in found.err) == bool(said)


def test_a_warning_is_shown_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def warns(*_: object, **__: object) -> str:
        for _ in range(3):
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.warn("aliased", stacklevel=1)
            logging.getLogger("torchsar").warning("warning: recommended failed")
            logging.getLogger("torchsar").info("again")
        return "done"

    monkeypatch.setattr("torchsar.study.commands.run.run", warns)
    for _ in range(2):
        assert main(["run", str(write_tiny(tmp_path)), "--out", str(tmp_path / "result")]) == 0
        said = spoken(capsys)
        assert [sum(text in line for line in said) for text in ("aliased", "recommended failed", "again")] == [1, 1, 3]


@pytest.mark.slow
def test_run_prints_where_the_report_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "result"
    assert main(["run", str(write_tiny(tmp_path)), "world.noise.snr_db=30", "seed=5", "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out / "report.html")
    assert "snr_db: 30" in (out / "config.yaml").read_text()
    assert "seed: 5" in (out / "config.yaml").read_text()


@pytest.mark.usefixtures("without_pictures")
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
    first, *lines = spoken(capsys)
    assert first.startswith(f"torchsar: {command} ")
    assert len(lines) == 1 and lines[0].startswith("torchsar: ") and "radar.prf" in lines[0] and "prf_hz" in lines[0]
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


@pytest.mark.parametrize("words", [["--out", "a\0b"], ["--out", "a\udcffb"], ["seed=\udc80"], ["se\0d=3"]])
@pytest.mark.parametrize("command", ["run", "sweep"])
def test_arguments_that_are_no_text_are_a_sentence(
    command: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(write_tiny(tmp_path)), *words]) == 2
    (said,) = spoken(capsys)
    assert "has characters that are no text" in said
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


@pytest.mark.parametrize(
    "error, said",
    [
        (MemoryError("Unable to allocate 3 GiB"), "memory is too short (Unable to allocate 3 GiB)"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes\nin a stack"),
            "memory is too short (Default",
        ),
        (OSError(28, "No space left on device"), "No space left on device"),
    ],
)
def test_a_machine_that_is_too_small_is_a_sentence(
    error: Exception, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("torchsar.study.trials.bench.Bench.batch", fail)
    assert main(["run", str(write_tiny(tmp_path)), "--out", str(tmp_path / "out")]) == 2
    assert said in spoken(capsys)[-1] and not (tmp_path / "out").exists()


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


@pytest.mark.usefixtures("without_pictures")
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, expected",
    [
        (
            {"iq": np.random.default_rng(1).normal(size=(96, 160, 2)) * (np.arange(96) < 90)[:, None, None]},
            ["raw.npz", "6 of 96 lines hold only zeros", "line 90"],
        ),
        ({"pilot": np.zeros(4096, np.complex64)}, ["recommended.pilot, not ok in 1 of 1 trials: "]),
    ],
)
def test_doubtful_recordings_are_named_in_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict, expected: list[str]
) -> None:
    stages = {
        **({"pilot": {"stage": "pilot_jitter", "uses": {"pilot": "aux.pilot"}}} if "pilot" in changes else {}),
        **FOCUS["recommended"]["stages"],
    }
    config = write_tiny(tmp_path, world=None, radar=None, metrics=None, processor={"recommended": {"stages": stages}})
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


@pytest.mark.usefixtures("without_pictures")
def test_aliasing_is_named_with_both_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logging.getLogger("torchsar").handlers.clear()
    config, expected = (
        str(write_tiny(tmp_path)),
        "Doppler band of a 0.2 s aperture is 14.67 Hz, and must be below 10 Hz",
    )
    assert main(["run", config, "radar.prf_hz=10.0", "--out", str(tmp_path / "run")]) == 0
    assert f"warning: {expected}" in capsys.readouterr().err
    assert main(["requires", config, "radar.prf_hz=10.0", "--out", str(tmp_path / "requires")]) == 0
    (row,) = json.loads((tmp_path / "requires" / "requires.json").read_text())["all"]["limits"]
    assert (row["verdict"], row["limit"]) == ("warn", 10.0) and row["value"] == pytest.approx(14.67, abs=0.01)


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    config = write_tiny(tmp_path)
    command = [
        sys.executable,
        "-m",
        "torchsar",
        "run",
        str(config),
        "world.lines=60000",
        "world.samples=1024",
        "--out",
        str(tmp_path / "result"),
    ]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=enable_interrupts)
    assert running.stderr is not None and "torchsar: run" in running.stderr.readline()
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130 and said.splitlines()[-1] == "torchsar: interrupted, nothing was written"
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


def test_an_interrupt_that_python_drops_comes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Callback:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def long(*_: object, **__: object) -> None:
        Callback()  # Python prints an exception in `__del__` and goes on
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr("torchsar.study.commands.run.run", long)
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["run", str(write_tiny(tmp_path)), "--out", str(tmp_path / "result")]) == 130
    finally:
        signal.signal(signal.SIGINT, earlier)
    assert spoken(capsys)[-1] == "torchsar: interrupted, nothing was written"


@pytest.mark.parametrize("word", ["0", "-3", "many", "9" * 30])
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


def test_requires_prints_the_table_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "needs"

    def squint_phase(doppler_hz: float) -> float:
        given = [str(write_tiny(tmp_path)), f"world.doppler_hz={doppler_hz}", "--out", str(out)]
        assert main(["requires", *given]) == 0
        text = capsys.readouterr().out
        assert "squint ignored" in text and "omega_k" in text and text.strip().endswith(str(out))
        table = json.loads((out / "requires.json").read_text())
        rows = [row for case in table.values() for row in case["requirements"]]
        assert {"effect", "phase_rad", "verdict"} <= set(rows[0])
        return next(row["phase_rad"] for row in rows if row["effect"] == "squint ignored")

    assert squint_phase(100.0) == pytest.approx(2 * squint_phase(50.0), rel=0.05)


def test_trade_refuses_what_it_does_not_know(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trade", str(write_tiny(tmp_path)), "trade.focusers=[omega_k]"]) == 2
    assert "'trade.focusers' is not known (accepted: repeats, tolerance, trials)" in spoken(capsys)[-1]


def test_threads_wait_passively_before_torch_is_imported() -> None:
    words = "import os, sys; from torchsar.cli import main; main(['--version']); assert 'torch' not in sys.modules"
    given = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", f"{words}; print(os.environ['OMP_WAIT_POLICY'])"],
        env=given,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "PASSIVE"
