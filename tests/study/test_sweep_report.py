"""From a record to summary, pictures and report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.study.scenes import draw_first_panels
from torchsar.core import Draws, Outcome
from torchsar.plot import axis_label
from torchsar.study.montecarlo import sweep
from torchsar.study.montecarlo.record import Record, summary_of
from torchsar.study.montecarlo.report import SweepPictures, draw_sweep, with_interval, write_sweep_report
from torchsar.study.montecarlo.summary import Summary
from torchsar.study.montecarlo.work import BOUNDS
from torchsar.study.output.numbers import number, write_json
from torchsar.study.output.report import Picture

GRID = {"world.noise.snr_db": (20.0, -10.0, 5.0), "world.squint_deg": (0.0, 3.0), "world.scene": ("point", "speckle")}
SESSION = {"device": "cpu", "versions": {"torch": "2.13.0"}, "seconds": 4.0, "trials": 470}


def synthetic(
    labels: dict[str, tuple[float | str, ...]], trials: int = 40, algorithms: tuple[str, ...] = ("wide", "narrow")
) -> Record:
    """Gaussian errors, three times wider for the first algorithm; the first point ends early and
    has a trial that failed.
    """
    shape, random = tuple(map(len, labels.values())), np.random.default_rng(8)
    done = np.ones((*shape, trials), bool)
    done.reshape(-1, trials)[0, trials // 4 :] = False
    bound = np.where(done, 2.0, np.nan)
    width = np.array([6.0, 2.0])[: len(algorithms)].reshape(-1, *(1,) * done.ndim)
    error = np.where(done, width * random.standard_normal((len(algorithms), *shape, trials)), np.nan)
    error.reshape(len(algorithms), -1, trials)[:, 0, 0] = np.inf
    entropy = np.where(done, 8 + random.random(error.shape), np.nan)
    codes = np.where(np.isnan(error) | (np.abs(error) < 12), Outcome.OK, Outcome.MISFIT)
    codes[np.isinf(error)] = Outcome.NOISE
    about = {"title": "A sweep <of> trials", "seed": 7, "hash": "0123abcd", "dtype": "complex64", "sessions": [SESSION]}
    return Record(
        algorithms,
        labels,
        done,
        np.where(done, codes, 255).astype(np.uint8),
        {"doppler_error_hz": error, "entropy_nats": entropy},
        {"doppler_error_hz": {"Cramer-Rao": bound}},
        about,
    )


@pytest.fixture(scope="module")
def record() -> Record:
    return synthetic(GRID)


@pytest.fixture(scope="module")
def figures(record: Record) -> Summary:
    return summary_of(record, {"doppler_error_hz": 4.0})


@pytest.fixture(scope="module")
def summary(record: Record, figures: Summary, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """As read from the file."""
    path = tmp_path_factory.mktemp("summary") / "summary.json"
    write_json(path, figures.tree(record.about, {"snr": "power over variance"}))
    return json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


@pytest.fixture(scope="module")
def drawn(figures: Summary, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Picture]]:
    folder = tmp_path_factory.mktemp("sweep") / "figures"
    with pytest.MonkeyPatch.context() as patch:
        draw_first_panels(patch)
        return folder, draw_sweep(figures, folder, ["doppler_error_hz", "entropy_nats"])


@pytest.fixture(scope="module")
def page(summary: dict[str, Any], drawn: tuple[Path, list[Picture]]) -> str:
    folder, pictures = drawn
    path = folder.parent / "report.html"
    write_sweep_report(path, summary, pictures, folder, "sweep:\n  trials: 40\n", "torchsar sweep synthetic")
    return path.read_text(encoding="utf-8")


# --- summary
# --------------------------------------------------------------------------------------------------


def test_summary_follows_the_schema(summary: dict[str, Any]) -> None:
    assert set(summary) == {"title", "parameters", "algorithms", "trials", "points", "bounds", "definitions", "about"}
    assert summary["parameters"] == {name: list(values) for name, values in GRID.items()} and summary["trials"] == 40
    assert len(summary["points"]) == 2 * 12 * 2 and len(summary["bounds"]) == 12
    common = {
        "algorithm",
        "parameters",
        "metric",
        "n",
        "trials",
        "mean",
        "median",
        "rmse",
        "std",
        "interval",
        "mean_interval",
        "median_interval",
        "ok_share",
        "ok_interval",
        "outcomes",
    }
    for point in summary["points"]:
        assert set(point) == common | (
            {"success_limit", "success_share", "success_interval"} if point["metric"] == "doppler_error_hz" else set()
        )
        assert len(point["interval"]) == len(point["ok_interval"]) == 2
        assert sum(point["outcomes"].values()) == point["trials"] and set(point["outcomes"]) <= {
            "OK",
            "MISFIT",
            "NOISE",
        }
    assert summary["definitions"]["outcome NOISE"] == Outcome.NOISE.message
    assert {"snr", "rmse", "interval", "ok_share", "success_share", "bound"} <= set(summary["definitions"])
    assert "ok" in summary["definitions"]["statistics"]


def test_points_hold_the_statistics_of_their_trials(record: Record, summary: dict[str, Any]) -> None:
    """All finite trials count, ok or not; failed and untrusted ones are no success."""
    point = next(
        p
        for p in summary["points"]
        if p["algorithm"] == "wide"
        and p["parameters"] == {"world.noise.snr_db": 20.0, "world.squint_deg": 0.0, "world.scene": "point"}
    )
    values, ok = record.metrics["doppler_error_hz"][0, 0, 0, 0, :10], record.ok[0, 0, 0, 0, :10]
    assert point["trials"] == 10 and point["n"] == 9
    assert np.isclose(point["rmse"], np.sqrt(np.mean(values[1:] ** 2)))
    assert np.isclose(point["ok_share"], ok.mean()) and np.isclose(
        point["success_share"], np.mean(ok & (np.abs(values) <= 4.0))
    )
    assert point["outcomes"]["NOISE"] == 1 and point["outcomes"]["OK"] == ok.sum()
    assert {bound["rms"] for bound in summary["bounds"]} == {2.0}


def test_trials_that_were_not_assessed_count_neither_way(record: Record) -> None:
    codes = record.outcome.copy()
    codes[0, ..., :20], codes[1] = np.where(record.done[..., :20], Outcome.NOT_ASSESSED, 255), Outcome.NOT_ASSESSED
    figures = summary_of(replace(record, outcome=codes), {}).figures["doppler_error_hz"]
    assert np.isnan(figures["ok_share"][1]).all()
    assert np.isclose(figures["ok_share"][0, 0, 0, 1], record.ok[0, 0, 0, 1, 20:].mean())


def test_marking_failures_as_unreliable_changes_no_error(record: Record, summary: dict[str, Any]) -> None:
    modest = Record(
        record.algorithms,
        record.labels,
        record.done,
        np.where(np.isnan(record.metrics["entropy_nats"]), 255, Outcome.NOISE).astype(np.uint8),
        record.metrics,
        record.bounds,
        record.about,
    )
    points = summary_of(modest, {"doppler_error_hz": 4.0}).tree(modest.about, {})["points"]
    assert [p["rmse"] for p in points] == [p["rmse"] for p in summary["points"]]
    assert {p["success_share"] for p in points if "success_share" in p} == {0.0}


def test_numbers_that_are_missing_become_null(tmp_path: Path) -> None:
    empty = synthetic({"snr_db": (0.0,)}, trials=4)
    empty.done[:] = False
    empty.metrics["doppler_error_hz"][:] = np.nan
    write_json(tmp_path / "summary.json", summary_of(empty, {}).tree(empty.about, {}))
    point = json.loads((tmp_path / "summary.json").read_text())["points"][0]
    assert (point["n"], point["trials"], point["rmse"], point["interval"], point["ok_share"]) == (
        0,
        0,
        None,
        [None, None],
        None,
    )


# --- pictures
# --------------------------------------------------------------------------------------------------


WORDS: dict[str, tuple[float | str, ...]] = {
    "scene": ("point", "speckle"),
    "beam": ("dwell", "sinc"),
    "snr_db": (10.0,),
}
MANY: dict[str, tuple[float | str, ...]] = {
    "snr_db": (0.0, 10.0),
    "speed_m_s": tuple(map(float, range(7))),
    "gain": (0.1, 1.0, 1000.0),
    "scene": ("a", "b", "c"),
}
THREE_PARAMETERS = [
    "error.*over_snr_db",
    "error.*over_squint",
    "success.*over_snr_db",
    "map_snr_db_squint",
    "entropy.*over_snr",
    "ok_share_over_snr_db",
]
SWEEPS = {
    "one number": ({"snr_db": (0.0, 10.0)}, ["error.*rmse_over_snr", "success_share_over_snr"]),
    "words alone": (WORDS, ["rmse_over_scene", "success_share_over_scene"]),
    "one point": ({}, ["rmse", "success_share", "ok_share"]),
    "two pages": (
        {"gain": (0.1, 1.0, 1000.0), "scene": tuple("abcdefg")},
        ["01_.*rmse_over_gain", "02_.*rmse_over_gain"],
    ),
}


def check_pictures(pictures: list[Picture], folder: Path, expected: list[str]) -> None:
    files = [file for p in pictures for file in p.files]
    assert sorted(files) == sorted(path.name for path in folder.iterdir())
    assert all((folder / file).read_bytes().startswith(b"\x89PNG") for file in files)
    for pattern in expected:
        assert any(re.search(pattern, file) for file in files), pattern
    assert all("trials a point" in p.caption for p in pictures)
    assert all("95%" in p.caption for p in pictures if "_map_" not in p.files[0])


@pytest.mark.slow
def test_three_parameters_have_curves_shares_and_maps(drawn: tuple[Path, list[Picture]]) -> None:
    check_pictures(drawn[1], drawn[0], THREE_PARAMETERS)


@pytest.mark.slow
@pytest.mark.parametrize("labels, expected", SWEEPS.values(), ids=SWEEPS)
def test_every_sweep_has_its_pictures(
    labels: dict[str, tuple[float | str, ...]], expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_first_panels(monkeypatch)
    record = synthetic(labels, trials=8)
    del record.metrics["entropy_nats"]
    success = {"doppler_error_hz": 4.0} if any("success" in name for name in expected) else {}
    check_pictures(
        draw_sweep(summary_of(record, success), tmp_path / "figures"),
        tmp_path / "figures",
        expected,
    )


def test_errors_are_drawn_unless_something_else_is_asked_for(tmp_path: Path) -> None:
    figures = summary_of(synthetic({"snr_db": (0.0, 10.0)}, trials=8), {"doppler_error_hz": 4.0})
    assert "entropy_nats" in figures.figures
    files = [p.files[0] for p in draw_sweep(figures, tmp_path / "a")]
    assert any("doppler_error_hz" in name for name in files) and not any("entropy" in name for name in files)


def test_panels_are_thinned_and_the_caption_says_so() -> None:
    cube = SweepPictures(summary_of(synthetic(MANY, trials=2), {}))
    panels, note = cube.panels_beside({"snr_db", "gain"})
    assert len(panels) == 6 and {p.index["speed_m_s"] for p in panels} == {0, 6}
    assert "Of 7 values of speed this shows 0, 6" in note
    panels, note = SweepPictures(summary_of(synthetic(GRID), {})).panels_beside({"world.noise.snr_db"})
    assert [p.title for p in panels] == [
        "scene: point, squint 0 deg",
        "scene: point, squint 3 deg",
        "scene: speckle, squint 0 deg",
        "scene: speckle, squint 3 deg",
    ] and not note


def test_curves_run_along_sorted_numbers(figures: Summary, summary: dict[str, Any]) -> None:
    cube = SweepPictures(figures)
    panel = cube.panels_beside({"world.noise.snr_db"})[0][1]
    along = cube.cut(cube.figures["doppler_error_hz"]["rmse"], panel, "world.noise.snr_db")
    at = {"world.squint_deg": 3.0, "world.scene": "point"}
    chosen = {
        p["parameters"]["world.noise.snr_db"]: p["rmse"]
        for p in summary["points"]
        if (p["algorithm"], p["metric"]) == ("narrow", "doppler_error_hz") and at.items() <= p["parameters"].items()
    }
    np.testing.assert_array_equal(along[1], [chosen[-10.0], chosen[5.0], chosen[20.0]])


LABELS = {
    "doppler_error_hz": "Doppler error (Hz)",
    "world.noise.snr_db": "SNR (dB)",
    "v_m_s": "v (m/s)",
    "yaw_rad_s": "yaw (rad/s)",
    "beam": "beam",
    "seconds": "seconds",
}


@pytest.mark.parametrize("name, label", LABELS.items(), ids=LABELS)
def test_labels_come_from_names(name: str, label: str) -> None:
    assert axis_label(name) == label


# --- report
# --------------------------------------------------------------------------------------------------


class Reader(HTMLParser):
    """Addresses of everything a page names, and the cells of its tables by row."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.rows: list[list[str]] = []
        self.cell = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self.cell = tag == "td"
        if tag == "tr":
            self.rows.append([])

    def handle_data(self, data: str) -> None:
        if self.cell:
            self.rows[-1].append(data)
            self.cell = False


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    return reader


def test_the_report_loads_no_external_resources(page: str, drawn: tuple[Path, list[Picture]]) -> None:
    addresses, panels = read(page).addresses, [file for picture in drawn[1] for file in picture.files]
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert sum(address.startswith("data:image/png;base64,") for address in addresses) == len(panels)
    assert page.count("<figure>") == len(drawn[1]) >= 8
    assert not re.search(r"https?://|@import|url\(|<script", page)
    assert {address[1:] for address in addresses if address.startswith("#")} <= set(re.findall(r'id="(\w+)"', page))


def test_report_shows_the_numbers_of_the_summary(page: str, summary: dict[str, Any]) -> None:
    rows = [row for row in read(page).rows if row and row[0] in summary["algorithms"]]
    count = len(summary["points"])
    assert len(rows) == count + count // 2
    points = [point for point in summary["points"] if point["metric"] == "doppler_error_hz"]
    for row, point in zip(rows[count:], points, strict=True):
        assert row[4:6] == [f"{point['trials']}", with_interval(point["ok_share"], point["ok_interval"])]
        assert row[6] == ", ".join(f"{Outcome[name].label}: {n}" for name, n in point["outcomes"].items())
    rows = rows[:count]
    for row, point in zip(rows, sorted(summary["points"], key=lambda p: p["metric"]), strict=True):
        assert row[0] == point["algorithm"] and row[4] == f"{point['n']} of {point['trials']}"
        assert row[5] == with_interval(point["rmse"], point["interval"]) and row[5].startswith(
            f"{number(point['rmse'])} ["
        )
        assert len(row) == (11 if "success_share" in point else 10)


def test_report_says_where_it_was_made(page: str) -> None:
    assert "A sweep &lt;of&gt; trials" in page and "<of>" not in page
    for text in (
        "470",
        "10 to 40",
        "117.5",
        "0123abcd",
        "complex64",
        "torch 2.13.0",
        "power over variance",
        "trials: 40",
        "torchsar sweep synthetic",
    ):
        assert text in page, text


def test_intervals_stand_in_brackets_where_there_is_one() -> None:
    assert with_interval(2.0, [None, None]) == "2" and with_interval(2.0, [1.5, 2.5]) == "2 [1.500, 2.500]"


def test_a_record_of_a_script_draws_itself_and_has_a_table(tmp_path: Path) -> None:
    """The figure is that of a report; the table has the statistics of each point."""

    def trial(parameters: Any, draws: Draws) -> Any:
        error = draws.normal("noise", (1,))[:, 0] * 10 ** (-parameters["snr_db"] / 20)
        return {"a": {"error_m": error}, "b": {"error_m": 2 * error}, BOUNDS: {"error_m": {"limit": error * 0 + 0.1}}}

    record = sweep(trial, {"snr_db": [0.0, 20.0]}, batched=["snr_db"], trials=50)
    (figure,) = record.plot("error_m")
    axes = figure.axes[0]
    assert {line.get_label() for line in axes.lines} >= {"a", "b"} and axes.get_yscale() == "log"
    with pytest.raises(KeyError, match=r"finite numbers of this record are \['error_m'\], got 'error'"):
        record.plot("error")
    first = record.table()[0]
    assert first["rmse"] == pytest.approx(np.sqrt((record.metrics["error_m"][0, 0] ** 2).mean()))
    assert first["rmse_low"] < first["rmse"] < first["rmse_high"] and first["bound_limit"] == pytest.approx(0.1)
    record.to_csv(tmp_path / "table.csv")
    lines = (tmp_path / "table.csv").read_text().splitlines()
    assert lines[0].startswith("metric,algorithm,snr_db,n,trials,rmse") and len(lines) == 5
    with pytest.raises(FileExistsError):
        record.to_csv(tmp_path / "table.csv")
    assert "95% interval" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_record_is_drawn_over_a_parameter_and_counts_outcomes() -> None:
    def trial(parameters: Any, draws: Draws) -> Any:
        error = draws.normal("noise", (1,))[:, 0] * parameters["scale"] * 10 ** (-parameters["snr_db"] / 20)
        code = torch.where(error > 0, int(Outcome.OK), int(Outcome.NOISE))
        return {"a": {"error_m": error, "outcome": code.to(torch.uint8)}}

    grid = {"scale": [1.0, 2.0, 3.0], "snr_db": [0.0, 20.0]}
    record = sweep(trial, grid, batched=["snr_db"], trials=20)
    assert record.plot("error_m")[0].axes[0].get_xlabel() == "scale"
    over = record.plot("error_m", over="snr_db")
    assert len(over) == 3 and over[0].axes[0].get_xlabel() == "SNR (dB)"
    with pytest.raises(KeyError, match="parameters of this record are .'scale', 'snr_db'., got 'snr'"):
        record.plot("error_m", over="snr")
    for row in record.table():
        assert row["outcome_ok"] + row["outcome_noise"] == 20 and row["outcome_ok"] == row["ok_share"] * 20
