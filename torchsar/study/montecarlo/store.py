"""The store of a sweep: labelled arrays in zarr version 3, and markers of what is done, written
last.

One process writes, and every file of a zarr store is replaced whole, so a sweep that is killed at
any moment leaves arrays that may hold more than is marked done, never less; what is not marked is
ignored and computed again.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from torchsar.study.montecarlo.grid import Grid, address, canonical
from torchsar.study.montecarlo.record import OK, Labels, Record, bound_name
from torchsar.study.settings.errors import ConfigError

FORMAT = 1
_CHUNK_NUMBERS = 1 << 16
_SHARE_FOR_WRITING = 0.005
_DONE, _SAVED = "done", "saved"


class Store:
    """results.zarr of one sweep, open for writing.

    Made by `create` or `resume`; `record` is what it holds.

    Root attributes: format, identity and hash (what the results depend on), labels and values of
    the parameters, algorithms, trials, about, sessions. Arrays: one a metric, `ok`, one a bound,
    the coordinates. Group `done`: by index of the point, the ranges of trials that are recorded.
    Group `saved`: images and taps of chosen trials.
    """

    def __init__(self, root: zarr.Group, record: Record) -> None:
        self.root, self.record = root, record
        self._marks = attributes(root[_DONE])
        self._dirty: set[tuple[int, ...]] = set()
        self._window: tuple[int, int] | None = None
        self._arrays: dict[str, zarr.Array] = {}
        self._pending: list[tuple[str, dict[str, Any], dict[str, np.ndarray]]] = []
        self._last, self._cost = time.perf_counter(), 0.0

    @classmethod
    def create(cls, path: Path, grid: Grid, trials: int, identity: Mapping[str, Any]) -> Store:
        """A new store. Raises ConfigError where the folder cannot be written."""
        record = empty(grid.labels, trials)
        with _writing(path):
            root = zarr.open_group(str(path), mode="w", zarr_format=3)
            root.create_group(_DONE)
            return cls(root, record)._begun(grid, identity)

    @classmethod
    def resume(cls, path: Path, grid: Grid, trials: int, identity: Mapping[str, Any]) -> Store:
        """The store that is there, with room for new labels and trials.

        Raises ConfigError where it belongs to another config.
        """
        root = _opened(path, "r+")
        held = attributes(root)
        refuse_another(path, held["identity"], _plain(identity), held["values"], _values(grid))
        record = _loaded(root, path)
        labels = {
            name: (*known, *(label for label in grid.labels[name] if label not in known))
            for name, known in record.labels.items()
        }
        with _writing(path):
            return cls(root, record.grown(labels, max(trials, record.trials)))._begun(grid, identity)

    def _begun(self, grid: Grid, identity: Mapping[str, Any]) -> Store:
        values = {
            name: {**attributes(self.root).get("values", {}).get(name, {}), **named}
            for name, named in _values(grid).items()
        }
        self.root.update_attributes(
            {"format": FORMAT, "identity": _plain(identity), "hash": hash_of(identity), "values": values}
        )
        self.record.about = _about(self.root)
        self._describe()
        for name, labels in self.record.labels.items():
            self._put(name, np.array(labels), (name,))
        self._put("trial", np.arange(self.record.trials), ("trial",))
        for name, (data, dims, about) in self._variables().items() if self.record.algorithms else ():
            self._array(name, data, dims, about)
        return self

    def _describe(self) -> None:
        self.root.update_attributes(
            {
                "labels": {k: list(v) for k, v in self.record.labels.items()},
                "trials": self.record.trials,
                "algorithms": list(self.record.algorithms),
            }
        )

    def note(self, **about: Any) -> None:
        """Root attributes: what the run was."""
        with _writing(self.path):
            self.root.update_attributes(_plain_values(about))

    @property
    def path(self) -> Path:
        """Where it lies."""
        return Path(str(self.root.store_path).removeprefix("file://"))

    # writing
    # ----------------------------------------------------------------------------------------------

    @property
    def due(self) -> bool:
        """Whether writing costs less than half a percent of the time since the last writing."""
        return time.perf_counter() - self._last > self._cost / _SHARE_FOR_WRITING

    def entered(self, places: Iterable[tuple[int, ...]], trials: Sequence[int]) -> None:
        """Rows have entered the record, to be written by the next `flush`."""
        self._dirty.update(places)
        first, last = min(trials), max(trials) + 1
        self._window = (
            (first, last) if self._window is None else (min(first, self._window[0]), max(last, self._window[1]))
        )

    def save(self, labels: Mapping[str, float | str], trial: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep arrays of one trial, to be written before it is marked done."""
        self._pending.append((f"{address(labels)}/{trial}", {"parameters": dict(labels), "trial": trial}, dict(arrays)))

    def flush(self) -> None:
        """Write what has entered the record, then mark it done, in one file."""
        if self._window is None:
            return
        with _writing(self.path):
            self._flush(*self._window)

    def _flush(self, first: int, last: int) -> None:
        """The trials first..last-1.

        The list of arrays comes after them and before the marks: whoever reads knows what must be
        there.
        """
        began = time.perf_counter()
        if list(self.record.algorithms) != self.root.attrs.get("algorithms"):
            self._describe()
            self._put("algorithm", np.array(self.record.algorithms), ("algorithm",))
        variables = self._variables()
        for name, (data, dims, about) in variables.items():
            self._write(name, data, dims, about, first, last)
        if list(variables) != self.root.attrs.get("arrays"):
            self.root.update_attributes({"arrays": list(variables)})
        self._write_saved()
        self._marks.update({",".join(map(str, place)): _spans(self.record.done[place]) for place in self._dirty})
        self.root[_DONE].update_attributes(self._marks)
        self._dirty, self._window = set(), None
        self._last = time.perf_counter()
        self._cost = self._last - began

    def _variables(self) -> dict[str, tuple[np.ndarray, tuple[str, ...], dict[str, Any]]]:
        record = self.record
        found = {
            OK: (record.ok, record.dims, {"kind": OK}),
            **{name: (x, record.dims, {"kind": "metric"}) for name, x in record.metrics.items()},
        }
        for metric, named in record.bounds.items():
            found.update(
                {
                    bound_name(metric, name): (x, record.dims[1:], {"kind": "bound", "bound_of": metric, "bound": name})
                    for name, x in named.items()
                }
            )
        return found

    def _write(
        self, name: str, data: np.ndarray, dims: tuple[str, ...], about: dict[str, Any], first: int, last: int
    ) -> None:
        """The trials first..last-1 of all points, widened to whole chunks of the array, so that
        nothing is read back.
        """
        array = self._array(name, data, dims, about)
        step = array.chunks[-1]
        window = (..., slice(first // step * step, min(-(-last // step) * step, data.shape[-1])))
        array[window] = data[window]

    def _array(self, name: str, data: np.ndarray, dims: tuple[str, ...], about: dict[str, Any]) -> zarr.Array:
        """The array of that name, made or grown as needed, and remembered: looking it up costs as
        much as writing it.
        """
        if name not in self._arrays:
            self._arrays[name] = self._opened_array(name, data, dims, about)
        if self._arrays[name].shape != data.shape:
            self._arrays[name].resize(data.shape)
        return self._arrays[name]

    def _opened_array(self, name: str, data: np.ndarray, dims: tuple[str, ...], about: dict[str, Any]) -> zarr.Array:
        if name in self.root:
            return self.root[name]  # pyright: ignore[reportReturnType]
        leading = tuple(max(1, min(n, 64)) for n in data.shape[:-1])
        chunk = max(1, min(data.shape[-1], 1024, _CHUNK_NUMBERS // max(1, int(np.prod(leading)))))
        fill = False if data.dtype == bool else np.nan
        return self.root.create_array(
            name,
            shape=data.shape,
            dtype=data.dtype,
            chunks=(*leading, chunk),
            dimension_names=dims,
            attributes=about,
            fill_value=fill,
            compressors=None,
        )

    def _put(self, name: str, values: np.ndarray, dims: tuple[str, ...]) -> None:
        """A coordinate, whole."""
        if values.dtype.kind == "U":
            values = (
                values.astype(np.dtypes.StringDType()) if hasattr(np.dtypes, "StringDType") else values.astype(object)
            )
        with warnings.catch_warnings():
            # zarr warns that texts are not in version 3 of the specification yet
            warnings.simplefilter("ignore")
            array = self.root.create_array(
                name,
                shape=values.shape,
                dtype=str if values.dtype.kind in "TO" else values.dtype,
                chunks=values.shape,
                dimension_names=dims,
                overwrite=True,
            )
            array[...] = values

    def _write_saved(self) -> None:
        for path, about, arrays in self._pending:
            group = self.root.require_group(f"{_SAVED}/{path}")
            group.attrs.put(_plain_values(about))
            for name, data in arrays.items():
                group.create_array(name, data=data, overwrite=True)
        self._pending = []


def empty(labels: Labels, trials: int) -> Record:
    """A record in which nothing has run. Raises ConfigError where it does not fit into memory."""
    shape = (*map(len, labels.values()), trials)
    try:
        return Record((), dict(labels), np.zeros(shape, bool), np.zeros((0, *shape), bool))
    except (MemoryError, ValueError):
        raise ConfigError(
            f"sweep: the results of {' x '.join(map(str, shape))} trials do not fit into memory; "
            "ask for fewer trials or points"
        ) from None


def read_sweep(path: Path | str) -> Record:
    """The record in a results.zarr, or in the folder of a sweep, finished or not.

    Raises ConfigError where there is none.
    """
    path = Path(path) / "results.zarr" if (Path(path) / "results.zarr").exists() else Path(path)
    return _loaded(_opened(path, "r"), path)


def attributes(node: Any) -> dict[str, Any]:
    """Attributes of a group or an array, as a plain tree."""
    return node.attrs.asdict()


def cut_off(path: Path) -> bool:
    """Whether a sweep of ours was killed while it made this store, before there was
    anything in it.
    """
    made = {p.name for p in path.iterdir() if not p.name.endswith(".partial")} if path.is_dir() else {""}
    if not made <= {"zarr.json", _DONE}:
        return False
    return "zarr.json" not in made or "labels" not in json.loads((path / "zarr.json").read_text(encoding="utf-8")).get(
        "attributes", {}
    )


def _opened(path: Path, mode: Any) -> zarr.Group:
    try:
        root = zarr.open_group(str(path), mode=mode)
    except (FileNotFoundError, ValueError, OSError):
        raise ConfigError(f"{path} holds no results of a sweep; choose another folder") from None
    if root.attrs.get("format") != FORMAT or not {"labels", "identity"} <= set(root.attrs):
        raise ConfigError(
            f"{path} was not left by a sweep of this version of torchsar; remove it or choose another folder"
        )
    return root


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """What the system says of a file that cannot be written, as one sentence."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be written ({error.strerror or error}); what is marked done there is "
            "safe, go on with --resume once it can be"
        ) from error


def _loaded(root: zarr.Group, path: Path) -> Record:
    """Everything on disk, without what is not marked done.

    Raises ConfigError where files are missing or spoilt.
    """
    try:
        missing = [name for name in (_DONE, *attributes(root).get("arrays", [])) if name not in root]
        if not missing:
            return _read(root)
    except (KeyError, ValueError, IndexError, TypeError, OSError) as error:
        raise ConfigError(
            f"{path} is damaged ({type(error).__name__}: {' '.join(str(error).split())}); restore "
            "it, or begin anew in another folder"
        ) from error
    raise ConfigError(f"{path} is damaged: {missing[0]!r} is missing; restore it, or begin anew in another folder")


def _read(root: zarr.Group) -> Record:
    held = attributes(root)
    record = empty({name: tuple(labels) for name, labels in held["labels"].items()}, held["trials"])
    for index, spans in attributes(root[_DONE]).items():
        for first, last in spans:
            record.done[(*map(int, filter(None, index.split(","))), slice(first, last))] = True
    record.algorithms = tuple(held["algorithms"])
    record.ok = np.zeros((len(record.algorithms), *record.done.shape), bool)
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Object at"
        )  # a process that was killed while it wrote leaves half a file beside the old one
        arrays = list(root.arrays())
    # a folder lists its files in any order
    place = {name: i for i, name in enumerate(held.get("arrays", []))}
    for name, array in sorted(arrays, key=lambda pair: place.get(pair[0], -1)):
        kind = array.attrs.get("kind")
        if kind == OK:
            _restore(record.ok, array, record.done)
        elif kind == "metric":
            _restore(record.metrics.setdefault(name, record.blank()), array, record.done)
        elif kind == "bound":
            named = record.bounds.setdefault(str(array.attrs["bound_of"]), {})
            _restore(named.setdefault(str(array.attrs["bound"]), record.blank(False)), array, record.done)
    record.about = _about(root)
    return record


def _about(root: zarr.Group) -> dict[str, Any]:
    return {
        key: value
        for key, value in attributes(root).items()
        if key not in ("labels", "values", "trials", "algorithms", "arrays", "format")
    }


def _restore(target: np.ndarray, array: zarr.Array, done: np.ndarray) -> None:
    """Put an array of the same or a smaller shape where it belongs; a sweep may have been killed
    while its arrays grew.
    """
    part = tuple(map(slice, array.shape))
    target[part] = np.where(done[part[-done.ndim :]], np.asarray(array[...]), target[part])


def _spans(done: np.ndarray) -> list[list[int]]:
    """Ranges [first, last) of a row of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], done, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2).tolist()


def hash_of(identity: Mapping[str, Any]) -> str:
    return address(identity)


def refuse_another(
    path: Path,
    was: Mapping[str, Any],
    now: Mapping[str, Any],
    values_were: Mapping[str, Any],
    values: Mapping[str, Any],
) -> None:
    """Raise ConfigError where results of two configs would mix; names what differs."""
    if list(values_were) != list(values):
        raise ConfigError(
            f"{path} holds a sweep over {', '.join(values_were) or 'nothing'}, not over "
            f"{', '.join(values) or 'nothing'}; choose another folder for the other sweep"
        )
    for name, named in values.items():
        for label, value in named.items():
            if values_were[name].get(label, value) != value:
                raise ConfigError(
                    f"{path} holds a sweep where {name} {label!r} is {_short(values_were[name][label])}, "
                    f"and now it is {_short(value)}; give the new value a name of its own"
                )
    differing = list(_differences(was, now))
    if differing:
        more = f", and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise ConfigError(
            f"{path} holds a sweep of another config ({hash_of(was)}, now {hash_of(now)}): "
            f"{'; '.join(differing[:3])}{more}; choose another folder, or set these back"
        )


def _differences(was: Any, now: Any, where: str = "") -> Iterable[str]:
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys((*was, *now)):
            yield from _differences(
                was.get(key, "absent"), now.get(key, "absent"), f"{where}.{key}" if where else str(key)
            )
    elif was != now:
        yield f"{where} was {_short(was)} and is {_short(now)}"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value).removesuffix(".0")
    return text if len(text) <= 60 else text[:57] + "..."


def _values(grid: Grid) -> dict[str, dict[str, str]]:
    """By parameter and label, what the value is."""
    return {p.name: {str(label): canonical(value) for label, value in zip(p.labels, p.values)} for p in grid.parameters}


def _plain(identity: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(canonical(identity))


def _plain_values(tree: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(dict(tree), default=str))
