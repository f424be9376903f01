"""Cluster files: what they may say, and the jobs that they make."""

import os
import signal
import sys
import time

import pytest
from dask.delayed import delayed
from distributed.system import MEMORY_LIMIT
from seamosaic.schemas.cluster import Cluster
from seamosaic.schemas.problems import InvalidInput
from seamosaic.schemas.yaml_input import load_model
from seamosaic.workflows import clusters, executor, heap, options

SLURM = """\
kind: slurm
adapt: {min: 0, max: 40}
cores: 8
memory: 32 GiB
queue: seabed
account: vortex
walltime: '02:30:00'
interface: lo
setup: [module load python/3.11]
directives: ['--gres=scratch:50G']
scratch: /scratch/seamosaic
"""


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [
        (
            "slurm",
            "#SBATCH -p seabed|#SBATCH -A vortex|#SBATCH -n 1|#SBATCH --cpus-per-task=8|#SBATCH --mem=32G"
            "|#SBATCH -t 02:30:00|#SBATCH --gres=scratch:50G",
        ),
        ("pbs", "#PBS -q seabed|#PBS -A vortex|#PBS -l walltime=02:30:00|ncpus=8:mem=32G|#PBS --gres=scratch:50G"),
    ],
)
def test_a_job_asks_for_what_the_file_says(kind, wanted):
    described = load_model(SLURM.replace("slurm", kind), "cluster.yaml", Cluster)
    with clusters.start(described) as cluster:
        script = cluster.job_script()
        address = cluster.scheduler_address
    lines = script.splitlines()
    for text in wanted.split("|"):
        assert any(line.endswith(text) or text in line for line in lines), f"{text} in\n{script}"
    assert "module load python/3.11" in lines
    assert lines.index("export MALLOC_TRIM_THRESHOLD_=268435456") < lines.index("module load python/3.11")
    (worker,) = (line for line in lines if sys.executable in line)
    assert address in worker
    for option in ("--nthreads 1", "--nworkers 8", "--memory-limit 4.00GiB", "--local-directory /scratch/seamosaic"):
        assert option in worker, script


def test_a_local_cluster_has_its_workers(tmp_path):
    described = load_model(f"kind: local\nworkers: 1\nmemory: 2 GiB\nscratch: {tmp_path}\n", "cluster.yaml", Cluster)
    with clusters.start(described) as cluster:
        (worker,) = cluster.workers.values()
        assert (worker.nthreads, worker.memory_manager.memory_limit) == (1, 2 * 1024**3)
    assert list(tmp_path.iterdir())


def test_workers_that_may_come_have_their_share_of_memory():
    described = load_model("kind: local\nadapt: {min: 1, max: 8}\n", "cluster.yaml", Cluster)
    with clusters.start(described) as cluster:
        (worker,) = cluster.workers.values()
        assert worker.memory_manager.memory_limit == MEMORY_LIMIT // 8


@pytest.mark.parametrize(("scheduler", "workers", "share"), [("sync", None, 1), ("sync", 4, 1), ("threads", 4, 4)])
def test_what_runs_at_once_shares_the_memory(scheduler, workers, share):
    with executor.open_executor(scheduler, workers) as running:
        assert running.memory_bytes() == MEMORY_LIMIT / share


def test_a_cluster_that_begins_without_workers_gets_one():
    described = load_model("kind: local\nadapt: {max: 1}\n", "cluster.yaml", Cluster)
    with executor.open_executor(None, None, described) as running:
        assert isinstance(running, executor.ClusterExecutor)
        running._wait()
        assert running.compute([delayed(sum)([1, 2])], lambda _: None) == [3]


def test_workers_keep_freed_memory_for_the_next_array_and_one_thread():
    with executor.open_executor(None, 1) as running:
        assert isinstance(running, executor.ClusterExecutor)
        (found,) = running.client.run(lambda: dict(os.environ)).values()
    wanted = {**heap.WORKER_ENVIRONMENT, "OMP_NUM_THREADS": 1}
    assert {name: found[name] for name in wanted} == {name: str(value) for name, value in wanted.items()}


@pytest.mark.slow
def test_a_worker_killed_while_it_starts_again_is_replaced(monkeypatch):
    """Its nanny starts no third one: the run would wait for ever."""
    monkeypatch.setattr(executor, "_LOOK_S", 0.2)
    with executor.open_executor(None, 1) as running:
        assert isinstance(running, executor.ClusterExecutor)
        (nanny,) = running.client.cluster.workers.values()
        first = nanny.pid
        os.kill(first, signal.SIGKILL)
        deadline = time.monotonic() + 60
        while nanny.pid in (None, first):
            assert time.monotonic() < deadline
            time.sleep(0.001)
        os.kill(nanny.pid, signal.SIGKILL)
        assert running.compute([delayed(abs)(-1)], lambda _: None) == [1]


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("kind: slurm\n", "memory"),
        ("kind: sge\nmemory: 1 GiB\n", "kind"),
        ("kind: local\nqueue: seabed\n", "queue"),
        ("kind: local\nmemory: much\n", "memory"),
        ("kind: local\nworkers: 2\nadapt: {max: 3}\n", "workers"),
        ("kind: local\nadapt: {min: 4, max: 3}\n", "adapt.min"),
        ("kind: pbs\nmemory: 1 GiB\nwalltime: 2 hours\n", "walltime"),
    ],
)
def test_what_is_wrong_with_a_cluster_file(text, key):
    with pytest.raises(InvalidInput) as caught:
        load_model(text, "cluster.yaml", Cluster)
    assert [problem.key for problem in caught.value.problems] == [key]
    assert all(problem.remedy for problem in caught.value.problems)


def test_what_would_be_passed_over_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="workers"):
        load_model("kind: local\ncores: 8\n", "cluster.yaml", Cluster)
    file = tmp_path / "cluster.yaml"
    file.write_text("kind: local\n")
    with pytest.raises(InvalidInput, match="--cluster and --workers"):
        options.cluster(file, None, 8)
