"""Figures, tables and numbers in the text of papers, what is compared of each, and the verdict."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

REPRODUCED, BETTER, NOT_REPRODUCED, MISPRINT = "reproduced", "better", "not reproduced", "error of the paper"
KINDS = ("figure", "table", "text", "erratum", "diagram", "photograph", "unpublished")
# Kinds of figures that cannot be compared: they show nothing that can be computed, or a recording
# or a model that is not published.
SHOWN = ("diagram", "photograph", "unpublished")


def seeds_of(small: bool, draws: int = 5) -> range:
    """Return the seeds of the random draws behind a verdict.

    Args:
        small: Whether it is the reduced form, with one draw.
        draws: Number of draws of the full form.

    Returns:
        The seeds.
    """
    return range(1, 2 if small else 1 + draws)


@dataclass(frozen=True)
class Check:
    """One published number or statement beside that of this project.

    Args:
        name: What is compared, with its unit.
        published: The number that the paper prints, or what its text or picture states in words.
        ours: Our number, or the numbers behind our answer in words.
        std: Standard deviation of our number: 0 without random numbers, None after a single draw
            and of statements.
        tolerance: Largest difference that counts as reproduced (see `verdict`); None for
            statements.
        verdict: `REPRODUCED`, `BETTER`, `NOT_REPRODUCED` or `MISPRINT`.
        draws: Number of random draws behind our number; 0 without random numbers, None of
            statements.
    """

    name: str
    published: float | str
    ours: float | str
    std: float | None
    tolerance: float | None
    verdict: str
    draws: int | None = None


@dataclass(frozen=True)
class Fact:
    """One of the numbers on which the reason rests why an item is not reproduced.

    Args:
        name: Name by which the words of the reason refer to the number.
        value: The number.
        least: Least value with which the reason holds.
        most: Largest value with which it holds.
    """

    name: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def holds(self) -> bool:
        """True if the reason holds with this number."""
        return self.least <= self.value <= self.most


def verdict(published: float, ours: float, std: float, tolerance: float, better: str = "") -> str:
    """Compare our number with a published one.

    Args:
        published: Published number.
        ours: Our number; a number that is not finite is not a reproduction.
        std: Standard deviation of our number.
        tolerance: Largest difference that counts as reproduced. The standard deviation does not
            widen it, and must not exceed it, so that a poor estimate proves nothing.
        better: "lower" or "higher" where a number beyond the published one is an improvement.

    Returns:
        `REPRODUCED` within the tolerance, `BETTER` beyond it on the better side, and otherwise
        `NOT_REPRODUCED`.
    """
    gap = ours - published
    if abs(gap) <= tolerance and std <= tolerance:
        return REPRODUCED
    improved = (better == "lower" and gap < -tolerance) or (better == "higher" and gap > tolerance)
    return BETTER if improved and math.isfinite(gap) else NOT_REPRODUCED


def number(
    name: str, published: float, ours: float | Sequence[float], tolerance: float, better: str = "", std: float = 0.0
) -> Check:
    """Compare a number.

    Args:
        name: What is compared, with its unit.
        published: Published number.
        ours: Our number, or one number per random draw, whose mean is compared.
        tolerance: Largest difference that counts as reproduced (see `verdict`).
        better: "lower" or "higher" where a number beyond the published one is an improvement.
        std: Standard deviation of a single number; that of a mean follows from the draws.

    Returns:
        The comparison.
    """
    spread: float | None = std
    count = 1 if std else 0
    if isinstance(ours, Sequence):
        draws, count = torch.tensor([float(x) for x in ours], dtype=torch.float64), len(ours)
        ours, spread = float(draws.mean()), float(draws.std() / math.sqrt(count)) if count > 1 else None
    found = verdict(published, float(ours), spread or 0.0, tolerance, better)
    return Check(name, float(published), float(ours), spread, float(tolerance), found, count)


def parameters(rows: Mapping[str, tuple[float, float]], share: float) -> list[Check]:
    """Compare the parameters of a table.

    Args:
        rows: Published and our value by name, with its unit.
        share: Largest difference that counts as reproduced, as a share of the published value.

    Returns:
        The comparisons.
    """
    return [number(name, published, ours, share * abs(published)) for name, (published, ours) in rows.items()]


def statement(name: str, published: str, holds: bool, ours: str, draws: int | None = None) -> Check:
    """Compare what a paper states in words or shows in a picture without numbers.

    Args:
        name: What it is about.
        published: What the paper states, in our words.
        holds: Whether our result says the same.
        ours: The numbers that show it.
        draws: Number of random draws behind them.

    Returns:
        The comparison.
    """
    return Check(name, published, ours, None, None, REPRODUCED if holds else NOT_REPRODUCED, draws)


def misprint(name: str, published: str, shown: bool, ours: str) -> Check:
    """List what a paper has wrong, or what contradicts another number of the same paper.

    Args:
        name: What it is about.
        published: What the paper has.
        shown: Whether our numbers show that it is wrong.
        ours: These numbers.

    Returns:
        The comparison, `MISPRINT` if it is shown.
    """
    return Check(name, published, ours, None, None, MISPRINT if shown else NOT_REPRODUCED)


def falling(name: str, values: Mapping[str, float | Sequence[float]], rising: bool = False) -> Check:
    """Compare the order of methods, where the published numbers depend on what is not published.

    Args:
        name: What is compared, with its unit.
        values: Our number by method, or one number per random draw, whose mean is compared, in the
            order in which the published numbers fall.
        rising: Whether the published numbers rise instead.

    Returns:
        The comparison.
    """
    rows = {method: value if isinstance(value, Sequence) else [value] for method, value in values.items()}
    ours = [sum(row) / len(row) for row in rows.values()]
    holds = ours == sorted(ours, reverse=not rising)
    listed = "; ".join(f"{method} {value:.4g}" for method, value in zip(rows, ours, strict=True))
    draws = max((len(value) for value in values.values() if isinstance(value, Sequence)), default=None)
    return statement(name, f"{'rises' if rising else 'falls'} in the order: {'; '.join(values)}", holds, listed, draws)


Made = Sequence[Check | Fact]


@dataclass(frozen=True)
class Item:
    """A numbered figure or table of a paper, a number in its text, or something it has wrong.

    Args:
        label: Its number, such as "Figure 5"; "Text 1" and "Erratum 1" are numbers of our own.
        subject: What it shows, in our words.
        of: Experiment that it is made of, a function of whether the reduced form is wanted; items
            with the same one share its result.
        make: Function of the result of the experiment and the path of a picture, which draws the
            picture and returns what is compared, and the facts of `why`; None where nothing can be
            made.
        why: Reason of what is not reproduced, with the names of facts in braces.
        kind: One of `KINDS`; by default the word of the label.
    """

    label: str
    subject: str
    of: Callable[[bool], Any] | None = None
    make: Callable[[Any, Path], Made] | None = None
    why: str = ""
    kind: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", self.kind or self.label.split()[0].lower())

    @property
    def file(self) -> str:
        """Name of the file of the picture, such as figure_05.png."""
        word, number = self.label.split()
        return f"{word.lower()}_{int(number):02}.png"

    def reason(self, facts: Sequence[Fact]) -> str:
        """Say why the item is not reproduced.

        Args:
            facts: Numbers of the reason.

        Returns:
            The words with the numbers, or which of the facts does not hold.
        """
        failed = [fact for fact in facts if not fact.holds]
        if failed:
            numbers = ", ".join(f"{one.name} {one.value:.4g} in {one.least:g} to {one.most:g}" for one in failed)
            return f"the reason that the full form has does not hold here: it expects {numbers}"
        return self.why.format_map({fact.name: fact.value for fact in facts})


def given(label: str, subject: str, *found: Check | Fact) -> Item:
    """Make an item of comparisons that need no experiment.

    Args:
        label: Its number.
        subject: What it is about, in our words.
        *found: What is compared.

    Returns:
        The item.
    """
    return Item(label, subject, bool, lambda _small, _path: found)


@dataclass(frozen=True)
class Paper:
    """A paper with all its numbered figures and tables, and numbers of its text.

    Args:
        name: System that follows the paper.
        source: Where it appeared.
        items: What is compared, in the order of `in_order`.
    """

    name: str
    source: str
    items: tuple[Item, ...]

    def find(self, label: str) -> Item:
        """Return the item of a number.

        Args:
            label: Such as "Table 2", "table2", "fig. 5" or "text 1".

        Returns:
            The item.

        Raises:
            ValueError: If the paper has no such item.
        """
        words = {"fig": "Figure", "tab": "Table", "tex": "Text", "err": "Erratum"}
        found = re.fullmatch(r"\s*(fig|figure|tab|table|text|err|erratum)[\s._-]*0*(\d+)\s*", label, re.IGNORECASE)
        wanted = f"{words[found[1][:3].lower()]} {found[2]}" if found else ""
        item = next((one for one in self.items if one.label == wanted), None)
        if item is None:
            counts = {word: sum(one.label.startswith(word) for one in self.items) for word in words.values()}
            known = ", ".join(f"{word.lower()}1 to {word.lower()}{n}" for word, n in counts.items() if n)
            raise ValueError(f"the paper of {self.name} has no {label!r}; it has {known}")
        return item


def settled(item: Item, checks: Sequence[Check]) -> str:
    """Return the verdict on an item.

    Args:
        item: The item.
        checks: What was compared of it.

    Returns:
        The kind of what has nothing that can be compared; otherwise the first verdict of
        `NOT_REPRODUCED`, `MISPRINT`, `BETTER` and `REPRODUCED` that one of the comparisons has.
    """
    if item.kind in SHOWN:
        return item.kind
    verdicts = {check.verdict for check in checks} or {NOT_REPRODUCED}
    return next(one for one in (NOT_REPRODUCED, MISPRINT, BETTER, REPRODUCED) if one in verdicts)


def in_order(*items: Item) -> tuple[Item, ...]:
    """Sort items by their numbers: figures, tables, numbers of the text, errors of the paper.

    Args:
        items: The items, in any order.

    Returns:
        The same, sorted.
    """
    words = ("Figure", "Table", "Text", "Erratum")
    return tuple(sorted(items, key=lambda one: (words.index(one.label.split()[0]), int(one.label.split()[1]))))
