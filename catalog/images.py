"""Decoded images."""

import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .digests import sha256
from .filesystems import ObjectStoreError, asking, connect
from .image_headers import HEADER_BYTES, TAIL_BYTES, damage, read_header


class UnreadableImage(Exception):
    """An image that cannot be used; carries why, as it is recorded in a frame's status.

    Attributes
    ----------
    reason : "file is truncated (no JPEG end marker)" and the like.
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason


class MissingImage(OSError):
    """An image that is gone, may not be read, or is another one than it was."""


class DecodedImage(NamedTuple):
    """An image and the digest of the file it came from.

    Attributes
    ----------
    bgr : (rows, cols, 3) uint8, blue green red; a greyscale image has three equal channels.
    sha256 : of the file's bytes, hexadecimal.
    """

    bgr: NDArray[np.uint8]
    sha256: str


_JPEG: Final = b"\xff\xd8"
_DARK, _TWELVE_BITS = 255, 4096  # levels of 16 bits
_REDUCED: Final = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}


def read_image(mission: str, image: str, camera: Camera, reduce: int = 1) -> DecodedImage:
    """Read and decode one image of a mission.

    Parameters
    ----------
    mission : folder or URL.
    image : path in it.
    camera : whose size the image must have.
    reduce : as in `decode`.

    Raises
    ------
    UnreadableImage
        If the file is truncated, damaged or of another size.
    MissingImage
        If it is not to be had now, which may be no fault of the image.
    ObjectStoreError
        If the object store does not give it: no fault of the image.
    """
    content = read_file(mission, image)
    return DecodedImage(decode(content, camera, reduce), sha256(content))


def read_file(mission: str, image: str) -> bytes:
    """The bytes of an image's file. Raises MissingImage and ObjectStoreError as `read_image` does."""
    fs, root = connect(mission)
    try:
        with asking(fs, f"{mission}/{image}"):
            return cast(bytes, fs.cat_file(f"{root.rstrip('/')}/{image}"))
    except ObjectStoreError:
        raise
    except OSError as error:
        raise MissingImage(f"{image} cannot be read ({error.strerror or error})") from error


@contextmanager
def reading_ahead(mission: str, images: Sequence[str]) -> Iterator[Callable[[str], bytes]]:
    """A `read_file` for images of a list: while one is worked on, the next is being read by another thread."""
    following = dict(itertools.pairwise(images))
    with ThreadPoolExecutor(1) as reader:
        begun: dict[str, Future[bytes]] = {}

        def read(image: str) -> bytes:
            waiting = begun.pop(image, None)
            content = waiting.result() if waiting else read_file(mission, image)
            if (after := following.get(image)) is not None:
                begun[after] = reader.submit(read_file, mission, after)
            return content

        yield read


def decode(content: bytes, camera: Camera, reduce: int = 1) -> NDArray[np.uint8]:
    """Decode the bytes of a JPEG, PNG or TIFF file into BGR, uint8 (rows, cols, 3).

    16 bits a channel become 8. The EXIF rotation is not applied: calibrations are of the sensor. What OpenCV
    would fill with grey or show in a wrong place (a truncated or damaged JPEG) is refused, and so is 16 bits a channel
    that holds no more than 12. Raises UnreadableImage.

    reduce : 1, 2, 4 ...: rows and columns so many times fewer, rounded up, each pixel the mean of those that it
        stands for; of a JPEG the rest is never decoded.
    """
    fault = read_header(content[:HEADER_BYTES], content[-TAIL_BYTES:], io.BytesIO(content)).fault
    jpeg = content[:2] == _JPEG
    if jpeg and reduce == 1 and not fault:  # what is read smaller has been read whole before
        fault = damage(content)
    if fault:
        raise UnreadableImage(fault)
    in_file = min(reduce, max(_REDUCED)) if jpeg else 1
    how = cv2.IMREAD_IGNORE_ORIENTATION | (0 if jpeg else cv2.IMREAD_ANYDEPTH)
    try:
        bgr = cv2.imdecode(np.frombuffer(content, np.uint8), _REDUCED[in_file] | how)
    except cv2.error:
        bgr = None
    if bgr is None or bgr.dtype not in (np.uint8, np.uint16):
        raise UnreadableImage("file is damaged (it cannot be decoded)")
    if bgr.shape[:2] != _reduced(camera, in_file):
        raise UnreadableImage(size_fault(bgr.shape[1] * in_file, bgr.shape[0] * in_file, camera))
    if bgr.dtype == np.uint16:
        bgr = _eight_bits(bgr)
    if reduce > in_file:
        bgr = cv2.resize(bgr, _reduced(camera, reduce)[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(bgr, np.uint8)


def _eight_bits(deep: NDArray) -> NDArray[np.uint8]:
    most = int(deep.max())
    if _DARK < most < _TWELVE_BITS:
        raise UnreadableImage(
            f"12 bits in a 16-bit file: no more than {most} of 65535; scale every image by 16 and write them again"
        )
    return (deep >> 8).astype(np.uint8)


def _reduced(camera: Camera, times: int) -> tuple[int, int]:
    return -(-camera.height // times), -(-camera.width // times)


def size_fault(width: int, height: int, camera: Camera) -> str:
    """Why an image of this size cannot be this camera's; empty if it can."""
    if (width, height) == (camera.width, camera.height):
        return ""
    return f"size {width}x{height}, calibration says {camera.width}x{camera.height}"
