"""Recommended images of all systems beside the direct sum at random pixels."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.study.scenes import bench_of, world
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Choice, choices_of

# largest errors in dB: what these small scenes neglect, with a few dB to spare
BARS = {"stripmap": -15.0, "isal": -15.0, "isal_rotation": -25.0, "sal": -60.0, "geo": -30.0}


def compared(bench: Bench) -> Choice:
    return next(choice for choice in choices_of(bench) if choice.name == "image beside the direct sum")


def losses(choice: Choice) -> list[float]:
    assert choice.measured is not None
    measured = choice.measured()
    return [measured.loss(one, measured.run(one))["image_error_db"] for one in choice.alternatives]


@pytest.mark.parametrize("system", BARS)
def test_recommended_images_are_those_of_the_direct_sum(tmp_path: Path, system: str) -> None:
    made, exact = losses(compared(bench_of(tmp_path, system)))
    assert exact < -250 < made < BARS[system]


def test_the_loss_of_a_turntable_grows_with_migration(tmp_path: Path) -> None:
    """Twice the bandwidth makes twice the range cells of the migration: four times the error."""
    narrow, wide = (
        losses(compared(bench_of(tmp_path, "isal", f"radar.bandwidth_hz={band}", "world.samples=64")))[0]
        for band in (300e9, 600e9)
    )
    assert wide - narrow == pytest.approx(6, abs=1)


def test_a_ladar_without_an_image_has_no_such_comparison(tmp_path: Path) -> None:
    stages = {"motion": {"stage": "radial_motion"}}
    bench = bench_of(tmp_path, "sal", processor={"recommended": {"stages": stages}}, metrics={})
    assert all(choice.name != "image beside the direct sum" for choice in choices_of(bench))


@pytest.mark.parametrize("beam", [None, {"width_deg": 0.5}])
def test_omega_k_stands_beside_tiles_where_a_method_uses_it(tmp_path: Path, beam: dict | None) -> None:
    strip = {
        "stage": "omega_k_image",
        "azimuth_m": 10.0,
        "range_m": 10.0,
        "step_m": 0.5,
        "beam_deg": 0.8,
        "window": "none",
        "uses": {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")},
    }
    tiles = {**strip, "stage": "tile_image"}
    methods = {"recommended": {"stages": {"image": tiles}}, "omega_k": {"stages": {"image": strip}}}
    # pulses 0.05 m apart, so that they sample the beam
    track = {
        "nominal": {"kind": "straight_path", "start_m": [-1500.0, -10.0, 1500.0], "velocity_m_s": [0.0, 5.0, 0.0]},
        "x": {"sway": {"kind": "sinusoid", "amplitude_m": 0.2, "frequency_hz": 0.3}},
    }
    scene = world("path", pulses=400, transmitter=track, navigation=None, beam=beam)
    bench = bench_of(tmp_path, "path", processor=methods, world=scene, metrics={})
    (choice,) = choices_of(bench)
    assert choice.measured is not None
    measured = choice.measured()
    one = next(one for one in choice.alternatives if one.name == "omega-K after motion compensation of order 2")
    assert one.loss is not None
    loss = measured.loss(one, measured.run(one))["image_error_db"]
    # the narrower antenna sees less of the change of motion errors with the angle
    assert abs(loss - one.loss["image_error_db"]) < 3.5 and loss < (-38 if beam else -20)
    # tiles sum the pulses of the same beam
    tiles = next(one for one in choice.alternatives if one.name == "tiles at -40 dB")
    assert tiles.loss is not None
    assert measured.loss(tiles, measured.run(tiles))["image_error_db"] < tiles.loss["image_error_db"] + 3
