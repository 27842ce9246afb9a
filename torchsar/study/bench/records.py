"""Records of benchmarks: their version, the frozen scenes, and files to hand in."""

from __future__ import annotations

import hashlib
import importlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchsar
from torchsar.study.bench.entrant import entrant, loaded
from torchsar.study.bench.frame import BLOCK, Bench, Entry, in_worlds_of, scored
from torchsar.study.settings.errors import ConfigError

VERSION = "2026.2"
HERE = Path(__file__).parent
# where the benchmarks are
PLACES = {
    "autofocus": "methods:BENCH",
    "alignment": "profiles:BENCH",
    "doppler": "strips:BENCH",
    "velocity": "channels:VELOCITY",
    "radial": "ladars:BENCH",
    "rotation": "rotations:BENCH",
    "repair": "repairs:BENCH",
    "channels": "channels:BENCH",
    "path": "paths:BENCH",
}
Record = dict[str, Any]


def bench(name: str) -> Bench:
    """The benchmark of a name."""
    if name not in PLACES:
        raise ConfigError(f"there is no benchmark {name!r}; choose one of {', '.join(PLACES)}")
    module, _, place = PLACES[name].partition(":")
    return getattr(importlib.import_module(f"torchsar.study.bench.{module}"), place)


def checksum(name: str) -> str:
    """The beginning of the SHA-256 of what is frozen of a benchmark."""
    table = json.loads((HERE / "frozen.json").read_text(encoding="utf-8"))[name]
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:12]


def score(
    name: str,
    methods: Mapping[str, Any] | None = None,
    *,
    trials: int = 20,
    most: int = 0,
    small: bool = False,
    draw: int = 0,
    batch: int = BLOCK,
    say: Callable[[str, int], object] = lambda *_: None,
) -> Record:
    """Score methods on a benchmark.

    Args:
        name: Name of the benchmark.
        methods: Classes, modules or functions by name, see `entrant`; all built-in ones by default.
            None in place of one means the built-in one of this name. A name "BUILT-IN=mine" takes
            the worlds of a built-in method, and not those of the first one.
        trials: Number of trials in a world.
        most: Number of trials in worlds in which a method was sure and wrong, if it is larger.
        small: Whether to try every fourth world only, with at most 6 trials.
        draw: Number of other scenes than the frozen ones, from 1 on.
        batch: Largest number of trials that a method is given at once.
        say: Function that is told each world before it is tried, and their number.

    Returns:
        The record, which JSON can hold.
    """
    one = bench(name)
    entries = entries_of(one, methods)
    found = scored(one, entries, trials, most=most, small=small, draw=draw, batch=batch, say=say)
    return {
        "bench": name,
        "version": VERSION,
        "checksum": checksum(name),
        "trials": trials,
        "most": most,
        "small": small,
        "draw": draw,
        "made": {
            "torchsar-lab": torchsar.__version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "machine": f"{platform.system()} {platform.machine()}",
            "threads": torch.get_num_threads(),
        },
        "methods": found,
    }


def entries_of(one: Bench, methods: Mapping[str, Any] | None = None) -> list[Entry]:
    """Methods as entries of a benchmark, see `score`."""
    known = {entry.name: entry for entry in one.entries()}
    first = next(iter(known.values()))
    entries: list[Entry] = []
    for label, method in (dict.fromkeys(known) if methods is None else methods).items():
        if method is None and label not in known:
            module, colon, _ = label.rpartition("=")[2].partition(":")
            missing = f"there is no {module}.py in the working folder; " if colon and module not in known else ""
            told = f"{missing}give package.module:Name, or one of {', '.join(known)}"
            raise ConfigError(f"{label!r} is no method of {one.name}: {told}")
        if method is None:
            entries.append(known[label])
        else:
            like = known.get(label.partition("=")[0], first)
            entries.append(in_worlds_of(like, label, entrant(method, like.judged[0].name, one.per_pulse)))
    return entries


def recorded(name: str) -> Record:
    """The record of the package."""
    return read(HERE / "recorded" / f"{name}.json")


def read(path: Path) -> Record:
    """Read a record.

    Raises:
        ConfigError: If the file is none, or of another version.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        version, mine = (record["version"], record["checksum"]), (VERSION, checksum(record["bench"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not a record of torchsar bench") from error
    if version != mine:
        raise ConfigError(f"{path} is a record of version {version}, and this program measures {mine}; score again")
    return record


def same_scenes(records: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse records by name that are not of the same scenes, with what differs."""
    first, *others = records.items()
    for other in others:
        (name, mine), (beside, theirs) = sorted((first, other), key=lambda one: (not one[1]["small"], -one[1]["draw"]))
        if mine["bench"] != theirs["bench"]:
            raise ConfigError(f"{name} is of the benchmark {mine['bench']}, and {beside} of {theirs['bench']}")
        if mine["small"] != theirs["small"]:
            raise ConfigError(f"{name} was made with --small, and {beside} was not; run it without")
        if mine["draw"] != theirs["draw"]:
            told = f"{name} was made with --draw {mine['draw']}, and {beside} with --draw {theirs['draw']}"
            raise ConfigError(f"{told}; run both with the same")


def together(records: Sequence[Record]) -> Record:
    """Join the methods of records, of which the later ones replace methods of the same name."""
    same_scenes({f"record {i} ({', '.join(list(one['methods'])[:3])})": one for i, one in enumerate(records, 1)})
    methods = {name: method for record in records for name, method in record["methods"].items()}
    return {**records[0], "methods": methods}


def write(path: Path, record: Record) -> None:
    """Write a record, one row per line, whole or not at all."""
    methods = ",\n".join(f"{json.dumps(name)}: {_method(method)}" for name, method in record["methods"].items())
    head = json.dumps({**record, "methods": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(head.replace('"methods": null', f'"methods": {{\n{methods}\n}}') + "\n", encoding="utf-8")
    beside.replace(path)


def _method(method: Mapping[str, Any]) -> str:
    rest = json.dumps({key: value for key, value in method.items() if key != "worlds"})
    rows = ",\n".join(f"  {json.dumps(world)}: {json.dumps(numbers)}" for world, numbers in method["worlds"].items())
    return f'{rest[:-1]}, "worlds": {{\n{rows}}}}}'


def methods_of(words: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Divide words of the command line into methods by name and names of records."""
    files = [word for word in words if word == "recorded" or word.endswith(".json")]
    rest = [word for word in words if word not in files]
    # a setting of a built-in method has a colon, too, but no dot before it
    theirs = {word: loaded(place) if _is_place(place := word.rpartition("=")[2]) else None for word in rest}
    return theirs, files


def _is_place(word: str) -> bool:
    module, colon, _ = word.partition(":")
    return "." in module or (bool(colon) and (Path.cwd() / f"{module}.py").is_file())
