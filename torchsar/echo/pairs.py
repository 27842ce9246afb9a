"""Simulated (Recording, Truth) pairs as an iterable, for training and for judging over many
scenes.
"""

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
    """Iterates over batches of trials of one world; batch b holds the trials b * batch ..

    (b + 1) * batch - 1 of `seed`.

    Every trial draws its own scene, phases, noise and impairment, and is the same in any batch
    size. count: trials in all; the last batch may be smaller. World values that are given per trial
    must be numbers here, as a batch holds any of the trials.
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
