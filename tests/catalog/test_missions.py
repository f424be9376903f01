import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import fsspec
import numpy as np
import pyproj
import pytest
import xarray
from PIL import Image
from seamosaic.catalog.missions import OpenedMission, open_mission
from seamosaic.schemas.problems import InvalidInput, Problem

NAVIGATION = ("longitude", "latitude", "elevation", "altitude", "roll", "pitch", "heading")
SIGMAS = ("sigma_horizontal", "sigma_depth", "sigma_roll", "sigma_pitch", "sigma_heading")


def edit(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def images(mission: Path) -> list[Path]:
    return sorted((mission / "images").iterdir())


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def problems(mission: Path | str, **options) -> list[Problem]:
    with pytest.raises(InvalidInput) as caught:
        open_mission(str(mission), **options)
    assert all(p.file and p.found and p.expected and p.remedy for p in caught.value.problems)
    return list(caught.value.problems)


def problem(mission: Path | str) -> Problem:
    (found,) = problems(mission)
    return found


def status(opened: OpenedMission) -> dict[str, str]:
    return {
        Path(str(name)).name: str(text)
        for name, text in zip(opened.frames["image"].values, opened.frames["status"].values, strict=True)
        if text
    }


def without_navigation(mission: Path) -> None:
    path = mission / "mission.yaml"
    path.write_text(path.read_text().split("navigation:")[0])


# --- a good mission ---


def test_the_frames_table(tiny_mission: Path) -> None:
    opened = open_mission(str(tiny_mission))
    frames = opened.frames
    assert isinstance(frames, xarray.Dataset)
    assert set(frames.variables) == {"image", "role", "time", "size", "sha256", "status", *NAVIGATION, *SIGMAS}
    assert frames.sizes == {"image": 10}
    assert frames["image"].values[0] == "images/V_20260603T021410.136751Z.jpg"
    assert frames["time"].dtype == "datetime64[ns]"
    assert str(frames["time"].values[0]) == "2026-06-03T02:14:10.136751000"
    assert np.all(np.diff(frames["time"].values).astype(int) == 10**9)
    assert set(frames["role"].values) == {"combined"}
    assert set(frames["status"].values) == {""}
    digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in images(tiny_mission)]
    assert frames["sha256"].values.tolist() == digests
    # A sample lies on each image; the heading goes through north without going round.
    seconds = np.arange(10)
    np.testing.assert_allclose(frames["latitude"].values, 43.042 + 2e-6 * seconds, atol=1e-9)
    np.testing.assert_allclose(frames["elevation"].values, -12 - 0.02 * seconds, atol=1e-9)
    np.testing.assert_allclose(frames["heading"].values, (358 + 2 * seconds) % 360, atol=1e-6)
    np.testing.assert_allclose(frames["altitude"].values, 3.1)
    np.testing.assert_allclose(frames["sigma_heading"].values, 0.84)


def test_the_rest_of_an_opened_mission(tiny_mission: Path) -> None:
    opened = open_mission(str(tiny_mission))
    assert (opened.url, opened.mission.id, opened.calibration.camera.width) == (str(tiny_mission), "tiny", 64)
    assert pyproj.CRS(opened.crs).to_epsg() == 32632
    assert (opened.vertical, opened.warnings) == (None, [])
    names = ("mission.yaml", "calibration.yaml", "navigation.csv")
    assert opened.input_digests == {n: hashlib.sha256((tiny_mission / n).read_bytes()).hexdigest() for n in names}


def test_crs_and_datum_as_given(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("calibration:", "crs: EPSG:2154\nvertical_datum: EPSG:5714\ncalibration:"))
    opened = open_mission(str(tiny_mission))
    assert pyproj.CRS(opened.crs).to_epsg() == 2154
    assert pyproj.CRS(opened.vertical).to_epsg() == 5714


def test_from_an_object_store_and_from_a_folder_alike(tiny_mission: Path) -> None:
    memory = fsspec.filesystem("memory")
    for path in [path for path in tiny_mission.rglob("*") if path.is_file()]:
        memory.pipe_file(f"/bucket/tiny/{path.relative_to(tiny_mission).as_posix()}", path.read_bytes())
    before = {path: info for path, info in memory.find("/bucket", detail=True).items()}
    cache: dict = {}
    there, here = open_mission("memory://bucket/tiny", cache), open_mission(str(tiny_mission))
    xarray.testing.assert_identical(there.frames, here.frames)
    assert there.input_digests == here.input_digests
    xarray.testing.assert_identical(open_mission("memory://bucket/tiny/", cache).frames, here.frames)
    assert memory.find("/bucket", detail=True) == before
    memory.rm("/bucket", recursive=True)


def test_the_mission_is_never_written_to(tiny_mission: Path) -> None:
    def listing() -> dict:
        return {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in [tiny_mission, *tiny_mission.rglob("*")]}

    before = listing()
    open_mission(str(tiny_mission), {})
    assert listing() == before


def test_a_folder_with_signs_of_globs_in_its_name(tiny_mission: Path) -> None:
    odd = tiny_mission.parent / "dive [2] *"
    tiny_mission.rename(odd)
    assert open_mission(str(odd)).frames.sizes["image"] == 10


def test_a_relative_path(tiny_mission: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tiny_mission.parent)
    assert open_mission("tiny").frames["image"].values[0].startswith("images/")


def test_known_images_are_not_read_again(tiny_mission: Path) -> None:
    known: dict = {}
    first = open_mission(str(tiny_mission), known)
    assert len(known) == 10
    for path in images(tiny_mission):
        stat = path.stat()
        path.write_bytes(bytes(stat.st_size))  # would be rejected if it were read
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    xarray.testing.assert_identical(open_mission(str(tiny_mission), known).frames, first.frames)


def test_a_quick_look_reads_no_digests(tiny_mission: Path) -> None:
    quick, full = open_mission(str(tiny_mission), hashed=False), open_mission(str(tiny_mission))
    assert set(quick.frames["sha256"].values) == {""}
    xarray.testing.assert_identical(quick.frames.drop_vars("sha256"), full.frames.drop_vars("sha256"))


def test_without_navigation(tiny_mission: Path) -> None:
    without_navigation(tiny_mission)
    opened = open_mission(str(tiny_mission))
    assert (opened.crs, opened.vertical) == (None, None)
    assert all(np.isnan(opened.frames[name].values).all() for name in (*NAVIGATION, *SIGMAS))
    assert not np.isnat(opened.frames["time"].values).any()


def test_tide_and_time_offset(tiny_mission: Path) -> None:
    edit(
        tiny_mission / "mission.yaml",
        ("path: navigation.csv", "path: navigation.csv\n  time_offset: 0.5"),
        ("calibration:", "tide: tide.csv\nvertical_datum: EPSG:5714\ncalibration:"),
    )
    rows = "time,height\n2026-06-03T02:14:00Z,1.0\n2026-06-03T02:15:00Z,1.0\n"
    (tiny_mission / "tide.csv").write_text(rows)
    opened = open_mission(str(tiny_mission))
    # Half a second later the vehicle is where it was one sample before: 1 cm shallower, and the tide 1 m up.
    np.testing.assert_allclose(opened.frames["elevation"].values, -12 - 0.02 * np.arange(10) + 0.01 + 1, atol=1e-9)
    assert "tide.csv" in opened.input_digests
    (tiny_mission / "tide.csv").write_text(rows.replace("02:15:00", "02:14:12"))
    assert (problem(tiny_mission).file, problem(tiny_mission).key) == ("tide.csv", "time")


def test_a_tide_without_a_datum_is_worth_a_word(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("calibration:", "tide: tide.csv\ncalibration:"))
    (tiny_mission / "tide.csv").write_text("time,height\n2026-06-03T02:14:00Z,1.0\n2026-06-03T02:15:00Z,1.0\n")
    assert "vertical_datum" in open_mission(str(tiny_mission)).warnings[0]


def test_a_datum_without_a_tide_is_worth_a_word(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("calibration:", "vertical_datum: EPSG:5714\ncalibration:"))
    assert "no tide" in open_mission(str(tiny_mission)).warnings[0]


def test_a_covariance_of_unknown_parameters_is_worth_a_word(tiny_mission: Path) -> None:
    with (tiny_mission / "calibration.yaml").open("a") as file:
        file.write("covariance: [{parameters: [laser.planes.left.offset], matrix: [[1.0e-6]]}]\n")
    assert "laser.planes.left.offset" in open_mission(str(tiny_mission)).warnings[0]


def test_strobe_and_laser_images(tiny_mission: Path) -> None:
    for path in images(tiny_mission)[::2]:
        path.rename(path.with_name(path.name.replace("V_", "L_")))
    # The last pair shares a time, which is none of our business.
    last = images(tiny_mission)[-1]
    shutil.copy(last, last.with_name(last.name.replace("V_", "L_")))
    edit(
        tiny_mission / "mission.yaml",
        (
            "  - {path: 'images/*.jpg', role: combined}",
            "  - {path: 'images/V_*.jpg', role: texture}\n  - {path: 'images/L_*.jpg', role: laser}",
        ),
    )
    opened = open_mission(str(tiny_mission))
    assert opened.frames["role"].values.tolist()[:4] == ["laser", "texture", "laser", "texture"]
    assert np.all(np.diff(opened.frames["time"].values) >= np.timedelta64(0))
    assert status(opened) == {}


# --- times from EXIF and from a table ---


def _resave_with_exif(mission: Path) -> None:
    for i, path in enumerate(images(mission)):
        exif = Image.Exif()
        exif[0x0112] = 6  # rotated: not our business either
        exif.get_ifd(0x8769).update({0x9003: f"2026:06:03 04:14:{10 + i}", 0x9291: "137", 0x9011: "+02:00"})
        Image.open(path).save(path, exif=exif)
        path.rename(path.with_name(f"DSC_{i:04}.jpg"))


def test_times_from_exif(tiny_mission: Path) -> None:
    _resave_with_exif(tiny_mission)
    edit(tiny_mission / "mission.yaml", ("{from: filename, pattern: '%Y%m%dT%H%M%S.%fZ'}", "{from: exif}"))
    plain = images(tiny_mission)[4]
    Image.open(plain).save(plain)
    opened = open_mission(str(tiny_mission))
    assert str(opened.frames["time"].values[0]) == "2026-06-03T02:14:10.137000000"
    assert status(opened) == {"DSC_0004.jpg": "rejected: no EXIF DateTimeOriginal"}
    # An image without a time comes last.
    assert np.isnat(opened.frames["time"].values[-1])
    assert np.isnan(opened.frames["latitude"].values[-1])


def test_times_from_a_table(tiny_mission: Path) -> None:
    rows = ["image,time"]
    for i, path in enumerate(images(tiny_mission)):
        path.rename(path.with_name(f"DSC_{i:04}.JPG"))
        name = f"DSC_{i:04}.JPG" if i % 2 else f"images/DSC_{i:04}.JPG"  # by name or by path
        rows.append(f"{name},2026-06-03T02:14:{20 - i}.5Z")
    rows[3:4] = ["DSC_9999.JPG,2026-06-03T02:14:18.5Z"]
    (tiny_mission / "times.csv").write_text("\n".join(rows))
    edit(
        tiny_mission / "mission.yaml",
        ("{from: filename, pattern: '%Y%m%dT%H%M%S.%fZ'}", "{from: csv, path: times.csv}"),
        ("*.jpg", "*.JPG"),
    )
    opened = open_mission(str(tiny_mission))
    assert opened.frames["image"].values[0] == "images/DSC_0009.JPG"
    assert status(opened) == {"DSC_0002.JPG": "rejected: not listed in times.csv"}
    assert any("DSC_9999.JPG" in warning for warning in opened.warnings)


# --- single bad images are recorded ---


def _wrong_size(path: Path) -> None:
    assert cv2.imwrite(str(path), np.zeros((48, 32, 3), np.uint8))


def _copy(path: Path) -> None:
    shutil.copy(path, path.with_name(path.stem + "_copy.jpg"))


@pytest.mark.parametrize(
    ("spoil", "name", "reason"),
    [
        (truncate, "V_20260603T021413.136751Z.jpg", "rejected: file is truncated (no JPEG end marker)"),
        (lambda path: path.write_bytes(b""), "V_20260603T021413.136751Z.jpg", "rejected: file is empty"),
        (lambda p: p.write_bytes(b"not"), "V_20260603T021413.136751Z.jpg", "rejected: not a JPEG, PNG or TIFF image"),
        (_wrong_size, "V_20260603T021413.136751Z.jpg", "rejected: size 32x48, calibration says 64x48"),
        (
            _copy,
            "V_20260603T021413.136751Z_copy.jpg",
            "rejected: duplicate timestamp of images/V_20260603T021413.136751Z.jpg",
        ),
        (
            lambda path: path.rename(path.with_name("V_photo.jpg")),
            "V_photo.jpg",
            "rejected: no time in the file name (pattern %Y%m%dT%H%M%S.%fZ)",
        ),
        (
            lambda path: path.rename(path.with_name("V_20260603T031413.0Z.jpg")),
            "V_20260603T031413.0Z.jpg",
            "rejected: outside the navigation (2026-06-03T02:14:08.636751Z to 2026-06-03T02:14:21.136751Z)",
        ),
    ],
)
def test_a_bad_image_is_recorded(tiny_mission: Path, spoil: Callable[[Path], object], name: str, reason: str) -> None:
    spoil(images(tiny_mission)[3])
    opened = open_mission(str(tiny_mission))
    assert status(opened) == {name: reason}
    (warning,) = opened.warnings
    assert "images rejected" in warning
    assert name in warning


def test_a_duplicate_of_a_rejected_image_is_kept(tiny_mission: Path) -> None:
    path = images(tiny_mission)[3]
    _copy(path)
    truncate(path)
    assert set(status(open_mission(str(tiny_mission)))) == {path.name}


def test_one_bad_image_of_three_is_still_one(tiny_mission: Path) -> None:
    for path in images(tiny_mission)[3:]:
        path.unlink()
    truncate(images(tiny_mission)[1])
    assert len(status(open_mission(str(tiny_mission)))) == 1


def test_too_many_bad_images_are_one_mistake(tiny_mission: Path) -> None:
    for path in images(tiny_mission)[:2]:
        truncate(path)
    assert len(status(open_mission(str(tiny_mission)))) == 2
    _wrong_size(images(tiny_mission)[5])
    found = {p.found.split(": ", 1)[0]: p for p in problems(tiny_mission)}
    assert set(found) == {"2 of 10 images rejected", "1 of 10 images rejected"}
    assert "file is truncated" in found["2 of 10 images rejected"].found
    assert "size 32x48" in found["1 of 10 images rejected"].found


def test_examples_are_few(tiny_mission: Path) -> None:
    for path in images(tiny_mission):
        truncate(path)
    assert problem(tiny_mission).found.endswith("and 7 more")


# --- wrong missions: everything at once, no traceback ---


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
        _copy(path)
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
    _copy(images(tiny_mission)[4])
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
    assert "scale" in open_mission(str(tiny_mission)).warnings[0]


def test_a_wrong_laser_is_not_called_missing(tiny_mission: Path) -> None:
    edit(tiny_mission / "calibration.yaml", ("angle: 25", "angle: 95"))
    assert problem(tiny_mission).key == "laser.planes.angle"


def test_laser_images_alone_need_navigation(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("combined", "laser"))
    without_navigation(tiny_mission)
    assert problem(tiny_mission).key == "navigation"


def test_gaps_and_missing_altitudes_are_worth_a_word(tiny_mission: Path) -> None:
    path = tiny_mission / "navigation.csv"
    path.write_text(path.read_text().replace(",3.1,", ",,"))
    assert open_mission(str(tiny_mission)).warnings == ["10 of 10 images have no altitude from navigation"]


@pytest.mark.skipif("SEAMOSAIC_SHARED" not in os.environ, reason="needs the shared missions")
def test_the_shared_missions_open() -> None:
    folder = Path(os.environ["SEAMOSAIC_SHARED"]) / "missions"
    for path in sorted(folder.iterdir()):
        opened = open_mission(str(path), hashed=False)
        assert set(opened.frames["status"].values) == {""}, path
        assert opened.warnings == [], path
        assert (opened.crs is None) == (path.name == "pool")
