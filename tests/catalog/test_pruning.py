"""Pruning frees what was not used for longest, and nothing else."""

import gc
import os
import time

import fsspec
import numpy as np
import pytest
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem
from seamosaic.catalog import json_files, leases, pruning
from seamosaic.catalog.filesystems import ObjectStoreError
from seamosaic.catalog.store import Store

KEYS = [f"{number:064x}" for number in range(6)]


@pytest.fixture
def out(tmp_path):
    """Six results of two missions, the n-th last used n hours ago, and products of both."""
    for number, key in enumerate(KEYS):
        store = Store(str(tmp_path / ("reef" if number % 2 else "sea") / "steps"))
        store.put("extract", key, {"a": np.zeros(1000)}, {"seconds": 0})
        when = time.time() - 3600 * number
        os.utime(store.path("extract", key), (when, when))
    for mission in ("reef", "sea"):
        (tmp_path / mission / "v1").mkdir()
        (tmp_path / mission / "v1/bathymetry.tif").write_bytes(b"x" * 50_000)
    return tmp_path


def left(out):
    return sorted(int(path.stem, 16) for path in out.rglob("*.npz"))


def size_of_one(out):
    return next(out.rglob("*.npz")).stat().st_size


def test_what_was_used_last_stays(out):
    one = size_of_one(out)
    pruned = pruning.prune(str(out), 2.5 * one)
    assert left(out) == [0, 1]
    assert (pruned.before, pruned.freed, pruned.entries, pruned.busy) == (6 * one, 4 * one, 4, ())
    assert len(list(out.rglob("bathymetry.tif"))) == 2
    assert pruning.prune(str(out), 2.5 * one).entries == 0


def test_of_results_used_at_the_same_time_no_more_go_than_must(out):
    for path in out.rglob("*.npz"):
        os.utime(path, (1e9, 1e9))
    one = size_of_one(out)
    assert pruning.prune(str(out), 3.5 * one).entries == 3
    assert len(left(out)) == 3


def test_no_listing_of_all_missions_is_held(out, monkeypatch):
    """What it holds of results while it looks at all missions is sizes and times."""
    held, entries = [], pruning._entries

    def listing(*given):
        held.append(sum(isinstance(one, pruning.Entry) for one in gc.get_objects()))
        return entries(*given)

    monkeypatch.setattr(pruning, "_entries", listing)
    assert pruning.prune(str(out), 0).entries == 6
    looks = len(json_files.names(str(out)))
    assert held[:looks] == held[:1] * looks


def test_use_counts_not_age(out):
    Store(str(out / "reef/steps")).touch("extract", KEYS[5])
    pruning.prune(str(out), 1.5 * size_of_one(out))
    assert left(out) == [5]


def test_a_dry_run_says_the_same_and_removes_nothing(out):
    said = pruning.prune(str(out), 0, dry_run=True)
    assert left(out) == list(range(6))
    assert pruning.prune(str(out), 0) == said
    assert left(out) == []


def test_a_running_mission_is_left_alone_and_others_make_room(out):
    with leases.take(str(out), "reef", shared=True):
        pruned = pruning.prune(str(out), 3 * size_of_one(out))
    assert pruned.busy == ("reef",)
    assert left(out) == [1, 3, 5]


def test_a_run_that_begins_meanwhile_is_left_alone(out, monkeypatch):
    monkeypatch.setattr(leases, "holder", lambda *_: None)
    with leases.take(str(out), "reef", shared=True):
        pruned = pruning.prune(str(out), 0)
    assert (pruned.busy, pruned.entries) == (("reef",), 3)
    assert left(out) == [1, 3, 5]


def test_what_killed_runs_left_half_written_goes_whatever_the_limit(out):
    half = out / "reef/steps/.tmp/host-17-0123abcd"
    half.parent.mkdir(parents=True, exist_ok=True)
    half.write_bytes(b"half")
    pruned = pruning.prune(str(out), 1e9)
    assert (pruned.entries, half.exists()) == (1, False)
    assert left(out) == list(range(6))


def test_what_cannot_be_deleted_is_said_and_holds_nothing_else_up(out, monkeypatch):
    remove = LocalFileSystem.rm_file

    def closed(fs, path):
        if KEYS[5] in path:
            raise PermissionError(13, "Permission denied", path)
        remove(fs, path)

    monkeypatch.setattr(LocalFileSystem, "rm_file", closed)
    one = size_of_one(out)
    pruned = pruning.prune(str(out), 0)
    assert (pruned.freed, pruned.entries, left(out)) == (5 * one, 5, [5])
    (why,) = pruned.failed
    assert why.startswith("reef: [Errno 13] Permission denied")


def test_a_mission_that_cannot_be_listed_again_holds_no_other_up(out, monkeypatch):
    looks, entries = [], pruning._entries

    def listing(filesystem, root, name):
        looks.append(name)
        if looks.count("reef") == 2 and name == "reef":
            raise ObjectStoreError("reef: timed out")
        return entries(filesystem, root, name)

    monkeypatch.setattr(pruning, "_entries", listing)
    pruned = pruning.prune(str(out), 0)
    assert (pruned.entries, pruned.failed, left(out)) == (3, ("reef: reef: timed out",), [1, 3, 5])


@pytest.fixture
def remote(out):
    memory = fsspec.filesystem("memory")
    memory.put(f"{out}/", f"/{out.name}/", recursive=True)
    yield f"memory://{out.name}"
    memory.rm(f"/{out.name}", recursive=True)


def test_a_store_removes_many_at_once(remote, monkeypatch):
    asked, remove = [], MemoryFileSystem.rm
    monkeypatch.setattr(MemoryFileSystem, "rm", lambda fs, paths: asked.append(len(paths)) or remove(fs, paths))
    assert pruning.prune(remote, 0).entries == 6
    assert asked == [3, 3]


def test_what_a_store_keeps_in_silence_is_not_freed(remote, monkeypatch):
    monkeypatch.setattr(MemoryFileSystem, "rm", lambda *_: None)
    pruned = pruning.prune(remote, 0)
    assert (pruned.freed, sorted(pruned.failed)) == (
        0,
        [f"{name}: 3 results cannot be deleted" for name in ("reef", "sea")],
    )


def test_without_its_lease_it_removes_nothing_more(out, monkeypatch):
    take = leases.take

    def lost(*given):
        lease = take(*given)
        lease.why = "another run took over"
        lease.lost.set()
        return lease

    monkeypatch.setattr(leases, "take", lost)
    pruned = pruning.prune(str(out), 0)
    assert (pruned.entries, left(out)) == (0, list(range(6)))
    assert sorted(pruned.failed) == ["reef: another run took over", "sea: another run took over"]
