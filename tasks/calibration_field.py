"""Calibration from an ordinary survey: sheets, mount angles and the clock of the navigation from crossovers.

Where lines of light of different images cross on the seabed they have to be at one height; where a match between
two images lies beside a line, its triangulated depth has to be the laser's; where the altimeter's foot passes over a
line, its height has to be the line's. Image matches and navigation hold the poses, which are estimated with the rest.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..schemas.calibration import Calibration
from .calibration_sheets import SheetBasis, basis, cast_rays, moved
from .calibration_solve import Layout, Solved, solve, unit_sigma
from .camera import normalised, rays
from .rotations import R_vehicle_camera

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# sheets (2 x 3), mount roll, pitch, yaw, clock, altimeter, constant errors of roll, pitch, heading
_MOUNT, _CLOCK, _ALTIMETER, _ATTITUDE = slice(6, 9), 9, 10, slice(11, 14)
SHARED: Final = 14
_PER_IMAGE: Final = 6  # errors of position (east, north, up) and attitude (vehicle axes)
_WHITE_SHARE: Final = 0.3
_JITTER_M: Final = 0.003
_OUTLIER_SIGMAS: Final = 4.0
GROUPS: Final = ("crossover", "beside", "match", "altimeter", "track", "depth", "attitude")
# Errors of neighbours are alike (one stone beside a line, one feature in many pairs): a group counts as if its sigma
# were so many times larger than its residuals say.
_CORRELATED: Final = np.array([1.5, 4.0, 1.5, 1.5, 1.0, 1.0, 1.0])
# No group may claim to be much better than stated: a survey that shrinks to nothing has no residuals at all.
_BEST, _WORST = 0.25, 50.0


class FieldPriors(NamedTuple):
    """1-sigma of what is believed before the data are looked at; degrees, metres, seconds."""

    sheet_deg: float = 2.0
    sheet_m: float = 0.04
    mount_deg: float = 1.0
    clock_s: float = 0.5
    altimeter_m: float = 0.001


class Track(NamedTuple):
    """Navigation of n images.

    Attributes
    ----------
    R_local_vehicle : (n, 3, 3). X_local : (n, 3) reference points, metres.
    turn_rate : (n, 3) rotation vector a second, vehicle axes. velocity : (n, 3) metres a second, local.
    time_s : (n,). sigma_horizontal, sigma_depth : (n,) metres. sigma_attitude : (n, 3) radians.
    drift_m_per_sqrt_s : random walk of the horizontal position.
    """

    R_local_vehicle: Array
    X_local: Array
    turn_rate: Array
    velocity: Array
    time_s: Array
    sigma_horizontal: Array
    sigma_depth: Array
    sigma_attitude: Array
    drift_m_per_sqrt_s: float


class Points(NamedTuple):
    """Laser points: uv (P, 2) pixels, image (P,), arm (P,), sigma_px (P,); by image, arm and row."""

    uv: Array
    image: Indices
    arm: NDArray[np.int8]
    sigma_px: Array


class Matches(NamedTuple):
    """Matches between images i and j (M,): uv_i, uv_j (M, 2) pixels."""

    i: Indices
    j: Indices
    uv_i: Array
    uv_j: Array


class Crossings(NamedTuple):
    """Where lines of light cross: p, q (C, 2) points at the ends of both segments, and the share f, g (C,) along."""

    p: Indices
    q: Indices
    f: Array
    g: Array


class Beside(NamedTuple):
    """Matches next to a line: match (B,), which of its images has the line (0 or 1), point (B,), slope apart (B,)."""

    match: Indices
    side: Indices
    point: Indices
    apart: Array


class Feet(NamedTuple):
    """Altimeter readings over something measured: image (A,) nearest in time, from_reference (A, 3) the foot from that
    image's reference point, local axes, metres; what is there (A,), a laser point or a match of that image, and its
    distance apart (A,), metres."""

    image: Indices
    from_reference: Array
    spot: Indices
    apart: Array


class FieldProblem(NamedTuple):
    """All observations of one round; `feet` are on lines, `feet_matched` on matches; `sigma` are factors on the stated
    sigmas of GROUPS."""

    calibration: Calibration
    starts: tuple[SheetBasis, SheetBasis]
    priors: FieldPriors
    track: Track
    points: Points
    matches: Matches
    crossings: Crossings
    beside: Beside
    feet: Feet
    feet_matched: Feet
    range_m: float
    sigma: Array


class FieldResult(NamedTuple):
    """What the survey says.

    Attributes
    ----------
    sheets : (2, 4). mount_deg : (3,) roll, pitch, yaw. clock_s : seconds to add to navigation times.
    shared, covariance, prior_sigma : (14,), (14, 14), (14,): steps of the sheets (radians, radians, metres), mount
        (radians), clock (s), altimeter (m), constant attitude errors (radians).
    crossing_m : (C,) height differences, metres. crossing_uv : (C, 2) pixels of the first line there.
    used : (C,) which were not outliers.
    sigma : of GROUPS, factors on what was stated. counts : observations of GROUPS.
    x : everything, to go on from.
    """

    sheets: Array
    mount_deg: Array
    clock_s: float
    shared: Array
    covariance: Array
    prior_sigma: Array
    crossing_m: Array
    crossing_uv: Array
    used: NDArray[np.bool_]
    sigma: Array
    counts: dict[str, int]
    x: Array


def field_starts(calibration: Calibration) -> tuple[SheetBasis, SheetBasis]:
    """What sheets' steps are measured from."""
    assert calibration.laser is not None
    first, second = (basis(sheet, calibration.laser.origin) for sheet in calibration.laser.sheets)
    return first, second


def prior_sigma(priors: FieldPriors, track: Track) -> Array:
    """(14,) of the shared unknowns."""
    turn, mount = np.radians(priors.sheet_deg), np.radians(priors.mount_deg)
    sheet = [turn, turn, priors.sheet_m]
    attitude = np.median(track.sigma_attitude, axis=0)
    return np.array([*sheet, *sheet, mount, mount, mount, priors.clock_s, priors.altimeter_m, *attitude])


def layout(priors: FieldPriors, track: Track) -> Layout:
    """The unknowns."""
    tilt = np.median(track.sigma_attitude, axis=0)
    image = np.array([0.05, 0.05, float(np.median(track.sigma_depth)), *tilt])
    count = len(track.time_s)
    return Layout(SHARED, count, _PER_IMAGE, np.concatenate([prior_sigma(priors, track), np.tile(image, count)]))


class Posed(NamedTuple):
    """R_local_camera (n, 3, 3), C_local (n, 3), and the reference points (n, 3) by the navigation's own clock."""

    R: Array
    C: Array
    reference: Array


def posed(x: Array, calibration: Calibration, priors: FieldPriors, track: Track) -> Posed:
    """Cameras for unknowns x."""
    shared, images = layout(priors, track).split(x)
    turn = Rotation.from_rotvec(track.turn_rate * shared[_CLOCK])
    bias = Rotation.from_rotvec(shared[_ATTITUDE])
    R_local_vehicle = Rotation.from_matrix(track.R_local_vehicle) * turn * bias * Rotation.from_rotvec(images[:, 3:])
    R = R_local_vehicle.as_matrix()
    reference = track.X_local + images[:, :3]
    mount = np.array(calibration.mount.rotation) + np.degrees(shared[_MOUNT])
    C = reference + track.velocity * shared[_CLOCK] + R @ np.asarray(calibration.mount.translation)
    return Posed(R @ R_vehicle_camera(*mount), C, reference)


def sheets_of(x: Array, starts: tuple[SheetBasis, SheetBasis]) -> Array:
    """(2, 4)"""
    return np.stack([moved(start, x[3 * s : 3 * s + 3]) for s, start in enumerate(starts)])


class _Cast(NamedTuple):
    """Rays of the points that observations use, once and for all."""

    origin: Array
    direction: Array
    slopes_i: Array
    slopes_j: Array
    focal_px: float


def _prepared(p: FieldProblem) -> _Cast:
    camera = p.calibration.camera
    origin, direction = rays(camera, p.points.uv)
    x_i, x_j = (normalised(camera, uv, p.range_m) for uv in (p.matches.uv_i, p.matches.uv_j))
    return _Cast(origin, direction, x_i, x_j, 0.5 * (camera.fx + camera.fy) * (1.33 if camera.port else 1.0))


def points_local(x: Array, p: FieldProblem, cast: _Cast, at: Posed) -> tuple[Array, Array]:
    """Laser points in camera and local frames, (P, 3), (P, 3)."""
    X = cast_rays(cast.origin, cast.direction, sheets_of(x, p.starts)[p.points.arm])
    image = p.points.image
    return X, np.einsum("pij,pj->pi", at.R[image], X) + at.C[image]


def crossing_heights(p: Crossings, X_local: Array) -> Array:
    """Distance (C,) of the lines at their crossings along the normal of the plane through both, metres."""
    first, second = X_local[p.p], X_local[p.q]
    along_p, along_q = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0]
    normal = np.cross(along_p, along_q)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) * np.where(normal[:, 2:] < 0, -1.0, 1.0)
    apart = first[:, 0] + p.f[:, None] * along_p - second[:, 0] - p.g[:, None] * along_q
    return (apart * normal).sum(1)


def intersect_matches(matches: Matches, slopes_i: Array, slopes_j: Array, at: Posed) -> Array:
    """Where matches lie (M, 3), local, metres: on the ray of image i, nearest to that of j; NaN without parallax."""
    i, j = matches.i, matches.j
    ray_i, turned, t, _ = _two_rays(slopes_i, slopes_j, at, i, j)
    depth = _depths(ray_i, turned, t)[:, 0]
    depth = np.where(depth > 0, depth, np.nan)
    return at.C[i] + np.einsum("mij,mj->mi", at.R[i], depth[:, None] * ray_i)


def _two_rays(slopes_i: Array, slopes_j: Array, at: Posed, i: Indices, j: Indices) -> tuple[Array, Array, Array, Array]:
    """Rays of i and j and the base from i to j (M, 3), all in the frame of camera i, and R (M, 3, 3) from j to i."""
    R = np.einsum("mki,mkj->mij", at.R[i], at.R[j])
    t = np.einsum("mki,mk->mi", at.R[i], at.C[j] - at.C[i])
    ray_i, ray_j = (np.column_stack([x, np.ones(len(x))]) for x in (slopes_i, slopes_j))
    return ray_i, np.einsum("mij,mj->mi", R, ray_j), t, R


def _depths(ray_i: Array, turned: Array, t: Array) -> Array:
    """Depths (M, 2) along both rays where these come closest, as `epipolar.depths`."""
    a, b, c = (ray_i**2).sum(1), (ray_i * turned).sum(1), (turned**2).sum(1)
    e, f = (ray_i * t).sum(1), (turned * t).sum(1)
    determinant = np.maximum(a * c - b * b, 1e-12)
    return np.column_stack([c * e - b * f, b * e - a * f]) / determinant[:, None]


def _match_residuals(p: FieldProblem, cast: _Cast, at: Posed) -> tuple[Array, Array]:
    """Sampson distances (M,), pixels, and triangulated depths (M, 2) in both cameras."""
    ray_i, turned, t, R = _two_rays(cast.slopes_i, cast.slopes_j, at, p.matches.i, p.matches.j)
    base = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-9)
    line_i = np.cross(base, turned)
    line_j = np.einsum("mij,mi->mj", R, np.cross(ray_i, base))
    spread = np.sqrt((line_i[:, :2] ** 2).sum(1) + (line_j[:, :2] ** 2).sum(1))
    distance = (ray_i * line_i).sum(1) / np.maximum(spread, 1e-12) * cast.focal_px
    return distance, _depths(ray_i, turned, t)


def _stated(p: FieldProblem, cast: _Cast, at: Posed, X: Array) -> list[Array]:
    """Stated 1-sigma of the observations of each group, before factors."""
    spread = 0.002
    points = p.points
    sheets = sheets_of(np.zeros(6), p.starts)[points.arm]
    slant = np.abs((cast.direction * sheets[:, :3]).sum(1))
    own = points.sigma_px * X[:, 2] / (cast.focal_px * np.maximum(slant, 0.05))
    crossing = np.sqrt(own[p.crossings.p[:, 0]] ** 2 + own[p.crossings.q[:, 0]] ** 2 + spread**2)
    base = np.linalg.norm(at.C[p.matches.j] - at.C[p.matches.i], axis=1)[p.beside.match]
    depth = p.range_m**2 / (cast.focal_px * np.maximum(base, 0.05)) * 0.5
    beside = np.sqrt(depth**2 + (0.3 * p.range_m * p.beside.apart) ** 2 + 0.003**2)
    apart = np.concatenate([p.feet.apart, p.feet_matched.apart])
    feet = np.sqrt(0.01**2 + (0.3 * apart) ** 2)
    t = p.track
    step = np.sqrt(t.drift_m_per_sqrt_s**2 * np.abs(np.diff(t.time_s)) + 2 * _JITTER_M**2)
    track = np.concatenate([np.repeat(step, 2), np.repeat(t.sigma_horizontal[:1], 2)])
    return [
        crossing,
        beside,
        np.full(len(p.matches.i), 0.5),
        feet,
        track,
        _WHITE_SHARE * t.sigma_depth,
        _WHITE_SHARE * t.sigma_attitude.ravel(),
    ]


def _misfits(x: Array, p: FieldProblem, cast: _Cast) -> list[Array]:
    """Residuals of each group, in its own unit."""
    at = posed(x, p.calibration, p.priors, p.track)
    X, X_local = points_local(x, p, cast, at)
    shared, images = layout(p.priors, p.track).split(x)
    distance, depth = _match_residuals(p, cast, at)
    beside = depth[p.beside.match, p.beside.side] - X[p.beside.point, 2]
    feet = _foot_heights(p.feet, at) + shared[_ALTIMETER] - X_local[p.feet.spot, 2]
    feet_matched = _foot_heights(p.feet_matched, at) + shared[_ALTIMETER] - _matched_heights(p, cast, at, depth)
    return [
        crossing_heights(p.crossings, X_local),
        np.nan_to_num(beside, nan=1.0),
        distance,
        np.concatenate([feet, feet_matched]),
        np.concatenate([np.diff(images[:, :2], axis=0).ravel(), images[0, :2]]),
        images[:, 2],
        images[:, 3:].ravel(),
    ]


def _foot_heights(feet: Feet, at: Posed) -> Array:
    """Elevations (A,) where the altimeter has the seabed, local, metres."""
    return at.reference[feet.image, 2] + feet.from_reference[:, 2]


def _matched_heights(p: FieldProblem, cast: _Cast, at: Posed, depth: Array) -> Array:
    """Elevations (A,) of the matches under the altimeter, as the image over them has them, local, metres."""
    k, image = p.feet_matched.spot, p.feet_matched.image
    second = (p.matches.i[k] != image).astype(int)
    slopes = np.where(second[:, None] == 1, cast.slopes_j[k], cast.slopes_i[k])
    toward = np.einsum("aj,aj->a", at.R[image, 2], np.column_stack([slopes, np.ones(len(k))]))
    return at.C[image, 2] + depth[k, second] * toward


def _rows(p: FieldProblem) -> Indices:
    image, m = p.points.image, p.matches
    count = len(p.track.time_s)
    number = np.arange(count)
    step = np.column_stack([number[:-1], number[1:]]) if count > 1 else np.zeros((0, 2), np.intp)
    alone = np.column_stack([number, np.full(count, -1)])
    parts = [
        np.column_stack([image[p.crossings.p[:, 0]], image[p.crossings.q[:, 0]]]),
        np.column_stack([m.i[p.beside.match], m.j[p.beside.match]]),
        np.column_stack([m.i, m.j]),
        np.column_stack([p.feet.image, image[p.feet.spot]]),
        np.column_stack([m.i[p.feet_matched.spot], m.j[p.feet_matched.spot]]),
        np.repeat(step, 2, axis=0),
        np.array([[0, -1], [0, -1]]),
        alone,
        np.repeat(alone, 3, axis=0),
        np.full((SHARED, 2), -1),
    ]
    rows = np.concatenate(parts).astype(np.intp)
    same = rows[:, 0] == rows[:, 1]
    rows[same, 1] = -1
    return rows


def _group_of(p: FieldProblem) -> Indices:
    """Number of the group of each residual, -1 for priors."""
    n = len(p.track.time_s)
    feet = len(p.feet.image) + len(p.feet_matched.image)
    sizes = [len(p.crossings.f), len(p.beside.match), len(p.matches.i), feet, 2 * n, n, 3 * n]
    return np.append(np.repeat(np.arange(len(GROUPS)), sizes), np.full(SHARED, -1)).astype(np.intp)


def adjust_field(p: FieldProblem, x: Array, rounds: int = 3) -> FieldResult:
    """Adjust sheets, mount, clock and poses to the observations; sigmas and outliers found in turns.

    Parameters
    ----------
    p : observations. x : unknowns to begin with.
    """
    cast = _prepared(p)
    at = posed(x, p.calibration, p.priors, p.track)
    stated = np.concatenate(_stated(p, cast, at, points_local(x, p, cast, at)[0]))
    group, rows, prior = _group_of(p), _rows(p), prior_sigma(p.priors, p.track)
    sigma, weight = p.sigma.copy(), np.ones(len(stated))

    def misfit(y: Array) -> Array:
        return np.concatenate(_misfits(y, p, cast)) / stated

    weight = _inliers(misfit(x), group[: len(stated)])
    solved: Solved | None = None
    for _ in range(rounds):
        counted = sigma * _CORRELATED
        factor = weight / counted[group[: len(stated)]]
        solved = solve(
            lambda y, k=factor: np.concatenate([misfit(y) * k, y[:SHARED] / prior]), x, layout(p.priors, p.track), rows
        )
        x = solved.x
        lit = np.append(weight, np.zeros(SHARED)) > 0
        unit = [unit_sigma(solved, (group == g) & lit) for g in range(len(GROUPS))]
        sigma = np.clip(counted * unit, _BEST, _WORST)
        weight = _inliers(misfit(x), group[: len(stated)])
    assert solved is not None
    heights = _misfits(x, p, cast)[0]
    return FieldResult(
        sheets=sheets_of(x, p.starts),
        mount_deg=np.array(p.calibration.mount.rotation) + np.degrees(x[_MOUNT]),
        clock_s=float(x[_CLOCK]),
        shared=x[:SHARED],
        covariance=solved.covariance[:SHARED, :SHARED],
        prior_sigma=prior,
        crossing_m=heights,
        crossing_uv=p.points.uv[p.crossings.p[:, 0]],
        used=weight[: len(heights)] > 0,
        sigma=sigma,
        counts={name: int(np.sum(weight[group[: len(stated)] == g] > 0)) for g, name in enumerate(GROUPS)},
        x=x,
    )


def _inliers(misfit: Array, group: Indices) -> Array:
    """1 (M,) for observations within four robust sigmas of their group's zero, else 0; navigation is never left out."""
    weight = np.ones(len(misfit))
    for g, name in enumerate(GROUPS):
        own = group == g
        if name in ("track", "depth", "attitude") or not own.any():
            continue
        off = np.abs(misfit[own])
        weight[own] = off < _OUTLIER_SIGMAS * max(1.4826 * float(np.median(off)), 1e-9)
    return weight


def heights_with(p: FieldProblem, x: Array) -> Array:
    """Height differences (C,) of the problem's crossovers for unknowns x, metres."""
    return _misfits(x, p, _prepared(p))[0]
