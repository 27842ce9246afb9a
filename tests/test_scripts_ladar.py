"""Scripts of system 000: they run at reduced size, print what was published beside their own, and
order the methods rightly.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar import plot
from torchsar.core import Axis, Signal

ROOT = Path(__file__).resolve().parents[1]


def run(name: str, folder: Path, figures: set[int], capsys: pytest.CaptureFixture[str]) -> str:
    """What a script prints with --small, after a look at its figures."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(["--small", "--out", str(folder / "figures")])
    drawn = sorted((folder / "figures").iterdir())
    assert {path.name for path in drawn} == {f"figure_{i:02}.png" for i in figures}
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 5000 for path in drawn)
    return capsys.readouterr().out


def rows(text: str, label: int) -> dict[str, list[float]]:
    """Numbers of the rows of a table by what stands in their first `label` letters; NaN for
    a dash.
    """
    found = (line for line in text.splitlines() if re.search(r"(\d|-)$", line))
    return {
        line[:label].strip(): [float("nan") if word == "-" else float(word) for word in line[label:].split()]
        for line in found
    }


def test_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = run("ladar_points", tmp_path, {2, 5, 6, 7, 8, 9}, capsys)
    assert text.splitlines()[0].split()[-4:] == ["published", "uncompensated", "segmented", "recommended"]
    table = rows(text, 28)
    assert table["pslr_azimuth_db"][0] == -12.49
    for column in (2, 3):
        assert abs(table["pslr_azimuth_db"][column] + 13.26) < 0.2 and abs(table["irw_range_m"][column] - 0.0266) < 2e-4
        assert table["largest range error (m)"][column] < 2e-7 < table["largest range error (m)"][1]


def test_letter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, trap = run("ladar_letter", tmp_path, {10, 11, 12}, capsys).split("\n\n")
    assert "published" in first.splitlines()[0]
    table = rows(first, 26)
    assert table["segmented, summed"][1] == 11.3471
    entropies, contrasts, residuals = (
        [table[name][i] for name in ("uncompensated", "cross-correlation", "segmented, summed")] for i in (0, 2, 4)
    )
    assert (
        entropies == sorted(entropies, reverse=True)
        and contrasts == sorted(contrasts)
        and residuals == sorted(residuals, reverse=True)
    )
    assert table["recommended"][4] < 0.15
    trapped = rows(trap, 26)
    assert (
        trapped["cross-correlation"][0] < trapped["ideal"][0] and trapped["cross-correlation"][4] > 1
    )  # less entropy than the truth, and wrong


def test_ground(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = run("ladar_ground", tmp_path, {15, 16, 17, 18, 19}, capsys).split("\n\n")
    assert "published" in first.splitlines()[0] and second.splitlines()[0].count("published") == 2
    table = rows(first, 26)
    assert table["segmented"][1] == 11.9251
    entropies, contrasts, residuals = (
        [table[name][i] for name in ("uncompensated", "cross-correlation", "segmented", "recommended")]
        for i in (0, 2, 4)
    )
    assert (
        entropies == sorted(entropies, reverse=True)
        and contrasts == sorted(contrasts)
        and residuals == sorted(residuals, reverse=True)
    )
    assert table["recommended"][4] < 0.05 and table["segmented, circular shift"][4] > 140
    responses = rows(second, 26)
    assert responses["pslr_azimuth_db"][1] == -5.01
    assert responses["pslr_azimuth_db"][4] < -12.5 < -10 < responses["pslr_azimuth_db"][0]


@pytest.mark.parametrize("is_complex", [True, False])
def test_short_time_spectrum_finds_a_tone(is_complex: bool) -> None:
    time_s = torch.arange(1024, dtype=torch.float64) / 64e6
    tone = torch.polar(torch.ones_like(time_s), 2 * np.pi * 5e6 * time_s) * (time_s > 8e-6)
    shown = plot.short_time_spectrum(tone if is_complex else tone.real, 64e6)
    assert shown.names == ("frequency", "time")
    late = shown.data[:, int(shown.axis("time").index_of(12.0).round())]
    assert abs(float(shown.axis("frequency").values()[int(late.argmax())]) - 5.0) < 0.1
    strength = shown.data.amax(0)
    middle = float(shown.axis("time").values()[int((strength > strength.max() / 2).to(torch.int8).argmax())])
    assert abs(middle - 8.0) < 0.1  # a tone that begins in the middle of a window gives half


def test_contours_and_overlays_draw() -> None:
    axes = Axis("azimuth", 20, -1.0, 0.1, "m"), Axis("range", 30, 0.0, 0.1, "m")
    blob = torch.exp(-(axes[0].values()[:, None].square() + (axes[1].values() - 1.5).square()) / 0.2).to(
        torch.complex64
    )
    drawn = plot.contours({"a": Signal(blob, axes), "b": Signal(blob[None], axes)})
    assert [figure.axes[0].get_title() for figure in drawn] == ["a", "b"]
    assert len(drawn[0].axes[0].collections) and drawn[0].axes[0].get_xlabel() == "range (m)"
    line = np.array([0.0, 2.0]), np.array([0.0, 0.5])
    parts = [
        {"title": "with", "signal": Signal(blob, axes), "lines": {"line": line}},
        {"series": {"line": line}, "xlabel": "x", "ylabel": "y", "title": "without"},
    ]
    over, beside = (figure.axes[0] for figure in plot.overlays(parts))
    assert over.get_images() and len(over.get_lines()) == 1 and not beside.get_images()
    assert over.get_xlim() == pytest.approx((-0.05, 2.95))
