"""Scripts of system 001: they run at reduced size and print what was expected."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scripting import rows, run, script


@pytest.mark.slow
def test_orbit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = rows(run("geo_orbit", tmp_path, {"coefficients"}, capsys), 34)
    assert table["largest, squint 90 deg"][0] == pytest.approx(376, abs=2)
    assert table["phase at 2.25 s (rad)"][2] == pytest.approx(2.7e-4, abs=2e-5)


def test_condition(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    condition = rows(run("geo_condition", tmp_path, {"condition"}, capsys), 30)
    assert condition["N = 3, condition"] == pytest.approx([1, 2.7, 4.3, 10.2, 30.6, 153, 30.6, 10.2, 6.1, 1], rel=0.01)
    assert condition["N = 3, uneven, condition"][3] == pytest.approx(5.8, abs=0.05)


@pytest.mark.slow
def test_ambiguity(capsys: pytest.CaptureFixture[str]) -> None:
    script("geo_ambiguity").main([])
    beyond = rows(capsys.readouterr().out, 34)
    assert beyond["bank and likelihood"] == pytest.approx([25, -35], abs=0.1)
    assert beyond["range walk, interferometry"] == pytest.approx([25, -35], abs=0.2)
    assert beyond["range walk: pulse rates"] == [1, -1] and abs(beyond["interferometry alone"][0] - 25) > 40


@pytest.mark.slow
def test_speed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = rows(run("geo_speed", tmp_path, {"estimators", "migration"}, capsys), 28)
    assert table["N = 2, complex64"][-2] < -125 and table["N = 3, complex64"][-2] < -118
    whole, one, static, none = (
        table[name][1:]
        for name in ("keystone, whole swath", "keystone, one reference", "static bulk, whole swath", "none")
    )
    assert all(abs(loss) < 0.05 for loss in whole) and -0.3 < one[1] < -0.1
    assert all(abs(loss) < 0.05 for loss in static[:2]) and all(loss < -8 for loss in static[2:] + none)
    assert table["ML from ATI"][-2] < table["SIR"][-2]
