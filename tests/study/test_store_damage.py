"""Stores of sweeps that are damaged, and functions that change: nothing wrong is read, mixed or
announced.
"""

from __future__ import annotations

import random
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from torchsar.study.montecarlo import read_sweep, sweep
from torchsar.study.montecarlo.store import Store
from torchsar.study.settings.errors import ConfigError

GRID = {"a": [1.0, 2.0]}


def trial(parameters: dict, draws) -> dict:
    x = draws.normal("x", (2,)).mean(-1)
    found = {"error_m": x, "ok": x > -0.3}
    return {"m": found, "bounds": {"error_m": {"x": x.abs()}}, "saved": {"m": {"y": torch.zeros(len(x), 3)}}}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sweep") / "s"
    sweep(trial, GRID, trials=4, out=out, save=[1])
    return out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "s")


def resumed(out: Path) -> Any:
    return sweep(trial, GRID, trials=4, out=out, save=[1], resume=True)


def refused(out: Path, *uses: Callable[[Path], Any]) -> str:
    """The sentence that a reader gives, or a resumed sweep; the files are left as they are."""
    before = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    said = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for use in uses:
            with pytest.raises(ConfigError) as error:
                use(out)
            said.append(str(error.value))
    after = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    assert after == before and len(set(said)) == 1 and "\n" not in said[0]
    return said[0]


def files_of(out: Path) -> list[Path]:
    return sorted(path for path in (out / "results.zarr").rglob("*") if path.is_file())


def test_any_flipped_bit_is_found(out: Path) -> None:
    """One random bit in each file; all bits of one such store were tried once."""
    source = random.Random(16)
    for path in files_of(out):
        data = bytearray(whole := path.read_bytes())
        data[source.randrange(len(data))] ^= 1 << source.randrange(8)
        path.write_bytes(data)
        assert "is damaged (" in refused(out, read_sweep), path
        path.write_bytes(whole)
    assert read_sweep(out).done.all()


def test_any_missing_file_is_found(out: Path) -> None:
    for i, path in enumerate(files_of(out)):
        whole = path.read_bytes()
        path.unlink()
        said = refused(out, read_sweep, *([] if i % 4 else [resumed]))
        assert re.search("is damaged|holds no results", said), path
        path.write_bytes(whole)


def test_a_chunk_of_another_state_is_found(out: Path, tmp_path: Path) -> None:
    """Such a chunk has a right checksum of its own."""
    sweep(trial, GRID, trials=4, out=tmp_path / "other", seed=2)
    chunk = next(path for path in files_of(out) if {"error_m", "c"} <= set(path.parts))
    chunk.write_bytes((tmp_path / "other" / chunk.relative_to(out)).read_bytes())
    assert "the numbers of the point {'a': 1.0} differ from their checksum" in refused(out, read_sweep)


# --- the function
# --------------------------------------------------------------------------------------------------


def made_of(text: str, **scope: Any) -> Callable:
    exec(f"def trial(parameters, draws):\n    return {{'m': {text}}}", scope)
    return scope["trial"]


def test_a_changed_function_does_not_resume(tmp_path: Path) -> None:
    grid, out = {"a": [1.0]}, tmp_path / "s"
    sweep(made_of("draws.normal('x', ()) * 2"), grid, trials=2, out=out)
    with pytest.raises(ConfigError, match=r"trial function, .* trial.code was \w+ and is \w+; choose another folder"):
        sweep(made_of("draws.normal('x', ()) * 3"), grid, trials=4, out=out, resume=True)
    assert read_sweep(out).trials == 2
    assert sweep(made_of("draws.normal('x', ()) * 2"), grid, trials=4, out=out, resume=True).done.all()


def test_a_changed_value_of_a_function_is_named(tmp_path: Path) -> None:
    options: dict[str, Any] = {"grid": {"a": [1.0]}, "trials": 2, "out": tmp_path / "s", "resume": True}
    sweep(made_of("draws.normal('x', ()) * GAIN", GAIN=2), **options)
    with pytest.raises(ConfigError, match="trial.uses.GAIN was int 2 and is int 3"):
        sweep(made_of("draws.normal('x', ()) * GAIN", GAIN=3), **options)


def test_a_version_stands_for_the_function(tmp_path: Path) -> None:
    options: dict[str, Any] = {"grid": {"a": [1.0]}, "trials": 2, "out": tmp_path / "s", "resume": True}
    sweep(made_of("draws.normal('x', ()) * 2"), version="one", **options)
    assert sweep(made_of("draws.normal('x', ()) * 3"), version="one", **options).done.all()
    with pytest.raises(ConfigError, match="trial.version was one and is two"):
        sweep(made_of("draws.normal('x', ()) * 2"), version="two", **options)
    with pytest.raises(ConfigError, match=r"version must be a word or a whole number, got 1\.5"):
        sweep(made_of("1"), version=1.5, **options)  # type: ignore[arg-type]


# --- progress
# --------------------------------------------------------------------------------------------------


def test_only_what_is_written_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[tuple[int, int]] = []
    chunks = iter(range(100))

    class Counted:
        """A bar of the progress that compares what it counts with what is written."""

        n = 0

        def __enter__(self) -> Counted:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def update(self, count: int) -> None:
            self.n += count
            counts.append((self.n, int(read_sweep(tmp_path / "s").done.sum())))

        def set_description_str(self, text: str) -> None:
            pass

    monkeypatch.setattr(Store, "due", property(lambda store: next(chunks) % 3 == 2))
    monkeypatch.setattr("torchsar.study.montecarlo.loop.progress", lambda *_: Counted())
    sweep(trial, GRID, trials=12, chunk=2, out=tmp_path / "s")
    assert all(said == there for said, there in counts)
    assert sorted({said for said, _ in counts} - {0}) == [6, 12, 18, 24]


def test_results_are_written_every_few_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep(trial, GRID, trials=1, out=tmp_path / "s")
    now = 1000.0
    monkeypatch.setattr("torchsar.study.montecarlo.store.time.perf_counter", lambda: now)
    store = object.__new__(Store)
    store._last, store._pending = now, []
    for cost, waited, due in (
        (0.001, 0.1, False),
        (0.001, 0.3, True),
        (0.1, 3.9, False),
        (0.1, 4.1, True),
        (2.0, 19, False),
    ):
        store._cost, now = cost, 1000.0 + waited
        assert store.due == due, (cost, waited)
