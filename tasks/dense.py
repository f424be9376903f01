"""Dense matching of a pair of images whose poses are known: an elevation for each map cell that both see.

The two images are rectified about their baseline, matched by semi-global matching (Hirschmüller 2008, OpenCV) and
reduced to one value a cell. What is wrong in one pair is for `gridding` to find out by the others.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .camera import focal_px, normalised, outline, project, rays
from .dense_refine import Refined
from .navigation import Poses
from .nodes import upsample
from .projection import look_up

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

_STEP = 16  # rectified pixels between nodes; in between, lenses are linear to a hundredth of a pixel
_LEAST_PX = 48  # sides of an overlap that is worth matching
_DISPARITY_STEP = 16  # of OpenCV
_MOST_DISPARITIES = 256
_BLOCK = 5
_CONTRAST_PX = 31
_LEAST_CONTRAST = 1.5  # grey levels, standard deviation of what counts as texture
_DARK, _BRIGHT = 2, 250
_SPECKLE_PX, _SPECKLE_STEP = 120, 2  # smaller islands of disparity go; an island ends where disparity jumps by so much
_RIM_PX = 2  # beside what could not be matched
_ENOUGH_PX = 4.0  # rectified pixels across a cell, of which every second one each way says enough


class Rectified(NamedTuple):
    """The geometry of two rectified images of one size, rows aligned, x from image i towards image j.

    Attributes
    ----------
    R_local_rect : (3, 3) rectified axes to local axes; z away from the cameras.
    C_local : (3,) of image i. base_m : from there to image j, along x.
    focal_px : pixels a slope. shape : rows, columns.
    left, top : column and row of slope 0 are at -left, -top of image i. shift : image j's left is left - shift.
    disparities : how many, from 0; disparity 0 is `shift` pixels.
    range_m : distance at which pixels stand for points, see `_places`.
    """

    R_local_rect: Array
    C_local: Array
    base_m: float
    focal_px: float
    shape: tuple[int, int]
    left: int
    top: int
    shift: int
    disparities: int
    range_m: float


class Sight(NamedTuple):
    """Where a camera's pixels are in its rectified image, at nodes.

    Attributes
    ----------
    uv : (rows, columns, 2) float32 pixels of the camera; NaN where it does not see.
    departure : (rows, columns, 4) float32 of exact rays from those of a pinhole, x = a + s z: of a_x, s_x, a_y, s_y;
        None for a camera with one centre of projection.
    """

    uv: Array
    departure: Array | None


class Relief(NamedTuple):
    """Points of a pair's surface.

    Attributes
    ----------
    X_local : (N, 3) m.
    metres_per_px : (N,) 1-sigma of the elevation for a pixel of disparity, m.
    noise_px : (N,) 1-sigma of the disparity by the noise of the images.
    """

    X_local: Array
    metres_per_px: Array
    noise_px: Array


def rectified_axes(poses: Poses, i: int, j: int) -> Array | None:
    """R_local_rect (3, 3) of `Rectified`, or None for images that lie one above the other or in one place."""
    base, axis = poses.C_local[j] - poses.C_local[i], poses.R_local_camera[i][:, 2] + poses.R_local_camera[j][:, 2]
    base_m = float(np.linalg.norm(base))
    x = base / max(base_m, 1e-9)
    z = axis - (axis @ x) * x
    if base_m < 1e-3 or np.linalg.norm(z) < 0.9 * np.linalg.norm(axis):
        return None
    z = z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def rectify(
    camera: Camera, poses: Poses, i: int, j: int, depths_m: tuple[float, float], scale: float
) -> Rectified | None:
    """How images i and j are rectified; None where they overlap too little or have no `rectified_axes`.

    depths_m : least and largest distance along the rectified z at which the seabed may be. scale : of pixels, less
        where these distances would take more disparities than are tried.
    """
    R_local_rect = rectified_axes(poses, i, j)
    if R_local_rect is None:
        return None
    C_i = poses.C_local[i]
    base_m = float((poses.C_local[j] - C_i) @ R_local_rect[:, 0])
    range_m = float(np.sqrt(depths_m[0] * depths_m[1]))
    most = (_MOST_DISPARITIES - 2) / (base_m * (1 / depths_m[0] - 1 / depths_m[1]))
    focal = min(scale * focal_px(camera, range_m), most)
    slopes_i, slopes_j = (
        _rect_slopes(camera, R_local_rect.T @ poses.R_local_camera[k], range_m) * focal for k in (i, j)
    )
    shift, last = (focal * base_m / depth for depth in (depths_m[1], depths_m[0]))
    # the deeper the ground, the more of it both see
    low = np.floor(np.maximum(slopes_i.min(0), slopes_j.min(0) + (shift, 0))).astype(int)
    size = np.ceil(np.minimum(slopes_i.max(0), slopes_j.max(0) + (last, 0))).astype(int) - low
    count = int(np.ceil((last - np.floor(shift) + 1) / _DISPARITY_STEP)) * _DISPARITY_STEP
    if (size < _LEAST_PX).any():
        return None
    # OpenCV finds nothing in as many columns at the left as there are disparities
    shape = int(size[1]), int(size[0]) + count
    left, top = int(low[0]) - count, int(low[1])
    return Rectified(R_local_rect, C_i, base_m, focal, shape, left, top, int(shift), count, range_m)


def _rect_slopes(camera: Camera, R_rect_camera: Array, range_m: float) -> Array:
    """Slopes (M, 2) of the image's border in the rectified frame."""
    slopes = normalised(camera, outline(camera, 9), range_m)
    ahead = np.column_stack([slopes, np.ones(len(slopes))]) @ R_rect_camera.T
    return ahead[:, :2] / ahead[:, 2:]


def sight(camera: Camera, made: Rectified, R_local_camera: Array, of_second: bool) -> Sight:
    """Where the pixels of the first or the second image of a pair are."""
    rows, columns = (-(-size // _STEP) + 2 for size in made.shape)
    x, y = ((np.arange(n) - 0.5) * _STEP - 0.5 for n in (columns, rows))
    x_slope, y_slope = _slopes(made, x, y, of_second)
    slopes = np.stack(np.broadcast_arrays(x_slope, y_slope[:, None], 1.0), -1).reshape(-1, 3)
    R_camera_rect = R_local_camera.T @ made.R_local_rect
    ahead = slopes @ R_camera_rect.T
    uv = project(camera, made.range_m * ahead)
    reach = _reach(camera, made.range_m)
    # beyond its rim a lens may fold back into the image
    inside = (np.abs(ahead[:, :2] / np.maximum(ahead[:, 2:], 1e-6)) < reach).all(1) & np.isfinite(uv).all(1)
    uv[~inside] = np.nan
    away = None if camera.port is None else _departure(camera, np.nan_to_num(uv), R_camera_rect, slopes)
    if away is not None:
        away[~inside] = 0
        away = away.reshape(rows, columns, 4).astype(np.float32)
    return Sight(uv.reshape(rows, columns, 2).astype(np.float32), away)


def _reach(camera: Camera, range_m: float) -> Array:
    return 1.1 * np.abs(normalised(camera, outline(camera, 9), range_m)).max(0)


def _departure(camera: Camera, uv: Array, R_camera_rect: Array, slopes: Array) -> Array:
    found = rays(camera, uv)
    o, d = found.origin @ R_camera_rect, found.direction @ R_camera_rect
    s = d[:, :2] / d[:, 2:]
    a = o[:, :2] - s * o[:, 2:]
    return np.column_stack([a[:, 0], s[:, 0] - slopes[:, 0], a[:, 1], s[:, 1] - slopes[:, 1]])


def _slopes(made: Rectified, x: Array, y: Array, of_second: bool) -> tuple[Array, Array]:
    """Slopes of columns x and rows y of one of the rectified images."""
    left = made.left - (made.shift if of_second else 0)
    return (x + left) / made.focal_px, (y + made.top) / made.focal_px


def warp(made: Rectified, seen: Sight, grey: Pixels, erase: Mask, scale: int) -> tuple[Pixels, Mask]:
    """An image's grey levels in its rectified image, with light and contrast evened out, and where they can be used.

    grey, erase : (H / scale, W / scale) the image and which of its pixels the laser lights.
    """
    u, v = cv2.split(upsample((seen.uv + 0.5) / scale - 0.5, _STEP)[: made.shape[0], : made.shape[1]])
    for place in (u, v):
        cv2.patchNaNs(place, -9.0)
    pixels = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[0])
    unseen = np.pad((erase | (grey >= _BRIGHT) | (grey < _DARK)).astype(np.uint8), 1, constant_values=1)
    hidden = cv2.remap(unseen, u + 1, v + 1, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=[1])
    usable = cv2.dilate(hidden, np.ones((_BLOCK, _BLOCK), np.uint8)) == 0
    return _evened(np.asarray(pixels, np.uint8), usable)


def _evened(pixels: Pixels, usable: Mask) -> tuple[Pixels, Mask]:
    """Local mean 128 and local contrast the same everywhere, by usable pixels alone; plain where there are none."""
    known, size = usable.astype(np.float32), (_CONTRAST_PX, _CONTRAST_PX)
    level = pixels * known
    weight = np.maximum(cv2.blur(known, size), 1e-3)
    mean = cv2.blur(level, size) / weight
    contrast = np.sqrt(np.maximum(cv2.blur(level * level, size) / weight - mean * mean, 0))
    even = (level - mean) * (48 * known / np.maximum(contrast, _LEAST_CONTRAST)) + 128
    return np.clip(even, 0, 255).astype(np.uint8), usable & (contrast > _LEAST_CONTRAST)


def disparity(made: Rectified, first: tuple[Pixels, Mask], second: tuple[Pixels, Mask]) -> Array:
    """Disparity (rows, columns) float32 of the first image's pixels, from 0; NaN where there is none to trust."""
    area = _BLOCK * _BLOCK
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=made.disparities,
        blockSize=_BLOCK,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        preFilterCap=63,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    fixed = matcher.compute(first[0], second[0])
    cv2.filterSpeckles(fixed, -16, _SPECKLE_PX, 16 * _SPECKLE_STEP)
    found = fixed.astype(np.float32) / 16
    column = np.arange(made.shape[1], dtype=np.float32) - found
    there = cv2.remap(
        second[1].astype(np.uint8),
        column,
        np.repeat(np.arange(made.shape[0], dtype=np.float32)[:, None], made.shape[1], 1),
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=[0],
    )
    good = (fixed >= 0) & first[1] & (there > 0)
    good = cv2.erode(good.astype(np.uint8), np.ones((2 * _RIM_PX + 1,) * 2, np.uint8)) > 0
    return np.where(good, found, np.float32(np.nan))


def spacing(pixels_a_cell: float) -> int:
    """Rectified pixels from point to point: neighbours tell the same, but a cell needs some."""
    return 2 if pixels_a_cell >= _ENOUGH_PX else 1


def points(made: Rectified, matched: Refined, first: Sight, second: Sight, every: int = 1) -> Relief:
    """The points of a disparity image, by the exact rays of both cameras. every : by `spacing`."""
    found = matched.disparity
    row, column = np.nonzero(np.isfinite(found[::every, ::every]))
    row, column = row * every, column * every
    moved = column - found[row, column].astype(float)
    x_i, y_i = _slopes(made, column, row, False)
    x_j, _ = _slopes(made, moved, row, True)
    a_i, s_i, a_y, s_y = _lines(first, column, row, x_i, y_i)
    a_j, s_j, _, _ = _lines(second, moved, row, x_j, y_i)
    Z = (made.base_m + a_j - a_i) / (s_i - s_j)
    X = np.column_stack([a_i + s_i * Z, a_y + s_y * Z, Z])
    sigma = Z**2 / (made.focal_px * made.base_m) * np.abs(made.R_local_rect[2, 2])
    return Relief(made.C_local + X @ made.R_local_rect.T, sigma, matched.sigma_px[row, column].astype(float))


def _lines(seen: Sight, x: Array, y: Array, x_slope: Array, y_slope: Array) -> tuple[Array, Array, Array, Array]:
    """The rays x = a + s z of pixels (N,) of a rectified image: a_x, s_x, a_y, s_y."""
    if seen.departure is None:
        zero = np.zeros(len(x))
        return zero, x_slope, zero, y_slope
    at = [((values + 0.5) / _STEP + 0.5).astype(np.float32) for values in (x, y)]
    away = look_up(seen.departure, at[0], at[1]).astype(float).T
    return away[0], x_slope + away[1], away[2], y_slope + away[3]
