"""Chunks of a sweep, which are batches of trials: their sizes, and how a process computes them."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchsar.core import Draws, Outcome, is_out_of_memory
from torchsar.study.memory import PeakMemory
from torchsar.study.montecarlo.fingerprint import code
from torchsar.study.montecarlo.grid import Case, Grid
from torchsar.study.montecarlo.record import OK, OUTCOME
from torchsar.study.settings.errors import ConfigError, one_line, own_line

# Larger batches take more time per trial, because they do not fit into the cache. Batches of fewer
# than four trials take 10 to 25 % more time for the calls, as measured with sweeps of four systems.
CACHE_BYTES = 12 << 20
# _GPU_SHARE: share of the free memory of a GPU that a batch takes. With 0.9, gaps between tensors
# left no room in two of four sweeps.
# _LARGER: ratio of the sizes of batches whose memory is measured one after the other.
# _CONTEXT_BYTES: memory that a process takes for itself.
_GPU_SHARE, _LARGER, _CONTEXT_BYTES = 0.8, 8, 600 << 20


class LargestTensor(TorchDispatchMode):
    """Context manager that records the largest tensor that any operation of torch returns.

    Attributes:
        bytes: Size of its storage in bytes.
    """

    bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self.bytes = max(self.bytes, leaf.untyped_storage().nbytes())
        return result


def rows_by_bytes(bytes_per_trial: int) -> int:
    """Return the number of trials in a batch on a CPU.

    Args:
        bytes_per_trial: Size in bytes of the largest tensor of one trial. For the whole batch, this
            tensor takes at most 12 MiB, or 32 MiB for up to four trials.

    Returns:
        The number, 1 or more.
    """
    return max(1, CACHE_BYTES // bytes_per_trial, min(4, (32 << 20) // bytes_per_trial))


def rows_by_peak(peaks: Mapping[int, int], free_bytes: int) -> int:
    """Return the number of trials whose peak memory fits.

    Args:
        peaks: Peak memory in bytes of batches of two sizes, by the number of trials. It is taken to
            grow linearly.
        free_bytes: Memory that a batch may take.

    Returns:
        The number, 1 or more.
    """
    (few, low), (many, high) = sorted(peaks.items())
    each = max(1.0, (high - low) / (many - few))
    return max(1, int((free_bytes - low) / each) + few)


def rows_by_trial(run: Callable[[int], int | None], device: torch.device | str, trials: int, workers: int) -> int:
    """Return the number of trials in a batch that fits a CUDA device, by trying small batches.

    Stages that work in blocks need less memory a trial in large batches than in small ones. Batches
    of growing size are therefore tried, up to a third or more of what fits, unless all trials fit.

    Args:
        run: Function that computes a batch of so many trials. It returns the number of trials that
            it had to go down to, None if memory was sufficient.
        device: The device; one without an index stands for all of them, which the processes share.
        trials: Number of trials in all.
        workers: Number of processes that compute batches.

    Returns:
        The number, 1 or more.
    """
    share, peaks = -(-trials // workers), list[tuple[int, int]]()
    if share < 2:
        return 1
    run(1)  # this run makes objects that later batches reuse
    rows = 1
    while True:
        with PeakMemory(device) as memory:
            fits = run(rows)
        if fits is not None:
            return fits
        peaks = [*peaks[-1:], (rows, memory.bytes or 0)]
        if len(peaks) == 1:
            rows = min(_LARGER, share)
            continue
        fitting = rows_by_peak(dict(peaks), _room_bytes(device, workers))
        if fitting >= share or fitting <= 3 * rows:
            return fitting
        rows = min(_LARGER * rows, -(-fitting // 2))


def _room_bytes(device: torch.device | str, workers: int) -> int:
    """Memory in bytes that a batch may take in each of the processes that use a device."""
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info(device)
    sharing = workers if torch.device(device).index is not None else -(-workers // torch.cuda.device_count())
    others = _CONTEXT_BYTES * sharing if workers > 1 else 0
    return int(_GPU_SHARE * max(0, free - others) / sharing)


log = logging.getLogger("torchsar")
Trial = Callable[[Mapping[str, Any], Draws], Mapping[str, Any]]
Numbers = dict[str, dict[str, list[float]]]
BOUNDS, SAVED = "bounds", "saved"


@dataclass(frozen=True)
class Chunk:
    """Trials that run as one batch, one per row.

    Args:
        case: Index of the case, the group of grid points that may share a batch.
        points: For each row, the index of its grid point, counted within the case.
        trials: For each row, the index of its trial.
    """

    case: int
    points: tuple[int, ...]
    trials: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.trials)

    def pieces(self, rows: int) -> Iterator[Chunk]:
        """Yield the rows in as few pieces of at most `rows` rows as possible, nearly equal."""
        count = -(-len(self) // rows)
        edges = [round(i * len(self) / count) for i in range(count + 1)]
        for first, last in pairwise(edges):
            yield Chunk(self.case, self.points[first:last], self.trials[first:last])


@dataclass(frozen=True)
class Part:
    """Results of one batch of trials.

    Args:
        chunk: The trials, one per row.
        values: Metrics by algorithm and name, (rows,) each.
        bounds: Lower bounds by metric and name of the bound, (rows,) each.
        saved: Arrays that are kept, by row and "algorithm.name".
    """

    chunk: Chunk
    values: Numbers
    bounds: Numbers
    saved: dict[int, dict[str, np.ndarray]]


@dataclass(frozen=True)
class Computed:
    """Results of a chunk of trials, which is run in smaller batches where memory is short.

    Args:
        parts: Results of each batch in which it was run.
        fits: Largest number of trials that fit into memory, None if no batch was too large.
        warnings: Warnings that the trials logged.
    """

    parts: list[Part]
    fits: int | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Work:
    """All that a process needs to compute chunks, and the `code` that it must have."""

    trial: Trial
    grid: Grid
    draws: Draws
    device: str = "cpu"
    save: frozenset[int] = frozenset()
    programs: Mapping[str, Any] = field(default_factory=code)

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        return tuple(self.grid.cases())

    def compute(self, chunk: Chunk, fits: int | None = None) -> Computed:
        """Run a chunk in batches of at most `fits` trials; halve batches that exceed the memory.

        Raises:
            ConfigError: If the trial function fails.
        """
        found, waiting, parts, before = fits, [chunk], [], _global_generators()
        with _warnings_kept() as said:
            while waiting:
                piece = waiting.pop(0)
                if found is not None and len(piece) > found:
                    waiting = [*piece.pieces(found), *waiting]
                    continue
                try:
                    parts.append(self._once(piece))
                except (Exception, SystemExit, GeneratorExit) as error:
                    self._refuse_unless_halving_helps(piece, error)
                    found, waiting = -(-len(piece) // 2), [piece, *waiting]
        if _global_generators() != before:
            said.append(
                "trials draw random numbers from a global generator of torch or numpy, which differ with the "
                "batches and processes, and after a resume; draw them from the draws that the trial function gets"
            )
        return Computed(parts, found if found != fits else None, tuple(dict.fromkeys(said)))

    def _refuse_unless_halving_helps(self, chunk: Chunk, error: BaseException) -> None:
        """Raise a ConfigError, unless the error is that a batch of several trials did not fit into
        memory.
        """
        points = ", ".join(f"{k}={v}" for k, v in self.cases[chunk.case].fixed.items()) or "the sweep"
        where = f"trials {min(chunk.trials)} to {max(chunk.trials)} of {points} failed"
        if not is_out_of_memory(error):
            raise ConfigError(
                f"{where}: {'' if isinstance(error, ConfigError) else type(error).__name__ + ': '}"
                f"{one_line(error) or 'no message'}{own_line(error)}"
            ) from error
        if len(chunk) == 1:
            raise ConfigError(
                f"{where}: a single trial does not fit into the memory of {self.device}; make the scene smaller"
            ) from error
        if self.device != "cpu":
            torch.cuda.empty_cache()

    def parameters(self, chunk: Chunk) -> dict[str, Any]:
        """Return the parameters of the trials: batched ones as float64 (rows,), others as given."""
        given, indices = dict[str, Any](), [self.cases[chunk.case].points[p].index for p in chunk.points]
        for dim, parameter in enumerate(self.grid.parameters):
            rows = [parameter.values[index[dim]] for index in indices]
            given[parameter.name] = (
                torch.tensor(rows, dtype=torch.float64, device=self.device) if parameter.batched else rows[0]
            )
        return given

    def _once(self, chunk: Chunk) -> Part:
        addresses = tuple(self.cases[chunk.case].points[p].address for p in chunk.points)
        given = self.trial(self.parameters(chunk), replace(self.draws, case=addresses, trials=list(chunk.trials)))
        if not isinstance(given, Mapping):
            raise ValueError(
                "a trial function returns {metric: tensor} or {algorithm: {metric: tensor}}, "
                f"got {type(given).__name__}"
            )
        found = dict(given)
        bounds, saved = found.pop(BOUNDS, {}), found.pop(SAVED, {})
        nested = {name: value for name, value in found.items() if isinstance(value, Mapping)}
        for wrong, text in (
            (
                nested and len(nested) != len(found),
                "a trial function returns tensors by metric, or a mapping of metrics by algorithm, not both; got "
                f"{list(found)}",
            ),
            (
                not (any(nested.values()) if nested else found),
                "a trial function gives at least one metric, and this one gave none",
            ),
            (not _nested(bounds), f"{BOUNDS!r} must be a mapping of mappings, {{metric: {{name: tensor}}}}"),
            (not _nested(saved), f"{SAVED!r} must be a mapping of mappings, {{algorithm: {{name: tensor}}}}"),
        ):
            if wrong:
                raise ValueError(text)
        kept = {f"{algorithm}.{name}": value for algorithm, named in saved.items() for name, value in named.items()}
        n, rows = len(chunk), [row for row, trial in enumerate(chunk.trials) if trial in self.save]
        return Part(
            chunk,
            _numbers(nested or {_name(self.trial): found}, n),
            _numbers(bounds, n, f"{BOUNDS}."),
            {row: {name: _array(value, row, n, f"{SAVED}.{name}") for name, value in kept.items()} for row in rows},
        )


def _global_generators() -> tuple[Any, ...]:
    """States of the global generators of torch and numpy. That of random is left out, since threads
    of dask use it.
    """
    _, numbers, *rest = np.random.get_state()
    return torch.get_rng_state().numpy().tobytes(), np.asarray(numbers).tobytes(), rest


@contextmanager
def _warnings_kept() -> Iterator[list[str]]:
    """Collect the warnings of the trials, so that a sweep can print each of them once."""
    said: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno == logging.WARNING:
            said.append(record.getMessage().removeprefix("warning: "))
        return record.levelno != logging.WARNING

    log.addFilter(keep)
    try:
        with warnings.catch_warnings(record=True) as caught:
            yield said
            said.extend(" ".join(str(warning.message).split()) for warning in caught)
    finally:
        log.removeFilter(keep)


def _name(trial: Trial) -> str:
    name = getattr(trial, "__name__", type(trial).__name__)
    return name if name.isidentifier() else "trial"


def _nested(tree: Any) -> bool:
    return isinstance(tree, Mapping) and all(isinstance(named, Mapping) for named in tree.values())


def _array(value: Any, row: int, rows: int, what: str) -> np.ndarray:
    """One trial of an array that is saved."""
    if not hasattr(value, "__len__") or len(value) != rows:
        raise ValueError(
            f"{what} must hold one array for each of the {rows} trials, got "
            f"{tuple(getattr(value, 'shape', ())) or type(value).__name__}"
        )
    one = value[row]
    if not isinstance(one, Tensor):
        return np.asarray(one)
    return one.to(torch.float32 if one.dtype == torch.bfloat16 else one.dtype).numpy(force=True)


def _numbers(tree: Mapping[str, Mapping[str, Any]], rows: int, before: str = "") -> Numbers:
    """Plain numbers for each row, as lists, which is the fastest conversion from torch."""
    return {
        outer: {inner: _rows(value, rows, f"{before}{outer}.{inner}") for inner, value in named.items()}
        for outer, named in tree.items()
    }


def _rows(value: Any, rows: int, what: str) -> list[float]:
    expected = f"{what} must hold one real number for each of the {rows} trials, got"
    try:
        x = value if isinstance(value, Tensor) else torch.as_tensor(value)
    except (TypeError, RuntimeError, ValueError):
        raise ValueError(f"{expected} {type(value).__name__}") from None
    # a bound may be one number for all trials, but a metric that is one lacks its trials
    shared = rows == 1 or what.startswith(f"{BOUNDS}.")
    if x.is_complex() or x.shape not in ((rows,), *[()] * shared):
        tip = "; reduce over the last dimensions only, as in x.mean(-1)" if x.ndim == 0 else ""
        raise ValueError(f"{expected} {x.dtype} of shape {tuple(x.shape)}{tip}")
    if what.endswith(f".{OK}") and x.dtype != torch.bool:
        raise ValueError(f"{what} must be bool, got {x.dtype}")
    if what.endswith(f".{OUTCOME}") and not set(x.reshape(-1).tolist()) <= set(Outcome):
        raise ValueError(f"{what} must hold codes of torchsar.Outcome, got {x.reshape(-1).tolist()[:5]}")
    return x.tolist() if x.ndim else [x.item()] * rows


def probed_bytes(work: Work, case: int) -> int:
    """Return the size in bytes of the largest tensor of one trial, found by running one trial.

    If the trial function has a method `bytes_per_trial(fixed)`, the result of this is used instead.
    """
    known = getattr(work.trial, "bytes_per_trial", None)
    if known is not None:
        return max(1, int(known(work.cases[case].fixed)))
    with LargestTensor() as largest:
        work.compute(Chunk(case, (0,), (0,)))
    return max(1, largest.bytes)


def rows_of(work: Work, case: int, trials: int, workers: int) -> int:
    """Return the largest number of trials in a batch: on a CPU it follows from the cache, on a GPU
    from the memory.

    Args:
        work: The work.
        case: Index of the case.
        trials: Number of trials of each point.
        workers: Number of processes that compute batches. Those that share a GPU share its memory.
    """
    return (
        rows_by_trial(
            lambda rows: work.compute(Chunk(case, (0,) * rows, tuple(range(rows)))).fits,
            work.device,
            trials * len(work.cases[case].points),
            workers,
        )
        if torch.device(work.device).type == "cuda"
        else rows_by_bytes(probed_bytes(work, case))
    )


def cut(case: int, whole: Case, active: set[int], first: int, last: int, rows: int) -> Iterator[Chunk]:
    """Yield chunks of at most `rows` trials: the trials `first` to `last` - 1 of each active point.

    The division depends only on these arguments and not on the trials already done, so that a
    resumed sweep runs the same batches.
    """
    order = [(p, t) for p in range(len(whole.points)) if p in active for t in range(first, last)]
    if order:
        yield from Chunk(case, tuple(p for p, _ in order), tuple(t for _, t in order)).pieces(rows)
