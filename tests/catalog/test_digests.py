import hashlib
import json
import os
from pathlib import Path

import fsspec
import pytest
import s3fs
from seamosaic.catalog import digests
from seamosaic.catalog.digests import inspect_images, peek_images


@pytest.fixture
def files(tiny_mission: Path) -> list[Path]:
    return sorted((tiny_mission / "images").iterdir())


def listed(files: list[Path]) -> tuple:
    fs = fsspec.filesystem("file")
    return fs, [(str(path), fs.info(str(path))) for path in files]


def test_digests_are_sha256(files: list[Path]) -> None:
    found = inspect_images(*listed(files), None)
    assert [i.sha256 for i in found] == [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    assert {i.header for i in found} == {digests.Header(64, 48, "", "")}
    assert [i.header for i in peek_images(*listed(files))] == [i.header for i in found]


def test_files_of_more_than_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: list[Path]) -> None:
    monkeypatch.setattr(digests, "_BLOCK", 100)
    (found,) = inspect_images(*listed(files[:1]), None)
    assert found.sha256 == hashlib.sha256(files[0].read_bytes()).hexdigest()


def test_a_known_file_is_not_read_again(files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict = {}
    first = inspect_images(*listed(files), known)
    assert len(known) == len(files)
    known = json.loads(json.dumps(known))  # as it is kept between runs
    read: list[str] = []
    inspect = digests._inspect
    monkeypatch.setattr(digests, "_inspect", lambda fs, path: read.append(path) or inspect(fs, path))
    assert inspect_images(*listed(files), known) == first
    assert read == []
    content = files[3].read_bytes()
    files[3].write_bytes(content[:-2] + b"\0\0")
    os.utime(files[3], (1, 1))
    again = inspect_images(*listed(files), known)
    assert read == [str(files[3])]
    assert again[3].sha256 != first[3].sha256
    assert "truncated" in again[3].header.fault


def test_a_file_that_cannot_be_read(files: list[Path]) -> None:
    fs, entries = listed(files[:2])
    files[1].unlink()
    known: dict = {}
    for found in (inspect_images(fs, entries, known), peek_images(fs, entries)):
        assert found[0].header.fault == ""
        assert "cannot be read" in found[1].header.fault
    assert len(known) == 1


def test_a_peek_fetches_little_of_an_object(s3, monkeypatch: pytest.MonkeyPatch) -> None:
    fs = s3fs.S3FileSystem(use_listings_cache=False)
    path = f"{s3.bucket}/large.jpg"
    fs.pipe_file(path, b"\xff\xd8" + bytes(4_000_000))
    fetched, fetch = [], s3fs.S3File._fetch_range

    def counting(file, start, end):
        fetched.append(end - start)
        return fetch(file, start, end)

    monkeypatch.setattr(s3fs.S3File, "_fetch_range", counting)
    peek_images(fs, [(path, fs.info(path))])
    assert 0 < sum(fetched) < 600_000
