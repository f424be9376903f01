"""Per image: decoded once; laser soundings, features and colour statistics into the store."""

import math
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..catalog import digests
from ..catalog.images import MissingImage, UnreadableImage, decode, read_file, reading_ahead
from ..schemas.calibration import Laser
from ..schemas.mission import Role
from ..tasks import colour, features, laser, triangulation
from .job import Done, Job, Made, code_version, once, stage

STEP = "extract"
VERSION = code_version(sys.modules[__name__])


class ImageTask(NamedTuple):
    """An image to extract: its row in the frames table, path, digest and role.

    north_deg : direction of north in it, from u towards v, where the headings of all images are known.
    """

    row: int
    path: str
    sha256: str
    role: Role
    north_deg: int | None = None

    @property
    def north_rad(self) -> float | None:
        """`north_deg` in radians."""
        return None if self.north_deg is None else math.radians(self.north_deg)


def extract_batch(job: Job, batch: Sequence[ImageTask]) -> list[Done]:
    """Extract some images; a bad one gives an entry that says why, never an exception."""
    cv2.setNumThreads(1)
    with reading_ahead(job.mission_url, [image.path for image in batch]) as read:
        return [_extract(job, image, read) for image in batch]


def _extract(job: Job, image: ImageTask, read: Callable[[str], bytes]) -> Done:
    calibration = job.calibration
    light = calibration.laser if image.role != "texture" else None
    parameters = [image.role, *stage(calibration.camera)]
    if light is not None:
        parameters += stage(job.parameters.laser, light)
    if image.role != "laser":
        parameters += [*stage(job.parameters.features), image.north_deg]

    def make() -> Made:
        try:
            bgr = _verified(job, image.path, image.sha256, read(image.path))
        except UnreadableImage as error:
            return Made({}, _rejected(error))
        return _measure(job, image, light, bgr)

    try:
        return once(job, STEP, VERSION, [image.sha256], parameters, make)
    except MissingImage as error:  # not the image's fault, so not to be remembered: the next run tries again
        return Done(STEP, "", True, 0.0, _rejected(error))


def _rejected(error: Exception) -> dict:
    return {"status": f"rejected: {error}", "soundings": 0, "features": 0}


def read_verified(job: Job, path: str, sha256: str, reduce: int = 1) -> np.ndarray:
    """An image (H, W, 3) BGR, so many times smaller, if it still is the one that was opened.

    Raises
    ------
    UnreadableImage
        It cannot be decoded.
    MissingImage
        It cannot be read now, or it changed since.
    ObjectStoreError
        The object store does not give it.
    """
    return _verified(job, path, sha256, read_file(job.mission_url, path), reduce)


def _verified(job: Job, path: str, expected: str, content: bytes, reduce: int = 1) -> np.ndarray:
    if digests.sha256(content) != expected:
        raise MissingImage(f"{path} changed while the mission was being processed; run again")
    return decode(content, job.calibration.camera, reduce)


def _measure(job: Job, image: ImageTask, light: Laser | None, bgr: np.ndarray) -> Made:
    arrays, reason, line_uv = {}, "", np.zeros((0, 2))
    count, range_m, sigma_m, halfwidth_px, agreement = 0, None, None, 0.0, None
    if light is not None:
        found = triangulation.sound(bgr, job.calibration.camera, light, job.parameters.laser)
        soundings, reason, halfwidth_px = found.soundings, found.reason, float(found.halfwidth_px)
        count, agreement = len(soundings.uv), found.agreement
        if count:
            range_m, sigma_m = float(np.median(soundings.X_camera[:, 2])), float(np.median(soundings.sigma_m))
        line_uv = found.line_uv
        arrays |= {
            "laser_uv": soundings.uv,
            "laser_arm": soundings.arm,
            "laser_X": soundings.X_camera,
            "laser_sigma": soundings.sigma_m,
            "line_uv": line_uv,
        }
    feature_count = 0
    if image.role != "laser":
        erase = laser.mask(bgr.shape[:2], line_uv, halfwidth_px)
        grey = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        points = features.detect(grey, erase, job.parameters.features, image.north_rad)
        feature_count = len(points.uv)
        arrays |= {
            "feature_uv": points.uv,
            "feature_descriptors": points.descriptors,
            "thumbnail": colour.thumbnail(bgr, erase),
        }
    info = {
        "status": "",
        "reason": reason,
        "soundings": count,
        "range_m": range_m,
        "sigma_m": sigma_m,
        "halfwidth_px": halfwidth_px,
        "laser_gap_m": agreement.gap_m if agreement else None,
        "laser_gap_sigma_m": agreement.sigma_m if agreement else None,
        "features": feature_count,
    }
    return Made(arrays, info)
