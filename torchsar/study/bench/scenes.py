"""Scenes of a benchmark as a data set, for training and validation."""

from __future__ import annotations

import warnings

from torch import Tensor
from torch.utils.data import Dataset

from torchsar.study.bench.frame import BLOCK, SPLITS, samples
from torchsar.study.bench.records import bench


class Scenes(Dataset[tuple[Tensor, Tensor]]):
    """Batches of data and true values, each of one world that has a truth, the worlds in turn.

    The scenes are none of those that are scored, which the command alone uses. Give a DataLoader
    `batch_size=None`. Lost pulses have the phase NaN.

    Args:
        name: Name of the benchmark.
        split: "train" or "validation".
        length: Number of batches.
        batch: Trials in a batch, at most 25.
    """

    def __init__(self, name: str, split: str = "train", length: int = 1000, batch: int = BLOCK) -> None:
        if split not in ("train", "validation"):
            raise ValueError(f"Scenes has the splits 'train' and 'validation', got {split!r}; `torchsar bench` tests")
        if not 1 <= batch <= BLOCK:
            raise ValueError(f"a batch of Scenes has 1 to {BLOCK} trials, got {batch}")
        entry = bench(name).entries()[0]
        self.value = entry.judged[0].name
        drawn = ((world, world.draw(1, SPLITS[split]).truth or {}) for world in entry.worlds)
        self.worlds = [world for world, truth in drawn if self.value in truth]
        self.split, self.length, self.batch = split, length, batch

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        if not 0 <= index < self.length:
            raise IndexError(index)
        world = self.worlds[index % len(self.worlds)]
        block = index // len(self.worlds)
        if self.split == "validation":  # it ends where training begins
            block %= (SPLITS["train"] - SPLITS["validation"]) // BLOCK
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = world.draw(self.batch, SPLITS[self.split] + BLOCK * block)
        return samples(found.data), (found.truth or {})[self.value]
