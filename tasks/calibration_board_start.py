"""Where a calibration with a board begins: camera, poses and sheets, each on its own, and which points to use."""

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import DISTORTION, Camera
from .calibration_sheets import SheetBasis, moved
from .camera import rays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Model = Literal["brown", "fisheye", "flat-port"]


def first_camera(
    corners: Sequence[tuple[Array, Array]], size: tuple[int, int], model: Model, free: Sequence[str]
) -> Camera:
    """Interior orientation by OpenCV's own calibration, from board points (N, 3) and pixels (N, 2) of each image.

    Parameters
    ----------
    size : width and height. free : names that the adjustment estimates; other distortion is left at zero.
    """
    board = [np.ascontiguousarray(X, np.float32).reshape(-1, 1, 3) for X, _ in corners]
    pixels = [np.ascontiguousarray(uv, np.float32).reshape(-1, 1, 2) for _, uv in corners]
    width, height = size
    if model == "fisheye":
        flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
        K, D = np.eye(3), np.zeros((4, 1))
        wide = [part.astype(np.float64) for part in board], [part.astype(np.float64) for part in pixels]
        _, K, D, _, _ = cv2.fisheye.calibrate(*wide, size, K, D, flags=flags)
        distortion = D.ravel()
    else:
        flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_LU
        _, K, D, _, _ = cv2.calibrateCamera(board, pixels, size, np.eye(3), np.zeros(5), flags=flags)
        distortion = D.ravel()[:5]
    names = DISTORTION["fisheye" if model == "fisheye" else "brown"]
    distortion = [float(v) if name in free else 0.0 for name, v in zip(names, distortion, strict=True)]
    return Camera(
        model="fisheye" if model == "fisheye" else "brown",
        width=width,
        height=height,
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        distortion=tuple(distortion),
    )


def first_poses(camera: Camera, corners: Sequence[tuple[Array, Array]]) -> Array:
    """Rotation vector and translation (n, 6), board to camera, of each image, by OpenCV's solvePnP on slopes."""
    poses = []
    for X, uv in corners:
        origin, direction = rays(camera, uv)
        # behind a flat port the rays' origins are off the centre by centimetres at most: good to begin with
        slopes = np.ascontiguousarray(direction[:, :2] / direction[:, 2:]).reshape(-1, 1, 2)
        _, rotation, translation = cv2.solvePnP(np.ascontiguousarray(X), slopes, np.eye(3), None)
        shift = origin.mean(axis=0)
        poses.append(np.concatenate([rotation.ravel(), translation.ravel() + shift * (camera.port is not None)]))
    return np.array(poses, float)


def first_sheet(name: str, X: Array) -> SheetBasis:
    """The plane nearest to points (N, 3), metres: total least squares, three times, without what is far off."""
    keep = np.isfinite(X).all(1)
    centre, normal = X[keep].mean(0), np.zeros(3)
    for _ in range(3):
        centre = X[keep].mean(0)
        normal = np.linalg.svd(X[keep] - centre, full_matrices=False)[2][2]
        off = np.abs((X - centre) @ normal)
        keep = off < max(4 * 1.4826 * float(np.nanmedian(off)), 1e-9)
    normal = normal * (1.0 if normal @ centre >= 0 else -1.0)
    first = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    return SheetBasis(name, centre, normal, np.stack([first, np.cross(normal, first)]))


def fit_sheet(X: Array) -> Array:
    """Normal and offset (4,) of the plane nearest to points (N, 3), outliers left out."""
    start = first_sheet("", X)
    return moved(start, np.zeros(3))
