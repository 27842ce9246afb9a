"""Results of a sweep in memory, as labelled arrays with trials last. Their comparison, and their
statistics, which reports show and summary.json contains.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchsar.core import Outcome, show
from torchsar.io.extras import library
from torchsar.io.seal import checksum
from torchsar.metrics.intervals import finite_rms, share_interval, trial_statistics
from torchsar.study.montecarlo.grid import RESERVED, check_name
from torchsar.study.montecarlo.summary import Labels, Summary
from torchsar.study.settings.errors import ConfigError

OK, OUTCOME = "ok", "outcome"


@dataclass(repr=False)
class Record(show.Shown):
    """Results of a sweep.

    A trial that has not run is NaN in every metric, False in `done` and `ok`, and 255 in `outcome`.

    Args:
        algorithms: Names of the algorithms, along the first dim of `outcome` and of the metrics.
        labels: Values of each parameter by name, numbers or words, in the order of the dims.
        done: Which trials have run, bool (*parameters, trial); points that ended early have fewer
            than others.
        outcome: Code of a `torchsar.Outcome` of each trial, the worst one where there are several
            estimates, uint8 (algorithm, *parameters, trial).
        metrics: Metrics by name, float64 (algorithm, *parameters, trial).
        bounds: Lower bounds by metric and name of the bound, float64 (*parameters, trial).
        about: Title, resolved config, hash, seed, versions, device and timings of the run.
    """

    algorithms: tuple[str, ...]
    labels: Labels
    done: np.ndarray
    outcome: np.ndarray
    metrics: dict[str, np.ndarray] = field(default_factory=dict)
    bounds: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> np.ndarray:
        """True where a trial is ok or was not assessed, bool (algorithm, *parameters, trial)."""
        return self.outcome < Outcome.INEXACT

    @property
    def trials(self) -> int:
        """Length of the trial dimension."""
        return self.done.shape[-1]

    @property
    def dims(self) -> tuple[str, ...]:
        return ("algorithm", *self.labels, "trial")

    def blank(self, by_algorithm: bool = True) -> np.ndarray:
        """Return an array of NaN with the shape of a metric, (algorithm, *parameters, trial), or of
        a bound, (*parameters, trial).
        """
        return blank(self.outcome.shape if by_algorithm else self.done.shape, float)

    def index_of(self, labels: Mapping[str, float | str]) -> tuple[int, ...]:
        """Index of a point with given labels of the parameters."""
        return tuple(known.index(labels[name]) for name, known in self.labels.items())

    def labels_at(self, point: tuple[int, ...]) -> dict[str, float | str]:
        """Labels of a point, by parameter."""
        return {name: known[i] for (name, known), i in zip(self.labels.items(), point)}

    def checksum(self, point: tuple[int, ...]) -> str:
        """Checksum of all numbers of the computed trials of a point."""
        rows = {name: x[(..., *point, self.done[point])] for name, (x, _, _) in self.variables().items()}
        # metrics that the trials of a point do not have are left out, because they may be added
        # later
        return checksum({name: x for name, x in rows.items() if x.dtype != float or not np.isnan(x).all()})

    def add(
        self,
        points: Sequence[tuple[int, ...]],
        trials: Sequence[int],
        values: Mapping[str, Mapping[str, Sequence[float]]],
        bounds: Mapping[str, Mapping[str, Sequence[float]]],
    ) -> None:
        """Enter the results of some trials, one per row, and mark these trials as done.

        Args:
            points: Index of the grid point of each row.
            trials: Trial number of each row.
            values: Metrics by algorithm and name, (rows,) each. `outcome` holds codes; without it,
                `ok` says which trials are reliable, and without both none was assessed.
            bounds: Lower bounds by metric and name of the bound, (rows,) each.

        Raises:
            ConfigError: If the algorithms differ from those of earlier trials, or the name of a
                metric or bound cannot be used.
        """
        if not self.algorithms:
            self.algorithms, self.outcome = tuple(values), blank((len(values), *self.done.shape), np.uint8)
        if set(values) != set(self.algorithms):
            new = next((repr(a) for a in values if a not in self.algorithms), None)
            gave = f"{', '.join(values)} alone" if new is None else f"the algorithm {new}"
            raise ConfigError(
                f"a trial returned results of {gave}, but earlier trials of {', '.join(self.algorithms)}; return the "
                "same algorithms in every trial"
            )
        indices = zip(*((*point, trial) for point, trial in zip(points, trials)))
        rows = np.ravel_multi_index(tuple(indices), self.done.shape)
        for number, algorithm in enumerate(self.algorithms):
            given = values[algorithm]
            verdicts = np.where(given[OK], Outcome.OK, Outcome.UNSPECIFIED) if OK in given else Outcome.NOT_ASSESSED
            self.outcome[number].reshape(-1)[rows] = given.get(OUTCOME, verdicts)
            for metric, found in given.items():
                if metric not in (OK, OUTCOME):
                    self._array(self.metrics, metric, metric)[number].reshape(-1)[rows] = found
        for metric, named in bounds.items():
            known = self.bounds.setdefault(metric, {})
            for name, found in named.items():
                self._array(known, name, bound_name(metric, name)).reshape(-1)[rows] = found
        self.done.reshape(-1)[rows] = True

    def _array(self, known: dict[str, np.ndarray], name: str, stored: str) -> np.ndarray:
        """Return a known array, or a new one. The name of a new one in the store must differ from
        those of all others.
        """
        if name not in known:
            kind = "metric" if known is self.metrics else "bound"
            check_name(stored, (*RESERVED, *self.labels, *self.variables()), "the trial function", kind)
            known[name] = self.blank(kind == "metric")
        return known[name]

    def variables(self) -> dict[str, tuple[np.ndarray, tuple[str, ...], dict[str, str]]]:
        """Return every array of results by its name in the store, as (data, dims, attributes)."""
        found = {OUTCOME: (self.outcome, self.dims, {"kind": OUTCOME})}
        found |= {name: (x, self.dims, {"kind": "metric"}) for name, x in self.metrics.items()}
        for metric, named in self.bounds.items():
            for name, x in named.items():
                about = {"kind": "bound", "bound_of": metric, "bound": name}
                found[bound_name(metric, name)] = (x, self.dims[1:], about)
        return found

    def grown(self, labels: Labels, trials: int) -> Record:
        """Return the results in larger arrays, for more parameter values or more trials.

        For each parameter, the given labels must begin with those of this record.
        """
        return self._mapped(lambda x: _enlarged(x, (*map(len, labels.values()), trials)), labels)

    def select(self, labels: Labels) -> Record:
        """Return the results of the given parameter values, in the order given."""
        index = [[self.labels[name].index(label) for label in wanted] for name, wanted in labels.items()]
        every = range(self.trials)
        return self._mapped(lambda x: x[np.ix_(*map(range, x.shape[: x.ndim - self.done.ndim]), *index, every)], labels)

    def _mapped(self, change: Any, labels: Labels) -> Record:
        bounds = {metric: {name: change(x) for name, x in named.items()} for metric, named in self.bounds.items()}
        return replace(
            self,
            labels=labels,
            done=change(self.done),
            outcome=change(self.outcome),
            metrics={name: change(x) for name, x in self.metrics.items()},
            bounds=bounds,
        )

    def to_xarray(self) -> Any:
        """Return the results as an xarray.Dataset with the dims (algorithm, *parameters, trial).

        The array of a bound has the attributes `bound_of`, its metric, and `bound`, its name.

        Raises:
            ModuleNotFoundError: If the extra `xarray` is not installed.
        """
        xarray = library("xarray", "xarray", "to_xarray")
        coordinates = {"algorithm": self.algorithms, **self.labels, "trial": range(self.trials)}
        arrays = {name: (dims, x, about) for name, (x, dims, about) in self.variables().items()}
        return xarray.Dataset(
            {"done": (self.dims[1:], self.done), OK: (self.dims, self.ok, {"kind": OK}), **arrays},
            {name: list(values) for name, values in coordinates.items()},
        )

    def plot(self, metric: str, over: str = "") -> Any:
        """Draw a metric over the parameters, with its intervals and bounds, as reports do.

        Args:
            metric: Name of the metric. Of an error its RMSE is drawn, otherwise its median.
            over: Name of the parameter on the horizontal axis; by default the first one with
                several numbers.

        Returns:
            Figures over this parameter, one for each value of the other parameters; a notebook
            shows them, and `torchsar.plot.save` writes them.

        Raises:
            KeyError: If the record has no such metric or parameter, or no finite number of the
                metric.
        """
        from torchsar.study.montecarlo.report import SweepPictures, main_quantity

        finite = [name for name, values in self.metrics.items() if np.isfinite(values).any()]
        if metric not in finite:
            raise KeyError(f"the metrics with finite numbers of this record are {finite}, got {metric!r}")
        if over and over not in self.labels:
            raise KeyError(f"the parameters of this record are {list(self.labels)}, got {over!r}")
        pictures = SweepPictures(summary_of(self, {}))
        return next(pictures.curves(main_quantity(metric, bool(self.bounds.get(metric))), over))[-1]

    def table(self) -> list[dict[str, Any]]:
        """Return the statistics of each metric, algorithm and point: rows of values by column.

        `rmse_low` and `rmse_high` are the ends of the 95 % interval of the RMSE. Columns such as
        `bound_cramer_rao` hold the rms of each bound of the record, NaN for metrics without it, and
        such as `outcome_ok` count the trials of each outcome that the record has.
        """
        tree = summary_of(self, {}).tree({"title": "", **self.about}, {})
        points, bounds = tree["points"], {}
        for b in tree["bounds"]:
            column = bound_name(b["metric"], b["bound"]).removeprefix(f"{b['metric']}_")
            bounds.setdefault(column, {})[(b["metric"], *b["parameters"].values())] = b["rms"]
        columns = ("n", "trials", "rmse", "median", "mean", "std", "ok_share")
        codes = sorted({name for p in points for name in p["outcomes"]}, key=lambda name: Outcome[name])
        return [
            {"metric": p["metric"], "algorithm": p["algorithm"], **p["parameters"], **{c: p[c] for c in columns}}
            | dict(zip(("rmse_low", "rmse_high"), p["interval"]))
            | {c: found.get((p["metric"], *p["parameters"].values()), np.nan) for c, found in bounds.items()}
            | {f"outcome_{name.lower()}": p["outcomes"].get(name, 0) for name in codes}
            for p in points
        ]

    def to_csv(self, path: Path | str) -> None:
        """Write the rows of `table` to a new file of comma-separated values.

        Raises:
            FileExistsError: If the file exists.
        """
        rows = self.table()
        with open(path, "x", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]) if rows else [])
            writer.writeheader()
            writer.writerows(rows)

    def _summary(self) -> show.Summary:
        axes = {"algorithm": self.algorithms, **self.labels}.items()
        parts = [*((name, f"{len(x)}", show.some_of(x)) for name, x in axes), ("trial", f"{self.trials}")]
        metrics = [(name, " and ".join(self.bounds.get(name, ()))) for name in self.metrics]
        return show.Summary(f"{self.done.sum()} of {self.done.size} trials done", {"axes": parts, "metrics": metrics})


def bound_name(metric: str, bound: str) -> str:
    """Return the name of the array of a bound: the metric 'doppler_error_hz' and the bound
    'Cramer-Rao bound' give 'doppler_error_hz_bound_cramer_rao_bound'.
    """
    return f"{metric}_bound_{''.join(c if c.isalnum() else '_' for c in bound.lower())}"


def blank(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return an array of trials that have not run: of False, of 255 as codes, or of NaN."""
    return np.full(shape, {"b": False, "u": 255}.get(np.dtype(dtype).kind, np.nan), dtype)


def _enlarged(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = blank((*x.shape[: x.ndim - len(shape)], *shape), x.dtype)
    out[tuple(map(slice, x.shape))] = x
    return out


@dataclass(frozen=True)
class Difference:
    """A trial of one algorithm in which two records have different values of a metric, or codes."""

    metric: str
    algorithm: str
    parameters: dict[str, float | str]
    trial: int
    values: tuple[float, float]


def differences(a: Record, b: Record, tolerance: float) -> list[Difference]:
    """Return the trials that both records hold and in which a metric or `outcome` differs.

    Two runs with different batch sizes or numbers of threads differ only by rounding, except in
    trials in which rounding changes a decision (the choice of a peak or the end of an iteration).
    This function finds such trials. An error is a small difference of two large numbers, so that
    metrics with "error" in their names are compared relative to the largest error of the point.

    Args:
        a: The one record.
        b: The other record.
        tolerance: Largest accepted difference of a metric, relative to the larger of the two
            magnitudes; `outcome` must be equal.

    Raises:
        ConfigError: If the records differ in their algorithms or parameter values.
    """
    if a.labels != b.labels or a.algorithms != b.algorithms:
        raise ConfigError(
            f"the two records must have the same algorithms and parameter values, got {a.algorithms} over {a.labels} "
            f"and {b.algorithms} over {b.labels}"
        )
    n = min(a.trials, b.trials)
    both = a.done[..., :n] & b.done[..., :n]
    pairs = {name: (a.metrics[name], b.metrics[name], tolerance) for name in a.metrics if name in b.metrics}
    pairs[OUTCOME] = (a.outcome.astype(float), b.outcome.astype(float), 0.0)
    found = []
    for name, (x, y, allowed) in pairs.items():
        x, y = x[..., :n], y[..., :n]
        scale = np.fmax(np.abs(x), np.abs(y))
        if "error" in name:
            scale = np.fmax.reduce(scale, axis=-1, keepdims=True, initial=0.0)
        apart = both & ~((np.abs(x - y) <= allowed * scale) | (np.isnan(x) & np.isnan(y)) | (x == y))
        for algorithm, *point, trial in np.argwhere(apart).tolist():
            parameters = {p: labels[i] for (p, labels), i in zip(a.labels.items(), point)}
            values = float(x[(algorithm, *point, trial)]), float(y[(algorithm, *point, trial)])
            found.append(Difference(name, a.algorithms[algorithm], parameters, trial, values))
    return found


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
    """Share of trials whose metric is within a limit, with its interval; nothing without a limit.

    Trials of an algorithm without the metric count neither as success nor as failure.
    """
    if limit is None:
        return {}
    here = np.isfinite(values)
    within = record.ok & (np.abs(np.where(here, values, np.inf)) <= limit)
    gives = here.any(tuple(range(1, here.ndim)), keepdims=True)
    shares = _shares(within, record.done[None] & gives, "success")
    return {"success_limit": np.full(values.shape[:-1], float(limit)), **shares}
