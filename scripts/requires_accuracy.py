"""How reliable is the advice of `torchsar requires`? Its predicted losses against measured ones.

python scripts/requires_accuracy.py [docs/requires] [--scenes 24] [--systems stripmap geo] [--table]

Scenes are points of a Sobol sequence over the parameters of each system (squint, aperture, swath,
range, velocity, rotation and the like). In each of them every loss that `requires` predicts is
measured as `torchsar trade` measures it. A prediction within the tolerance of the system says
"acceptable"; precision is the share of these that the measurement confirms, recall the share of
acceptable ones that are found. The recorded scenes are held out: the predictions were developed on
those of another seed. `--table` prints the recorded figures without measuring again.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchsar.study.settings.errors import ConfigError
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import choices_of, tolerance_of

# of the Sobol sequence; the predictions were developed on scenes of seed 1
SEED = 2
HELD_OUT = f"scenes are points of the Sobol sequence of seed {SEED}; predictions were developed on seed 1"
Spans = Mapping[str, tuple[float, float]]
# predictions are compared closely where the measured loss lies so near the tolerance, in dB
NEAR_DB = 10.0
# logarithms of losses below this are rounding
FLOOR_DB = -100.0


@dataclass(frozen=True)
class Family:
    """Scenes of a system.

    Args:
        config: A packaged config.
        spans: Least and largest value of each parameter; positive ones are spread in logarithm.
        overrides: The changes of the config that make the scene of given parameters.
    """

    config: str
    spans: Spans
    overrides: Callable[[Mapping[str, float]], Mapping[str, Any]]

    def scenes(self, count: int, first: int = 0) -> Iterator[dict[str, float]]:
        """Successive points of the scrambled Sobol sequence of the seed."""
        sequence = torch.quasirandom.SobolEngine(len(self.spans), scramble=True, seed=SEED).fast_forward(first)
        for point in sequence.draw(count).tolist():
            yield {name: _spread(u, *span) for u, (name, span) in zip(point, self.spans.items(), strict=True)}


def _spread(u: float, low: float, high: float) -> float:
    value = low * (high / low) ** u if low > 0 else low + (high - low) * u
    return float(f"{value:.4g}")


def stripmap(p: Mapping[str, float]) -> dict[str, Any]:
    """A slow platform, squinted by up to 8 degrees; the record holds one aperture and the swath."""
    wavelength, bandwidth = 3e8 / 3.2e9, p["bandwidth_hz"]
    velocity, near, squint = 120.0, p["near_range_m"], 8 * p["squint"] ** 3
    rate = 2 * velocity**2 / (wavelength * near)
    aperture = p["doppler_band_hz"] / rate
    prf = 1.4 * p["doppler_band_hz"]
    return {
        "radar.carrier_hz": 3.2e9,
        "radar.pulse": {"bandwidth_hz": bandwidth, "duration_s": 0.4e-6},
        "radar.sampling_hz": 1.25 * bandwidth,
        "radar.prf_hz": prf,
        "radar.velocity_m_s": velocity,
        "radar.near_range_m": near,
        "radar.pointing_doppler_hz": 2 * velocity / wavelength * math.sin(math.radians(squint)),
        "radar.integration_s": aperture,
        "world.lines": math.ceil(1.5 * aperture * prf),
        "world.samples": math.ceil((p["swath_m"] / 1.2e8 + 0.4e-6) * bandwidth) + 64,
        "world.velocity_m_s": velocity,
        "world.doppler_hz": None,
        "world.squint_deg": squint,
        "world.beam": {"kind": "dwell", "dwell_s": aperture},
        "world.impairments": {},
        "world.scene": {"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [0.0]}},
    }


def isal(p: Mapping[str, float]) -> dict[str, Any]:
    """A point at the corner of the target, which moves and vibrates."""
    corner = {"kind": "points", "azimuth_m": [p["extent_m"]], "range_m": [p["extent_m"]]}
    return {
        "radar.rotation_rad_s": p["rotation_rad_s"],
        "radar.pulse_s": p["pulse_s"],
        "radar.bandwidth_hz": p["bandwidth_hz"],
        "world.pulses": 64,
        "world.samples": 128,
        "world.scene": {"aircraft": corner},
        "world.fidelity": {"kind": "dechirped"},
        "cases": {},
        "world.motion": {
            "drift": {"kind": "polynomial", "coefficients_m": [p["velocity_m_s"]]},
            "shake": {"kind": "sinusoid", "amplitude_m": p["amplitude_m"], "frequency_hz": 100.0},
        },
    }


def isal_rotation(p: Mapping[str, float]) -> dict[str, Any]:
    """Scatterers on two levers, whose angle has three terms."""
    y, cell, time_s = p["lever_m"], 1.5e8 / p["bandwidth_hz"], 0.02
    fastest = 1 + p["k1"] * time_s + p["k2"] * time_s**2 / 2 + p["k3"] * time_s**3 / 6
    x = p["band_share"] * 1.55e-6 * 50e3 / (4 * p["omega_rad_s"] * fastest)
    return {
        "radar.prf_hz": 50.0e3,
        "radar.bandwidth_hz": p["bandwidth_hz"],
        "radar.pulse_s": 10e-6,
        "world.pulses": 1000,
        "world.samples": math.ceil(y / cell) + 8,
        "world.scene": {"points": {"kind": "points", "azimuth_m": [-x, 0.3 * x, x], "range_m": [-y / 4, y / 4, y / 2]}},
        "world.centre_deviation_m": y / 2,
        "world.rotation": {"omega_rad_s": p["omega_rad_s"], "k": [p["k1"], p["k2"], p["k3"]]},
    }


def sal(p: Mapping[str, float]) -> dict[str, Any]:
    """Three points whose line of sight drifts and shakes."""
    return {
        "radar.period_s": p["period_s"],
        "radar.sample_rate_hz": 128 / p["period_s"] * 2,
        "radar.bandwidth_hz": 1e9,
        "radar.reference_range_m": p["reference_range_m"],
        "world.periods": 64,
        "cases": {},
        "world.scene": {
            "points": {"kind": "points", "azimuth_m": [-0.02, 0.0, 0.02], "range_m": [0.2, 0.5, p["range_m"]]}
        },
        "world.motion": {
            "drift": {"kind": "drift", "velocity_m_s": p["velocity_m_s"], "acceleration_m_s2": p["acceleration_m_s2"]},
            "shake": {"kind": "sinusoid", "frequency_hz": 500.0, "amplitude_m": p["amplitude_m"], "phase_deg": 40.0},
        },
    }


def geo(p: Mapping[str, float]) -> dict[str, Any]:
    """Two targets that move in opposite directions."""
    targets = {
        "near": {"u_r_m_s": p["u_r_m_s"], "u_a_m_s": p["u_a_m_s"], "azimuth_m": p["y0_m"]},
        "far": {"u_r_m_s": -p["u_r_m_s"] / 2, "azimuth_m": -p["y0_m"]},
    }
    lit = p["integration_s"]
    return {
        "radar.bandwidth_hz": p["bandwidth_hz"],
        "radar.reference_range_m": p["reference_range_m"],
        "radar.sampling_hz": 1.2 * p["bandwidth_hz"],
        "radar.orbit.off_nadir_deg": p["off_nadir_deg"],
        "world.pulses": 2 * math.ceil(90 * lit) + 200,
        "world.samples": None,
        "world.targets": targets,
        "world.gate": {"kind": "band_limited", "duration_s": lit},
        "world.noise": {"raw_scnr_db": None},
        "precision": "complex128",
    }


def geo_ocean(p: Mapping[str, float]) -> dict[str, Any]:
    """One ship; what counts is the swath about it and the aperture."""
    lit = p["integration_s"]
    return {
        "radar.reference_range_m": p["reference_range_m"],
        "radar.bandwidth_hz": p["bandwidth_hz"],
        "radar.sampling_hz": 1.2 * p["bandwidth_hz"],
        "radar.height_m": p["reference_range_m"] / 2,
        "radar.orbit.off_nadir_deg": p["off_nadir_deg"],
        "world.pulses": 2 * math.ceil(90 * lit) + 200,
        "world.samples": round(p["samples"]),
        "world.targets": {"ship1": {"azimuth_m": 0.0}},
        "world.gate": {"kind": "band_limited", "duration_s": lit},
    }


def path(p: Mapping[str, float]) -> dict[str, Any]:
    """A swaying aircraft, squinted by up to about 27 degrees, that images 30 m of ground."""
    ground = p["range_m"] / math.sqrt(2)
    length = p["aperture_rad"] * p["range_m"]
    flight = {
        "nominal": {
            "kind": "straight",
            "start_m": [-ground, -length / 2 - p["squint"] * ground, ground],
            "velocity_m_s": [0.0, length, 0.0],
        },
        "x": {"sway": {"kind": "sinusoid", "amplitude_m": p["sway_m"], "frequency_hz": 1.5}},
        "z": {},
    }
    return {
        "radar.bandwidth_hz": p["bandwidth_hz"],
        "world.pulses": 200,
        "world.samples": max(128, 32 * math.ceil(p["bandwidth_hz"] * 45 / 1.5e8 / 32)),
        "world.scene": {"corner": {"kind": "points", "azimuth_m": [0.0], "range_m": [0.0]}},
        "world.transmitter": flight,
        "world.navigation": None,
        "world.noise.snr_db": None,
        **{f"processor.recommended.stages.image.{side}_m": 30.0 for side in ("azimuth", "range")},
        "processor.recommended.stages.image.step_m": 0.25,
    }


# losses of every choice lie on both sides of their tolerance in these
FAMILIES: dict[str, Family] = {
    "stripmap": Family(
        "stripmap_damaged",
        {
            "squint": (-1.0, 1.0),
            "bandwidth_hz": (20e6, 200e6),
            "near_range_m": (2e3, 12e3),
            "doppler_band_hz": (60.0, 300.0),
            "swath_m": (50.0, 500.0),
        },
        stripmap,
    ),
    "isal": Family(
        "isal_table1",
        {
            "extent_m": (0.003, 0.06),
            "rotation_rad_s": (0.001, 0.02),
            "pulse_s": (5e-6, 200e-6),
            "bandwidth_hz": (1e10, 1.5e11),
            "velocity_m_s": (1e-5, 3e-3),
            "amplitude_m": (1e-9, 3e-6),
        },
        isal,
    ),
    "isal_rotation": Family(
        "isal_rotation_points",
        {
            "band_share": (0.01, 0.9),
            "lever_m": (0.2, 20.0),
            "omega_rad_s": (0.005, 0.1),
            "bandwidth_hz": (1e7, 1e9),
            "k1": (0.1, 30.0),
            "k2": (10.0, 3000.0),
            "k3": (1e2, 1e5),
        },
        isal_rotation,
    ),
    "sal": Family(
        "sal_points",
        {
            "period_s": (4e-6, 60e-6),
            "reference_range_m": (20.0, 5e3),
            "range_m": (0.6, 3.0),
            "velocity_m_s": (1e-4, 0.3),
            "acceleration_m_s2": (0.1, 300.0),
            "amplitude_m": (1e-9, 2e-5),
        },
        sal,
    ),
    "geo": Family(
        "geo_point_targets",
        {
            "u_r_m_s": (0.3, 20.0),
            "u_a_m_s": (-10.0, 10.0),
            "y0_m": (1.0, 300.0),
            "integration_s": (0.5, 5.0),
            "reference_range_m": (4e3, 2e4),
            "bandwidth_hz": (10e6, 150e6),
            "off_nadir_deg": (1.0, 8.0),
        },
        geo,
    ),
    "geo_ocean": Family(
        "geo_ocean",
        {
            "integration_s": (1.0, 5.0),
            "reference_range_m": (4e3, 2e4),
            "bandwidth_hz": (20e6, 150e6),
            "samples": (64, 512),
            "off_nadir_deg": (1.0, 8.0),
        },
        geo_ocean,
    ),
    "path": Family(
        "airborne_spotlight",
        {
            "range_m": (500.0, 1e4),
            "aperture_rad": (0.02, 0.15),
            "bandwidth_hz": (1e8, 1e9),
            "squint": (-0.5, 0.5),
            "sway_m": (0.01, 2.0),
        },
        path,
    ),
}


@torch.no_grad()
def compared(system: str, parameters: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """Predicted and measured losses of one scene."""
    family = FAMILIES[system]
    changes = [f"{key}={json.dumps(value)}" for key, value in family.overrides(parameters).items()]
    bench = Bench(load(family.config, changes))
    tolerance = tolerance_of(bench.loaded)
    for choice in choices_of(bench):
        predicted = [one for one in choice.alternatives if one.loss]
        if not predicted or choice.measured is None:
            continue
        measured = choice.measured()
        for one in predicted:
            found = measured.loss(one, measured.run(one))
            for metric, loss in one.loss.items():
                limit = tolerance[metric]
                row = {"choice": choice.name, "alternative": one.name, "metric": metric}
                row |= {"predicted": _short(loss), "measured": _short(found[metric]), "tolerance": limit}
                yield {**row, "advice_right": (loss <= limit) == (found[metric] <= limit), "scene": dict(parameters)}


def _short(x: float) -> float:
    return float(f"{max(x, FLOOR_DB):.4g}")


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Precision and recall of the advice that a simplification is acceptable, and how far
    predictions lie from measurements near the tolerance.
    """
    called = [row for row in rows if row["predicted"] <= row["tolerance"]]
    true = [row for row in rows if row["measured"] <= row["tolerance"]]
    both = sum(row["measured"] <= row["tolerance"] for row in called)
    apart = sorted(abs(r["predicted"] - r["measured"]) for r in rows if abs(r["measured"] - r["tolerance"]) < NEAR_DB)
    counts = {"rows": len(rows), "acceptable": len(true), "called_acceptable": len(called), "called_rightly": both}
    shares = {"precision": both / len(called) if called else None, "recall": both / len(true) if true else None}
    error = {"near_tolerance": len(apart), "median_error": apart[len(apart) // 2] if apart else None}
    return {key: x if x is None else float(f"{x:.4g}") for key, x in {**counts, **shares, **error}.items()}


def assessed(system: str, scenes: int, first: int = 0) -> dict[str, Any]:
    """The rows of so many scenes of a system from the first one on, and their summary, by choice as
    well.
    """
    rows: list[dict[str, Any]] = []
    refused = 0
    for number, parameters in enumerate(FAMILIES[system].scenes(scenes, first), 1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = list(compared(system, parameters))
            except ConfigError as error:  # no such system: the radar cannot work in this scene
                print(f"{system}: scene {number} of {scenes} is refused: {error}", flush=True)
                refused += 1
                continue
        rows += found
        wrong = [
            f"{r['alternative']} {r['predicted']} measured {r['measured']}" for r in found if not r["advice_right"]
        ]
        print(f"{system}: scene {number} of {scenes}{': ' if wrong else ''}{', '.join(wrong)}", flush=True)
    choices = list(dict.fromkeys(row["choice"] for row in rows))
    by_choice = {name: summary([row for row in rows if row["choice"] == name]) for name in choices}
    about = {"system": system, "scenes": scenes - refused, "refused_scenes": refused, "held_out": HELD_OUT}
    return {**about, **summary(rows), "choices": by_choice, "comparisons": rows}


def table(folder: Path) -> Iterator[str]:
    """A markdown table of the recorded figures."""
    yield "| system | scenes | predicted losses | acceptable | precision | recall | median error near the tolerance |"
    yield "|---|---|---|---|---|---|---|"
    for system in FAMILIES:
        tree = json.loads((folder / f"{system}.json").read_text(encoding="utf-8"))
        shares = " | ".join(f"{tree[name]:.3f}" for name in ("precision", "recall"))
        apart = f"{tree['median_error']:.2g} dB"
        yield f"| `{system}` | {tree['scenes']} | {tree['rows']:g} | {tree['acceptable']:g} | {shares} | {apart} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs/requires"))
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--systems", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        print("\n".join(table(options.folder)))
        return
    logging.getLogger("torchsar").setLevel(logging.ERROR)
    options.folder.mkdir(parents=True, exist_ok=True)
    for system in options.systems:
        found = assessed(system, options.scenes)
        rows = found.pop("comparisons")
        lines = [f'"{key}": {json.dumps(value)}' for key, value in found.items()]
        lines.append('"comparisons": [\n' + ",\n".join(json.dumps(row) for row in rows) + "\n]")
        (options.folder / f"{system}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
