"""The summary of a sweep: every figure that is printed or drawn, as one tree (summary.json)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from torchsar.study.montecarlo.record import Record
from torchsar.study.montecarlo.statistics import LEVEL, RESAMPLES, share, statistics

Tree = dict[str, Any]

_DEFINITIONS = {
    "statistics": (
        "over all trials with a finite value, whether the algorithm trusts them (ok) or not, "
        "so that disowning failures makes nothing look better; n counts them"
    ),
    "rmse": "root mean square of the metric about zero, which is the RMSE of a metric that is an error",
    "interval": (
        f"{LEVEL:.0%} interval of the rmse; mean_interval of the mean: percentiles of a "
        f"bootstrap of {RESAMPLES} resamples, the same resamples for every point"
    ),
    "median_interval": (
        "two order statistics that enclose the median of any distribution with a probability "
        f"of at least {LEVEL:.0%}; none for fewer than six trials"
    ),
    "ok_share": (
        "share of the trials done that the algorithm itself trusts, with its exact "
        f"{LEVEL:.0%} interval (Clopper-Pearson)"
    ),
}
_SUCCESS = (
    "share of trials done that the algorithm trusts, with the metric within "
    "success_limit of zero, none where it never gives the metric, with its exact "
    f"{LEVEL:.0%} interval (Clopper-Pearson)"
)
_BOUND = "root mean square over the trials done of the bound of each trial, beside which an rmse stands"


def summary_tree(record: Record, success: Mapping[str, float], definitions: Mapping[str, str]) -> Tree:
    """The content of summary.json.

    success: metric -> largest magnitude that counts as success; definitions: added to those made
    here.

    Points are a flat list, one entry for each algorithm, place of the grid and metric.
    `record.about` holds "title" and "seed". What is unknown is NaN (null in the file). Raises
    ValueError where `success` names a metric that the record does not have.
    """
    missing = [name for name in success if name not in record.metrics]
    if missing:
        raise ValueError(
            f"success names the metric {missing[0]!r}, which was not measured; choose among "
            f"{', '.join(record.metrics) or 'none'}"
        )
    return {
        "title": record.about["title"],
        "parameters": {name: list(labels) for name, labels in record.labels.items()},
        "algorithms": list(record.algorithms),
        "trials": record.trials,
        "points": _points(record, success),
        "bounds": list(_bounds(record)),
        "definitions": _DEFINITIONS
        | ({"success_share": _SUCCESS} if success else {})
        | ({"bound": _BOUND} if record.bounds else {})
        | dict(definitions),
        "about": dict(record.about),
    }


def _points(record: Record, success: Mapping[str, float]) -> list[Tree]:
    """Entries in the order of algorithm, place and metric."""
    seed = int(record.about["seed"])
    ok = _shares(record.ok, record.done[None], "ok")
    fields = {
        name: _statistics(values, seed) | ok | _success(record, values, success.get(name))
        for name, values in record.metrics.items()
    }
    done = record.done.sum(-1)
    entries = []
    for i, algorithm in enumerate(record.algorithms):
        for index, parameters in _places(record):
            for metric, found in fields.items():
                figures = {name: array[(i, *index)].tolist() for name, array in found.items()}
                entries.append(
                    {
                        "algorithm": algorithm,
                        "parameters": parameters,
                        "metric": metric,
                        "trials": int(done[index]),
                        **figures,
                    }
                )
    return entries


def _places(record: Record) -> Iterator[tuple[tuple[int, ...], dict[str, float | str]]]:
    """Index and labels of every place of the grid, the last parameter running fastest."""
    for index in itertools.product(*(range(len(labels)) for labels in record.labels.values())):
        yield index, {name: labels[i] for (name, labels), i in zip(record.labels.items(), index, strict=True)}


def _statistics(values: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    found = statistics(values, seed)
    return {"interval" if name == "rmse_interval" else name: array for name, array in found.items()}


def _shares(hits: np.ndarray, of: np.ndarray, name: str) -> dict[str, np.ndarray]:
    value, interval = share(hits, of)
    return {f"{name}_share": value, f"{name}_interval": interval}


def _success(record: Record, values: np.ndarray, limit: float | None) -> dict[str, np.ndarray]:
    if limit is None:
        return {}
    here = np.isfinite(values)
    within = record.ok & (np.abs(np.where(here, values, np.inf)) <= limit)
    gives = here.any(
        tuple(range(1, here.ndim)), keepdims=True
    )  # an algorithm that never has the metric neither succeeds nor fails
    return {
        "success_limit": np.full(values.shape[:-1], float(limit)),
        **_shares(within, record.done[None] & gives, "success"),
    }


def _bounds(record: Record) -> Iterator[Tree]:
    """The bounds of each metric at every place of the grid."""
    for metric, bounds in record.bounds.items():
        for name, values in bounds.items():
            rms = _rms(np.where(record.done, values, np.nan))
            for index, parameters in _places(record):
                yield {"parameters": parameters, "metric": metric, "bound": name, "rms": float(rms[index])}


def _rms(values: np.ndarray) -> np.ndarray:
    """Over what is finite in the last dim; NaN where nothing is."""
    here = np.isfinite(values)
    power = np.square(np.where(here, values, 0.0)).sum(-1)
    return np.sqrt(power / np.where(here.any(-1), here.sum(-1), np.nan))
