"""Where chunks are computed: in this process, or on workers of dask.distributed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from torchsar.study.errors import ConfigError
from torchsar.study.montecarlo.work import Chunk, Outcome, Work

Task = tuple[Chunk, int | None]
_QUEUE = 4
_RETRIES = 20


class Engine(Protocol):
    """Computes chunks in any order; `workers` is for the record."""

    workers: int

    def results(self, work: Work, tasks: Iterable[Task]) -> Iterator[tuple[Chunk, Outcome]]: ...


@dataclass(frozen=True)
class InProcess:
    """One chunk after the other, with the threads of torch."""

    workers: int = 1

    def results(self, work: Work, tasks: Iterable[Task]) -> Iterator[tuple[Chunk, Outcome]]:
        for chunk, fits in tasks:
            yield chunk, work.compute(chunk, fits)


def _compute(chunk: Chunk, fits: int | None) -> Outcome:
    """Runs in a worker, with the work that its plugin holds."""
    from distributed import get_worker

    return get_worker().plugins[_PLUGIN].work.compute(chunk, fits)


_PLUGIN = "torchsar-work"


def _plugin(work: Work, threads: int | None) -> Any:
    """Gives every worker, a restarted one too, the work, its torch threads, and the GPU of its number."""
    from distributed import WorkerPlugin

    class Carrier(WorkerPlugin):
        name = _PLUGIN

        def setup(self, worker: Any) -> None:
            torch.set_num_threads(threads or max(1, worker.state.nthreads))
            self.work = _on_own_gpu(work, worker.name)

    return Carrier()


def _on_own_gpu(work: Work, worker: Any) -> Work:
    """The GPU whose number is the worker's, where there are several and none was named."""
    from dataclasses import replace

    count = torch.cuda.device_count() if work.device == "cuda" else 0
    return replace(work, device=f"cuda:{int(worker) % count}") if count > 1 and str(worker).isdecimal() else work


@dataclass(frozen=True)
class Distributed:
    """Workers of a dask.distributed client. A chunk whose worker dies is run again on another one."""

    client: Any
    workers: int
    threads: int | None = None

    def results(self, work: Work, tasks: Iterable[Task]) -> Iterator[tuple[Chunk, Outcome]]:
        from distributed import as_completed

        self.client.register_plugin(_plugin(work, self.threads), name=_PLUGIN)
        source, waiting = iter(tasks), {}
        done = as_completed(raise_errors=False)

        def submit() -> None:
            task = next(source, None)
            if task is not None:
                future = self.client.submit(_compute, *task, pure=False, retries=_RETRIES)
                waiting[future.key] = task[0]
                done.add(future)

        try:
            for _ in range(_QUEUE * max(1, self.workers)):
                submit()
            for future in done:
                chunk = waiting.pop(future.key)
                yield chunk, future.result()
                submit()
        finally:
            self.client.cancel(list(done.futures), force=True)


@contextmanager
def engine(workers: int | None = None, cluster: str | None = None) -> Iterator[Engine]:
    """In this process by default; `workers` local processes that share the cores; or the workers of a running scheduler at `cluster`.

    Raises ConfigError where dask.distributed is missing or the address does not answer.
    """
    if workers is None and cluster is None:
        yield InProcess()
        return
    if workers is not None and cluster is not None:
        raise ConfigError("--workers starts processes on this machine and --cluster uses running ones; give one of them")
    try:
        import distributed
    except ImportError:
        raise ConfigError("several processes need dask.distributed; install the extra: pip install 'torchsar-lab[cluster]'") from None
    with _local(distributed, workers) if workers is not None else _remote(distributed, str(cluster)) as chosen:
        yield chosen


@contextmanager
def _local(distributed: Any, workers: int) -> Iterator[Engine]:
    threads = max(1, torch.get_num_threads() // workers)
    with (
        distributed.LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=40, memory_limit=0) as local,
        distributed.Client(local) as client,
    ):
        yield Distributed(client, workers, threads)


@contextmanager
def _remote(distributed: Any, address: str) -> Iterator[Engine]:
    try:
        client = distributed.Client(address, timeout=20)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster {address} does not answer ({' '.join(str(error).split())}); start a scheduler there, or leave --cluster out") from None
    with client:
        client.wait_for_workers(1, timeout=600)
        yield Distributed(client, len(client.scheduler_info()["workers"]))
