"""Targets with non-uniform rotation: what is theirs alone in the frame of all systems; limits and
neglected phases by their formulas.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.study.scenes import FOUND_ROTATION, ISAL_ROTATION, bench_of, loaded_as, world
from torchsar.core import Axis, Draws, Signal
from torchsar.focus.rotation_requirements import rotation_limits, rotation_requirements
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.montecarlo import sweep
from torchsar.study.systems.isal_rotation.judge import cross_range_cut

BOX = {"low": [0.018, 9.0, 900.0], "high": [0.022, 11.0, 1100.0]}


def outcomes_of(folder: Path, *overrides: str, trials: int = 2, **changes: object):
    bench = bench_of(folder, "isal_rotation", *overrides, **changes)
    return bench, bench.batch(Draws(bench.config.seed, "run", range(trials)), detail=True).outcomes


@pytest.mark.slow
def test_rotations_are_found_and_images_reach_the_ideal(tmp_path: Path) -> None:
    genetic = {
        "rotation": {"stage": "entropy_rotation", "method": "genetic", **BOX, "population": 6, "generations": 3},
        **FOUND_ROTATION,
    }
    processor = {**ISAL_ROTATION["processor"], "genetic": {"stages": genetic}}
    _, outcomes = outcomes_of(tmp_path, processor=processor)
    found = {n: {k: float(v.double().mean()) for k, v in o.metrics.items()} for n, o in outcomes.items()}
    best, none, coarse = (found[name] for name in ("recommended", "none", "coarse"))
    assert abs(best["omega_error_percent"]) < 5 and abs(best["k1_error_percent"]) < 0.5 and best["ok"] == 1.0
    assert abs(best["entropy_above_ideal_nats"]) < 0.05 < none["entropy_above_ideal_nats"]
    assert abs(best["cross_range_scale_error_percent"] + best["omega_error_percent"]) < 0.5
    # it says nothing of the rate
    assert "omega_error_percent" not in coarse and "yc_error_m" not in coarse and abs(coarse["k1_error_percent"]) < 15
    assert found["genetic"]["evaluations"] > 6 and "yc_error_m" not in found["genetic"]


def test_a_range_centre_deviation_is_found(tmp_path: Path) -> None:
    processor = {"recommended": ISAL_ROTATION["processor"]["recommended"]}
    bench, outcomes = outcomes_of(tmp_path, "world.centre_deviation_m=1.5", processor=processor, metrics=None)
    assert float(outcomes["recommended"].metrics["yc_error_m"].abs().max()) < 0.3
    table = bench.system.found(bench, outcomes["recommended"], bench.trials(Draws(3, "run", range(2))))
    assert {f"rotation.{key}" for key in ("omega_rad_s", "k1_per_s", "k2_per_s2", "yc_m")} <= set(table)
    assert np.allclose(table["rotation.yc_m"].value, 1.5, atol=0.3)


def test_scene_and_noise_have_seeds_of_their_own(tmp_path: Path) -> None:
    processor = {"recommended": {"stages": {"image": {"stage": "matched_fourier"}}}}

    def drawn(*overrides: str) -> tuple[torch.Tensor, torch.Tensor]:
        bench = bench_of(tmp_path, "isal_rotation", *overrides, processor=processor, metrics=None)
        trials = bench.trials(Draws(bench.config.seed, "run", range(2)))
        return trials.truth["range_m"], trials.clean.signal.data

    free, one, other = drawn(), drawn("world.scene_seed=5"), drawn("world.scene_seed=5", "seed=9")
    # scenes follow the seed and differ from trial to trial
    assert not torch.equal(free[0][0], free[0][1])
    assert torch.equal(one[0], other[0])
    # the noise does not
    assert not torch.equal(one[1][0], one[1][1]) and not torch.equal(one[1], other[1])
    quiet = drawn("world.scene_seed=5", "world.noise.snr_db=null")
    assert torch.equal(quiet[1][0], quiet[1][1])


@pytest.mark.slow
def test_errors_of_a_sweep_stay_above_the_bound_and_are_predicted(tmp_path: Path) -> None:
    processor = {"recommended": {"stages": {"rotation": {"stage": "uneven_rotation"}}}}
    changes = {"processor": processor, "metrics": None, "precision": "complex128"}
    trial, key = SweepTrial(loaded_as(tmp_path, "isal_rotation", **changes)), "world.noise.snr_db"
    record = sweep(trial, {key: [0.0, 20.0]}, batched=[key], trials=4, seed=3, chunk=8)
    for name in ("omega_error_percent", "k1_error_percent", "k2_error_percent", "yc_error_m"):
        bound = record.bounds[name]["Cramer-Rao"]
        rms, least = (np.sqrt((x**2).mean(-1)).reshape(-1) for x in (record.metrics[name][0], bound))
        assert (rms > 0.2 * least).all() and rms[0] < 6 * least[0], name
        # other scenes at the other SNR
        np.testing.assert_allclose(least[0] / least[1], 10, rtol=0.2)
        predicted = record.metrics[name.replace("error", "std")][0]
        assert (predicted > 0.5 * bound).all() and (predicted[0] < 3 * bound[0]).all(), name


@pytest.mark.slow
def test_of_a_true_zero_there_is_no_percentage(tmp_path: Path) -> None:
    """Cases of one sweep: a constant rate has an error of k1 in 1/s, any other one in percent."""
    processor = {"recommended": {"stages": {"rotation": {"stage": "uneven_rotation"}}}}
    laws = {"constant": [0.0, 0.0], "changing": [10.0, 1000.0]}
    rows = {}
    for name, law in laws.items():
        turning = world("isal_rotation", rotation={"omega_rad_s": 0.02, "k": law})
        bench = bench_of(tmp_path, "isal_rotation", world=turning, processor=processor, metrics=None)
        rows[name] = bench.batch(Draws(3, "zero", [0])).outcomes["recommended"].metrics
    assert torch.isnan(rows["constant"].get("k1_error_percent", torch.tensor(torch.nan))).all()
    assert abs(float(rows["constant"]["k1_error_per_s"])) < 0.5
    assert torch.isnan(rows["changing"].get("k1_error_per_s", torch.tensor(torch.nan))).all()
    assert abs(float(rows["changing"]["k1_error_percent"])) < 1


def test_a_cut_measures_a_sinc() -> None:
    along, across = Axis("cross range", 400, -200 * 0.4, 0.4, "m"), Axis("range", 3, -1.0, 1.0, "m")
    x, width = along.values() - 7.3, 0.8  # half a cell a line, between lines
    line = torch.sinc(x / width) * torch.polar(torch.ones_like(x), math.pi * 0.5 * (x / 0.4))
    image = Signal(torch.stack([0 * line, 3 * line, 0 * line], -1)[None], (along, across))
    at, unit = (torch.tensor([value], dtype=torch.float64) for value in (7.2, 1.0))
    cut = cross_range_cut(image, at, torch.tensor([0.2], dtype=torch.float64), unit, 20.0, 0.25)
    assert cut is not None
    figures = {name: float(value) for name, value in cut.figures.items()}
    assert figures["peak"] == pytest.approx(3.0, rel=2e-3)
    assert figures["irw_azimuth_m"] == pytest.approx(0.886 * width, rel=5e-3)
    assert figures["pslr_azimuth_db"] == pytest.approx(-13.26, abs=0.05)


def test_a_point_beyond_the_search_is_named(tmp_path: Path) -> None:
    few = {"points": {"kind": "points", "azimuth_m": [-0.3, 0.1, 0.2], "range_m": [1.0, -1.0, 2.0]}}
    processor = {name: ISAL_ROTATION["processor"][name] for name in ("ideal", "none")}
    processor["recommended"] = processor["none"]
    metrics = {"reference": "ideal", "search_m": 1e-6}
    _, outcomes = outcomes_of(
        tmp_path, world=world("isal_rotation", scene=few), processor=processor, metrics=metrics, trials=1
    )
    judged = outcomes["recommended"].judged
    assert set(judged.outside) | set(judged.targets) == {"points.0", "points.1", "points.2"} and judged.outside


RADAR = InverseRadar(LIGHT_M_S / 1.55e-6, 624.567621e6, 500e3)
TURN = (RADAR, 10000, 0.02, [10.0, 1000.0])
C4, H = 4 * math.pi / 1.55e-6, 0.01
ANGLE = 0.02 * (0.02 + 10 * 0.02**2 / 2 + 1000 * 0.02**3 / 6)


def test_neglected_phases_follow_their_formulas() -> None:
    cell = 1.55e-6 / (2 * ANGLE)
    rows = {row.effect: row for row in rotation_requirements(*TURN, 6.43, 2 * cell**2 / 1.55e-6)}
    # Legendre terms of the warp: k2 h^3 / 15 P3, and (h^2 / 3) (k1 + k2 h) P2 with it in order 1,
    # both 1 at the last pulse
    cubic, square = 1000 * H**3 / 15, H**2 / 3 * (10 + 1000 * H)
    assert rows["warp of order 2"].phase_rad == pytest.approx(C4 * 6.43 * 0.02 * cubic, rel=1e-6)
    assert rows["warp of order 1"].phase_rad == pytest.approx(C4 * 6.43 * 0.02 * (square + cubic), rel=1e-6)
    assert rows["warp of order 3"].phase_rad == rows["warp of order 4"].phase_rad == 0.0
    assert [rows[f"warp of order {order}"].ok for order in (1, 2, 3, 4)] == [False, False, True, True]
    # at the depth of focus
    assert rows["azimuth only"].phase_rad == pytest.approx(math.pi / 4, rel=1e-9)
    assert (
        rows["fixed envelopes (phase_only)"].range_cells == pytest.approx(6.43 * ANGLE / 0.24, rel=1e-6)
        and rows["fixed envelopes (phase_only)"].ok
    )
    assert not {row.effect: row for row in rotation_requirements(*TURN, 110.0, 1.0)}[
        "fixed envelopes (phase_only)"
    ].ok  # 0.21 cells
    orders = rotation_requirements(RADAR, 10000, 0.02, [10.0, 1000.0, 1e6], 6.43, 1.0)[:4]
    assert [row.ok for row in orders] == [False, False, False, True]


def limits(x: list[float], y: list[float], **given: float) -> dict:
    across, lever, level = (torch.tensor(v, dtype=torch.float64) for v in (x, y, [1.0] * len(x)))
    return {row.name: row for row in rotation_limits(*TURN, across, lever, level, **given)}


def test_limits_follow_their_formulas() -> None:
    found = limits([6.43, -6.0, 0.0], [3.0, -3.0, 3.0], noise_std=1.0, rate_bound=0.0008)
    assert (
        found["Doppler over half the pulse rate"].value
        == pytest.approx(2 * 0.02 * 1.4 * 6.43 / 1.55e-6 / 250e3, rel=1e-9)
        and found["Doppler over half the pulse rate"].ok
    )
    assert found["range term, pi lambda sigma_y / ra^2"].value == pytest.approx(
        math.pi * 1.55e-6 * 3.0 / (1.55e-6 / (2 * ANGLE)) ** 2, rel=1e-9
    )
    assert found["Cramer-Rao bound of the rate"].value == pytest.approx(4.0) and all(row.ok for row in found.values())
    assert limits([6.7, 0.0, 1.0], [1.0, 2.0, 3.0])["Doppler over half the pulse rate"].verdict == "warn"
    assert limits([7.2, 0.0, 1.0], [1.0, 2.0, 3.0])["Doppler over half the pulse rate"].verdict == "refuse"
    assert limits([1.0, 2.0, 3.0], [0.0, 0.0, 0.0])["range term, pi lambda sigma_y / ra^2"].verdict == "refuse"
    assert limits([1.0, 2.0, 3.0], [0.1, -0.1, 0.1])["range term, pi lambda sigma_y / ra^2"].verdict == "warn"
    assert limits([1.0, 2.0, 3.0], [0.5, 1.0, 1.5])["scatterers off a line through the centre"].verdict == "warn"
    assert limits([1.0, 2.0], [3.0, -1.0])["scatterers above the noise"].verdict == "refuse"
    assert limits([1.0, 2.0, 3.0], [3.0, -1.0, 3.0], noise_std=30.0)["scatterers above the noise"].verdict == "refuse"
    assert (
        limits([1.0, 2.0, 3.0], [3.0, -1.0, 3.0], rate_bound=math.inf)["Cramer-Rao bound of the rate"].verdict == "warn"
    )
    with pytest.raises(ValueError, match="the same shape"):
        limits([1.0, 2.0], [1.0])
