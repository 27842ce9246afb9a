"""Alternatives beside an exact yardstick: `torchsar trade`, its rule, and the kept results."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.scripting import script
from tests.study.tiny import write_tiny
from torchsar.cli import main
from torchsar.study.commands.trade import compared, trade
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import cases_of
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured, choices_of, tolerance_of

pytestmark = pytest.mark.usefixtures("blank_pictures")

ROOT = Path(__file__).parents[2]
KEPT = sorted((ROOT / "docs" / "trade").glob("*.json"))
FIELDS = {"name", "cpu_s", "wall_s", "peak_bytes", "loss", "within_tolerance", "recommended"}


def tiny_bench(tmp_path: Path) -> Bench:
    return Bench(load(str(write_tiny(tmp_path)), ["trade.repeats=2"]))


def invented(losses: Mapping[str, Any]) -> Choice:
    """Alternatives with given losses; the work of the first three grows 30 times with each."""

    def run(one: Alternative) -> float:
        torch.ones(60, 60 * 30 ** min(list(losses).index(one.name), 2)).square().sum()
        if losses[one.name] == "fails":
            raise ValueError("this alternative cannot be built")
        return losses[one.name]

    measured = Measured(run, lambda one, found: {"image_error_db": found})
    return Choice("invented", "stage", [Alternative(name, {"stage": name}) for name in losses], lambda: measured)


def test_the_cheapest_within_tolerance_is_recommended(tmp_path: Path) -> None:
    bench = tiny_bench(tmp_path)
    losses = {"coarse": -10.0, "fair": -25.0, "good": -60.0, "wrong": math.nan, "endless": math.inf, "broken": "fails"}
    rows = {row["name"]: row for row in compared(invented(losses), bench, {"image_error_db": -20.0})}
    assert [name for name, row in rows.items() if row["recommended"]] == ["fair"]
    assert [name for name, row in rows.items() if row["within_tolerance"]] == ["fair", "good"]
    assert "not finite" in rows["wrong"]["failed"] and "not finite" in rows["endless"]["failed"]
    assert rows["broken"]["failed"] == "this alternative cannot be built" and rows["broken"]["cpu_s"] is None
    strict = compared(invented(losses), bench, {"image_error_db": -70.0})
    assert not any(row["recommended"] for row in strict)


def test_a_table_has_the_fixed_fields_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["trade", str(write_tiny(tmp_path)), "trade.repeats=1", "--out", str(out)]) == 0
    tree = json.loads((out / "trade.json").read_text(encoding="utf-8"))
    assert {"alternatives", "tolerance", "machine"} <= set(tree)
    for row in tree["alternatives"]:
        assert set(row) >= FIELDS
        assert row["cpu_s"] > 0 and row["wall_s"] > 0
    kept = [row for row in tree["alternatives"] if row["within_tolerance"]]
    assert [row["name"] for row in kept if row["recommended"]] == [min(kept, key=lambda row: row["cpu_s"])["name"]]
    assert len(list((out / "figures").glob("*.png"))) == 1 + len(tree["others"])
    assert "omega_k_stolt" in capsys.readouterr().out


def test_an_unknown_tolerance_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="image_error_db"):
        trade(load(str(write_tiny(tmp_path)), ["trade.tolerance.image_eror_db=-30"]), tmp_path / "out")


def test_the_kept_results_name_the_configs_of_the_script() -> None:
    assert {path.stem for path in KEPT} == set(script("keep_trade").CONFIGS)


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_the_kept_results_are_well_formed(path: Path) -> None:
    """Every alternative of the config stands in its file, and the rule marks one of each choice."""
    tree = json.loads(path.read_text(encoding="utf-8"))
    assert tree["config"] == script("keep_trade").CONFIGS[path.stem] and tree["system"] == path.stem
    loaded = load(tree["config"], [])
    assert tree["tolerance"] == tolerance_of(loaded)
    tables = {tree["choice"]: tree["alternatives"], **tree["others"]}
    for rows in tables.values():
        assert all(set(row) >= FIELDS for row in rows)
        kept = [row for row in rows if row["within_tolerance"]]
        for row in rows:
            inside = all(value <= tree["tolerance"].get(name, math.inf) for name, value in row["loss"].items())
            assert row["within_tolerance"] == (inside and not row["failed"])
        least = min((row["cpu_s"] for row in kept), default=None)
        assert [row["cpu_s"] for row in rows if row["recommended"]] == ([] if least is None else [least])


def test_the_kept_losses_are_reproduced() -> None:
    """Echo models and range terms, the quick choices."""
    for system, name in (
        ("isal", "echo model"),
        ("isal_rotation", "range term"),
        ("isal_rotation", "order of the rotation"),
    ):
        tree = json.loads((ROOT / "docs" / "trade" / f"{system}.json").read_text(encoding="utf-8"))
        kept = {tree["choice"]: tree["alternatives"], **tree["others"]}[name]
        loaded = load(tree["config"], ["trade.trials=1", "world.trials=1"])
        bench = Bench(next(iter(cases_of(loaded).values())))
        choice = next(choice for choice in choices_of(bench) if choice.name == name)
        assert choice.measured is not None
        measured = choice.measured()
        for row, one in zip(kept, choice.alternatives, strict=True):
            assert row["name"] == one.name
            for metric, value in measured.loss(one, measured.run(one)).items():
                assert row["loss"][metric] == pytest.approx(max(value, -300.0), rel=1e-3, abs=1e-3)
