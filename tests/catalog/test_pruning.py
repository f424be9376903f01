"""Pruning frees what was not used for longest, and nothing else."""

import os
import time

import numpy as np
import pytest
from seamosaic.catalog import leases, pruning
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
