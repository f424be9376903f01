import hashlib
import io
import threading
from pathlib import Path

import cv2
import fsspec
import numpy as np
import pytest
from PIL import Image
from seamosaic.catalog import images
from seamosaic.catalog.images import MissingImage, UnreadableImage, decode, read_file, read_image, reading_ahead
from seamosaic.schemas.calibration import Camera

CAMERA = Camera(model="brown", width=96, height=64, fx=100, fy=100, cx=47.5, cy=31.5)


def encoded(suffix: str, picture: np.ndarray) -> bytes:
    done, content = cv2.imencode(suffix, picture)
    assert done
    return content.tobytes()


@pytest.fixture
def smooth() -> np.ndarray:
    noise = np.random.default_rng(1).integers(0, 255, (64, 96, 3), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def test_an_image_and_its_digest(tmp_path: Path, smooth: np.ndarray) -> None:
    content = encoded(".jpg", smooth)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(content)
    read = read_image(str(tmp_path), "images/a.jpg", CAMERA)
    assert read.sha256 == hashlib.sha256(content).hexdigest()
    assert read.bgr.shape == (64, 96, 3)
    assert read.bgr.dtype == np.uint8
    error = np.abs(read.bgr.astype(float) - smooth).mean()
    assert 0 < error < 6  # a JPEG: close, in the order blue green red, but not the same


def test_from_memory(smooth: np.ndarray) -> None:
    fs = fsspec.filesystem("memory")
    fs.pipe_file("/decode/a.png", encoded(".png", smooth))
    np.testing.assert_array_equal(read_image("memory://decode", "a.png", CAMERA).bgr, smooth)
    fs.rm("/decode", recursive=True)


def test_sixteen_bits_and_grey(smooth: np.ndarray) -> None:
    deep = encoded(".png", smooth.astype(np.uint16) * 257)
    np.testing.assert_array_equal(decode(deep, CAMERA), smooth)
    grey = decode(encoded(".png", smooth[..., 1]), CAMERA)
    for channel in range(3):
        np.testing.assert_array_equal(grey[..., channel], smooth[..., 1])
    deep_grey = decode(encoded(".png", smooth[..., 1].astype(np.uint16) * 257), CAMERA)
    np.testing.assert_array_equal(deep_grey, grey)
    np.testing.assert_array_equal(decode(encoded(".tif", smooth), CAMERA), smooth)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("reduce", [2, 4, 8, 16])
def test_a_reduced_image_has_the_means_of_its_pixels_in_their_places(smooth, suffix, reduce) -> None:
    smooth = cv2.GaussianBlur(smooth, (0, 0), 4)
    content = encoded(suffix, smooth)
    reduced = decode(content, CAMERA, reduce)
    assert reduced.shape == (-(-64 // reduce), 96 // reduce, 3)
    means = cv2.resize(decode(content, CAMERA), reduced.shape[1::-1], interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(reduced - means).mean() < 1.0
    assert np.abs(reduced - means[:, ::-1]).mean() > 1.5
    with pytest.raises(UnreadableImage, match="size"):
        decode(content, CAMERA.model_copy(update={"width": 160}), reduce)


def test_exif_rotation_is_not_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (96, 64)).save(tmp_path / "a.jpg", exif=exif)
    assert read_image(str(tmp_path), "a.jpg", CAMERA).bgr.shape == (64, 96, 3)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("share", [0, 0.01, 0.5, 0.98])
def test_a_truncated_file_is_refused(tmp_path: Path, smooth: np.ndarray, suffix: str, share: float) -> None:
    content = encoded(suffix, smooth)
    (tmp_path / "a").write_bytes(content[: int(share * len(content))])
    with pytest.raises(UnreadableImage) as caught:
        read_image(str(tmp_path), "a", CAMERA)
    assert caught.value.reason.startswith("file is")


def test_damage_inside_is_refused(smooth: np.ndarray) -> None:
    content = bytearray(encoded(".png", smooth))
    content[len(content) // 2 : len(content) // 2 + 400] = bytes(400)
    with pytest.raises(UnreadableImage, match="cannot be decoded"):
        decode(bytes(content), CAMERA)


def test_another_size_is_refused(smooth: np.ndarray) -> None:
    with pytest.raises(UnreadableImage, match="size 96x32, calibration says 96x64"):
        decode(encoded(".jpg", smooth[:32]), CAMERA)


def test_a_missing_file_is_no_fault_of_the_image(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"nowhere.jpg cannot be read"):
        read_image(str(tmp_path), "nowhere.jpg", CAMERA)


def test_the_next_image_is_read_while_one_is_worked_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "abc":
        (tmp_path / name).write_bytes(name.encode())
    begun = {name: threading.Event() for name in "abc"}

    def announced(mission: str, image: str) -> bytes:
        begun[image].set()
        return read_file(mission, image)

    monkeypatch.setattr(images, "read_file", announced)
    with reading_ahead(str(tmp_path), ["a", "b", "c"]) as read:
        assert not begun["a"].is_set()
        assert read("a") == b"a"
        assert begun["b"].wait(30)  # nobody has asked for it
        assert not begun["c"].is_set()
        assert read("c") == b"c"  # in whatever order
        assert read("b") == b"b"


def test_reading_ahead_says_of_which_image_it_failed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"a")
    with reading_ahead(str(tmp_path), ["a", "gone", "b"]) as read:
        assert read("a") == b"a"
        with pytest.raises(MissingImage, match="gone cannot be read"):
            read("gone")
        with pytest.raises(MissingImage, match="b cannot be read"):
            read("b")


def jpeg(picture: np.ndarray, **options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=90, **options)
    return file.getvalue()


@pytest.mark.parametrize("restarts", [0, 1])
@pytest.mark.parametrize("kind", ["zeros", "noise"])
def test_a_jpeg_that_is_damaged_inside_is_refused(kind: str, restarts: int) -> None:
    rng = np.random.default_rng(2)
    content = bytearray(jpeg(rng.integers(0, 255, (64, 96, 3), np.uint8), restart_marker_rows=restarts))
    decode(bytes(content), CAMERA)
    middle = slice(len(content) // 2, len(content) // 2 + 2000)
    content[middle] = bytes(2000) if kind == "zeros" else rng.bytes(2000)
    with pytest.raises(UnreadableImage, match="file is damaged"):
        decode(bytes(content), CAMERA)


@pytest.mark.parametrize("options", [{}, {"optimize": True}, {"progressive": True}, {"comment": b"\xff\x01" * 50}])
@pytest.mark.parametrize("level", [0, 117, 255])
def test_a_plain_jpeg_is_not_damaged(level: int, options: dict) -> None:
    camera = CAMERA.model_copy(update={"width": 1600, "height": 1200})
    for shape in ((1200, 1600), (1200, 1600, 3)):
        content = jpeg(np.full(shape, level, np.uint8), **options)
        if "optimize" in options:
            assert bytes(64) in content
        assert decode(content + bytes(200), camera).mean() == level


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_twelve_bits_in_sixteen_are_refused_and_dark_is_not(smooth: np.ndarray, suffix: str) -> None:
    for picture in (smooth, smooth[..., 1]):
        with pytest.raises(UnreadableImage, match=r"12 bits in a 16-bit file.*scale every image by 16"):
            decode(encoded(suffix, picture.astype(np.uint16) * 16), CAMERA)
        assert decode(encoded(suffix, picture.astype(np.uint16)), CAMERA).max() == 0
        np.testing.assert_array_equal(
            decode(encoded(suffix, picture.astype(np.uint16) * 256), CAMERA)[..., 1], smooth[..., 1]
        )
