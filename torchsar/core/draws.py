"""Reproducible random numbers that depend only on seed, purpose, case and trial."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from torchsar.core import numpy_random, torch_random

Source = Literal["numpy", "torch"]
_SOURCES = {"numpy": numpy_random, "torch": torch_random}


def generator_at(*address: str | int) -> np.random.Generator:
    """Return a random generator that is fixed by an address of texts and whole numbers.

    The address is hashed (BLAKE2b) to the key of a counter-based generator (Philox), so that equal
    addresses give equal numbers, and different addresses give independent numbers.

    Args:
        *address: Text and whole numbers, such as seed, purpose, case and trial.

    Returns:
        A generator at the beginning of its sequence.
    """
    return np.random.Generator(np.random.Philox(key=_key(*address)))


def _key(*address: str | int) -> int:
    """Hash of an address as a whole number of 128 bits."""
    return int.from_bytes(hashlib.blake2b(repr(address).encode(), digest_size=16).digest(), "big")


@dataclass(frozen=True)
class Draws:
    """Source of random numbers, each of which depends only on its address.

    >>> import torch
    >>> from torchsar import Draws
    >>> draws = Draws(seed=1, trials=range(3))
    >>> draws.normal("noise", (4, 5), torch.complex64).shape
    torch.Size([3, 4, 5])
    >>> bool((draws.for_trials([2]).uniform("phase") == draws.uniform("phase")[2]).all())
    True

    The address of a draw is (seed, purpose, case, trial), where the purpose is the name of the
    quantity that is drawn. A draw therefore does not depend on draws made before it, or on the
    division of trials into chunks; a repeated draw gives the same numbers.

    Args:
        seed: Seed of the whole study.
        case: Text or number that identifies a point in parameter space, such as a hash of its
            parameters, so that the point keeps its random numbers when further points are added to
            a sweep. A tuple has one case per trial, for a batch that holds several points.
        trials: Indices of the trials of this chunk, which become the leading dimension. None draws
            a single trial without that dimension, with the numbers of trial 0.
        source: "numpy" draws on the CPU with numpy's generator, in double precision, and copies the
            numbers to their device: all precisions and devices see the same noise, up to rounding.
            "torch" draws with a `torch.Generator` for each trial on the device and in the precision
            of the result. On a CPU, complex numbers take a quarter of the time in single precision,
            and 1.6 times as long in double precision. The numbers depend on the device, the
            precision, the shape and the version of torch. On a CPU, torch seeds a generator with 32
            bits, so that two of n trials share their numbers with a probability of about
            n**2 / 2**33, and no normal number of single precision lies beyond 5.8 standard
            deviations. Within `torch.func.vmap` it needs `randomness="same"`.

    Raises:
        TypeError: If `trials` is a number instead of indices.
        ValueError: If the case is a tuple whose length is not the number of trials, or the source
            is unknown.
    """

    seed: int
    case: str | int | tuple[str | int, ...] = 0
    trials: Sequence[int] | None = None
    source: Source = "numpy"

    def __post_init__(self) -> None:
        if isinstance(self.trials, int):
            raise TypeError(
                f"`trials` of Draws are indices of trials, got the number {self.trials}; for so many trials write "
                f"trials=range({self.trials})"
            )
        if isinstance(self.case, tuple) and (self.trials is None or len(self.case) != len(self.trials)):
            raise ValueError(
                f"Draws with a tuple of {len(self.case)} cases need as many trials, got "
                f"{None if self.trials is None else len(self.trials)}; give one case for all trials, "
                "or a tuple with one case per trial"
            )
        if self.source not in get_args(Source):
            raise ValueError(
                f"source of Draws must be one of {', '.join(map(repr, get_args(Source)))}, got {self.source!r}"
            )

    def for_trials(self, trials: Sequence[int]) -> Draws:
        """Return a source of random numbers with this seed and case, but for other trials.

        Args:
            trials: Indices of the trials.

        Raises:
            ValueError: If the case is a tuple whose length is not the number of trials.
        """
        return replace(self, trials=trials)

    def part(self, name: str) -> Draws:
        """Return an independent source of random numbers for a named part of a scene.

        Two parts of one kind, such as two areas of speckle, draw the same numbers unless their
        sources have different names. The name joins the case, which is part of the address of every
        random number.

        Args:
            name: Name of the part.
        """
        return replace(
            self,
            case=tuple(f"{case}/{name}" for case in self.case)
            if isinstance(self.case, tuple)
            else f"{self.case}/{name}",
        )

    @property
    def addresses(self) -> list[tuple[str | int, int]]:
        """Case and index of each trial."""
        trials = self.trials if self.trials is not None else [0]
        cases = self.case if isinstance(self.case, tuple) else [self.case] * len(trials)
        return list(zip(cases, trials, strict=True))

    def _keys(self, purpose: str) -> list[int]:
        """Hash keys of the random numbers of all trials for one purpose."""
        return [_key(self.seed, purpose, *address) for address in self.addresses]

    def _of_trials(self, x: Tensor) -> Tensor:
        """Remove the leading dimension of random numbers if there is a single trial."""
        return x if self.trials is not None else x[0]

    def normal(
        self,
        purpose: str,
        shape: Sequence[int] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw standard normal numbers.

        Args:
            purpose: Name of the quantity; different names give independent numbers.
            shape: Shape of the numbers of one trial.
            dtype: Real or complex dtype of the result.
            device: Device of the result; None for that of `torch.set_default_device`.

        Returns:
            Numbers of shape (trial, *shape) with mean zero and unit variance. For a complex dtype
            they are circular Gaussian, with a mean square magnitude of one.
        """
        made = _SOURCES[self.source].normal(self._keys(purpose), shape, dtype, _device(device))
        return self._of_trials(made)

    def uniform(
        self,
        purpose: str,
        shape: Sequence[int] = (),
        low: float = 0.0,
        high: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw numbers that are uniform between two limits.

        Args:
            purpose: Name of the quantity; different names give independent numbers.
            shape: Shape of the numbers of one trial.
            low: Lower limit.
            high: Upper limit.
            dtype: Dtype of the result.
            device: Device of the result; None for that of `torch.set_default_device`.

        Returns:
            Numbers of shape (trial, *shape).
        """
        made = _SOURCES[self.source].uniform(self._keys(purpose), shape, low, high, dtype, _device(device))
        return self._of_trials(made)

    def subset(self, purpose: str, n: int, k: int, device: torch.device | str | None = None) -> Tensor:
        """Draw k of the whole numbers 0 to n - 1 without repetition.

        Args:
            purpose: Name of the quantity; different names give independent numbers.
            n: Number of whole numbers to choose from.
            k: Number of whole numbers to choose.
            device: Device of the result; None for that of `torch.set_default_device`.

        Returns:
            Chosen numbers of shape (trial, k) in rising order, int64.
        """
        return self.permutation(purpose, n, device)[..., :k].sort(-1).values

    def permutation(self, purpose: str, n: int | Sequence[int], device: torch.device | str | None = None) -> Tensor:
        """Draw the whole numbers 0 to n - 1 in random order.

        For the same purpose, `subset` returns the first k of these numbers, sorted.

        Args:
            purpose: Name of the quantity; different names give independent numbers.
            n: Number of whole numbers: an int for all trials, or a sequence with one int per trial.
            device: Device of the result; None for that of `torch.set_default_device`.

        Returns:
            Numbers of shape (trial, largest n), int64. The row of a trial with a smaller n is
            filled up with the whole numbers from that n on, in rising order.
        """
        keys = self._keys(purpose)
        counts = [n] * len(keys) if isinstance(n, int) else list(n)
        return self._of_trials(_SOURCES[self.source].permutation(keys, counts, _device(device)))


def _device(device: torch.device | str | None) -> torch.device:
    """Device for random numbers: the given one, or torch's default device for None."""
    return torch.get_default_device() if device is None else torch.device(device)
