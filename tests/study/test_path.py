"""Antennas on any path: what is theirs alone in the frame of all systems, and recordings."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.study.scenes import PATH, TILES, bench_of, loaded_as, run, world
from torchsar.core import Axis, Draws, Estimate, Signal, centred_ifft
from torchsar.radar import LIGHT_M_S
from torchsar.study.commands.requires import needs, refuse_beyond_limits
from torchsar.study.commands.run import _entry
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import cases_of
from torchsar.study.systems.path.figures import paths
from torchsar.study.table import load
from torchsar.study.trials.batch import Judged, Processed, Result
from torchsar.study.trials.bench import Bench

pytestmark = pytest.mark.usefixtures("blank_pictures")


def metrics_of(bench: Bench, trials: int = 2, seed: int = 3) -> dict[str, dict[str, torch.Tensor]]:
    outcomes = bench.batch(Draws(seed, "run", range(trials)), detail=True).outcomes
    return {name: {key: value.double() for key, value in one.metrics.items()} for name, one in outcomes.items()}


def test_autofocus_corrects_what_navigation_leaves(tmp_path: Path) -> None:
    found = metrics_of(bench_of(tmp_path, "path"), 4)
    ideal, none, best = (found[name] for name in ("ideal", "none", "recommended"))
    assert bool((ideal["position_error_rms_m"] < 0.01).all()) and bool((ideal["path_residual_rms_m"] == 0).all())
    assert bool((none["path_residual_rms_m"] > 1e-3).all()) and bool((none["image_error_db"] > -12).all())
    assert bool(best["ok"].all()) and bool((best["path_residual_rms_m"] < 3e-4).all())
    assert bool((best["image_error_db"] < -24).all()) and bool((best["position_error_rms_m"] < 0.02).all())
    assert bool((best["amplitude_error_db"] < best["image_error_db"]).all()) and bool(
        (best["phase_error_rad"] < 0.1).all()
    )
    assert bool((none["amplitude_error_db"] > -12).all()) and bool(
        (best["irw_azimuth_m"] < none["irw_azimuth_m"]).all()
    )


def test_the_residual_of_a_path_has_no_shift_and_is_that_of_the_truth(tmp_path: Path) -> None:
    """Offset and drift shift the image; of a sinusoid of 1 mm along x, 0.71 mm along the line of
    sight, three cycles are left, less their slope: a share of 6 / (3 pi)^2 of their power.
    """
    bias = {"bias": {"kind": "offset", "metres": 0.05}, "drift": {"kind": "polynomial", "coefficients_m": [0.01]}}
    sway = {"sway": {"kind": "sinusoid", "amplitude_m": 1e-3 * math.sqrt(2), "frequency_hz": 100 / 96 * 3}}
    bench = bench_of(tmp_path, "path", world=world("path", navigation={"x": {**bias, **sway}}))
    found = metrics_of(bench)["none"]
    torch.testing.assert_close(found["path_residual_rms_m"], torch.full((2,), 6.83e-4).double(), rtol=0.01, atol=0)
    assert bool((found["image_shift_m"] > 0.02).all()) and bool((found["position_error_rms_m"] < 0.03).all())


def test_images_of_one_path_are_compared_without_registration(tmp_path: Path) -> None:
    """A shift is an error as in `requires`, but where another path than that of the reference is
    used, since autofocus cannot observe it.
    """
    bench, axes = bench_of(tmp_path, "path"), (Axis("azimuth", 64, 0.0, 0.5, "m"), Axis("range", 64, 0.0, 0.5, "m"))
    image = centred_ifft(centred_ifft(torch.randn(64, 64, dtype=torch.complex128)[20:44, 20:44].contiguous()), -2)
    image = torch.nn.functional.pad(image, (20, 20, 20, 20))

    def of(data: torch.Tensor, left_m: float) -> Processed:
        judged = Judged({"path_residual_rms_m": torch.zeros(1)}, view=torch.full((1, 40), left_m).double())
        return Processed(judged, signal=Signal(data, axes))

    ideal, moved = of(image, 0.0), image.roll(2, 0) * (1 + 0.01 * torch.randn(64, 64))
    same, other = (bench.system.compare(bench, of(moved, left), ideal).metrics for left in (0.0, 1e-3))
    assert float(same["image_error_db"]) > -5 and float(other["image_error_db"]) < -20
    assert float(same["amplitude_error_db"]) == float(other["amplitude_error_db"]) < -20


def test_a_sweep_of_navigation_errors_and_noise_runs_in_one_batch(tmp_path: Path) -> None:
    methods = {name: PATH["processor"][name] for name in ("ideal", "none", "recommended")}
    trial = SweepTrial(loaded_as(tmp_path, "path", processor=methods))
    walk, snr = "world.navigation.x.walk.m_per_root_s", "world.noise.snr_db"
    record = sweep(trial, {walk: [0.0, 0.02], snr: [0.0, 20.0]}, batched=[walk, snr], trials=2, seed=1)
    names = list(record.algorithms)
    residual = np.asarray(record.metrics["path_residual_rms_m"])
    none, best = residual[names.index("none")], residual[names.index("recommended")]
    assert (none[0] < 1e-9).all() and (none[1] > 1e-3).all()
    assert (best[:, 1] < 2e-4).all() and (best[1] < none[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize("config", ["airborne_spotlight", "bistatic_fixed", "drone_stripmap"])
def test_packaged_configs_work_at_reduced_size(config: str) -> None:
    small = [
        f"processor.{name}.stages.image.{side}_m=6.0"
        for name in ("ideal", "recommended")
        for side in ("azimuth", "range")
    ]
    if config == "airborne_spotlight":
        small += ["processor.recorded.stages.image.azimuth_m=6.0", "processor.recorded.stages.image.range_m=6.0"]
        small += ["processor.recommended.stages.autofocus.extent_m=12.0", "world.pulses=96"]
    small += ["world.scene.field.count=20", "world.trials=1", "world.scene.corners.amplitude=null"]
    bench = Bench(next(iter(cases_of(load(config, small)).values())))
    if config == "drone_stripmap":
        assert bench.world().beam is not None and bench.world().window_range_m == 500.0
        return
    found = metrics_of(bench, 1)
    assert float(found["ideal"]["position_error_rms_m"]) < 0.02
    if config == "bistatic_fixed":
        assert float(found["recommended"]["image_error_db"]) < -75


@pytest.mark.parametrize("config", ["airborne_spotlight", "bistatic_fixed", "drone_stripmap"])
def test_samples_too_coarse_for_an_image_are_warned_of(config: str, caplog: pytest.LogCaptureFixture) -> None:
    for changes in ([], ["processor.recommended.stages.image.step_m=0.9"]):
        bench = Bench(next(iter(cases_of(load(config, changes)).values())))
        refuse_beyond_limits(bench, "one")
        warned = "step_m of the image in azimuth is 0.9 m" in caplog.text and "choose a finer step_m" in caplog.text
        assert warned == bool(changes) == bool(caplog.text)


def archive(folder: Path) -> Path:
    """Recorded phase history of some points from a circle."""
    made, frequency = np.random.default_rng(2), 9.4e9 + 4e6 * np.arange(64)
    angle = np.linspace(-0.04, 0.04, 80)
    place = 2000 * np.stack([-np.cos(angle), np.sin(angle), np.ones(80)], -1)
    history = np.zeros((64, 80), complex)
    for _ in range(25):
        point = np.append(made.uniform(-8, 8, 2), 0.0)
        path = 2 * (np.linalg.norm(place - point, axis=-1) - np.linalg.norm(place, axis=-1))
        history += made.normal() * np.exp(-2j * np.pi / LIGHT_M_S * frequency[:, None] * path)
    path = folder / "recorded.npz"
    reference = 2 * np.linalg.norm(place, axis=-1)
    np.savez(path, history=history, freq_hz=frequency, transmitter_m=place, path_reference_m=reference, prf_hz=100.0)
    return path


def test_errors_are_added_to_a_recorded_path_and_corrected(tmp_path: Path) -> None:
    error = {"kind": "path_error", "x": {"sway": {"kind": "sinusoid", "amplitude_m": 0.01, "frequency_hz": 4.0}}}
    config = loaded_as(
        tmp_path,
        "path",
        radar=None,
        world=None,
        metrics={"reference": "ideal"},
        data={"file": str(archive(tmp_path)), "impairments": {"path": error}},
    )
    tree = run(config.file, tmp_path / "out")
    none, best = (tree["methods"][name]["metrics"] for name in ("none", "recommended"))
    assert none["path_residual_rms_m"] == pytest.approx(0.005, rel=0.1) and none["image_error_db"] > -3
    assert best["path_residual_rms_m"] < 4e-4 and best["image_error_db"] < -12
    # the path acts differently on near and far parts of the scene, which phases alone cannot follow
    assert set(tree["methods"]["recommended"]["outcomes"]["phase"]) <= {"OK", "PARTS_DISAGREE"}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (
            {"transmitter": {"nominal": {"kind": "straigt"}}},
            "transmitter.nominal.kind.*did you mean 'straight_path'",
        ),
        ({"transmitter": {**PATH["world"]["transmitter"], "x": {"a": {"kind": "jiter"}}}}, "did you mean 'jitter'"),
        ({"navigation": {"latency_s": 0.7}}, "world.navigation.latency_s|latency_s of a navigation"),
        ({"beam": {"width_deg": 200.0}}, "between 0 and 180 degrees"),
        ({"pulses": 1}, "two pulses"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        metrics_of(bench_of(tmp_path, "path", world=world("path", **changes)))


def test_auto_takes_tiles_and_images_of_other_stages_have_no_points(tmp_path: Path) -> None:
    chosen = {"stages": {"image": {**TILES, "stage": "auto"}}}
    bench = bench_of(tmp_path, "path", processor={"recommended": chosen}, metrics={})
    assert "tiles at -40 dB was chosen" in bench.chosen[0]


def test_a_pulse_rate_below_the_band_of_the_beam_is_named(tmp_path: Path) -> None:
    """100 m/s at 9.6 GHz: a beam of 1 degree has a band of 4 v sin(0.5 deg) / lambda = 111.8 Hz."""
    for width, verdict in ((1.0, "warn"), (0.8, "ok")):
        bench = bench_of(tmp_path, "path", world=world("path", beam={"width_deg": width}))
        (limit,) = (one for one in bench.system.limits(bench) if "distance of pulses" in one.name)
        assert limit.verdict == verdict and limit.limit == pytest.approx(100 / 111.8 / width, rel=0.02)


def test_what_a_strip_does_not_see_adds_nothing_to_the_deviation_of_a_path(tmp_path: Path) -> None:
    bench, seen = bench_of(tmp_path, "path"), torch.arange(40) >= 20
    std = torch.where(seen, 1e-4, 5e-3).double()[None]
    estimate = Estimate({"line_of_sight_m": std}, std={"line_of_sight_m": std})
    judged = Judged({}, view=torch.zeros(1, 40).double().masked_fill(~seen, math.nan))
    found = bench.system.found(bench, Processed(judged, {"autofocus": estimate}), bench.trials(bench.draws(0, [0])))
    entry = _entry(found["autofocus.line_of_sight_m"])
    assert entry["value"] == pytest.approx(1e-4) and entry["std"] == pytest.approx(1e-4)


@pytest.mark.parametrize("metres", [0.0, 1e-3])
def test_paths_without_errors_have_no_panel(tmp_path: Path, metres: float) -> None:
    sway = {"sway": {"kind": "sinusoid", "amplitude_m": metres, "frequency_hz": 3.0}}
    own = {"nominal": PATH["world"]["transmitter"]["nominal"]}
    bench = bench_of(tmp_path, "path", world=world("path", navigation={"x": sway}, transmitter=own))
    drawn = list(paths(Result(bench, bench.batch(Draws(3, "run", range(1)), methods=["none"]), {}, {}, {}, {}, {})))
    assert [len(figures) for *_, figures in drawn] == ([1] if metres else [])


def test_a_motion_log_is_flown(tmp_path: Path) -> None:
    rows = (f"{t / 50:.2f},-1500,{100 * t / 50 - 48},1500" for t in range(80))
    (tmp_path / "log.csv").write_text("\n".join(["time_s,x,y,z", *rows]))
    nominal = {"kind": "recorded_path", "file": str(tmp_path / "log.csv")}
    own = {**PATH["world"]["transmitter"], "nominal": nominal}
    found = metrics_of(bench_of(tmp_path, "path", world=world("path", transmitter=own)))
    straight = metrics_of(bench_of(tmp_path, "path"))
    for key in ("entropy_nats", "path_residual_rms_m"):
        torch.testing.assert_close(found["ideal"][key], straight["ideal"][key], rtol=1e-3, atol=1e-9)


def test_what_a_flight_requires(tmp_path: Path) -> None:
    """A sway of 0.3 m along x at 1 Hz over one period, 45 degrees from the line of sight, and a
    recorded speed that is 2 m/s too high.
    """
    drift = {"y": {"drift": {"kind": "polynomial", "coefficients_m": [2.0]}}}
    bench = bench_of(tmp_path, "path", world=world("path", navigation=drift))
    rows = {row.effect: row for row in bench.system.requirements(bench)}
    time = np.arange(96) / 100
    sway = 0.3 * np.sin(2 * np.pi * time) / np.sqrt(2)
    left = np.abs(sway - np.polyval(np.polyfit(time, sway, 1), time)).max()
    turn = 4 * np.pi * 9.6e9 / LIGHT_M_S
    assert rows["a straight path"].phase_rad == pytest.approx(turn * left, rel=0.05) and not rows["a straight path"].ok
    # 2 m/s too fast at 100 m/s: after half of 0.96 s the range differs by v dv t^2 / R
    distance = 1500 * np.sqrt(2)
    assert rows["the recorded speed"].phase_rad == pytest.approx(turn * 100 * 2 * 0.48**2 / distance, rel=0.05)
    assert "an error of 2 m/s" in rows["the recorded speed"].neglects and rows["the recorded path"].ok
    # a sixteenth of the wavelength of 31.2 mm
    assert "0.00195 m along the line of sight leave a phase of pi / 4" in rows["the recorded path"].neglects
    assert rows["an antenna at rest during an echo"].ok


@pytest.mark.parametrize(
    ("velocity_m_s", "range_axis_rad", "said"),
    [
        ([100.0, 0.0, 0.0], 0.0, True),
        ([100.0, 0.0, 0.0], -math.pi / 2, False),
        ([0.0, 100.0, 0.0], 0.0, False),
        ([0.0, 100.0, 0.0], math.pi / 2, True),
    ],
)
def test_a_flight_along_the_range_axis_is_named(
    tmp_path: Path, velocity_m_s: list[float], range_axis_rad: float, said: bool
) -> None:
    start_m = [-1500.0 * (v == 0) for v in velocity_m_s[:2]]
    flight = {"nominal": {"kind": "straight_path", "start_m": [*start_m, 1500.0], "velocity_m_s": velocity_m_s}}
    images = {"recommended": {"stages": {"image": {**TILES, "range_axis_rad": range_axis_rad}}}}
    changed = world("path", transmitter=flight, navigation=None)
    bench = bench_of(tmp_path, "path", world=changed, processor=images, metrics={})
    sentence = "along the range axis of the image: widths 'in azimuth' are then those across the track"
    assert sum(sentence in text for text in needs(bench)["warnings"]) == said
    with warnings.catch_warnings(record=True) as caught:  # as in `run`
        warnings.simplefilter("always")
        refuse_beyond_limits(bench, "")
    assert sum(sentence in str(one.message) for one in caught) == said


def test_an_origin_with_its_latitude_and_longitude_exchanged_is_named(tmp_path: Path) -> None:
    rows = (f"{t / 50:.2f},{48 + 1e-5 * t},11.0,520" for t in range(80))
    (tmp_path / "log.csv").write_text("\n".join(["time_s,lat,lon,alt_m", *rows]))
    nominal = {"kind": "recorded_path", "file": str(tmp_path / "log.csv"), "origin": [11.0, 48.0, 300.0]}
    flight = {**PATH["world"]["transmitter"], "nominal": nominal}
    changed = world("path", transmitter=flight, beam={"width_deg": 6.0})
    images = {"recommended": {"stages": {"image": {**TILES, "beam_deg": 6.0}}}}
    bench = bench_of(tmp_path, "path", world=changed, processor=images, metrics={})
    with pytest.raises(ConfigError, match=r"passes it at 5.\d*e\+06 m; check the origin of a motion log"):
        refuse_beyond_limits(bench, "")
