"""Numbers that differ from trial to trial: in every system they share batches, give what single
cases give, and cost what trials of one value cost.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tests.program import Program
from torchsar.core import Draws
from torchsar.optim import lbfgs
from torchsar.study.commands.sweep import SweepTrial, sweep_grid
from torchsar.study.montecarlo.engines import engine
from torchsar.study.montecarlo.loop import Plan, run_plan
from torchsar.study.montecarlo.record import Record
from torchsar.study.settings.sections import Loaded
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

Tree = dict[str, Any]
SAL_IMAGE = {
    "compress": {"stage": "compress_sweeps"},
    "deramp": {"stage": "deramp_azimuth"},
    "image": {"stage": "azimuth_matched_filter", "beam_rad": 114e-6},
}
PHASES = {
    "phase": {"stage": "pga", "kernel": "ml"},
    "correct": {"stage": "correct_pulse_phase", "uses": {"phase_rad": "phase"}},
}
ROTATION = {
    "rotation": {"stage": "uneven_rotation"},
    "range": {"stage": "range_phase", "uses": dict.fromkeys(("omega_rad_s", "warp_k", "yc_m"), "rotation")},
    "image": {"stage": "matched_fourier", "uses": {"warp_k": "rotation"}},
}
GEO_RADAR = {
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
REMOVED = {"transmit": {"stage": "remove_transmit_range"}}
VELOCITY = {
    "stage": "moving_point_velocity",
    "aperture": {"kind": "dwell", "duration_s": 1.5},
    "search": {"u_r_m_s": 15.0, "u_a_m_s": 3.0},
}
PHASE_ERRORS = {
    "white": {"kind": "white_phase", "limit_rad": 1.0},
    "walk": {"kind": "phase_walk", "step_rad": 0.3},
    "slow": {"kind": "phase_sinusoid", "amplitude_rad": 2.0, "cycles": 3.0},
}
SHAKEN = {
    "drift": {"kind": "polynomial", "coefficients_m": [1e-5, 1e-4]},
    "vibration": {"kind": "sinusoid", "amplitude_m": 1e-6, "frequency_hz": 20.0, "phase_deg": 90.0},
}
MOVING = {"u_r_m_s": 10.0, "u_a_m_s": 1.0, "azimuth_m": 20.0}

# by system: radar, world, stages that estimate, stages of a cheap image
CONFIGS: dict[str, tuple[Tree, Tree, Tree, Tree]] = {
    "stripmap": (
        {
            "carrier_hz": 3.2e9,
            "pulse": {"bandwidth_hz": 40e6, "duration_s": 0.5e-6},
            "sampling_hz": 50e6,
            "prf_hz": 400.0,
            "velocity_m_s": 120.0,
            "near_range_m": 4000.0,
            "pointing_doppler_hz": 0.0,
            "integration_s": 0.2,
        },
        {
            "lines": 96,
            "samples": 64,
            "beam": {"kind": "dwell", "dwell_s": 0.15},
            "noise": {"snr_db": 20.0},
            "velocity_m_s": 121.0,
            "doppler_hz": 20.0,
            "scene": {"points": {"kind": "points", "azimuth_m": [0.0, 5.0], "range_m": [0.0, 20.0]}},
        },
        {"doppler": {"stage": "phase_increment"}, "image": {"stage": "omega_k", "reference": "flat"}},
        {"image": {"stage": "omega_k", "reference": "flat"}},
    ),
    "isal": (
        {
            "carrier_hz": 193.414489e12,
            "bandwidth_hz": 150e9,
            "prf_hz": 2000.0,
            "rotation_rad_s": 0.005,
            "pulse_s": 100e-6,
            "reference_range_m": 20e3,
        },
        {
            "pulses": 64,
            "samples": 32,
            "rotation_rad_s": 0.005,
            "scene": {
                "field": {"kind": "random_points", "count": 10, "azimuth_extent_m": 0.15, "range_extent_m": 0.02}
            },
            "motion": SHAKEN,
            "start_phase": {"pulses": {"kind": "start_phase", "sigma_rad": 0.3}},
            "noise": {"snr_db": 15.0},
        },
        {**PHASES, "image": {"stage": "azimuth_transform"}},
        {"image": {"stage": "azimuth_transform"}},
    ),
    "isal_rotation": (
        {"wavelength_m": 1.55e-6, "bandwidth_hz": 624.567621e6, "prf_hz": 50e3, "reference_range_m": 100e3},
        {
            "pulses": 500,
            "samples": 16,
            "scene": {
                "satellite": {"kind": "satellite", "count": 60, "half_width_m": 0.6, "half_depth_m": 1.2},
            },
            "rotation": {"omega_rad_s": 0.02, "k": [10.0, 1000.0]},
            "centre_deviation_m": 0.1,
            "noise": {"snr_db": 20.0},
        },
        ROTATION,
        {"image": {"stage": "matched_fourier"}},
    ),
    "sal": (
        {
            "wavelength_m": 1.55e-6,
            "bandwidth_hz": 5e9,
            "period_s": 16e-6,
            "sample_rate_hz": 32e6,
            "speed_m_s": 60.0,
            "reference_range_m": 3000.0,
        },
        {
            "periods": 64,
            "scene": {"points": {"kind": "points", "azimuth_m": [0.0], "range_m": [1.5]}},
            "motion": {
                "drift": {"kind": "drift", "velocity_m_s": 0.35, "acceleration_m_s2": 20.0},
                "slow": {"kind": "sinusoid", "frequency_hz": 100.0, "amplitude_m": 160e-6, "phase_deg": 17.0},
            },
            "noise": {"snr_db": 20.0},
        },
        {
            "velocity": {"stage": "mirror_product", "window_m": [1.0, 2.0]},
            "compensate": {"stage": "compensate_motion", "uses": {"velocity_m_s": "velocity"}},
            **SAL_IMAGE,
        },
        SAL_IMAGE,
    ),
    "geo": (
        GEO_RADAR,
        {
            "pulses": 384,
            "targets": {"fast": MOVING},
            "gate": {"kind": "band_limited", "duration_s": 1.5},
            "noise": {"snr_db": 20.0},
        },
        {**REMOVED, "velocity": VELOCITY},
        {**REMOVED, "velocity": {"stage": "interferometry"}},
    ),
    "geo_ocean": (
        GEO_RADAR,
        {
            "pulses": 270,
            "samples": 60,
            "targets": {"one": {**MOVING, "scr_db": 20.0, "length_m": 40.0, "range_cells": 2, "count": 6}},
            "gate": {"kind": "band_limited", "duration_s": 1.0},
            "sea": {"kind": "k_sea", "cnr_db": 30.0},
        },
        {**REMOVED, "image": {"stage": "stationary_image"}},
        {**REMOVED, "image": {"stage": "stationary_image"}},
    ),
}
# what is swept: the key, and its first and last value
VELOCITIES = {
    "stripmap": ("world.velocity_m_s", 120.0, 122.0),
    "isal": ("world.motion.drift.coefficients_m.0", 1e-5, 2e-5),
    "isal_rotation": ("world.rotation.omega_rad_s", 0.019, 0.021),
    "sal": ("world.motion.drift.velocity_m_s", 0.3, 0.4),
    "geo": ("world.targets.fast.u_r_m_s", 9.0, 11.0),
    "geo_ocean": ("world.targets.one.u_r_m_s", 7.0, 9.0),
}
# richer worlds, by system: what is changed in that of CONFIGS
RICH: dict[str, Tree] = {
    "stripmap": {
        "scene": {
            "points": {"kind": "points", "azimuth_m": [0.0], "range_m": [10.0], "amplitude": [1.0]},
            "field": {"kind": "speckle", "count": 5, "azimuth_extent_m": 4.0, "range_extent_m": 9.0, "level_db": 1.0},
        },
        "beam": {"kind": "antenna", "length_m": 8.0},
        "doppler_hz": None,
        "squint_deg": 0.5,
        "impairments": {
            "response": {"kind": "smooth_response", "cubic_rad": 1.2, "ripple_rad": 0.5, "slope_db": 3.0},
            "imbalance": {"kind": "channel_imbalance", "gain": [1.0, 1.1], "phase_rad": [0.05, 0.1]},
            "tone": {"kind": "tone", "over_signal_db": 10.0, "frequency_hz": 11e6, "drift_hz": 1e6, "share": 0.5},
            "jitter": {"kind": "periodic_jitter", "offset_samples": [-0.03, 0.1], "pilot_snr_db": None},
            "lost": {"kind": "lost_lines", "fraction": 0.1},
            **PHASE_ERRORS,
        },
    },
    "isal": {"impairments": PHASE_ERRORS, "fidelity": {"kind": "dechirped", "track_m": [1e-5, 1e-4]}},
    "isal_rotation": {"motion": SHAKEN, "impairments": PHASE_ERRORS},
    "sal": {
        "log_amplitude": {"kind": "log_amplitude", "rms": 0.1},
        "sweep_error": {"kind": "polynomial", "up_hz": [1e4, 1e5], "down_hz": [1e4, -1e5]},
    },
    "geo": {
        "targets": {"slow": {"u_r_m_s": 1.0, "u_a_m_s": 2.0, "azimuth_m": 5.0}, "fast": MOVING},
        "transmit_range": [-200.0, 0.1],
        "impairments": {
            "channels": {"kind": "channel_errors", "gain_db": [0.1, 1.0, -1.0], "phase_rad": [0.1, 0.2, 0.3]},
            "clocks": {"kind": "synchronisation_error", "phase_rad": [0.1, 0.2], "phase_walk_rad": 0.05},
        },
    },
    "geo_ocean": {},
}
# keys of which trials must be able to have their own value, whatever else may differ
NAMED = {
    "stripmap": "noise.snr_db velocity_m_s squint_deg scene.field.level_db impairments.walk.step_rad "
    "impairments.response.cubic_rad impairments.tone.over_signal_db",
    "isal": "noise.snr_db rotation_rad_s motion.vibration.amplitude_m motion.vibration.frequency_hz "
    "motion.vibration.phase_deg motion.drift.coefficients_m.0 start_phase.pulses.sigma_rad impairments.white.limit_rad",
    "isal_rotation": "noise.snr_db rotation.omega_rad_s rotation.k.0 rotation.k.1 centre_deviation_m "
    "motion.vibration.amplitude_m impairments.slow.amplitude_rad",
    "sal": "noise.snr_db motion.drift.velocity_m_s motion.slow.amplitude_m motion.slow.frequency_hz "
    "motion.slow.phase_deg sweep_error.up_hz.1 log_amplitude.rms",
    "geo": "noise.snr_db targets.slow.u_r_m_s targets.fast.u_a_m_s gate.duration_s transmit_range.0 "
    "impairments.channels.phase_rad.1 impairments.clocks.phase_walk_rad",
    "geo_ocean": "targets.one.u_r_m_s targets.one.u_a_m_s targets.one.scr_db sea.cnr_db",
}


# largest difference of a figure from that of a case, over its largest value, in double precision:
# in single precision a rotation search ends where rounding lets it, which differs by processor
SAME = 1e-6


def loaded(
    system: str, folder: Path, world: Mapping[str, Any] | None = None, cheap: bool = False, **top: Any
) -> Loaded:
    """The tiny config of a system, with changes of its world and of other sections."""
    radar, own, stages, image = CONFIGS[system]
    processor = {"recommended": {"stages": image if cheap else stages}}
    tree = {"system": system, "title": "tiny", "seed": 3, "radar": radar, "world": {**own, **(world or {})}}
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump({**tree, "processor": processor, **top}, sort_keys=False), encoding="utf-8")
    return load(path)


def batch_of_every_system(folder: Path) -> int:
    """Run a small batch of each system, and return how many costly modules that has imported."""
    for system in CONFIGS:
        Bench(loaded(system, folder)).batch(Draws(3, "a", [0]))
    lbfgs(lambda x: x.square().sum(-1), torch.ones(2))
    costly = {"sympy", "torch._dynamo"} & set(sys.modules)
    print(*costly)
    return len(costly)


@pytest.mark.slow
def test_a_batch_does_not_import_the_compiler_of_torch(tmp_path: Path) -> None:
    """It takes seconds in each process; torch.broadcast_shapes and torch.func.grad import it."""
    program = Program(batch_of_every_system, tmp_path, folder=tmp_path, said=tmp_path / "said.txt")
    assert program.wait() == 0, program.said


class Watched(SweepTrial):
    """Keeps the values of every batch."""

    def __init__(self, config: Loaded) -> None:
        super().__init__(config)
        self.batches: list[dict[str, Any]] = []

    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        self.batches.append(dict(parameters))
        return super().__call__(parameters, draws)


def swept(config: Loaded, trials: int) -> tuple[Watched, Record]:
    trial = Watched(config)
    plan = Plan(sweep_grid(config, trial), trials, config.config.seed)
    return trial, run_plan(plan, trial, None, engine())


def spread(system: str, count: int) -> list[float]:
    return np.linspace(*VELOCITIES[system][1:], count).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("system", CONFIGS)
def test_trials_of_different_velocities_share_batches_and_give_the_numbers_of_cases(
    system: str, tmp_path: Path
) -> None:
    key, values = VELOCITIES[system][0], spread(system, 5)
    config = loaded(system, tmp_path, sweep={key: values}, precision="complex128")
    trial, record = swept(config, 1)
    assert any(len(set(batch[key].tolist())) > 1 for batch in trial.batches)
    grid = sweep_grid(config, trial)
    assert len(grid.cases()) == 1
    for index in (0, 2):
        case = config.changed({key: values[index]})
        alone = Bench(case).batch(Draws(3, (grid.points()[index].address,), [0])).outcomes["recommended"].metrics
        assert len(alone) > 1
        for name, value in alone.items():
            if name not in ("seconds", "ok", "outcome"):
                found = record.metrics[name].reshape(len(values))
                scale = np.abs(found).max()
                np.testing.assert_allclose(found[index], float(value[0]), rtol=0, atol=SAME * scale, err_msg=name)


def numbers(tree: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, float]]:
    """Dotted keys of the numbers of a section, with their values."""
    parts = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in parts:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield ".".join((*path, str(key))), value
        else:
            yield from numbers(value, (*path, str(key)))


@pytest.mark.slow
@pytest.mark.parametrize("system", CONFIGS)
def test_every_number_of_the_world_that_may_differ_gives_the_data_of_cases(system: str, tmp_path: Path) -> None:
    config = loaded(system, tmp_path, RICH[system], cheap=True)
    bench, trial, draws = Bench(config), SweepTrial(config), Draws(3, ("a", "b"), [0, 1])
    free = {key: v for key, v in numbers(config.config.world) if v and trial.may_differ(f"world.{key}")}
    assert set(NAMED[system].split()) <= set(free)
    for key, value in free.items():
        pair = [float(value), value * 1.02]
        together = bench.trials(draws, {key: torch.tensor(pair, dtype=torch.float64)}).recording.signal.data
        for i in range(2):
            case = Bench(config.changed({f"world.{key}": pair[i]}))
            alone = case.trials(Draws(3, ("ab"[i],), [i])).recording.signal.data
            rows = together.flatten().chunk(2)[i]  # the targets of a trial follow each other
            torch.testing.assert_close(rows, alone.flatten(), rtol=0, atol=1e-5 * float(alone.abs().max()), msg=key)


def test_a_gate_that_gives_a_sea_its_cells_makes_cases(tmp_path: Path) -> None:
    ocean = SweepTrial(loaded("geo_ocean", tmp_path))
    assert not ocean.may_differ("world.gate.duration_s") and ocean.may_differ("world.sea.cnr_db")
    sea = {"sea": {"kind": "k_sea"}, "samples": 24}
    assert not SweepTrial(loaded("geo", tmp_path, sea)).may_differ("world.gate.duration_s")
    lit = {**sea, "sea_gate": {"kind": "band_limited", "duration_s": 2.0}}
    apart = SweepTrial(loaded("geo", tmp_path, lit))
    assert apart.may_differ("world.gate.duration_s") and not apart.may_differ("world.sea_gate.duration_s")


@pytest.mark.slow
@pytest.mark.parametrize("system", CONFIGS)
def test_a_sweep_over_velocities_costs_what_trials_of_one_velocity_cost(system: str, tmp_path: Path) -> None:
    count = 6 if system == "geo_ocean" else 32
    key, values = VELOCITIES[system][0], spread(system, count)
    many = loaded(system, tmp_path, cheap=True, sweep={key: values})
    one = loaded(system, tmp_path, cheap=True, sweep={key: values[:1]})

    def seconds(config: Loaded, trials: int) -> float:
        began = time.process_time()
        swept(config, trials)
        return time.process_time() - began

    pairs: list[tuple[float, float]] = []
    ratio = float("inf")
    while ratio > 1.2 and len(pairs) < 20:  # others may use the machine: the least times are compared
        pairs.append((seconds(many, 1), seconds(one, count)))
        ratio = min(a for a, _ in pairs) / min(b for _, b in pairs)
    assert ratio <= 1.2, f"{count} values took {ratio:.2f} times as long as {count} trials of one value"
