"""Where two records of one sweep differ, trial by trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchsar.study.montecarlo.record import OK, Record
from torchsar.study.settings.errors import ConfigError


@dataclass(frozen=True)
class Difference:
    """One trial of one algorithm that came out otherwise."""

    metric: str
    algorithm: str
    parameters: dict[str, float | str]
    trial: int
    values: tuple[float, float]


def differences(a: Record, b: Record, tolerance: float) -> list[Difference]:
    """Trials that both records hold and whose metrics differ by more than tolerance times the
    larger magnitude, or whose `ok` differs.

    Two runs in batches of other sizes or with other threads differ by rounding alone, but for
    trials in which a choice (a peak, a candidate, an end of iterations) hung on less than that;
    those are what this finds. Errors are compared on the scale of the largest error of their metric
    and point: each is a small difference of two large numbers. Raises ConfigError where the records
    are not of one grid.
    """
    if a.labels != b.labels or a.algorithms != b.algorithms:
        raise ConfigError(
            f"records of different sweeps cannot be compared: {a.algorithms} over {a.labels} and "
            f"{b.algorithms} over {b.labels}"
        )
    trials = min(a.trials, b.trials)
    both = a.done[..., :trials] & b.done[..., :trials]
    found = [
        d
        for name in a.metrics
        if name in b.metrics
        for d in _of(name, a.metrics[name][..., :trials], b.metrics[name][..., :trials], both, a, tolerance)
    ]
    return found + _of(OK, a.ok[..., :trials].astype(float), b.ok[..., :trials].astype(float), both, a, 0.0)


def _of(
    name: str, x: np.ndarray, y: np.ndarray, both: np.ndarray, record: Record, tolerance: float
) -> list[Difference]:
    magnitude = np.fmax(np.abs(x), np.abs(y))
    scale = np.fmax.reduce(magnitude, axis=-1, keepdims=True, initial=0.0) if "error" in name else magnitude
    apart = both & ~((np.abs(x - y) <= tolerance * scale) | (np.isnan(x) & np.isnan(y)) | (x == y))
    return [_named(name, tuple(index), x, y, record) for index in np.argwhere(apart).tolist()]


def _named(name: str, index: tuple[int, ...], x: np.ndarray, y: np.ndarray, record: Record) -> Difference:
    parameters = {p: labels[i] for (p, labels), i in zip(record.labels.items(), index[1:-1])}
    return Difference(name, record.algorithms[index[0]], parameters, index[-1], (float(x[index]), float(y[index])))
