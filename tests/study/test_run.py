"""A whole run: what lies in the folder, and that it is whole or absent."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import zarr
from torchsar.study.config import load
from torchsar.study.stripmap.run import run

from tests.study.tiny import write_tiny
from torchsar.study.settings.errors import ConfigError


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    run(load(str(write_tiny(folder))), folder / "result")
    return folder / "result"


def test_folder_holds_what_is_promised(out: Path) -> None:
    assert sorted(path.name for path in out.iterdir()) == [
        ".torchsar",
        "arrays.zarr",
        "config.yaml",
        "figures",
        "metrics.json",
        "report.html",
    ]
    for png in (out / "figures").iterdir():
        assert png.read_bytes().startswith(b"\x89PNG")
    assert len(list((out / "figures").iterdir())) >= 5


def test_metrics_follow_the_schema(out: Path) -> None:
    tree = json.loads(
        (out / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert set(tree) == {"methods", "published", "truth", "definitions"}
    assert {"snr", "contrast", "islr_extent_nulls"} <= set(tree["definitions"])
    best = tree["methods"]["recommended"]
    assert {"metrics", "estimates", "targets"} <= set(best)
    assert {
        "entropy_nats",
        "contrast",
        "seconds",
        "doppler_baseband_hz",
        "doppler_centroid_hz",
        "effective_velocity_m_s",
        "squint_deg",
        "image_error_db",
    } <= set(best["metrics"])
    assert all(isinstance(value, (int, float)) for value in best["metrics"].values())
    assert set(best["targets"]) == {"points.0", "points.1"}
    for estimate in best["estimates"].values():
        assert set(estimate) == {"value", "std", "ok"}


def test_metrics_say_what_is_true(out: Path) -> None:
    tree = json.loads((out / "metrics.json").read_text())
    clean, best, off = (tree["methods"][name]["metrics"] for name in ("clean", "recommended", "squint_ignored"))
    assert clean["targets_found"] == best["targets_found"] == 2
    assert abs(best["doppler_centroid_hz"] - tree["truth"]["doppler_hz"]) < 15
    assert best["image_error_db"] < -25 < off["image_error_db"]
    assert abs(tree["methods"]["recommended"]["targets"]["points.0"]["position_error_range_m"]) < 0.2
    assert math.isclose(off["doppler_centroid_hz"], 100.0)


def test_arrays_carry_images_and_axes(out: Path) -> None:
    root = zarr.open_group(str(out / "arrays.zarr"), mode="r")
    assert set(root.group_keys()) == {"clean", "recommended", "squint_ignored", "truth", "estimate"}
    image = root["recommended/image"]
    assert image.metadata.zarr_format == 3 and image.metadata.dimension_names == ("azimuth", "range")
    assert image.shape == (192, 128) and image.dtype == np.complex64
    azimuth, range_m = root["recommended/azimuth"][:], root["recommended/range"][:]
    assert azimuth.shape == (192,) and range_m.shape == (128,)
    peak = np.unravel_index(np.abs(image[:]).argmax(), image.shape)
    zero, closest = root["truth/zero_doppler_s"][:2], root["truth/closest_range_m"][:2]
    assert min(np.hypot(azimuth[peak[0]] - 120.0 * zero, range_m[peak[1]] - closest)) < 4
    assert root["estimate/recommended/doppler.doppler_baseband_hz"].shape == ()


def test_same_seed_same_numbers_other_seed_other_numbers(out: Path, tmp_path: Path) -> None:
    def entropy(*assignments: str) -> float:
        run(load(str(write_tiny(tmp_path)), assignments), tmp_path / "again")
        return json.loads((tmp_path / "again" / "metrics.json").read_text())["methods"]["clean"]["metrics"][
            "entropy_nats"
        ]

    first = json.loads((out / "metrics.json").read_text())["methods"]["clean"]["metrics"]["entropy_nats"]
    assert entropy() == first
    assert entropy("seed=4") != first


def test_report_shows_the_figures_of_metrics_json_and_asks_for_nothing(out: Path) -> None:
    text = (out / "report.html").read_text()
    tree = json.loads((out / "metrics.json").read_text())
    assert f"{tree['methods']['recommended']['metrics']['entropy_nats']:.3f}" in text
    assert "published" in text and "islr_extent_nulls" in text and "snr_db: 20.0" in text
    for outside in ("http://", "https://", "<script", 'src="figures', "@import", "url("):
        assert outside not in text
    assert text.count("data:image/png;base64,") == len(list((out / "figures").iterdir()))


def test_a_failed_run_leaves_nothing(tmp_path: Path) -> None:
    loaded = load(
        str(write_tiny(tmp_path)),
        [
            "processor.recommended.stages.focus.doppler_hz=[1.0, 2.0]",
            "processor.recommended.stages.focus.uses={}",
            "processor.squint_ignored.rerun.start=doppler",
        ],
    )
    with pytest.raises(ConfigError, match="processor.recommended: doppler_hz of shape"):
        run(loaded, tmp_path / "result")
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]
