"""Simulated pairs of recording and truth as an iterable."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import torch

from torchsar.core import Draws, Recording, Truth
from torchsar.echo.stripmap import Impairment, simulate
from torchsar.radar import StripmapRadar
from torchsar.scene import StripmapWorld


@dataclass(frozen=True)
class SimulatedPairs:
    """Iterable over batches of trials of one world, for training and for tests over many scenes.

    Batch b holds the trials b * batch to (b + 1) * batch - 1 of the seed. Every trial draws its own
    scene, phases, noise and impairments, and is the same in any batch size. Each item is a
    Recording and its Truth.

    Args:
        radar: Radar parameters.
        world: World whose parameters are numbers that hold for all trials, not tensors with one
            value per trial.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        seed: Seed of the random draws.
        count: Number of trials in all.
        batch: Number of trials in a batch; the last batch may be smaller.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recordings.
        device: Device of the recordings.
    """

    radar: StripmapRadar
    world: StripmapWorld
    n_pulse: int
    n_range: int
    seed: int
    count: int
    batch: int = 1
    impairments: Mapping[str, Impairment] = field(default_factory=dict)
    dtype: torch.dtype = torch.complex64
    device: torch.device | str | None = None

    def __len__(self) -> int:
        return -(-self.count // self.batch)

    def __iter__(self) -> Iterator[tuple[Recording, Truth]]:
        for first in range(0, self.count, self.batch):
            draws = Draws(self.seed, trials=range(first, min(first + self.batch, self.count)))
            yield simulate(
                self.radar, self.world, self.n_pulse, self.n_range, draws, self.impairments, self.dtype, self.device
            )
