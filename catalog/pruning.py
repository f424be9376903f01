"""Frees intermediate results, least recently used first; products are never touched."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any, Final, NamedTuple

from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem

from . import json_files, leases
from .filesystems import ObjectStoreError, asking, connect, is_glob

STEPS: Final = "steps"
_SCRATCH: Final = ".tmp"  # of Store
_BATCH: Final = 1000  # what S3 removes at once
_MODIFIED: Final = ("mtime", "LastModified", "last_modified", "updated", "created")


class Entry(NamedTuple):
    """A stored result, or what a killed run left of one. used_s : when it was last made or used, POSIX seconds."""

    mission_id: str
    path: str
    size: int
    used_s: float


class Pruned(NamedTuple):
    """What was freed, or would be.

    Attributes
    ----------
    before, freed : bytes of all intermediate results, and of those that are gone. entries : how many these were.
    busy : missions that were left alone because a run is at work on them. failed : missions of which something could
        not be freed, and why.
    """

    before: int
    freed: int
    entries: int
    busy: tuple[str, ...]
    failed: tuple[str, ...] = ()


def exists(out: str) -> bool:
    """Whether there is such a folder."""
    filesystem, path = connect(out)
    with asking(filesystem, out):
        return filesystem.isdir(path)


def prune(out: str, keep_bytes: float, *, dry_run: bool = False, term_s: float = leases.TERM_S) -> Pruned:
    """Remove intermediate results until what is left of them in OUT is no more than keep_bytes.

    What killed runs left half-written goes first, then what was not used for longest. While a mission's results are
    removed, its lease is held; one that a run is at work on is left alone.
    """
    filesystem, _ = connect(out)
    entries = [entry for mission_id in json_files.names(out) for entry in _entries(filesystem, out, mission_id)]
    before = sum(entry.size for entry in entries)
    missions = {entry.mission_id for entry in entries}
    busy = {mission_id for mission_id in missions if leases.holder(out, mission_id)}
    chosen = _choose([entry for entry in entries if entry.mission_id not in busy], before - keep_bytes)
    freed, failed = [], []
    for mission_id, some in chosen.items():
        try:
            gone, why = (some, "") if dry_run else _free(filesystem, out, mission_id, some, term_s)
        except leases.Busy:
            busy.add(mission_id)
            continue
        freed += gone
        failed += [f"{mission_id}: {why}"] if why else []
    return Pruned(before, sum(entry.size for entry in freed), len(freed), tuple(sorted(busy)), tuple(failed))


def _free(
    filesystem: AbstractFileSystem, out: str, mission_id: str, some: Sequence[Entry], term_s: float
) -> tuple[list[Entry], str]:
    """Remove results of a mission: those that are gone, and why others are not."""
    try:
        with leases.take(out, mission_id, "prune", term_s) as lease:
            why = _remove(filesystem, [entry.path for entry in some], lease)
            left = {entry.path for entry in _entries(filesystem, out, mission_id)}  # a store may refuse in silence
    except OSError as error:
        return [], str(error)
    gone = [entry for entry in some if entry.path not in left]
    return gone, why or ("" if len(gone) == len(some) else f"{len(some) - len(gone)} results cannot be deleted")


def _entries(filesystem: AbstractFileSystem, out: str, mission_id: str) -> list[Entry]:
    _, folder = connect(f"{out.rstrip('/')}/{mission_id}/{STEPS}")
    with asking(filesystem, folder):
        found: Any = filesystem.find(folder, detail=True)
    return [Entry(mission_id, path, int(info["size"] or 0), _used_s(info)) for path, info in found.items()]


def _used_s(info: Mapping[str, Any]) -> float:
    when = next((info[name] for name in _MODIFIED if info.get(name) is not None), 0.0)
    return when.timestamp() if isinstance(when, datetime) else float(when)


def _choose(entries: Sequence[Entry], excess: float) -> dict[str, list[Entry]]:
    """What to remove, by mission."""
    chosen: dict[str, list[Entry]] = {}
    for entry in sorted(entries, key=lambda entry: (not _is_half(entry.path), entry.used_s)):
        if excess > 0 or _is_half(entry.path):
            chosen.setdefault(entry.mission_id, []).append(entry)
            excess -= entry.size
    return chosen


def _is_half(path: str) -> bool:
    return path.split("/")[-2] == _SCRATCH


def _remove(filesystem: AbstractFileSystem, paths: Sequence[str], lease: leases.Lease) -> str:
    """Remove files, many with one request where that can be, as long as the lease is ours; why some are not removed."""
    why, single = "", isinstance(filesystem, LocalFileSystem) or is_glob(paths[0])  # as fsspec would take it
    count = 1 if single else _BATCH
    for start in range(0, len(paths), count):
        if lease.lost.is_set():
            return lease.why
        batch = list(paths[start : start + count])
        try:
            with asking(filesystem, batch[0]), suppress(FileNotFoundError):
                filesystem.rm_file(batch[0]) if single else filesystem.rm(batch)
        except ObjectStoreError:
            raise
        except OSError as error:  # of one file: the others can go
            why = why or str(error)
    return why
