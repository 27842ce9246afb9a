"""Progress of long work on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

# seconds between two bars in a file, so that it has at least one in 10 s
_EVERY_S = 8.0


def progress(total: int, unit: str, done: int = 0) -> Any:
    """Return a bar of the progress of equal parts of work, with their rate and the remaining time.

    It is a context manager with the methods `update(count)`, for parts that are done, and
    `set_description_str(text)`. A terminal shows it after half a second, and a file gets one every
    8 seconds, so that short work shows none.

    Args:
        total: Number of all parts.
        unit: Name of the parts.
        done: Number of parts that were done earlier.
    """
    every = 0.5 if sys.stderr.isatty() else _EVERY_S
    return tqdm(total=total, initial=done, unit=f" {unit}", mininterval=every, miniters=1, delay=every, leave=False)


def told(unit: str) -> Callable[[str, int], object]:
    """Return a function that is told the name of each part of work before it, and their number."""
    bars: list[Any] = []

    def say(name: str, total: int) -> None:
        if bars:
            bars[0].update(1)
        else:
            bars.append(progress(total, unit))
        bars[0].set_description_str(name)

    return say


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, with hours if there are any."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
