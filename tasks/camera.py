"""Cameras in water: pixel to ray and back, for brown, fisheye and flat-port (FORMATS, "calibration.yaml").

Pixels (u, v) have their centres at integer coordinates; rays and points are in the camera frame, metres.
"""

from collections.abc import Hashable
from functools import lru_cache
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, Port

Array = NDArray[np.float64]

_NEWTON_STEPS = 12
# Iterations that are tried to undo distortion, and what more of them may still move a corner by, pixels.
_ITERATIONS: Final = (5, 8, 12, 20, 40)
_SETTLED_PX: Final = 1e-9


class Rays(NamedTuple):
    """Half-lines in water, camera frame.

    Attributes
    ----------
    origin : (N, 3) a point of each ray, metres; the centre of projection but for a flat port.
    direction : (N, 3) unit vectors, away from the camera.
    """

    origin: Array
    direction: Array


def camera_matrix(camera: Camera) -> Array:
    """K, (3, 3), pixels."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def _coefficients(camera: Camera) -> Array:
    size = 4 if camera.model == "fisheye" else 5
    return np.array([*camera.distortion, *[0.0] * (size - len(camera.distortion))])


def _undistort(camera: Camera, uv: Array) -> Array:
    """Pinhole slopes (N, 2) x/z, y/z of pixels, before any refraction."""
    pixels = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 1, 2)
    if not len(pixels):
        return np.zeros((0, 2))
    if camera.model == "fisheye":
        slopes = cv2.fisheye.undistortPoints(pixels, camera_matrix(camera), _coefficients(camera))
        return np.asarray(slopes, np.float64).reshape(-1, 2)
    return _after(camera, pixels, _iterations(cast(Hashable, camera))).reshape(-1, 2)


def _after(camera: Camera, pixels: Array, iterations: int) -> Array:
    """Pinhole slopes (N, 1, 2) of pixels (N, 1, 2) after so many iterations: to test for an end costs as much again."""
    criteria = (cv2.TERM_CRITERIA_COUNT, iterations, 0)
    K, distortion = camera_matrix(camera), _coefficients(camera)
    return np.asarray(cv2.undistortPoints(pixels, K, distortion, criteria=criteria), np.float64)


@lru_cache(maxsize=16)
def _iterations(camera: Camera) -> int:
    """How many iterations undo a camera's distortion at its image's border, where it is strongest."""
    border = outline(camera, 9)[:, None]
    settled = _after(camera, border, _ITERATIONS[-1])
    moved = [camera.fx * np.abs(_after(camera, border, count) - settled).max() for count in _ITERATIONS]
    return _ITERATIONS[int(np.argmax(np.array(moved) < _SETTLED_PX))]


def _distort(camera: Camera, slopes: Array) -> Array:
    """Pixels (N, 2) of pinhole slopes (N, 2)."""
    if not len(slopes):
        return np.zeros((0, 2))
    if camera.model == "fisheye":
        points = np.column_stack([slopes, np.ones(len(slopes))]).reshape(-1, 1, 3)
        zero, K = np.zeros(3), camera_matrix(camera)
        pixels = cv2.fisheye.projectPoints(points, zero, zero, K, _coefficients(camera))[0]
        return np.asarray(pixels, np.float64).reshape(-1, 2)
    # as cv2.projectPoints, which also computes derivatives, at twenty times the cost
    k1, k2, p1, p2, k3 = _coefficients(camera)
    x, y = slopes.T
    r2 = x * x + y * y
    radial, cross = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * x * y
    u = camera.fx * (x * radial + p1 * cross + p2 * (r2 + 2 * x * x)) + camera.cx
    v = camera.fy * (y * radial + p1 * (r2 + 2 * y * y) + p2 * cross) + camera.cy
    return np.column_stack([u, v])


def rays(camera: Camera, uv: Array) -> Rays:
    """Rays in water of pixels (N, 2).

    For a flat port the ray is refracted into glass and again into water; its origin is where it leaves the
    outer face of the window.
    """
    slopes = _undistort(camera, uv)
    direction = np.empty((len(slopes), 3))
    direction[:, 2] = 1 / np.sqrt(1 + slopes[:, 0] ** 2 + slopes[:, 1] ** 2)
    direction[:, :2] = slopes * direction[:, 2:]
    if camera.port is None:
        return Rays(np.zeros_like(direction), direction)
    return _through_port(camera.port, slopes, direction)


def _through_port(port: Port, slopes: Array, direction: Array) -> Rays:
    sine_air = np.hypot(direction[:, 0], direction[:, 1])
    azimuth = np.divide(direction[:, :2], sine_air[:, None], out=np.zeros_like(slopes), where=sine_air[:, None] > 0)
    sine_glass, sine_water = sine_air / port.glass_index, sine_air / port.water_index
    radius = port.distance * np.hypot(slopes[:, 0], slopes[:, 1]) + port.thickness * _tangent(sine_glass)
    outer = np.full(len(slopes), port.distance + port.thickness)
    return Rays(
        np.column_stack([azimuth * radius[:, None], outer]),
        np.column_stack([azimuth * sine_water[:, None], np.sqrt(1 - sine_water**2)]),
    )


def _tangent(sine: Array) -> Array:
    return sine / np.sqrt(1 - sine**2)


def project(camera: Camera, X_camera: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in water; NaN for points not in front of the camera (or of its window)."""
    X = np.asarray(X_camera, float)
    near = 1e-6 if camera.port is None else camera.port.distance + camera.port.thickness + 1e-6
    front = X[:, 2] > near
    uv = np.full((len(X), 2), np.nan)
    slopes = X[front, :2] / X[front, 2:]
    if camera.port is not None:
        slopes = _slopes_before_port(camera.port, X[front])
    uv[front] = _distort(camera, slopes)
    return uv


def _slopes_before_port(port: Port, X: Array) -> Array:
    """Slopes in air of the rays that reach points X (N, 3): Newton on the tangent of the angle in air.

    The radius at which a ray crosses the point's depth grows monotonically and is concave in that tangent, so
    starting from the pinhole solution Newton's steps stay on one side.
    """
    radius, water = np.hypot(X[:, 0], X[:, 1]), X[:, 2] - port.distance - port.thickness
    tangent = radius / X[:, 2]
    for _ in range(_NEWTON_STEPS):
        sine = tangent / np.sqrt(1 + tangent**2)
        slope_of_sine = (1 + tangent**2) ** -1.5
        reached, gain = port.distance * tangent, np.full_like(tangent, port.distance)
        for index, thickness in ((port.glass_index, port.thickness), (port.water_index, water)):
            inside = sine / index
            reached = reached + thickness * _tangent(inside)
            gain = gain + thickness * (1 - inside**2) ** -1.5 * slope_of_sine / index
        tangent = np.maximum(tangent - (reached - radius) / gain, 0)
    azimuth = np.divide(X[:, :2], radius[:, None], out=np.zeros((len(X), 2)), where=radius[:, None] > 0)
    return azimuth * tangent[:, None]


def normalised(camera: Camera, uv: Array, range_m: float | Array = 3.0) -> Array:
    """Slopes (N, 2) X/Z, Y/Z of the point that each pixel (N, 2) sees at depth Z = range_m, one or (N,).

    Exact at every depth for a camera with one centre of projection; for a flat port, whose rays do not meet in
    one point, exact at that depth only.
    """
    origin, direction = rays(camera, uv)
    step = (range_m - origin[:, 2]) / direction[:, 2]
    return (origin[:, :2] + step[:, None] * direction[:, :2]) / np.reshape(range_m, (-1, 1))


def ground_sample_distance(camera: Camera, range_m: float) -> float:
    """Metres on the ground under one pixel at the image's centre, looking straight down from range_m."""
    centre = np.array([[camera.cx, camera.cy], [camera.cx + 1, camera.cy], [camera.cx, camera.cy + 1]])
    slopes = normalised(camera, centre, range_m)
    return float(range_m * np.sqrt(np.linalg.norm(slopes[1] - slopes[0]) * np.linalg.norm(slopes[2] - slopes[0])))


def focal_px(camera: Camera, range_m: float) -> float:
    """Pixels a slope at the image's centre, in water: behind a flat port a third more than fx."""
    return range_m / ground_sample_distance(camera, range_m)


def outline(camera: Camera, points_per_side: int = 2) -> Array:
    """Pixels (4 (n - 1), 2) around the image's border, clockwise from the top left corner."""
    t = np.linspace(0, 1, points_per_side)[:-1]
    w, h = camera.width - 1.0, camera.height - 1.0
    zero, one = np.zeros_like(t), np.ones_like(t)
    sides = [(t, zero), (one, t), (1 - t, one), (zero, 1 - t)]
    return np.concatenate([np.column_stack([x * w, y * h]) for x, y in sides])
