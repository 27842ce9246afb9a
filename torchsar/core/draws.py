"""Random numbers with addresses: (seed, purpose, case, trial)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor


def generator_at(*address: str | int) -> np.random.Generator:
    """The source of random numbers that lives at this address."""
    return np.random.Generator(
        np.random.Philox(key=int.from_bytes(hashlib.blake2b(repr(address).encode(), digest_size=16).digest(), "big"))
    )


@dataclass(frozen=True)
class Draws:
    """A source whose every draw depends on its address alone, never on what was drawn before, on
    chunking or on the device.

    seed: of the whole study. case: any text or number that names a parameter point (a hash of its
    parameters, so that a growing grid moves no seed), or a tuple of them, one per trial, where a
    batch holds several points. trials: indices of the trials of this chunk, which become the
    leading dim; None draws one unbatched trial, equal to trial 0. Draws are made in float64 on the
    host and then cast, so that complex64 and complex128, CPU and GPU see the same noise. Raises
    ValueError where cases and trials disagree in number.
    """

    seed: int
    case: str | int | tuple[str | int, ...] = 0
    trials: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.case, tuple) and (self.trials is None or len(self.case) != len(self.trials)):
            raise ValueError(
                f"draws for {len(self.case)} cases need as many trials, got "
                f"{None if self.trials is None else len(self.trials)}; name one case for all of them "
                "or one for each"
            )

    def for_trials(self, trials: Sequence[int]) -> Draws:
        """The same source for other trials."""
        return replace(self, trials=trials)

    def part(self, name: str) -> Draws:
        """An independent source for a named part of the world, so that two patches of one kind
        differ.
        """
        return replace(
            self,
            case=tuple(f"{case}/{name}" for case in self.case)
            if isinstance(self.case, tuple)
            else f"{self.case}/{name}",
        )

    def _generators(self, purpose: str) -> list[np.random.Generator]:
        trials = self.trials if self.trials is not None else [0]
        cases = self.case if isinstance(self.case, tuple) else [self.case] * len(trials)
        return [generator_at(self.seed, purpose, case, trial) for case, trial in zip(cases, trials, strict=True)]

    def _stack(self, arrays: list[np.ndarray], dtype: torch.dtype, device: torch.device | str | None) -> Tensor:
        x = torch.from_numpy(np.stack(arrays))
        return (x if self.trials is not None else x[0]).to(device=device, dtype=dtype)

    def normal(
        self,
        purpose: str,
        shape: Sequence[int] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Standard normal numbers, (trials, *shape); for a complex dtype circular with unit mean
        square.
        """
        if dtype.is_complex:
            parts = self._stack(
                [g.standard_normal((*shape, 2)) for g in self._generators(purpose)], torch.float64, None
            )
            return (torch.view_as_complex(parts) / 2**0.5).to(device=device, dtype=dtype)
        return self._stack(
            [np.asarray(g.standard_normal(tuple(shape))) for g in self._generators(purpose)], dtype, device
        )

    def uniform(
        self,
        purpose: str,
        shape: Sequence[int] = (),
        low: float = 0.0,
        high: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Uniform numbers in low..high, (trials, *shape)."""
        return self._stack(
            [np.asarray(g.uniform(low, high, tuple(shape))) for g in self._generators(purpose)], dtype, device
        )

    def subset(self, purpose: str, n: int, k: int, device: torch.device | str | None = None) -> Tensor:
        """k of the numbers 0..n-1 without repetition, rising, (trials, k) int64."""
        return self._stack([np.sort(g.permutation(n)[:k]) for g in self._generators(purpose)], torch.int64, device)
