"""Leases: who is at work on a mission, and until when that is to be believed.

A lease is a small file OUT/.leases/<mission id>/<number>.json with owner, host, process, and the time of its last
heartbeat. A thread renews it; one that was not renewed for its term has lapsed, whoever held it, and the next number
may be taken. Numbers are taken by creating the file, which succeeds for one of several at once (a hard link locally,
a conditional put in an object store); nothing stays behind that a person would have to remove. Clocks of the hosts
that share an archive should agree to a few seconds (NTP).
"""

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple, Self

from . import json_files

log = logging.getLogger("seamosaic")

FOLDER: Final = ".leases"
TERM_S: Final = 120.0
_BEATS_A_TERM: Final = 5
_ASK_AGAIN_S: Final = 0.2
_TAKEN_OVER: Final = "another run took over its lease; see that this machine's clock is right"
_LATE: Final = "its lease could not be renewed for {:g} s; see that this machine reaches and may write the products"
_TAKEN: Final[set["Lease"]] = set()  # by this process, and not given back


class Holder(NamedTuple):
    """Who holds a lease.

    Attributes
    ----------
    purpose : run or prune. host, pid : of the process. since, heartbeat : POSIX seconds. term_s : how long after a
        heartbeat it is believed. token : tells this lease from any other.
    """

    purpose: str
    host: str
    pid: int
    since: float
    heartbeat: float
    term_s: float
    token: str

    @property
    def lapsed(self) -> bool:
        return time.time() > self.heartbeat + self.term_s

    def __str__(self) -> str:
        since = datetime.fromtimestamp(self.since, UTC)
        return f"{self.purpose} by process {self.pid} on {self.host} since {since:%Y-%m-%d %H:%M:%S} UTC"


class Busy(Exception):
    """Somebody else holds the lease: `holder`, if it could be read."""

    def __init__(self, holder: Holder | None):
        self.holder = holder
        super().__init__(str(holder) if holder else "taken just now")


class Lease:
    """A lease that is held; use as a context manager, which renews it until it is left.

    Attributes
    ----------
    holder : us. lost : set when it could not be renewed within its term or was taken by another. why : which of these.
    """

    def __init__(self, url: str, holder: Holder):
        self.url, self.holder, self.lost, self.why = url, holder, threading.Event(), ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name=f"lease {url}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()  # else it may be writing
        self.give_back()

    def give_back(self) -> None:
        """Remove its file, if no other took it meanwhile."""
        self._ended.set()
        with suppress(OSError):  # what cannot be given back lapses
            if self.is_ours():
                json_files.remove(self.url)
        _TAKEN.discard(self)

    def _beat(self) -> None:
        term, renewed = self.holder.term_s, time.monotonic()
        while not self._ended.wait(term / _BEATS_A_TERM):
            with suppress(OSError):
                late = time.monotonic() - renewed > term
                if late or not self.is_ours():
                    self.why = _LATE.format(term) if late else _TAKEN_OVER
                    self.lost.set()
                    return
                json_files.write_json(self.url, self.holder._replace(heartbeat=time.time())._asdict())
                if time.monotonic() - renewed < term:  # else another may have begun before it was written
                    renewed = time.monotonic()

    def is_ours(self) -> bool:
        """Whether it has not been taken by another."""
        found = _read(self.url)
        return found is not None and found.token == self.holder.token


def holder(out: str, mission_id: str) -> Holder | None:
    """Who is at work on a mission now."""
    return next((found for _, found in _all(_folder(out, mission_id)) if found and not found.lapsed), None)


def take(out: str, mission_id: str, purpose: str = "run", term_s: float = TERM_S, *, shared: bool = False) -> Lease:
    """Take the lease of a mission, from one that has lapsed if need be; enter it to keep it.

    Parameters
    ----------
    shared : go on beside others that run: only to say that somebody is at work.

    Raises
    ------
    Busy
        If it is held by another. What prunes is waited for, as that takes seconds.
    """
    said = False
    while True:
        try:
            return _take(_folder(out, mission_id), purpose, term_s, shared)
        except Busy as busy:
            prunes = busy.holder is not None and busy.holder.purpose == "prune"
            if not shared and (purpose == "prune" or not prunes):
                raise
            if prunes and not said:
                log.info("mission=%s step=%s waiting for %s", mission_id, "lease", busy)
                said = True
            time.sleep(_ASK_AGAIN_S)


def _take(folder: str, purpose: str, term_s: float, shared: bool) -> Lease:
    now = time.time()
    ours = Holder(purpose, socket.gethostname(), os.getpid(), now, now, term_s, secrets.token_hex(8))
    present = _all(folder)
    _refuse(present, lambda one: not shared or one.purpose == "prune")
    number = max((number for number, _ in present), default=0) + 1
    url = f"{folder}/{number}.json"
    lease = Lease(url, ours)
    _TAKEN.add(lease)
    try:
        json_files.write_json(url, ours._asdict(), new=True)
        _confirm(lease, folder, shared)
    except FileExistsError:
        _TAKEN.discard(lease)
        raise Busy(_read(url)) from None
    except BaseException:
        lease.give_back()
        raise
    return lease


def give_back_all() -> None:
    """Give back what this process has taken, before it ends: a signal may come before a lease is entered."""
    for lease in tuple(_TAKEN):
        lease.give_back()


def _confirm(lease: Lease, folder: str, shared: bool) -> None:
    """Look again after creating it: the first look may have been too old, and not every store creates atomically."""
    if not shared:
        found = _read(lease.url)
        if found is None or found.token != lease.holder.token:
            raise Busy(found)
    present = _all(folder)
    _refuse(present, lambda one: one.token != lease.holder.token and (not shared or one.purpose == "prune"))
    for number, one in present:
        if one is not None and one.lapsed and one.token != lease.holder.token:
            json_files.remove(f"{folder}/{number}.json")


def _refuse(present: list[tuple[int, Holder | None]], hinders: Callable[[Holder], bool]) -> None:
    for _, one in present:
        if one is not None and not one.lapsed and hinders(one):
            raise Busy(one)


def _folder(out: str, mission_id: str) -> str:
    return f"{out.rstrip('/')}/{FOLDER}/{mission_id}"


def _all(folder: str) -> list[tuple[int, Holder | None]]:
    """Numbers and holders of the leases of a mission, lapsed ones too; None for one that vanished meanwhile."""
    numbers = sorted(int(name[:-5]) for name in json_files.names(folder) if name[:-5].isdigit())
    return [(number, _read(f"{folder}/{number}.json")) for number in numbers]


def _read(url: str) -> Holder | None:
    found: Any = json_files.read_json(url, strict=True)
    try:
        return Holder(**found)
    except TypeError:
        return None
