"""Progress messages: one line that is rewritten on a terminal, or lines of the log."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

log = logging.getLogger("torchsar")
# seconds between messages: a log gets at least one message in 10 s
_PIPED_S, _TERMINAL_S = 8.0, 0.5


class Ticker:
    """Shows progress messages at regular intervals from a thread.

    Args:
        message: Function that returns the present message; an empty one is not shown.
    """

    def __init__(self, message: Callable[[], str]) -> None:
        self._message, self._ended = message, threading.Event()
        self._terminal = sys.stderr.isatty()
        self._thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Ticker:
        self._thread.start()
        return self

    def _tick(self) -> None:
        while not self._ended.wait(_TERMINAL_S if self._terminal else _PIPED_S):
            text = self._message()
            if text and self._terminal:
                sys.stderr.write(f"\r\x1b[K{text}")
                sys.stderr.flush()
            elif text:
                log.info("%s", text)

    def __exit__(self, *_: Any) -> None:
        self._ended.set()
        self._thread.join()
        if self._terminal:
            sys.stderr.write("\r\x1b[K")


class Steps:
    """Progress of a known sequence of steps; the remaining time follows from earlier steps.

    Args:
        names: Names of all steps in order. Several steps may have the same name.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._at, self._since = list(names), -1, time.perf_counter()
        self._began, self._spent = self._since, dict[str, float]()

    def begin(self, name: str) -> None:
        """Note that a step begins; earlier steps that did not begin were not needed."""
        now = time.perf_counter()
        if self._at >= 0:
            self._spent[self._names[self._at]] = now - self._since
        later = self._names.index(name, self._at + 1) if name in self._names[self._at + 1 :] else self._at
        self._at, self._since = max(later, 0), now
        log.debug("%s", name)

    @property
    def left_s(self) -> float | None:
        """Remaining time in s; None in the first step, and in one that is longer than expected."""
        coming = self._names[max(self._at, 0) :]
        if not self._spent or not coming:
            return None
        usual = sum(self._spent.values()) / len(self._spent)
        here, *later = (self._spent.get(name, usual) for name in coming)
        rest = here - (time.perf_counter() - self._since)
        return rest + sum(later) if rest >= 0 else None

    def say(self) -> str:
        """Return the present step, its time, and the remaining time."""
        if self._at < 0:
            return ""
        now, left = time.perf_counter(), self.left_s
        then = "" if left is None else f", about {clock(left)} left"
        step = f"step {self._at + 1} of {len(self._names)}: {self._names[self._at]}"
        return f"{step} for {clock(now - self._since)}, {clock(now - self._began)} in all{then}"


class Count:
    """Progress of many equal items such as trials; the remaining time follows from their rate.

    Args:
        unit: Name of the items.
        total: Number of all items.
        done: Number of items that were done earlier.
    """

    def __init__(self, unit: str, total: int, done: int = 0) -> None:
        self.unit, self.total, self.done, self._first = unit, total, done, done
        self._began = self._since = time.perf_counter()

    def advance(self, count: int) -> None:
        """Note that further items are done."""
        self.done, self._since = self.done + count, time.perf_counter()

    @property
    def new(self) -> int:
        """Number of items since the start of this count."""
        return self.done - self._first

    @property
    def seconds(self) -> float:
        """Time since the start of this count in s."""
        return time.perf_counter() - self._began

    def say(self) -> str:
        """Return the number of items that are done, and the remaining time."""
        then, spent = "the remaining time is known after the first batch", self._since - self._began
        if self.new:
            left = (self.total - self.done) * spent / self.new - (time.perf_counter() - self._since)
            then = f"{self.new / max(spent, 1e-9):.3g} {self.unit}/s"
            then += f", about {clock(left)} left" if left > 0 else ""
        return f"{self.done} of {self.total} {self.unit} after {clock(self.seconds)}, {then}"


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, with hours if there are any."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
