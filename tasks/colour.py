"""Small pictures of images, as light, and how far away what they show is."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .camera import rays

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

THUMBNAIL: Final = (24, 32)  # rows, columns
_SHRINK: Final = 8
_KNOWN: Final = 0.1
_LEAN: Final = 0.02  # error of a point's depth over the seabed's slope, and its points' share in what is independent
_NEAR: Final = 0.15  # share of the depth that a cell's laser points may be off the plane of all


def thumbnail(image: Pixels, mask: Mask) -> Array32:
    """Means (24, 32, 3) of an image (H, W, 3) over its unmasked pixels; NaN where nearly all are masked."""
    size = THUMBNAIL[::-1]
    seen = ~mask
    kept = np.asarray(cv2.copyTo(image, seen.view(np.uint8)))
    weight = seen.astype(np.float32)
    shrink = min(_SHRINK, image.shape[1] // THUMBNAIL[1], image.shape[0] // THUMBNAIL[0])
    if shrink > 1:
        smaller = image.shape[1] // shrink, image.shape[0] // shrink
        kept, weight = (
            np.asarray(cv2.resize(layer, smaller, interpolation=cv2.INTER_AREA)) for layer in (kept, weight)
        )
    weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)[..., None]
    total = cv2.resize(kept.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.where(weight > _KNOWN, total / np.maximum(weight, _KNOWN), np.nan).astype(np.float32)


def as_light(levels: NDArray, gamma: float) -> Array32:
    """Light 0..1 of levels 0..255: level = light ** (1 / gamma)."""
    return ((np.asarray(levels, np.float32) / np.float32(255)) ** np.float32(gamma)).astype(np.float32)


def ranges(camera: Camera, down: Array, height_m: float, laser_uv: Array, laser_X: Array) -> tuple[Array32, Mask]:
    """Distance (24, 32) of the middle of a thumbnail's cells, and where it is known well.

    With laser points by their plane, and where some lie in a cell by these; without by level ground.

    Parameters
    ----------
    down : (3,) the vertical, camera frame.
    height_m : of the camera above the ground.
    laser_uv : (N, 2) pixels of laser points. laser_X : (N, 3) their places, camera frame, m.
    """
    rows, columns = THUMBNAIL
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width / columns, (np.arange(rows) + 0.5) * camera.height / rows
    )
    direction = rays(camera, np.column_stack([u.ravel(), v.ravel()]) - 0.5).direction
    if len(laser_X) < 3:
        away = height_m / np.maximum(direction @ down, 0.1)
        return away.reshape(THUMBNAIL).astype(np.float32), np.ones(THUMBNAIL, bool)
    plane = _plane(laser_X, down)
    typical = float(np.median(1 / laser_X[:, 2]))
    own = direction / direction[:, 2:]
    depth = 1 / np.clip(own @ plane, 0.5 * typical, 2 * typical)
    cell = np.clip((laser_uv + 0.5) / (camera.width, camera.height) * (columns, rows), 0, (columns - 1, rows - 1))
    cell = cell[:, 1].astype(int) * columns + cell[:, 0].astype(int)
    count = np.bincount(cell, minlength=rows * columns)
    mean = np.bincount(cell, laser_X[:, 2], rows * columns) / np.maximum(count, 1)
    exact = (count > 0) & (np.abs(mean - depth) < _NEAR * depth)
    away = np.where(exact, mean, depth) / direction[:, 2]
    return away.reshape(THUMBNAIL).astype(np.float32), exact.reshape(THUMBNAIL)


def _plane(X: Array, down: Array) -> Array:
    """(3,): the inverse depth of a plane near points X (N, 3), linear in the slopes X/Z, Y/Z, 1.

    Where the points do not say how it leans, as along one arm of the laser, it is level.
    """
    slopes, nearness = np.column_stack([X[:, :2] / X[:, 2:], np.ones(len(X))]), 1 / X[:, 2]
    level = down * np.median(nearness / (slopes @ down))
    weight = _LEAN * np.sqrt(len(X)) * np.eye(3)
    found = np.linalg.lstsq(np.vstack([slopes, weight]), np.append(nearness, weight @ level), rcond=None)
    return found[0].astype(np.float64)
