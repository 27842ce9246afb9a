"""The store of a sweep: labelled arrays in zarr version 3, and marks of the trials that are done.

One process writes, every file of a zarr store is replaced as a whole, and the marks are written
last. If a sweep is killed, its arrays may therefore hold more trials than are marked as done, but
never fewer. Trials that are not marked are ignored and computed again.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from torchsar.study.montecarlo.grid import Grid, address, canonical
from torchsar.study.montecarlo.record import OK, Labels, Record
from torchsar.study.settings.errors import ConfigError, one_line

# number of the layout of the store; another one is refused on resume
FORMAT = 1
# numbers in a zarr chunk at most: half a megabyte, which is written whole for every change
_CHUNK_NUMBERS = 1 << 16
# writing takes half a percent of the time at most
_SHARE_FOR_WRITING = 0.005
# trials whose arrays wait to be written at most, since they fill the memory meanwhile
_WAITING = 64
_DONE, _SAVED = "done", "saved"


class Store:
    """results.zarr of one sweep, open for writing; made by `create` or `resume`.

    Root attributes: format, identity and hash (what the results depend on), labels and values of
    the parameters, algorithms, trials, about, sessions. Arrays: one for each metric, `ok`, one for
    each bound, and the coordinates. Group `done`: for each point, by its index, the ranges of
    trials that are recorded. Group `saved`: images and outputs of stages for chosen trials.

    Args:
        root: The open zarr group.
        record: The same results in memory.
    """

    def __init__(self, root: zarr.Group, record: Record) -> None:
        self.root, self.record = root, record
        self.path = Path(str(root.store_path).removeprefix("file://"))
        self._marks = _attributes(root[_DONE])
        self._dirty: set[tuple[tuple[int, ...], int]] = set()
        self._arrays: dict[str, zarr.Array] = {}
        self._pending: list[tuple[str, dict[str, Any], dict[str, np.ndarray]]] = []
        self._last, self._cost = time.perf_counter(), 0.0

    @classmethod
    def create(cls, path: Path, grid: Grid, trials: int, identity: Mapping[str, Any]) -> Store:
        """Create a new store for the results of a sweep, and return it.

        Raises:
            ConfigError: If the folder cannot be written.
        """
        record = empty(grid.labels, trials)
        with _writing(path):
            root = zarr.open_group(str(path), mode="w", zarr_format=3)
            root.create_group(_DONE)
            return cls(root, record)._begun(grid, identity)

    @classmethod
    def resume(cls, path: Path, grid: Grid, trials: int, identity: Mapping[str, Any]) -> Store:
        """Open an existing store, and enlarge it for new values of parameters and more trials.

        Raises:
            ConfigError: If the store has the results of another config, or is damaged.
        """
        root = _opened(path, "r+")
        _refuse_another(path, _attributes(root), _plain(identity), _values(grid))
        record = _loaded(root, path)
        labels = {name: tuple(dict.fromkeys((*known, *grid.labels[name]))) for name, known in record.labels.items()}
        with _writing(path):
            return cls(root, record.grown(labels, max(trials, record.trials)))._begun(grid, identity)

    def _begun(self, grid: Grid, identity: Mapping[str, Any]) -> Store:
        known = _attributes(self.root).get("values", {})
        values = {name: {**known.get(name, {}), **named} for name, named in _values(grid).items()}
        about = {"format": FORMAT, "identity": _plain(identity), "hash": address(identity), "values": values}
        self.root.update_attributes(about)
        self.record.about = _about(self.root)
        labels = {name: list(known) for name, known in self.record.labels.items()}
        self.root.update_attributes({"labels": labels, "trials": self.record.trials})
        for name, values in (*labels.items(), ("trial", range(self.record.trials))):
            self._put(name, np.array(values))
        for name, variable in self.record.variables().items() if self.record.algorithms else ():
            self._array(name, *variable)
        return self

    def note(self, **about: Any) -> None:
        """Set root attributes that describe the run."""
        with _writing(self.path):
            self.root.update_attributes(json.loads(json.dumps(about, default=str)))

    @property
    def due(self) -> bool:
        """Whether results should be written now.

        This is so if writing takes less than 0.5 % of the time since the results were last written,
        or if the saved arrays of 64 trials wait to be written.
        """
        waited = time.perf_counter() - self._last
        return waited > self._cost / _SHARE_FOR_WRITING or len(self._pending) >= _WAITING

    def entered(self, points: Iterable[tuple[int, ...]], trials: Iterable[int]) -> None:
        """Note trials whose results are new in the record; the next `flush` writes them.

        Args:
            points: Index of the grid point of each trial.
            trials: Number of each trial at its point.
        """
        self._dirty.update(zip(points, trials))

    def save(self, labels: Mapping[str, float | str], trial: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep arrays of a trial until the next `flush`, which writes them and then marks the trial
        as done.
        """
        self._pending.append((f"{address(labels)}/{trial}", {"parameters": dict(labels), "trial": trial}, dict(arrays)))

    def flush(self) -> None:
        """Write the new results, and then mark their trials as done, by writing a single file.

        The names of algorithms and arrays are written after the arrays and before these marks, so
        that a reader finds every array that is named.
        """
        if not self._dirty:
            return
        began, trials = time.perf_counter(), [trial for _, trial in self._dirty]
        with _writing(self.path):
            variables = self.record.variables()
            for name, variable in variables.items():
                self._write(name, variable, min(trials), max(trials) + 1)
            names = {"algorithms": list(self.record.algorithms), "arrays": list(variables)}
            if any(self.root.attrs.get(key) != value for key, value in names.items()):
                self._put("algorithm", np.array(self.record.algorithms))
                self.root.update_attributes(names)
            for path, about, arrays in self._pending:
                group = self.root.require_group(f"{_SAVED}/{path}")
                group.attrs.put(about)
                for name, data in arrays.items():
                    group.create_array(name, data=data, overwrite=True)
            points = {point for point, _ in self._dirty}
            self._marks.update({",".join(map(str, point)): _spans(self.record.done[point]) for point in points})
            self.root[_DONE].update_attributes(self._marks)
        self._dirty, self._pending, self._last = set(), [], time.perf_counter()
        self._cost = self._last - began

    def _write(self, name: str, variable: tuple[np.ndarray, Any, Any], first: int, last: int) -> None:
        """The trials first..last-1 of all points, widened to whole chunks of the array, so that
        nothing is read back.
        """
        array, data = self._array(name, *variable), variable[0]
        step = array.chunks[-1]
        window = (..., slice(first // step * step, min(-(-last // step) * step, data.shape[-1])))
        array[window] = data[window]

    def _array(self, name: str, data: np.ndarray, dims: tuple[str, ...], about: dict[str, Any]) -> zarr.Array:
        """The array of that name, made or enlarged as needed; cached, since looking it up takes as
        long as writing it.
        """
        if name not in self._arrays:
            leading = tuple(max(1, min(n, 64)) for n in data.shape[:-1])
            chunk = max(1, min(data.shape[-1], 1024, _CHUNK_NUMBERS // max(1, int(np.prod(leading)))))
            made: dict[str, Any] = {
                "shape": data.shape,
                "dtype": data.dtype,
                "chunks": (*leading, chunk),
                "fill_value": False if data.dtype == bool else np.nan,
                "dimension_names": dims,
                "attributes": about,
                "compressors": None,
            }
            known: Any = self.root.get(name)
            self._arrays[name] = self.root.create_array(name, **made) if known is None else known
        if self._arrays[name].shape != data.shape:
            self._arrays[name].resize(data.shape)
        return self._arrays[name]

    def _put(self, name: str, values: np.ndarray) -> None:
        """A coordinate, whole."""
        dtype: Any = values.dtype
        if dtype.kind == "U":
            dtype, values = str, values.astype(getattr(np.dtypes, "StringDType", lambda: object)())
        with warnings.catch_warnings():
            # zarr warns that texts are not in version 3 of the specification yet
            warnings.simplefilter("ignore")
            made: dict[str, Any] = {"shape": values.shape, "dtype": dtype, "chunks": values.shape}
            array = self.root.create_array(name, dimension_names=(name,), overwrite=True, **made)
            array[...] = values


def empty(labels: Labels, trials: int) -> Record:
    """Return a record without results, in which no trial is marked as done.

    Raises:
        ConfigError: If its arrays do not fit into memory.
    """
    shape = (*map(len, labels.values()), trials)
    try:
        return Record((), dict(labels), np.zeros(shape, bool), np.zeros((0, *shape), bool))
    except (MemoryError, ValueError):
        raise ConfigError(
            f"sweep: the results of {' x '.join(map(str, shape))} trials do not fit into memory; "
            "ask for fewer trials or points"
        ) from None


def read_sweep(path: Path | str) -> Record:
    """Read the results of a sweep, finished or not.

    Args:
        path: Path of results.zarr, or of the folder of the sweep that has this file.

    Returns:
        The results, with trials that have not run as NaN.

    Raises:
        ConfigError: If there are no results, or they are damaged or of another version.
    """
    path = Path(path) / "results.zarr" if (Path(path) / "results.zarr").exists() else Path(path)
    return _loaded(_opened(path, "r"), path)


def cut_off(path: Path) -> bool:
    """Return whether a sweep was killed while creating this store, which then holds no results."""
    made = {p.name for p in path.iterdir() if not p.name.endswith(".partial")} if path.is_dir() else {""}
    root = path / "zarr.json"
    if not made <= {root.name, _DONE}:
        return False
    return root.name not in made or "labels" not in json.loads(root.read_text("utf-8")).get("attributes", {})


def _opened(path: Path, mode: Any) -> zarr.Group:
    try:
        root = zarr.open_group(str(path), mode=mode)
    except (FileNotFoundError, ValueError, OSError):
        raise ConfigError(f"{path} holds no results of a sweep; choose another folder") from None
    if root.attrs.get("format") != FORMAT or not {"labels", "identity"} <= set(root.attrs):
        raise ConfigError(
            f"{path} was not written by a sweep of this version of torchsar; remove it or choose another folder"
        )
    return root


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn an error of the file system into one sentence."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be written ({error.strerror or error}), but finished trials are kept; go on with "
            "--resume once the folder can be written"
        ) from error


def _loaded(root: zarr.Group, path: Path) -> Record:
    """The trials on disk that are marked done.

    Raises:
        ConfigError: If files are missing or broken.
    """
    advice = "restore it, or start again in another folder"
    try:
        missing = [name for name in (_DONE, *_attributes(root).get("arrays", [])) if name not in root]
        if not missing:
            return _read(root)
    except (KeyError, ValueError, IndexError, TypeError, OSError) as error:
        raise ConfigError(f"{path} is damaged ({type(error).__name__}: {one_line(error)}); {advice}") from error
    raise ConfigError(f"{path} is damaged: {missing[0]!r} is missing; {advice}")


def _read(root: zarr.Group) -> Record:
    held = _attributes(root)
    record = empty({name: tuple(labels) for name, labels in held["labels"].items()}, held["trials"])
    for index, spans in _attributes(root[_DONE]).items():
        for first, last in spans:
            record.done[(*map(int, filter(None, index.split(","))), slice(first, last))] = True
    record.algorithms = tuple(held.get("algorithms", ()))
    record.ok = np.zeros((len(record.algorithms), *record.done.shape), bool)
    for name in held.get("arrays", ()):
        array: Any = root[name]
        about = _attributes(array)
        if about["kind"] == OK:
            target = record.ok
        elif about["kind"] == "metric":
            target = record.metrics.setdefault(name, record.blank())
        else:
            target = record.bounds.setdefault(about["bound_of"], {}).setdefault(about["bound"], record.blank(False))
        # the array is smaller where the sweep was killed while its arrays grew
        part = tuple(map(slice, array.shape))
        target[part] = np.where(record.done[part[-record.done.ndim :]], np.asarray(array[...]), target[part])
    record.about = _about(root)
    return record


def _attributes(node: Any) -> dict[str, Any]:
    return node.attrs.asdict()


def _about(root: zarr.Group) -> dict[str, Any]:
    own = ("labels", "values", "trials", "algorithms", "arrays", "format")
    return {key: value for key, value in _attributes(root).items() if key not in own}


def _spans(done: np.ndarray) -> list[list[int]]:
    """Ranges [first, last) of a row of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], done, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2).tolist()


def _refuse_another(
    path: Path, held: Mapping[str, Any], identity: Mapping[str, Any], values: Mapping[str, Any]
) -> None:
    """Refuse to mix the results of two configs; the sentence names what differs."""
    was = held["values"]
    if list(was) != list(values):
        raise ConfigError(
            f"{path} holds a sweep over the parameters {', '.join(was) or '(none)'}, and this sweep is over "
            f"{', '.join(values) or '(none)'}; choose another folder for this sweep"
        )
    for name, named in values.items():
        for label, value in named.items():
            if was[name].get(label, value) != value:
                raise ConfigError(
                    f"{path} holds a sweep in which {label!r} of the parameter {name} stands for "
                    f"{_short(was[name][label])}, and now it stands for {_short(value)}; give the new value "
                    "another label"
                )
    differing = list(_differences(held["identity"], identity))
    if differing:
        more = f", and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise ConfigError(
            f"{path} holds a sweep of another config (hash {address(held['identity'])}, now {address(identity)}): "
            f"{', '.join(differing[:3])}{more}; choose another folder, or give these keys their earlier values"
        )


def _differences(was: Any, now: Any, where: str = "") -> Iterator[str]:
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys((*was, *now)):
            name = f"{where}.{key}" if where else str(key)
            yield from _differences(was.get(key, "absent"), now.get(key, "absent"), name)
    elif was != now:
        yield f"{where} was {_short(was)} and is {_short(now)}"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value).removesuffix(".0")
    return text if len(text) <= 60 else text[:57] + "..."


def _values(grid: Grid) -> dict[str, dict[str, str]]:
    """The text of every value by parameter and label."""
    return {p.name: {str(label): canonical(value) for label, value in zip(p.labels, p.values)} for p in grid.parameters}


def _plain(identity: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(canonical(identity))
