"""System 004: every impairment at once, repaired; and the recordings focused end to end by the
shipped configs.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from torchsar.study.commands.run import run
from torchsar.study.table import load


def metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def test_all_impairments_at_once(tmp_path):
    run(load("stripmap_damaged"), tmp_path / "strip")
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


@pytest.mark.parametrize(
    ("block", "baseband_hz", "absolute_hz", "entropy_nats"),
    [("english_bay", 488, -7050, 10.018), ("squamish", 549, -6990, 11.974)],
)
def test_recordings_end_to_end(recorded, tmp_path, block, baseband_hz, absolute_hz, entropy_nats):
    run(load("radarsat1", [f"data.file={recorded(f'radarsat1_{block}.npz')}"]), tmp_path / block)
    best = metrics(tmp_path / block)["methods"]["recommended"]["metrics"]
    assert best["doppler_baseband_hz"] == pytest.approx(baseband_hz, abs=5)
    assert best["doppler_centroid_hz"] == pytest.approx(absolute_hz, abs=25)
    assert best["effective_velocity_m_s"] == pytest.approx(7066, abs=3)
    assert best["entropy_nats"] <= entropy_nats + 0.01
