"""Leases: one holder at a time, renewed while it lives, free when it died, nothing left behind."""

import errno
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from seamosaic.catalog import json_files, leases

HOLD = """
import sys, time
from seamosaic.catalog import leases
with leases.take(sys.argv[1], "reef", term_s=float(sys.argv[2])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture(params=["local", "memory", "s3"])
def out(request, tmp_path):
    if request.param == "s3":
        return request.getfixturevalue("s3").url(tmp_path.name)
    return str(tmp_path) if request.param == "local" else f"memory://{tmp_path.name}"


def test_one_holds_it_and_gives_it_back(out):
    assert leases.holder(out, "reef") is None
    with leases.take(out, "reef") as lease:
        assert leases.holder(out, "reef") == lease.holder
        with pytest.raises(leases.Busy, match=f"run by process {os.getpid()} on"):
            leases.take(out, "reef")
        leases.take(out, "sea")
    assert leases.holder(out, "reef") is None
    assert json_files.names(f"{out}/{leases.FOLDER}/reef") == []
    assert not lease.lost.is_set()


@pytest.mark.parametrize("out", ["local", "s3"], indirect=True)  # fsspec's memory is not made for threads
def test_of_many_that_take_it_at_once_one_has_it(out):
    together, inside, most = threading.Barrier(8), [], []

    def contend(_):
        together.wait()
        for _ in range(10):
            try:
                with leases.take(out, "reef"):
                    inside.append(1)
                    most.append(len(inside))
                    time.sleep(0.001)
                    inside.pop()
            except leases.Busy:
                time.sleep(0.001)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(contend, range(8)))
    assert most
    assert max(most) == 1


@pytest.mark.parametrize("out", ["local", "s3"], indirect=True)  # fsspec's memory is not made for threads
def test_of_many_that_find_a_lapsed_one_one_has_it(out):
    for turn in range(10):
        dead = leases.take(out, "reef", term_s=0.05)  # never entered, so never renewed
        time.sleep(0.06)
        together = threading.Barrier(4)

        def contend(_, together=together):
            together.wait()
            try:
                return leases.take(out, "reef")
            except leases.Busy:
                return None

        with ThreadPoolExecutor(4) as pool:
            held = [lease for lease in pool.map(contend, range(4)) if lease]
        assert len(held) == 1, turn
        assert not json_files.exists(dead.url)
        json_files.remove(held[0].url)


def test_it_is_renewed_for_as_long_as_it_is_held(tmp_path):
    with leases.take(str(tmp_path), "reef", term_s=2) as lease:
        until = time.monotonic() + 20
        while (found := leases.holder(str(tmp_path), "reef")) and found.heartbeat < lease.holder.heartbeat + 2.5:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert found is not None
        assert found.token == lease.holder.token
        assert not lease.lost.is_set()


def test_it_is_free_again_when_its_owner_was_killed(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path), "1.5"], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    found = leases.holder(str(tmp_path), "reef")
    assert found is not None
    assert found.pid == process.pid
    with pytest.raises(leases.Busy):
        leases.take(str(tmp_path), "reef")
    time.sleep(max(0.0, found.heartbeat + found.term_s - time.time()) + 0.01)
    with leases.take(str(tmp_path), "reef") as lease:
        assert lease.holder.pid == os.getpid()
        assert len(list(Path(tmp_path).rglob("*.json"))) == 1
    assert not list(Path(tmp_path).rglob("*.json"))


def test_who_was_silent_for_too_long_has_lost_it(tmp_path):
    with leases.take(str(tmp_path), "reef", term_s=2) as lease:
        json_files.write_json(lease.url, lease.holder._replace(token="another")._asdict())
        assert lease.lost.wait(20)
        assert "another run took over" in lease.why
    assert json_files.exists(lease.url)  # it is another's now


def test_who_could_not_renew_it_has_lost_it_and_says_so(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError("no space left on device")

    with leases.take(str(tmp_path), "reef", term_s=1) as lease:
        monkeypatch.setattr(json_files, "write_json", full)
        assert lease.lost.wait(20)
        assert "could not be renewed for 1 s" in lease.why


def test_who_renewed_it_too_late_has_lost_it(tmp_path, monkeypatch):
    write = json_files.write_json

    def slow(*given, **more):
        time.sleep(1.5)
        write(*given, **more)

    with leases.take(str(tmp_path), "reef", term_s=1) as lease:
        monkeypatch.setattr(json_files, "write_json", slow)
        assert lease.lost.wait(20)
        assert "could not be renewed for 1 s" in lease.why


def test_what_cannot_be_read_for_a_moment_is_not_lost(tmp_path, monkeypatch):
    with leases.take(str(tmp_path), "reef", term_s=4) as lease:
        with monkeypatch.context() as patch:
            patch.setattr(leases.json_files, "connect", _down)
            assert not lease.lost.wait(2)
        assert not lease.lost.wait(4)


def _down(url):
    raise OSError(errno.EIO, "input/output error")


def test_runs_of_one_mission_share_and_are_not_pruned(tmp_path):
    out = str(tmp_path)
    with leases.take(out, "reef", shared=True):
        with leases.take(out, "reef", shared=True):
            with pytest.raises(leases.Busy):
                leases.take(out, "reef")
            with pytest.raises(leases.Busy):
                leases.take(out, "reef", "prune")
        assert leases.holder(out, "reef") is not None


@pytest.mark.parametrize("shared", [True, False])
def test_pruning_is_waited_for(tmp_path, shared, caplog):
    pruning = leases.take(str(tmp_path), "reef", "prune")
    threading.Timer(0.5, json_files.remove, [pruning.url]).start()
    with caplog.at_level("INFO", "seamosaic"):
        lease = leases.take(str(tmp_path), "reef", shared=shared)
    assert lease.holder.since >= pruning.holder.since + 0.4
    assert [record.getMessage().split(" by ")[0] for record in caplog.records] == [
        "mission=reef step=lease waiting for prune"
    ]


def test_what_a_signal_interrupts_before_it_is_entered_is_given_back(out):
    leases.take(out, "reef")
    with leases.take(out, "sea") as kept:
        leases.give_back_all()
        assert leases.holder(out, "reef") is None
        assert leases.holder(out, "sea") is None
    assert not kept.lost.is_set()


def test_a_signal_at_any_line_leaves_no_lease(tmp_path):
    """While it is taken, held and given back; what was entered is given back by itself, the rest at the end."""
    before = sys.gettrace()
    for line in itertools.count(1):
        out, left = str(tmp_path / str(line)), [line]

        def count(frame, event, _, left=left):
            if frame.f_code.co_filename != leases.__file__:
                return None
            left[0] -= event == "line"
            if left[0] == 0:
                left[0] = -1
                raise SystemExit
            return count

        try:
            sys.settrace(count)
            with leases.take(out, "reef"):
                pass
            done = left[0] > 0
        except SystemExit:
            done = False
        finally:
            sys.settrace(before)
        leases.give_back_all()
        assert leases.holder(out, "reef") is None, line
        assert not list(tmp_path.rglob("*.json"))
        if done:
            break
    assert line > 50
