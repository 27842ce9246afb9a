"""Statistics of a sweep and their definitions, as reports and summary.json show them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchsar.core import Outcome
from torchsar.metrics.intervals import LEVEL, RESAMPLES

Labels = dict[str, tuple[float | str, ...]]

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
