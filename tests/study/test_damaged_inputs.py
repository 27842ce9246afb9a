"""Damaged configs, recordings, folders and stores: each gives one sentence and loses nothing.

Many more than the test has time for: python -m tests.study.test_damaged_inputs 300 SEED
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import os
import random
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tests.study.tiny import TINY
from torchsar.cli import main
from torchsar.study.commands import run, sweep, trade

SMALL = {**TINY, "world": {**TINY["world"], "lines": 48, "samples": 64, "beam": {"kind": "dwell", "dwell_s": 0.05}}}
SMALL["radar"] = {**TINY["radar"], "pulse": {"bandwidth_hz": 40e6, "duration_s": 3e-7}}
SWEPT = {**SMALL, "sweep": {"world.noise.snr_db": [10.0, 20.0], "trials": 2}}
STRANGE: list[Any] = [
    *(None, "", " ", "x" * 400, "a\nb", "a/b", "../x", "zarr.json", "nan", "1:30", "auto", "é" * 100, "\x85"),
    *(-1, 0, 1, 2**63, -(2**63), 10**30, 1.5, 1e308, -1e308, 1e-308, 1e999, True, False),
    *(
        [],
        {},
        [[]],
        [None],
        [1, "a"],
        {"a": {"b": 1}},
        {"": 1},
        {"kind": "points"},
        {"stage": "omega_k"},
        [1e308, -1e308],
    ),
]


class Spot:
    """A folder with configs, earlier results of commands, a recording, and files of a user."""

    def __init__(self, path: Path) -> None:
        self.path = path
        for name, tree in (("run", SMALL), ("sweep", SWEPT)):
            (path / f"{name}.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
            status, said = command(name, path / f"{name}.yaml", "--out", path / name)
            assert status == 0, said
            (path / name / "notes.txt").write_text("mine")
        made = np.random.default_rng(0).normal(size=(96, 160, 2)).astype(np.float32)
        known = {"fs_hz": 50e6, "prf_hz": 400.0, "f0_hz": 3.2e9, "chirp_rate_hz_s": 80e12, "pulse_s": 0.5e-6}
        np.savez(path / "data.npz", iq=made, slant_range_cell1_m=4000.0, v_eff_m_s=120.0, **known)
        stages = {"recommended": {"stages": {"focus": {"stage": "omega_k"}}}}
        recorded = {"title": "recorded", "processor": stages, "data": {"file": "DATA"}}
        (path / "recorded.yaml").write_text(yaml.safe_dump(recorded).replace("DATA", str(path / "data.npz")))


def files_of(out: Path) -> dict[str, bytes]:
    found = {path.relative_to(out).as_posix(): path for path in sorted(out.rglob("*")) if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if not name.endswith(".torchsar/lock")}


def command(*words: object) -> tuple[int, str]:
    """Exit status and text of a command line, without pictures, which take longest."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:
            status = end.code
    return status, said.getvalue()


# --- damages: each changes files of a copy of the folder, and returns the command line to try
# --------------------------------------------------------------------------------------------------


def bytes_changed(path: Path, source: random.Random) -> None:
    data = bytearray(path.read_bytes())
    kind = source.choice(["bit", "bits", "cut", "zeros", "doubled", "empty", "noise"])
    if kind in ("bit", "bits"):
        for _ in range(1 if kind == "bit" else 20):
            data[source.randrange(len(data))] ^= 1 << source.randrange(8)
    at, more = source.randrange(len(data)), source.randrange(1, 200)
    changed = {"cut": data[:at], "zeros": data[:at] + bytes(more) + data[at + more :], "doubled": data[:at] + data}
    changed |= {"empty": bytearray(), "noise": bytearray(source.randbytes(len(data)))}
    damaged = bytes(changed.get(kind, data))
    path.write_bytes(damaged if damaged != path.read_bytes() else damaged + b"\0")


def config_bytes(spot: Spot, source: random.Random) -> list[object]:
    name = source.choice(["run", "sweep"])
    bytes_changed(spot.path / f"{name}.yaml", source)
    return [name, spot.path / f"{name}.yaml", "--out", spot.path / name, *(["--resume"] if name == "sweep" else [])]


def config_value(spot: Spot, source: random.Random) -> list[object]:
    """A value replaced, removed or added somewhere in the tree."""
    name = source.choice(["run", "sweep"])
    tree: Any = json.loads(json.dumps(SMALL if name == "run" else SWEPT))
    inner, key = tree, source.choice(list(tree))
    while isinstance(inner[key], (dict, list)) and inner[key] and source.random() < 0.85:
        inner = inner[key]
        key = source.choice(list(inner) if isinstance(inner, dict) else range(len(inner)))
    kind = source.random()
    if kind < 0.15:
        del inner[key]
    elif kind < 0.3 and isinstance(inner, dict):
        inner[source.choice(["", "x" * 400, "zarr.json", "a/b", "__x", "a\tb", "é", "stages", "kind"])] = inner[key]
    else:
        inner[key] = source.choice(STRANGE)
    (spot.path / f"{name}.yaml").write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return [name, spot.path / f"{name}.yaml", "--out", spot.path / name, *(["--resume"] if name == "sweep" else [])]


def words(spot: Spot, source: random.Random) -> list[object]:
    key = source.choice(["seed", "radar.prf_hz", "world.noise.snr_db", "processor.x.stages.y", "cases.a", "", "a..b"])
    value = source.choice(
        ["[" * 300, "{a: 1", "'", "&a [*a]", "!!python/name:os.x", "1:30", "\udcff", "a\0b", "*b", "\t"]
    )
    out = source.choice([spot.path / "run", "\udc80", "a\0b", "x" * 5000, "/proc/x", spot.path / "run.yaml"])
    return ["run", spot.path / "run.yaml", f"{key}={value}", "--out", out]


def recording(spot: Spot, source: random.Random) -> list[object]:
    bytes_changed(spot.path / "data.npz", source)
    return ["run", spot.path / "recorded.yaml", "--out", spot.path / "recorded"]


def state(spot: Spot, source: random.Random) -> list[object]:
    """Files of the program in a result folder, or files in its way."""
    name = source.choice(["run", "sweep"])
    out, extra = spot.path / name, ["--resume"] if name == "sweep" else []
    kind = source.choice(["manifest", "journal", "link", "file", "folder"])
    if kind == "manifest":
        bytes_changed(out / ".torchsar" / "manifest.json", source)
    elif kind == "journal":
        shutil.copy(out / ".torchsar" / "manifest.json", out / ".torchsar" / "journal.json")
        bytes_changed(out / ".torchsar" / "journal.json", source)
    elif kind == "link":
        (out / "report.html").unlink()
        (out / "report.html").symlink_to(out / "notes.txt")
    elif kind == "file":
        bytes_changed(out / source.choice(["report.html", "config.yaml"]), source)
    else:
        (out / "report.html").unlink()
        (out / "report.html").mkdir()
        (out / "report.html" / "mine").write_text("mine")
    return [name, spot.path / f"{name}.yaml", "--out", out, *extra]


def store(spot: Spot, source: random.Random) -> list[object]:
    root = spot.path / "sweep" / "results.zarr"
    path = source.choice(sorted(path for path in root.rglob("*") if path.is_file()))
    if source.random() < 0.3:
        path.unlink()
    else:
        bytes_changed(path, source)
    return ["sweep", spot.path / "sweep.yaml", "--out", spot.path / "sweep", "--resume", "sweep.trials=3"]


DAMAGES: list[Callable[[Spot, random.Random], list[object]]] = [
    config_value,
    config_bytes,
    words,
    recording,
    state,
    store,
]


def tried(spot: Spot, damage: Callable, source: random.Random) -> str:
    """Damage a copy of the folder, run a command on it, and check what it says and leaves."""
    with tempfile.TemporaryDirectory(dir=spot.path.parent) as folder:
        copied = object.__new__(Spot)
        copied.path = shutil.copytree(spot.path, Path(folder) / "spot", symlinks=True)
        recorded = copied.path / "recorded.yaml"
        recorded.write_text(recorded.read_text().replace(str(spot.path), str(copied.path)))
        given = damage(copied, source)
        before, here = files_of(copied.path), os.getcwd()
        os.chdir(copied.path)
        try:
            status, said = command(*given)
        finally:
            os.chdir(here)
        lines = [line for line in said.splitlines() if "warning:" not in line]
        assert status in (0, 2), (status, given, said)
        assert "Traceback" not in said, (given, said)
        if status == 2:
            after = files_of(copied.path)
            assert after == before, (given, said, [name for name in before if before[name] != after.get(name)])
            assert lines[-1].startswith("torchsar: ") and len(lines[-1]) < 2500, (given, said)
        else:
            assert all((copied.path / name / "notes.txt").read_text() == "mine" for name in ("run", "sweep"))
        if damage is store:
            assert status == 2, given
        return f"{damage.__name__} {status} {lines[-1][-150:]}"


@pytest.fixture(scope="module")
def spot(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((run, "draw_all"), (sweep, "draw_sweep"), (trade, "draw_all")):
            patch.setattr(module, name, lambda *_, **__: [], raising=False)
        patch.setattr("torchsar.cli._log_to_stderr", contextlib.nullcontext)
        torch.set_num_threads(1)
        path = tmp_path_factory.mktemp("damaged") / "spot"
        path.mkdir()
        yield Spot(path)


@pytest.mark.parametrize("damage", DAMAGES, ids=[damage.__name__ for damage in DAMAGES])
def test_damaged_inputs_are_one_sentence(damage: Callable, spot: Spot) -> None:
    source = random.Random(damage.__name__)
    for _ in range(3):
        tried(spot, damage, source)


if __name__ == "__main__":
    count, seed = int(sys.argv[1]), int(sys.argv[2])
    torch.set_num_threads(1)
    run.draw_all = sweep.draw_sweep = lambda *_, **__: []
    chosen, ends, bad = random.Random(seed), collections.Counter(), 0
    with tempfile.TemporaryDirectory() as base:
        (Path(base) / "spot").mkdir()
        whole = Spot(Path(base) / "spot")
        for index in range(count):
            one = DAMAGES[index % len(DAMAGES)]
            try:
                line = tried(whole, one, chosen)
                ends[" ".join(line.split()[:2])] += 1
            except Exception as error:
                bad += 1
                line = f"{one.__name__} BAD {type(error).__name__}: {str(error)[:1500]}"
            print(index, line.encode("utf-8", "replace").decode(), flush=True)
    print(f"{count} damaged inputs, seed {seed}: {bad} bad, {dict(ends)}")
