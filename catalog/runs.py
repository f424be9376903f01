"""Names of what a run leaves while it is under way, by which the leftovers of dead runs are found."""

import hashlib
import os
import re
import socket
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final
from uuid import uuid4

LEASE_S: Final = 24 * 3600.0
_NAME: Final = re.compile(r"(?P<host>[^ ]*)-(?P<pid>[0-9]+)(\.(?P<realm>[0-9a-f]{8}))?-[0-9a-f]{8}")
_BOOT_ID: Final = "/proc/sys/kernel/random/boot_id"
_PIDS: Final = "/proc/self/ns/pid"


def run_name() -> str:
    """A new name that tells who gave it: host, process and where its number counts, and something of its own."""
    realm = _realm()
    return f"{socket.gethostname()}-{os.getpid()}{'.' if realm else ''}{realm}-{uuid4().hex[:8]}"


@cache
def _realm() -> str:
    """Where process numbers count: containers may share a host's name, and have numbers of their own.

    Of Linux, its start and its namespace of processes; elsewhere nothing.
    """
    with suppress(OSError):
        return hashlib.sha256(f"{Path(_BOOT_ID).read_text()}{os.readlink(_PIDS)}".encode()).hexdigest()[:8]
    return ""


def is_dead(name: str, quiet_s: float) -> bool:
    """Whether the process that gave a name is gone from this host, or, on any host, silent for the lease.

    quiet_s : seconds since it was last heard of.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        return False
    ours = match["host"] == socket.gethostname() and match["realm"] in (None, _realm())  # none: of an earlier seamosaic
    return quiet_s > LEASE_S or (ours and _is_gone(int(match["pid"])))


def _is_gone(pid: int) -> bool:
    if os.name != "posix":  # elsewhere signal 0 is not a question
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass
    return False
