"""When a point has seen enough trials: looked at after 50, 100, 200, 400, ...

of them in the order of their numbers, and never in between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchsar.study.montecarlo.record import Record
from torchsar.study.montecarlo.statistics import half_width_ratio
from torchsar.study.settings.errors import ConfigError

FIRST_LOOK = 50


@dataclass(frozen=True)
class Stop:
    """A point ends when half of the 95 % interval of a statistic is below `relative` times the
    statistic, for every algorithm that has the metric.

    An rmse that rare outliers make up is settled before they come: with one error in a hundred 100
    times as large and relative = 0.19, four points of ten end at 50 trials and never saw one. Below
    a threshold SNR take the median, or a smaller relative (0.1 sees 100 trials or more).
    """

    metric: str
    relative: float
    statistic: Literal["rmse", "mean", "median"] = "rmse"

    def __post_init__(self) -> None:
        if self.statistic not in ("rmse", "mean", "median"):
            raise ConfigError(f"stop.statistic must be rmse, mean or median, got {self.statistic!r}")
        if not isinstance(self.relative, (int, float)) or not 0 < self.relative < 1:
            raise ConfigError(f"stop.relative must lie between 0 and 1, got {self.relative!r}")

    def reached(self, record: Record, place: tuple[int, ...], trials: int, seed: int) -> bool:
        """Whether the first `trials` trials of a point say enough."""
        values = record.metrics[self.metric][(slice(None), *place, slice(0, trials))]
        values = values[np.isfinite(values).any(-1)]
        return bool(len(values)) and bool((half_width_ratio(values, self.statistic, seed) < self.relative).all())


def looks(trials: int, stop: Stop | None) -> list[int]:
    """Numbers of trials after which points are looked at; the last is the limit."""
    levels, level = [], FIRST_LOOK
    while stop is not None and level < trials:
        levels.append(level)
        level *= 2
    return [*levels, trials]
