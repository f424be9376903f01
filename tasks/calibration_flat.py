"""Calibration over a flat surface: both sheets and the boresight, from lines of light and navigation.

All light of an image lies on one plane, the floor; navigation says how far and how tilted the floor is. Vehicle
and local frames are those of FORMATS ("Frames of reference").
"""

from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Calibration
from .calibration_lines import Lines, averaged
from .calibration_sheets import SheetBasis, basis, cast_rays, moved
from .calibration_solve import Layout, Solved, solve, unit_sigma
from .camera import rays
from .rotations import R_level_vehicle, R_vehicle_camera

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

ROUNDS: Final = 4
_WHITE_SHARE: Final = 0.3  # of a stated sigma that changes from image to image, to begin with
_OUTLIER_SIGMAS: Final = 4.0
# sheets (2 x 3), boresight roll and pitch, constant error of the altimeter
_SHEETS, _BORESIGHT, _ALTIMETER = slice(0, 6), slice(6, 8), 8
_COMMON: Final = 9
# of each mission: elevation of the floor, its slopes to east and north, constant errors of roll and pitch
_PER_MISSION: Final = 5
_PER_IMAGE: Final = 3  # errors of depth, roll, pitch


class Priors(NamedTuple):
    """1-sigma of what is believed before the data are looked at.

    Attributes
    ----------
    sheet_deg, sheet_m : turn and shift of each sheet of the starting calibration.
    boresight_deg : mount roll and pitch, of the starting calibration.
    altimeter_m : constant error of the altimeter. floor_slope_deg : of a floor that is taken as level.
    """

    sheet_deg: float = 2.0
    sheet_m: float = 0.04
    boresight_deg: float = 1.0
    altimeter_m: float = 0.001
    floor_slope_deg: float = 0.5


class FlatData(NamedTuple):
    """Laser points over a floor and the navigation of their images.

    Attributes
    ----------
    uv : (P, 2) pixels. image : (P,) index of the image. arm : (P,) index of the sheet. sigma_px : (P,).
    R_local_vehicle : (n, 3, 3). X_local : (n, 3) navigation reference points, metres.
    altitude_m : (n,) of the reference point above the floor, NaN where missing.
    mission : (n,) number of the mission of each image, from 0.
    sigma_depth_m, sigma_tilt_rad : (n,) stated by the navigation.
    """

    uv: Array
    image: Indices
    arm: NDArray[np.int8]
    sigma_px: Array
    R_local_vehicle: Array
    X_local: Array
    altitude_m: Array
    mission: Indices
    sigma_depth_m: Array
    sigma_tilt_rad: Array

    def take(self, keep: NDArray) -> "FlatData":
        """The points that a mask (P,) selects; all images stay."""
        return self._replace(uv=self.uv[keep], image=self.image[keep], arm=self.arm[keep], sigma_px=self.sigma_px[keep])


class FlatResult(NamedTuple):
    """What the floor says.

    Attributes
    ----------
    sheets : (2, 4) normals and offsets. boresight_deg : (2,) mount roll and pitch.
    covariance : (8, 8) of both sheets' steps (radians, radians, metres) and the boresight (radians).
    starts : the sheets from which steps are measured. steps : (6,).
    prior_sigma : (8,) in the units of the covariance.
    residual_m : (P,) height of the points above the floor. used : (P,) which were not outliers.
    image_m : (n, 2) mean height of the points of an image by sheet, NaN without points.
    altimeter_m : constant error found, and its sigma. slopes_deg : (missions, 2) of the floor, to east and north.
    noise : measured 1-sigma: line of light (in stated sigmas), depth (m), tilt (degrees), altimeter (m).
    """

    sheets: Array
    boresight_deg: Array
    covariance: Array
    starts: tuple[SheetBasis, SheetBasis]
    steps: Array
    prior_sigma: Array
    residual_m: Array
    used: NDArray[np.bool_]
    image_m: Array
    altimeter_m: tuple[float, float]
    slopes_deg: Array
    noise: dict[str, float]


class _Problem(NamedTuple):
    """Everything that the residuals need; `noise` are sigmas of line, depth, roll and pitch, altimeter."""

    data: FlatData
    origin: Array
    direction: Array
    per_sigma: Array
    calibration: Calibration
    starts: tuple[SheetBasis, SheetBasis]
    priors: Priors
    noise: Array
    missions: int
    boresight: bool


def gather(lines: list[Lines]) -> tuple[Array, Indices, NDArray[np.int8], Array]:
    """uv, image, arm and sigma_px of the lines of n images, neighbouring rows averaged."""
    parts = [averaged(one.uv, one.arm.astype(np.intp), one.sigma_px) for one in lines]
    uv, arm, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    return uv, np.repeat(np.arange(len(parts)), [len(own) for own, _, _ in parts]), arm.astype(np.int8), sigma


def calibrate_flat(data: FlatData, start: Calibration, priors: Priors, boresight: bool = True) -> FlatResult:
    """Sheets and boresight from lines of light on a flat floor.

    Sigmas of line, depth, tilt and altimeter are estimated with them, and outliers are left out, in turns.

    Parameters
    ----------
    data : points and navigation.
    start : a calibration that may be wrong by a few degrees and centimetres; its camera is taken as right.
    boresight : whether to solve for the mount's roll and pitch too.
    """
    assert start.laser is not None
    first, second = (basis(sheet, start.laser.origin) for sheet in start.laser.sheets)
    noise = np.array([1.0, 1.0, 1.0, 0.02])
    origin, direction = rays(start.camera, data.uv)
    problem = _Problem(
        data,
        origin,
        direction,
        np.ones(len(data.uv)),
        start,
        (first, second),
        priors,
        noise,
        int(data.mission.max()) + 1,
        boresight,
    )
    x = np.zeros(_layout(problem).scale.size)
    x[_COMMON : _COMMON + _PER_MISSION * problem.missions : _PER_MISSION] = _floors(data)
    used = np.ones(len(data.uv), bool)
    chosen, solved = problem, None
    for _ in range(ROUNDS):
        problem = problem._replace(noise=noise)
        problem = problem._replace(per_sigma=_sigma_m(problem, x))
        chosen = _chosen(problem, used)
        solved = solve(lambda x, p=chosen: _residuals(x, p), x, _layout(chosen), _rows(chosen))
        x, noise = solved.x, _noise(chosen, solved)
        off = np.abs(_heights(x, problem)) / problem.per_sigma
        used = off < _OUTLIER_SIGMAS * max(1.4826 * float(np.median(off)), 1e-9)
    assert solved is not None
    return _result(problem, solved, used, noise)


def _floors(data: FlatData) -> Array:
    """Elevation of each mission's floor by the altimeter, or 2.5 m below the vehicle."""
    count = int(data.mission.max()) + 1
    below = np.where(np.isfinite(data.altitude_m), data.altitude_m, np.nan)
    return np.array(
        [
            float(np.nanmedian((data.X_local[:, 2] - below)[own]))
            if np.isfinite(below[own]).any()
            else float(np.median(data.X_local[own, 2])) - 2.5
            for own in (data.mission == m for m in range(count))
        ]
    )


def _chosen(p: _Problem, used: NDArray[np.bool_]) -> _Problem:
    return p._replace(
        data=p.data.take(used), origin=p.origin[used], direction=p.direction[used], per_sigma=p.per_sigma[used]
    )


def _prior_sigma(p: _Problem) -> Array:
    """Of the sheets' steps, the boresight and the altimeter (9,)."""
    turn, boresight = np.radians(p.priors.sheet_deg), np.radians(p.priors.boresight_deg if p.boresight else 1e-4)
    return np.array([turn, turn, p.priors.sheet_m] * 2 + [boresight] * 2 + [p.priors.altimeter_m])


def _layout(p: _Problem) -> Layout:
    tilt = float(np.median(p.data.sigma_tilt_rad))
    slope = np.radians(p.priors.floor_slope_deg)
    mission = np.array([0.1, slope, slope, tilt, tilt])
    image = np.array([float(np.median(p.data.sigma_depth_m)), tilt, tilt])
    count = len(p.data.X_local)
    scale = np.concatenate([_prior_sigma(p), np.tile(mission, p.missions), np.tile(image, count)])
    return Layout(_COMMON + _PER_MISSION * p.missions, count, _PER_IMAGE, scale)


def _rows(p: _Problem) -> Indices:
    """Images of the residuals, in the order of `_residuals`."""
    count = len(p.data.X_local)
    measured = np.flatnonzero(np.isfinite(p.data.altitude_m))
    first = [p.data.image, measured, *[np.arange(count)] * _PER_IMAGE, np.full(_COMMON + 4 * p.missions, -1)]
    own = np.concatenate(first)
    return np.column_stack([own, np.full(len(own), -1)])


def _posed(x: Array, p: _Problem) -> tuple[Array, Array, Array]:
    """R_local_camera (n, 3, 3), C_local (n, 3) and elevations of the reference points (n,)."""
    shared, images = _layout(p).split(x)
    missions = shared[_COMMON:].reshape(p.missions, _PER_MISSION)
    tilt = np.degrees(missions[p.data.mission, 3:5] + images[:, 1:3])
    R_local_vehicle = p.data.R_local_vehicle @ R_level_vehicle(tilt[:, 0], tilt[:, 1], np.zeros(len(tilt)))
    mount = np.array(p.calibration.mount.rotation)
    mount[:2] += np.degrees(shared[_BORESIGHT])
    reference = p.data.X_local + images[:, :1] * np.array([0.0, 0.0, 1.0])
    C = reference + R_local_vehicle @ np.asarray(p.calibration.mount.translation)
    return R_local_vehicle @ R_vehicle_camera(*mount), C, reference


def _sheets(x: Array, p: _Problem) -> Array:
    """(2, 4)"""
    return np.stack([moved(p.starts[s], x[3 * s : 3 * s + 3]) for s in (0, 1)])


def _above_floor(x: Array, p: _Problem, X_local: Array, mission: Indices) -> Array:
    """Distance (N,) of points (N, 3) from the floor of their mission, along its normal, positive up."""
    floor = x[_COMMON : _COMMON + _PER_MISSION * p.missions].reshape(p.missions, _PER_MISSION)[mission]
    height = X_local[:, 2] - floor[:, 0] - (X_local[:, :2] * floor[:, 1:3]).sum(1)
    return height / np.sqrt(1 + (floor[:, 1:3] ** 2).sum(1))


def _heights(x: Array, p: _Problem) -> Array:
    """Of the laser points above the floor (P,), metres."""
    R, C, _ = _posed(x, p)
    X = cast_rays(p.origin, p.direction, _sheets(x, p)[p.data.arm])
    image = p.data.image
    X_local = np.einsum("pij,pj->pi", R[image], X) + C[image]
    return _above_floor(x, p, X_local, p.data.mission[image])


def _sigma_m(p: _Problem, x: Array) -> Array:
    """1-sigma (P,) of the laser points' heights from that of their columns, metres."""
    half = np.array([0.5, 0.0])
    sides = []
    for sign in (1, -1):
        origin, direction = rays(p.calibration.camera, p.data.uv + sign * half)
        sides.append(_heights(x, p._replace(origin=origin, direction=direction)))
    return np.maximum(np.abs(sides[0] - sides[1]) * p.data.sigma_px, 1e-6)


def _residuals(x: Array, p: _Problem) -> Array:
    shared, images = _layout(p).split(x)
    _, _, reference = _posed(x, p)
    line, depth, tilt, altimeter = p.noise
    altitude = _above_floor(x, p, reference, p.data.mission)
    # the altimeter measures straight down
    missing = altitude + shared[_ALTIMETER] - p.data.altitude_m
    prior = _prior_sigma(p)
    missions = shared[_COMMON:].reshape(p.missions, _PER_MISSION)
    first = np.array([np.flatnonzero(p.data.mission == m)[0] for m in range(p.missions)])
    slope = np.radians(p.priors.floor_slope_deg)
    return np.concatenate(
        [
            _heights(x, p) / (p.per_sigma * line),
            missing[np.isfinite(missing)] / altimeter,
            images[:, 0] / (_WHITE_SHARE * depth * p.data.sigma_depth_m),
            images[:, 1] / (_WHITE_SHARE * tilt * p.data.sigma_tilt_rad),
            images[:, 2] / (_WHITE_SHARE * tilt * p.data.sigma_tilt_rad),
            shared[:_COMMON] / prior,
            (missions[:, 1:3] / slope).ravel(),
            (missions[:, 3:5] / p.data.sigma_tilt_rad[first, None]).ravel(),
        ]
    )


def _noise(p: _Problem, solved: Solved) -> Array:
    """Sigmas for the next round: what the residuals say, within bounds that no instrument leaves."""
    line, depth, tilt, altimeter = p.noise
    count, points = len(p.data.X_local), len(p.data.uv)
    measured = int(np.isfinite(p.data.altitude_m).sum())
    number = np.arange(len(solved.residual))
    starts = np.cumsum([0, points, measured, count, 2 * count])
    groups = [(number >= a) & (number < b) for a, b in pairwise(starts)]
    scale = [unit_sigma(solved, group) for group in groups]
    return np.array(
        [
            np.clip(line * scale[0], 0.2, 20),
            np.clip(depth * scale[2], 0.02, 10),
            np.clip(tilt * scale[3], 0.02, 10),
            np.clip(altimeter * scale[1], 0.001, 0.3),
        ]
    )


def _result(p: _Problem, solved: Solved, used: NDArray[np.bool_], noise: Array) -> FlatResult:
    shared = solved.x[: _COMMON + _PER_MISSION * p.missions]
    missions = shared[_COMMON:].reshape(p.missions, _PER_MISSION)
    heights = _heights(solved.x, p)
    image_m = np.full((len(p.data.X_local), 2), np.nan)
    for k, arm in np.unique(np.column_stack([p.data.image, p.data.arm]), axis=0):
        own = (p.data.image == k) & (p.data.arm == arm) & used
        image_m[k, arm] = heights[own].mean() if own.any() else np.nan
    line, depth, tilt, altimeter = noise
    return FlatResult(
        sheets=_sheets(solved.x, p),
        boresight_deg=np.array(p.calibration.mount.rotation[:2]) + np.degrees(shared[_BORESIGHT]),
        covariance=solved.covariance[:8, :8],
        starts=p.starts,
        steps=shared[_SHEETS],
        prior_sigma=_prior_sigma(p)[:8],
        residual_m=heights,
        used=used,
        image_m=image_m,
        altimeter_m=(float(shared[_ALTIMETER]), float(np.sqrt(solved.covariance[_ALTIMETER, _ALTIMETER]))),
        slopes_deg=np.degrees(missions[:, 1:3]),
        noise={
            "line": float(line),
            "depth_m": float(depth * _WHITE_SHARE * np.median(p.data.sigma_depth_m)),
            "tilt_deg": float(np.degrees(tilt * _WHITE_SHARE * np.median(p.data.sigma_tilt_rad))),
            "altimeter_m": float(altimeter),
        },
    )
