"""Small JSON files that appear whole, and of which one of many writers makes the first."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor

import pytest
from seamosaic.catalog import json_files


@pytest.fixture(params=["local", "memory", "s3"])
def place(request, tmp_path):
    if request.param == "s3":
        return request.getfixturevalue("s3").url(tmp_path.name)
    return str(tmp_path / "some/folder") if request.param == "local" else f"memory://{tmp_path.name}/folder"


def test_what_was_written_is_read(place):
    assert json_files.read_json(f"{place}/a.json") is None
    json_files.write_json(f"{place}/a.json", {"é": 1})
    json_files.write_json(f"{place}/a.json", {"é": 2})
    assert json_files.read_json(f"{place}/a.json") == {"é": 2}
    assert json_files.names(place) == ["a.json"]
    assert json_files.exists(f"{place}/a.json")
    json_files.remove(f"{place}/a.json")
    json_files.remove(f"{place}/a.json")
    assert json_files.names(place) == []
    assert not json_files.exists(f"{place}/a.json")


@pytest.mark.parametrize("place", ["local", "s3"], indirect=True)  # fsspec's memory knows no "only if it is new"
def test_of_many_at_once_one_makes_it(place):
    def write(number):
        try:
            json_files.write_json(f"{place}/a.json", number, new=True)  # each its own
        except FileExistsError:
            return None
        return number

    with ThreadPoolExecutor(8) as pool:
        made = [number for number in pool.map(write, range(40)) if number is not None]
    assert made == [json_files.read_json(f"{place}/a.json")]
    assert json_files.names(place) == ["a.json"]


def test_what_is_damaged_is_not_there(tmp_path):
    (tmp_path / "a.json").write_bytes(b'{"half')
    assert json_files.read_json(str(tmp_path / "a.json")) is None


def test_a_file_system_without_hard_links(tmp_path, monkeypatch):
    def link(*_):
        raise PermissionError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", link)
    json_files.write_json(str(tmp_path / "a.json"), 1, new=True)
    with pytest.raises(FileExistsError):
        json_files.write_json(str(tmp_path / "a.json"), 2, new=True)
    assert json_files.read_json(str(tmp_path / "a.json")) == 1
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    settled = []
    monkeypatch.setattr(json_files, "settle", lambda path: settled.append((path, (tmp_path / "a.json").exists())))
    json_files.write_json(str(tmp_path / "a.json"), 1)
    assert [finished for _, finished in settled] == [False, True]
    assert settled[1][0] == str(tmp_path)
