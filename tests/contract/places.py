"""Devices on which the contract is checked: the pretended one, and a GPU where there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from tests.contract.pretended import DEVICE, Counts, Pretended, pretended_device, to_device, to_host
from torchsar.core import nufft


@dataclass(frozen=True)
class Place:
    """A device, and how values get there and back.

    Args:
        device: The device.
        put: Puts the tensors of a value, which may be nested, on the device.
        take: Takes them from there.
        holds: Whether a tensor lies there.
        counted: A block in which the device is there, with the counts of what is done on it. A real
            device counts nothing.
        tolerance: Least relative error that is allowed. A real device rounds differently from the
            CPU, and ill-conditioned results show it.
    """

    device: torch.device
    put: Callable[[Any], Any]
    take: Callable[[Any], Any]
    holds: Callable[[Tensor], bool]
    counted: Callable[[], AbstractContextManager[Counts]]
    tolerance: float

    @property
    def real(self) -> bool:
        return self.device != DEVICE


@contextmanager
def _pretended() -> Iterator[Counts]:
    # without what earlier runs have left there
    nufft._polynomials.cache_clear()
    with pretended_device() as counts:
        yield counts
    nufft._polynomials.cache_clear()


@contextmanager
def _real() -> Iterator[Counts]:
    yield Counts()


def _moved(x: Any, device: str) -> Any:
    return tree_map(lambda leaf: leaf.to(device) if isinstance(leaf, Tensor) else leaf, x)


PLACES = {"pretended": Place(DEVICE, to_device, to_host, lambda x: isinstance(x, Pretended), _pretended, 0.0)}
if torch.cuda.is_available():
    PLACES["cuda"] = Place(
        torch.device("cuda"), lambda x: _moved(x, "cuda"), lambda x: _moved(x, "cpu"), lambda x: x.is_cuda, _real, 1e-5
    )
