"""Where Dask runs the graph: threads of this process, a local cluster, or a cluster elsewhere."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import dask.config
from dask.base import compute
from dask.callbacks import Callback
from dask.delayed import Delayed
from distributed import Client, Future, LocalCluster, as_completed

from ..schemas.problems import InvalidInput, Problem

Progress = Callable[[int], None]

# a busy machine answers late; that is no reason to give up a run
_PATIENCE = {"distributed.comm.timeouts.connect": "120s", "distributed.comm.timeouts.tcp": "300s"}


class Executor(Protocol):
    """Computes delayed values, in their order; `advance` is told of every task that ends."""

    def compute(self, tasks: Sequence[Delayed], advance: Progress) -> list[Any]: ...


class LocalExecutor:
    """Dask's own schedulers in this process: `sync` or `threads`."""

    def __init__(self, scheduler: str, workers: int):
        self._options = {"scheduler": scheduler, "num_workers": workers}

    def compute(self, tasks: Sequence[Delayed], advance: Progress) -> list[Any]:
        wanted = {task.key for task in tasks}

        def ended(key: Any, *_: Any) -> None:
            if key in wanted:
                advance(1)

        with Callback(posttask=ended):
            return list(compute(*tasks, optimize_graph=False, **self._options))


class ClusterExecutor:
    """A `dask.distributed` cluster."""

    def __init__(self, client: Client):
        self.client = client

    def compute(self, tasks: Sequence[Delayed], advance: Progress) -> list[Any]:
        futures: list[Future] = self.client.compute(list(tasks), optimize_graph=False)  # type: ignore[assignment]
        try:
            for future in as_completed(futures):
                if future.status == "error":
                    future.result()
                advance(1)
            return list(self.client.gather(futures))  # type: ignore[arg-type]
        finally:
            self.client.cancel(futures)


@contextmanager
def open_executor(scheduler: str | None, workers: int | None) -> Iterator[Executor]:
    """An executor for as long as the context lasts.

    Parameters
    ----------
    scheduler : None for a cluster of processes on this machine; `sync` or `threads`; or the address of a
        scheduler (tcp://...).
    workers : processes or threads; None for one a core. Without meaning for a scheduler elsewhere.
    """
    count = workers or os.cpu_count() or 1
    dask.config.set(_PATIENCE)
    if scheduler in ("sync", "threads"):
        yield LocalExecutor(scheduler, count)
    elif scheduler is None:
        options: dict[str, Any] = {"n_workers": count, "threads_per_worker": 1, "dashboard_address": ":0"}
        with LocalCluster(**options) as cluster, Client(cluster) as client:
            yield ClusterExecutor(client)
    else:
        with _connect(scheduler) as client:
            yield ClusterExecutor(client)


def _connect(address: str) -> Client:
    try:
        return Client(address, timeout="15s")
    except (OSError, ValueError, TimeoutError) as error:
        remedy = "Start one with `dask scheduler` and `dask worker ADDRESS`, or leave --scheduler away."
        raise InvalidInput(
            [Problem("--scheduler", None, "", f"{address} ({error})", "a Dask scheduler that answers", remedy)]
        ) from error
