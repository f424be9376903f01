"""Metric motion of the camera between two overlapping images (paper III.E).

The laser decides how: where the soundings of both images lie on a plane, the motion comes from the homography,
which that plane makes metric; elsewhere from the essential matrix, made metric by the ratio of laser depths to
triangulated depths over all features near soundings. Image points are slopes (x/z, y/z) in the camera frame.
"""

from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..schemas.parameters import MatchParameters
from .epipolar import depths, distances, essential, homogeneous, sampson
from .motion_scale import laser_scale
from .navigation import RelativePrior
from .robust_minimum import HUBER, Minimum, minimise

Array = NDArray[Any]

_PIXEL_SIGMA = 0.5  # of a SIFT match, pixels at full resolution
_LASER_CONTRADICTS = 0.1  # spread of the depth ratios beyond which a motion is not the right one
_UNIT_LENGTH_SIGMA = 1e-3
_MAX_MATCHES = 300
_PLANE_POINTS = 500
_STEEPEST = 0.5  # cosine of a plane's normal and the optical axis
_SCALE_SHARE, _SCALE_SIGMAS = 0.02, 5.0  # by which the depths on a plane and those of the laser may differ


class Plane(NamedTuple):
    """normal . X = offset, with the share of points within tolerance and their rms distance, metres."""

    normal: Array
    offset: float
    share: float
    rms_m: float


class Motion(NamedTuple):
    """Pose of camera j in the frame of camera i.

    Attributes
    ----------
    R_i_j : (3, 3). t_i_j : (3,) camera j's centre in camera i's frame, metres if `metric`, else of unit length.
    covariance : (6, 6) of (rotation, translation), radians and metres, perturbing on the right: R exp(w), t + R v.
    inliers : (M,) indices of the matches that agree.
    model : homography or essential.
    metric : whether the laser gave the scale.
    scale_sigma : relative 1-sigma of the scale (nan when not metric).
    """

    R_i_j: Array
    t_i_j: Array
    covariance: Array
    inliers: NDArray[np.intp]
    model: Literal["homography", "essential"]
    metric: bool
    scale_sigma: float


def fit_plane(X: Array, tolerance_m: float, trials: int = 200) -> Plane | None:
    """Plane through points (N, 3) by RANSAC, refined on its inliers; the normal points away from the camera."""
    if len(X) < 10:
        return None
    X = X[:: max(1, len(X) // _PLANE_POINTS)]
    rng = np.random.default_rng(0)
    corners = X[rng.integers(0, len(X), (trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], corners[lengths > 1e-9, 0]
    sample = X[rng.permutation(len(X))[:500]]
    distance = np.abs(sample @ normals.T - np.einsum("ij,ij->i", normals, corners))
    best = int((distance < tolerance_m).sum(0).argmax()) if len(normals) else -1
    if best < 0:
        return None
    inlier = np.abs((X - corners[best]) @ normals[best]) < tolerance_m
    centre = X[inlier].mean(0)
    normal = np.linalg.svd(X[inlier] - centre, full_matrices=False)[2][2]
    normal = normal * np.sign(normal[2]) if normal[2] else normal
    residual = (X - centre) @ normal
    close = np.abs(residual) < tolerance_m
    return Plane(normal, float(normal @ centre), float(close.mean()), float(np.sqrt((residual[close] ** 2).mean())))


def common_plane(X_i: Array, X_j: Array, parameters: MatchParameters) -> Plane | None:
    """The plane of image i's soundings if those of both images are planar (paper III.E), else None.

    Soundings of one arm lie on a plane whatever the seabed: on the laser's sheet, which stands steep.
    """
    plane = _seabed_plane(X_i, parameters)
    return plane if plane is None or _seabed_plane(X_j, parameters) is not None else None


def _seabed_plane(X: Array, parameters: MatchParameters) -> Plane | None:
    plane = fit_plane(X, parameters.planarity_m)
    if plane is None or plane.share < parameters.planar_share or plane.normal[2] < _STEEPEST:
        return None
    return plane


def estimate(
    x_i: Array,
    x_j: Array,
    laser_i: Array,
    laser_j: Array,
    focal_px: float,
    parameters: MatchParameters,
    prior: RelativePrior | None = None,
    laser_sigma: float = 0.0,
) -> Motion | None:
    """Motion from matches (N, 2) in slopes and the soundings (L, 3) of both images in their camera frames.

    laser_sigma is the share of their range by which all soundings of an image may be wrong together, as they are
    where navigation carried them over from another image.

    Where images share a narrow strip only, rotation and translation can hardly be told apart: navigation's motion,
    if given as prior, then leads to the right solution, but does not count in its covariance. None when fewer than
    `min_inliers` matches agree.
    """
    if len(x_i) < parameters.min_inliers:
        return None
    plane = common_plane(laser_i, laser_j, parameters)
    start = None if plane is None else _from_homography(x_i, x_j, plane, focal_px, parameters)
    if start is not None and plane is not None:
        motion = _refine_on_plane(x_i, x_j, start, plane, focal_px, parameters, laser_sigma)
        share = 1.0 if motion is None else _depth_of_matches(motion, x_i, x_j, laser_i, laser_j)
        if share != 1.0:
            start = start._replace(t_i_j=share * start.t_i_j)
            plane = plane._replace(offset=share * plane.offset)
            motion = _refine_on_plane(x_i, x_j, start, plane, focal_px, parameters, laser_sigma)
        if motion is not None:
            return motion
    found = [
        _refine_epipolar(x_i, x_j, start, laser_i, laser_j, focal_px, parameters, prior, laser_sigma)
        for start in _starts(x_i, x_j, focal_px, parameters, prior)
    ]
    return max((motion for motion in found if motion is not None), key=_credit, default=None)


def _depth_of_matches(motion: Motion, x_i: Array, x_j: Array, laser_i: Array, laser_j: Array) -> float:
    """Depth of the matches by the laser beside them, over that of the plane: they may all lie on a box, say.

    1 where the laser does not contradict the plane.
    """
    x_i, x_j = x_i[motion.inliers], x_j[motion.inliers]
    depth_i, depth_j = depths(x_i, x_j, motion.R_i_j, motion.t_i_j)
    found = laser_scale([(x_i, depth_i, laser_i), (x_j, depth_j, laser_j)])
    if not np.isfinite(found.scale) or abs(np.log(found.scale)) < _SCALE_SHARE + _SCALE_SIGMAS * found.sigma:
        return 1.0
    return found.scale


def _credit(motion: Motion) -> tuple[bool, float]:
    """Motions that the laser speaks of first, the one it contradicts least; then the one with most matches."""
    return motion.metric, -motion.scale_sigma if motion.metric else len(motion.inliers)


class _Start(NamedTuple):
    R_i_j: Array
    t_i_j: Array
    inliers: NDArray[np.intp]


def _starts(
    x_i: Array, x_j: Array, focal_px: float, parameters: MatchParameters, prior: RelativePrior | None
) -> list[_Start]:
    """Where to begin: with the essential matrix if navigation agrees to it.

    Else it may have fallen for the plane that most points lie on, so the decompositions of their homography are
    tried as well; where navigation agrees to none of them, its own motion is the start.
    """
    essential = _from_essential(x_i, x_j, focal_px, parameters)
    if essential is not None and prior is not None and _compatible(essential, prior):
        return [essential]
    starts = [] if essential is None else [essential]
    starts += _from_unknown_plane(x_i, x_j, focal_px, parameters)
    if prior is None:
        return starts
    believable = [start for start in starts if _compatible(start, prior)]
    given = None if believable else _from_prior(x_i, x_j, prior, focal_px, parameters)
    return believable if given is None else [given]


def _from_unknown_plane(x_i: Array, x_j: Array, focal_px: float, parameters: MatchParameters) -> list[_Start]:
    """Decompositions of the homography whose plane lies in front of the camera."""
    H, mask = _homography(x_i, x_j, focal_px, parameters)
    if H is None or mask.sum() < parameters.min_inliers:
        return []
    inliers = np.flatnonzero(mask.ravel())
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    starts = []
    for R_j_i, t_j_i, normal in zip(rotations, translations, normals, strict=True):
        length = float(np.linalg.norm(t_j_i))
        if length > 1e-6 and (homogeneous(x_i[inliers]) @ normal.ravel() > 0).mean() > 0.5:
            starts.append(_Start(R_j_i.T, -R_j_i.T @ t_j_i.ravel() / length, inliers))
    return starts


def _homography(x_i: Array, x_j: Array, focal_px: float, parameters: MatchParameters):
    threshold = parameters.inlier_px / focal_px
    return cv2.findHomography(x_i, x_j, cv2.USAC_FAST, threshold, maxIters=2000, confidence=0.999)


def _from_homography(x_i: Array, x_j: Array, plane: Plane, focal_px: float, parameters: MatchParameters):
    """H = R + t n' / D by RANSAC and its decomposition (Faugeras & Lustman) nearest to the laser's plane."""
    H, mask = _homography(x_i, x_j, focal_px, parameters)
    if H is None or mask.sum() < parameters.min_inliers:
        return None
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    agreement = [abs(float(plane.normal @ n.ravel())) for n in normals]
    rotation_size = [np.linalg.norm(cv2.Rodrigues(R)[0]) for R in rotations]
    best = min(range(len(normals)), key=lambda k: (round(1 - agreement[k], 3), rotation_size[k]))
    sign = np.sign(float(plane.normal @ normals[best].ravel()))
    R_j_i, t_j_i = rotations[best], translations[best].ravel() * sign * plane.offset
    return _Start(R_j_i.T, -R_j_i.T @ t_j_i, np.flatnonzero(mask.ravel()))


def _from_essential(x_i: Array, x_j: Array, focal_px: float, parameters: MatchParameters):
    """Essential matrix by RANSAC and the decomposition that puts the points in front of both cameras."""
    E, mask = cv2.findEssentialMat(
        x_i, x_j, np.eye(3), cv2.USAC_FAST, prob=0.9999, threshold=parameters.inlier_px / focal_px, maxIters=3000
    )
    if E is None or E.shape != (3, 3) or mask.sum() < parameters.min_inliers:
        return None
    _, R_j_i, t_j_i, mask = cv2.recoverPose(E, x_i, x_j, np.eye(3), mask=mask)
    inliers = np.flatnonzero(mask.ravel())
    if len(inliers) < parameters.min_inliers:
        return None
    return _Start(R_j_i.T, -R_j_i.T @ t_j_i.ravel(), inliers)


def _compatible(start: _Start, prior: RelativePrior) -> bool:
    """Rotation and direction of the translation within three sigma of navigation's."""
    length = float(np.linalg.norm(prior.t_i_j))
    off = _log(prior.R_i_j.T @ start.R_i_j, prior.R_i_j.T @ (start.t_i_j * length - prior.t_i_j))
    return float(off @ np.linalg.solve(prior.covariance, off)) < 3**2 * 6


def _from_prior(x_i: Array, x_j: Array, prior: RelativePrior, focal_px: float, parameters: MatchParameters):
    """Navigation's own motion as the start, with the matches that lie as near its epipolar lines as it is sure."""
    length = max(float(np.linalg.norm(prior.t_i_j)), 1e-9)
    blur = float(np.sqrt(np.trace(prior.covariance[:3, :3]) + np.trace(prior.covariance[3:, 3:]) / length**2))
    distance = np.abs(sampson(x_i, x_j, prior.R_i_j, prior.t_i_j))
    inliers = np.flatnonzero(distance < parameters.inlier_px / focal_px + blur)
    if len(inliers) < parameters.min_inliers:
        return None
    return _Start(prior.R_i_j, prior.t_i_j / length, inliers)


def _log(R: Array, v: Array) -> Array:
    return np.concatenate([cv2.Rodrigues(R)[0].ravel(), v])


def _moved(start_R: Array, start_t: Array, step: Array) -> tuple[Array, Array]:
    return start_R @ cv2.Rodrigues(step[:3])[0], start_t + start_R @ step[3:]


def _thin(inliers: NDArray[np.intp]) -> NDArray[np.intp]:
    return inliers[:: max(1, len(inliers) // _MAX_MATCHES)]


def _refine_on_plane(
    x_i: Array,
    x_j: Array,
    start: _Start,
    plane: Plane,
    focal_px: float,
    parameters: MatchParameters,
    laser_sigma: float,
) -> Motion | None:
    """Least squares of the transfer over the laser's plane; relief about the plane counts as noise of the match."""
    relief_px = plane.rms_m / plane.offset**2 * np.linalg.norm(start.t_i_j) * focal_px
    sigma = float(np.hypot(_PIXEL_SIGMA, relief_px)) / focal_px

    def transfer(step: Array, chosen: NDArray[np.intp]) -> Array:
        R, t = _moved(start.R_i_j, start.t_i_j, step)
        ground = homogeneous(x_i[chosen])
        ground = ground * (plane.offset / (ground @ plane.normal))[:, None]
        X_j = (ground - t) @ R
        return ((X_j[:, :2] / X_j[:, 2:]) - x_j[chosen]) / sigma

    chosen = _thin(start.inliers)
    solution = least_squares(lambda step: transfer(step, chosen).ravel(), np.zeros(6), loss="huber", f_scale=HUBER)
    R, t = _moved(start.R_i_j, start.t_i_j, solution.x)
    distance = np.linalg.norm(transfer(solution.x, np.arange(len(x_i))), axis=1) * sigma * focal_px
    inliers = np.flatnonzero(distance < parameters.inlier_px)
    if len(inliers) < parameters.min_inliers:
        return None
    # The plane's own offset scales the translation: its error adds along it.
    scale_sigma = float(np.hypot(plane.rms_m / plane.offset / 3, laser_sigma))
    along = R.T @ t * scale_sigma
    covariance = _covariance(solution.jac, solution.fun)
    covariance[3:, 3:] += np.outer(along, along)
    return Motion(R, t, covariance, inliers, "homography", True, scale_sigma)


def _refine_epipolar(
    x_i: Array,
    x_j: Array,
    start: _Start,
    laser_i: Array,
    laser_j: Array,
    focal_px: float,
    parameters: MatchParameters,
    prior: RelativePrior | None,
    laser_sigma: float,
) -> Motion | None:
    """Least squares of the Sampson distance for direction and rotation, with the laser's scale."""
    R, t, inliers = start.R_i_j, start.t_i_j, start.inliers
    found = None
    for _ in range(2):  # again, with the inliers of the better motion
        found = _minimise_sampson(x_i[_thin(inliers)], x_j[_thin(inliers)], R, t, focal_px, prior)
        R, t = _moved(R, t, found.step)
        inliers = np.flatnonzero(np.abs(sampson(x_i, x_j, R, t)) * focal_px < parameters.inlier_px)
        if len(inliers) < parameters.min_inliers:
            return None
    assert found is not None
    depth_i, depth_j = depths(x_i[inliers], x_j[inliers], R, t)
    inliers, depth_i, depth_j = (a[(depth_i > 0) & (depth_j > 0)] for a in (inliers, depth_i, depth_j))
    if len(inliers) < parameters.min_inliers:
        return None
    scale, scale_sigma, spread = laser_scale([(x_i[inliers], depth_i, laser_i), (x_j[inliers], depth_j, laser_j)])
    metric = bool(np.isfinite(scale))
    if metric and spread > _LASER_CONTRADICTS:
        return None
    scale_sigma = float(np.hypot(scale_sigma, laser_sigma))
    covariance = _epipolar_covariance(found, scale_sigma if metric else _UNIT_LENGTH_SIGMA, prior is not None)
    if metric:
        t = t * scale
        covariance[3:] *= scale
        covariance[:, 3:] *= scale
    return Motion(R, t, covariance, inliers, "essential", metric, scale_sigma)


def _minimise_sampson(
    x_i: Array, x_j: Array, R: Array, t: Array, focal_px: float, prior: RelativePrior | None
) -> Minimum:
    """The step (6,) from (R, t); the last rows of the residuals are the length of t and, if given, the prior."""
    sigma = _PIXEL_SIGMA / focal_px
    length = 1.0 if prior is None else float(np.linalg.norm(prior.t_i_j))
    whiten = None if prior is None else np.linalg.cholesky(np.linalg.inv(prior.covariance)).T
    p_i, p_j = homogeneous(x_i), homogeneous(x_j)

    def at(steps: Array) -> Array:
        """Residuals (K, rows) after each of K steps."""
        moved = [_moved(R, t, step) for step in steps]
        rows = distances(p_i, p_j, np.stack([essential(*one) for one in moved])) / sigma
        other = [others(*one) for one in moved]
        return np.column_stack([rows, np.array(other)])

    def others(R_step: Array, t_step: Array) -> Array:
        stretched = np.log(np.linalg.norm(t_step)) / _UNIT_LENGTH_SIGMA
        if prior is None or whiten is None:
            return np.array([stretched])
        off = _log(prior.R_i_j.T @ R_step, prior.R_i_j.T @ (t_step * length - prior.t_i_j))
        return np.append(stretched, whiten @ off)

    return minimise(at)


def _epipolar_covariance(found: Minimum, scale_sigma: float, with_prior: bool) -> Array:
    """Covariance for a translation of unit length: the rows of the prior left out, that of the length exchanged.

    Matches beyond Huber's threshold say nothing of it.
    """
    rows = len(found.residual) - (6 if with_prior else 0)
    residual = found.residual[:rows]
    jacobian = found.jacobian[:rows] * (np.abs(residual) < HUBER)[:, None]
    jacobian[-1] *= _UNIT_LENGTH_SIGMA / scale_sigma
    return _covariance(jacobian, residual)


def _covariance(jacobian: Array, residual: Array) -> Array:
    """(6, 6), never better than the residuals say: scaled up by their variance when above 1.

    A direction that the matches leave open gets a sigma of 1 (radian, or length of the translation).
    """
    degrees = max(1, len(residual) - 6)
    variance = max(1.0, float((np.clip(residual, -3, 3) ** 2).sum() / degrees))
    return np.linalg.inv(jacobian.T @ jacobian + np.eye(6)) * variance
