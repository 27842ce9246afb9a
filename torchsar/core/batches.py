"""Number of trials in a batch, chosen by the cache of a CPU or by the memory of a GPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch

from torchsar.core.memory import PeakMemory

# larger batches do not fit the cache of a CPU and take more time per trial, as measured
CACHE_BYTES = 12 << 20
# Share of the free memory of a GPU that a batch takes, trials of a batch whose memory is measured
# beside that of one, and memory that a process takes for itself.
_GPU_SHARE, _MEASURED, _CONTEXT_BYTES = 0.85, 8, 600 << 20


def rows_by_bytes(bytes_per_trial: int) -> int:
    """Return the number of trials in a batch on a CPU.

    Args:
        bytes_per_trial: Size in bytes of the largest tensor of one trial. For the whole batch, this
            tensor takes at most 12 MiB, the size of a cache.

    Returns:
        The number, 1 or more.
    """
    return max(1, CACHE_BYTES // bytes_per_trial)


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
    """Return the number of trials in a batch that fits a CUDA device, by trying two small batches.

    Args:
        run: Function that computes a batch of so many trials. It returns the number of trials that
            it had to go down to, None if memory was sufficient.
        device: The device; one without an index stands for all of them, which the processes share.
        trials: Number of trials in all.
        workers: Number of processes that compute batches.

    Returns:
        The number, 1 or more.
    """
    many, peaks = min(_MEASURED, -(-trials // workers)), {}
    if many < 2:
        return 1
    for rows in (1, 1, many):  # the first batch also makes what later ones find made
        with PeakMemory(device) as memory:
            fits = run(rows)
        if fits is not None:
            return fits
        peaks[rows] = memory.bytes or 0
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info(device)
    sharing = workers if torch.device(device).index is not None else -(-workers // torch.cuda.device_count())
    others = _CONTEXT_BYTES * sharing if workers > 1 else 0
    return rows_by_peak(peaks, int(_GPU_SHARE * max(0, free - others) / sharing))
