"""What is known of a mission without reading its images, and what makes it unknown."""

import os

import pytest
from fsspec.implementations.local import LocalFileSystem
from seamosaic.catalog import digests, memory
from seamosaic.schemas.problems import InvalidInput


@pytest.fixture
def read(monkeypatch):
    """Images that were read whole."""
    counted, inspect = [], digests._inspect

    def counting(fs, path):
        counted.append(path)
        return inspect(fs, path)

    monkeypatch.setattr(digests, "_inspect", counting)
    return counted


def test_images_are_read_once(tiny_mission, tmp_path, read):
    url, out = str(tiny_mission), str(tmp_path / "out")
    first = memory.look(url, out)
    assert (first.id, first.images, first.unread, first.inputs) == ("tiny", 10, 10, None)
    assert (first.start, first.end) == ("2026-06-03T02:14:10Z", "2026-06-03T02:14:19Z")
    assert read == []
    inputs = memory.inputs_digest(memory.open_known(url, out))
    assert len(read) == 10
    assert memory.look(url, out)._replace(inputs=None, unread=10) == first
    assert memory.look(url, out).inputs == inputs == memory.inputs_digest(memory.open_known(url, out))
    assert len(read) == 10


def test_a_look_at_what_did_not_change_opens_nothing(tiny_mission, tmp_path, monkeypatch):
    url, out = str(tiny_mission), str(tmp_path / "out")
    memory.open_known(url, out)
    before = memory.look(url, out)
    monkeypatch.setattr(memory, "open_mission", None)
    assert memory.look(url, out) == before


def test_an_image_that_was_changed_is_unread_until_it_is_read(tiny_mission, tmp_path, read):
    url, out = str(tiny_mission), str(tmp_path / "out")
    before = memory.inputs_digest(memory.open_known(url, out))
    image = sorted((tiny_mission / "images").iterdir())[3]
    image.write_bytes(image.read_bytes() + b"\0")
    found = memory.look(url, out)
    assert (found.unread, found.inputs) == (1, None)
    assert memory.inputs_digest(memory.open_known(url, out)) != before
    assert len(read) == 11
    image.write_bytes(image.read_bytes()[:-1])
    assert memory.inputs_digest(memory.open_known(url, out)) == before


def test_an_image_that_could_not_be_read_is_asked_for_again(tiny_mission, tmp_path, read, monkeypatch):
    url, out, inspect = str(tiny_mission), str(tmp_path / "out"), digests._inspect
    refused = sorted((tiny_mission / "images").iterdir())[3].name

    def refusing(fs, path):
        return digests._unreadable(OSError("timed out")) if path.endswith(refused) else inspect(fs, path)

    with monkeypatch.context() as patch:
        patch.setattr(digests, "_inspect", refusing)
        before = memory.inputs_digest(memory.open_known(url, out))
    found = memory.look(url, out)
    assert (found.unread, found.inputs) == (1, None)  # nothing about the files has changed
    assert memory.inputs_digest(memory.open_known(url, out)) != before
    assert memory.look(url, out).unread == 0


def test_a_folder_of_any_name_is_remembered(tiny_mission, tmp_path, read):
    odd = tmp_path / os.fsdecode(b"M\xe9diterran\xe9e")
    tiny_mission.rename(odd)
    memory.open_known(str(odd), str(tmp_path / "out"))
    assert memory.look(str(odd), str(tmp_path / "out")).unread == 0
    assert len(read) == 10


def test_a_removed_image_is_known_to_be_gone(tiny_mission, tmp_path, read):
    url, out = str(tiny_mission), str(tmp_path / "out")
    before = memory.inputs_digest(memory.open_known(url, out))
    next((tiny_mission / "images").iterdir()).unlink()
    found = memory.look(url, out)
    assert (found.images, found.unread) == (9, 0)
    assert found.inputs not in (None, before)
    assert len(read) == 10


def test_an_edit_that_keeps_size_and_time_is_seen(tiny_mission, tmp_path):
    url, out = str(tiny_mission), str(tmp_path / "out")
    memory.open_known(url, out)
    before, path = memory.look(url, out), tiny_mission / "calibration.yaml"
    when = path.stat().st_mtime_ns
    path.write_text(path.read_text().replace("fx: 80.0", "fx: 81.0"))
    os.utime(path, ns=(when, when))
    after = memory.look(url, out)
    assert after.inputs not in (None, before.inputs)
    assert [name for name in after.texts if after.texts[name] != before.texts[name]] == ["calibration.yaml"]


def test_files_that_do_not_count_do_not(tiny_mission, tmp_path):
    url, out = str(tiny_mission), str(tmp_path / "out")
    before = memory.inputs_digest(memory.open_known(url, out))
    (tiny_mission / "notes.txt").write_text("windy")
    assert memory.look(url, out).inputs == before


def test_what_is_wrong_is_said_each_time(tiny_mission, tmp_path):
    out = str(tmp_path / "out")
    memory.open_known(str(tiny_mission), out)
    (tiny_mission / "calibration.yaml").unlink()
    for _ in range(2):
        with pytest.raises(InvalidInput, match=r"no file calibration\.yaml"):
            memory.look(str(tiny_mission), out)


def test_a_damaged_memory_is_none(tiny_mission, tmp_path, read):
    url, out = str(tiny_mission), tmp_path / "out"
    memory.open_known(url, str(out))
    (file,) = (out / memory.FOLDER).iterdir()
    file.write_text('{"images": 3}')
    memory.open_known(url, str(out))
    assert len(read) == 20


def test_images_behind_a_link_are_files_like_others(tiny_mission, tmp_path, read):
    card = tmp_path / "card"
    (tiny_mission / "images").rename(card)
    (tiny_mission / "images").symlink_to(card)
    url, out = str(tiny_mission), str(tmp_path / "out")
    memory.open_known(url, out)
    assert memory.look(url, out).unread == 0
    memory.open_known(url, out)
    assert len(read) == 10
    image = sorted(card.iterdir())[3]
    image.write_bytes(image.read_bytes() + b"\0")
    assert memory.look(url, out).unread == 1


def test_a_linked_image_changes_with_what_it_leads_to(tiny_mission, tmp_path, read):
    image, other = sorted((tiny_mission / "images").iterdir())[3], tmp_path / "other.jpg"
    image.rename(other)
    image.symlink_to(other)
    url, out = str(tiny_mission), str(tmp_path / "out")
    memory.open_known(url, out)
    before = other.stat()
    other.write_bytes(other.read_bytes()[:-1] + b"\0")
    os.utime(other, ns=(before.st_atime_ns, before.st_mtime_ns + 10**9))
    assert memory.look(url, out).unread == 1


def test_links_that_lead_round_end(tiny_mission, tmp_path):
    (tiny_mission / "again").symlink_to(tiny_mission)
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "back").symlink_to(tiny_mission / "images")
    (tiny_mission / "images" / "out").symlink_to(tmp_path / "beside")
    assert memory.look(str(tiny_mission), str(tmp_path / "out")).images == 10


def test_what_another_run_read_meanwhile_is_kept(tiny_mission, tmp_path, read, monkeypatch):
    url, out, opening = str(tiny_mission), str(tmp_path / "out"), memory.open_mission

    def slow(*given, **more):
        if more:
            memory.open_known(url, out)
        return opening(*given, **more)

    monkeypatch.setattr(memory, "open_mission", slow)
    memory.look(url, out)
    assert memory.look(url, out).unread == 0
    assert len(read) == 10


def test_a_mission_is_known_by_any_way_that_leads_to_it(tiny_mission, tmp_path, read):
    out, link = str(tmp_path / "out"), tmp_path / "link"
    link.symlink_to(tiny_mission)
    memory.open_known(str(tiny_mission), out)
    for url in (link, f"file://{link}", tiny_mission / "images/..", f"{link}/"):
        assert memory.look(str(url), out).unread == 0
        memory.open_known(str(url), out)
    assert len(read) == 10


def test_a_folder_that_may_not_be_looked_into_is_passed_over_but_not_trusted(tiny_mission, tmp_path, read, monkeypatch):
    url, out, opened = str(tiny_mission), str(tmp_path / "out"), memory.open_mission
    (tiny_mission / "lost+found").mkdir()
    list_it = LocalFileSystem.ls

    def closed(fs, path, **more):
        if path.endswith("lost+found"):
            raise PermissionError(13, "Permission denied")
        return list_it(fs, path, **more)

    monkeypatch.setattr(LocalFileSystem, "ls", closed)
    memory.open_known(url, out)
    times = []
    monkeypatch.setattr(memory, "open_mission", lambda *given, **more: times.append(1) or opened(*given, **more))
    assert [memory.look(url, out).unread for _ in range(2)] == [0, 0]
    assert (len(times), len(read)) == (2, 10)
