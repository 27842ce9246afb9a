"""Configs that make no sense are refused in one sentence, and nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.study.scenes import (
    FLOW,
    FOUND_ROTATION,
    IMAGE,
    MIRROR,
    SCENES,
    SEGMENTED,
    SHIP,
    TRUE_MOTION,
    channels_method,
    ladar_method,
    radar,
    scene_method,
    world,
    write,
)
from torchsar.cli import main
from torchsar.study.commands.requires import refuse_beyond_limits
from torchsar.study.settings.errors import ConfigError
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench


def methods(system: str, **more: dict) -> dict:
    """The recommended method and others."""
    recommended = {"recommended": SCENES[system]["processor"]["recommended"]}
    return {"processor": {**recommended, **more}, "metrics": None}


def points(azimuth_m: list[float], range_m: list[float]) -> dict:
    return {"scene": {"points": {"kind": "points", "azimuth_m": azimuth_m, "range_m": range_m}}}


def rotating(**changes: object) -> dict:
    kept = {name: SCENES["isal_rotation"]["processor"][name] for name in ("ideal", "recommended")}
    return {"world": world("isal_rotation", **changes), "processor": kept}


FOUR = {"kind": "least_squares", "bands": 4}


def alone(image: dict, **changes: object) -> dict:
    return {"processor": {"recommended": {"stages": {"image": image}}}, "metrics": None, **changes}


VIBRATION = {"kind": "vibration", "name": "1_100_90", "unit": "mm"}
FAR = {"far": {"kind": "points", "azimuth_m": [0.0], "range_m": [5.0]}}
HUM = {"hum": {"kind": "tone", "over_signal_db": 9.0, "frequency_hz": 1e6}}
DENSE = points([0.0, 0.02], [1.5, 1.55])

MISTAKES = [
    # of every system
    ("isal", {"metrics": {"reference": "sca"}}, "name a method with 'input: clean'"),
    ("sal", {"beyond_limits": ["segmentd"]}, "beyond_limits names 'segmentd', which is no method"),
    ("sal", {"metrics": {"reference": ["sca"]}}, "metrics.reference names ['sca'], which is no method"),
    ("stripmap", {"world": world("stripmap", squint_deg=1.0)}, "both give the direction of the beam"),
    ("stripmap", {"world": world("stripmap", doppler_hz=None, squint_deg=90.0)}, "between -90 and 90 degrees"),
    ("stripmap", {"world": world("stripmap", lines=1)}, "world needs at least 2 lines, got 1"),
    ("stripmap", alone({"stage": "omega_k", "doppler_hz": [1.0, 2.0]}), "doppler_hz' has the value [1.0, 2.0]"),
    (
        "stripmap",
        alone({"stage": "compress_dechirped"}),
        "radar must be InverseRadar(carrier_hz, bandwidth_hz, prf_hz), got StripmapRadar",
    ),
    # isal
    ("isal", {"world": world("isal", motion={"v": {**VIBRATION, "name": "1_100"}})}, "amplitude_frequency_phase"),
    (
        "isal",
        {"world": world("isal", motion={"v": {"kind": "vibration", "name": "1_100_90"}})},
        "key 'world.motion.v.unit' is missing",
    ),
    ("isal", {"world": world("isal", scene=FAR, fidelity={"kind": "dechirped"})}, "range window"),
    (
        "isal",
        {"processor": {"recommended": {"stages": {"image": IMAGE, "phase": {"stage": "sca"}}}}, "metrics": None},
        "works on the axes",
    ),
    ("isal", {"radar": radar("isal", rotation_rad_s=None)}, "rotation"),
    (
        "isal",
        {"world": world("isal", impairments={"lost": {"kind": "lost_pulses", "count": 96}})},
        "lost pulses leave nothing",
    ),
    (
        "isal",
        methods("isal", odd={"stages": {"phase": {"stage": "sca"}}}),
        "processor.odd, whose last stage gives the axes ('pulse', 'range'), not an image",
    ),
    (
        "isal",
        methods("isal", odd={"stages": {"doppler": {"stage": "doppler_centroid"}, "image": IMAGE}}),
        "near_range_m), got InverseRadar",
    ),
    (
        "isal",
        methods("isal", odd={"stages": {"compress": {"stage": "range_compress"}, "image": IMAGE}}),
        "compress: RangeCompress: radar must be StripmapRadar(",
    ),
    (
        "isal",
        {"world": world("isal", impairments=HUM)},
        "unknown impairment of range profiles of a target 'tone'",
    ),
    (
        "isal",
        {"world": world("isal", impairments={"lost": {"kind": "lost_lines", "count": 3}})},
        "did you mean 'lost_pulses'",
    ),
    ("isal", {"radar": radar("isal", carrier_hz=1e-300)}, "should be 2e+07 Hz to 1e+16 Hz"),
    # isal_rotation
    ("isal_rotation", {"radar": radar("isal_rotation", carrier_hz=1.9e14)}, "give one of carrier_hz and wavelength_m"),
    ("isal_rotation", {"radar": radar("isal_rotation", wavelength_m=None)}, "give one of carrier_hz and wavelength_m"),
    ("isal_rotation", rotating(rotation={"omega_rad_s": 0.0}), "world.rotation"),
    ("isal_rotation", rotating(rotation={"omega_rad_s": 0.02, "k1": 10.0}), "key 'world.rotation.k1' is not known"),
    ("isal_rotation", rotating(rotation={"omega_rad_s": 0.02, "k": [-100.0, 2000.0]}), "two times have the same angle"),
    ("isal_rotation", rotating(rotation_rad_s=0.02), "world.rotation_rad_s"),
    (
        "isal_rotation",
        rotating(scene={"satellite": {"kind": "satellite", "count": 60, "half_width_m": 1.0}}),
        "Doppler over half the pulse rate is 1.445",
    ),
    (
        "isal_rotation",
        rotating(**points([0.05, 0.1, 0.2, 0.3], [0.0] * 4)),
        "range term, pi lambda sigma_y / ra^2 is 0 rad, and must be at least 1 rad: the rate",
    ),
    (
        "isal_rotation",
        rotating(**points([0.1, 0.2], [1.0, 2.0])),
        "scatterers above the noise is 2, and must be at least 3",
    ),
    (
        "isal_rotation",
        methods("isal_rotation", odd={"stages": {"rotation": {"stage": "uneven_rotation"}}}),
        "processor.odd, whose last stage gives the axes ('pulse', 'range'), not an image",
    ),
    (
        "isal_rotation",
        methods("isal_rotation", odd={"stages": {"image": FOUND_ROTATION["image"]}}),
        "processor.odd",
    ),
    (
        "isal_rotation",
        methods(
            "isal_rotation",
            odd={
                "stages": {
                    "rotation": {
                        "stage": "entropy_rotation",
                        "method": "genetic",
                        "low": [0.018, 9.0],
                        "high": [0.022, 11.0],
                    },
                    "image": {"stage": "matched_fourier"},
                }
            },
        ),
        "must hold the 3 values omega_rad_s, k1_per_s, k2_per_s2",
    ),
    # sal
    ("sal", {"radar": radar("sal", carrier_hz=2e14)}, "give one of carrier_hz and wavelength_m"),
    ("sal", {"radar": radar("sal", wavelength_m=None)}, "give one of carrier_hz and wavelength_m"),
    ("sal", {"radar": radar("sal", sample_rate_hz=33.3e6)}, "must give a whole number of samples"),
    (
        "sal",
        {"world": world("sal", motion={"drift": {"kind": "drift", "velocity_m_s": 30.0}})},
        "speed in the beat band is 30 m/s",
    ),
    ("sal", {"world": world("sal", gate_m=[3.0, 4.0])}, "no scatterer"),
    ("sal", {"world": world("sal", gate_m=[3.0])}, "gate_m"),
    (
        "sal",
        {"world": world("sal", motion={"track": {"kind": "measured_track", "file": "no.csv"}})},
        "world.motion.track",
    ),
    ("sal", {"world": world("sal", fidelity={"kind": "phase_only"})}, "unknown fidelity of a sweep 'phase_only'"),
    ("sal", {"metrics": {"target": "points.1"}}, "metrics.target names 'points.1', which is no point target"),
    (
        "sal",
        {"processor": {"recommended": ladar_method(MIRROR, image=False)}, "metrics": None},
        "processor.recommended, whose last stage gives the axes ('ramp', 'pulse', 'fast_time'), not an image",
    ),
    ("sal", alone({"stage": "azimuth_transform"}), "processor.recommended"),
    ("sal", alone({"stage": "target_image"}), "processor.recommended"),
    ("sal", {"world": world("sal", noise={"snr_db": 4000.0})}, "world.noise.snr_db is 4000 dB"),
    (
        "sal",
        {"world": world("sal", motion={"drift": {"kind": "drift", "velocity_m_s": float("nan")}})},
        "it should be a finite number",
    ),
    ("sal", {"world": world("sal", **points([0.0], [-4000.0]))}, "lies behind the ladar"),
    ("sal", {"world": world("sal", **points([0.0], [100.0]))}, "beat frequencies that alias"),
    (
        "sal",
        {
            "processor": {
                "recommended": {
                    "stages": {"compress": {"stage": "compress_sweeps"}, "image": {"stage": "azimuth_matched_filter"}}
                }
            },
            "metrics": None,
        },
        "needs profiles that are deramped once, but 0 stages deramp_azimuth",
    ),
    (
        "sal",
        {"world": world("sal", log_amplitude={"kind": "log_amplitude", "rms": -1.0})},
        "world.log_amplitude: rms",
    ),
    (
        "sal",
        {"world": world("sal", **DENSE), **methods("sal", segmented=ladar_method(SEGMENTED))},
        "processor.segmented: spacing of scatterers is 0.05 m, and must be at least 0.05996 m",
    ),
    (
        "sal",
        {"world": world("sal", noise={"snr_db": -15.0}), **methods("sal", segmented=ladar_method(SEGMENTED))},
        "processor.segmented: SNR after compression",
    ),
    # geo
    ("geo", {"radar": radar("geo", transmit_range=[1.0])}, "give one of transmit_range and orbit"),
    ("geo", {"radar": radar("geo", channel_m=[])}, "channel_m"),
    ("geo", {"radar": radar("geo", prf_hz=0.0)}, "prf_hz"),
    ("geo", {"radar": radar("geo", reference_range_m=2000.0)}, "height_m must lie in 0..reference_range_m"),
    ("geo", {"world": world("geo", noise={"snr_db": 0.0, "raw_scnr_db": 0.0})}, "both set the level of the targets"),
    ("geo", {"world": world("geo", noise={"scr_db": 0.0})}, "noise.scr_db, a signal-to-clutter ratio, needs world.sea"),
    (
        "geo",
        {"world": world("geo", sea={"kind": "k_sea"}, noise={})},
        "must be given with world.sea, whose level is relative to the noise",
    ),
    ("geo", {"world": world("geo", targets={"p": {"range_m": 10.0}})}, "azimuth-only data (null) have a single range"),
    ("geo", {"world": world("geo", targets={"p": {"u_a_m_s": 300.0}})}, "speed past the fastest target is 0 m/s"),
    ("geo", {"world": world("geo", pulses=600)}, "record is 3.333 s, and must be at least 4.5 s"),
    (
        "geo",
        {"processor": {"recommended": channels_method(TRUE_MOTION, 4)}, "metrics": None},
        "4 Doppler bands cannot be separated by 3 channels",
    ),
    (
        "geo",
        {
            "radar": radar("geo", prf_hz=187.5),
            "processor": {"recommended": channels_method(TRUE_MOTION, 3)},
            "metrics": None,
        },
        "at a pulse rate of 187.5 Hz and 300 m/s channels sample the same positions",
    ),
    (
        "geo",
        {
            "world": world("geo", targets={"p": {"u_a_m_s": 12.0}}),
            "processor": {"recommended": channels_method(TRUE_MOTION, 3)},
            "metrics": None,
        },
        "a speed past the target of 288 m/s the channels sample",
    ),
    (
        "geo",
        alone({"stage": "signal_intensity_ratio", "bandwidth_hz": 600.0}),
        "3 bands of 180 Hz leave nothing outside 600 Hz",
    ),
    ("geo", alone({"stage": "omega_k"}), "near_range_m), got BistaticRadar"),
    ("geo", {"metrics": {"reference": "recommended"}}, "metrics.reference"),
    # geo_ocean
    (
        "geo_ocean",
        {"world": world("geo_ocean", targets={"one": {**SHIP, "range_cells": 9}})},
        "at least one range cell and a scatterer for each, got range_cells=9 and count=6",
    ),
    ("geo_ocean", {"world": world("geo_ocean", pulses=180)}, "record is 1 s, and must be at least 2 s"),
    (
        "geo_ocean",
        {"processor": {"recommended": scene_method({"stage": "reconstruct"})}, "metrics": None},
        "end the chain with movers_image or stationary_image",
    ),
    (
        "geo_ocean",
        {
            "processor": {
                "recommended": scene_method(
                    {"stage": "stationary_image", "rebuild": {"kind": "least_squares", "bands": 4}}
                )
            },
            "metrics": None,
        },
        "4 Doppler bands cannot be separated by 3 channels",
    ),
    (
        "geo_ocean",
        {"processor": {"recommended": scene_method({**FLOW, "removal": "paint"})}, "metrics": None},
        "removal",
    ),
    (
        "geo_ocean",
        {
            "radar": radar("geo_ocean", prf_hz=187.5),
            "processor": {"recommended": scene_method({**FLOW, "bands": 3})},
            "metrics": None,
        },
        "at a pulse rate of 187.5 Hz and 300 m/s channels sample the same positions",
    ),
    ("geo_ocean", {"metrics": {"match_m": [1.0]}}, "metrics.match_m needs two positive distances"),
    (
        "geo_ocean",
        {"processor": {"recommended": scene_method(FLOW, {"u_r_m_s": "truth.u_r_m_s"})}, "metrics": None},
        "connect all four, or none",
    ),
]


@pytest.mark.parametrize(("system", "changes", "said"), MISTAKES, ids=[f"{s}: {said}" for s, _, said in MISTAKES])
def test_mistakes_are_named(
    system: str,
    changes: dict,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The file is named once. A method that fails ends a run where faults are looked for."""
    monkeypatch.setenv("TORCHSAR_DEBUG", "1")
    config = write(tmp_path, system, **changes)
    assert main(["run", config, "--out", str(tmp_path / "out")]) == 2
    sentence = capsys.readouterr().err
    assert said in sentence and sentence.replace(f"run {config}", "").count(config) == 1
    assert not (tmp_path / "out").exists()


SHOWN = [
    ("sal", {"world": world("sal", **DENSE), **methods("sal", segmented=ladar_method(SEGMENTED))}, "segmented"),
    ("isal_rotation", rotating(**points([0.05, 0.1, 0.2, 0.3], [0.0] * 4)), "recommended"),
    (
        "geo",
        {
            "radar": radar("geo", prf_hz=187.5),
            "processor": {"recommended": channels_method(TRUE_MOTION), "inverse_n3": channels_method(TRUE_MOTION, 3)},
            "metrics": None,
        },
        "inverse_n3",
    ),
]


@pytest.mark.parametrize(("system", "changes", "method"), SHOWN, ids=[system for system, *_ in SHOWN])
def test_a_method_may_be_shown_beyond_its_limits(
    system: str, changes: dict, method: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(
        ConfigError, match=rf"cases\.odd: processor\.{method}: .* \(or name the method in beyond_limits\)"
    ):
        refuse_beyond_limits(Bench(load(write(tmp_path, system, **changes))), "odd")
    refuse_beyond_limits(Bench(load(write(tmp_path, system, **changes, beyond_limits=[method]))), "odd")
    assert "warning: cases.odd: " in caplog.text


def test_requires_ends_as_run_where_it_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    system, changes, method = SHOWN[1]
    config, out = write(tmp_path, system, **changes), tmp_path / "out"
    assert main(["requires", config, "--out", str(out)]) == 2
    shown = capsys.readouterr()
    assert "refuse" in shown.out and f"`torchsar run` refuses this config: processor.{method}: " in shown.err
    assert json.loads((out / "requires.json").read_text())["all"]["refused"].startswith(f"processor.{method}: ")
    assert main(["requires", config, f"beyond_limits=[{method}]", "--out", str(out)]) == 0
    assert "refuses" not in capsys.readouterr().err


@pytest.mark.parametrize("system", ["isal_rotation", "sal", "geo", "geo_ocean"])
@pytest.mark.parametrize("command", ["run", "requires", "trade", "sweep"])
def test_systems_without_recordings_refuse_them(
    system: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "record.npz", profiles=np.zeros((4, 4), np.complex64))
    given = [write(tmp_path, system), f"data.file={tmp_path / 'record.npz'}", "--out", str(tmp_path / "out")]
    assert main([command, *given]) == 2
    assert "reads no recordings; omit" in capsys.readouterr().err


def test_an_unknown_system_is_named(tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text("system: isla\ntitle: x\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="is no system; did you mean 'isal'. .accepted: geo, "):
        load(path)


@pytest.mark.parametrize("system", SCENES)
def test_a_sweep_has_no_cases(system: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write(tmp_path, system, cases={"quiet": {"seed": 30}}, sweep={"precision": ["complex64"], "trials": 1})
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 2
    assert "cases cannot be used in a sweep" in capsys.readouterr().err
