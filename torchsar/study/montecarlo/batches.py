"""Number of trials in a batch, chosen by the cache of a CPU or by the memory of a GPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchsar.study.memory import PeakMemory

# Larger batches take more time per trial for want of cache, but batches of fewer than four trials
# 10 to 25 % more for the calls, as measured with sweeps of four systems.
CACHE_BYTES, _FEW, _FEW_BYTES = 12 << 20, 4, 32 << 20
# Share of the free memory of a GPU that a batch takes (with 0.9, gaps between tensors left no room
# in two of four sweeps), ratio of the sizes of batches whose memory is measured one after the
# other, and memory that a process takes for itself.
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
    return max(1, CACHE_BYTES // bytes_per_trial, min(_FEW, _FEW_BYTES // bytes_per_trial))


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
    run(1)  # makes what later batches find made
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
    """Memory that a batch of each of the processes that share a device may take."""
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info(device)
    sharing = workers if torch.device(device).index is not None else -(-workers // torch.cuda.device_count())
    others = _CONTEXT_BYTES * sharing if workers > 1 else 0
    return int(_GPU_SHARE * max(0, free - others) / sharing)
