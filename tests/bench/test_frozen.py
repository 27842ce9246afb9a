"""Scenes and scores are frozen by their version."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.bench.frozen import fingerprint, frozen, table
from torchsar.study.bench.records import PLACES, VERSION, bench, checksum

# checksum of each benchmark in each version: a changed scene or score needs another version
VERSIONS = {
    "2026.1": {
        "autofocus": "b68d99982081",
        "alignment": "31b3dc061dd8",
        "doppler": "f37d8ca9dfb7",
        "velocity": "4d35cc4596b8",
        "radial": "b0b91b789f43",
        "rotation": "d06ea4491fa6",
        "repair": "14cbcc11ddfb",
        "channels": "70c77c8adc13",
        "path": "daf62b495961",
    },
    "2026.2": {
        "autofocus": "b68d99982081",
        "alignment": "31b3dc061dd8",
        "doppler": "f37d8ca9dfb7",
        "velocity": "4d35cc4596b8",
        "radial": "b0b91b789f43",
        "rotation": "d06ea4491fa6",
        "repair": "14cbcc11ddfb",
        "channels": "70c77c8adc13",
        "path": "42965840b56a",
    },
}
SLOW = ("velocity", "repair", "channels")  # their scenes take seconds
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in PLACES]


def test_the_version_has_the_checksums_that_were_published() -> None:
    assert {name: checksum(name) for name in PLACES} == VERSIONS[VERSION], (
        "scenes or scores have changed: give records.VERSION another name, make the records again, and write the table "
        "by `python -m tests.bench.frozen BENCH`"
    )


@pytest.mark.parametrize("name", NAMES)
def test_scenes_and_scores_are_those_of_the_version(name: str) -> None:
    kept, found = table()[name], frozen(bench(name))
    assert set(found["worlds"]) == set(kept["worlds"])
    for world, numbers in found["worlds"].items():
        assert near(numbers, kept["worlds"][world]), (world, numbers, kept["worlds"][world])
    assert set(found["score"]) == set(kept["score"])
    assert all(near(value, kept["score"][key]) for key, value in found["score"].items()), found["score"]


def near(found: Any, recorded: Any) -> bool:
    """Whether numbers are equal but for the rounding of another machine."""
    if isinstance(found, list):
        return len(found) == len(recorded) and all(map(near, found, recorded))
    return found == recorded or abs(found - recorded) <= 1e-3 * max(1, abs(recorded))


def test_a_changed_scene_changes_the_fingerprint() -> None:
    world = next(w for w in bench("autofocus").entries()[0].worlds if w.label == "direct, 10 dB")
    x = world.blocks(1)[0].data.data
    assert not near(fingerprint(x), fingerprint(x + 0.02 * x.abs().mean() * torch.randn(x.shape)))
    assert not near(fingerprint(x), fingerprint(x.flip(-1)))
