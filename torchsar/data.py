"""Simulated recordings with their true values, in batches for training and tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data import IterableDataset, get_worker_info

from torchsar.core import Chain, Draws, Recording, Truth, device_fault

Pair = tuple[Recording, Truth]


class Simulated(IterableDataset[Pair]):
    """Batches of simulated recordings and their true values, by the numbers of their trials.

    All random numbers of a trial depend only on the seed and the case of `draws` and on the number
    of the trial. Neither the batch size nor the number of workers of a DataLoader changes a trial:
    on a CPU to the last bit, on a GPU to the rounding of sums in batches of another size.
    With n workers, worker k computes the batches k, k + n, k + 2 n, ..., so that a DataLoader gives
    the same batches in the same order as without workers. The batches are complete: give the
    DataLoader `batch_size=None`.

        data = Simulated("isal_snr", Draws(1, trials=range(1_000_000)), vary=lambda draws: {
            "world.noise.snr_db": draws.uniform("snr_db", low=-10.0, high=20.0)})
        for recording, truth in DataLoader(data, batch_size=None, num_workers=2):
            ...

    Each pass over the data gives the same trials. For other trials, for instance to test what was
    trained, give other numbers of trials or another seed.

    Args:
        source: Name of a packaged config or path of a YAML file, which is simulated as by
            `torchsar run`. It may also be a function that is given Draws and returns a recording
            and its truth, such as one that calls `torchsar.echo.simulate`. A config needs the extra
            `study`.
        draws: Seed, case, source and numbers of the trials; `seed` and `random` of a config are not
            used.
        batch: Number of trials in a batch; the last one may be smaller.
        overrides: Changes of the config, as "key=value" with dotted keys.
        case: Name of the case, for a config with cases.
        vary: Function that is given the Draws of a batch and returns numbers of the world that
            differ between trials, by dotted key, shape (trial,), float64. Where workers are
            spawned and not forked, it must be a function of a module.
        device: Device on which the trials of a config are computed. The results of a function are
            moved to it.

    Raises:
        TypeError: If `draws` are not Draws, the source is no config and no function, or a function
            does not return a Recording and a Truth.
        ValueError: If there are no numbers of trials, the batch has less than one trial, or the
            device cannot be used. For a config: if it or an override is invalid, it processes a
            recording, the case does not exist, or a number of `vary` cannot differ between trials.
            For a function: if it is combined with arguments for a config.
        ImportError: If a package of the extra `study`, which a config needs, is not installed.
    """

    def __init__(
        self,
        source: str | Path | Callable[[Draws], Pair],
        draws: Draws,
        *,
        batch: int = 16,
        overrides: Sequence[str] = (),
        case: str | None = None,
        vary: Callable[[Draws], Mapping[str, Tensor]] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        if not isinstance(draws, Draws):
            raise TypeError(f"Simulated needs Draws, such as Draws(1, trials=range(100)), got {type(draws).__name__}")
        if draws.trials is None or not len(draws.trials):
            raise ValueError(
                f"Simulated needs numbers of trials, got Draws with trials={draws.trials!r}; give Draws with "
                "trials=range(100)"
            )
        if isinstance(batch, bool) or not isinstance(batch, int) or batch < 1:
            raise ValueError(f"Simulated: batch must be a whole number of trials above 0, got {batch!r}")
        reason = device_fault(device)
        if reason:
            raise ValueError(f"Simulated: the device {str(device)!r} cannot be used here: {reason}")
        self.draws, self.trials, self.batch = draws, draws.trials, batch
        if isinstance(source, str | Path):
            self.simulate: Callable[[Draws], Pair] = _Config(str(source), tuple(overrides), case, vary, str(device))
            self.simulate.given(self._part(0))
        elif callable(source):
            if overrides or case is not None or vary is not None:
                raise ValueError("Simulated: overrides, case and vary are for a config, and the source is a function")
            self.simulate = _Function(source, str(device))
        else:
            raise TypeError(
                f"Simulated needs the name or path of a config, or a function of Draws, got {type(source).__name__}"
            )

    def __len__(self) -> int:
        """Return the number of batches of one pass."""
        return -(-len(self.trials) // self.batch)

    def __iter__(self) -> Iterator[Pair]:
        """Yield the batches of this worker, or all batches if there are no workers."""
        worker = get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        for index in range(first, len(self), step):
            with torch.no_grad():
                pair = self.simulate(self._part(index))
            yield pair

    def _part(self, index: int) -> Draws:
        """Draws of one batch of trials."""
        part, case = slice(index * self.batch, (index + 1) * self.batch), self.draws.case
        return replace(self.draws, trials=self.trials[part], case=case[part] if isinstance(case, tuple) else case)


def config_chain(
    config: str | Path,
    method: str = "recommended",
    *,
    case: str | None = None,
    overrides: Sequence[str] = (),
    vary: Sequence[str] = (),
    device: torch.device | str = "cpu",
) -> Chain:
    """Return the chain of a config, from its world to the metrics that its stages measure.

        chain = torchsar.data.config_chain("isal_snr", vary=["world.noise.snr_db"])
        levels = {"given.world.noise.snr_db": torch.linspace(0, 20, 8, dtype=torch.float64)}
        trace = chain.trace(draws=Draws(1, "run", trials=range(8)), given=levels)

    The first stage is called `world` and simulates what `torchsar run` does; the others are those
    of the method. With the seed of the config, the case that `torchsar run` draws ("run", and 0 for
    the system stripmap) and the same trials, all samples and estimates are the same.

    Args:
        config: Name of a packaged config, or path of a YAML file.
        method: Name of the method.
        case: Name of the case, for a config with cases.
        overrides: Changes of the config, as "key=value" with dotted keys.
        vary: Numbers of the world that are given per trial, by dotted key.
        device: Device on which the trials are computed.

    Returns:
        The chain, which is called with `draws`, and with `given` values "given.KEY" for each of the
        keys that vary.

    Raises:
        ValueError: If the config, an override, the case, the method or a key is not valid, or the
            config processes a recording.
        ImportError: If a package of the extra `study` is not installed.
    """
    bench = _Config(str(config), tuple(overrides), case, None, str(device)).bench
    if method not in bench.chains:
        raise ValueError(f"{bench.file} has the methods {', '.join(bench.chains)}, got {method!r}")
    return bench.chain(method, [_refuse_fixed(bench, key) for key in vary])


def _refuse_fixed(bench: Any, key: str) -> str:
    """Return the part of a key after "world."; raise ValueError if it must be equal in
    all trials.
    """
    section, _, rest = key.partition(".")
    if section != "world" or not bench.system.may_differ(rest, bench.config.world):
        raise ValueError(f"{bench.file}: vary gives {key!r}, which cannot differ between trials of a batch")
    return rest


@dataclass(frozen=True)
class _Function:
    """A user's simulation function, with a check of its result."""

    function: Callable[[Draws], Pair]
    device: str

    def __call__(self, draws: Draws) -> Pair:
        pair = self.function(draws)
        if not (isinstance(pair, tuple) and [type(part) for part in pair] == [Recording, Truth]):
            raise TypeError(
                f"Simulated: the function must return a Recording and a Truth, got {type(pair).__name__}"
                f"{f' of {[type(part).__name__ for part in pair]}' if isinstance(pair, tuple) else ''}"
            )
        return pytree.tree_map(lambda x: x.to(self.device), pair)


@dataclass(frozen=True)
class _Config:
    """The simulation of a config. In another process the config is loaded again by its name."""

    source: str
    overrides: tuple[str, ...]
    case: str | None
    vary: Callable[[Draws], Mapping[str, Tensor]] | None
    device: str

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __call__(self, draws: Draws) -> Pair:
        trials = self.bench.trials(draws, self.given(draws))
        return trials.recording, Truth(trials.truth, trials.clean)

    @cached_property
    def bench(self) -> Any:
        """Radar and world of the config."""
        try:
            from torchsar.study.settings.sections import cases_of
            from torchsar.study.table import load
            from torchsar.study.trials.bench import Bench
        except ImportError as error:
            raise ImportError(
                f"Simulated needs {error.name} to read a config: pip install 'torchsar-lab[study]'"
            ) from error
        loaded = load(self.source, self.overrides)
        if loaded.config.data.file is not None:
            raise ValueError(f"{loaded.file}: the config processes the recording data.file; Simulated needs a world")
        cases = cases_of(loaded)
        name = next(iter(cases)) if self.case is None and not loaded.config.cases else self.case
        if name not in cases:
            raise ValueError(
                f"{loaded.file}: Simulated needs one case of the config, got case={self.case!r}; its cases are "
                f"{', '.join(map(repr, loaded.config.cases)) or 'none'}"
            )
        return Bench(cases[name], self.device)

    def given(self, draws: Draws) -> dict[str, Tensor]:
        """Numbers of the world that differ between trials, by the part of the dotted key after
        "world.".
        """
        bench, count, found = self.bench, len(draws.trials or ()), {}
        for key, value in ({} if self.vary is None else self.vary(draws)).items():
            rest = _refuse_fixed(bench, key)
            if not isinstance(value, Tensor) or value.shape != (count,):
                got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(f"{bench.file}: vary must give one number per trial as {key!r}, ({count},), got {got}")
            found[rest] = value.to(self.device)
        return found
