"""A scheduler, workers and an S3 server, each a process of its own on a free port of this machine."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
PATIENCE_S = 180
_PORTS = range(20_000, 32_000)
_given: set[int] = set()


def free_port() -> int:
    """A port below those that the system gives away by itself: nobody takes it until a server has started."""
    first = _PORTS.start + os.getpid() % 100 * 100  # other processes of the tests look elsewhere first
    for port in itertools.chain(range(first, _PORTS.stop), range(_PORTS.start, first)):
        if port not in _given:
            _given.add(port)
            with socket.socket() as probe, suppress(OSError):
                probe.bind(("127.0.0.1", port))
                return port
    raise RuntimeError("no port is free")


def wait_for_port(port: int, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        assert process.poll() is None, f"{process.args} ended"
        assert time.monotonic() < deadline, f"{process.args} does not answer"
        with socket.socket() as probe:
            probe.settimeout(1)
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)


@contextmanager
def process(
    *command: str | Path | int, folder: Path, log: str, env: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen]:
    """A process in a folder of its own, its output in a file there; ended by its id."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / log).open("ab") as output:
        started = subprocess.Popen(
            [str(part) for part in command], cwd=folder, stdout=output, stderr=output, env={**os.environ, **(env or {})}
        )
    try:
        yield started
    finally:
        end(started)


def end(started: subprocess.Popen, how: int = signal.SIGTERM) -> None:
    if started.poll() is None:
        os.kill(started.pid, how)
        try:
            started.wait(20)
        except subprocess.TimeoutExpired:
            os.kill(started.pid, signal.SIGKILL)
            started.wait()


class S3(NamedTuple):
    """An S3 server; env : what reaches it. faults : the file that says how it misbehaves."""

    env: dict[str, str]
    faults: Path
    bucket: str = "missions"

    def url(self, *parts: str) -> str:
        return "/".join([f"s3://{self.bucket}", *parts])

    @contextmanager
    def misbehaving(self, **fault: float | bool) -> Iterator[None]:
        temporary = self.faults.with_suffix(".new")
        temporary.write_text(json.dumps(fault))
        temporary.replace(self.faults)
        try:
            yield
        finally:
            self.faults.unlink()


@contextmanager
def s3_server(folder: Path) -> Iterator[S3]:
    port, faults = free_port(), folder / "faults.json"
    with process(sys.executable, HERE / "faulty_s3.py", port, faults, folder=folder, log="s3.log") as server:
        wait_for_port(port, server)
        yield S3(
            {
                "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
                "AWS_ACCESS_KEY_ID": "someone",
                "AWS_SECRET_ACCESS_KEY": "secret",
                "AWS_DEFAULT_REGION": "us-east-1",
            },
            faults,
        )


@contextmanager
def scheduler(folder: Path, port: int | None = None) -> Iterator[tuple[str, subprocess.Popen]]:
    """`dask scheduler`: its address and process."""
    port = port or free_port()
    options = ["--host", "127.0.0.1", "--port", port, "--no-dashboard"]
    with process(
        sys.executable, "-m", "distributed.cli.dask_scheduler", *options, folder=folder, log="scheduler.log"
    ) as started:
        wait_for_port(port, started)
        yield f"tcp://127.0.0.1:{port}", started


@contextmanager
def worker(address: str, folder: Path, env: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen]:
    """`dask worker` with a working folder of its own, one thread, no nanny."""
    options = ["--nthreads", 1, "--no-nanny", "--no-dashboard", "--host", "127.0.0.1", "--local-directory", folder]
    command = [sys.executable, "-m", "distributed.cli.dask_worker", address, *options]
    with process(*command, folder=folder, log="worker.log", env=env) as started:
        yield started
