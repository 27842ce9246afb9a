"""Reduced forms run, verdicts follow from the numbers, and the command says what it found."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from torchsar import plot
from torchsar.cli import main
from torchsar.reproduce import (
    BETTER,
    MISPRINT,
    NOT_REPRODUCED,
    PAPERS,
    REPRODUCED,
    Fact,
    Item,
    Paper,
    falling,
    misprint,
    number,
    paper,
    reproduce,
    settled,
    statement,
    verdict,
)
from torchsar.reproduce.command import entry, read, write


@pytest.mark.parametrize(
    "ours, std, better, expected",
    [
        (1.0, 0.0, "", REPRODUCED),
        (1.09, 0.0, "", REPRODUCED),
        (1.15, 0.0, "", NOT_REPRODUCED),
        (1.15, 0.09, "", NOT_REPRODUCED),  # a deviation does not widen the tolerance
        (1.05, 0.5, "", NOT_REPRODUCED),  # a poor estimate proves nothing
        (0.95, 0.5, "lower", NOT_REPRODUCED),
        (0.5, 0.0, "lower", BETTER),
        (0.5, 0.0, "higher", NOT_REPRODUCED),
        (1.5, 0.0, "higher", BETTER),
        (math.nan, 0.0, "lower", NOT_REPRODUCED),
        (-math.inf, 0.0, "lower", NOT_REPRODUCED),
    ],
)
def test_verdict(ours: float, std: float, better: str, expected: str) -> None:
    assert verdict(1.0, ours, std, 0.1, better) == expected


def test_numbers_of_draws_have_a_deviation() -> None:
    check = number("x", 1.0, [0.9, 1.0, 1.1], 0.01)
    assert check.ours == pytest.approx(1.0) and check.std == pytest.approx(0.1 / math.sqrt(3))
    assert number("x", 1.0, [0.9], 0.01).std is None and number("x", 1.0, 0.9, 0.01).std == 0
    assert check.draws == 3 and number("x", 1.0, 0.9, 0.01).draws == 0


def test_orders_are_compared() -> None:
    assert falling("x", {"a": 3.0, "b": 2.0}).verdict == REPRODUCED
    assert falling("x", {"a": 3.0, "b": 2.0}, rising=True).verdict == NOT_REPRODUCED
    assert "a 3; b 2" in str(falling("x", {"a": 3.0, "b": 2.0}).ours)
    several = falling("x", {"a": [3.0, 1.0], "b": [1.0, 2.0]})
    assert several.verdict == REPRODUCED and several.draws == 2


def test_the_worst_comparison_decides() -> None:
    item = Item("Table 1", "x")
    good, best, bad = number("x", 1, 1, 0), number("x", 1, 0, 0, "lower"), statement("x", "so", False, "no")
    assert settled(item, [good]) == REPRODUCED and settled(item, [good, best]) == BETTER
    assert settled(item, [good, best, bad]) == NOT_REPRODUCED and settled(item, []) == NOT_REPRODUCED
    assert settled(Item("Figure 1", "x", kind="diagram"), []) == "diagram"
    wrong = misprint("x", "2", True, "3")
    assert settled(item, [good, best, wrong]) == MISPRINT and settled(item, [bad, wrong]) == NOT_REPRODUCED
    assert misprint("x", "2", False, "2").verdict == NOT_REPRODUCED


def test_a_reason_stands_with_its_numbers() -> None:
    item = Item("Table 1", "x", why="{share:.0f} % are lost")
    bad = statement("x", "so", False, "no")
    stands = entry(item, [bad, Fact("share", 51.2, least=50)], None)
    assert stands["why"] == "51 % are lost" and stands["facts"][0]["most"] is None
    falls = entry(item, [bad, Fact("share", 48.0, least=50)], None)
    assert falls["why"].startswith("the reason that the full form has does not hold here: it expects share 48 in 50")
    assert entry(item, [number("x", 1, 1, 0), Fact("share", 51.2)], None)["facts"] == []


# verdicts of the reduced form that are not "reproduced" or "better": what is not public, or not
# reproduced in the full form either, or needs its size
EXPECTED = {
    "sal": {"Figure 15", "Table 6"},
    "geo": {"Figure 16", "Table 4"},  # figure 16: P1 is 0.92 m wide in short lines
    "isal": {"Table 1"},
    # figure 13 and Tables 3 and 4: a search of six images does not improve with the SNR; Text 3: it
    # is faster than a step of Newton's method
    "isal_rotation": {"Figure 13", "Figure 19", "Table 3", "Table 4", "Text 2", "Text 3"},
    "stripmap": set(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PAPERS)
def test_reduced_forms_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are drawn, but not written: that takes as long as all the rest."""
    drawn: list[str] = []

    def keep(figure: Any, path: Path, columns: int = 2) -> None:
        assert all(one.axes for one in (figure if isinstance(figure, Sequence) else [figure]))
        drawn.append(path.name)

    monkeypatch.setattr(plot, "save", keep)
    text = reproduce(name, None, tmp_path, small=True)
    entries = read(tmp_path / f"{name}.json")
    own: Paper = paper(name)
    assert list(entries) == [item.label for item in own.items]
    assert {label for label, one in entries.items() if one["verdict"] == NOT_REPRODUCED} <= EXPECTED[name]
    assert all(item.file in drawn for item in own.items if item.make is not None and item.kind == "figure")
    for item in own.items:
        one = entries[item.label]
        assert f"{item.label:12}{one['verdict']:>38}" in text
        assert item.make is None or one["made"]["form"] == "reduced"
        assert all(check["ours"] is not None for check in one["checks"])


def test_the_command_makes_one_item(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "stripmap", "fig9", "--small", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "Figure 9" in text and "Figure 8" not in text and "rad rms" in text
    assert (tmp_path / "stripmap" / "figure_09.png").read_bytes().startswith(b"\x89PNG")
    first = json.loads((tmp_path / "stripmap.json").read_text(encoding="utf-8"))
    assert [one["item"] for one in first["items"]] == ["Figure 9"]
    assert main(["reproduce", "stripmap", "figure3", "--small", "--out", str(tmp_path)]) == 0
    assert list(read(tmp_path / "stripmap.json")) == ["Figure 3", "Figure 9"]  # the earlier one is kept


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["nowhere"], "there is no paper 'nowhere'; choose one of sal, geo, isal, isal_rotation, stripmap"),
        (
            ["sal", "table9"],
            "the paper of sal has no 'table9'; it has figure1 to figure19, table1 to table6, text1 to text4",
        ),
    ],
)
def test_bad_names_are_one_sentence(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reproduce", *arguments, "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"torchsar: {said}"
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_record_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "stripmap.json").write_text("mine", encoding="utf-8")
    assert main(["reproduce", "stripmap", "fig9", "--out", str(tmp_path)]) == 2
    assert "stripmap.json is not a record of reproduced figures" in capsys.readouterr().err
    assert (tmp_path / "stripmap.json").read_text(encoding="utf-8") == "mine"


def test_a_record_survives_a_round_trip(tmp_path: Path) -> None:
    own = Paper("x", "y", (Item("Figure 1", "a"), Item("Table 1", "b")))
    write(tmp_path / "x.json", own, {"Table 1": {"item": "Table 1"}, "Figure 1": {"item": "Figure 1"}})
    assert list(read(tmp_path / "x.json")) == ["Figure 1", "Table 1"] and read(tmp_path / "none.json") == {}
