"""Calibration with a board in view of the laser: camera, board poses and sheets of light in one adjustment.

The board is the plane z = 0 of its own frame, x and y along its rows and columns. Poses take board to camera.
"""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..schemas.calibration import Camera
from .calibration_sheets import SheetBasis, cast_rays, moved
from .calibration_solve import Layout, Solved, solve, unit_sigma
from .camera import project, rays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Model = Literal["brown", "fisheye", "flat-port"]

_ROUNDS: Final = 4
_OUTLIER_SIGMAS: Final = 4.5
_CORNER_SIGMA_PX: Final = 0.1
_POINTS_A_LINE: Final = 60
_HELD: Final = 1e-7  # of a parameter that is not to change, as a share of its scale
_PINHOLE: Final = ("fx", "fy", "cx", "cy")
_DISTORTION: Final = {
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "flat-port": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_SCALE: Final = {"fx": 10.0, "fy": 10.0, "cx": 10.0, "cy": 10.0, "p1": 0.002, "p2": 0.002}


class BoardData(NamedTuple):
    """What was seen in n images of the board.

    Attributes
    ----------
    corner_uv : (P, 2) pixels. corner_board : (P, 3) on the board, metres. corner_image : (P,).
    laser_uv : (L, 2) pixels of light on the board's plane. laser_sheet, laser_image : (L,). laser_sigma_px : (L,).
    images : how many.
    """

    corner_uv: Array
    corner_board: Array
    corner_image: Indices
    laser_uv: Array
    laser_sheet: Indices
    laser_image: Indices
    laser_sigma_px: Array
    images: int


class BoardResult(NamedTuple):
    """Camera, board poses and sheets.

    Attributes
    ----------
    camera : interior orientation. camera_names : of the covariance's first rows, as "fx".
    R_camera_board, t_camera_board : (n, 3, 3), (n, 3) metres.
    sheets : (S, 4) normals and offsets. starts, steps : from which covariance's steps are measured, S and (3 S,).
    covariance : (c + 3 S,) squared, of camera and steps; widened to what leaving images out says, if that is more.
    corner_residual_px : (P, 2). corner_used : (P,).
    laser_residual_m : (L,) distance of the light on the board from the sheet, along the sheet's normal.
    laser_used : (L,). corner_sigma_px, laser_sigma : measured 1-sigma (pixels; stated sigmas).
    left_out_m : (n, S) rms distance from the board (by its corners alone) of an image's light, triangulated by an
        adjustment without it. left_out_sheets : (n, S, 4) its sheets. range_m : (n,) median range of the light.
    """

    camera: Camera
    camera_names: tuple[str, ...]
    R_camera_board: Array
    t_camera_board: Array
    sheets: Array
    starts: tuple[SheetBasis, ...]
    steps: Array
    covariance: Array
    corner_residual_px: Array
    corner_used: NDArray[np.bool_]
    laser_residual_m: Array
    laser_used: NDArray[np.bool_]
    corner_sigma_px: float
    laser_sigma: float
    left_out_m: Array
    left_out_sheets: Array
    range_m: Array


class _Problem(NamedTuple):
    data: BoardData
    camera: Camera
    names: tuple[str, ...]
    free: tuple[str, ...]
    starts: tuple[SheetBasis, ...]
    per_px: Array
    corner_sigma: float
    laser_sigma: float


def thinned(uv: Array, sheet: Indices, sigma_px: Array) -> Indices:
    """Indices of at most sixty points of each line (N,), spread along it."""
    chosen = []
    for number in np.unique(sheet[sheet >= 0]):
        own = np.flatnonzero(sheet == number)
        own = own[np.argsort(uv[own, 1], kind="stable")]
        chosen.append(own[np.unique(np.linspace(0, len(own) - 1, min(len(own), _POINTS_A_LINE)).astype(int))])
    return np.concatenate(chosen) if chosen else np.zeros(0, np.intp)


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
    names = _DISTORTION["fisheye" if model == "fisheye" else "brown"]
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


def calibrate_board(data: BoardData, camera: Camera, free: Sequence[str]) -> BoardResult:
    """One adjustment of camera, board poses and sheets; sigmas and outliers found in turns.

    Parameters
    ----------
    data : corners and light.
    camera : where to begin, as by `first_camera`, or a camera that is known.
    free : which of its numbers to estimate, as `camera_names` names them; none of a camera that is known.
    """
    names = (*_PINHOLE, *_DISTORTION[camera.model])
    poses = first_poses(camera, _by_image(data))
    problem = _Problem(data, camera, names, tuple(free), (), np.zeros(0), _CORNER_SIGMA_PX, 1.0)
    light = _on_board(camera, poses, data)
    count = int(data.laser_sheet.max(initial=-1)) + 1
    starts = tuple(_first_sheet(str(s), light[data.laser_sheet == s]) for s in range(count))
    problem = problem._replace(starts=starts)
    x = np.concatenate([np.zeros(len(names) + 3 * count), poses.ravel()])
    corner_used, laser_used = np.ones(len(data.corner_uv), bool), np.ones(len(data.laser_uv), bool)
    chosen, solved = problem, None
    for _ in range(_ROUNDS):
        problem = problem._replace(per_px=_per_px(x, problem))
        chosen = _chosen(problem, corner_used, laser_used)
        solved = solve(lambda x, p=chosen: _residuals(x, p), x, _layout(chosen), _rows(chosen))
        x = solved.x
        corner, laser = _groups(chosen)
        sigma = np.clip(problem.corner_sigma * unit_sigma(solved, corner), 0.005, 5)
        factor = np.clip(problem.laser_sigma * unit_sigma(solved, laser), 0.05, 50) if laser.any() else 1.0
        problem = problem._replace(corner_sigma=float(sigma), laser_sigma=float(factor))
        corner_off, laser_off = _misfits(x, problem)
        corner_used, laser_used = _within(np.hypot(*corner_off.T)), _within(np.abs(laser_off))
    assert solved is not None
    return _result(x, solved, problem, corner_used, laser_used)


def _within(off: Array) -> NDArray[np.bool_]:
    spread = 1.4826 * float(np.median(off)) if len(off) else 0.0
    return off <= max(_OUTLIER_SIGMAS * spread, 1e-9)


def _by_image(data: BoardData) -> list[tuple[Array, Array]]:
    own = [data.corner_image == k for k in range(data.images)]
    return [(data.corner_board[o], data.corner_uv[o]) for o in own]


def _first_sheet(name: str, X: Array) -> SheetBasis:
    """The plane nearest to points (N, 3): total least squares, twice, without what is far off."""
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
    start = _first_sheet("", X)
    return moved(start, np.zeros(3))


def _layout(p: _Problem) -> Layout:
    scale = [_SCALE.get(name, 0.05) * (1.0 if name in p.free else _HELD) for name in p.names]
    sheet = [0.01, 0.01, 0.005] * len(p.starts)
    image = np.tile([0.01, 0.01, 0.01, 0.005, 0.005, 0.005], p.data.images)
    return Layout(len(scale) + len(sheet), p.data.images, 6, np.concatenate([scale, sheet, image]))


def _rows(p: _Problem) -> Indices:
    held = len(p.names)
    own = np.concatenate([np.repeat(p.data.corner_image, 2), p.data.laser_image, np.full(held, -1)])
    return np.column_stack([own, np.full(len(own), -1)])


def _groups(p: _Problem) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    number = np.arange(2 * len(p.data.corner_uv) + len(p.data.laser_uv) + len(p.names))
    corner = number < 2 * len(p.data.corner_uv)
    return corner, ~corner & (number < 2 * len(p.data.corner_uv) + len(p.data.laser_uv))


def _chosen(p: _Problem, corner: NDArray[np.bool_], laser: NDArray[np.bool_]) -> _Problem:
    d = p.data
    kept = BoardData(
        d.corner_uv[corner],
        d.corner_board[corner],
        d.corner_image[corner],
        d.laser_uv[laser],
        d.laser_sheet[laser],
        d.laser_image[laser],
        d.laser_sigma_px[laser],
        d.images,
    )
    return p._replace(data=kept, per_px=p.per_px[laser])


def _unpacked(x: Array, p: _Problem) -> tuple[Camera, Array, Array]:
    """Camera, sheets (S, 4) and poses (n, 6)."""
    shared, images = _layout(p).split(x)
    start = dict(zip(p.names, (p.camera.fx, p.camera.fy, p.camera.cx, p.camera.cy, *_padded(p.camera)), strict=True))
    value = {name: start[name] + step for name, step in zip(p.names, shared, strict=False)}
    camera = p.camera.model_copy(
        update={
            **{name: value[name] for name in _PINHOLE},
            "distortion": tuple(value[name] for name in p.names[len(_PINHOLE) :]),
        }
    )
    steps = shared[len(p.names) :].reshape(-1, 3)
    sheets = [moved(start, step) for start, step in zip(p.starts, steps, strict=True)]
    return camera, np.array(sheets).reshape(-1, 4), images


def _padded(camera: Camera) -> tuple[float, ...]:
    size = len(_DISTORTION[camera.model])
    return (*camera.distortion, *[0.0] * (size - len(camera.distortion)))


def _board_planes(poses: Array) -> Array:
    """Normals and offsets (n, 4) of the board in the camera frame."""
    normal = Rotation.from_rotvec(poses[:, :3]).as_matrix()[:, :, 2]
    return np.column_stack([normal, (normal * poses[:, 3:]).sum(1)])


def _on_board(camera: Camera, poses: Array, data: BoardData, shift_px: float = 0.0) -> Array:
    """The light (L, 3) on the board's plane, camera frame."""
    if not len(data.laser_uv):
        return np.zeros((0, 3))
    origin, direction = rays(camera, data.laser_uv + np.array([shift_px, 0.0]))
    return cast_rays(origin, direction, _board_planes(poses)[data.laser_image])


def _gaps(camera: Camera, sheets: Array, poses: Array, data: BoardData, shift_px: float = 0.0) -> Array:
    """Distances (L,) of the light on the board from its sheet, metres."""
    if not len(data.laser_uv):
        return np.zeros(0)
    own = sheets[data.laser_sheet]
    return (_on_board(camera, poses, data, shift_px) * own[:, :3]).sum(1) - own[:, 3]


def _per_px(x: Array, p: _Problem) -> Array:
    """Change (L,) of the gaps by one pixel along the row, metres."""
    camera, sheets, poses = _unpacked(x, p)
    change = _gaps(camera, sheets, poses, p.data, 0.5) - _gaps(camera, sheets, poses, p.data, -0.5)
    return np.maximum(np.abs(change), 1e-9)


def _misfits(x: Array, p: _Problem) -> tuple[Array, Array]:
    """Corners (P, 2), pixels, and gaps (L,), in stated sigmas."""
    camera, sheets, poses = _unpacked(x, p)
    R = Rotation.from_rotvec(poses[:, :3]).as_matrix()[p.data.corner_image]
    X = np.einsum("pij,pj->pi", R, p.data.corner_board) + poses[p.data.corner_image, 3:]
    gaps = _gaps(camera, sheets, poses, p.data)
    return np.nan_to_num(project(camera, X) - p.data.corner_uv, nan=1e3), gaps / (p.per_px * p.data.laser_sigma_px)


def _residuals(x: Array, p: _Problem) -> Array:
    corner, laser = _misfits(x, p)
    scale = _layout(p).scale[: len(p.names)]
    hold = np.array([0.01 if name in p.free else 1.0 for name in p.names])
    held = x[: len(p.names)] / scale * hold
    return np.concatenate([corner.ravel() / p.corner_sigma, laser / p.laser_sigma, held])


def _result(x: Array, solved: Solved, p: _Problem, corner_used: NDArray, laser_used: NDArray) -> BoardResult:
    camera, sheets, poses = _unpacked(x, p)
    corner, _ = _misfits(x, p)
    light = _on_board(camera, poses, p.data)
    size = len(p.names) + 3 * len(p.starts)
    left_out, left_out_m = _left_out(x, p, corner_used, laser_used)
    steps = x[len(p.names) : size]
    covariance = solved.covariance[:size, :size]
    wide = _widened(covariance, left_out, sheets, p.starts, len(p.names))
    ranges = [light[laser_used & (p.data.laser_image == k)] for k in range(p.data.images)]
    return BoardResult(
        camera=camera,
        camera_names=p.names,
        R_camera_board=Rotation.from_rotvec(poses[:, :3]).as_matrix(),
        t_camera_board=poses[:, 3:],
        sheets=sheets,
        starts=p.starts,
        steps=steps,
        covariance=wide,
        corner_residual_px=corner,
        corner_used=corner_used,
        laser_residual_m=_gaps(camera, sheets, poses, p.data),
        laser_used=laser_used,
        corner_sigma_px=p.corner_sigma,
        laser_sigma=p.laser_sigma,
        left_out_m=left_out_m,
        left_out_sheets=left_out,
        range_m=np.array([float(np.median(np.linalg.norm(X, axis=1))) if len(X) else np.nan for X in ranges]),
    )


def _without(x: Array, p: _Problem, corner: NDArray, laser: NDArray, image: int) -> tuple[Camera, Array, Array]:
    """Camera, sheets and poses of an adjustment that knows nothing of the light in one image."""
    chosen = _chosen(p, corner, laser & (p.data.laser_image != image))
    solved = solve(lambda y: _residuals(y, chosen), x, _layout(chosen), _rows(chosen))
    return _unpacked(solved.x, chosen)


def _left_out(x: Array, p: _Problem, corner: NDArray, laser: NDArray) -> tuple[Array, Array]:
    """Sheets (n, S, 4) without the light of each image, and what they are off by on it (n, S).

    The latter is the rms distance, metres, along the board's normal, of the image's light, triangulated with these
    sheets, from the board as its corners alone have it. NaN where too little is left to tell.
    """
    count, lit = len(p.starts), p.data.laser_image
    sheets, rms = np.full((p.data.images, count, 4), np.nan), np.full((p.data.images, count), np.nan)
    for k in np.unique(lit[laser]):
        camera, others, poses = _without(x, p, corner, laser, int(k))
        board = _board_planes(poses)[k]
        for s in range(count):
            own = laser & (p.data.laser_sheet == s)
            if len(np.unique(lit[own & (lit != k)])) < 2:
                continue
            sheets[k, s] = others[s]
            here = own & (lit == k)
            if here.any():
                X = cast_rays(*rays(camera, p.data.laser_uv[here]), others[s])
                rms[k, s] = float(np.sqrt(np.mean((X @ board[:3] - board[3]) ** 2)))
    return sheets, rms


def _widened(covariance: Array, left_out: Array, sheets: Array, starts: Sequence[SheetBasis], first: int) -> Array:
    """The covariance with each sheet's rows scaled up to the jackknife's variance where that is larger.

    Errors that all points of an image share (a bent board, glare) do not show in the residuals, but in how much the
    sheets change when an image is left out.
    """
    factor = np.ones(len(covariance))
    for s, start in enumerate(starts):
        known = np.isfinite(left_out[:, s]).all(1)
        count = int(known.sum())
        if count < 4:
            continue
        sign = np.sign(left_out[known, s, :3] @ sheets[s, :3])
        others = left_out[known, s] * sign[:, None]
        turn = (others[:, :3] - sheets[s, :3]) @ start.tangents.T
        shift = others[:, 3] - others[:, :3] @ start.anchor
        steps = np.column_stack([turn, shift])
        variance = (count - 1) * np.mean((steps - steps.mean(0)) ** 2, axis=0)
        own = slice(first + 3 * s, first + 3 * s + 3)
        factor[own] = np.sqrt(np.maximum(variance / np.diag(covariance)[own], 1.0))
    return covariance * np.outer(factor, factor)
