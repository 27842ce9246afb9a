"""Scheduler and workers of dask for one machine, which open no port for web browsers."""

from typing import Any

from distributed import Scheduler, Worker


class _WithoutHttp:
    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Start no HTTP server, which dask starts even if no page is asked for."""


class SchedulerWithoutHttp(_WithoutHttp, Scheduler):
    """Scheduler that listens to its clients and workers alone."""


class WorkerWithoutHttp(_WithoutHttp, Worker):
    """Worker that listens to the scheduler and to other workers alone."""
