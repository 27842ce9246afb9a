"""Small configs of all systems, and ways to write, load and run them."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.study.tiny import TINY
from torchsar import plot
from torchsar.cli import main
from torchsar.study.settings.sections import Loaded
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

CORRECT = {"stage": "correct_pulse_phase", "uses": {"phase_rad": "phase"}}
IMAGE = {"stage": "azimuth_transform"}

_TRUE_FOCUS = {
    "stage": "omega_k",
    "reference": "flat",
    "uses": {"doppler_hz": "truth.doppler_hz", "velocity_m_s": "truth.velocity_m_s"},
}
STRIPMAP: dict = {
    **TINY,
    "system": "stripmap",
    "world": {**TINY["world"], "doppler_hz": 4.0},
    "processor": {
        **TINY["processor"],
        "clean": {"input": "clean", "oracle": True, "stages": {"focus": _TRUE_FOCUS}},
        "squint_ignored": {
            "rerun": {"method": "recommended", "start": "focus", "given": {"doppler.doppler_baseband_hz": 12.0}}
        },
    },
    "metrics": {"reference": "clean", "published": {"targets_found": {"one": {"recommended": "all"}}}},
}

ISAL: dict = {
    "system": "isal",
    "title": "tiny target",
    "seed": 3,
    "radar": {
        "carrier_hz": 193.414489e12,
        "bandwidth_hz": 150e9,
        "prf_hz": 2000.0,
        "rotation_rad_s": 0.005,
        "pulse_s": 100e-6,
        "reference_range_m": 20e3,
    },
    "world": {
        "pulses": 96,
        "samples": 64,
        "scene": {"field": {"kind": "random_points", "count": 40, "azimuth_extent_m": 0.15, "range_extent_m": 0.05}},
        "start_phase": {"pulses": {"kind": "uniform_start_phase"}},
        "noise": {"snr_db": 15.0},
    },
    "processor": {
        "ideal": {"input": "clean", "stages": {"image": IMAGE}},
        "none": {"stages": {"image": IMAGE}},
        "sca": {"stages": {"phase": {"stage": "sca"}, "correct": CORRECT, "image": IMAGE}},
        "recommended": {"stages": {"phase": {"stage": "autofocus"}, "correct": CORRECT, "image": IMAGE}},
    },
    "metrics": {"reference": "ideal", "published": {"entropy_above_ideal_nats": {"one": {"sca": 1.0}}}},
}

_WARP = [10.0, 1000.0]
_KNOWN = {
    "range": {"stage": "range_phase", "omega_rad_s": 0.02, "warp_k": _WARP},
    "image": {"stage": "matched_fourier", "warp_k": _WARP},
}
FOUND_ROTATION = {
    "range": {"stage": "range_phase", "uses": dict.fromkeys(("omega_rad_s", "warp_k", "yc_m"), "rotation")},
    "image": {"stage": "matched_fourier", "uses": {"warp_k": "rotation"}},
}
ISAL_ROTATION: dict = {
    "system": "isal_rotation",
    "title": "tiny satellite",
    "seed": 3,
    "radar": {"wavelength_m": 1.55e-6, "bandwidth_hz": 624.567621e6, "prf_hz": 50e3, "reference_range_m": 100e3},
    "world": {
        "pulses": 1000,
        "samples": 32,
        "scene": {"satellite": {"kind": "satellite", "count": 60, "half_width_m": 0.6}},
        "rotation": {"omega_rad_s": 0.02, "k": _WARP},
        "noise": {"snr_db": 20.0},
    },
    "processor": {
        "ideal": {"input": "clean", "stages": _KNOWN},
        "none": {"stages": {"image": {"stage": "matched_fourier"}}},
        "coarse": {"stages": {"rotation": {"stage": "coarse_rotation"}, "image": FOUND_ROTATION["image"]}},
        "recommended": {"stages": {"rotation": {"stage": "uneven_rotation"}, **FOUND_ROTATION}},
    },
    "metrics": {"reference": "ideal", "published": {"omega_error_percent": {"one": {"coarse": 1.0}}}},
}

WINDOW = [1.0, 2.0]
MIRROR = {"stage": "mirror_product", "window_m": WINDOW}
SEGMENTED = {"stage": "segmented_interference", "window_m": WINDOW}


def ladar_method(velocity: dict | None = None, phase: dict | None = None, image: bool = True) -> dict:
    """A chain of a ladar: velocity compensated, phases of pulses corrected, image made."""
    stages = {}
    if velocity is not None:
        motion = {"stage": "compensate_motion", "uses": {"velocity_m_s": "velocity"}}
        stages = {"velocity": velocity, "compensate": motion}
    if image:
        stages |= {"compress": {"stage": "compress_sweeps"}, "deramp": {"stage": "deramp_azimuth"}}
        stages |= {"phase": phase, "correct": CORRECT} if phase else {}
        stages |= {"image": {"stage": "azimuth_matched_filter", "beam_rad": 114e-6}}
    return {"stages": stages}


SAL: dict = {
    "system": "sal",
    "title": "tiny ladar",
    "seed": 2,
    "radar": {
        "wavelength_m": 1.55e-6,
        "bandwidth_hz": 5e9,
        "period_s": 16e-6,
        "sample_rate_hz": 32e6,
        "speed_m_s": 60.0,
        "reference_range_m": 3000.0,
    },
    "world": {
        "periods": 384,
        "scene": {"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [1.5]}},
        "motion": {
            "drift": {"kind": "drift", "velocity_m_s": 0.35, "acceleration_m_s2": 20.0},
            "slow": {"kind": "sinusoid", "frequency_hz": 100.0, "amplitude_m": 160e-6, "phase_deg": 17.0},
        },
        "noise": {"snr_db": 20.0},
    },
    "processor": {
        "ideal": {"input": "clean", **ladar_method()},
        "none": ladar_method(),
        "segmented": ladar_method(SEGMENTED),
        "sca": ladar_method(None, {"stage": "sca"}),
        "recommended": ladar_method(MIRROR, {"stage": "phase_polish"}),
    },
    "metrics": {
        "reference": "ideal",
        "target": "points.0",
        "published": {"pslr_azimuth_db": {"one": {"segmented": -12.49}}},
    },
}

TRUE_MOTION = {name: f"truth.{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}
FOUND_MOTION = dict.fromkeys(TRUE_MOTION, "velocity")
VELOCITY = {
    "stage": "moving_point_velocity",
    "aperture": {"kind": "dwell", "duration_s": 4.5},
    "search": {"u_r_m_s": 15.0, "u_a_m_s": 3.0},
}


def channels_method(uses: dict, bands: int = 2, before: dict | None = None) -> dict:
    """A chain of a moving point: its motion known or found, bands rebuilt, the target focused."""
    migration = {"stage": "correct_migration", "migration": {"kind": "static_bulk", "whole_swath": False}, "uses": uses}
    stages = {"transmit": {"stage": "remove_transmit_range"}, **(before or {}), "migration": migration}
    stages["rebuild"] = {"stage": "reconstruct", "rebuild": {"kind": "least_squares", "bands": bands}, "uses": uses}
    stages["focus"] = {"stage": "focus_azimuth", "bandwidth_hz": 337.5, "uses": uses}
    return {"oracle": uses == TRUE_MOTION, "stages": stages}


_BISTATIC = {
    "carrier_hz": 1.25e9,
    "bandwidth_hz": 50e6,
    "pulse_s": 10e-6,
    "sampling_hz": 60e6,
    "prf_hz": 180.0,
    "speed_m_s": 300.0,
    "reference_range_m": 5000.0,
    "wave_speed_m_s": 3e8,
    "orbit": {},
}
GEO: dict = {
    "system": "geo",
    "title": "tiny",
    "seed": 3,
    "radar": _BISTATIC,
    "world": {
        "pulses": 1024,
        "targets": {"slow": {"u_a_m_s": 2.0}, "fast": {"u_r_m_s": 10.0, "azimuth_m": 20.0}},
        "noise": {"raw_scnr_db": -10.0},
    },
    "processor": {
        "conventional": channels_method({}),
        "inverse_n3": channels_method(FOUND_MOTION, 3, {"velocity": VELOCITY}),
        "oracle": channels_method(TRUE_MOTION),
        "recommended": channels_method(FOUND_MOTION, before={"velocity": VELOCITY}),
    },
    "metrics": {"published_targets": {"mfta_db": {"one/fast": {"recommended": -56.7}}}},
}

FLOW = {
    "stage": "movers_image",
    "bands": 2,
    "integration_s": 2.0,
    "segment_s": 0.4,
    "half_along_m": 60.0,
    "half_range_m": 30.0,
    "u_a_reach_m_s": 12.0,
    "suppressed_m_s": [],
}


def scene_method(image: dict, uses: dict | None = None) -> dict:
    """A chain of a sea with ships, its image with the true motions where they are given."""
    last = {**image, "uses": uses} if uses else image
    return {"oracle": uses is not None, "stages": {"transmit": {"stage": "remove_transmit_range"}, "image": last}}


SHIP = {"u_r_m_s": 8.0, "scr_db": 20.0, "length_m": 40.0, "range_cells": 2, "count": 6}
GEO_OCEAN: dict = {
    "system": "geo_ocean",
    "title": "tiny",
    "seed": 1,
    "radar": _BISTATIC,
    "world": {
        "pulses": 540,
        "samples": 120,
        "targets": {"one": SHIP},
        "gate": {"kind": "band_limited", "duration_s": 2.0},
        "sea": {"kind": "k_sea", "cnr_db": 30.0},
    },
    "processor": {
        "conventional": scene_method({"stage": "stationary_image"}),
        "oracle": scene_method(FLOW, {**TRUE_MOTION, "range_m": "truth.range_m"}),
        "recommended": scene_method(FLOW),
    },
    "metrics": {"published_targets": {"displacement_vt_m": {"one": {"conventional": 133.0}}}},
}

_AUX = {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
TILES = {"stage": "tile_image", "azimuth_m": 20.0, "range_m": 20.0, "step_m": 0.25, "uses": _AUX}
_WALK = {"walk": {"kind": "random_walk", "m_per_root_s": 0.02, "step_s": 0.01}}
PATH: dict = {
    "system": "path",
    "title": "tiny flight",
    "seed": 3,
    "radar": {"carrier_hz": 9.6e9, "bandwidth_hz": 300e6, "prf_hz": 100.0},
    "world": {
        "pulses": 96,
        "samples": 64,
        "scene": {
            "corners": {"kind": "points", "azimuth_m": [0.0, 6.0], "range_m": [-3.0, 5.0], "amplitude": [9.0, 9.0]},
            "field": {"kind": "random_points", "count": 30, "azimuth_extent_m": 14.0, "range_extent_m": 14.0},
        },
        "transmitter": {
            "nominal": {
                "kind": "straight_path",
                "start_m": [-1500.0, -48.0, 1500.0],
                "velocity_m_s": [0.0, 100.0, 0.0],
            },
            "x": {"sway": {"kind": "sinusoid", "amplitude_m": 0.3, "frequency_hz": 1.0}},
        },
        "navigation": {"x": _WALK, "latency_s": 0.0},
        "noise": {"snr_db": 15.0},
    },
    "processor": {
        "ideal": {"input": "clean", "stages": {"image": TILES}},
        "none": {"stages": {"image": TILES}},
        "recommended": {"stages": {"phase": {"stage": "autofocus"}, "correct": CORRECT, "image": TILES}},
    },
    "metrics": {"reference": "ideal", "published": {"entropy_above_ideal_nats": {"one": {"none": 1.0}}}},
}

SCENES = {tree["system"]: tree for tree in (STRIPMAP, ISAL, ISAL_ROTATION, SAL, GEO, GEO_OCEAN, PATH)}


def world(system: str, **changes: object) -> dict:
    """The small world of a system with some of its keys changed."""
    return {**SCENES[system]["world"], **changes}


def radar(system: str, **changes: object) -> dict:
    """The radar of a system with some of its keys changed, None leaving one out."""
    return {key: value for key, value in {**SCENES[system]["radar"], **changes}.items() if value is not None}


def write(folder: Path, system: str, **changes: object) -> str:
    """The config of a system as small.yaml, with sections replaced, None leaving one out."""
    tree = {key: value for key, value in {**SCENES[system], **changes}.items() if value is not None}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return str(path)


def loaded_as(folder: Path, system: str, *overrides: str, **changes: object) -> Loaded:
    return load(write(folder, system, **changes), overrides)


def bench_of(folder: Path, system: str, *overrides: str, **changes: object) -> Bench:
    return Bench(loaded_as(folder, system, *overrides, **changes))


def run(config: str, out: Path, *overrides: str) -> dict:
    """metrics.json of a run by command."""
    assert main(["run", config, *overrides, "--out", str(out)]) == 0
    return json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def draw_first_panels(patch: pytest.MonkeyPatch, **copied: str) -> None:
    """Of every picture the first panel is drawn: the others are copies, since they differ only in
    their data. So are pictures that are named in the first place of `copied` instead of the second.
    """
    save, drawn = plot.save, {}

    def once(figure: Any, path: Path, **how: Any) -> None:
        kind = re.sub(r"_\d+$", "", path.stem.partition("_")[2])
        for name, original in copied.items():
            kind = kind.replace(name, original)
        if kind in drawn:
            shutil.copy(drawn[kind], path)
        else:
            save(figure, path, **how)
            drawn[kind] = path

    patch.setattr(plot, "save", once)
