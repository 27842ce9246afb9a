"""Scripts of system 003: they run at reduced size, print what was expected or published beside
their own, and order the methods rightly.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.scripting import rows, run


@pytest.mark.slow
def test_estimators(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("rotation_estimators", tmp_path, {"time_and_error"}, capsys)
    first, second = text.split("\n\n")
    table, over = rows(first, 34), rows(second, 34)
    assert "published" in text and table["grid 5 x 21 x 201, extrapolated"][0] == 21105
    errors = table["recommended"][1:4]
    assert abs(errors[0]) < 3 and abs(errors[1]) < 0.3 and abs(errors[2]) < 0.3
    assert table["GA 6 x 3, os 1, seed 1"][0] == 18 and table["GA 30 x 2, os 2"][0] == 86
    assert all(ratio > 1 for ratio in over["GA 6 x 3, os 1, seed 1"][1:])
    assert over["grid, extrapolated"][0] > 100


def test_landscape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("rotation_landscape", tmp_path, {"cuts", "valley"}, capsys)
    table = rows(text, 32)
    for name in ("k1", "k2", "q2"):
        assert abs(table[name][2]) < 0.1 and table[name][3:] == [1, 1, 1]
    assert abs(table["q3"][2]) < abs(table["q3"][0])
    valley = next(line for line in text.splitlines() if line.startswith("along the valley"))
    lean, half = (
        float(number)
        for number in re.findall(r"is (-[\d.]+) ms|is (-[\d.]+) ms", valley)
        for number in number
        if number
    )
    assert lean == pytest.approx(half, rel=0.2)
    slopes = [re.findall(r"-?\d+\.\d{6}", line) for line in text.splitlines() if line.startswith("slope")]
    assert len(slopes) == 6 and all(float(a) == pytest.approx(float(b), abs=2e-5) for a, b in slopes)


def test_accuracy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    double = run("rotation_accuracy", tmp_path, {"accuracy"}, capsys).split("float64")[1]
    table = rows(double, 28)
    for grid in ("1.25", "2"):
        errors = [table[f"{taps} taps, grid {grid}"][0] for taps in range(2, 9)]
        assert errors == sorted(errors, reverse=True)
    assert table["6 taps, grid 2"][0] == pytest.approx(4e-6, rel=0.5) and table["8 taps, grid 2"][0] < 1e-7
    assert table["linear resampling + FFT"][0] > 0.05
