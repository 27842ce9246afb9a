"""Measurement of the peak memory of a block of code."""

from __future__ import annotations

from pathlib import Path

import torch


class PeakMemory:
    """Context manager that measures the peak memory added by the code inside its `with` block.

    It measures the memory of the CUDA device if CUDA is in use, else that of the process.

    Attributes:
        bytes: Peak minus the memory in use at the beginning, in bytes. None until the block ends,
            and on systems that do not report memory.
    """

    def __init__(self) -> None:
        self.bytes: int | None = None

    def __enter__(self) -> PeakMemory:
        self._gpu = torch.cuda.is_available() and torch.cuda.is_initialized()
        if self._gpu:
            torch.cuda.reset_peak_memory_stats()
            self._before: int | None = torch.cuda.memory_allocated()
        else:
            self._before = _resident("VmRSS", reset=True)
        return self

    def __exit__(self, *_: object) -> None:
        peak = torch.cuda.max_memory_allocated() if self._gpu else _resident("VmHWM")
        self.bytes = None if peak is None or self._before is None else max(0, peak - self._before)


def _resident(field: str, reset: bool = False) -> int | None:
    """Resident memory of this process (VmRSS) or its peak since the last reset (VmHWM), in bytes;
    None on systems that do not report it.
    """
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        text = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in text.splitlines() if line.startswith(f"{field}:")), None)
