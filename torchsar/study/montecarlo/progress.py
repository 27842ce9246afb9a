"""How far a sweep is: a bar on a terminal, lines in the log elsewhere."""

from __future__ import annotations

import logging
import sys
import time

from tqdm import tqdm

log = logging.getLogger("torchsar")
_QUIET_S = 1.0


class Progress:
    """Counts trials.

    Without a terminal each chunk is a line of the log, but not more than one line a second; DEBUG
    shows all of them.
    """

    def __init__(self, title: str, total: int, done: int) -> None:
        self.total, self.done, self.began_with, self.began, self._said = total, done, done, time.perf_counter(), 0.0
        self.chunks = 0
        self._bar = (
            tqdm(total=total, initial=done, unit="trial", desc=title, leave=False) if sys.stderr.isatty() else None
        )

    def expect(self, total: int) -> None:
        """The number of trials turned out to be another."""
        self.total = total
        if self._bar is not None:
            self._bar.total = total

    def advance(self, trials: int, seconds: float) -> None:
        """A chunk is recorded."""
        self.done, self.chunks = self.done + trials, self.chunks + 1
        if self._bar is not None:
            self._bar.update(trials)
            return
        now = time.perf_counter()
        quiet = now - self._said < _QUIET_S and self.done < self.total
        level = logging.DEBUG if quiet else logging.INFO
        if not log.isEnabledFor(level):
            return
        log.log(
            level,
            "chunk %d, %d trials in %.2f s: %d of %d, %.3g trials/s, %s left",
            self.chunks,
            trials,
            seconds,
            self.done,
            self.total,
            self.rate,
            _clock(self.left_s),
        )
        self._said = self._said if quiet else now

    @property
    def rate(self) -> float:
        """Trials a second in this session."""
        return (self.done - self.began_with) / max(time.perf_counter() - self.began, 1e-9)

    @property
    def left_s(self) -> float:
        return (self.total - self.done) / max(self.rate, 1e-9)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
