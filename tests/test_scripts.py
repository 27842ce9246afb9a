"""Scripts run, and print what they say."""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests import scripting
from tests.program import fork_workers
from torchsar.compensate import correct_pulse_phase
from torchsar.core import Draws
from torchsar.metrics import phase_rmse

ROOT = Path(__file__).resolve().parents[1]


Printed = Callable[[Path, list[str]], str]


@pytest.fixture
def printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Printed:
    """What a script prints that runs as the main program, in this process and an empty folder."""

    def run(script: Path, arguments: list[str]) -> str:
        threads = torch.get_num_threads()
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        try:
            runpy.run_path(str(script), run_name="__main__")
        finally:
            torch.set_num_threads(threads)
        return capsys.readouterr().out

    return run


def test_first_image_runs(printed: Printed, tmp_path: Path) -> None:
    script = ROOT / "scripts" / "first_image.py"
    found = re.match(r"Doppler ([-\d.]+) Hz, true ([-\d.]+) Hz", printed(script, []))
    assert found and abs(float(found[1]) - float(found[2])) < 5
    assert (tmp_path / "first_image.png").read_bytes().startswith(b"\x89PNG")


def test_the_sweep_of_the_documentation_is_right(printed: Printed, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how_to" / "sweeps.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    script = tmp_path / "sweep.py"
    script.write_text(next(block for block in blocks if "def trial(" in block), encoding="utf-8")
    text = printed(script, [])
    assert (tmp_path / "out" / "mean" / "results.zarr").is_dir()
    rmse = [float(x) for x in re.findall(r"\d\.\d+(?:e-\d+)?", text)]
    # the median of Gaussian noise is worse than the mean
    assert rmse[0] < 0.15 and rmse[3] > rmse[0]


@pytest.mark.slow
def test_the_benchmark_of_sweeps_runs(printed: Printed) -> None:
    fork_workers()
    overrides = ["processor.recommended.stages.velocity.lines=16", "world.lines=384", "world.samples=128"]
    arguments = ["stripmap_doppler", "--trials", "2", "--rounds", "1", *overrides]
    text = printed(ROOT / "scripts" / "sweep_speed.py", arguments)
    for name in ("one by one", "one batch", "automatic ", "automatic, 2 workers"):
        assert re.search(rf"^{name} +\d+ +\d+\.\d+", text, re.MULTILINE), text


@pytest.mark.slow
def test_the_share_of_time_in_which_sweeps_compute_is_measured(printed: Printed, tmp_path: Path) -> None:
    fork_workers()
    file = tmp_path / "busy.json"
    arguments = ["stripmap_doppler", "--workers", "2", "--seconds", "0.1", "--device", "cpu", "--batch", "1"]
    printed(ROOT / "scripts" / "sweep_busy.py", [*arguments, "--out", str(file)])
    found = json.loads(file.read_text(encoding="utf-8"))
    (row,) = found["rows"]
    assert found["machine"]["workers"] == 2 and row["trials_per_s"] > 0
    assert (row["sweep"], row["trials"], row["busy"]) == ("stripmap_doppler", 1, None)


@pytest.mark.slow
def test_autofocus_is_composed(printed: Printed, tmp_path: Path) -> None:
    arguments = ["--trials", "2", "--candidates", "2", "--pulses", "64"]
    text = printed(ROOT / "scripts" / "compose_autofocus.py", arguments)
    rows = {
        line[:32].strip(): [float(x) for x in line[32:].split()]
        for line in text.splitlines()
        if re.search(r"\d\.\d{3}$", line)
    }
    assert all(len(row) == 6 for row in rows.values()) and len(rows) == 6
    middle = {name: sorted(row)[2] for name, row in rows.items()}
    assert middle["polynomial, region"] < 0.1 < middle["polynomial, whole image"]
    assert (tmp_path / "compose_autofocus.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_network_learns_to_focus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = scripting.run("learned_autofocus", tmp_path, {"learned_autofocus"}, capsys)
    rows = scripting.rows(text, 34)
    for i in range(2):
        bound, learned, known = (rows[name][i] for name in ("bound", "learned", "pga_sca"))
        assert 0.8 * bound < learned < known, text
    assert "recordings: skipped" in text


def test_the_training_of_a_network_repeats_to_the_bit() -> None:
    script = scripting.script("learned_autofocus")

    def losses() -> list[float]:
        network = script.LearnedAutofocus(Draws(2))
        return script.train(
            network.parameters(), script.scenes(6, 2, script.TINY), script.loss_of_network(network), rate=0.03
        )

    first = losses()
    assert len(set(first)) == 3 and first == losses()


def test_a_learned_autofocus_moves_with_the_phases_and_stays_finite() -> None:
    script = scripting.script("learned_autofocus")
    network, draws = script.LearnedAutofocus(Draws(2)), Draws(3, trials=range(2))
    data = draws.normal("data", (32, 24), torch.complex128).to(torch.complex64)
    phase = draws.uniform("phase", (32,), -100.0, 100.0, torch.float32)
    with torch.no_grad():
        still, turned = network(data, 2), network(correct_pulse_phase(data, -phase), 2)
        assert bool(torch.isfinite(network(torch.zeros_like(data), 2)).all())
    assert float(phase_rmse(turned - phase, still).max()) < 1e-3


def test_the_benchmark_of_ladar_estimators_runs(printed: Printed) -> None:
    arguments = ["--trials", "2", "--rounds", "1", "--periods", "32"]
    text = printed(ROOT / "scripts" / "ladar_speed.py", arguments)
    for precision in ("complex64", "complex128"):
        assert re.search(rf"^{precision}: 2 trials of 32 periods x 2 x 512 samples", text, re.MULTILINE), text
    over = [float(x) for x in re.findall(r"^radial_motion(?: +[\d.]+){4} +([\d.]+)", text, re.MULTILINE)]
    # of the bound with unknown phases; known ones halve it
    assert len(over) == 2 and all(0.4 < x < 0.7 for x in over)


def test_the_benchmark_of_images_runs(printed: Printed) -> None:
    text = printed(ROOT / "scripts" / "imaging_speed.py", ["--small", "--errors", "-60", "-90"])
    noise = {line[:28].strip(): float(line.split()[-1]) for line in text.splitlines() if re.search(r"-?\d\.\d$", line)}
    for form in ("kept", "moved", "new"):
        assert noise[f"tiles -60 dB, {form}"] < -57 and noise[f"tiles -90 dB, {form}"] < -87
    assert noise["direct sum"] < -90 < noise["polar format"]


@pytest.mark.parametrize("script", sorted((ROOT / "scripts").glob("*.py")), ids=lambda path: path.stem)
def test_scripts_name_their_options(script: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    text = script.read_text(encoding="utf-8")
    assert text.startswith('"""')
    if "argparse" not in text:
        return
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    assert "usage: " in capsys.readouterr().out
