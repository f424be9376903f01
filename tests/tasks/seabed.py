"""A simulated camera over ground with a pattern that has no symmetry, for the tests of mosaics."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from seamosaic.schemas.calibration import Camera
from seamosaic.tasks import camera as cameras
from seamosaic.tasks import mosaic, nodes, rotations

CAMERA = Camera(
    model="brown", width=320, height=240, fx=416.0, fy=420.0, cx=163.0, cy=117.0,
    distortion=(-0.08, 0.03, 0.0006, -0.0005, 0.0),
)  # fmt: skip


class View(NamedTuple):
    """An image (H, W, 3), the pixels to erase (H, W), and where it was taken from."""

    image: np.ndarray
    erase: np.ndarray
    camera: Camera
    R_local_camera: np.ndarray
    C_local: np.ndarray
    number: int


def shot_of(view, thumbnail=None):
    scale = nodes.quality_scale(view.camera)
    assert scale == 1
    return nodes.Shot(view.number, view.camera, nodes.qualities(view.erase, scale), thumbnail)


def shrunk(image, times):
    size = -(-image.shape[1] // times), -(-image.shape[0] // times)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def compose(plans, views, **options):
    """The mosaics of plans; every image that counts is asked for once."""
    images, asked = {view.number: view.image for view in views}, []

    def read(number, times):
        asked.append(number)
        return shrunk(images[number], times)

    cell = plans[0].tile.cell_m
    times = {view.number: mosaic.reduction(view.camera, view.C_local[2] + 3.0, cell) for view in views}
    made = mosaic.compose(plans, read, times, **options)
    assert len(set(asked)) == len(asked)
    return made


def pattern(x, y):
    """Colours (..., 3), 0..255, of the ground at map x, y less the origin: smooth, and unlike any mirror image."""
    red = 120 + 60 * np.sin(9 * x + 2 * np.sin(3 * y)) + 50 * np.tanh(4 * (y - 0.3 * x))
    green = 110 + 70 * np.sin(7 * y - 3 * x + 1) * np.cos(2 * x * y)
    blue = 90 + 25 * x + 40 * np.sin(13 * (x + y))
    return np.clip(np.stack([red, green, blue], -1), 0, 255)


def pose(x, y, z, heading=0.0, roll=0.0, pitch=0.0, mount=(0.0, 0.0, 0.0)):
    R = rotations.R_LOCAL_LEVEL @ rotations.R_level_vehicle(roll, pitch, heading) @ rotations.R_vehicle_camera(*mount)
    return R, np.array([x, y, z])


def ground_points(R, C, height: Callable | float, camera=CAMERA, top=-2.2, bottom=-3.5):
    """First points (H * W, 3) of the ground that the pixels' rays meet, by small steps down and then by halving."""
    v, u = np.mgrid[: camera.height, : camera.width]
    direction = cameras.rays(camera, np.column_stack([u.ravel(), v.ravel()]).astype(float)).direction @ R.T
    direction /= -np.where(direction[:, 2:] > -1e-3, -1e-3, direction[:, 2:])
    if not callable(height):
        return C + direction * (C[2] - height)
    depth, step = np.full(len(direction), C[2] - top), 0.02
    going = np.ones(len(direction), bool)
    for _ in range(int((top - bottom) / step)):
        X = C + direction * (depth + step)[:, None]
        going &= X[:, 2] > height(X[:, 0], X[:, 1])
        depth[going] += step
    low, high = depth + step, depth
    for _ in range(12):
        middle = (low + high) / 2
        X = C + direction * middle[:, None]
        above = X[:, 2] > height(X[:, 0], X[:, 1])
        high, low = np.where(above, middle, high), np.where(above, low, middle)
    return C + direction * high[:, None]


def photograph(R, C, height, number, origin=(0.0, 0.0), camera=CAMERA, paint=pattern):
    """The image that a camera takes; origin is where the pattern begins."""
    X = ground_points(R, C, height, camera)
    image = paint(X[:, 0] - origin[0], X[:, 1] - origin[1]).reshape(camera.height, camera.width, 3)
    erase = np.zeros(image.shape[:2], bool)
    return View(np.rint(image).astype(np.uint8), erase, camera, R, C, number)
