"""Calibration with a board in view of the laser: camera, board poses and sheets of light in one adjustment.

The board is the plane z = 0 of its own frame, x and y along its rows and columns. Poses take board to camera.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from ..schemas.calibration import DISTORTION, Camera
from .board_shape import FLAT, Shape, around, heights, meet
from .calibration_board_start import first_poses, first_sheet
from .calibration_sheets import SheetBasis, cast_rays, moved
from .calibration_solve import Layout, Solved, solve, unit_sigma
from .camera import project, rays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_ROUNDS: Final = 4
_ROUNDS_BENT: Final = 7
_RELEASES: Final = 2
_BEND: Final = 0.01  # how far a board may bend, as a share of its size
_PRINTED: Final = 0.01  # how far a corner may be from its place, as a share of the distance to the next
_NUDGE_M: Final = 1e-6
_MOST_ALIKE: Final = 0.9
_LEAST_LEFT_OUT: Final = 4
_OUTLIER_SIGMAS: Final = 4.5
_CORNER_SIGMA_PX: Final = 0.1
_BEST_CORNER_PX: Final = 0.03  # what neighbours have in common, from the raster of pixels, shows in no residual
_HELD: Final = 1e-7  # of a parameter that is not to change, as a share of its scale
_PINHOLE: Final = ("fx", "fy", "cx", "cy")
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
    shape : of the board; flat unless it was asked for.
    sheets : (S, 4) normals and offsets. starts, steps : from which covariance's steps are measured, S and (3 S,).
    covariance : (c + 3 S,) squared, of camera and steps; widened to what leaving images out says, if that is more.
    corner_residual_px : (P, 2). corner_used : (P,).
    laser_residual_m : (L,) distance of the light on the board from the sheet, along the sheet's normal.
    light_on_board : (L, 3) in the board's frame. laser_used : (L,).
    corner_sigma_px, laser_sigma : measured 1-sigma (pixels; stated sigmas).
    left_out_m : (L,) height over the board (by its corners alone) of the light, triangulated by an adjustment without
        that of its image; NaN where too little is left to tell. left_out_sheets : (n, S, 4) its sheets.
    range_m : (n,) median range of the light.
    """

    camera: Camera
    camera_names: tuple[str, ...]
    R_camera_board: Array
    t_camera_board: Array
    shape: Shape
    sheets: Array
    starts: tuple[SheetBasis, ...]
    steps: Array
    covariance: Array
    corner_residual_px: Array
    corner_used: NDArray[np.bool_]
    laser_residual_m: Array
    light_on_board: Array
    laser_used: NDArray[np.bool_]
    corner_sigma_px: float
    laser_sigma: float
    left_out_m: Array
    left_out_sheets: Array
    range_m: Array


class _Problem(NamedTuple):
    data: BoardData
    printed: Array
    camera: Camera
    names: tuple[str, ...]
    free: tuple[str, ...]
    starts: tuple[SheetBasis, ...]
    per_px: Array
    corner_sigma: float
    laser_sigma: float
    shape: Shape


class _State(NamedTuple):
    """Unknowns as things: camera, sheets (S, 4), shape of the board, poses (n, 6)."""

    camera: Camera
    sheets: Array
    shape: Shape
    poses: Array


def calibrate_board(data: BoardData, camera: Camera, free: Sequence[str], bent: bool = False) -> BoardResult:
    """One adjustment of camera, board poses and sheets; sigmas and outliers found in turns.

    Parameters
    ----------
    data : corners and light.
    camera : where to begin, as by `first_camera`, or a camera that is known.
    free : which of its numbers to estimate, as `camera_names` names them; none of a camera that is known.
    bent : whether the board may not be flat: its shape, one smooth surface in all images, is estimated with the rest,
        and the places of its corners.
    """
    names = (*_PINHOLE, *DISTORTION[camera.model])
    poses = first_poses(camera, _by_image(data))
    printed, unknown = data.corner_board, np.zeros(0)
    problem = _Problem(data, printed, camera, names, tuple(free), (), unknown, _CORNER_SIGMA_PX, 1.0, FLAT)
    light = _on_board(_State(camera, np.zeros((0, 4)), FLAT, poses), data)
    count = int(data.laser_sheet.max(initial=-1)) + 1
    starts = tuple(first_sheet(str(s), light[data.laser_sheet == s]) for s in range(count))
    shape = around(_seen(data, poses, light)) if bent else FLAT
    problem = problem._replace(starts=starts, shape=shape)
    x = np.concatenate([np.zeros(len(names) + 3 * count + len(shape.terms)), poses.ravel()])
    corner_used, laser_used = np.ones(len(data.corner_uv), bool), np.ones(len(data.laser_uv), bool)
    chosen, solved = problem, None
    for _ in range(_ROUNDS_BENT if bent else _ROUNDS):
        problem = problem._replace(per_px=_per_px(x, problem))
        chosen, adjusted = _chosen(problem, corner_used, laser_used), corner_used
        solved = _adjusted(x, chosen)
        x = solved.x
        corner, laser = _groups(chosen)
        sigma = np.clip(problem.corner_sigma * unit_sigma(solved, corner), _BEST_CORNER_PX, 5)
        factor = 1.0
        if laser.any():
            unit = unit_sigma(solved, laser) * _alike(solved.residual[laser], chosen.data)
            factor = np.clip(problem.laser_sigma * unit, 0.05, 50)
        problem = problem._replace(corner_sigma=float(sigma), laser_sigma=float(factor))
        corner_off, laser_off = _misfits(x, problem)
        corner_used, laser_used = _within(np.hypot(*corner_off.T)), _within(np.abs(laser_off))
        if bent:
            problem = problem._replace(data=_released(problem, chosen, solved, adjusted))
    assert solved is not None
    return _result(x, solved, problem, corner_used, laser_used)


def _released(p: _Problem, chosen: _Problem, solved: Solved, used: NDArray[np.bool_]) -> BoardData:
    """The data of p with every corner of the board moved to where all images together have it.

    As Strobl and Hirzinger 2011 (and cv2.calibrateCameraRO) release the target, but with the printed places as a
    prior, so that scale and pose of the board stay. Poses, lens and shape follow the places, and are eliminated from
    the normal equations: a step that held them would be a small part of the way, for their errors look alike.

    Parameters
    ----------
    chosen, solved : the part of p that was adjusted, and its solution. used : (P,) which corners of p that part has.
    """
    state, d = _unpacked(solved.x, chosen), chosen.data
    J = np.stack([_corners(state, d, step) - _corners(state, d, -step) for step in _NUDGE_M * np.eye(3)], axis=2)
    J = np.nan_to_num(J) / (2 * _NUDGE_M * chosen.corner_sigma)
    places, number = np.unique(p.printed, axis=0, return_inverse=True)
    by_place = np.zeros((*J.shape[:2], len(places), 3))
    by_place[np.arange(len(J)), :, number[used]] = J
    by_place = by_place.reshape(2 * len(J), -1)
    corner, _ = _groups(chosen)
    now = np.zeros_like(places)
    now[number] = p.data.corner_board - p.printed
    prior = (_PRINTED * float(np.min(pdist(places)))) ** -2
    joint = by_place.T @ solved.jacobian[corner] @ solved.covariance
    normal = by_place.T @ (by_place - solved.jacobian[corner] @ joint.T) + prior * np.eye(3 * len(places))
    slope = by_place.T @ solved.residual[corner] - joint @ (solved.jacobian.T @ solved.residual)
    now = now - np.linalg.solve(normal, slope + prior * now.ravel()).reshape(now.shape)
    return p.data._replace(corner_board=p.printed + now[number])


def _alike(residual: Array, data: BoardData) -> float:
    """By how much neighbours on a line that err alike (at the edges of squares, on a bent board) widen their sigma."""
    same = (np.diff(data.laser_image) == 0) & (np.diff(data.laser_sheet) == 0)
    product = float((residual[1:] * residual[:-1])[same].sum())
    correlation = product / max(float((residual[1:] ** 2)[same].sum()), 1e-12)
    correlation = float(np.clip(correlation, 0.0, _MOST_ALIKE))
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def _within(off: Array) -> NDArray[np.bool_]:
    spread = 1.4826 * float(np.median(off)) if len(off) else 0.0
    return off <= max(_OUTLIER_SIGMAS * spread, 1e-9)


def _by_image(data: BoardData) -> list[tuple[Array, Array]]:
    own = [data.corner_image == k for k in range(data.images)]
    return [(data.corner_board[o], data.corner_uv[o]) for o in own]


def _in_board(data: BoardData, poses: Array, light: Array) -> Array:
    """The light (L, 3), metres, from the camera's to the board's frame."""
    R = Rotation.from_rotvec(poses[:, :3]).as_matrix()[data.laser_image]
    return np.einsum("pji,pj->pi", R, light - poses[data.laser_image, 3:])


def _seen(data: BoardData, poses: Array, light: Array) -> Array:
    """Where corners and light are on the board (N, 2), metres."""
    on_board = _in_board(data, poses, light)
    return np.concatenate([data.corner_board[:, :2], on_board[np.isfinite(on_board).all(1), :2]])


def _layout(p: _Problem) -> Layout:
    scale = [_SCALE.get(name, 0.05) * (1.0 if name in p.free else _HELD) for name in p.names]
    sheet = [0.01, 0.01, 0.005] * len(p.starts)
    bend = [_BEND * p.shape.size_m] * len(p.shape.terms)
    image = np.tile([0.01, 0.01, 0.01, 0.005, 0.005, 0.005], p.data.images)
    return Layout(len(scale) + len(sheet) + len(bend), p.data.images, 6, np.concatenate([scale, sheet, bend, image]))


def _rows(p: _Problem) -> Indices:
    held = len(p.names) + len(p.shape.terms)
    own = np.concatenate([np.repeat(p.data.corner_image, 2), p.data.laser_image, np.full(held, -1)])
    return np.column_stack([own, np.full(len(own), -1)])


def _groups(p: _Problem) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    number = np.arange(2 * len(p.data.corner_uv) + len(p.data.laser_uv) + len(p.names) + len(p.shape.terms))
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
    return p._replace(data=kept, printed=p.printed[corner], per_px=p.per_px[laser])


def _unpacked(x: Array, p: _Problem) -> _State:
    shared, images = _layout(p).split(x)
    start = dict(zip(p.names, (p.camera.fx, p.camera.fy, p.camera.cx, p.camera.cy, *_padded(p.camera)), strict=True))
    value = {name: float(start[name] + step) for name, step in zip(p.names, shared, strict=False)}
    camera = p.camera.model_copy(
        update={
            **{name: value[name] for name in _PINHOLE},
            "distortion": tuple(value[name] for name in p.names[len(_PINHOLE) :]),
        }
    )
    steps, terms = np.split(shared[len(p.names) :], [3 * len(p.starts)])
    sheets = [moved(start, step) for start, step in zip(p.starts, steps.reshape(-1, 3), strict=True)]
    return _State(camera, np.array(sheets).reshape(-1, 4), p.shape._replace(terms=terms), images)


def _padded(camera: Camera) -> tuple[float, ...]:
    size = len(DISTORTION[camera.model])
    return (*camera.distortion, *[0.0] * (size - len(camera.distortion)))


def _on_board(state: _State, data: BoardData, shift_px: float = 0.0) -> Array:
    """The light (L, 3) on the board, camera frame."""
    if not len(data.laser_uv):
        return np.zeros((0, 3))
    origin, direction = rays(state.camera, data.laser_uv + np.array([shift_px, 0.0]))
    R = Rotation.from_rotvec(state.poses[:, :3]).as_matrix()[data.laser_image]
    t = state.poses[data.laser_image, 3:]
    X = meet(state.shape, np.einsum("pji,pj->pi", R, origin - t), np.einsum("pji,pj->pi", R, direction))
    return np.einsum("pij,pj->pi", R, X) + t


def _gaps(state: _State, data: BoardData, shift_px: float = 0.0) -> Array:
    """Distances (L,) of the light on the board from its sheet, metres."""
    if not len(data.laser_uv):
        return np.zeros(0)
    own = state.sheets[data.laser_sheet]
    return (_on_board(state, data, shift_px) * own[:, :3]).sum(1) - own[:, 3]


def _per_px(x: Array, p: _Problem) -> Array:
    """Change (L,) of the gaps by one pixel along the row, metres."""
    state = _unpacked(x, p)
    return np.maximum(np.abs(_gaps(state, p.data, 0.5) - _gaps(state, p.data, -0.5)), 1e-9)


def _corners(state: _State, data: BoardData, step: Array | None = None) -> Array:
    """Pixels (P, 2) of the corners, all of them moved on the board by `step` (3,), metres."""
    R = Rotation.from_rotvec(state.poses[:, :3]).as_matrix()[data.corner_image]
    on_board = data.corner_board + (0.0 if step is None else step)
    bend = heights(state.shape, data.corner_board[:, :2])[:, None] * np.array([0.0, 0.0, 1.0])
    return project(state.camera, np.einsum("pij,pj->pi", R, on_board + bend) + state.poses[data.corner_image, 3:])


def _misfits(x: Array, p: _Problem) -> tuple[Array, Array]:
    """Corners (P, 2), pixels, and gaps (L,), in stated sigmas."""
    state = _unpacked(x, p)
    off = np.nan_to_num(_corners(state, p.data) - p.data.corner_uv, nan=1e3)
    return off, _gaps(state, p.data) / (p.per_px * p.data.laser_sigma_px)


def _residuals(x: Array, p: _Problem) -> Array:
    corner, laser = _misfits(x, p)
    layout = _layout(p)
    hold = np.array([0.01 if name in p.free else 1.0 for name in p.names])
    held = x[: len(p.names)] / layout.scale[: len(p.names)] * hold
    bend = slice(layout.shared - len(p.shape.terms), layout.shared)
    return np.concatenate([corner.ravel() / p.corner_sigma, laser / p.laser_sigma, held, x[bend] / layout.scale[bend]])


def _result(x: Array, solved: Solved, p: _Problem, corner_used: NDArray, laser_used: NDArray) -> BoardResult:
    state = _unpacked(x, p)
    corner, _ = _misfits(x, p)
    light = _on_board(state, p.data)
    size = len(p.names) + 3 * len(p.starts)
    left_out, left_out_m, others = _left_out(x, p, corner_used, laser_used)
    steps = x[len(p.names) : size]
    covariance = solved.covariance[:size, :size]
    wide = _widened(covariance, others[:, :size])
    ranges = [light[laser_used & (p.data.laser_image == k)] for k in range(p.data.images)]
    return BoardResult(
        camera=state.camera,
        camera_names=p.names,
        R_camera_board=Rotation.from_rotvec(state.poses[:, :3]).as_matrix(),
        t_camera_board=state.poses[:, 3:],
        shape=state.shape,
        sheets=state.sheets,
        starts=p.starts,
        steps=steps,
        covariance=wide,
        corner_residual_px=corner,
        corner_used=corner_used,
        laser_residual_m=_gaps(state, p.data),
        light_on_board=_in_board(p.data, state.poses, light),
        laser_used=laser_used,
        corner_sigma_px=p.corner_sigma,
        laser_sigma=p.laser_sigma,
        left_out_m=left_out_m,
        left_out_sheets=left_out,
        range_m=np.array([float(np.median(np.linalg.norm(X, axis=1))) if len(X) else np.nan for X in ranges]),
    )


def _adjusted(x: Array, p: _Problem) -> Solved:
    return solve(lambda y: _residuals(y, p), x, _layout(p), _rows(p))


def _without(x: Array, p: _Problem, corner: NDArray, laser: NDArray, image: int) -> tuple[_State, Array]:
    """What an adjustment finds, and its shared unknowns, that knows nothing of the light in one image."""
    chosen = _chosen(p, corner, laser & (p.data.laser_image != image))
    solved = _adjusted(x, chosen)
    for _ in range(_RELEASES if len(p.shape.terms) else 0):
        # that image's light has had a say in where the corners are, too
        every = np.ones(len(chosen.data.corner_uv), bool)
        chosen = chosen._replace(data=_released(chosen, chosen, solved, every))
        solved = _adjusted(solved.x, chosen)
    return _unpacked(solved.x, chosen), _layout(chosen).split(solved.x)[0]


def _left_out(x: Array, p: _Problem, corner: NDArray, laser: NDArray) -> tuple[Array, Array, Array]:
    """Sheets (n, S, 4) without the light of each image, how far they put it off (L,), and what is shared (n, K).

    The second is the height, metres, of each laser point, triangulated with these sheets, over the board as its corners
    alone place it. NaN where too little is left to tell.
    """
    count, lit = len(p.starts), p.data.laser_image
    sheets, off = np.full((p.data.images, count, 4), np.nan), np.full(len(lit), np.nan)
    shared = np.full((p.data.images, _layout(p).shared), np.nan)
    for k in np.unique(lit[laser]):
        state, found = _without(x, p, corner, laser, int(k))
        for s in range(count):
            own = laser & (p.data.laser_sheet == s)
            if len(np.unique(lit[own & (lit != k)])) < 2:
                continue
            sheets[k, s] = state.sheets[s]
            # also the points that the adjustment rejected: that they are far off is to be seen
            here = (p.data.laser_sheet == s) & (lit == k)
            if here.any():
                X = cast_rays(*rays(state.camera, p.data.laser_uv[here]), state.sheets[s])
                off[here] = _above(state, int(k), X)
        # a sheet that fewer than two other images have is nowhere without this one, and would speak for no scatter
        shared[k] = found
        lost = np.isnan(sheets[k]).any(1)
        shared[k, len(p.names) : len(p.names) + 3 * count][np.repeat(lost, 3)] = np.nan
    return sheets, off, shared


def _above(state: _State, image: int, X: Array) -> Array:
    """Distance (N,) of points (N, 3), camera frame, from the board of an image, along the axis of its frame."""
    pose = state.poses[image]
    on_board = Rotation.from_rotvec(pose[:3]).inv().apply(X - pose[3:])
    return on_board[:, 2] - heights(state.shape, on_board[:, :2])


def _widened(covariance: Array, left_out: Array) -> Array:
    """The covariance (K, K) scaled up to the jackknife's variances where these are larger.

    Errors that all points of an image share (a bent board, glare) do not show in the residuals, but in how much camera
    and sheets change when the light of an image is left out: left_out (n, K), NaN where that says nothing.
    """
    factor = np.ones(len(covariance))
    for k, values in enumerate(left_out.T):
        known = values[np.isfinite(values)]
        if len(known) >= _LEAST_LEFT_OUT and covariance[k, k] > 0:
            variance = (len(known) - 1) * float(known.var())
            factor[k] = np.sqrt(max(variance / covariance[k, k], 1.0))
    return covariance * np.outer(factor, factor)
