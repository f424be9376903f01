"""Where Dask runs the graph: threads of this process, a cluster of its own, or a cluster elsewhere."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import dask.config
from dask.base import compute
from dask.callbacks import Callback
from dask.delayed import Delayed
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.comm.core import CommClosedError
from distributed.system import MEMORY_LIMIT

from ..schemas.cluster import Cluster
from ..schemas.problems import InvalidInput, Problem
from . import clusters
from .footing import why_not
from .job import Job, log

Progress = Callable[[int], None]

# How often a task's worker may die before the task is to blame. A killed worker takes down all that waits for it too,
# so that Dask's own 3 are soon reached where workers are killed at random
_DEATHS = 50
_SETTINGS = {
    # a busy machine answers late; that is no reason to give up a run
    "distributed.comm.timeouts.connect": "120s",
    "distributed.comm.timeouts.tcp": "300s",
    "distributed.scheduler.allowed-failures": _DEATHS,
}
_HELLO_S, _LOOK_S, _REMIND = "15s", 5.0, 12


class ClusterLost(RuntimeError):
    """The scheduler went away."""


class Executor(Protocol):
    """Computes delayed values, in their order; `advance` is told of every task that ends."""

    def check(self, job: Job) -> None: ...

    def memory_bytes(self) -> float | None: ...

    def compute(self, tasks: Sequence[Delayed], advance: Progress) -> list[Any]: ...


class LocalExecutor:
    """Dask's own schedulers in this process: `sync` or `threads`."""

    def __init__(self, scheduler: str, workers: int):
        self._options = {"scheduler": scheduler, "num_workers": workers}

    def check(self, job: Job) -> None:
        """This process sees what it sees."""

    def memory_bytes(self) -> float | None:
        """What a thread may use."""
        return MEMORY_LIMIT / self._options["num_workers"] if MEMORY_LIMIT else None

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

    def check(self, job: Job) -> None:
        """Wait for a worker, and refuse those of another version or that do not see mission and store.

        Raises
        ------
        InvalidInput
            With every worker that cannot work on the mission. One that comes later is refused by its first task.
        """
        self._wait()
        assert job.footing is not None
        answers = self.client.run(why_not, job.mission_url, job.store, job.footing, on_error="return")
        # a worker that died over the question refuses nothing, and its successor is asked by its first task
        refusals = {name: why for name, why in answers.items() if why and not isinstance(why, OSError)}
        problems = [_refused(address, answer) for address, answer in sorted(refusals.items())]
        if problems:
            raise InvalidInput(problems)

    def memory_bytes(self) -> float | None:
        """What the smallest worker may use; None without a limit."""
        workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        return min((worker["memory_limit"] for worker in workers if worker["memory_limit"]), default=None)

    def _wait(self) -> None:
        """Until there is a worker: a cluster that adapts starts one only where a task asks for it."""
        self.client.submit(os.getpid, pure=False).result()

    def compute(self, tasks: Sequence[Delayed], advance: Progress) -> list[Any]:
        with _clearly(self.client):
            futures: list[Future] = self.client.compute(list(tasks), optimize_graph=False)  # type: ignore[assignment]
            try:
                for future in as_completed(futures):
                    if future.status != "finished":
                        future.result()
                    advance(1)
                return list(self.client.gather(futures))  # type: ignore[arg-type]
            finally:
                if self.client.status == "running":
                    self.client.cancel(futures)


def _refused(address: str, answer: Any) -> Problem:
    found = answer if isinstance(answer, str) else f"no or another seamosaic ({answer})"
    remedy = (
        "Install the same seamosaic on all workers and start them again; without a disk that all of them see, "
        "put mission and OUT on object storage (docs/clusters.md)."
    )
    return Problem("--scheduler", None, f"worker {address}", found, "what the run was started with", remedy)


@contextmanager
def _clearly(client: Client) -> Iterator[None]:
    """What Dask raises when workers or the scheduler die, in words."""
    try:
        yield
    except KilledWorker as error:
        raise RuntimeError(
            f"the worker died {_DEATHS} times over one task ({error.task}), most likely for want of memory: "
            "give workers more of it (fewer --workers, or `memory` in the cluster file), and run again to go on"
        ) from error
    except (CommClosedError, TimeoutError, OSError) as error:
        if client.status == "running":
            raise
        raise _lost(client) from error
    except BaseException as error:
        if "Cancelled" in type(error).__name__:
            raise _lost(client) from error
        raise


def _lost(client: Client) -> ClusterLost:
    address = client.scheduler.address if client.scheduler else "the cluster"
    return ClusterLost(
        f"the scheduler ({address}) went away, or gave up the run's tasks; what is done is kept: start it again, "
        "if it is not one of this run's own, and run again to go on from here"
    )


@contextmanager
def open_executor(scheduler: str | None, workers: int | None, cluster: Cluster | None = None) -> Iterator[Executor]:
    """An executor for as long as the context lasts.

    Parameters
    ----------
    scheduler : None for a cluster of its own; `sync` or `threads`; or the address of a scheduler (tcp://...).
    workers : processes or threads of this machine; None for one a core. Without meaning for a cluster elsewhere.
    cluster : what cluster of its own; None for processes of this machine.
    """
    dask.config.set(_SETTINGS)
    if scheduler == "sync":  # one task at a time
        yield LocalExecutor(scheduler, 1)
    elif scheduler == "threads":
        yield LocalExecutor(scheduler, clusters.local(workers).workers or 1)
    elif scheduler is None:
        described = cluster or clusters.local(workers)
        with clusters.start(described) as running, Client(running) as client:
            own = running if isinstance(running, LocalCluster) and described.adapt is None else None
            with _watched(client, own, described.workers or 1):
                yield _announced(client)
    else:
        client = _connect(scheduler)
        try:
            client.run_on_scheduler(_tolerant(_DEATHS))
            with _watched(client):
                yield _announced(client)
        finally:
            with suppress(OSError, TimeoutError, RuntimeError):
                client.close()


@contextmanager
def _watched(client: Client, own: LocalCluster | None = None, wanted: int = 0) -> Iterator[None]:
    """Say when there is no worker for a while, and replace those of this machine that nobody else does."""
    ended, dead, missed = threading.Event(), frozenset(), 0

    def watch() -> None:
        nonlocal dead, missed
        while not ended.wait(_LOOK_S):
            with suppress(OSError, TimeoutError, RuntimeError):  # the run itself will say what is wrong
                if own is not None:
                    dead = clusters.replace_dead(own, wanted, dead)
                missed = 0 if client.scheduler_info(n_workers=-1)["workers"] else missed + 1
                if missed and missed % _REMIND == 0:
                    log.warning("step=%s there is no worker; waiting for one", "cluster")

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _announced(client: Client) -> ClusterExecutor:
    log.info("step=%s scheduler=%s dashboard=%s", "cluster", client.scheduler.address, client.dashboard_link)  # type: ignore[union-attr]
    return ClusterExecutor(client)


def _tolerant(deaths: int) -> Callable[[Any], None]:
    """What sets the scheduler's patience with tasks whose workers die; sent whole, as it may not have our code."""

    def set_it(dask_scheduler: Any) -> None:
        dask_scheduler.allowed_failures = max(dask_scheduler.allowed_failures, deaths)

    return set_it


def _connect(address: str) -> Client:
    try:
        return Client(address, timeout=_HELLO_S)
    except (OSError, ValueError, TimeoutError) as error:
        remedy = "Start one with `dask scheduler` and `dask worker ADDRESS`, or leave --scheduler away."
        raise InvalidInput(
            [Problem("--scheduler", None, "", f"{address} ({error})", "a Dask scheduler that answers", remedy)]
        ) from error
