"""How many trials run at once: by bytes, so that a batch stays in the cache of a CPU or in the
memory of a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchsar.study.montecarlo.grid import Case
from torchsar.study.montecarlo.work import Chunk, Work

CACHE_BYTES = 12 << 20
_GPU_SHARE, _LIVE_TENSORS = 0.5, 12


class _Largest(TorchDispatchMode):
    """Remembers the bytes of the largest tensor that any operation gives."""

    bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self.bytes = max(self.bytes, leaf.untyped_storage().nbytes())
        return result


def probed_bytes(work: Work, case: int) -> int:
    """Bytes of the largest tensor of one trial, found by running it once; the trial's own
    `bytes_per_trial(fixed)` saves that run.
    """
    told = getattr(work.trial, "bytes_per_trial", None)
    if told is not None:
        return max(1, int(told(work.cases[case].fixed)))
    with _Largest() as largest:
        work.compute(Chunk(case, (0,), (0,)))
    return max(1, largest.bytes)


def rows_by_bytes(bytes_per_trial: int, device: str) -> int:
    """Trials a batch, from the bytes of the largest tensor of one trial.

    On a CPU that tensor of the whole batch fills CACHE_BYTES: larger batches leave the cache and
    cost more per trial. On a GPU about a dozen of its kind fill half of the free memory.
    """
    if torch.device(device).type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return max(1, int(_GPU_SHARE * free / (_LIVE_TENSORS * bytes_per_trial)))
    return max(1, CACHE_BYTES // bytes_per_trial)


def cut(case: int, whole: Case, active: set[int], first: int, last: int, rows: int) -> Iterator[Chunk]:
    """Chunks of at most `rows` rows: trials first..last-1 of the active points of a case, point by
    point.

    The cuts depend on these arguments alone, never on what has already been done, so that a resumed
    sweep runs the same batches.
    """
    order = [(p, t) for p in range(len(whole.points)) if p in active for t in range(first, last)]
    if order:
        yield from Chunk(case, tuple(p for p, _ in order), tuple(t for _, t in order)).pieces(rows)
