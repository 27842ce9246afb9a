"""What a sweep has found, in memory: labelled arrays with trials last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchsar.study.montecarlo.grid import RESERVED, check_name
from torchsar.study.settings.errors import ConfigError

OK = "ok"
Labels = dict[str, tuple[float | str, ...]]


@dataclass
class Record:
    """Results of a sweep. A trial that has not run is NaN in every metric and False in `done`.

    labels: values of every parameter, numbers or words, in the order of the dims. metrics: name ->
    float64 (algorithm, *parameters, trial). ok: bool of the same shape, what the algorithm itself
    says of the trial. bounds: metric -> name of the bound -> float64 (*parameters, trial). done:
    bool (*parameters, trial); points that ended early have fewer trials than others. about: what
    the run was: title, resolved config, hash, seed, versions, device, dtype, timings.
    """

    algorithms: tuple[str, ...]
    labels: Labels
    done: np.ndarray
    ok: np.ndarray
    metrics: dict[str, np.ndarray] = field(default_factory=dict)
    bounds: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def trials(self) -> int:
        """Length of the trial dim."""
        return self.done.shape[-1]

    @property
    def dims(self) -> tuple[str, ...]:
        return ("algorithm", *self.labels, "trial")

    def blank(self, by_algorithm: bool = True) -> np.ndarray:
        """An array of NaN with the dims of a metric, or those of a bound."""
        return np.full(self.ok.shape if by_algorithm else self.done.shape, np.nan)

    def place(self, labels: Mapping[str, float | str]) -> tuple[int, ...]:
        """Index of a point, from its labels by parameter."""
        return tuple(known.index(labels[name]) for name, known in self.labels.items())

    def add(
        self,
        places: Sequence[tuple[int, ...]],
        trials: Sequence[int],
        values: Mapping[str, Mapping[str, Sequence[float]]],
        bounds: Mapping[str, Mapping[str, Sequence[float]]],
    ) -> None:
        """Enter rows: values by algorithm and metric, bounds by metric and name, each (rows,).

        An algorithm without `ok` stands for all it gives.
        """
        if not self.algorithms:
            self.algorithms, self.ok = tuple(values), np.zeros((len(values), *self.done.shape), bool)
        if set(values) != set(self.algorithms):
            foreign = next((a for a in values if a not in self.algorithms), None)
            gave = (
                f"results of the algorithm {foreign!r}"
                if foreign is not None
                else f"results of {', '.join(values)} alone"
            )
            raise ConfigError(
                f"a trial gave {gave}, those before it of {', '.join(self.algorithms)}; return the "
                "same algorithms in every trial"
            )
        rows = np.ravel_multi_index(
            tuple(zip(*((*place, trial) for place, trial in zip(places, trials)))), self.done.shape
        )
        for algorithm, metrics in values.items():
            number = self.algorithms.index(algorithm)
            self.ok[number].reshape(-1)[rows] = metrics.get(OK, True)
            for metric, found in metrics.items():
                if metric != OK:
                    self._metric(metric)[number].reshape(-1)[rows] = found
        for metric, named in bounds.items():
            for name, found in named.items():
                self._bound(metric, name).reshape(-1)[rows] = found
        self.done.reshape(-1)[rows] = True

    def _metric(self, name: str) -> np.ndarray:
        if name not in self.metrics:
            self._refuse_name(name, "metric")
            self.metrics[name] = self.blank()
        return self.metrics[name]

    def _bound(self, metric: str, name: str) -> np.ndarray:
        named = self.bounds.setdefault(metric, {})
        if name not in named:
            self._refuse_name(bound_name(metric, name), "bound")
            named[name] = self.blank(False)
        return named[name]

    def _refuse_name(self, name: Any, kind: str) -> None:
        """A new array may not stand in the place of another one."""
        bounds = [bound_name(metric, bound) for metric, named in self.bounds.items() for bound in named]
        check_name(name, (*RESERVED, *self.labels, *self.metrics, *bounds), "the trial function", kind)

    def grown(self, labels: Labels, trials: int) -> Record:
        """The same results where there is room for more: labels begin with those of this record."""
        return self._mapped(lambda x: _enlarged(x, (*map(len, labels.values()), trials)), labels)

    def select(self, labels: Labels) -> Record:
        """The part of these labels, in their order."""
        index = [[self.labels[name].index(label) for label in wanted] for name, wanted in labels.items()]
        return self._mapped(lambda x: x[_mesh(index, x.ndim - self.done.ndim, x.shape)], labels)

    def _mapped(self, change: Any, labels: Labels) -> Record:
        bounds = {metric: {name: change(x) for name, x in named.items()} for metric, named in self.bounds.items()}
        return replace(
            self,
            labels=labels,
            done=change(self.done),
            ok=change(self.ok),
            metrics={name: change(x) for name, x in self.metrics.items()},
            bounds=bounds,
        )

    def to_xarray(self) -> Any:
        """An xarray.Dataset with the dims (algorithm, *parameters, trial); bounds carry the
        attributes `bound_of` and `bound`. Needs the extra `xarray`.
        """
        try:
            import xarray
        except ImportError:
            raise ImportError("labelled reading needs xarray: pip install 'torchsar-lab[xarray]'") from None
        arrays: dict[str, Any] = {
            OK: (self.dims, self.ok),
            "done": (self.dims[1:], self.done),
            **{name: (self.dims, x) for name, x in self.metrics.items()},
        }
        for metric, named in self.bounds.items():
            for name, x in named.items():
                arrays[bound_name(metric, name)] = (self.dims[1:], x, {"bound_of": metric, "bound": name})
        return xarray.Dataset(
            arrays,
            {
                "algorithm": list(self.algorithms),
                **{k: list(v) for k, v in self.labels.items()},
                "trial": np.arange(self.trials),
            },
        )


def bound_name(metric: str, bound: str) -> str:
    """Name of a bound's array: 'doppler_error_hz' and 'Cramer-Rao bound' give
    doppler_error_hz_bound_cramer_rao_bound.
    """
    return f"{metric}_bound_{''.join(c if c.isalnum() else '_' for c in bound.lower())}"


def _enlarged(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = np.full((*x.shape[: x.ndim - len(shape)], *shape), False if x.dtype == bool else np.nan, x.dtype)
    out[tuple(map(slice, x.shape))] = x
    return out


def _mesh(index: list[list[int]], leading: int, shape: tuple[int, ...]) -> Any:
    return np.ix_(*(range(n) for n in shape[:leading]), *index, range(shape[-1]))
