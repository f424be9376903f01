"""Wrong missions: everything is said at once, without a traceback."""

import os
import shutil
from pathlib import Path

import pytest
from seamosaic.catalog import memory
from seamosaic.catalog.missions import open_mission

from tests.catalog.edited import copy, edit, images, problem, problems, truncate, without_navigation


def test_navigation_that_does_not_cover_the_images(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("path: navigation.csv", "path: navigation.csv\n  time_offset: 3600"))
    found = problem(tiny_mission)
    assert found.key == "navigation"
    assert "navigation from 2026-06-03T03:14:08.636751Z" in found.found
    assert "images from 2026-06-03T02:14:10.136751Z" in found.found
    assert "time_offset" in found.remedy


def test_navigation_that_covers_half_of_the_images(tiny_mission: Path) -> None:
    path = tiny_mission / "navigation.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:15]))
    found = problem(tiny_mission)
    assert "4 of 10 images rejected" in found.found
    assert "outside the navigation" in found.found


@pytest.mark.parametrize("name", ["mission.yaml", "calibration.yaml", "navigation.csv"])
def test_a_missing_file(tiny_mission: Path, name: str) -> None:
    (tiny_mission / name).unlink()
    found = problem(tiny_mission)
    assert found.file == "mission.yaml"
    assert f"no file {name}" in found.found
    lines = {"mission.yaml": None, "calibration.yaml": 7, "navigation.csv": 9}
    assert found.line == lines[name]


def test_all_files_missing_are_named(tiny_mission: Path) -> None:
    (tiny_mission / "calibration.yaml").unlink()
    (tiny_mission / "navigation.csv").unlink()
    shutil.rmtree(tiny_mission / "images")
    assert {p.key for p in problems(tiny_mission)} == {"calibration", "navigation.path", "images.0.path"}


@pytest.mark.parametrize(
    ("url", "found"),
    [
        ("{}/nowhere", "nothing"),
        ("{}/tiny/mission.yaml", "a file"),
        ("nosuch://bucket/x", "no access"),
        ("memory://nowhere", "nothing"),
    ],
)
def test_a_wrong_place(tiny_mission: Path, url: str, found: str) -> None:
    assert problem(url.format(tiny_mission.parent)).found.startswith(found)


def test_duplicate_times_in_the_navigation(tiny_mission: Path) -> None:
    path = tiny_mission / "navigation.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows[:6], rows[5], *rows[6:]]))
    found = problem(tiny_mission)
    assert (found.file, found.line, found.key) == ("navigation.csv", 7, "time")
    assert "the time of line 6" in found.found


def test_duplicate_times_of_the_images(tiny_mission: Path) -> None:
    for path in images(tiny_mission)[:4]:
        copy(path)
    found = problem(tiny_mission)
    assert "4 of 14 images rejected" in found.found
    assert "duplicate timestamp of" in found.found


def test_nan_cells(tiny_mission: Path) -> None:
    edit(tiny_mission / "navigation.csv", ("6.0127,12.000", "nan,12.000"), ("12.010,3.1", "12.010,inf"))
    assert [(p.file, p.line, p.key, p.found) for p in problems(tiny_mission)] == [
        ("navigation.csv", 5, "longitude", "'nan'"),
        ("navigation.csv", 6, "altitude", "'inf'"),
    ]


def test_everything_wrong_is_said_at_once(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("title:", "titel:"), ("calibration:", "crs: EPSG:4326\ncalibration:"))
    edit(tiny_mission / "calibration.yaml", ("fx: 80.0", "fx: -80.0"))
    edit(tiny_mission / "navigation.csv", ("6.0127,12.000", "NaN,12.000"))
    truncate(images(tiny_mission)[2])
    copy(images(tiny_mission)[4])
    found = problems(tiny_mission)
    assert [(p.file, p.line, p.key) for p in found] == [
        ("mission.yaml", 3, "titel"),
        ("calibration.yaml", 6, "camera.fx"),
        ("navigation.csv", 5, "longitude"),
        ("mission.yaml", 7, "crs"),
        ("images", None, ""),
        ("images", None, ""),
    ]
    assert "truncated" in found[4].found
    assert "duplicate" in found[5].found


@pytest.mark.parametrize("text", ["format: 1\n  id: x: y\n", "", "- 1\n", "\xff"])
def test_a_useless_mission_file_does_not_hide_the_others(tiny_mission: Path, text: str) -> None:
    (tiny_mission / "mission.yaml").write_text(text, encoding="latin-1")
    edit(tiny_mission / "calibration.yaml", ("fx: 80.0", "fx: -80.0"))
    edit(tiny_mission / "navigation.csv", ("6.0127,12.000", "NaN,12.000"))
    assert [p.file for p in problems(tiny_mission)] == ["mission.yaml", "calibration.yaml", "navigation.csv"]


def test_a_pattern_without_images(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("*.jpg", "*.JPG"))
    assert "case-sensitive" in problem(tiny_mission).remedy
    edit(tiny_mission / "mission.yaml", ("*.JPG", "*.png"))
    found = problem(tiny_mission)
    assert (found.line, found.key) == (5, "images.0.path")
    assert "V_20260603T021410.136751Z.jpg" in found.remedy
    edit(tiny_mission / "mission.yaml", ("images/*.png", "pictures/*.png"))
    assert "no file in that folder" in problem(tiny_mission).remedy


def test_patterns(tiny_mission: Path) -> None:
    (tiny_mission / "images" / "deep" / "er").mkdir(parents=True)
    for i, path in enumerate(images(tiny_mission)[:4]):
        path.rename(tiny_mission / "images" / "deep" / ("er" if i % 2 else "") / path.name)
    (tiny_mission / "images" / "._V_20260603T021414.136751Z.jpg").write_bytes(b"what a Mac leaves behind")
    for pattern, count in (("*", 6), ("**/*", 10), ("*/*", 2), ("deep/**/*", 4), ("V_*[5-9].136751Z", 5)):
        text = (tiny_mission / "mission.yaml").read_text()
        (tiny_mission / "mission.yaml").write_text(text.replace("'images/*.jpg'", f"'images/{pattern}.jpg'"))
        assert open_mission(str(tiny_mission), hashed=False).frames.sizes["image"] == count
        (tiny_mission / "mission.yaml").write_text(text)


def test_an_image_in_two_sets(tiny_mission: Path) -> None:
    line = "  - {path: 'images/*.jpg', role: combined}\n"
    edit(tiny_mission / "mission.yaml", (line, line + "  - {path: 'images/V_*1?.*.jpg', role: texture}\n"))
    found = problem(tiny_mission)
    assert (found.line, found.key) == (6, "images.1.path")
    assert "'images/*.jpg' matches too" in found.found


@pytest.mark.parametrize("role", ["combined", "laser"])
def test_laser_images_need_a_laser(tiny_mission: Path, role: str) -> None:
    path = tiny_mission / "calibration.yaml"
    path.write_text(path.read_text().split("laser:")[0])
    edit(tiny_mission / "mission.yaml", ("combined", role))
    found = problem(tiny_mission)
    assert (found.line, found.key, found.expected) == (5, "images.0.role", "a laser in calibration.yaml")
    edit(tiny_mission / "mission.yaml", (role, "texture"))
    assert open_mission(str(tiny_mission)).warnings == []
    without_navigation(tiny_mission)
    assert problem(tiny_mission).expected == "something that tells the scale"


def test_a_wrong_laser_is_not_called_missing(tiny_mission: Path) -> None:
    edit(tiny_mission / "calibration.yaml", ("angle: 25", "angle: 95"))
    assert problem(tiny_mission).key == "laser.planes.angle"


def test_laser_and_texture_apart_need_navigation(tiny_mission: Path) -> None:
    line = "  - {path: 'images/*.jpg', role: combined}\n"
    parts = [
        line.replace("*", glob).replace("combined", role)
        for glob, role in (("*[02468].*", "laser"), ("*[13579].*", "texture"))
    ]
    edit(tiny_mission / "mission.yaml", (line, "".join(parts)))
    without_navigation(tiny_mission)
    assert problem(tiny_mission).expected == "something that tells the scale"


def test_laser_images_alone_need_navigation(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("combined", "laser"))
    without_navigation(tiny_mission)
    assert problem(tiny_mission).key == "navigation"


def test_an_image_whose_name_is_no_text(tiny_mission: Path) -> None:
    first = images(tiny_mission)[0]
    os.rename(first, os.fsencode(first.parent) + b"/caf\xe9.jpg")
    (found,) = [p for p in problems(tiny_mission) if p.expected == "names in UTF-8"]
    assert found.key == "images.0.path"
    assert "1 images whose names are no text in UTF-8, such as 'images/caf\\udce9.jpg'" in found.found


def test_a_stray_file_may_have_any_name(tiny_mission: Path, tmp_path: Path) -> None:
    (tiny_mission / "notes").mkdir()
    Path(os.fsdecode(os.fsencode(tiny_mission / "notes") + b"/caf\xe9.txt")).write_text("")
    for _ in range(2):
        assert memory.open_known(str(tiny_mission), str(tmp_path / "out")).frames.sizes["image"] == 10
