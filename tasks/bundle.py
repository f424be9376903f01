"""Bundle adjustment: tie points, laser ranges and navigation in one estimate of all poses, solved by GTSAM.

The paper names it as its future (VI). Tie points hold the images to each other, the laser gives the scale wherever it
passes near a tie point, navigation holds the map to the ground. The noise of the sights and the roughness of the
terrain between soundings are measured on what the rounds before leave of them.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from ..schemas.parameters import AdjustParameters
from . import crossovers, laser_ranges, tracks
from . import residuals as remaining
from .adjust import Adjusted, sigmas
from .camera import focal_px, normalised
from .crossovers import Crossovers, Lines
from .factors import DOUBTFUL, datum, first_values, navigation_factors
from .laser_ranges import Ranges
from .navigation import NavigationPrior, Poses, with_half_turns
from .reduction import Observations, State, covariances, observations, solve
from .tracks import Sights

Array = NDArray[Any]

_FIRST_SIGMA_PX, _SIGMA_PX = 0.7, (0.1, 2.0)
_LEAST_FREEDOM = 0.2  # share of the tie points' that poses leave
_LEAST_PARALLAX = 0.015  # radians
# before each round, what is farther off is a wrong match: pixels, but not less than sigmas
_GATES_PX, _GATE_SIGMAS = (100.0, 10.0, 1.0, 0.5), 5.0
_TOLERANCES = 1e-2, 1e-2, 1e-3, 3e-4  # of each round: what the next one changes anyhow need not be found to the end
_FIRST_ROUNDS = 2  # these have a few tie points of an image only: the longest track of each cell twice as wide
_LEAST_SIGHTS = 4  # of an image that tie points hold: three leave several poses
_COVARIANCE_SIGMA_PX = 1.0  # of sights, for the covariances: what calibration leaves is shared by many
_RANGE_GATE = 6.0  # sigmas
# Ranges beside each other are carried along one slope and err alike, all of them where the image is in a wrong place.
# Sights hold an image against that; the ranges of one that has none, as laser images have, together count as what they
# tell: height, roll and pitch. So many of them hold it.
_TOLD, _HOLDING = 3, 36
_SLOPE_SIGMA = 0.03
_SHIFT_ROUNDS = 20


class Block(NamedTuple):
    """What is adjusted together.

    Attributes
    ----------
    sights : of tie points, wrong matches left out. x : (M, 2) their slopes.
    X : (N, 3) tie points, local. focal_px : pixels a slope.
    ranges : of the laser. roughness : see `laser_ranges`. crossed : laser lines of different images.
    """

    sights: Sights
    x: Array
    X: Array
    focal_px: float
    ranges: Ranges
    roughness: float
    crossed: Crossovers


class Bundle(NamedTuple):
    """The adjusted block.

    Attributes
    ----------
    poses : cameras, local. block : tie points and what was measured of them.
    residual_px : (M, 2) of the sights. sigma_px : their noise.
    """

    poses: Poses
    block: Block
    residual_px: Array
    sigma_px: float


def adjust(
    camera: Camera,
    chained: Adjusted,
    sights: Sights,
    soundings: Mapping[int, Array],
    lines: Lines,
    navigation: NavigationPrior | None,
    p: AdjustParameters,
) -> Adjusted:
    """The poses of `tasks.adjust.adjust` made better by tie points and the laser, with their sigmas.

    sights : tie points of the links that `chained` used. soundings : (L, 3) of images with a laser, camera frame.
    lines : the same soundings as lines that cross each other.
    """
    if navigation is not None:
        navigation = with_half_turns(navigation, chained.turned)
    try:
        found = refine(camera, chained.poses, sights, soundings, lines, navigation, p)
    except RuntimeError:  # GTSAM: a system too near to singular, which counting alone cannot foresee
        found = None
    if found is None:
        return chained
    sigma = chained.sigma_m, chained.covariance_xy_m2, chained.sigma_tilt_rad
    with suppress(RuntimeError):  # too near to singular for covariances: those of the pair motions are larger
        own = sigmas(_covariances(found, navigation, p), found.poses, navigation)
        sigma = tuple(np.where(np.isnan(one), other, one) for one, other in zip(own, sigma, strict=True))
    sigma_m, covariance_xy, sigma_tilt = sigma
    # a tie point that ended behind a camera is a wrong match that nothing is left of
    ahead = np.isfinite(found.residual_px).all(1)
    sights, left_px = Sights(*(column[ahead] for column in found.block.sights)), found.residual_px[ahead]
    rms_px = float(np.sqrt((left_px**2).sum(1).mean())) if len(left_px) else None
    count = len(chained.status)
    held = _by_laser(found, lines, count)
    return chained._replace(
        poses=_with_loose(found.poses, chained.poses),
        sigma_m=sigma_m,
        covariance_xy_m2=covariance_xy,
        sigma_tilt_rad=sigma_tilt,
        reprojection_px=rms_px,
        residuals=remaining.of(count, sights, left_px, crossovers.apart(found.poses, found.block.crossed)),
        status=["adjusted" if ok else status for status, ok in zip(chained.status, held, strict=True)],
    )


def _with_loose(found: Poses, chained: Poses) -> Poses:
    """Images that were left out lie to the nearest one in time that was not as they did in the chain."""
    R, C = found.R_local_camera.copy(), found.C_local.copy()
    held = np.flatnonzero(found.known)
    for k in np.flatnonzero(chained.known & ~found.known).tolist():
        near = held[np.abs(held - k).argmin()]
        turn = R[near] @ chained.R_local_camera[near].T
        R[k] = turn @ chained.R_local_camera[k]
        C[k] = C[near] + turn @ (chained.C_local[k] - chained.C_local[near])
    return Poses(R, C)


def _by_laser(found: Bundle, lines: Lines, count: int) -> NDArray[np.bool_]:
    """Which of `count` images the laser holds to others where no feature can.

    None where images with a laser have tie points: one among them that has none is in doubt, and lines cross in a
    wrong place, too.
    """
    block = found.block
    if np.isin(lines.image, block.sights.image).any():
        return np.zeros(count, bool)
    ranged = np.bincount(block.ranges.image, minlength=count) >= _HOLDING
    every = crossovers.find(found.poses, lines)
    kept = crossovers.believable(every, crossovers.LEAST_OF_IMAGE * len(np.unique(lines.image)))
    return ranged | crossovers.holds(every, kept, count)


def refine(
    camera: Camera,
    start: Poses,
    sights: Sights,
    soundings: Mapping[int, Array],
    lines: Lines,
    navigation: NavigationPrior | None,
    p: AdjustParameters,
) -> Bundle | None:
    """The poses that have a start, adjusted together.

    None where images share no tie point and no laser line crosses, or, without navigation, where the laser leaves the
    scale open. Without navigation images that tie points do not hold to the rest are left out, and have no pose.

    soundings : (L, 3) of each image with a laser, camera frame. lines : the same as lines.
    """
    lit = {k: own for k, own in soundings.items() if start.known[k] and len(own)}
    depth = float(np.median([np.median(own[:, 2]) for own in lit.values()])) if lit else 3.0
    sights = sights.take(start.known[sights.image])
    fixed = _fixed(start, navigation)
    bundle, poses, unknowns, values = None, start, 0, first_values(fixed, start)
    sigma_px, rough = _FIRST_SIGMA_PX, laser_ranges.FIRST_ROUGHNESS
    anew = {}
    if navigation is not None:  # without, each image must be held from the start
        anew[_FIRST_ROUNDS] = sights
        sights = tracks.thin(sights, (camera.height, camera.width), -(-p.tie_cells // 2), 1)
    for number, (gate_px, tolerance) in enumerate(zip(_GATES_PX, _TOLERANCES, strict=True)):
        gate_px = max(gate_px, _GATE_SIGMAS * sigma_px)
        sights = anew.get(number, sights)
        sights, x, X, pixels = _inliers(camera, poses, sights, depth, gate_px)
        crossed = crossovers.believable(crossovers.find(poses, lines), unknowns)
        if not len(X) and not len(crossed.i):
            return None
        ranges = _believable(poses, X, laser_ranges.measure(poses, X, lit, p.max_ranges), rough)
        if navigation is None:
            held = determined(poses.known, sights, ranges)
            if not held.any():
                return None
            if (poses.known & ~held).any():
                again = _only(start, held), sights.take(held[sights.image]), soundings, lines
                return refine(camera, *again, navigation, p)
        block = Block(sights, x, X, pixels, ranges, rough, crossed)
        o, afloat = _observations(block, poses, sigma_px, p), navigation is not None
        crossing = _with_crossovers(fixed, block, State(values, poses, X), p)
        values, poses, X = solve(crossing, State(values, poses, X), o, tolerance, afloat)
        residual_px = residuals(poses, sights, x, X) * pixels
        sigma_px, rough = _noise_px(residual_px, sights), laser_ranges.roughness(poses, X, ranges)
        unknowns = crossovers.LEAST_OF_IMAGE * len(np.union1d(crossed.i, crossed.j))
        bundle = Bundle(poses, block._replace(X=X, roughness=rough), residual_px, sigma_px)
    return bundle if bundle is None or navigation is None else _where_navigation_is(bundle, navigation)


def _where_navigation_is(bundle: Bundle, navigation: NavigationPrior) -> Bundle:
    """The whole of it moved to where navigation has it, in which nothing else has a say.

    `reduction.solve` leaves the map as a whole where it began. Images count by what navigation knows of them, and
    those of which it is wrong little.
    """
    poses = bundle.poses
    both = poses.known & navigation.poses.known
    off = (navigation.poses.C_local - poses.C_local)[both]
    sigma = np.column_stack([navigation.sigma_horizontal, navigation.sigma_horizontal, navigation.sigma_depth])[both]
    shift = np.median(off, axis=0)
    for _ in range(_SHIFT_ROUNDS):
        weight = np.minimum(1, DOUBTFUL * sigma / np.maximum(np.abs(off - shift), 1e-12)) / sigma**2
        shift = (weight * off).sum(0) / weight.sum(0)
    moved = poses._replace(C_local=poses.C_local + shift)
    return bundle._replace(poses=moved, block=bundle.block._replace(X=bundle.block.X + shift))


def determined(known: NDArray[np.bool_], sights: Sights, ranges: Ranges) -> NDArray[np.bool_]:
    """Which images of those with a pose (n,) tie points join: of several blocks the largest whose scale ranges tell."""
    count = len(known)
    seen = np.bincount(sights.image, minlength=count)
    block = remaining.blocks(count + sights.tie_points, np.column_stack([sights.image, count + sights.track]))[:count]
    held = known & (seen >= _LEAST_SIGHTS)
    ranged = np.isin(block, block[ranges.image[np.isin(ranges.image, sights.image)]])
    sizes = np.bincount(block[held & ranged], minlength=count + 1)
    return held & ranged & (block == sizes.argmax())


def _only(poses: Poses, held: NDArray[np.bool_]) -> Poses:
    """The poses of some images (n,) only."""
    where = held[:, None]
    return Poses(np.where(where[..., None], poses.R_local_camera, np.nan), np.where(where, poses.C_local, np.nan))


def _fixed(poses: Poses, navigation: NavigationPrior | None) -> Any:
    """What holds the poses besides tie points and crossovers, as a GTSAM graph."""
    return navigation_factors(navigation) if navigation else datum(poses, int(np.flatnonzero(poses.known)[0]))


def _with_crossovers(fixed: Any, block: Block, at: State, p: AdjustParameters) -> Any:
    graph = gtsam.NonlinearFactorGraph(fixed)
    crossovers.add(graph, at.values, at.poses, block.crossed, 2 * p.robust_threshold)
    return graph


def _observations(block: Block, poses: Poses, sigma_px: float, p: AdjustParameters) -> Observations:
    """Cauchy's kernel at twice the threshold of pair motions: a wrong match must not pull, however many it has."""
    sigma_m = laser_ranges.sigma(block.ranges.away_m, block.roughness)
    blind = ~np.isin(block.ranges.image, block.sights.image)
    alike = np.bincount(block.ranges.image)[block.ranges.image] / _TOLD
    sigma_m = np.where(blind, np.sqrt(np.maximum(alike, 1)) * sigma_m, sigma_m)
    ranges, normal = _along_normals(poses, block.X, block.ranges, blind)
    sigma = sigma_px / block.focal_px
    return observations(block.sights, block.x, sigma, ranges, sigma_m, normal, 2 * p.robust_threshold)


def _along_normals(poses: Poses, X: Array, ranges: Ranges, blind: NDArray[np.bool_]) -> tuple[Ranges, Array]:
    """Ranges of images that see no tie point as distances along normals (K, 3), camera frames, 0 for the others.

    Their laser lies on the surface that the tie points of others make. A range would hold such a camera by the
    direction in which it looks; a surface holds it along its normal alone, which is all that a laser without features
    knows.
    """
    R = poses.R_local_camera[ranges.image]
    away = X[ranges.track] - poses.C_local[ranges.image]
    height = away[:, 2] * ranges.range_m / np.linalg.norm(away, axis=1)
    lit = np.column_stack([away[:, :2], height])
    normal = crossovers.normals(ranges.slope, np.full(len(away), _SLOPE_SIGMA))
    distance = np.where(blind, (lit * normal).sum(1), ranges.range_m)
    return ranges._replace(range_m=distance), np.einsum("kji,kj->ki", R, normal) * blind[:, None]


def _covariances(found: Bundle, navigation: NavigationPrior | None, p: AdjustParameters) -> Array:
    """Covariances (n, 6, 6) of the poses."""
    fixed = _fixed(found.poses, navigation)
    state = State(first_values(fixed, found.poses), found.poses, found.block.X)
    o = _observations(found.block, found.poses, _COVARIANCE_SIGMA_PX, p)
    return covariances(_with_crossovers(fixed, found.block, state, p), state, o)


def _inliers(camera: Camera, poses: Poses, sights: Sights, depth: float, gate_px: float):
    """Sights that agree, their slopes x (M, 2), the tie points X (N, 3), and the focal length in pixels."""
    pixels = focal_px(camera, depth)
    x = normalised(camera, sights.uv, depth)
    X, parallax = intersect(poses, sights, x)
    if camera.port is not None:  # its slopes hold at one depth only
        Z = in_cameras(poses, sights, X)[:, 2]
        x = normalised(camera, sights.uv, np.where(Z > 0, Z, depth))
        X, parallax = intersect(poses, sights, x)
    off = np.linalg.norm(residuals(poses, sights, x, X), axis=1) * pixels
    good = (off < gate_px) & (parallax > _LEAST_PARALLAX)[sights.track]
    kept = sights.kept(good)
    sights, x = sights.take(good), x[kept]
    return sights, x, intersect(poses, sights, x)[0], pixels


def in_cameras(poses: Poses, sights: Sights, X: Array) -> Array:
    """The tie points (M, 3) in the frames of the cameras that see them."""
    off = X[sights.track] - poses.C_local[sights.image]
    return np.einsum("mji,mj->mi", poses.R_local_camera[sights.image], off)


def residuals(poses: Poses, sights: Sights, x: Array, X: Array) -> Array:
    """Where tie points X (N, 3) should be seen less where they are (M, 2), slopes; inf behind the camera."""
    seen = in_cameras(poses, sights, X)
    front = seen[:, 2:] > 0
    return np.where(front, seen[:, :2] / np.where(front, seen[:, 2:], 1.0) - x, np.inf)


def intersect(poses: Poses, sights: Sights, x: Array) -> tuple[Array, Array]:
    """Points (N, 3) nearest to the rays of each tie point, and the angle (N,) by which these rays differ, radians."""
    count = sights.tie_points
    ray = np.einsum("mij,mj->mi", poses.R_local_camera[sights.image], np.column_stack([x, np.ones(len(x))]))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    along = np.einsum("mij,mj->mi", across, poses.C_local[sights.image])
    starts = np.searchsorted(sights.track, np.arange(count))
    A, b = (np.add.reduceat(values, starts) if count else values[:0] for values in (across, along))
    size = np.bincount(sights.track, minlength=count)
    weakest = np.linalg.eigvalsh(A)[:, 0] if count else np.zeros(0)
    X = np.linalg.solve(A + 1e-12 * np.eye(3), b[..., None])[..., 0] if count else np.zeros((0, 3))
    return X, 2 * np.sqrt(np.maximum(weakest, 0) / np.maximum(size, 1))


def _believable(poses: Poses, X: Array, ranges: Ranges, rough: float) -> Ranges:
    """Ranges without those that only a step in the terrain can explain."""
    left = np.linalg.norm(X[ranges.track] - poses.C_local[ranges.image], axis=1) - ranges.range_m
    level = np.median(left) if len(left) else 0.0  # what all have in common is the scale that they are to tell
    keep = np.abs(left - level) < _RANGE_GATE * laser_ranges.sigma(ranges.away_m, rough)
    return ranges.take(keep)


def _noise_px(residual_px: Array, sights: Sights) -> float:
    """1-sigma of a sight along either axis, from the residuals (M, 2) that the adjustment left.

    Of the four coordinates of a tie point that two images see its own place takes three: only what is left across
    the epipolar line tells. So each tie point's squares are held against the median of chi squared of its freedom
    (Wilson & Hilferty 1931); what the images' poses took besides is common to all.
    """
    if not residual_px.size:
        return _FIRST_SIGMA_PX
    squares, views = np.bincount(sights.track, (residual_px**2).sum(1)), np.bincount(sights.track)
    freedom = 2 * views - 3
    usual = freedom * (1 - 2 / (9 * freedom)) ** 3
    left = max(_LEAST_FREEDOM, 1 - 6 * len(np.unique(sights.image)) / freedom.sum())
    return float(np.clip(np.sqrt(np.median(squares / usual) / left), *_SIGMA_PX))
