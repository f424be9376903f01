import io

import cv2
import numpy as np
import pytest
from PIL import Image
from seamosaic.catalog.image_headers import HEADER_BYTES, TAIL_BYTES, Header, read_header

EXIF_IFD = 0x8769


def header(content: bytes) -> Header:
    return read_header(content[:HEADER_BYTES], content[-TAIL_BYTES:], io.BytesIO(content))


def picture(suffix: str, width: int = 96, height: int = 64, depth: type = np.uint8) -> bytes:
    noise = np.random.default_rng(0).integers(0, np.iinfo(depth).max, (height, width, 3)).astype(depth)
    done, content = cv2.imencode(suffix, noise)
    assert done
    return content.tobytes()


def with_exif(kind: str, tags: dict[int, str], rotation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = rotation
    exif.get_ifd(EXIF_IFD).update(tags)
    file = io.BytesIO()
    Image.new("RGB", (96, 64), (10, 120, 60)).save(file, "JPEG", exif=exif)
    if kind == "JPEG":
        return file.getvalue()
    # Pillow writes the EXIF directory of another format only from an image that was read with one.
    with Image.open(file) as read:
        other = io.BytesIO()
        read.save(other, kind, exif=read.getexif())
    return other.getvalue()


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_size_of_a_whole_file(suffix: str) -> None:
    assert header(picture(suffix)) == Header(96, 64, "", "")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_a_large_file_is_known_by_its_ends(suffix: str) -> None:
    content = picture(suffix, 900, 700)
    assert len(content) > HEADER_BYTES + TAIL_BYTES
    assert header(content) == Header(900, 700, "", "")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("size", [(96, 64), (900, 700)])
def test_a_truncated_file_is_found(suffix: str, share: float, size: tuple[int, int]) -> None:
    content = picture(suffix, *size)
    assert "file is truncated" in header(content[: int(share * len(content))]).fault


def test_a_preallocated_file_that_was_not_filled_is_truncated() -> None:
    content = picture(".jpg")
    assert "truncated" in header(content[:2000] + bytes(len(content) - 2000)).fault


def test_padding_behind_the_end_is_harmless() -> None:
    assert header(picture(".jpg") + bytes(3000)).fault == ""


def test_the_end_of_a_thumbnail_is_not_the_end() -> None:
    content, thumbnail = picture(".jpg"), picture(".jpg", 16, 16)
    segment = b"\xff\xe2" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = content[:2] + segment + content[2:]
    assert header(whole).fault == ""
    assert "truncated" in header(whole[: len(whole) - 500]).fault


def test_a_header_longer_than_what_is_looked_at_first() -> None:
    content, extra = with_exif("JPEG", {TIME: "2026:06:03 02:14:10"}), b"\xff\xe2\xff\xff" + bytes(0xFFFD)
    assert header(content[:2] + 6 * extra + content[2:]) == Header(96, 64, "2026-06-03T02:14:10Z", "")
    assert "truncated" in header(content[:2] + 6 * extra).fault


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"hello", "not a JPEG"),
        (b"GIF89a" + bytes(100), "not a JPEG"),
        (b"\xff\xd8\xff\xff\xff", "no JPEG frame"),
        (b"\x89PNG\r\n\x1a\n", "no PNG header"),
        (b"II*\0\xff\xff\xff\xff", "no TIFF directory"),
        (b"MM\0*", "no TIFF directory"),
    ],
)
def test_what_is_no_image(content: bytes, word: str) -> None:
    assert word in header(content).fault


TIME, SUBSECONDS, OFFSET = 0x9003, 0x9291, 0x9011


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize(
    ("tags", "time"),
    [
        ({TIME: "2026:06:03 02:14:10"}, "2026-06-03T02:14:10Z"),
        ({TIME: "2026:06:03 02:14:10", SUBSECONDS: "137"}, "2026-06-03T02:14:10.137Z"),
        ({TIME: "2026:06:03 04:14:10", SUBSECONDS: "5", OFFSET: "+02:00"}, "2026-06-03T04:14:10.5+02:00"),
        ({TIME: "2026:06:03 04:14:10", OFFSET: "   :  "}, "2026-06-03T04:14:10Z"),
        ({TIME: "2026:06:03"}, ""),
        ({SUBSECONDS: "137"}, ""),
    ],
)
def test_exif_time(kind: str, tags: dict[int, str], time: str) -> None:
    assert header(with_exif(kind, tags)).exif_time == time


def test_the_size_is_the_stored_one_whatever_exif_says_of_rotation() -> None:
    read = header(with_exif("JPEG", {TIME: "2026:06:03 02:14:10"}, rotation=6))
    assert (read.width, read.height) == (96, 64)


def test_broken_exif_is_no_time() -> None:
    content = with_exif("JPEG", {TIME: "2026:06:03 02:14:10"})
    place = content.index(b"Exif\0\0") + 6
    assert header(content[:place] + b"garbage!" + content[place + 8 :]).exif_time == ""
