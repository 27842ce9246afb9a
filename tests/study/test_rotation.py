"""Configs of targets that turn unevenly: run, sweep, requires and trade; limits and fidelity rows
by their formulas.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torchsar.study.config import load
from torchsar.study.rotation.judge import cut_through
from torchsar.study.rotation.requires import heed_limits
from torchsar.study.rotation.trials import RotationTrials, run_batch

from torchsar.cli import main
from torchsar.core import Axis, Draws, Signal
from torchsar.focus.rotation_requirements import least_order, rotation_limits, rotation_requirements
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.study.montecarlo import sweep
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems import system_of

TRUE = {"omega_rad_s": 0.02, "warp_k": [10.0, 1000.0]}
TAKEN_OUT = {
    "range": {"stage": "range_phase", "uses": dict.fromkeys(("omega_rad_s", "warp_k", "yc_m"), "rotation")},
    "image": {"stage": "matched_fourier", "uses": {"warp_k": "rotation"}},
}
KNOWN = {"range": {"stage": "range_phase", **TRUE}, "image": {"stage": "matched_fourier", "warp_k": TRUE["warp_k"]}}
BOX = {"low": [0.018, 9.0, 900.0], "high": [0.022, 11.0, 1100.0]}
TINY: dict = {
    "system": "isal_rotation",
    "title": "tiny satellite",
    "seed": 3,
    "radar": {"wavelength_m": 1.55e-6, "bandwidth_hz": 624.567621e6, "prf_hz": 50e3, "reference_range_m": 100e3},
    "world": {
        "pulses": 1000,
        "samples": 32,
        "trials": 2,
        "scene": {"satellite": {"kind": "satellite", "count": 60, "half_width_m": 0.6}},
        "rotation": {"omega_rad_s": 0.02, "k": [10.0, 1000.0]},
        "noise": {"snr_db": 20.0},
    },
    "processor": {
        "ideal": {"input": "clean", "stages": KNOWN},
        "none": {"stages": {"image": {"stage": "matched_fourier"}}},
        "coarse": {"stages": {"rotation": {"stage": "rotation_coarse"}, "image": TAKEN_OUT["image"]}},
        "genetic": {
            "stages": {"rotation": {"stage": "rotation_genetic", **BOX, "population": 6, "generations": 3}, **TAKEN_OUT}
        },
        "recommended": {"stages": {"rotation": {"stage": "rotation"}, **TAKEN_OUT}},
    },
    "metrics": {"reference": "ideal", "published": {"omega_error_percent": {"centred": {"genetic": 1.0}}}},
    "trade": {
        "taps": [4, 6],
        "kernel_oversamplings": [2.0],
        "scatterers": [5],
        "rounds": [1],
        "population": 6,
        "generations": 2,
        "precisions": ["complex64"],
    },
}
FEW = {name: TINY["processor"][name] for name in ("ideal", "recommended")}


def write(folder: Path, **changes: object) -> str:
    tree = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / "turning.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return str(path)


def run(config: str, out: Path, *overrides: str) -> dict:
    assert main(["run", config, *overrides, "--out", str(out)]) == 0
    return json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def test_a_run_compares_methods_over_cases_and_scenes(tmp_path: Path) -> None:
    config = write(tmp_path, cases={"centred": {"seed": 3}, "off centre": {"world.centre_deviation_m": 1.5}})
    metrics = run(config, tmp_path / "out")
    methods = metrics["methods"]
    best, none, coarse = (methods[name]["cases"]["centred"] for name in ("recommended", "none", "coarse"))
    assert abs(best["omega_error_percent"]) < 5 and abs(best["k1_error_percent"]) < 0.5 and best["ok"] == 1.0
    assert abs(best["entropy_above_ideal_nats"]) < 0.05 < none["entropy_above_ideal_nats"]
    assert abs(best["cross_range_scale_error_percent"] + best["omega_error_percent"]) < 0.5
    assert abs(methods["recommended"]["cases"]["off centre"]["yc_error_m"]) < 0.2
    assert (
        "omega_error_percent" not in coarse and "yc_error_m" not in coarse and abs(coarse["k1_error_percent"]) < 15
    )  # it says nothing of the rate
    assert methods["genetic"]["metrics"]["evaluations"] > 6 and "yc_error_m" not in methods["genetic"]["metrics"]
    told = methods["recommended"]["estimates"]["off centre/yc_m"]
    assert len(told["value"]) == len(told["std"]) == len(told["ok"]) == 2 and np.allclose(told["value"], 1.5, atol=0.3)
    assert set(methods["recommended"]["estimates"]) >= {
        f"centred/{name}" for name in ("omega_rad_s", "k1_per_s", "k2_per_s2", "yc_m")
    }
    assert metrics["truth"]["centred/k2_per_s2"] == [1000.0, 1000.0]
    assert "centred, published" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 9
    again = load(str(tmp_path / "out" / "config.yaml"))  # what was resolved can be run again
    system_of(again).check(again)


def test_scene_and_noise_have_seeds_of_their_own(tmp_path: Path) -> None:
    config = write(
        tmp_path, processor={"recommended": {"stages": {"image": {"stage": "matched_fourier"}}}}, metrics=None
    )

    def drawn(*overrides: str) -> tuple[torch.Tensor, torch.Tensor]:
        loaded = load(config, overrides)
        truth = run_batch(RotationTrials(loaded).bench({}), Draws(loaded.config.seed, "run", range(2))).truth
        assert truth.clean is not None
        return truth.values["range_m"], truth.clean.signal.data

    free, one, other = drawn(), drawn("world.scene_seed=5"), drawn("world.scene_seed=5", "seed=9")
    # scenes follow the seed and differ from trial to trial
    assert not torch.equal(free[0][0], free[0][1])
    assert torch.equal(one[0], other[0])
    # the noise does not
    assert not torch.equal(one[1][0], one[1][1]) and not torch.equal(one[1], other[1])
    quiet = drawn("world.scene_seed=5", "world.noise.snr_db=null")
    assert torch.equal(quiet[1][0], quiet[1][1])


def test_trials_of_a_sweep_do_not_depend_on_their_batch_and_stay_above_the_bound(tmp_path: Path) -> None:
    processor = {"recommended": {"stages": {"rotation": {"stage": "rotation"}}}}
    trial = RotationTrials(
        load(
            write(
                tmp_path,
                processor=processor,
                metrics=None,
                precision="complex128",
                sweep={"world.noise.snr_db": [0.0, 20.0]},
            )
        )
    )
    records = [
        sweep(trial, {"world.noise.snr_db": [0.0, 20.0]}, batched=["world.noise.snr_db"], trials=4, seed=3, chunk=chunk)
        for chunk in (1, 8)
    ]
    for name, values in records[0].metrics.items():
        if name != "seconds":
            np.testing.assert_allclose(values, records[1].metrics[name], atol=1e-5, rtol=1e-4, err_msg=name)
    for name in ("omega_error_percent", "k1_error_percent", "k2_error_percent", "yc_error_m"):
        bound = records[0].bounds[name]["Cramer-Rao"]
        rms, least = (np.sqrt((x**2).mean(-1)).reshape(-1) for x in (records[0].metrics[name][0], bound))
        assert (rms > 0.3 * least).all() and rms[0] < 6 * least[0], name
        # other scenes at the other SNR
        np.testing.assert_allclose(least[0] / least[1], 10, rtol=0.2)
        predicted = records[0].metrics[name.replace("error", "std")][0]
        assert (predicted > 0.5 * bound).all() and (predicted[0] < 3 * bound[0]).all(), name


def test_a_sweep_by_command(tmp_path: Path) -> None:
    grid = {
        "world.rotation.k": {"even": [0.0, 0.0], "uneven": [10.0, 1000.0]},
        "trials": 1,
        "success": {"omega_error_percent": 10.0},
    }
    config = write(tmp_path, sweep=grid, processor=FEW)
    assert main(["sweep", config, "--out", str(tmp_path / "sweep")]) == 0
    points = json.loads((tmp_path / "sweep" / "summary.json").read_text(encoding="utf-8"))["points"]
    by = {(p["metric"], p["parameters"]["world.rotation.k"]): p for p in points if p["algorithm"] == "recommended"}
    assert (
        by["k1_error_percent", "uneven"]["n"] == by["k1_error_per_s", "even"]["n"] == 1
    )  # of a true 0 there is no percentage
    assert by["k1_error_percent", "even"]["n"] == 0 and abs(by["k1_error_per_s", "even"]["mean"]) < 0.5


def test_requires_names_order_and_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["requires", write(tmp_path), "--out", str(tmp_path / "needs")]) == 0
    assert "the simplest model that this scene allows: order 3, phase_only" in capsys.readouterr().out
    needs = json.loads((tmp_path / "needs" / "requires.json").read_text(encoding="utf-8"))["turning"]
    assert needs["order"] == 3 and all(row["verdict"] == "ok" for row in needs["limits"])
    assert main(["requires", write(tmp_path), "world.rotation.k=[0.0, 0.0]"]) == 0
    assert "order 1, phase_only" in capsys.readouterr().out


def test_trade_sets_orders_kernels_estimators_and_precisions_side_by_side(tmp_path: Path) -> None:
    assert main(["trade", write(tmp_path), "--out", str(tmp_path / "trade")]) == 0
    tables = json.loads((tmp_path / "trade" / "trade.json").read_text(encoding="utf-8"))
    entropies = [row["entropy_nats"] for row in tables["order"]]
    assert entropies[0] > entropies[1] > entropies[2] == entropies[3] and entropies[7] == entropies[6] < entropies[2]
    rows = {row["name"]: row for table in ("gridding", "estimators", "precision") for row in tables[table]}
    assert rows["the sum itself"]["entropy_error_nats"] == 0.0
    assert (
        rows["6 taps, grid x2, complex64"]["image_error_db"]
        < rows["4 taps, grid x2, complex64"]["image_error_db"]
        < -60
    )
    assert rows["recommended"]["k1_error_percent"] < rows["coarse"]["k1_error_percent"]
    assert rows["coarse"]["omega_error_percent"] is None and rows["recommended, complex64"]["k1_error_percent"] < 0.5
    assert len(list((tmp_path / "trade" / "figures").glob("*.png"))) == 4


def _method(**stages: dict) -> dict:
    return {
        "processor": {"ideal": TINY["processor"]["ideal"], "recommended": {"stages": KNOWN}, "odd": {"stages": stages}}
    }


def _world(**changes: object) -> dict:
    return {"world": {**TINY["world"], **changes}, "processor": FEW}


def _points(x: list[float], y: list[float]) -> dict:
    return {"scene": {"points": {"kind": "points", "azimuth_m": x, "range_m": y}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radar": {**TINY["radar"], "carrier_hz": 1.9e14}}, "give one of wavelength_m and carrier_hz"),
        (
            {"radar": {key: value for key, value in TINY["radar"].items() if key != "wavelength_m"}},
            "give one of wavelength_m and carrier_hz",
        ),
        (_world(rotation={"omega_rad_s": 0.0}), "key 'world.rotation.omega_rad_s' has the value 0.0"),
        (_world(rotation={"omega_rad_s": 0.02, "k1": 10.0}), "key 'world.rotation.k1' is not known"),
        (_world(rotation={"omega_rad_s": 0.02, "k": [-100.0, 2000.0]}), "two times share an angle"),
        (_world(rotation_rad_s=0.02), "world.rotation_rad_s"),
        (
            _world(scene={"satellite": {"kind": "satellite", "count": 60, "half_width_m": 1.0}}),
            "Doppler over half the pulse rate is 1.445",
        ),
        (
            _world(**_points([0.05, 0.1, 0.2, 0.3], [0.0, 0.0, 0.0, 0.0])),
            "range term, pi lambda sigma_y / ra^2 is 0 rad, and must be at least 1 rad: the rate",
        ),
        (_world(**_points([0.1, 0.2], [1.0, 2.0])), "scatterers above the noise is 2, and must be at least 3"),
        ({"beyond_limits": ["recomended"]}, "beyond_limits names the method 'recomended'"),
        (
            _method(rotation={"stage": "rotation"}),
            "processor.odd, whose last stage gives the axes ('pulse', 'range'), not an image",
        ),
        (_method(image={"stage": "matched_fourier", "uses": {"warp_k": "rotation"}}), "rotation"),
        (
            _method(
                rotation={"stage": "rotation_genetic", "low": [0.018, 9.0], "high": [0.022, 11.0]},
                image={"stage": "matched_fourier"},
            ),
            "needs the 3 values omega_rad_s, k1_per_s, k2_per_s2",
        ),
        ({"metrics": {"reference": "none"}}, "name a method with 'input: clean'"),
        (
            {
                **_world(**_points([-0.3, 0.1, 0.2], [1.0, -1.0, 2.0])),
                "metrics": {"reference": "ideal", "search_m": 1e-6},
            },
            "widen metrics.search_m",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, changes: dict, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", write(tmp_path, **changes), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_method_may_be_shown_beyond_its_limits(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    world = _world(**_points([0.05, 0.1, 0.2, 0.3], [0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(ConfigError, match=r"processor\.recommended: range term"):
        heed_limits(load(write(tmp_path, **world)), "")
    heed_limits(load(write(tmp_path, **world, beyond_limits=["recommended"])), "odd")
    assert "cases.odd: range term" in caplog.text


def test_recordings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "record.npz", profiles=np.zeros((4, 4), np.complex64))
    for command in ("run", "requires", "trade"):
        assert (
            main([command, write(tmp_path), f"data.file={tmp_path / 'record.npz'}", "--out", str(tmp_path / "other")])
            == 2
        )
        assert "leave data.file out" in capsys.readouterr().err


def test_listing_knows_the_experiments(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    assert all(
        name in said
        for name in (
            "isal_rotation_points",
            "isal_satellite",
            "isal_corner_cubes",
            "isal_rotation_snr",
            "rotation_and_phase",
            "satellite",
        )
    )


def test_a_cut_measures_a_sinc() -> None:
    along, across = Axis("cross range", 400, -200 * 0.4, 0.4, "m"), Axis("range", 3, -1.0, 1.0, "m")
    x, width = along.values() - 7.3, 0.8  # half a cell a line, between lines
    line = torch.sinc(x / width) * torch.polar(torch.ones_like(x), math.pi * 0.5 * (x / 0.4))
    figures = cut_through(
        Signal(torch.stack([0 * line, 3 * line, 0 * line], -1), (along, across)), 7.2, 0.2, 20.0, 0.25
    ).figures
    assert figures["peak"] == pytest.approx(3.0, rel=2e-3)
    assert figures["irw_azimuth_m"] == pytest.approx(0.886 * width, rel=5e-3)
    assert figures["pslr_azimuth_db"] == pytest.approx(-13.26, abs=0.05)


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
    assert (
        rows["warp of order 3"].phase_rad == rows["warp of order 4"].phase_rad == 0.0
        and least_order(tuple(rows.values())) == 3
    )
    # at the depth of focus
    assert rows["azimuth only"].phase_rad == pytest.approx(math.pi / 4, rel=1e-9)
    assert (
        rows["fixed envelopes (phase_only)"].range_cells == pytest.approx(6.43 * ANGLE / 0.24, rel=1e-6)
        and rows["fixed envelopes (phase_only)"].ok
    )
    assert not {row.effect: row for row in rotation_requirements(*TURN, 110.0, 1.0)}[
        "fixed envelopes (phase_only)"
    ].ok  # 0.21 cells
    assert least_order(rotation_requirements(RADAR, 10000, 0.02, [10.0, 1000.0, 1e6], 6.43, 1.0)) == 4


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
