"""Versions on an object store: whole or not there, a number for each run, and leftovers of dead runs removed."""

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar

import pytest
from seamosaic.catalog import filesystems, publishing, versions
from seamosaic.catalog.filesystems import ObjectStoreError, create, place
from seamosaic.catalog.publishing import PROVENANCE, LostClaim
from seamosaic.catalog.runs import LEASE_S
from seamosaic.catalog.store import Store
from seamosaic.catalog.versions import VersionWriter, list_versions, new_version, newest_version

HOST = socket.gethostname()


def write(out: str, digest: str):
    writer = new_version(out, "reef", digest)
    assert isinstance(writer, VersionWriter)
    with writer:
        (writer.folder / PROVENANCE).write_text(json.dumps({"digest": digest}))
        (writer.folder / "report.html").write_text(digest)
    assert not writer.folder.exists()
    assert writer.path is not None
    return writer.path


def made(folder: Path, digest: str) -> Path:
    (folder / PROVENANCE).parent.mkdir(parents=True)
    (folder / PROVENANCE).write_text(json.dumps({"digest": digest}))
    (folder / "report.html").write_text(digest)
    return folder


def dead_run() -> str:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return f"{HOST}-{process.pid}-0123abcd"


def claim(out: str, number: int, digest: str, run: str) -> None:
    (place(out) / "reef/.claims" / f"v{number}").write_text(json.dumps({"digest": digest, "run": run, "beat": 0}))


def files(out: str) -> list[str]:
    folder = place(out) / "reef"
    return sorted(name.rpartition("reef/")[2] for name in folder.fs.find(folder.path))


@pytest.fixture(params=["s3", "memory"])
def out(request, tmp_path) -> str:
    name = tmp_path.name
    return request.getfixturevalue("s3").url(name) if request.param == "s3" else f"memory://{name}"


def test_a_change_makes_the_next_version_and_no_change_none(out):
    assert list_versions(out, "reef") == []
    assert newest_version(out, "reef") is None
    first = write(out, "one")
    assert str(first) == f"{out}/reef/v1"
    assert (first / "report.html").read_text() == "one"
    assert str(new_version(out, "reef", "one")) == str(first)
    for number in (2, 10):
        (place(out) / "reef" / f"v{number}" / PROVENANCE).write_text('{"digest": "earlier"}')
    (place(out) / "reef/v7/report.html").write_text("no provenance")
    assert write(out, "one").name == "v11"  # going back is a change too
    assert [version.number for version in list_versions(out, "reef")] == [1, 2, 10, 11]
    assert newest_version(out, "reef").digest == "one"
    assert [name for name in files(out) if "claims" in name] == []


def test_runs_at_once_get_numbers_of_their_own(s3, tmp_path):
    out = s3.url(tmp_path.name)
    with ThreadPoolExecutor(4) as pool:
        paths = list(pool.map(lambda k: write(out, f"digest {k}"), range(12)))
    assert len({path.name for path in paths}) == 12
    for k, path in enumerate(paths):
        assert (path / "report.html").read_text() == f"digest {k}"


def test_a_number_taken_and_finished_at_the_last_moment_is_left_alone(out, tmp_path, monkeypatch):
    """Another run claims v1, uploads and ends after we have looked."""
    true, between = publishing.create, [lambda: write(out, "other")]

    def create_late(*given):
        if between:
            between.pop()()
        return true(*given)

    monkeypatch.setattr(publishing, "create", create_late)
    assert publishing.publish(made(tmp_path / "a", "ours"), place(out) / "reef", "ours").name == "v2"
    assert [version.digest for version in list_versions(out, "reef")] == ["other", "ours"]
    assert [name for name in files(out) if "claims" in name] == []


@pytest.mark.parametrize("code", ["PreconditionFailed", "ConditionalRequestConflict", "AccessDenied"])
def test_a_store_that_says_in_its_own_words_that_another_was_first(code):
    """MinIO names no condition, of which s3fs makes an error like any other."""

    class Other:
        def pipe_file(self, path, data, mode):
            raise OSError(errno.EINVAL, "At least one of the pre-conditions you specified did not hold") from Answer()

        def cat_file(self, path):
            return b"another's"

    class Answer(Exception):
        response: ClassVar = {"Error": {"Code": code}}

    if code == "AccessDenied":
        with pytest.raises(OSError, match="pre-conditions"):
            create(Other(), "x", b"ours")
    else:
        assert not create(Other(), "x", b"ours")


def test_one_of_many_creates(s3, tmp_path):
    fs, path = filesystems.connect(s3.url(tmp_path.name, "claim"))
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda k: create(fs, path, b"%d" % k), range(8)))
    assert won.count(True) == 1
    assert fs.cat_file(path) == b"%d" % won.index(True)
    assert create(fs, path, b"%d" % won.index(True))  # the answer may have been lost on the way


def test_what_is_being_uploaded_is_no_version(out, tmp_path, monkeypatch):
    """Looked at before each file of a version: the others are there already, and still it is not."""
    seen, upload = [], publishing._upload

    def watched(made, version, check):
        def look():
            check()
            seen.append((list_versions(out, "reef"), len(files(out))))

        upload(made, version, look)

    monkeypatch.setattr(publishing, "_upload", watched)
    write(out, "one")
    assert [versions for versions, _ in seen] == [[], []]
    assert seen[1][1] == 2  # the report and the claim
    assert len(list_versions(out, "reef")) == 1


def test_the_same_run_twice_at_once_makes_one_version(out, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "_LOOK_S", 0.01)
    upload, go = publishing._upload, threading.Event()

    def slow(*given):
        assert go.wait(30)
        upload(*given)

    monkeypatch.setattr(publishing, "_upload", slow)
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(publishing.publish, made(tmp_path / k, "same"), place(out) / "reef", "same") for k in "ab"]
        time.sleep(0.5)
        go.set()
        assert {str(future.result()) for future in both} == {f"{out}/reef/v1"}
    assert len(list_versions(out, "reef")) == 1


def test_a_run_that_fell_silent_is_not_waited_for_for_ever(out, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "_LOOK_S", 0.01)
    monkeypatch.setattr(publishing, "SILENCE_S", 0.1)
    claim(out, 1, "same", "elsewhere-17-0123abcd")
    assert write(out, "same").name == "v2"


def test_leftovers_of_dead_runs_are_removed_and_those_of_live_ones_kept(out, tmp_path, monkeypatch):
    write(out, "one")
    for number, run in ((2, dead_run()), (3, f"{HOST}-{os.getpid()}-0123abcd"), (4, "elsewhere-17-0123abcd")):
        claim(out, number, f"{number}", run)
        (place(out) / "reef" / f"v{number}" / "half.tif").write_text("half")
    claim(out, 1, "one", dead_run())  # it died between its last file and the end of its claim
    assert write(out, "five").name == "v5"
    found = files(out)
    assert {"v1/report.html", "v3/half.tif", "v4/half.tif", ".claims/v3", ".claims/v4"} < set(found)
    assert not {"v2/half.tif", ".claims/v1", ".claims/v2"} & set(found)
    assert [version.number for version in list_versions(out, "reef")] == [1, 5]
    monkeypatch.setattr(publishing, "_quiet_s", lambda *_: LEASE_S + 1)
    publishing.remove_unfinished(place(out) / "reef")
    assert not {"v3/half.tif", "v4/half.tif"} & set(files(out))


def test_a_run_that_lost_its_claim_does_not_finish(out, tmp_path, monkeypatch):
    upload = publishing._upload

    def stolen(*given):
        claim(out, 1, "other", "elsewhere-17-0123abcd")
        upload(*given)

    monkeypatch.setattr(publishing, "_upload", stolen)
    with pytest.raises(LostClaim, match="run again"):
        publishing.publish(made(tmp_path / "a", "ours"), place(out) / "reef", "ours")
    assert list_versions(out, "reef") == []
    assert files(out) == [".claims/v1"]  # the other's


def test_a_claim_is_renewed_while_the_upload_lasts(out, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "RENEW_S", 0.02)
    beats: list[int] = []

    def upload(*_):
        deadline = time.monotonic() + 30
        while len(set(beats)) < 3 and time.monotonic() < deadline:
            beats.append(publishing._read(place(out) / "reef", 1).beat)

    monkeypatch.setattr(publishing, "_upload", upload)
    publishing.publish(made(tmp_path / "a", "ours"), place(out) / "reef", "ours")
    assert len(set(beats)) == 3


def test_a_store_that_is_unwell_and_well_again(s3, tmp_path):
    out, store = s3.url(tmp_path.name), Store(s3.url(tmp_path.name, "steps"))
    with s3.misbehaving(errors=0.2, delay_s=0.01):
        write(out, "one")
        store.put("extract", "ab12", {}, {"count": 4})
        assert store.info("extract", "ab12") == {"count": 4}
    assert newest_version(out, "reef").digest == "one"


def test_a_store_that_stays_unwell_is_a_failure_and_no_absent_result(s3, tmp_path, monkeypatch):
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "2")
    out, store = s3.url(tmp_path.name), Store(s3.url(tmp_path.name, "steps"))
    store.put("extract", "ab12", {}, {"count": 4})
    writer = new_version(out, "reef", "one")
    assert isinstance(writer, VersionWriter)
    with s3.misbehaving(down=True):
        for ask in (store.info, store.get, store.remove):
            with pytest.raises(ObjectStoreError, match="unwell"):
                ask("extract", "ab12")
        with pytest.raises(ObjectStoreError):
            newest_version(out, "reef")
        with pytest.raises(ObjectStoreError), writer:
            (writer.folder / PROVENANCE).write_text('{"digest": "one"}')
    assert not writer.folder.exists()
    assert list_versions(out, "reef") == []
    assert store.info("extract", "ab12") == {"count": 4}
    assert write(out, "one").name == "v1"


def test_what_a_dead_run_staged_here_is_removed(out, tmp_path, monkeypatch):
    monkeypatch.setattr(versions.tempfile, "gettempdir", lambda: str(tmp_path))
    dead, alive = (tmp_path / f"seamosaic-new-{run}" for run in (dead_run(), f"{HOST}-{os.getpid()}-0123abcd"))
    for folder in (dead, alive):
        folder.mkdir()
    new_version(out, "reef", "one")
    assert (dead.exists(), alive.exists()) == (False, True)
