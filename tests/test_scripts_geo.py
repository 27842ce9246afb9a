"""Scripts of system 001: they run at reduced size, print what was expected or published beside
their own, and order the methods rightly.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.scripting import rows, run


def test_geometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("geo_geometry", tmp_path, {"coefficients", "figure_02", "figure_03", "figure_04", "figure_08"}, capsys)
    table = rows(text, 34)
    # a clear swath near each rate that the paper names
    assert len(table["its middle beyond 7 degrees (km)"]) == 5
    assert table["largest, squint 90 deg"][0] == pytest.approx(376, abs=2) and table["phase at 2.25 s (rad)"][
        2
    ] == pytest.approx(2.7e-4, abs=2e-5)
    for name in (
        "v_e at u_a = 0 (m/s)",
        "v_e at u_a = 20 (m/s)",
        "delay at u_a = 0 (ms)",
        "delay at u_a = 20 (ms)",
        "phase a m/s of u_r (rad)",
        "phase error at u_a = 10 (rad)",
    ):
        ours, expected = table[name]
        assert ours == pytest.approx(expected, rel=1e-2)
    assert table["change of delay at u_r = 20 (%)"][0] < 0.5
    assert table["u_a: phase shift (rad)"] == pytest.approx([0.0] * 5, abs=1e-3)


def test_targets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = {"contours", "figure_07", "figure_15", "figure_16", "figure_16_contours"}
    two, three = (rows(text, 28) for text in run("geo_targets", tmp_path, figures, capsys).split("\n\n")[:2])
    assert "published" in two
    for name in ("P1", "P2", "P3", "P4"):
        width, side, energy, across, across_side, _, level = two[f"proposed {name}"]
        assert (
            width == pytest.approx(0.81, abs=0.02)
            and side == pytest.approx(-13.26, abs=0.15)
            and energy == pytest.approx(-9.9, abs=0.2)
        )
        assert across == pytest.approx(2.66, abs=0.02) and across_side == pytest.approx(-13.26, abs=0.15)
        assert level < -65 and three[f"proposed {name}"][-1] < -45
    assert [two[f"conventional {name}"][-1] for name in ("P1", "P2", "P4")] == pytest.approx(
        [-45.6, -19.4, -23.1], abs=1.5
    )
    assert two["conventional P1"][0] > 50 and two["conventional P2"][0] < 1.1


def test_reconstruction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run(
        "geo_reconstruction", tmp_path, {"condition", "figure_10", "figure_11", "figure_12", "figure_17"}, capsys
    )
    table = rows(text, 36)
    at = {-20: 0, 0: 3, 2: 4, 10: 5, 20: 6}
    for gate in ("band-limited", "pattern"):
        for name in (
            "conventional, N = 3",
            "conventional, N = 2",
            "proposed, N = 3",
            "proposed, N = 2",
            "proposed, MMSE, N = 5",
        ):
            lines = text.splitlines()
            here = next(i for i, line in enumerate(lines) if line.startswith(f"{gate}: {name}"))
            for level, speed in re.findall(r"(-[\d.]+) at ([\d]+) m/s", lines[here + 1]):
                ours = table[f"{gate}: {name}"][at[int(speed)]]
                assert ours == pytest.approx(float(level), abs=1.5) or (float(level) < -60 and ours < float(level))
    ratios = rows(text, 26)
    assert (
        ratios["band-limited: Gamma"][0] == pytest.approx(10.0, abs=0.5)
        and ratios["band-limited: Gamma"][1] > ratios["band-limited: Gamma1"][1] > 15
    )
    condition = rows(text, 30)
    assert condition["N = 3, condition"] == pytest.approx([1, 2.7, 4.3, 10.2, 30.6, 153, 30.6, 10.2, 6.1, 1], rel=0.01)
    assert condition["N = 3, uneven, condition"][3] == pytest.approx(5.8, abs=0.05)


def test_velocity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("geo_velocity", tmp_path, {"table_2", "table_3"}, capsys)
    second, third, beyond = (rows(part, 34) for part in text.split("\n\n"))
    assert second["published"] == [1.33, 0.19] and third["published"] == [0.19, 0.15]
    assert second["ML"][0] < 1 and second["ML"][1] < 0.1 and second["SIR"][1] < 0.3
    assert second["bound, u_a known"][0] == pytest.approx(10 * second["bound, u_a known"][1], rel=0.02)
    assert all(a < b for a, b in zip(second["bound, u_a known"], second["bound, no prior knowledge"], strict=True))
    assert beyond["bank and likelihood"] == pytest.approx([25, -35], abs=0.1) and beyond[
        "range walk, interferometry"
    ] == pytest.approx([25, -35], abs=0.2)
    assert beyond["range walk: pulse rates"] == [1, -1] and abs(beyond["interferometry alone"][0] - 25) > 40


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
