"""Peak memory of a block of code, and reuse of freed memory."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import torch

# parameters of mallopt in malloc.h of the GNU C library
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# freed blocks up to this size are kept: more than a tensor of a batch usually has
_KEPT_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Let this process reuse the memory of freed tensors instead of returning it to the system.

    By default the GNU C library returns the memory of every large tensor when it is freed, so that
    the pages of the next one have to be mapped and cleared again. For chains on the CPU this takes
    up to half of the time. The setting holds for the whole process and cannot be undone. The peak
    memory of the process may grow by about a third.

    Returns:
        Whether the C library has this setting; otherwise nothing is changed.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    return set_option is not None and all(
        set_option(name, _KEPT_BYTES) == 1 for name in (_TRIM_THRESHOLD, _MMAP_THRESHOLD)
    )


class PeakMemory:
    """Context manager that measures the peak memory added by the code inside its `with` block.

    It measures the memory of the CUDA device if CUDA is in use, else that of the process. Memory
    that the process keeps for reuse is returned to the system first.

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
            _return_freed_memory()
            self._before = _resident("VmRSS", reset=True)
        return self

    def __exit__(self, *_: object) -> None:
        peak = torch.cuda.max_memory_allocated() if self._gpu else _resident("VmHWM")
        self.bytes = None if peak is None or self._before is None else max(0, peak - self._before)


def _return_freed_memory() -> None:
    """Undo the effect of `keep_freed_memory` for what is free now, where the C library can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


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
