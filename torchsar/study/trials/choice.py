"""What a config may leave open: decisions, their alternatives and how these are compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Alternative:
    """One way to do what a choice is about.

    Args:
        name: For tables.
        keys: What stands in the config for it, in the mapping that the choice is made in.
        loss: Predicted loss by metric; None where nothing is predicted.
        neglects: What it leaves out.
    """

    name: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, float] | None = None
    neglects: str = ""


# levels below this are differences of rounding at most
EXACT_DB = -280.0


@dataclass(frozen=True)
class Measured:
    """How the alternatives of a choice are compared.

    Args:
        run: Does the work of one alternative, which is timed; the yardstick is run as well.
        loss: Loss by metric of a result of `run`, against the yardstick.
        share: Share of the whole work that `run` does of an alternative, which divides its times.
    """

    run: Callable[[Alternative], Any]
    loss: Callable[[Alternative, Any], Mapping[str, float]]
    share: Callable[[Alternative], float] = lambda alternative: 1.0


@dataclass(frozen=True)
class Choice:
    """A decision that a config takes, with its alternatives from the cheapest to the best one.

    Args:
        name: For tables.
        at: Where `auto` may be written: a dotted key of the world such as `world.fidelity`, or
            `stage`, or `STAGE.key` for a key of stages of that name.
        alternatives: The cheapest first, the best one last.
        measured: Prepares their comparison, which may take long.
        yardstick: What they are compared with, where that is none of them.
    """

    name: str
    at: str
    alternatives: Sequence[Alternative]
    measured: Callable[[], Measured] | None = None
    yardstick: Alternative | None = None
