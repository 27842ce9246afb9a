"""Choices that a config makes, such as the form of the focusing, and their alternatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchsar.study.trials.direct_images import DirectlySummed


@dataclass(frozen=True)
class Alternative:
    """One alternative of a choice.

    Args:
        name: Name in tables.
        keys: Keys and values that select it in the mapping of the choice.
        loss: Predicted loss by metric; None if there is no prediction.
        neglects: Description of the effects that the alternative neglects.
        effect: Field `effect` of the `Requirement` about the same simplification; empty if there is
            none. The verdict of that requirement then follows from `loss`.
    """

    name: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, float] | None = None
    neglects: str = ""
    effect: str = ""


# lower levels are differences by rounding in double precision
EXACT_DB = -280.0


@dataclass(frozen=True)
class Measured:
    """Measurement of the time and the loss of alternatives.

    Args:
        run: Function of an alternative that computes its result, and whose time is measured.
        loss: Function of an alternative and its result that returns the loss by metric, relative to
            an exact result.
        share: Function of an alternative that returns which part of the whole work `run` does,
            between 0 and 1; measured times are divided by it.
    """

    run: Callable[[Alternative], Any]
    loss: Callable[[Alternative, Any], Mapping[str, float]]
    share: Callable[[Alternative], float] = lambda alternative: 1.0


@dataclass(frozen=True)
class Choice:
    """A choice that a config makes, with its alternatives from the cheapest to the exact one.

    Args:
        name: Name in tables.
        at: The key that may have the value `auto`: a dotted key of the world such as
            `world.fidelity`, `stage`, or `STAGE.key` for a key of all stages of that name.
        alternatives: The alternatives, the cheapest first and the most exact one last.
        measured: Function that prepares the measurement of the alternatives, which may take long;
            None if they cannot be measured.
        yardstick: Exact alternative to which losses are relative, if it is not the last one of
            `alternatives`; None otherwise.
    """

    name: str
    at: str
    alternatives: Sequence[Alternative]
    measured: Callable[[], Measured] | None = None
    yardstick: Alternative | None = None


def beside_direct_sum(prepared: Callable[[], DirectlySummed], neglects: str) -> Choice:
    """Return the comparison of the recommended image with the direct sum at random pixels.

    Args:
        prepared: Function that prepares the image.
        neglects: What the recommended image neglects.
    """

    def measured() -> Measured:
        of = prepared()
        return Measured(
            lambda one: of.exact() if one.keys else of.image(),
            lambda one, made: {"image_error_db": of.error_db(made if one.keys else of.at(made))},
            lambda one: of.share if one.keys else 1.0,
        )

    return Choice(
        "image beside the direct sum",
        "image",
        [
            Alternative("recommended image", {}, None, neglects),
            Alternative("direct sum, times extrapolated from random pixels", {"exact": True}),
        ],
        measured,
    )
