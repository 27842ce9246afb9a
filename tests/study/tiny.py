"""A config that runs in a second, and its parts."""

from __future__ import annotations

from pathlib import Path

import yaml

TINY: dict = {
    "title": "tiny",
    "seed": 3,
    "radar": {
        "carrier_hz": 3.2e9,
        "pulse": {"bandwidth_hz": 40e6, "duration_s": 0.5e-6},
        "sampling_hz": 50e6,
        "prf_hz": 400.0,
        "velocity_m_s": 120.0,
        "near_range_m": 4000.0,
        "pointing_doppler_hz": 0.0,
        "integration_s": 0.2,
    },
    "world": {
        "lines": 192,
        "samples": 128,
        "beam": {"kind": "dwell", "dwell_s": 0.2},
        "noise": {"snr_db": 20.0},
        "scene": {
            "points": {"kind": "points", "azimuth_m": [0.0, 9.0], "range_m": [0.0, 40.0]},
            "field": {
                "kind": "speckle",
                "count": 20,
                "azimuth_extent_m": 4.0,
                "range_extent_m": 10.0,
                "level_db": -20.0,
            },
        },
    },
    "processor": {
        "clean": {"input": "clean", "stages": {"focus": {"stage": "omega_k", "reference": "flat"}}},
        "recommended": {
            "stages": {
                "doppler": {"stage": "phase_increment"},
                "focus": {
                    "stage": "omega_k",
                    "reference": "flat",
                    "uses": {"doppler_hz": "doppler.doppler_baseband_hz"},
                },
            }
        },
        "squint_ignored": {
            "rerun": {"method": "recommended", "start": "focus", "given": {"doppler.doppler_baseband_hz": 100.0}}
        },
    },
    "metrics": {"reference": "clean"},
}


def write_tiny(folder: Path, **changes: object) -> Path:
    """tiny.yaml in the folder, with top-level sections replaced (None removes one)."""
    tree = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return path
