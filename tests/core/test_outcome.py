"""Outcomes of estimates: codes, sentences, the worst of several reasons, counts, and defaults."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import torchsar
from torchsar.core import Estimate, Outcome, counts, worst

CODES = torch.tensor([Outcome.OK, Outcome.NOT_ASSESSED, Outcome.MISFIT, Outcome.NOISE])


@pytest.mark.parametrize("outcome", Outcome)
def test_every_outcome_is_of_one_kind_and_has_one_sentence(outcome: Outcome) -> None:
    assert outcome.is_ok + outcome.is_doubtful + outcome.is_failed == 1
    assert outcome.message and len(outcome.message) < 120 and "\n" not in outcome.message
    assert outcome.message[0].islower() and outcome.message[-1] != ".", "it follows a count in reports"
    assert outcome.label == outcome.name.lower().replace("_", " ")
    assert [one.message for one in Outcome].count(outcome.message) == 1


def test_the_kinds_follow_from_the_codes() -> None:
    assert torchsar.Outcome is Outcome and [one for one in Outcome if one.is_ok] == [Outcome.OK, Outcome.NOT_ASSESSED]
    assert all(one.is_failed == (one >= 30) and one.is_doubtful == (10 <= one < 30) for one in Outcome)


def test_the_greatest_code_of_the_reasons_that_apply_counts() -> None:
    yes, no = torch.tensor([True, True, False]), torch.tensor([True, False, False])
    assert worst((Outcome.MISFIT, yes), (Outcome.NOISE, no)).tolist() == [30, 15, 0]
    assert worst((Outcome.NOISE, no), (Outcome.MISFIT, yes)).tolist() == [30, 15, 0], "whatever their order"
    assert worst((Outcome.MISFIT, yes[:, None]), (Outcome.NOISE, no)).shape == (3, 3)
    assert Outcome.of(yes, Outcome.TOO_FEW).tolist() == [0, 0, 19]
    assert Outcome.EMPTY.like(yes).tolist() == [32] * 3 and Outcome.EMPTY.like(yes).dtype == torch.int64


def test_counts_are_in_the_order_of_the_codes() -> None:
    found = counts(torch.tensor([[30, 0], [12, 0]]))
    assert list(found.items()) == [(Outcome.OK, 2), (Outcome.HOMOGENEOUS, 1), (Outcome.NOISE, 1)]
    assert counts(torch.zeros(0, dtype=torch.int64)) == {}


def test_ok_doubtful_and_failed_follow_from_the_outcome() -> None:
    found = Estimate({"a_m": torch.arange(4.0) + 1}, outcome=CODES, neutral={"a_m": 0.0})
    assert found.ok.tolist() == [True, True, False, False]
    assert found.doubtful.tolist() == [False, False, True, False]
    assert found.failed.tolist() == [False, False, False, True]
    assert found.quality.tolist() == [1, 1, 0, 0], "by default what ok says"
    assert found.trusted("a_m").tolist() == [1, 2, 3, 0] and found.trusted("a_m", "neutral").tolist() == [1, 2, 0, 0]
    assert found.reasons == {Outcome.NOT_ASSESSED: 1, Outcome.MISFIT: 1, Outcome.NOISE: 1}


def test_an_estimate_without_an_outcome_is_not_assessed() -> None:
    found = Estimate({"a_m": torch.zeros(2, 3)})
    assert found.outcome.tolist() == [[1] * 3] * 2 and found.ok.all() and found.quality.shape == (2, 3)
    phases = Estimate({"phase_rad": torch.zeros(2, 3)}, quality=torch.ones(2))
    assert phases.outcome.tolist() == [1, 1]


@pytest.mark.parametrize("outcome", [torch.tensor([True]), torch.tensor([0.0]), torch.zeros(2, dtype=torch.int64)])
def test_an_outcome_of_another_kind_is_refused(outcome: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="integers `outcome`"):
        Estimate({"a_m": torch.zeros(1)}, quality=torch.zeros(1), outcome=outcome)


def test_the_page_of_outcomes_lists_every_code_with_its_sentence() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "how_to" / "ok.md").read_text(encoding="utf-8")
    rows = [row.split(" | ") for row in re.findall(r"^\| (\d+ \| `.*) \|$", page, re.MULTILINE)]
    kinds = ["ok" if one.is_ok else "doubtful" if one.is_doubtful else "failed" for one in Outcome]
    assert rows == [
        [str(int(one)), f"`{one.name}`", kind, one.message] for one, kind in zip(Outcome, kinds, strict=True)
    ]
