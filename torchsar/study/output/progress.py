"""How far long work is: a line that is rewritten on a terminal, lines of the log elsewhere."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

log = logging.getLogger("torchsar")
# a reader of a log must never wait longer than 10 s for a sign of life
_PIPED_S, _TERMINAL_S = 8.0, 0.5


class Ticker:
    """Says at regular intervals, from a thread of its own, how far the work is.

    Args:
        say: Gives the sentence of the moment; an empty one is not shown.
    """

    def __init__(self, say: Callable[[], str]) -> None:
        self._say, self._ended = say, threading.Event()
        self._terminal = sys.stderr.isatty()
        self._thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Ticker:
        self._thread.start()
        return self

    def _tick(self) -> None:
        while not self._ended.wait(_TERMINAL_S if self._terminal else _PIPED_S):
            text = self._say()
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
    """Steps of known names that are taken in order; tells the time left from those taken before.

    Args:
        names: Name of every step that is to come. A name may come several times.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._at, self._since = list(names), -1, time.perf_counter()
        self._began, self._spent = self._since, dict[str, float]()

    def begin(self, name: str) -> None:
        """A step begins, and the one before it is over; steps in between were not needed."""
        now = time.perf_counter()
        if self._at >= 0:
            self._spent[self._names[self._at]] = now - self._since
        later = self._names.index(name, self._at + 1) if name in self._names[self._at + 1 :] else self._at
        self._at, self._since = max(later, 0), now
        log.debug("%s", name)

    @property
    def left_s(self) -> float | None:
        """Seconds to come, None while nothing is known."""
        coming = self._names[max(self._at, 0) :]
        if not self._spent or not coming:
            return None
        usual = sum(self._spent.values()) / len(self._spent)
        whole = sum(self._spent.get(name, usual) for name in coming)
        return max(0.0, whole - (time.perf_counter() - self._since))

    def say(self) -> str:
        """What is being done, for how long, and the time left."""
        if self._at < 0:
            return ""
        now, left = time.perf_counter(), self.left_s
        then = "" if left is None else f", about {clock(left)} left"
        step = f"step {self._at + 1} of {len(self._names)}: {self._names[self._at]}"
        return f"{step} for {clock(now - self._since)}, {clock(now - self._began)} in all{then}"


class Count:
    """Counts what is done of many equal things, such as trials; tells the time left from the pace.

    Args:
        unit: What is counted.
        total: How many there are.
        done: How many of them were done before.
    """

    def __init__(self, unit: str, total: int, done: int = 0) -> None:
        self.unit, self.total, self.done, self._first = unit, total, done, done
        self._began = self._since = time.perf_counter()

    def advance(self, count: int) -> None:
        """So many more are done."""
        self.done, self._since = self.done + count, time.perf_counter()

    @property
    def new(self) -> int:
        """How many were done since the beginning of this count."""
        return self.done - self._first

    @property
    def seconds(self) -> float:
        """Since the beginning of this count."""
        return time.perf_counter() - self._began

    def say(self) -> str:
        """How many are done, and the time left."""
        then, spent = "the time left is known after the first batch", self._since - self._began
        if self.new:
            left = (self.total - self.done) * spent / self.new - (time.perf_counter() - self._since)
            then = f"{self.new / max(spent, 1e-9):.3g} {self.unit}/s, about {clock(max(left, 0.0))} left"
        return f"{self.done} of {self.total} {self.unit} after {clock(self.seconds)}, {then}"


def clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are any."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
