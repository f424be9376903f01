"""Frees intermediate results, least recently used first; products are never touched."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any, Final, NamedTuple

import numpy as np
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray

from . import json_files, leases
from .filesystems import ObjectStoreError, asking, connect, is_glob

STEPS: Final = "steps"
_SCRATCH: Final = ".tmp"  # of Store
_BATCH: Final = 1000  # what S3 removes at once
_MODIFIED: Final = ("mtime", "LastModified", "last_modified", "updated", "created")


class Entry(NamedTuple):
    """A stored result, or what a killed run left of one. used_s : when it was last made or used, POSIX seconds."""

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
    removed, its lease is held; one that a run is at work on is left alone. Of all missions together only sizes and
    times are held in memory; a mission's results are listed again when it is its turn.
    """
    filesystem, _ = connect(out)
    stocks = {name: _stock(_entries(filesystem, out, name)) for name in json_files.names(out)}
    before = sum(int(stock.size.sum()) for stock in stocks.values())
    busy = {name for name, stock in stocks.items() if len(stock.size) and leases.holder(out, name)}
    limit, rest = _limit([stock for name, stock in stocks.items() if name not in busy], before - keep_bytes)
    count, freed, failed = 0, 0, []
    for name, stock in stocks.items():
        if name in busy or not (stock.order <= limit).any():
            continue
        try:
            some, rest = _choose(_entries(filesystem, out, name), limit, rest)
            gone, why = _free(filesystem, out, name, some, term_s) if some and not dry_run else (some, "")
        except leases.Busy:
            busy.add(name)
            continue
        except OSError as error:
            gone, why = [], str(error)
        count, freed = count + len(gone), freed + sum(entry.size for entry in gone)
        failed += [f"{name}: {why}"] if why else []
    return Pruned(before, freed, count, tuple(sorted(busy)), tuple(failed))


class _Stock(NamedTuple):
    """A mission's results: bytes (N,), and the order (N,) in which they go."""

    size: NDArray[np.int64]
    order: NDArray[np.float64]


def _stock(entries: Sequence[Entry]) -> _Stock:
    return _Stock(np.array([entry.size for entry in entries], np.int64), np.array([_order(e) for e in entries], float))


def _order(entry: Entry) -> float:
    """Half-written ones first, then by the time of use."""
    return -math.inf if entry.path.split("/")[-2] == _SCRATCH else entry.used_s


def _limit(stocks: Sequence[_Stock], excess: float) -> tuple[float, float]:
    """The order up to which results go, so that excess bytes do; and how many bytes of those that are at it."""
    order = np.concatenate([np.zeros(0), *(stock.order for stock in stocks)])
    size = np.concatenate([np.zeros(0, np.int64), *(stock.size for stock in stocks)])
    if excess <= 0 or not len(order):
        return -math.inf, math.inf
    sequence = np.argsort(order, kind="stable")
    enough = int(np.searchsorted(np.cumsum(size[sequence]), excess))
    limit = float(order[sequence[min(enough, len(order) - 1)]])
    return limit, math.inf if limit == -math.inf else excess - float(size[order < limit].sum())


def _choose(entries: Sequence[Entry], limit: float, rest: float) -> tuple[list[Entry], float]:
    """Those of a mission that go, and how many bytes of others at the limit are to go."""
    chosen = []
    for entry in entries:
        at = _order(entry) == limit and rest > 0
        if at or _order(entry) < limit:
            chosen.append(entry)
            rest -= entry.size if at else 0
    return chosen, rest


def _free(
    filesystem: AbstractFileSystem, out: str, mission_id: str, some: Sequence[Entry], term_s: float
) -> tuple[list[Entry], str]:
    """Remove results of a mission: those that are gone, and why others are not."""
    with leases.take(out, mission_id, "prune", term_s) as lease:
        why = _remove(filesystem, [entry.path for entry in some], lease)
        left = {entry.path for entry in _entries(filesystem, out, mission_id)}  # a store may refuse in silence
    gone = [entry for entry in some if entry.path not in left]
    return gone, why or ("" if len(gone) == len(some) else f"{len(some) - len(gone)} results cannot be deleted")


def _entries(filesystem: AbstractFileSystem, out: str, mission_id: str) -> list[Entry]:
    _, folder = connect(f"{out.rstrip('/')}/{mission_id}/{STEPS}")
    with asking(filesystem, folder):
        found: Any = filesystem.find(folder, detail=True)
    return [Entry(path, int(info["size"] or 0), _used_s(info)) for path, info in found.items()]


def _used_s(info: Mapping[str, Any]) -> float:
    when = next((info[name] for name in _MODIFIED if info.get(name) is not None), 0.0)
    return when.timestamp() if isinstance(when, datetime) else float(when)


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
