"""System 004: every impairment at once, repaired; and the recordings focused end to end by the
shipped configs.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from torchsar.study.commands import run
from torchsar.study.settings.text import find_config
from torchsar.study.table import load


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of every system are drawn in other tests, of smaller scenes."""
    monkeypatch.setattr(run, "draw_all", lambda *_, **__: [])


def metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.slow
def test_all_impairments_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "draw_all", lambda *_, **__: [])  # a third of the time
    tree = yaml.safe_load(find_config("stripmap_damaged").read_text(encoding="utf-8"))
    del tree["processor"]["squint_ignored"]  # of no interest here
    (tmp_path / "strip.yaml").write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    run.run(load(tmp_path / "strip.yaml"), tmp_path / "strip")
    found = metrics(tmp_path / "strip")
    best, baseline, none = (found["methods"][name]["metrics"] for name in ("recommended", "baseline", "none"))
    assert (
        best["image_error_db"] < -27
        and best["image_error_db"] < baseline["image_error_db"] - 6 < none["image_error_db"]
    )
    assert best["targets_found"] == 24
    assert abs(best["effective_velocity_m_s"] - found["truth"]["velocity_m_s"]) < 0.3
    # 0.01 degree of squint
    assert abs(best["doppler_centroid_hz"] - found["truth"]["doppler_hz"]) < 26


@pytest.mark.slow
@pytest.mark.parametrize(
    ("block", "baseband_hz", "absolute_hz", "entropy_nats"),
    [("english_bay", 488, -7050, 10.018), ("squamish", 549, -6990, 11.974)],
)
def test_recordings_end_to_end(recorded, tmp_path, block, baseband_hz, absolute_hz, entropy_nats):
    run.run(load("radarsat1", [f"data.file={recorded(f'radarsat1_{block}.npz')}"]), tmp_path / block)
    best = metrics(tmp_path / block)["methods"]["recommended"]["metrics"]
    assert best["doppler_baseband_hz"] == pytest.approx(baseband_hz, abs=5)
    assert best["doppler_centroid_hz"] == pytest.approx(absolute_hz, abs=25)
    assert best["effective_velocity_m_s"] == pytest.approx(7066, abs=3)
    assert best["entropy_nats"] <= entropy_nats + 0.01
