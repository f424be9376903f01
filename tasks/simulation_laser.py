"""Simulated laser cross (paper III.A): its light on the seabed, and where its line truly is in an image."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, LaserPlane
from .camera import rays
from .simulation_navigation import Cameras
from .simulation_terrain import Terrain, cast, occluded

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_REACH_SIGMAS = 4.0
_TRIALS = 9


class View(NamedTuple):
    """What a camera sees through its pixels, in its own frame.

    Attributes
    ----------
    origin, direction : (H, W, 3) float32, rays in water (`camera.rays`).
    along_row, along_column : (H, W, 2, 3) change of origin and direction from pixel to pixel.
    pixel_share : a pixel's width over the range at which it looks, at the image's centre.
    """

    origin: Array32
    direction: Array32
    along_row: Array32
    along_column: Array32
    pixel_share: float


class LaserTruth(NamedTuple):
    """Where the laser line is in an image, one entry for each row and arm where it can be seen.

    Attributes
    ----------
    row : (N,) image rows.
    u : (N,) sub-pixel column of the middle of the line on that row.
    arm : (N,) index of the sheet.
    X_camera : (N, 3) the lit point of the seabed, camera frame, metres.
    """

    row: NDArray[np.int64]
    u: Array
    arm: NDArray[np.uint8]
    X_camera: Array


def make_view(camera: Camera) -> View:
    """The rays of all pixels of a camera."""
    shape = (camera.height, camera.width)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    both = rays(camera, np.column_stack([u.ravel(), v.ravel()]))
    origin, direction = (part.reshape(*shape, 3).astype(np.float32) for part in both)
    gradients = [np.stack([np.gradient(part, axis=axis) for part in (origin, direction)], axis=2) for axis in (1, 0)]
    middle = gradients[0][shape[0] // 2, shape[1] // 2, 1]
    return View(origin, direction, gradients[0], gradients[1], float(np.linalg.norm(middle)))


def sheet_light(
    view: View, range_m: Array32, sheet: LaserPlane, up_camera: Array, width_px: float
) -> tuple[NDArray[np.int64], Array32]:
    """Relative light of one sheet on the seabed: flat indices of lit pixels, and 1 in the sheet's middle.

    The sheet's profile is Gaussian and as thick as makes the line width_px wide (1-sigma, across it) where the
    seabed is level; slopes stretch and squeeze it as they do in nature. Shadows are not considered.

    Parameters
    ----------
    range_m : (H, W) along the view's rays.
    sheet : camera frame.
    up_camera : (3,) the vertical in the camera frame.
    width_px : pixels.
    """
    normal = np.asarray(sheet.normal, np.float32)
    s = range_m.ravel()
    origin, direction = view.origin.reshape(-1, 3), view.direction.reshape(-1, 3)
    distance = origin @ normal + s * (direction @ normal) - np.float32(sheet.offset)
    # on level ground a pixel is at most a few times its width at the centre; the profile decides in the end
    near = np.flatnonzero(abs(distance) < 3 * _REACH_SIGMAS * width_px * view.pixel_share * s)
    d, distance, s = direction[near], distance[near], s[near, None]
    level = normal - np.asarray(up_camera, np.float32) * ((d @ normal) / (d @ up_camera.astype(np.float32)))[:, None]
    slopes = []
    for change in (view.along_row, view.along_column):
        part = change.reshape(-1, 2, 3)[near]
        slopes.append(((part[:, 0] + s * part[:, 1]) * level).sum(axis=1))
    sigmas = distance / (width_px * np.hypot(*slopes))
    lit = abs(sigmas) < _REACH_SIGMAS
    return near[lit], np.exp(-0.5 * sigmas[lit] ** 2)


def laser_truth(
    terrain: Terrain,
    camera: Camera,
    sheets: Sequence[LaserPlane],
    emitter: Sequence[float],
    pose: Cameras,
    rows: NDArray[np.int64] | None = None,
) -> LaserTruth:
    """The exact laser line of one image: what a perfect detector would find.

    Parameters
    ----------
    terrain : the seabed, local frame.
    camera : the camera that took the image.
    sheets, emitter : the two sheets and the laser's origin (3,), camera frame, metres.
    pose : one pose, R_local_camera (1, 3, 3) and C_local (1, 3).
    rows : image rows to look at; all by default.

    Returns
    -------
    LaserTruth
        Only points that the camera sees and the laser lights, ordered by arm, row, column. A row that an arm
        crosses more than once, behind a step, has one entry for each crossing.
    """
    rows = np.arange(camera.height) if rows is None else np.asarray(rows)
    u, v = (part.ravel().astype(float) for part in np.meshgrid(np.arange(camera.width), rows))
    X = _seen(terrain, camera, pose, u, v)
    found = []
    for arm, sheet in enumerate(sheets):
        off = (X @ sheet.normal - sheet.offset).reshape(len(rows), -1)
        left = np.flatnonzero(np.pad((off[:, :-1] < 0) != (off[:, 1:] < 0), ((0, 0), (0, 1))).ravel())
        found.append(_between(terrain, camera, pose, sheet, u[left], v[left], arm))
    row, column, arm, X = (np.concatenate(part) for part in zip(*found, strict=True))
    R, C = pose.R_local_camera[0], pose.C_local[0]
    lit = ~occluded(terrain, X @ R.T + C, R @ np.asarray(emitter) + C)
    return LaserTruth(row[lit].astype(np.int64), column[lit], arm[lit], X[lit])


def _seen(terrain: Terrain, camera: Camera, pose: Cameras, u: Array, v: Array) -> Array:
    """Points of the seabed (N, 3), camera frame, at sub-pixel positions."""
    origin, direction = rays(camera, np.column_stack([u, v]))
    R, C = pose.R_local_camera[0], pose.C_local[0]
    return origin + cast(terrain, origin @ R.T + C, direction @ R.T)[:, None] * direction


def _between(
    terrain: Terrain, camera: Camera, pose: Cameras, sheet: LaserPlane, u: Array, v: Array, arm: int
) -> tuple[Array, Array, NDArray[np.uint8], Array]:
    """Where rows v cross a sheet between columns u and u + 1, by false position; jumps across a step are left out."""

    def off(at: Array) -> tuple[Array, Array]:
        X = _seen(terrain, camera, pose, at, v)
        return X, X @ sheet.normal - sheet.offset

    low, high = u.copy(), u + 1
    off_low, off_high = off(low)[1], off(high)[1]
    at, X, left = low, np.zeros((len(u), 3)), off_low
    for _ in range(_TRIALS):
        at = (low * off_high - high * off_low) / (off_high - off_low)
        X, left = off(at)
        below = (left < 0) == (off_low < 0)
        # the end that stays is given half its weight, or it might stay for ever (Illinois)
        low, off_low = np.where(below, at, low), np.where(below, left, off_low / 2)
        high, off_high = np.where(below, high, at), np.where(below, off_high / 2, left)
    on = abs(left) < 5e-4
    return v[on], at[on], np.full(int(on.sum()), arm, np.uint8), X[on]
