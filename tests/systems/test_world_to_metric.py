"""The chains of the page "Chain from the world to the metric", one for each system."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from torchsar import Draws
from torchsar.core import Trace
from torchsar.data import config_chain
from torchsar.study.settings.errors import ConfigError
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "world_to_metric.md"
DRAWS = Draws(1, "run", range(4))
SNR_DB, SHARE = (torch.tensor(x, dtype=torch.float64) for x in ([10.0, 30.0, 10.0, 30.0], [1.0, 1.0, 1.1, 1.1]))

# the same worlds and stages as sections of a config
BISTATIC = {
    **{"carrier_hz": 1.25e9, "bandwidth_hz": 50e6, "pulse_s": 2e-7, "sampling_hz": 60e6, "prf_hz": 180.0},
    **{"speed_m_s": 300.0, "reference_range_m": 5000.0},
}
TURNTABLE = {"carrier_hz": 193.4e12, "bandwidth_hz": 150e9, "prf_hz": 2000.0, "rotation_rad_s": 0.005}
THREE = {"kind": "points", "azimuth_m": [-0.02, 0.0, 0.03], "range_m": [-0.01, 0.0, 0.012]}
BALANCE = {"balance": {"kind": "channel_errors", "phase_rad": [0.0, 0.1, -0.1]}}
KNOWN = {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
MOTION = {"u_r_m_s": "truth.u_r_m_s"}
CONFIGS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any], str]] = {
    "stripmap": (
        {
            **{"carrier_hz": 3.2e9, "pulse": {"bandwidth_hz": 40e6, "duration_s": 5e-7}, "sampling_hz": 50e6},
            **{"prf_hz": 400.0, "velocity_m_s": 120.0, "near_range_m": 4000.0},
        },
        {
            **{"lines": 128, "samples": 96, "beam": {"kind": "dwell", "dwell_s": 0.2}},
            "scene": {"point": {"kind": "points", "azimuth_m": [0.0], "range_m": [0.0]}},
            "impairments": {"oscillator": {"kind": "phase_sinusoid", "amplitude_rad": 0.2, "cycles": 3.0}},
        },
        {"image": {"stage": "omega_k"}},
        "velocity_m_s",
    ),
    "path": (
        {"carrier_hz": 10e9, "bandwidth_hz": 150e6, "prf_hz": 100.0},
        {
            **{"pulses": 64, "samples": 32},
            "scene": {"points": {"kind": "points", "azimuth_m": [0.0, 4.0], "range_m": [0.0, 3.0]}},
            "transmitter": {
                "nominal": {
                    "kind": "straight_path",
                    "start_m": [-800.0, -16.0, 600.0],
                    "velocity_m_s": [0.0, 50.0, 0.0],
                },
            },
            "navigation": {"y": {"drift": {"kind": "drift", "velocity_m_s": 0.5}}},
            "impairments": {
                "navigation": {
                    "kind": "path_error",
                    "z": {"sway": {"kind": "sinusoid", "amplitude_m": 5e-3, "frequency_hz": 2.0}},
                }
            },
        },
        {"image": {"stage": "direct_image", "azimuth_m": 12.0, "range_m": 12.0, "step_m": 0.5, "uses": KNOWN}},
        "navigation.y.drift.velocity_m_s",
    ),
    "geo": (
        BISTATIC,
        {
            **{"pulses": 128, "samples": 32, "gate": {"kind": "band_limited", "duration_s": 0.4}},
            **{"targets": {"ship": {"u_r_m_s": 4.0, "u_a_m_s": 2.0}}, "impairments": BALANCE},
        },
        {
            "migration": {"stage": "correct_migration", "uses": MOTION},
            "bands": {"stage": "reconstruct", "uses": MOTION},
            "image": {"stage": "focus_azimuth", "bandwidth_hz": 150.0, "uses": MOTION},
        },
        "targets.ship.u_r_m_s",
    ),
    "geo_ocean": (
        BISTATIC,
        {
            **{"pulses": 96, "samples": 64, "gate": {"kind": "band_limited", "duration_s": 0.4}},
            "targets": {"ship": {"u_r_m_s": 4.0, "u_a_m_s": 2.0, "length_m": 20.0, "scr_db": 25.0}},
            **{"sea": {"kind": "k_sea", "cell_m": [40.0, 40.0]}, "impairments": BALANCE},
        },
        {"image": {"stage": "stationary_image"}},
        "targets.ship.u_r_m_s",
    ),
    "isal": (
        TURNTABLE,
        {
            **{"pulses": 64, "samples": 48, "scene": {"points": THREE}, "rotation_rad_s": 0.006},
            "impairments": {"start": {"kind": "white_phase", "limit_rad": 0.5}},
        },
        {
            "phase": {"stage": "sca", "assess": False},
            "correct": {"stage": "correct_pulse_phase", "uses": {"phase_rad": "phase"}},
            "image": {"stage": "azimuth_transform"},
        },
        "rotation_rad_s",
    ),
    "isal_rotation": (
        TURNTABLE,
        {
            **{"pulses": 64, "samples": 48, "scene": {"points": THREE}},
            "rotation": {"omega_rad_s": 0.005, "k": [4.0]},
            "impairments": {"oscillator": {"kind": "phase_sinusoid", "amplitude_rad": 0.2, "cycles": 3.0}},
        },
        {
            "range": {
                "stage": "range_phase",
                "yc_m": 0.0,
                "uses": {"omega_rad_s": "truth.omega_rad_s", "warp_k": "truth.warp_k"},
            },
            "image": {"stage": "matched_fourier", "uses": {"warp_k": "truth.warp_k"}},
        },
        "rotation.omega_rad_s",
    ),
    "sal": (
        {
            **{"carrier_hz": 1.934e14, "bandwidth_hz": 5e9, "period_s": 16e-6, "sample_rate_hz": 4e6},
            **{"speed_m_s": 60.0, "reference_range_m": 3000.0},
        },
        {
            **{"periods": 48, "scene": {"point": {"kind": "points", "azimuth_m": [0.0], "range_m": [0.1]}}},
            "motion": {"drift": {"kind": "drift", "velocity_m_s": 0.1, "acceleration_m_s2": 20.0}},
        },
        {
            "velocity": {"stage": "mirror_product", "assess": False},
            "still": {"stage": "compensate_motion", "uses": {"velocity_m_s": "velocity"}},
            "profiles": {"stage": "compress_sweeps"},
            "deramp": {"stage": "deramp_azimuth"},
            "image": {"stage": "azimuth_matched_filter", "beam_rad": 1e-4},
        },
        "motion.drift.velocity_m_s",
    ),
}
SYSTEMS = tuple(CONFIGS)


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@cache
def page() -> dict[str, Any]:
    """What the page defines before it runs the chains."""
    names: dict[str, Any] = {}
    for block in blocks()[: 1 + len(SYSTEMS)]:
        exec(compile(block, str(PAGE), "exec"), names)
    return names


def run(system: str, draws: Draws, snr_db: Tensor, share: Tensor) -> Trace:
    chain, speed = page()["chains"][system], page()["speeds"][system] * share
    return chain.trace(draws=draws, given={"given.snr_db": snr_db, "given.speed": speed})


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_chain_takes_at_most_15_lines(system: str) -> None:
    chain = re.search(rf'chains\["{system}"\] = (Chain\(.*?\n\))\n', "".join(blocks()), re.DOTALL)
    assert chain is not None
    assert chain[1].count("\n") < 15
    (block,) = (block for block in blocks() if chain[0] in block)
    assert len([line for line in block.splitlines() if line]) <= 20


@pytest.mark.parametrize("system", SYSTEMS)
def test_trials_of_one_batch_are_those_of_single_ones(system: str) -> None:
    whole = run(system, DRAWS, SNR_DB, SHARE).metrics["entropy"]
    one = run(system, DRAWS.for_trials([2]), SNR_DB[2:3], SHARE[2:3]).metrics["entropy"]
    assert whole.shape == (4,)
    assert len(whole.unique()) == 4
    torch.testing.assert_close(whole[2:3], one, rtol=1e-9, atol=0)


@pytest.mark.parametrize("system", SYSTEMS)
def test_derivatives_from_the_metric_to_the_world_equal_differences(system: str) -> None:
    def entropy(x: Tensor) -> Tensor:
        return run(system, DRAWS.for_trials([0]), 20 * x[:, 0], x[:, 1]).metrics["entropy"]

    x = torch.ones(1, 2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(entropy(x).sum(), x)
    assert bool((slope != 0).all())
    assert torch.autograd.gradcheck(entropy, x, eps=1e-5, rtol=1e-4, atol=1e-4 * float(slope.abs().min()))


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_same_chain_as_a_config_gives_the_same_bits(system: str, tmp_path: Path) -> None:
    radar, world, stages, speed = CONFIGS[system]
    stages = {**stages, "entropy": {"stage": "measure", "metric": "entropy"}}
    level = "sea.cnr_db" if system == "geo_ocean" else "noise.snr_db"
    noise = {} if system == "geo_ocean" else {"noise": {"snr_db": 20.0}}
    tree = {
        **{
            "title": "the same chain",
            "system": system,
            "seed": 1,
            "precision": "complex128",
            "radar": radar,
            "world": {**world, **noise},
        },
        "processor": {"recommended": {"oracle": True, "stages": stages}},
    }
    file = tmp_path / "same.yaml"
    file.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    chain = config_chain(file, vary=[f"world.{level}", f"world.{speed}"])
    value = page()["speeds"][system] * SHARE
    found = chain.trace(draws=DRAWS, given={f"given.world.{level}": SNR_DB, f"given.world.{speed}": value})
    draws = DRAWS
    if system == "geo":  # every target of a config has random numbers of its own
        draws = DRAWS.part("ship")
    if system == "geo_ocean":  # every scene of a config is a case of its own
        draws = Draws(1, tuple(f"run/{trial}" for trial in range(4)), [0] * 4)
    own = run(system, draws, SNR_DB, SHARE)
    assert torch.equal(found.metrics["entropy"], own.metrics["entropy"])
    for name in stages:
        assert torch.equal(found.outputs[name].data, own.outputs[name].data)


def test_what_a_config_measures_are_metrics_of_the_method(tmp_path: Path) -> None:
    radar, world, stages, _ = CONFIGS["isal"]
    error = {"estimate_rad": "phase.phase_rad", "reference_rad": "truth.start.phase_rad"}
    measured = {
        "entropy": {"stage": "measure", "metric": "entropy"},
        "error": {"stage": "measure", "metric": "phase_rmse", "uses": error},
        "point": {"stage": "measure", "metric": "impulse_response", "at_m": [0.0, 0.0]},
    }
    tree = {"title": "measured", "system": "isal", "radar": radar, "world": {**world, "noise": {"snr_db": 20.0}}}
    tree["processor"] = {"recommended": {"stages": {**stages, **measured}}}
    file = tmp_path / "measured.yaml"
    file.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    bench = Bench(load(file))
    metrics = bench.batch(bench.draws("run", range(3)), detail=True).outcomes["recommended"].metrics
    assert torch.equal(metrics["entropy"], metrics["entropy_nats"])
    torch.testing.assert_close(metrics["error"], metrics["residual_phase_rms_rad"])
    assert bool((metrics["point.irw_range_m"] > 0).all()) and bool((metrics["point.peak"] > 0).all())
    # other stages may not use true values
    tree["processor"]["recommended"]["stages"]["correct"]["uses"] = {"phase_rad": "truth.start.phase_rad"}
    file.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    with pytest.raises(ConfigError, match="oracle: true"):
        Bench(load(file))
