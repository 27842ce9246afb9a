"""Numbered figures and tables of papers, what is compared of each, and the verdict."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

REPRODUCED, BETTER, NOT_REPRODUCED = "reproduced", "better", "not reproduced"
KINDS = ("figure", "table", "diagram", "photograph")
# kinds that show nothing that can be computed
SHOWN = ("diagram", "photograph")


@dataclass(frozen=True)
class Check:
    """One published number or statement beside ours.

    Args:
        name: What is compared, with its unit.
        published: The number that the paper prints, or what its text or picture states in words.
        ours: Our number, or the numbers behind our answer in words.
        std: Standard deviation of our number: 0 without random numbers, None after a single draw
            and of statements.
        tolerance: Largest difference that counts as reproduced (see `verdict`); None for
            statements.
        verdict: `REPRODUCED`, `BETTER` or `NOT_REPRODUCED`.
    """

    name: str
    published: float | str
    ours: float | str
    std: float | None
    tolerance: float | None
    verdict: str


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
    improved = (better == "lower" and gap < 0) or (better == "higher" and gap > 0)
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
    if isinstance(ours, Sequence):
        draws = torch.tensor([float(x) for x in ours], dtype=torch.float64)
        ours, spread = float(draws.mean()), float(draws.std() / math.sqrt(len(draws))) if len(draws) > 1 else None
    found = verdict(published, float(ours), spread or 0.0, tolerance, better)
    return Check(name, float(published), float(ours), spread, float(tolerance), found)


def parameters(rows: Mapping[str, tuple[float, float]], share: float) -> list[Check]:
    """Compare the parameters of a table.

    Args:
        rows: Published and our value by name, with its unit.
        share: Largest difference that counts as reproduced, as a share of the published value.

    Returns:
        The comparisons.
    """
    return [number(name, published, ours, share * abs(published)) for name, (published, ours) in rows.items()]


def statement(name: str, published: str, holds: bool, ours: str) -> Check:
    """Compare what a paper states in words or shows in a picture without numbers.

    Args:
        name: What it is about.
        published: What the paper states, in our words.
        holds: Whether our result says the same.
        ours: The numbers that show it.

    Returns:
        The comparison.
    """
    return Check(name, published, ours, None, None, REPRODUCED if holds else NOT_REPRODUCED)


def falling(name: str, values: dict[str, float], rising: bool = False) -> Check:
    """Compare the order of methods, where the published numbers depend on what is not published.

    Args:
        name: What is compared, with its unit.
        values: Our number by method, in the order in which the published numbers fall.
        rising: Whether the published numbers rise instead.

    Returns:
        The comparison.
    """
    ours = list(values.values())
    holds = ours == sorted(ours, reverse=not rising)
    listed = "; ".join(f"{method} {value:.4g}" for method, value in values.items())
    return statement(name, f"{'rises' if rising else 'falls'} in the order: {'; '.join(values)}", holds, listed)


@dataclass(frozen=True)
class Item:
    """A numbered figure or table of a paper.

    Args:
        label: Its number, such as "Figure 5".
        subject: What it shows, in our words.
        kind: One of `KINDS`.
        of: Experiment that it is made of, a function of whether the reduced form is wanted; items
            with the same one share its result.
        make: Function of the result of the experiment and the path of a picture, which draws the
            picture and returns what is compared; None where nothing can be made.
        why: Reason of what is not reproduced.
    """

    label: str
    subject: str
    kind: str = "figure"
    of: Callable[[bool], Any] | None = None
    make: Callable[[Any, Path], Sequence[Check]] | None = None
    why: str = ""

    @property
    def file(self) -> str:
        """Name of its picture, such as figure_05.png."""
        word, number = self.label.split()
        return f"{word.lower()}_{int(number):02}.png"


@dataclass(frozen=True)
class Paper:
    """A paper and all its numbered figures and tables.

    Args:
        name: System that follows the paper.
        source: Where it appeared.
        items: Figures and tables, in the order of their numbers.
    """

    name: str
    source: str
    items: tuple[Item, ...]

    def find(self, label: str) -> Item:
        """Return the item of a number.

        Args:
            label: Such as "Table 2", "table2" or "fig. 5".

        Returns:
            The item.

        Raises:
            ValueError: If the paper has no such item.
        """
        found = re.fullmatch(r"\s*(fig|figure|tab|table)[\s._-]*0*(\d+)\s*", label, re.IGNORECASE)
        wanted = f"{'Figure' if found[1].lower().startswith('fig') else 'Table'} {found[2]}" if found else ""
        item = next((one for one in self.items if one.label == wanted), None)
        if item is None:
            counts = {word: sum(one.label.startswith(word) for one in self.items) for word in ("Figure", "Table")}
            known = " and ".join(f"{word.lower()}1 to {word.lower()}{n}" for word, n in counts.items() if n)
            raise ValueError(f"the paper of {self.name} has no {label!r}; it has {known}")
        return item


def settled(item: Item, checks: Sequence[Check]) -> str:
    """Return the verdict on an item.

    Args:
        item: The item.
        checks: What was compared of it.

    Returns:
        The kind of what shows nothing that can be computed; otherwise the worst verdict of the
        comparisons, where `BETTER` counts if nothing is `NOT_REPRODUCED`.
    """
    if item.kind in SHOWN:
        return item.kind
    verdicts = {check.verdict for check in checks}
    if not checks or NOT_REPRODUCED in verdicts:
        return NOT_REPRODUCED
    return BETTER if BETTER in verdicts else REPRODUCED


def in_order(*items: Item) -> tuple[Item, ...]:
    """Sort figures and tables by their numbers, the figures first.

    Args:
        items: The items, in any order.

    Returns:
        The same, sorted.
    """
    return tuple(sorted(items, key=lambda one: (one.label.split()[0], int(one.label.split()[1]))))
