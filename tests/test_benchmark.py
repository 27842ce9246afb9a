"""The benchmark of all stages, and the comparison of two of its results."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import compiles_stages
from tests.scripting import ROOT, script


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of the small benchmark, by the command that users type."""
    file = tmp_path_factory.mktemp("benchmark") / "new.json"
    command = [sys.executable, ROOT / "scripts" / "benchmark.py", "--small", "--device", "cpu", "--out", file]
    command += ["--random", "torch"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return file


@pytest.mark.slow
def test_every_part_of_a_config_is_measured(result: Path) -> None:
    found = json.loads(result.read_text(encoding="utf-8"))
    assert not found["failed"] and {"torch", "processor", "vectors", "cores"} <= found["machine"].keys()
    rows = found["rows"]
    assert {row["part"] for row in rows} == {"echo", "draws", "stage", "metrics", "batch", "memory"}
    stages = [row for row in rows if row["part"] == "stage"]
    assert any(row["name"].startswith("recommended.") for row in stages)
    assert all(row["seconds"] > 0 and row["over_floor"] > 0 for row in stages)
    whole = {
        row["part"]: row["seconds"] for row in rows if row["part"] in ("echo", "draws", "batch") and not row["name"]
    }
    # each contains the one before, about twice; other processes may slow one of them
    assert 0 < whole["draws"] < 2 * whole["echo"] < 4 * whole["batch"]
    other = {row["part"]: row["seconds"] for row in rows if row["name"] == "torch"}
    assert other.keys() == {"draws", "batch"} and 0 < other["draws"] < 2 * other["batch"]
    assert next(row for row in rows if row["part"] == "memory")["peak_bytes"] > 1e8


@pytest.mark.slow
def test_what_became_slower_is_listed(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    compare = script("compare_benchmarks").main
    assert compare([str(result), str(result)]) == 0
    tree = json.loads(result.read_text(encoding="utf-8"))
    slow = max((row for row in tree["rows"] if row["part"] == "stage"), key=lambda row: row["seconds"])
    slow["over_floor"] *= 1.5
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(tree), encoding="utf-8")
    capsys.readouterr()
    assert compare([str(result), str(changed)]) == 1
    slower, faster = capsys.readouterr().out.split("parts became faster")
    assert "1 of" in slower and slow["name"] in slower and slow["name"] not in faster
    assert compare([str(changed), str(result), "--limit", "1.6"]) == 0


@pytest.mark.slow
@compiles_stages
def test_the_gain_of_compiled_chains_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By a compiler that takes a moment; what cannot be compiled is named."""
    file = tmp_path / "compiled.json"
    chosen = ["isal_table1", "sweeps/nowhere", "--backend", "aot_eager", "--seconds", "0"]
    script("compiled_speed").main(["--out", str(file), *chosen])
    found = json.loads(file.read_text(encoding="utf-8"))
    assert [row["config"] for row in found["rows"]] == ["isal_table1"] and list(found["failed"]) == ["sweeps/nowhere"]
    row = found["rows"][0]
    assert row["difference"] < 1e-5 and min(row["seconds"], row["gain"], row["compile_s"]) > 0
