"""A seventh system from one file: every command works on it, no shared file knows it."""

from __future__ import annotations

import ast
import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
import yaml

from tests.study import toy_system
from torchsar.cli import main
from torchsar.study import table
from torchsar.study.trials.batch import Trials

pytestmark = pytest.mark.usefixtures("blank_pictures")

# what a further system may cost at most, in statements
MOST_STATEMENTS = 120
FREQUENCIES = [3.0, 10.3, 20.1]
CONFIG = {
    "system": "tone",
    "title": "a tone",
    "radar": {"sample_rate_hz": 100.0},
    "world": {"samples": 64, "frequency_hz": 10.3, "trials": 3, "noise": {"snr_db": 10.0}},
    "processor": {
        "coarse": {"stages": {"line": {"stage": "strongest_line", "padding": 1}}},
        "recommended": {"stages": {"line": {"stage": "strongest_line", "padding": "auto"}}},
    },
    "trade": {"repeats": 1},
    "sweep": {"world.frequency_hz": FREQUENCIES, "trials": 40, "success": {"frequency_error_hz": 0.2}},
}


@pytest.fixture(params=["entry point", "table"])
def config(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The config, its system made known in either way."""
    monkeypatch.setattr(table, "systems", table._Systems())
    if request.param == "table":
        monkeypatch.setitem(table.SYSTEMS, "tone", toy_system.__name__)
    else:
        point = EntryPoint("tone", toy_system.__name__, "torchsar.systems")
        monkeypatch.setattr(table, "entry_points", lambda group: [point] if group == point.group else [])
    path = tmp_path / "tone.yaml"
    path.write_text(yaml.safe_dump(CONFIG), encoding="utf-8")
    return str(path)


def test_it_is_short() -> None:
    tree = ast.parse(Path(toy_system.__file__).read_text(encoding="utf-8"))
    assert sum(isinstance(node, ast.stmt) for node in ast.walk(tree)) <= MOST_STATEMENTS


@pytest.mark.slow
def test_every_command_works_on_it(
    config: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    batches: list[tuple[list[float], Trials]] = []
    simulate = toy_system.ToneSystem.simulate

    def seen(system, bench, world, draws) -> Trials:
        trials = simulate(system, bench, world, draws)
        batches.append((torch.as_tensor(world.frequency_hz).reshape(-1).tolist(), trials))
        return trials

    monkeypatch.setattr(toy_system.ToneSystem, "simulate", seen)
    assert main(["list", "--all"]) == 0
    assert "a tone in noise" in (said := capsys.readouterr().out) and "strongest_line" in said and "padding=8" in said
    _check_run(config, tmp_path / "run")
    batches.clear()
    _check_sweep(config, tmp_path / "sweep")
    # the trials of all frequencies share one batch
    assert [sorted(set(values)) for values, _ in batches] == [FREQUENCIES] and batches[0][1].count == 120
    assert main(["trade", config, "--out", str(tmp_path / "trade")]) == 0
    rows = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))["alternatives"]
    assert [row["name"] for row in rows if row["recommended"]] == ["padding 16"]
    for row in rows:
        assert row["loss"]["grid_error_hz"] == pytest.approx(row["predicted"]["grid_error_hz"], rel=0.2), row["name"]
    assert main(["requires", config, "--out", str(tmp_path / "needs")]) == 0
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["all"]
    assert needs["limits"][0]["verdict"] == "ok" and needs["choices"][0]["recommended"] == "padding 16"
    assert not needs["requirements"][0]["ok"]  # with the coarse method


def _check_run(config: str, out: Path) -> None:
    assert main(["run", config, "--out", str(out)]) == 0
    tree = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    best, coarse = (tree["methods"][name]["metrics"] for name in ("recommended", "coarse"))
    assert abs(best["frequency_error_hz"]) < 0.1 < abs(coarse["frequency_error_hz"]) and best["ok"] == 1.0
    assert len(tree["methods"]["recommended"]["estimates"]["line.frequency_hz"]["value"]) == 3
    assert "padding 16 was chosen" in tree["chosen"][0] and tree["truth"]["frequency_hz"] == [10.3] * 3
    assert "error of the frequency" in (out / "report.html").read_text(encoding="utf-8")
    assert list((out / "figures").glob("*.png"))


def _check_sweep(config: str, out: Path) -> None:
    assert main(["sweep", config, "sweep.success={}", "--out", str(out)]) == 0
    points = json.loads((out / "summary.json").read_text(encoding="utf-8"))["points"]
    kept = [p for p in points if (p["algorithm"], p["metric"]) == ("recommended", "frequency_error_hz")]
    assert len(kept) == len(FREQUENCIES)
    for point in kept:
        # the spectrum is read on lines 0.098 Hz apart, the noise moves them by 0.03 Hz
        assert 0.01 < point["rmse"] < 0.08 and point["n"] == 40


def test_a_tone_below_the_noise_is_refused_and_never_sure(
    config: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", config, "world.noise.snr_db=-10.0", "--out", str(tmp_path / "none")]) == 2
    assert "SNR of the spectrum is 8.062 dB, and must be at least 14 dB" in capsys.readouterr().err
    noise = torch.randn(2000, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    assert float(toy_system.strongest_line(noise, 100.0, 16).ok.double().mean()) < 0.01
