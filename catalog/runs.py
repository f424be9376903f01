"""Names of what a run leaves while it is under way, by which the leftovers of dead runs are found."""

import os
import re
import socket
from typing import Final
from uuid import uuid4

LEASE_S: Final = 24 * 3600.0
_NAME: Final = re.compile(r"(?P<host>[^ ]*)-(?P<pid>[0-9]+)-[0-9a-f]{8}")


def run_name() -> str:
    """A new name that tells who gave it: host, process, and something of its own."""
    return f"{socket.gethostname()}-{os.getpid()}-{uuid4().hex[:8]}"


def is_dead(name: str, quiet_s: float) -> bool:
    """Whether the process that gave a name is gone from this host, or, on any host, silent for the lease.

    quiet_s : seconds since it was last heard of.
    """
    match = _NAME.fullmatch(name)
    return match is not None and (quiet_s > LEASE_S or _is_gone(match["host"], int(match["pid"])))


def _is_gone(host: str, pid: int) -> bool:
    if os.name != "posix" or host != socket.gethostname():  # elsewhere signal 0 is not a question
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass
    return False
