"""Shared fixtures."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import torchsar

SHARED = Path(os.environ.get("TORCHSAR_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Modules and tests stay until the end: no pass of the garbage collector looks at them, which
    took as long as the rest of the collection, and grew with every import of a test.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Runs of the system geo_ocean are slow: they take as long as those of the six others."""
    for item in items:
        if "geo_ocean" in item.name.partition("[")[2]:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True, scope="session")
def _process() -> None:
    torchsar.keep_freed_memory()  # as the commands do
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(min(2, os.cpu_count() or 1))


@pytest.fixture(autouse=True)
def _same_numbers() -> None:
    """Numbers that a test draws without a generator do not depend on the tests before it.

    `torch.manual_seed` would note a stack of calls for every kind of device that is not in use.
    """
    torch.default_generator.manual_seed(1)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(1)


@pytest.fixture(scope="session")
def recorded() -> Callable[[str], Path]:
    """Path of a recorded data set by file name; skips where the recordings are not at hand."""

    def find(name: str) -> Path:
        path = SHARED / name
        if not path.is_file():
            pytest.skip(f"recorded data set {name} is not at hand (set TORCHSAR_DATA to its folder)")
        return path

    return find


@pytest.fixture(scope="module")
def blank_pictures() -> Iterator[None]:
    """Figures are made, but written as blank pictures: drawing takes two thirds of a small run.

    Those of every system are drawn by test_frame.py, those of sweeps by test_sweep_report.py.
    """
    from matplotlib.image import imsave

    from torchsar import plot

    def save(figure: object, path: Path, **_: object) -> None:
        assert figure
        imsave(path, np.full((4, 4, 4), 255, np.uint8))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "save", save)
        yield
