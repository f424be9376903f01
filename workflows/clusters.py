"""Clusters that a run starts and ends itself: processes of this machine, or jobs of Slurm or PBS."""

import os
from contextlib import suppress
from typing import Any

import dask.config
from distributed import LocalCluster
from distributed.deploy.cluster import Cluster as Running
from distributed.system import MEMORY_LIMIT

from ..schemas.cluster import Cluster
from ..schemas.problems import InvalidInput, Problem
from .heap import WORKER_ENVIRONMENT

_FREE_PORT = ":0"
# How often scheduler, nannies and workers of this machine look at themselves: at Dask's own intervals, of 10 to 500 ms,
# that took a twentieth of a core
_SETTINGS = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "2s",
}
_STARTS = 5


def start(described: Cluster) -> Running:
    """Start a cluster with its workers; in a queue these may come later.

    Raises
    ------
    InvalidInput
        If dask-jobqueue is needed and not installed.
    """
    cluster = _local(described) if described.kind == "local" else _jobs(described)
    if described.adapt is not None:
        cluster.adapt(minimum=described.adapt.min, maximum=described.adapt.max)
    elif described.kind != "local":
        cluster.scale(described.workers or 1)
    return cluster


def replace_dead(cluster: Running, wanted: int, before: frozenset) -> frozenset:
    """Start the workers of this machine that are missing now and were before; names of those to be missed next time.

    A nanny starts its worker again, but gives up if that is killed while it starts, and nobody takes its place.
    """
    missing = frozenset(cluster.worker_spec) - frozenset(cluster.workers)
    if missing & before:
        cluster.scale(wanted)  # which looks at what is there
        return frozenset()  # they take a while to start
    return missing


def local(workers: int | None) -> Cluster:
    """One worker a core, or so many."""
    return Cluster(kind="local", workers=workers or os.cpu_count() or 1)


def _local(described: Cluster) -> LocalCluster:
    dask.config.set(_SETTINGS)
    environment = "distributed.nanny.pre-spawn-environ"
    dask.config.set({f"{environment}.{name}": value for name, value in WORKER_ENVIRONMENT.items()})
    options: dict[str, Any] = {
        "n_workers": described.adapt.min if described.adapt else described.workers or 1,
        "threads_per_worker": 1,
        "dashboard_address": _FREE_PORT,
        "local_directory": described.scratch,
    }
    if described.memory is not None:
        options["memory_limit"] = described.memory
    elif described.adapt is not None and MEMORY_LIMIT:  # Dask would share it among the first workers alone
        options["memory_limit"] = MEMORY_LIMIT // described.adapt.max
    for _ in range(_STARTS - 1):
        with suppress(RuntimeError):  # of a worker that was killed while it started
            return LocalCluster(**options)
    return LocalCluster(**options)


def _jobs(described: Cluster) -> Any:
    try:
        from dask_jobqueue.pbs import PBSCluster
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError as error:
        remedy = "Install it with `.venv/bin/pip install dask-jobqueue`."
        found = f"{described.kind}, without dask-jobqueue"
        raise InvalidInput([Problem("--cluster", None, "kind", found, "an installed dask-jobqueue", remedy)]) from error
    options: dict[str, Any] = {
        "cores": described.cores,
        "processes": described.cores,
        "memory": described.memory,
        "queue": described.queue,
        "account": described.account,
        "walltime": described.walltime,
        "interface": described.interface,
        "local_directory": described.scratch,
        "job_script_prologue": [*_exports(), *described.setup],
        "job_extra_directives": list(described.directives),
        "scheduler_options": {"dashboard_address": _FREE_PORT},
    }
    make = SLURMCluster if described.kind == "slurm" else PBSCluster
    return make(**{name: value for name, value in options.items() if value is not None})


def _exports() -> list[str]:
    return [f"export {name}={value}" for name, value in WORKER_ENVIRONMENT.items()]
