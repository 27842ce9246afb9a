"""Programs in processes of their own that start at once: they are forked from a server that has
imported torch, which takes a new interpreter seconds. So are workers of dask.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

_SERVER = multiprocessing.get_context("forkserver")
_IMPORTED = ["distributed", "torchsar.study.table", "torchsar.study.commands.sweep"]
_SERVER.set_forkserver_preload(_IMPORTED)


def fork_workers() -> None:
    """Let dask start its workers from the server of this process, or one that imports the same."""
    if find_spec("distributed") is None:
        return
    from dask import config
    from distributed.utils import get_mp_context

    config.set({"distributed.worker.multiprocessing-method": "forkserver"})
    get_mp_context()  # at its first call it chooses other modules to import
    _SERVER.set_forkserver_preload(_IMPORTED)


class Program:
    """A function that runs as a program does: its result is the exit status, a group of its own.

    Args:
        main: Function of a module.
        given: Its arguments.
        folder: Working directory.
        said: File to which its output goes.
    """

    def __init__(self, main: Callable[..., int | None], *given: Any, folder: Path, said: Path) -> None:
        said.write_text("")
        self._said = said
        self._process = _SERVER.Process(target=_run, args=(main, given, folder, said))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def said(self) -> str:
        return self._said.read_text(encoding="utf-8", errors="replace")

    @property
    def running(self) -> bool:
        return self._process.is_alive()

    def wait(self, timeout_s: float = 120.0) -> int:
        """Exit status after the end; negative if a signal ended it."""
        self._process.join(timeout_s)
        if self._process.exitcode is None:
            self.kill()
            raise TimeoutError(f"still running after {timeout_s:g} s: {self.said[-2000:]}")
        return self._process.exitcode

    def wait_for(self, words: str, timeout_s: float = 120.0) -> None:
        """Until it has said the words."""
        deadline = time.monotonic() + timeout_s
        while words not in self.said:
            if not self.running or time.monotonic() > deadline:
                raise AssertionError(f"did not say {words!r}: {self.said[-2000:]}")
            time.sleep(0.02)

    def send(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> int:
        self.send(signal.SIGKILL)
        return self.wait()


def _run(main: Callable[..., int | None], given: tuple, folder: Path, said: Path) -> None:
    os.setsid()
    os.chdir(folder)
    with said.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = (os.fdopen(descriptor, "w", buffering=1, closefd=False) for descriptor in (1, 2))
    # a test that was started in the background ignores Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    fork_workers()
    sys.exit(main(*given))
