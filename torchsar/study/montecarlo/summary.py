"""The summary of a sweep: all statistics that reports show, as arrays and as summary.json."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchsar.core import Outcome
from torchsar.metrics.intervals import LEVEL, RESAMPLES, finite_rms, share_interval, trial_statistics
from torchsar.study.montecarlo.record import Labels, Record

_DEFINITIONS = {
    "statistics": (
        "over all trials with a finite value, reliable (ok) or not, so that marking failures as unreliable improves no "
        "figure; n counts them"
    ),
    "rmse": "root mean square of the metric about zero, which is the RMSE of a metric that is an error",
    "interval": (
        f"{LEVEL:.0%} interval of the rmse; mean_interval of the mean: percentiles of a bootstrap of {RESAMPLES} "
        "resamples, the same resamples for every point"
    ),
    "median_interval": (
        "two order statistics that enclose the median of any distribution with a probability of at least "
        f"{LEVEL:.0%}; none for fewer than six trials"
    ),
    "ok_share": (
        "share of the trials done and assessed that the algorithm itself marks as reliable (trusted), with its exact "
        f"{LEVEL:.0%} interval (Clopper-Pearson)"
    ),
    "outcomes": "number of trials of each outcome; of several estimates of a trial the worst outcome counts",
}
_SUCCESS = (
    "share of the trials done that the algorithm marks as reliable (trusted), with the metric within success_limit of "
    f"zero; none where it never gives the metric; with its exact {LEVEL:.0%} interval (Clopper-Pearson)"
)
_BOUND = "root mean square over the trials done of the bound of each trial, for comparison with an rmse"


@dataclass(frozen=True)
class Summary:
    """Statistics of the metrics of a sweep, and their bounds.

    Args:
        algorithms: Names of the algorithms, along the first dim of the arrays in `figures`.
        labels: Values of each parameter by name, in the order of the dims.
        figures: Statistics by metric and name, arrays (algorithm, *parameters); confidence
            intervals have a last dim of 2 for their lower and upper end.
        bounds: Lower bounds by metric and name of the bound, each as the root mean square over
            trials, shape (*parameters).
        outcomes: Number of trials of each outcome that occurs, (algorithm, *parameters).
    """

    algorithms: tuple[str, ...]
    labels: Labels
    figures: Mapping[str, Mapping[str, np.ndarray]]
    bounds: Mapping[str, Mapping[str, np.ndarray]]
    outcomes: Mapping[Outcome, np.ndarray] = field(default_factory=dict)

    def points(self) -> Iterator[tuple[tuple[int, ...], dict[str, float | str]]]:
        """Yield index and labels of every point of the grid; the last parameter runs fastest."""
        for index in itertools.product(*(range(len(labels)) for labels in self.labels.values())):
            yield index, {name: labels[i] for (name, labels), i in zip(self.labels.items(), index)}

    def tree(self, about: Mapping[str, Any], definitions: Mapping[str, str]) -> dict[str, Any]:
        """Return the content of summary.json; unknown numbers are NaN, and null in the file.

        Args:
            about: Title and description of the sweep, as in `Record.about`.
            definitions: Definitions of terms, in addition to those of the statistics.
        """
        points: list[dict[str, Any]] = [
            {"algorithm": algorithm, "parameters": parameters, "metric": metric}
            | {name: array[(i, *index)].tolist() for name, array in fields.items()}
            | {"outcomes": {code.name: int(n[(i, *index)]) for code, n in self.outcomes.items() if n[(i, *index)]}}
            for i, algorithm in enumerate(self.algorithms)
            for index, parameters in self.points()
            for metric, fields in self.figures.items()
        ]
        bounds = [
            {"parameters": parameters, "metric": metric, "bound": name, "rms": float(rms[index])}
            for metric, named in self.bounds.items()
            for name, rms in named.items()
            for index, parameters in self.points()
        ]
        success = {"success_share": _SUCCESS} if any("success_share" in point for point in points) else {}
        return {
            "title": about["title"],
            "parameters": {name: list(labels) for name, labels in self.labels.items()},
            "algorithms": list(self.algorithms),
            "trials": max((point["trials"] for point in points), default=0),
            "points": points,
            "bounds": bounds,
            "definitions": {
                **_DEFINITIONS,
                **{f"outcome {code.name}": code.message for code in self.outcomes},
                **success,
                **({"bound": _BOUND} if bounds else {}),
                **definitions,
            },
            "about": dict(about),
        }


def summary_of(record: Record, success: Mapping[str, float]) -> Summary:
    """Return the statistics and bounds of the metrics of a sweep.

    Args:
        record: The results; `record.about` holds the seed, also for the bootstrap of intervals.
        success: For each metric, the largest magnitude that counts as a success.
    """
    done = record.done[None]
    assessed = done & (record.outcome != Outcome.NOT_ASSESSED)
    trials = {"trials": np.broadcast_to(done.sum(-1), record.ok.shape[:-1]), **_shares(record.ok, assessed, "ok")}
    figures = {
        name: {
            **{
                "interval" if kind == "rmse_interval" else kind: array
                for kind, array in trial_statistics(values, int(record.about["seed"])).items()
            },
            **trials,
            **_success(record, values, success.get(name)),
        }
        for name, values in record.metrics.items()
    }
    bounds = {
        metric: {name: finite_rms(np.where(record.done, values, np.nan)) for name, values in named.items()}
        for metric, named in record.bounds.items()
    }
    outcomes = {code: n for code in Outcome if (n := (record.outcome == code).sum(-1)).any()}
    return Summary(record.algorithms, record.labels, figures, bounds, outcomes)


def _shares(hits: np.ndarray, of: np.ndarray, name: str) -> dict[str, np.ndarray]:
    value, interval = share_interval(hits, of)
    return {f"{name}_share": value, f"{name}_interval": interval}


def _success(record: Record, values: np.ndarray, limit: float | None) -> dict[str, np.ndarray]:
    """Nothing without a limit; an algorithm without the metric neither succeeds nor fails."""
    if limit is None:
        return {}
    here = np.isfinite(values)
    within = record.ok & (np.abs(np.where(here, values, np.inf)) <= limit)
    gives = here.any(tuple(range(1, here.ndim)), keepdims=True)
    shares = _shares(within, record.done[None] & gives, "success")
    return {"success_limit": np.full(values.shape[:-1], float(limit)), **shares}
