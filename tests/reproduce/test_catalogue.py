"""The catalogue lists every numbered figure and table of the papers and numbers of their texts, and
prints their numbers; reasons in the records are what their numbers say.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from tests.conftest import SHARED
from torchsar.reproduce import MISPRINT, NOT_REPRODUCED, PAPERS, Fact, Item, Paper, paper
from torchsar.reproduce.item import KINDS, SHOWN

ROOT = Path(__file__).resolve().parents[2]
TEXTS = SHARED.parent / "papers"
RECORDS = ROOT / "docs" / "reproduce"
# texts of the papers, and how each numbers its figures and tables
SOURCES = {
    "sal": ("000", r"\b(Fig|Tab)(?:ure|le) (\d+)"),
    "geo": ("001", r"\b(Fig|Tab)(?:ure|le) (\d+)"),
    "isal": ("002", r"\b(Fig|Tab)(?:\.|le) (\d+)"),
    "isal_rotation": ("003", r"\b(Fig|Tab)(?:ure|le) (\d+)"),
    "stripmap": ("004", r"\b([Рр]ис|[Тт]абл)\.? ?(\d+)"),
}


# numbers of the texts, and errors of the papers, by their counts
LISTED = {"sal": (4, 0), "geo": (6, 5), "isal": (1, 0), "isal_rotation": (3, 1), "stripmap": (5, 0)}
# fewest random draws behind what depends on chance
FEWEST = 5


def text_of(name: str) -> str:
    """Text of a paper; skips where the papers are not at hand."""
    found = sorted(TEXTS.glob(f"{SOURCES[name][0]}_*.txt"))
    if not found:
        pytest.skip("the texts of the papers are not at hand")
    return found[0].read_text(encoding="utf-8")


def items(name: str) -> tuple[Item, ...]:
    return paper(name).items


@pytest.mark.parametrize("name", PAPERS)
def test_every_figure_and_table_of_a_paper_is_listed(name: str) -> None:
    found = re.findall(SOURCES[name][1], text_of(name))
    words = {"Fig": "Figure", "Tab": "Table", "Рис": "Figure", "рис": "Figure", "Табл": "Table", "табл": "Table"}
    numbered = {f"{words[word]} {number}" for word, number in found}
    if name == "stripmap":  # the text writes two numbers behind one word
        assert "рис. 10 и 11" in text_of(name)
        numbered |= {"Figure 11"}
    assert {item.label for item in items(name) if item.label.split()[0] in ("Figure", "Table")} == numbered


def test_numbers_of_the_texts_and_errors_of_the_papers_are_listed() -> None:
    for name, counts in LISTED.items():
        found = tuple(sum(item.label.startswith(word) for item in items(name)) for word in ("Text", "Erratum"))
        assert found == counts, name
    assert sum(texts for texts, _ in LISTED.values()) >= 10


@pytest.mark.parametrize("name", PAPERS)
def test_items_are_in_order_and_complete(name: str) -> None:
    labels = [item.label for item in items(name)]
    for word in ("Figure", "Table", "Text", "Erratum"):
        numbers = [int(label.split()[1]) for label in labels if label.startswith(word)]
        assert numbers == list(range(1, len(numbers) + 1))
    for item in items(name):
        assert item.kind in KINDS and item.subject
        assert (item.make is None) == (item.of is None)
        made = item.make is not None
        assert made or item.kind in SHOWN, f"{item.label} is neither made nor shows nothing that can be compared"
        assert bool(item.why) or item.kind != "unpublished"


def found_in(text: str, number: float) -> bool:
    """Whether a paper prints a number, perhaps with more zeros or as a percentage."""
    plain = text.replace("−", "-").replace(" ", " ")
    ways = {f"{number:.{digits}f}" for digits in range(6)} | {f"{number:g}"}
    return any(re.search(rf"(?<![\d.]){re.escape(way.lstrip('-'))}(?!\d)", plain) for way in ways)


# published in other words: 5 km; 2e-7 m (printed 2 with the exponent -7); hundredths of a degree;
# 0.1 mm; the number of targets, channels and points in words; ratios to what is ideal; numbers with
# a comma in them
OTHERWISE = {2e-7, 0.01, 0.0, 2.0, 3.0, 62.0, 1000.0, 10.0, 20.0, 156177.0, 0.75}


@pytest.mark.parametrize("name", PAPERS)
def test_published_numbers_stand_in_the_paper(name: str) -> None:
    path = RECORDS / f"{name}.json"
    text = text_of(name)
    for item in json.loads(path.read_text(encoding="utf-8"))["items"]:
        for check in item["checks"]:
            number = check["published"]
            deviation = "|error|" in check["name"]  # of Tables 2 and 3: printed with two digits
            if isinstance(number, float) and not deviation and number not in OTHERWISE:
                assert found_in(text, number), f"{name}, {item['item']}: {number} of {check['name']}"


@pytest.mark.parametrize(
    "label, known",
    [
        ("table2", "Table 2"),
        ("Table 02", "Table 2"),
        ("fig. 5", "Figure 5"),
        ("FIGURE_12", "Figure 12"),
        ("text 1", "Text 1"),
    ],
)
def test_items_are_found_by_their_numbers(label: str, known: str) -> None:
    assert paper("sal").find(label).label == known


@pytest.mark.parametrize("label", ["table7", "figure", "5", "figure99", ""])
def test_an_unknown_item_is_refused(label: str) -> None:
    with pytest.raises(ValueError, match=r"figure1 to figure19, table1 to table6, text1 to text4"):
        paper("sal").find(label)


@pytest.mark.parametrize("name", PAPERS)
def test_records_are_complete_and_say_why(name: str) -> None:
    record = json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))
    own: Paper = paper(name)
    assert record["paper"] == own.name and record["source"] == own.source
    assert [one["item"] for one in record["items"]] == [item.label for item in own.items]
    for one, item in zip(record["items"], own.items, strict=True):
        assert one["kind"] == item.kind and one["subject"] == item.subject
        assert bool(one["why"]) == (one["verdict"] in (NOT_REPRODUCED, "unpublished")), f"{name}, {item.label}"
        if item.make is None:
            assert one["made"] is None
            continue
        made = one["made"]
        assert made["form"] in ("full", "reduced") and re.fullmatch(r"20\d\d-\d\d-\d\d", made["date"])
        assert re.fullmatch(r"[0-9a-f]{12}", made["commit"]) and made["machine"] and made["versions"]["torch"]
        for check in one["checks"]:
            assert set(check) == {"name", "published", "ours", "std", "tolerance", "verdict", "draws"}
            enough = not check["draws"] or check["draws"] >= FEWEST
            assert enough, f"{name}, {item.label}: {check['name']}"


def facts_of(one: dict) -> list[Fact]:
    """Facts of an entry of a record, in which limits that are infinite are None."""
    limits = {"least": -math.inf, "most": math.inf}
    return [
        Fact(**{key: limits[key] if key in limits and value is None else value for key, value in fact.items()})
        for fact in one["facts"]
    ]


@pytest.mark.parametrize("name", PAPERS)
def test_reasons_are_what_the_numbers_of_the_record_say(name: str) -> None:
    """Every reason has numbers, each of which could contradict it and does not."""
    record = json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))
    for one, item in zip(record["items"], paper(name).items, strict=True):
        facts = facts_of(one)
        if one["verdict"] != NOT_REPRODUCED:
            assert not facts and (one["verdict"] == "unpublished") == (item.kind == "unpublished")
            continue
        assert facts and one["why"] == item.reason(facts), f"{name}, {item.label}"
        for fact in facts:
            assert fact.holds and (math.isfinite(fact.least) or math.isfinite(fact.most)), (
                f"{name}, {item.label}: {fact.name}"
            )


@pytest.mark.parametrize("name", PAPERS)
def test_errors_of_the_papers_are_shown(name: str) -> None:
    record = json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))
    found = {one["item"]: one["verdict"] for one in record["items"] if one["item"].startswith("Erratum")}
    assert set(found.values()) <= {MISPRINT}
