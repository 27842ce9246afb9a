"""The store of a sweep: labelled arrays in zarr version 3, and marks of the trials that are done.

One process writes, every file of a zarr store is replaced as a whole, and the marks are written
last. If a sweep is killed, its arrays may therefore hold more trials than are marked as done, but
never fewer. Trials that are not marked are ignored and computed again.

Everything that is read has a checksum. Each chunk has the checksum of zarr. The marks of the trials
contain those of the numbers of each point, so that a missing or an older chunk is detected. They
also contain the checksums of the files of saved arrays, of the metadata of all arrays, and of the
attributes. Only plain files are read.
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec

from torchsar.core.stored import machine_memory_bytes
from torchsar.io.seal import (
    SEAL,
    address,
    array_metadata,
    canonical,
    files_checksum,
    group_attributes,
    plain_files,
    sealed,
)
from torchsar.study.montecarlo.fingerprint import changes, short
from torchsar.study.montecarlo.grid import Grid
from torchsar.study.montecarlo.record import OUTCOME, Record, blank
from torchsar.study.montecarlo.summary import Labels
from torchsar.study.settings.errors import ConfigError, one_line

# version of the layout of the store; other versions are rejected on resume
FORMAT = 4
# largest number of trials whose saved arrays wait to be written, because they fill the memory
# meanwhile
_WAITING = 64
_DONE, _SAVED = "done", "saved"


class Store:
    """results.zarr of one sweep, open for writing; made by `create` or `resume`.

    Root attributes: format, identity and hash (what the results depend on), labels and values of
    the parameters, algorithms, trials, about, sessions. Arrays: one for each metric, `outcome`, one
    for each bound, and the coordinates. Group `done`: for each point, by its index, the ranges of
    trials that are recorded with the checksum of their numbers, and the checksum of each entry of
    `saved`. Group `saved`: images and outputs of stages for chosen trials.

    Args:
        root: The open zarr group.
        record: The same results in memory.
    """

    def __init__(self, root: zarr.Group, record: Record) -> None:
        self.root, self.record = root, record
        self.path = Path(str(root.store_path).removeprefix("file://"))
        self._marks: dict[str, Any] = {"points": {}, _SAVED: {}, **_attributes(root[_DONE])}
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
    def resume(
        cls, path: Path, grid: Grid, trials: int, identity: Mapping[str, Any], allow_changed: bool = False
    ) -> Store:
        """Open an existing store, and enlarge it for new values of parameters and more trials.

        With `allow_changed`, the results may come from another config, other files or other code:
        the attribute `changed` then lists what differs and after how many trials, and `earlier` the
        identities before this one.

        Raises:
            ConfigError: If the store has the results of another identity, or is damaged.
        """
        root = _opened(path, "r+")
        held, changed = _attributes(root), _differing(path, _attributes(root), _plain(identity), _values(grid))
        if changed and not allow_changed:
            more = f", and {len(changed) - 3} more" if len(changed) > 3 else ""
            raise ConfigError(
                f"{path} holds a sweep of another config, trial function, file or version (hash "
                f"{address(held['identity'])}, now {address(identity)}): {', '.join(changed[:3])}{more}; choose "
                "another folder, restore what differs, or add --allow-changed (allow_changed=True) to mix both"
            )
        record = _loaded(root, path)
        labels = {name: tuple(dict.fromkeys((*known, *grid.labels[name]))) for name, known in record.labels.items()}
        with _writing(path):
            store = cls(root, record.grown(labels, max(trials, record.trials)))._begun(grid, identity)
        if changed:
            notes = [f"after {int(record.done.sum())} trials {text}" for text in changed]
            earlier = [*held.get("earlier", []), held["identity"]]
            store.note(changed=[*held.get("changed", []), *notes], earlier=earlier)
            store.record.about = _about(store.root)
        return store

    def _begun(self, grid: Grid, identity: Mapping[str, Any]) -> Store:
        known = _attributes(self.root).get("values", {})
        values = {name: {**known.get(name, {}), **named} for name, named in _values(grid).items()}
        about = {"format": FORMAT, "identity": _plain(identity), "hash": address(identity), "values": values}
        labels = {name: list(known) for name, known in self.record.labels.items()}
        # the arrays have their present shapes, which an earlier session may have enlarged only in
        # part
        if self._marks["points"]:
            self._mark()
        self.note(**about, labels=labels, trials=self.record.trials)
        self._put_coordinates()
        self.record.about = _about(self.root)
        for name, variable in self.record.variables().items() if self.record.algorithms else ():
            self._array(name, *variable)
        return self

    def note(self, **about: Any) -> None:
        """Set root attributes that describe the run."""
        with _writing(self.path):
            self.root.update_attributes(sealed({**_attributes(self.root), **about}))

    @property
    def due(self) -> bool:
        """Whether results should be written now.

        Results are written if 4 s have passed since the last time. They are written earlier if
        writing takes less than 0.5 % of the time, and later if it takes more than 10 %. They are
        also written if the saved arrays of 64 trials wait.
        """
        # The interval in seconds between writes is 4 s. It is shorter if writing then takes at most
        # half a percent of the time, and longer if writing would take more than a tenth.
        interval = max(min(self._cost / 0.005, 4.0), self._cost / 0.1)
        return time.perf_counter() - self._last > interval or len(self._pending) >= _WAITING

    @property
    def waiting(self) -> int:
        """Number of trials that the next `flush` writes."""
        return len(self._dirty)

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
                self._put_coordinates()
                self.note(**names)
            for path, about, arrays in self._pending:
                group = self.root.require_group(f"{_SAVED}/{path}")
                group.attrs.put(about)
                for name, data in arrays.items():
                    group.create_array(name, data=data, overwrite=True, compressors=[Crc32cCodec()])
                self._marks[_SAVED][path] = _of_saved(self.path, path)
            for point in {point for point, _ in self._dirty}:
                mark = {"spans": _spans(self.record.done[point]), SEAL: self.record.checksum(point)}
                self._marks["points"][",".join(map(str, point))] = mark
            self._mark()
        self._dirty, self._pending, self._last = set(), [], time.perf_counter()
        self._cost = self._last - began

    def _mark(self) -> None:
        """Write the marks of finished trials, which are a single file."""
        names = (*self.record.variables(), *_coordinates(self.record))
        self._marks["arrays"] = {name: array_metadata(self.path / name) for name in names}
        self.root[_DONE].update_attributes(sealed(self._marks))

    def _write(self, name: str, variable: tuple[np.ndarray, Any, Any], first: int, last: int) -> None:
        """Write the trials first..last-1 of all points. The range is widened to whole chunks of the
        array, so that nothing has to be read back.
        """
        array, data = self._array(name, *variable), variable[0]
        step = array.chunks[-1]
        window = (..., slice(first // step * step, min(-(-last // step) * step, data.shape[-1])))
        array[window] = data[window]

    def _array(self, name: str, data: np.ndarray, dims: tuple[str, ...], about: dict[str, Any]) -> zarr.Array:
        """Return the array of a name, created or enlarged as needed. It is cached, because finding
        it takes as long as writing it.
        """
        if name not in self._arrays:
            leading = tuple(max(1, min(n, 64)) for n in data.shape[:-1])
            # largest number of values in a zarr chunk: half a megabyte, which is rewritten as a
            # whole for every change
            chunk = max(1, min(data.shape[-1], 1024, (1 << 16) // max(1, int(np.prod(leading)))))
            made: dict[str, Any] = {
                "shape": data.shape,
                "dtype": data.dtype,
                "chunks": (*leading, chunk),
                "fill_value": blank((), data.dtype).item(),
                "dimension_names": dims,
                "attributes": about,
                "compressors": [Crc32cCodec()],
            }
            known: Any = self.root.get(name)
            self._arrays[name] = self.root.create_array(name, **made) if known is None else known
        if self._arrays[name].shape != data.shape:
            self._arrays[name].resize(data.shape)
        return self._arrays[name]

    def _put_coordinates(self) -> None:
        """Write the coordinates as a whole. Existing ones are enlarged and never removed in
        between.
        """
        for name, values in ((name, np.array(values)) for name, values in _coordinates(self.record).items()):
            known: Any = self.root.get(name)
            dtype: Any = values.dtype
            if dtype.kind == "U":
                dtype, values = str, values.astype(getattr(np.dtypes, "StringDType", lambda: object)())
            made: dict[str, Any] = {"shape": values.shape, "dtype": dtype, "chunks": values.shape}
            with warnings.catch_warnings():
                # zarr warns that version 3 of its specification does not contain texts yet
                warnings.simplefilter("ignore")
                known = known or self.root.create_array(
                    name, dimension_names=(name,), compressors=[Crc32cCodec()], **made
                )
                if known.shape != values.shape:
                    known.resize(values.shape)
                known[...] = values


def all_false(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of False, or raise MemoryError if it does not fit the main memory.

    Some systems promise more memory than there is: the array could be made there, but not used.
    """
    if math.prod(shape) > (machine_memory_bytes() or math.inf):
        raise MemoryError
    return np.zeros(shape, bool)


def empty(labels: Labels, trials: int) -> Record:
    """Return a record without results, in which no trial is marked as done.

    Raises:
        ConfigError: If its arrays do not fit into memory.
    """
    shape = (*map(len, labels.values()), trials)
    try:
        return Record((), dict(labels), all_false(shape), blank((0, *shape), np.uint8))
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
        ConfigError: If there are no results, or they are of another version, or a file of the store
            is missing or damaged, one of the arrays of saved trials included.
    """
    path = Path(path) / "results.zarr" if (Path(path) / "results.zarr").exists() else Path(path)
    return _loaded(_opened(path, "r"), path)


def cut_off(path: Path) -> bool:
    """Return whether a sweep was killed while creating this store, which then holds no results."""
    made = {p.name for p in path.iterdir() if not p.name.endswith(".partial")} if path.is_dir() else {""}
    return made <= {"zarr.json", _DONE} and ("zarr.json" not in made or not _attributes(_opened(path, "r", ())))


def _opened(path: Path, mode: Any, needed: Collection[str] = ("labels", "identity")) -> zarr.Group:
    if not (path / "zarr.json").is_file():
        raise ConfigError(f"{path} holds no results of a sweep; choose another folder")
    with _undamaged(path):
        plain_files(path)
        root, held = zarr.open_group(str(path), mode=mode), group_attributes(path, {"format": FORMAT})
    if needed and (held.get("format") != FORMAT or not set(needed) <= set(held)):
        raise ConfigError(
            f"{path} was not written by a sweep of this version of torchsar (its layout is {held.get('format')}, not "
            f"{FORMAT}); choose another folder, or move it"
        )
    return root


@contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    """Convert an error due to a missing or damaged file to one sentence."""
    try:
        yield
    except Exception as error:  # zarr raises errors of many kinds
        text = f"{type(error).__name__}: {one_line(error)}"
        raise ConfigError(
            f"{path} is damaged ({text[:200]}); restore it from a copy, or start again in another folder"
        ) from error


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert an error of the file system to one sentence."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be written ({error.strerror or error}), but finished trials are kept; go on with "
            "--resume once the folder can be written"
        ) from error


def _loaded(root: zarr.Group, path: Path) -> Record:
    """Read the trials on disk that are marked as done.

    Raises:
        ConfigError: If files are missing or damaged.
    """
    with _undamaged(path):
        held = _attributes(root)
        missing = [name for name in (_DONE, *held.get("arrays", [])) if name not in root]
        if missing:
            raise ValueError(f"{missing[0]!r} is missing")
        marks = {"points": {}, _SAVED: {}, "arrays": {}, **group_attributes(path / _DONE)}
        record = _read(root, held, marks["points"])
        coordinates = {name: np.array(values) for name, values in _coordinates(record).items()}
        whole = coordinates | {name: variable[0] for name, variable in record.variables().items()}
        for name, (known, rest) in marks["arrays"].items():
            shape, now = array_metadata(path / name)
            # an array has its earlier shape if the sweep was killed while its arrays were enlarged
            if now != rest or shape not in (known, list(whole[name].shape)):
                raise ValueError(f"the metadata of {name!r} differ from their checksum")
            array: Any = root[name]
            if name in coordinates and list(array[: known[0]]) != list(whole[name][: known[0]]):
                raise ValueError(f"the coordinate {name!r} does not hold its values")
        for place, known in marks[_SAVED].items():
            if _of_saved(path, place) != known:
                raise ValueError(f"the saved arrays {place} differ from their checksum")
        return record


def _read(root: zarr.Group, held: Mapping[str, Any], marks: Mapping[str, Any]) -> Record:
    record = empty({name: tuple(labels) for name, labels in held["labels"].items()}, held["trials"])
    points = {index: tuple(map(int, filter(None, index.split(",")))) for index in marks}
    for index, point in points.items():
        for first, last in marks[index]["spans"]:
            record.done[(*point, slice(first, last))] = True
    record.algorithms = tuple(held.get("algorithms", ()))
    record.outcome = blank((len(record.algorithms), *record.done.shape), np.uint8)
    for name in held.get("arrays", ()):
        array: Any = root[name]
        about = _attributes(array)
        if about["kind"] == OUTCOME:
            target = record.outcome
        elif about["kind"] == "metric":
            target = record.metrics.setdefault(name, record.blank())
        else:
            target = record.bounds.setdefault(about["bound_of"], {}).setdefault(about["bound"], record.blank(False))
        # the array is smaller if the sweep was killed while its arrays were enlarged
        part = tuple(map(slice, array.shape))
        target[part] = np.where(record.done[part[-record.done.ndim :]], np.asarray(array[...]), target[part])
    wrong = next((point for index, point in points.items() if marks[index][SEAL] != record.checksum(point)), None)
    if wrong is not None:
        raise ValueError(f"the numbers of the point {record.labels_at(wrong)} differ from their checksum")
    record.about = _about(root)
    return record


def _coordinates(record: Record) -> dict[str, Sequence[Any]]:
    named = {"algorithm": record.algorithms} if record.algorithms else {}
    return {**record.labels, "trial": range(record.trials), **named}


def _of_saved(path: Path, place: str) -> str:
    """Checksum of all files of the saved arrays of a trial, and of those of the groups above."""
    folder = path / _SAVED / place
    above = [group / "zarr.json" for group in (folder.parents[1], folder.parent)]
    return files_checksum(path, [*above, *plain_files(folder)])


def _attributes(node: Any) -> dict[str, Any]:
    return node.attrs.asdict()


def _about(root: zarr.Group) -> dict[str, Any]:
    own = ("labels", "values", "trials", "algorithms", "arrays", "format", SEAL)
    return {key: value for key, value in _attributes(root).items() if key not in own}


def _spans(done: np.ndarray) -> list[list[int]]:
    """Ranges [first, last) in which a row of flags is True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], done, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2).tolist()


def _differing(
    path: Path, held: Mapping[str, Any], identity: Mapping[str, Any], values: Mapping[str, Any]
) -> list[str]:
    """Return the differences between the identity of a store and the present one as words; refuse
    other parameters and labels of another meaning.
    """
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
                    f"{short(was[name][label])}, and now it stands for {short(value)}; give the new value "
                    "another label"
                )
    return list(changes(held["identity"], identity))


def _values(grid: Grid) -> dict[str, dict[str, str]]:
    """Text of every value, by parameter and label."""
    return {p.name: {str(label): canonical(value) for label, value in zip(p.labels, p.values)} for p in grid.parameters}


def _plain(identity: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(canonical(identity))
