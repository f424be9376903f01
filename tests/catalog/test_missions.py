import errno
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
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem
from PIL import Image
from seamosaic.catalog import digests
from seamosaic.catalog.filesystems import ObjectStoreError
from seamosaic.catalog.missions import open_mission, span
from seamosaic.workflows.results import vertical_reference

from tests.catalog.edited import copy, edit, images, problem, problems, status, truncate, without_navigation

NAVIGATION = ("longitude", "latitude", "elevation", "altitude", "roll", "pitch", "heading")
SIGMAS = ("sigma_horizontal", "sigma_depth", "sigma_roll", "sigma_pitch", "sigma_heading")


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


def test_a_quick_look_reads_only_what_is_not_known(tiny_mission: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict = {}
    open_mission(str(tiny_mission), known)
    copy(images(tiny_mission)[3])
    peeked, peek = [], digests._peek
    monkeypatch.setattr(digests, "_peek", lambda fs, path: peeked.append(Path(path).stem) or peek(fs, path))
    frames = open_mission(str(tiny_mission), known, hashed=None).frames
    assert [name[-5:] for name in peeked] == ["_copy"]
    assert set(frames["sha256"].values) == {""}


def test_one_file_has_one_name_however_it_is_written(tiny_mission: Path) -> None:
    before = open_mission(str(tiny_mission))
    edit(
        tiny_mission / "mission.yaml",
        ("images/*.jpg", "./images//*.jpg"),
        ("calibration: calibration.yaml", "calibration: .//calibration.yaml"),
    )
    after = open_mission(str(tiny_mission))
    xarray.testing.assert_identical(after.frames, before.frames)
    assert set(after.input_digests) == set(before.input_digests)
    edit(tiny_mission / "mission.yaml", (".//calibration.yaml", "./"))
    assert problem(tiny_mission).key == "calibration"


def test_a_folder_that_cannot_be_listed_is_no_empty_folder(tiny_mission: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tiny_mission / "images/deep").mkdir()
    images(tiny_mission)[1].rename(tiny_mission / "images/deep" / images(tiny_mission)[1].name)
    list_it = LocalFileSystem.ls

    def failing(fs, path, **more):
        if path.endswith("deep"):
            raise OSError(errno.EIO, "Input/output error", path)
        return list_it(fs, path, **more)

    monkeypatch.setattr(LocalFileSystem, "ls", failing)
    for pattern in ("**/*", "*/*"):
        text = (tiny_mission / "mission.yaml").read_text()
        (tiny_mission / "mission.yaml").write_text(text.replace("images/*.jpg", f"images/{pattern}.jpg"))
        with pytest.raises(OSError, match="Input/output"):
            open_mission(str(tiny_mission))
        (tiny_mission / "mission.yaml").write_text(text)
    assert open_mission(str(tiny_mission)).frames.sizes["image"] == 9  # it is not looked for there


def test_a_store_that_does_not_answer_is_no_mistake_of_the_user(
    tiny_mission: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(f"{tiny_mission}/", "/unwell/", recursive=True)
    read = MemoryFileSystem.cat_file

    def failing(fs, path, *given, **more):
        if path.endswith("navigation.csv"):
            raise OSError("503: slow down")
        return read(fs, path, *given, **more)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", failing)
    with pytest.raises(ObjectStoreError, match=r"navigation.csv: 503: slow down\. Check .* AWS_ENDPOINT_URL"):
        open_mission("memory://unwell")
    for name in ("info", "ls"):
        monkeypatch.setattr(MemoryFileSystem, name, lambda *_, **__: (_ for _ in ()).throw(OSError("500")))
    with pytest.raises(ObjectStoreError, match="500"):
        open_mission("memory://unwell")
    monkeypatch.undo()
    memory.rm("/unwell", recursive=True)


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


def test_the_mission_lasts_from_the_first_to_the_last_image_that_counts(tiny_mission: Path) -> None:
    frames = open_mission(str(tiny_mission)).frames
    old = frames["time"].values.copy()
    old[0] = np.datetime64("1980-01-01")
    status = np.where(np.arange(10) == 0, "rejected: outside the navigation", "")
    wrong = frames.assign(time=("image", old), status=("image", status))
    assert span(frames) == (frames["time"].values[0], frames["time"].values[-1])
    assert span(wrong) == (frames["time"].values[1], frames["time"].values[-1])
    assert span(wrong.assign(status=("image", ["rejected: all"] * 10)))[0] == old[0]


def test_a_datum_in_a_compound_crs_is_one(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("calibration:", "crs: EPSG:32632+5714\ncalibration:"))
    (warning,) = open_mission(str(tiny_mission)).warnings
    assert "no tide" in warning


def test_a_tide_without_a_datum_is_worth_a_word(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", ("calibration:", "tide: tide.csv\ncalibration:"))
    (tiny_mission / "tide.csv").write_text("time,height\n2026-06-03T02:14:00Z,1.0\n2026-06-03T02:15:00Z,1.0\n")
    opened = open_mission(str(tiny_mission))
    assert "vertical_datum" in opened.warnings[0]
    assert vertical_reference(opened).startswith("the zero of the tide table tide.csv")


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


@pytest.mark.parametrize(
    ("spoil", "name", "reason"),
    [
        (truncate, "V_20260603T021413.136751Z.jpg", "rejected: file is truncated (no JPEG end marker)"),
        (lambda path: path.write_bytes(b""), "V_20260603T021413.136751Z.jpg", "rejected: file is empty"),
        (lambda p: p.write_bytes(b"not"), "V_20260603T021413.136751Z.jpg", "rejected: not a JPEG, PNG or TIFF image"),
        (_wrong_size, "V_20260603T021413.136751Z.jpg", "rejected: size 32x48, calibration says 64x48"),
        (
            copy,
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
    copy(path)
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
