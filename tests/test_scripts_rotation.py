"""Scripts of system 003: they run at reduced size, print what was expected or published beside
their own, and order the methods rightly.
"""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import pytest

from tests.scripting import NUMBER, rows, run


def test_profiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = rows(run("rotation_profiles", tmp_path, {"figure_01", "figure_02", "figure_03"}, capsys), 26)
    for name in ("no compensation", "order 2, azimuth", "order 3, azimuth", "order 3, two-dimensional"):
        peak, width, side = table[name][6:9]  # at 12 m
        expected_peak, expected_width, expected_side = table[name][9:12]
        assert abs(peak - expected_peak) < 0.3 and abs(side - expected_side) < 0.3
        assert abs(width / expected_width - 1) < 0.2
    assert table["order 3, two-dimensional"][3:6] == pytest.approx([0.0, 1.48, -13.2], abs=0.06)
    assert table["y = 12 m, one cell"] == pytest.approx([math.sqrt(1 + yc / 12) for yc in table["yc (m)"]], abs=1e-3)
    ignored, estimated = (table[f"image, yc {how}"] for how in ("ignored", "estimated"))
    assert (
        all(abs(ratio - 1) < 0.02 for ratio in estimated) and abs(ignored[0] - 1) > 0.1 and abs(ignored[-1] - 1) > 0.1
    )


def test_satellite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("rotation_satellite", tmp_path, {"methods", *(f"figure_0{i}" for i in range(4, 10))}, capsys)
    table = rows(text, 26)
    entropies, contrasts = (
        [table[name][i] for name in ("no compensation", "SM, order 2", "order 3, azimuth", "order 3, two-dimensional")]
        for i in (0, 1)
    )
    assert entropies == sorted(entropies, reverse=True) and contrasts == sorted(contrasts)
    assert table["uniform autofocus"][0] > table["SM, order 2"][0]
    tips = [
        float(number)
        for number in NUMBER.findall(next(line for line in text.splitlines() if line.startswith("ok ; tips")))
    ]
    assert (
        tips[0] == pytest.approx(tips[1], rel=0.02)
        and tips[2] == pytest.approx(tips[3], rel=0.02)
        and tips[0] < 0 < tips[2]
    )


def test_estimators(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("rotation_estimators", tmp_path, {"time_and_error", "figure_10_12"}, capsys)
    first, second = text.split("\n\n")
    table, over = rows(first, 34), rows(second, 34)
    assert "published" in text and table["grid 5 x 21 x 201, extrapolated"][0] == 21105
    errors = table["recommended"][1:4]
    assert abs(errors[0]) < 3 and abs(errors[1]) < 0.3 and abs(errors[2]) < 0.3
    assert table["GA 6 x 3, os 1, seed 1"][0] == 18 and table["GA 30 x 2, os 2"][0] == 86
    assert all(ratio > 1 for ratio in over["GA 6 x 3, os 1, seed 1"][1:])
    assert over["grid, extrapolated"][0] > 100


def test_snr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = rows(run("rotation_snr", tmp_path, {"figure_13", "errors", "figure_14_17"}, capsys), 30)
    bounds = [table[f"{snr} dB, bound"] for snr in (-10, -5, 0, 5)]
    assert all(high[0] / low[0] == pytest.approx(10**-0.25, rel=0.01) for low, high in itertools.pairwise(bounds))
    recommended = table["5 dB, recommended"]
    genetic = table["5 dB, GA, 1 line"]
    assert abs(recommended[3]) + recommended[4] < 1 < abs(genetic[3])
    assert genetic[4] > 0  # each scene has random numbers of its own
    rate, tip = table["5 dB, rate"], table["5 dB"]
    assert rate[-1] == tip[-3] == 1.56 and table["-10 dB, rate"][-1] == table["-10 dB"][-3] == 9.18
    # errors of the recommended estimator, and those of the genetic algorithm itself
    assert rate[1] < 4 < 10 > rate[2] > rate[0] and tip[2] < 4 and 0 < tip[3] < 11.2


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


def test_cubes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = run("rotation_cubes", tmp_path, {"figure_18", "figure_19", "figure_20"}, capsys).split("\n\n")
    table, estimates = rows(first, 26), rows(second, 26)
    names = ("no compensation", "uniform autofocus", "autofocus + SM", "autofocus + third order", "alternation")
    entropies, contrasts = ([table[name][i] for name in names] for i in (0, 1))
    assert entropies == sorted(entropies, reverse=True) and contrasts == sorted(contrasts)
    assert abs(table["alternation"][0] - table["clean reference"][0]) < 0.1
    assert estimates["alternation"][0] == pytest.approx(0.1745, rel=0.03)
    assert estimates["published, genetic"] == [0.204, 6.1372, 1091.0]
