"""Runs that are disturbed in every way: in the end the data are those of the run that was left alone."""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import s3fs
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.run import RunResult, run

from tests import fleet
from tests.fleet import PATIENCE_S
from tests.products import differing
from tests.simulated import small_mission

# many small tasks, so that there is always one to disturb
CHOSEN = {"grid": {"tile_cells": 64}, "mosaic": {"tile_cells": 256}}
PARAMETERS = Parameters.model_validate(CHOSEN)
SETTINGS = [f"--set={stage}.{name}={value}" for stage, values in CHOSEN.items() for name, value in values.items()]
ID = "reef-3"
KILLS = 50


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_mission(tmp_path_factory.mktemp("small") / "mission", images=6, width=320, seed=3)


@pytest.fixture(scope="module")
def calm(mission: Path) -> RunResult:
    """The run that is left alone."""
    return run(str(mission), mission.parent / "calm", PARAMETERS, scheduler="sync")


def command(mission: Path | str, out: Path | str, *options: str) -> list[str]:
    seamosaic = [sys.executable, "-m", "seamosaic.workflows.cli"]
    return [*seamosaic, "run", str(mission), "-o", str(out), *SETTINGS, "--log-json", *options]


def finish(mission: Path | str, out: Path | str, *options: str, **how: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(mission, out, *options), capture_output=True, text=True, timeout=4 * PATIENCE_S, check=False, **how
    )


def left_over(out: Path) -> list[str]:
    """What is neither a version nor a result nor remembered."""
    found = [path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()]
    return [name for name in found if "/.new-" in name or "/.tmp/" in name]


def is_at_work(process: psutil.Process) -> bool:
    """Whether a process is a Dask worker that has started: it listens."""
    try:
        return any(connection.status == psutil.CONN_LISTEN for connection in process.net_connections("tcp"))
    except psutil.Error:
        return False


@contextmanager
def kills(rng: random.Random) -> Iterator[list[int]]:
    """Workers of this process die a while after they have started; the list of those killed."""
    killed: list[int] = []
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(rng.uniform(0.0, 15.0)):  # a worker takes seconds to start: some must live to do something
            found = [child for child in psutil.Process().children() if is_at_work(child)]
            if found:
                victim = rng.choice(found)
                victim.kill()
                killed.append(victim.pid)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        ended.set()
        thread.join()


@pytest.mark.slow
def test_workers_killed_at_random(mission, calm, tmp_path):
    rng, count, turn = random.Random(0), 0, 0
    while count < KILLS:
        turn += 1
        out = tmp_path / f"out{turn}"
        with kills(rng) as killed:
            result = run(str(mission), out, PARAMETERS, workers=2)
        count += len(killed)
        assert differing(result.path, calm.path) == []
        assert left_over(out) == []
        print(f"{len(killed)} kills in run {turn}")
    assert turn > 1


@pytest.mark.slow
def test_a_client_killed_ten_times(mission, calm, tmp_path):
    """The run is always stopped at another place, and always goes on into the same OUT."""
    rng, killed = random.Random(1), 0
    while killed < 10:
        process = subprocess.Popen(
            command(mission, tmp_path, "--scheduler", "threads"), stderr=subprocess.PIPE, text=True
        )
        assert process.stderr is not None
        process.stderr.readline()  # it has begun
        time.sleep(rng.uniform(0, 6))
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            killed += 1
        process.wait()
        process.stderr.close()
        found = sorted((tmp_path / ID).glob("v*"))
        assert all(differing(version, calm.path) == [] for version in found)  # nothing half-written is a version
        if found:  # it was too fast: once more from the start
            shutil.rmtree(tmp_path / ID)
    assert finish(mission, tmp_path, "--scheduler", "threads").returncode == 0
    assert differing(tmp_path / ID / "v1", calm.path) == []
    assert left_over(tmp_path) == []


@pytest.mark.slow
def test_a_scheduler_that_dies_is_a_clear_failure(mission, calm, tmp_path):
    with fleet.scheduler(tmp_path / "scheduler") as (address, scheduler), fleet.worker(address, tmp_path / "worker"):
        process = subprocess.Popen(
            command(mission, tmp_path / "out", "--scheduler", address), stderr=subprocess.PIPE, text=True
        )
        while not list((tmp_path / "out").rglob("*.npz")):
            assert process.poll() is None
            time.sleep(0.02)
        fleet.end(scheduler, signal.SIGKILL)
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "went away" in said
    assert "run again" in said
    assert not list((tmp_path / "out").glob("*/v*"))
    with fleet.scheduler(tmp_path / "scheduler") as (address, _), fleet.worker(address, tmp_path / "worker"):
        assert finish(mission, tmp_path / "out", "--scheduler", address).returncode == 0
    assert differing(tmp_path / "out" / ID / "v1", calm.path) == []


@pytest.mark.slow
@pytest.mark.parametrize("kilobytes", [2, 30, 60, 90, 200, 500])
def test_writing_that_fails_is_a_clear_failure(mission, calm, tmp_path, kilobytes):
    """A limit on the size of a file stands for a full disk: every layer, GDAL and HDF5 too, is refused the write."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * kilobytes, resource.RLIM_INFINITY))

    stopped = finish(mission, tmp_path, "--scheduler", "sync", preexec_fn=limit)
    assert stopped.returncode == 1
    assert not list(tmp_path.glob("*/v*"))
    assert left_over(tmp_path) == []
    assert finish(mission, tmp_path, "--scheduler", "sync").returncode == 0
    assert differing(tmp_path / ID / "v1", calm.path) == []


@pytest.mark.slow
def test_every_stored_result_damaged(mission, calm, tmp_path):
    """Found while a later step is made; the same run makes them anew."""
    shutil.copytree(calm.path.parent / "steps", tmp_path / ID / "steps")
    rng, damaged = random.Random(2), 0
    for path in sorted((tmp_path / ID / "steps").rglob("*.npz")):
        content = bytearray(path.read_bytes())
        content[rng.randrange(len(content) // 2)] ^= 0x10
        path.write_bytes(content)
        damaged += 1
    result = run(str(mission), tmp_path, PARAMETERS, scheduler="sync")
    assert damaged > 20
    assert differing(result.path, calm.path) == []


@pytest.mark.slow
def test_two_runs_at_once_make_one_version(mission, calm, tmp_path):
    runs = [
        subprocess.Popen(command(mission, tmp_path, "--scheduler", "threads"), stderr=subprocess.DEVNULL) for _ in "ab"
    ]
    assert [process.wait(4 * PATIENCE_S) for process in runs] == [0, 0]
    assert [path.name for path in (tmp_path / ID).glob("v*")] == ["v1"]
    assert differing(tmp_path / ID / "v1", calm.path) == []
    assert left_over(tmp_path) == []


FULL_DISK = """\
mount -t tmpfs -o size={size}k tmpfs {out} || exit 77
{run} && exit 1
test $? -eq 1 || exit 2
ls -d {out}/*/v* && exit 3
mount -o remount,size=200m {out} && {run} && cp -r {out}/{id}/v1 {kept}
"""


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a disk of a few kilobytes")
@pytest.mark.parametrize("size", [200, 1100, 2600])
def test_a_disk_that_is_full(mission, calm, tmp_path, size):
    """While results are stored, and while products are written; with more space the same command goes on."""
    (tmp_path / "out").mkdir()
    again = " ".join(command(mission, tmp_path / "out", "--scheduler", "sync"))
    script = FULL_DISK.format(size=size, out=tmp_path / "out", run=again, id=ID, kept=tmp_path / "v1")
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", script], capture_output=True, text=True, timeout=900, check=False
    )
    if done.returncode == 77:
        pytest.skip("no mount here")
    assert done.returncode == 0, done.stderr
    assert "No space left" in done.stderr
    assert differing(tmp_path / "v1", calm.path) == []


@pytest.mark.slow
def test_an_object_store_that_errs_and_one_that_fails(mission, calm, s3, tmp_path):
    """A tenth of all requests fail and all are slow: the same result. None is answered: a failure, then the rest."""
    fs = s3fs.S3FileSystem(use_listings_cache=False)
    fs.put(str(mission), f"{s3.bucket}/disturbed", recursive=True)
    url, out = s3.url("disturbed"), s3.url("disturbed-out")
    with s3.misbehaving(errors=0.1, delay_s=0.02):
        result = run(url, out, PARAMETERS, scheduler="threads", workers=2)
    fs.get(f"{s3.bucket}/disturbed-out/{ID}/v1", str(tmp_path / "v1"), recursive=True)
    assert differing(tmp_path / "v1", calm.path) == []
    assert result.new
    fs.rm(f"{s3.bucket}/disturbed-out", recursive=True)
    tries = {**os.environ, "AWS_MAX_ATTEMPTS": "2"}
    process = subprocess.Popen(
        command(url, out, "--scheduler", "threads"), stderr=subprocess.PIPE, text=True, env=tries
    )
    while not [path for path in fs.find(f"{s3.bucket}/disturbed-out") if path.endswith(".npz")]:
        assert process.poll() is None
        time.sleep(0.05)
    with s3.misbehaving(down=True):
        _, said = process.communicate(timeout=4 * PATIENCE_S)
    assert process.returncode == 1
    assert "unwell" in said or "Internal Server Error" in said  # which answers to HEAD, without a body, are
    assert not [path for path in fs.find(f"{s3.bucket}/disturbed-out") if "/v1/" in path]
    assert finish(url, out, "--scheduler", "threads").returncode == 0
    fs.get(f"{s3.bucket}/disturbed-out/{ID}/v1", str(tmp_path / "again"), recursive=True)
    assert differing(tmp_path / "again", calm.path) == []
    left = [path for path in fs.find(f"{s3.bucket}/disturbed-out") if "/.tmp/" in path or "/.claims/" in path]
    assert left == []


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_worker_without_a_nanny_dies_and_the_other_goes_on(mission, calm, s3, tmp_path, victim):
    s3fs.S3FileSystem(use_listings_cache=False).put(str(mission), f"{s3.bucket}/halved{victim}", recursive=True)
    url, out = s3.url(f"halved{victim}"), s3.url(f"halved-out{victim}")
    with (
        fleet.scheduler(tmp_path / "scheduler") as (address, _),
        fleet.worker(address, tmp_path / "one") as one,
        fleet.worker(address, tmp_path / "two") as two,
    ):
        process = subprocess.Popen(command(url, out, "--scheduler", address), stderr=subprocess.PIPE, text=True)
        fs = s3fs.S3FileSystem(use_listings_cache=False)
        while len([path for path in fs.find(f"{s3.bucket}/halved-out{victim}") if path.endswith(".npz")]) < 4:
            assert process.poll() is None
            time.sleep(0.05)
        fleet.end((one, two)[victim], signal.SIGKILL)
        _, said = process.communicate(timeout=4 * PATIENCE_S)
    assert process.returncode == 0, said
    fs.get(f"{s3.bucket}/halved-out{victim}/{ID}/v1", str(tmp_path / "v1"), recursive=True)
    assert differing(tmp_path / "v1", calm.path) == []
