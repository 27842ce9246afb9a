"""Worlds in which nothing can be found: noise, zeros, and noise that is strong in few places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.study.bench.frame import Batch, World

Source = Callable[[int, int], Tensor]


def white_noise(shape: Sequence[int]) -> Source:
    """Draw circular white noise (trial, *shape)."""
    return lambda trials, seed: Draws(seed, trials=range(trials)).normal("alone", tuple(shape), torch.complex64)


def silent(shape: Sequence[int]) -> Source:
    """Draw zeros (trial, *shape)."""
    return lambda trials, seed: torch.zeros(trials, *shape, dtype=torch.complex64)


def uneven(shape: Sequence[int], dim: int, most: int = 3) -> Source:
    """Draw white noise, 20 or 40 dB stronger in 1 to `most` places of a dimension of `shape`."""
    noise = white_noise(shape)

    def draw(trials: int, seed: int) -> Tensor:
        x = noise(trials, seed).movedim(dim, -1)
        order = Draws(seed, trials=range(trials)).uniform("audit.places", (x.shape[-1],)).argsort(-1).argsort(-1)
        number = torch.arange(seed, seed + trials)[:, None]
        level = torch.where(order <= number % most, 10.0 ** (1 + number // most % 2), 1.0)
        level = level.reshape(trials, *[1] * (x.ndim - 2), -1)
        return (x * level).movedim(-1, dim)

    return draw


def real(shape: Sequence[int]) -> Source:
    """Draw white noise (trial, *shape) whose imaginary part is zero."""
    noise = white_noise(shape)

    def draw(trials: int, seed: int) -> Tensor:
        x = noise(trials, seed).real
        return torch.complex(x, torch.zeros_like(x))

    return draw


def nothing(shape: Sequence[int], wrap: Callable[[Tensor], Any] = lambda x: x, **values: Any) -> list[World]:
    """Make the worlds in which nothing can be found, for data of this shape."""

    def of(draw: Source) -> Callable[[int, int], Batch]:
        def batch(trials: int, seed: int) -> Batch:
            x = draw(trials, seed)
            return Batch(wrap(x), None, {name: v(x) if callable(v) else v for name, v in values.items()})

        return batch

    def world(name: str, draw: Source) -> World:
        return World(name, of(draw), track="nothing to be found")

    return [
        world("noise", white_noise(shape)),
        world("zeros", silent(shape)),
        world("real noise", real(shape)),
        world("bright cells", uneven(shape, -1)),
        *([world("bright lines", uneven(shape, -2))] if len(shape) > 1 else []),
    ]


def unlit(worlds: Sequence[World]) -> list[World]:
    """Leave out bright cells, for methods that are right about a cell that stays bright."""
    return [world for world in worlds if world.name != "bright cells"]
