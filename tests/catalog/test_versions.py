"""Versions: numbers, sameness, concurrency and leftovers."""

import json
import os
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from seamosaic.catalog import runs, versions
from seamosaic.catalog.versions import VersionWriter

HOST = socket.gethostname()


def write(out, digest, mission="reef"):
    writer = versions.new_version(out, mission, digest)
    assert isinstance(writer, VersionWriter)
    with writer:
        (writer.folder / versions.PROVENANCE).write_text(json.dumps({"digest": digest}))
        (writer.folder / "report.html").write_text(digest)
    assert writer.path is not None
    return writer.path


def leftover(out, name, age_s=0.0):
    folder = out / "reef" / name
    (folder / "metadata").mkdir(parents=True)
    file = folder / "metadata" / "half.tif"
    file.touch()
    for path in (file, file.parent, folder):
        os.utime(path, (time.time() - age_s, time.time() - age_s))
    return folder


def dead_pid():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_change_makes_the_next_version_and_no_change_none(tmp_path):
    assert write(tmp_path, "one") == tmp_path / "reef" / "v1"
    assert versions.new_version(tmp_path, "reef", "one") == tmp_path / "reef" / "v1"
    assert write(tmp_path, "two") == tmp_path / "reef" / "v2"
    # only the newest counts: going back is a change again
    assert write(tmp_path, "one") == tmp_path / "reef" / "v3"
    assert [version.number for version in versions.list_versions(tmp_path, "reef")] == [1, 2, 3]
    assert sorted(os.listdir(tmp_path / "reef")) == ["v1", "v2", "v3"]
    assert write(tmp_path, "one", mission="sea") == tmp_path / "sea" / "v1"


def test_numbers_are_numbers_not_text(tmp_path):
    for name in ("v2", "v10", "v9", "v01", "v0", "vx", "notes"):
        (tmp_path / "reef" / name).mkdir(parents=True)
    assert [version.number for version in versions.list_versions(tmp_path, "reef")] == [2, 9, 10]
    assert write(tmp_path, "new").name == "v11"


def test_no_versions(tmp_path):
    assert versions.list_versions(tmp_path / "nowhere", "reef") == []
    assert versions.newest_version(tmp_path, "reef") is None


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"digest": 3}'])
def test_a_version_whose_provenance_cannot_be_read_is_never_the_same(tmp_path, text):
    path = write(tmp_path, "one")
    (path / versions.PROVENANCE).write_text(text)
    assert write(tmp_path, "one").name == "v2"


def test_a_failed_run_leaves_nothing(tmp_path):
    writer = versions.new_version(tmp_path, "reef", "one")
    assert isinstance(writer, VersionWriter)

    def fail():
        with writer:
            (writer.folder / "mosaic.tif").touch()
            raise RuntimeError("half-way")

    with pytest.raises(RuntimeError, match="half-way"):
        fail()
    assert os.listdir(tmp_path / "reef") == []


def test_a_version_without_its_provenance_is_refused(tmp_path):
    writer = VersionWriter(tmp_path, "reef", "one")
    with pytest.raises(ValueError, match="digest"), writer:
        pass
    assert versions.list_versions(tmp_path, "reef") == []


def test_runs_at_once_get_numbers_of_their_own(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda k: write(tmp_path, f"digest {k}"), range(24)))
    assert sorted(path.name for path in paths) == sorted(f"v{k}" for k in range(1, 25))
    for k, path in enumerate(paths):
        assert (path / "report.html").read_text() == f"digest {k}"


def test_a_number_taken_at_the_last_moment_is_left_alone(tmp_path, monkeypatch):
    """Another run finishes v1 after we have looked; then one with our own digest."""
    other, ours = VersionWriter(tmp_path, "reef", "other"), VersionWriter(tmp_path, "reef", "ours")
    for writer, digest in ((other, "other"), (ours, "ours")):
        writer.__enter__()
        (writer.folder / versions.PROVENANCE).write_text(json.dumps({"digest": digest}))
    other.__exit__(None)
    monkeypatch.setattr(versions, "newest_version", lambda *_: None)
    ours.__exit__(None)
    assert (other.path, ours.path) == (tmp_path / "reef" / "v1", tmp_path / "reef" / "v2")
    assert versions.Version(1, tmp_path / "reef" / "v1").digest == "other"


def test_the_same_run_twice_at_once_makes_one_version(tmp_path):
    first, second = VersionWriter(tmp_path, "reef", "same"), VersionWriter(tmp_path, "reef", "same")
    for writer in (first, second):
        writer.__enter__()
        (writer.folder / versions.PROVENANCE).write_text('{"digest": "same"}')
    first.__exit__(None)
    second.__exit__(None)
    assert first.path == second.path == tmp_path / "reef" / "v1"
    assert os.listdir(tmp_path / "reef") == ["v1"]


def test_leftovers_of_dead_runs_are_removed_and_those_of_live_ones_kept(tmp_path):
    write(tmp_path, "one")
    gone = leftover(tmp_path, f".new-{HOST}-{dead_pid()}-0123abcd")
    abandoned = leftover(tmp_path, ".new-other-host-17-0123abcd", age_s=versions.LEASE_S + 60)
    alive = leftover(tmp_path, f".new-{HOST}-{os.getpid()}-0123abcd")
    elsewhere = leftover(tmp_path, f".new-other-{dead_pid()}-0123abcd", age_s=versions.LEASE_S / 2)
    foreign = leftover(tmp_path, ".new-ideas", age_s=9 * versions.LEASE_S)
    versions.new_version(tmp_path, "reef", "two")
    assert [path.exists() for path in (gone, abandoned, alive, elsewhere, foreign)] == [False, False, True, True, True]
    assert (tmp_path / "reef" / "v1").exists()


def test_a_version_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    settled = []

    def settle(path):
        settled.append((path.name, (tmp_path / "reef/v1").exists()))

    monkeypatch.setattr(versions, "settle", settle)
    write(tmp_path, "one")
    before = {name for name, finished in settled if not finished}
    assert before >= {"provenance.json", "report.html", "metadata"}
    assert settled[-1] == ("reef", True)


def test_a_process_number_of_another_container_or_start_says_nothing(tmp_path):
    """Its host may have our name."""
    ours, name = runs._realm(), runs.run_name()
    assert name.startswith(f"{HOST}-{os.getpid()}.{ours}-" if ours else f"{HOST}-{os.getpid()}-")
    here = leftover(tmp_path, f".new-{name}".replace(str(os.getpid()), str(dead_pid()), 1))
    elsewhere = leftover(tmp_path, f".new-{HOST}-{dead_pid()}.01234567-0123abcd")
    old = leftover(tmp_path, f".new-{HOST}-{dead_pid()}.01234567-89abcdef", age_s=versions.LEASE_S + 60)
    versions.new_version(tmp_path, "reef", "two")
    assert [path.exists() for path in (here, elsewhere, old)] == [False, True, False]
