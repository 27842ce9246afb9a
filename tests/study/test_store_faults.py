"""A sweep that dies at any write of its store: what is marked done is there, and resuming gives
what an undisturbed sweep gives.
"""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from zarr.storage import LocalStore

from tests.study import toy
from torchsar.study.montecarlo import Record, read_sweep
from torchsar.study.montecarlo import store as store_module
from torchsar.study.output import folder as folder_module

SMALL = {"grid": {"snr_db": [0.0, 20.0], "law": ["flat"]}, "trials": 8, "chunk": 6, "save": [1], "resume": True}
LARGE = {**SMALL, "grid": {"snr_db": [0.0, 10.0, 20.0], "law": ["flat", "tilted"]}, "trials": 12}
BEFORE_LABELS = 7  # writes after which a new store says whose it is


class Killed(BaseException):
    """The process dies here."""


@pytest.fixture
def writes(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Counts what a store writes and removes; nothing is written from number `end` on, which leaves
    half a file.
    """
    state: dict[str, float] = {"number": 0, "end": float("inf")}

    def guarded(name: str):
        original = getattr(LocalStore, name)

        async def write(self: LocalStore, key: str, *args: object) -> None:
            number, state["number"] = state["number"], state["number"] + 1
            if number >= state["end"]:
                if number == state["end"] and name == "set" and (self.root / key).parent.is_dir():
                    (self.root / key).with_suffix(".0.partial").write_bytes(b"{")
                raise Killed(f"{name} {key}")
            await original(self, key, *args)

        return write

    for name in ("set", "set_if_not_exists", "delete", "delete_dir"):
        monkeypatch.setattr(LocalStore, name, guarded(name))
    # every chunk is written at once
    monkeypatch.setattr(store_module.Store, "due", property(lambda store: True))
    # the lock of a dead process is gone, that of an exception is not
    monkeypatch.setattr(folder_module, "fcntl", None)
    return state


def held_rows_are(held: Record, reference: Record) -> None:
    for index in np.argwhere(held.done):
        position = reference.index_of({name: known[i] for (name, known), i in zip(held.labels.items(), index)})
        for name, values in held.metrics.items():
            np.testing.assert_array_equal(
                values[(slice(None), *index)], reference.metrics[name][(slice(None), *position, index[-1])]
            )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:unclosed file")
@pytest.mark.parametrize(
    "before, options, first, step", [(None, SMALL, BEFORE_LABELS, 11), (SMALL, LARGE, 0, 29)], ids=["new", "growing"]
)
def test_dying_at_any_write_loses_nothing_and_changes_nothing(
    writes: dict, tmp_path: Path, before: dict | None, options: dict, first: int, step: int
) -> None:
    known = 0 if before is None else int(toy.run(tmp_path / "before", **before).done.sum())
    (tmp_path / "before").mkdir(exist_ok=True)
    reference = toy.run(shutil.copytree(tmp_path / "before", tmp_path / "undisturbed"), **options)
    end, died = first, True
    while died:
        out = shutil.copytree(tmp_path / "before", tmp_path / str(end))
        writes["end"] = float("inf")
        writes.update(number=0, end=end)
        try:
            toy.run(out, **options)
            died = False
        except Killed:
            pass
        writes["end"] = float("inf")
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Object at")
            held = read_sweep(out)
        assert held.done.sum() >= known
        held_rows_are(held, reference)
        again = toy.run(out, **options)
        np.testing.assert_array_equal(again.done, reference.done)
        held_rows_are(again, reference)
        held_rows_are(read_sweep(out), reference)
        end += step
    assert end > first + 5 * step


@pytest.mark.filterwarnings("ignore:unclosed file")
def test_dying_before_the_store_says_whose_it_is_begins_anew(writes: dict, tmp_path: Path) -> None:
    for end in range(BEFORE_LABELS):
        writes.update(number=0, end=end)
        with pytest.raises(Killed):
            toy.run(tmp_path / str(end), **SMALL)
        writes["end"] = float("inf")
        assert toy.run(tmp_path / str(end), **SMALL).done.all()


@pytest.mark.parametrize("left", [[], ["zarr.json"], ["zarr.json", "done"], ["zarr.0123.partial"]])
@pytest.mark.parametrize("resume", [True, False])
def test_a_store_that_was_killed_while_it_was_made_is_begun_anew(left: list[str], resume: bool, tmp_path: Path) -> None:
    store = tmp_path / "s" / "results.zarr"
    store.mkdir(parents=True)
    with folder_module.opened(tmp_path / "s", "sweep") as folder:
        folder.claim()
    for name in left:
        if name == "done":
            (store / name).mkdir()
        else:
            (store / name).write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}', encoding="utf-8")
    assert toy.run(tmp_path / "s", trials=3, resume=resume).done.all()
