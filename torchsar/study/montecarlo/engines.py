"""Engines of a sweep: they compute batches of trials in this process or in workers of dask."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import torch

from torchsar.io.extras import library
from torchsar.study.memory import keep_freed_memory
from torchsar.study.montecarlo.fingerprint import changes, code
from torchsar.study.montecarlo.work import Chunk, Computed, Work
from torchsar.study.settings.errors import ConfigError, one_line

log = logging.getLogger("torchsar")
Task = tuple[Chunk, int | None]
_QUEUE = 4  # number of chunks submitted ahead per worker, so that no worker is idle
_POLL_S = 2e-3  # interval at which finished chunks are looked for; a chunk takes 50 ms or more
_DEATHS = 10  # number of workers that may die with a chunk before the chunk counts as the cause


@dataclass(frozen=True)
class InProcess:
    """Engine that computes one chunk (batch of trials) after the other in this process."""

    threads: int = 1
    workers: int = 1

    def results(self, work: Work, tasks: Iterable[Task]) -> Iterator[tuple[Chunk, Computed]]:
        before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            yield from ((chunk, work.compute(chunk, fits)) for chunk, fits in tasks)
        finally:
            torch.set_num_threads(before)


def _compute(chunk: Chunk, fits: int | None) -> Computed:
    """Compute a chunk in a worker, with the work that the plugin of the worker carries."""
    from distributed import get_worker

    carrier: Any = get_worker().plugins[_PLUGIN]
    _refuse_others({get_worker().address: carrier.programs}, carrier.work)
    return carrier.work.compute(chunk, fits)


def _refuse_others(found: Mapping[str, Any], work: Work) -> None:
    """Refuse workers by their programs, or by the error that a worker without torchsar gives."""
    for address, programs in found.items():
        if isinstance(programs, Exception):
            raise ConfigError(
                f"the worker {address} cannot compute trials ({type(programs).__name__}: {one_line(programs)}); "
                "install torchsar there as it is here"
            )
        differing = [*changes(work.programs, programs)]
        if differing:
            raise ConfigError(
                f"the worker {address} has other programs than this process: {', '.join(differing[:3])}; install the "
                "same versions there, and start its process again"
            )


_PLUGIN = "torchsar-work"


def _plugin(work: Work, threads: int, own: bool) -> Any:
    """Make a plugin that sends the work, the number of torch threads and the index of the GPU to
    every worker, also to restarted ones.

    own: True if this program started the workers. They then ignore Ctrl-C, which the program itself
    handles.
    """
    from distributed import WorkerPlugin

    class Carrier(WorkerPlugin):
        name = _PLUGIN

        def setup(self, worker: Any) -> None:
            logging.getLogger("distributed.worker").setLevel(
                logging.CRITICAL
            )  # a failed trial is reported only once, as one sentence
            torch.set_num_threads(threads)
            keep_freed_memory()
            if own and threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            self.work, self.programs = _on_own_gpu(work, worker.name), code(work.programs["code"])

    return Carrier()


def _on_own_gpu(work: Work, worker: Any) -> Work:
    """Assign the work to the GPU with the number of the worker, if there are several GPUs."""
    count = torch.cuda.device_count() if work.device == "cuda" else 0
    return replace(work, device=f"cuda:{int(worker) % count}") if count > 1 and str(worker).isdecimal() else work


@dataclass(frozen=True)
class Distributed:
    """Engine that computes chunks (batches of trials) in the workers of a dask.distributed client.

    A chunk whose worker process dies is run again by another worker, until ten have died with it.

    Raises:
        ConfigError: If so many workers died, most likely for want of memory, if a worker has other
            programs than this process, or if the scheduler does not answer any more.
    """

    client: Any
    workers: int
    threads: int = 1
    own: bool = False

    def results(self, work: Work, tasks: Iterable[Task]) -> Iterator[tuple[Chunk, Computed]]:
        from distributed import CancelledError, KilledWorker, as_completed

        source, waiting = iter(tasks), {}
        try:
            workers, asked = self._workers(), time.monotonic()
            _refuse_others(self.client.run(code, list(work.programs["code"]), on_error="return"), work)
            self.client.register_plugin(_plugin(work, self.threads, self.own), name=_PLUGIN)
            done = as_completed()
            while True:
                # The queue is filled for the present number of workers, which changes in a cluster.
                for chunk, fits in islice(source, max(0, _QUEUE * workers - len(waiting))):
                    future = self.client.submit(_compute, chunk, fits, pure=False)
                    waiting[future] = chunk
                    done.add(future)
                if not waiting:
                    return
                while not done.has_ready():
                    time.sleep(_POLL_S)
                    if time.monotonic() > asked + 1:
                        workers, asked = self._workers(), time.monotonic()
                future = next(done)
                yield waiting.pop(future), future.result()
        except KilledWorker as error:
            raise ConfigError(
                f"the workers of the sweep died one after the other ({one_line(error)}), most likely because memory "
                "ran out; use fewer workers, a smaller chunk, or a smaller scene"
            ) from None
        except (CancelledError, OSError) as error:
            waiting.clear()
            raise ConfigError(
                f"the scheduler of the sweep does not answer any more ({type(error).__name__}: {one_line(error)}); "
                "finished trials are recorded: start a scheduler, and go on with --resume"
            ) from None
        finally:
            if waiting:
                self.client.cancel(list(waiting), force=True)

    def _workers(self) -> int:
        """Return the number of workers; without a worker, log one line and wait for the first."""
        if self.own:
            return self.workers
        address = self.client.scheduler.address
        if not self.client.nthreads():
            log.warning("waiting for workers: start them with `dask worker %s --nthreads 1`", address)
            while not self.client.nthreads():
                time.sleep(0.2)
        return len(self.client.nthreads())


Engine = InProcess | Distributed


@contextmanager
def engine(workers: int | None = None, cluster: str | None = None, threads: int = 1) -> Iterator[Engine]:
    """Start the engine that computes the batches of a sweep, and stop it at the end of the block.

    Args:
        workers: Number of worker processes on this machine; None to compute in this process.
        cluster: Address of a running dask scheduler, whose workers are used instead.
        threads: Number of torch threads in each process. The default is 1, because batches that fit
            into the cache are not faster with more threads (with 2 threads on 2 cores they took 1.4
            times as long). Results then do not depend on the number of cores either.

    Raises:
        ConfigError: If a number is not accepted, both `workers` and `cluster` are given, or no
            scheduler answers at the address.
        ModuleNotFoundError: If dask.distributed is not installed.
    """
    for name, value in (("workers", workers), ("threads", threads)):
        if (name, value) != ("workers", None) and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ConfigError(f"sweep: {name} must be a whole number of at least 1, got {value!r}")
    if workers is None and cluster is None:
        yield InProcess(threads)
        return
    if workers is not None and cluster is not None:
        raise ConfigError(
            "--workers starts processes on this machine and --cluster uses running ones; give one of them"
        )
    distributed = library("distributed", "cluster", "a sweep with workers or a cluster")
    with (
        _local(distributed, workers or 1, threads) if cluster is None else _remote(distributed, cluster, threads)
    ) as chosen:
        yield chosen


@contextmanager
def _local(distributed: Any, workers: int, threads: int) -> Iterator[Engine]:
    from dask import config

    from torchsar.study.montecarlo.servers import SchedulerWithoutHttp, WorkerWithoutHttp

    settings = {
        "distributed.nanny.pre-spawn-environ": dict.fromkeys(
            ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads
        )
        | {"OMP_WAIT_POLICY": "PASSIVE"},
        "distributed.scheduler.allowed-failures": _DEATHS,
    }
    # with a key of its own, processes of other users cannot give work to the workers
    security = distributed.Security.temporary()
    common = {"host": "127.0.0.1", "port": 0, "protocol": "tls://", "security": security}
    of_nanny = {"worker_class": WorkerWithoutHttp, "nthreads": 1, "memory_limit": 0, "silence_logs": logging.CRITICAL}
    with config.set(settings):
        try:
            cluster = distributed.SpecCluster(
                {i: {"cls": distributed.Nanny, "options": common | of_nanny} for i in range(workers)},
                {"cls": SchedulerWithoutHttp, "options": common},
                security=security,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            raise ConfigError(
                f"the worker processes did not start ({one_line(error)}); a script that starts workers is imported "
                "again by each of them: put its call of sweep(...) below the line: if __name__ == '__main__':"
            ) from None
        with cluster, distributed.Client(cluster) as client:
            yield Distributed(client, workers, threads, own=True)


@contextmanager
def _remote(distributed: Any, address: str, threads: int) -> Iterator[Engine]:
    # the logs of dask are suppressed, so that the loss of a scheduler is reported once, as one
    # sentence
    for part in ("client", "utils"):
        logging.getLogger(f"distributed.{part}").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=20)
    except (OSError, ValueError, TypeError) as error:  # TypeError without a certificate for TLS
        raise ConfigError(
            f"--cluster {address} does not answer ({one_line(error)}); start a scheduler there, or leave --cluster out"
        ) from None
    with client:
        yield Distributed(client, max(1, len(client.nthreads())), threads)
