"""Which arm of the laser cross each point is on (paper III.C).

The centre is found in the image as in the paper: double erosion by line elements at +45 and -45 degrees, then a
circle around each candidate. Left and right of it, above and below it, are then known arms. Two things are taken
from the calibration, which the paper leaves unused: the two sheets meet in one line, so the centre can only be on
its image; and a point has a depth by either sheet, so that fragments and displaced pieces, which left and right
would get wrong, go to the sheet whose depths agree with the rest of the cross.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from . import laser
from .laser import LaserPoints

Array = NDArray[np.float64]
Labels = NDArray[np.int8]

# Two lines this many widths apart do not disturb each other's peaks.
_APART_SIGMAS: Final = 6.0
_CENTRE_TOLERANCE_SIGMAS: Final = 4.0
# What a bottom is like: pieces of it stand out from the mean plane by this share of the range, and slope so much.
_RELIEF: Final = 0.15
_SLOPE: Final = 1.0
_ROUNDS: Final = 10
_LONG: Final = 60


class Sheets(NamedTuple):
    """What the calibration says about points before their arm is known.

    Attributes
    ----------
    inverse_depth : (N, 2) 1/Z of each point if it were on sheet a or on sheet b, 1/m; negative behind the camera.
    per_px : (N, 2) change of inverse_depth by one pixel along the row.
    slopes : (N, 2) X/Z and Y/Z of the point's ray.
    meeting_uv : (M, 2) image of the line in which the sheets meet, pixels.
    meeting_inverse_depth : (M,) 1/Z along it.
    """

    inverse_depth: Array
    per_px: Array
    slopes: Array
    meeting_uv: Array
    meeting_inverse_depth: Array


class Cross(NamedTuple):
    """A segmented cross.

    Attributes
    ----------
    centre : (2,) pixels, or None where it could not be found in the image.
    arm : (N,) int8, index into laser.sheets, -1 for points that are on neither or whose arm cannot be told.
    """

    centre: Array | None
    arm: Labels


def nowhere(points: LaserPoints) -> Cross:
    """No cross: every point on neither arm."""
    return Cross(None, np.full(len(points.uv), -1, np.int8))


def segment(points: LaserPoints, shape: tuple[int, int], sheets: Sheets, inverse_range: tuple[float, float]) -> Cross:
    """Tell the arms of the cross apart (paper III.C).

    Parameters
    ----------
    points : laser points of one image
    shape : height and width of that image
    sheets : the same points seen by the calibration
    inverse_range : lowest and highest believable 1/Z, 1/m
    """
    arm = np.full(len(points.uv), -1, np.int8)
    if not len(points.uv):
        return Cross(None, arm)
    width = float(np.median(points.width_px))
    centre = find_centre(points, shape, sheets.meeting_uv, _CENTRE_TOLERANCE_SIGMAS * width)
    # also farther than laser.linked reaches
    apart = max(_APART_SIGMAS * width, 8.0 * points.step_px)
    clear = (separation_px(sheets) > apart) & (laser.distance_in_row(points) > apart)
    clear &= _believable(sheets.inverse_depth, inverse_range).any(axis=1)
    if not clear.any():
        return Cross(centre, arm)
    fragment = _fragments(points, shape, clear, sheets)
    start = _start(centre, sheets, clear, inverse_range)
    arm[clear] = _label(fragment[clear], sheets.inverse_depth[clear], sheets.slopes[clear], start, inverse_range)
    arm[_unlikely(fragment, arm, points.uv, sheets.inverse_depth)] = -1
    return Cross(centre, arm)


def separation_px(sheets: Sheets) -> Array:
    """How far apart (N,) the arms are in each point's row, on a level bottom, in pixels.

    This is the paper's "row relative to the centre" for a cross at any angle; its sign would tell above from below.
    """
    difference = np.abs(sheets.inverse_depth[:, 0] - sheets.inverse_depth[:, 1])
    return difference / np.maximum(np.abs(sheets.per_px).mean(axis=1), 1e-12)


def _believable(inverse_depth: Array, inverse_range: tuple[float, float]) -> NDArray[np.bool_]:
    return (inverse_depth > inverse_range[0]) & (inverse_depth < inverse_range[1])


def _fragments(points: LaserPoints, shape: tuple[int, int], clear: NDArray[np.bool_], sheets: Sheets) -> NDArray:
    """Number of the unbroken piece of line that each point is on, the crossing zone cut out."""
    step = points.step_px
    pixel = np.floor((points.uv + 0.5) / step).astype(np.intp)
    size = (shape[0] // step + 1, shape[1] // step + 1)
    fragment = np.full(len(points.uv), -1, np.int64)
    above = sheets.inverse_depth[:, 0] > sheets.inverse_depth[:, 1]
    for side, part in enumerate((clear & above, clear & ~above)):
        fragment[part] = 2 * laser.linked(pixel[part, 1], pixel[part, 0], size).astype(np.int64) + side
    return fragment


# ------------------------------------------------------------------------------------------------ centre


def find_centre(points: LaserPoints, shape: tuple[int, int], meeting_uv: Array, tolerance_px: float) -> Array | None:
    """Centre (2,) of the cross in pixels by double erosion and the circle test, or None (paper III.C).

    Candidates farther than tolerance_px from the image of the line in which the sheets meet are not looked at.
    """
    step = points.step_px
    half = max(2, round(1.5 * float(np.median(points.width_px)) / step))
    drawn = _drawn(points, shape, half)
    for length in (4 * half + 1, 3 * half + 1, 2 * half + 1):
        found = []
        for candidate in _eroded_twice(drawn, length):
            uv = (candidate + 0.5) * step - 0.5
            if _distance(uv, meeting_uv) > tolerance_px:
                continue
            unevenness = _unevenness(drawn, candidate, radius=2.0 * length)
            if unevenness is not None:
                found.append((unevenness, uv))
        if found:
            return min(found, key=lambda item: item[0])[1]
    return None


def _drawn(points: LaserPoints, shape: tuple[int, int], half: int) -> NDArray[np.uint8]:
    """The thresholded image, at the scale of detection: the points as wide as the line."""
    step = points.step_px
    drawn = np.zeros((shape[0] // step + 1, shape[1] // step + 1), np.uint8)
    pixel = np.floor((points.uv + 0.5) / step).astype(int)
    drawn[pixel[:, 1], pixel[:, 0]] = 1
    wide = cv2.dilate(drawn, np.ones((3, 2 * half + 1), np.uint8))
    # where the arms run into each other there are no separate peaks
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (4 * half + 1, 4 * half + 1))
    return np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc), np.uint8)


def _eroded_twice(drawn: NDArray[np.uint8], length: int) -> Array:
    """Centres (M, 2) of the places that line elements of both directions fit into, pixels of the drawn image."""
    falling = np.eye(length, dtype=np.uint8)

    def eroded(element: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.erode(drawn, element, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)), np.uint8)

    both = eroded(falling) & eroded(np.ascontiguousarray(falling[::-1]))
    centroids = cv2.connectedComponentsWithStats(both, connectivity=8)[3]
    return np.asarray(centroids, np.float64)[1:]


def _distance(uv: Array, line_uv: Array) -> float:
    """Distance of a pixel (2,) from a finely sampled line (M, 2); infinite from an empty one."""
    return float(np.min(np.hypot(*(line_uv - uv).T), initial=np.inf))


def _unevenness(drawn: NDArray[np.uint8], candidate: Array, radius: float) -> float | None:
    """How far, in degrees, the four crossings of a circle with the arms are from being 90 degrees apart.

    None where the circle does not cross exactly four arms, or crosses them too unevenly for a cross.
    """
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    u = np.round(candidate[0] + radius * np.cos(angle)).astype(int)
    v = np.round(candidate[1] + radius * np.sin(angle)).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < drawn.shape[1]) & (v < drawn.shape[0])
    lit = np.zeros(360, bool)
    lit[inside] = drawn[v[inside], u[inside]] > 0
    edges = np.flatnonzero(lit != np.roll(lit, 1))
    if len(edges) != 8:
        return None
    if not lit[edges[0]]:
        edges = np.roll(edges, -1)
    middle = np.sort((edges[0::2] + ((edges[1::2] - edges[0::2]) % 360) / 2) % 360)
    worst = float(np.abs(np.diff(np.append(middle, middle[0] + 360)) - 90).max())
    return worst if worst < 45 else None


# ---------------------------------------------------------------------------------------------- labelling


def _start(centre: Array | None, sheets: Sheets, clear: NDArray, inverse_range: tuple[float, float]) -> float:
    """Inverse depth to begin with: the centre's own or, without one, that on which most points can agree.

    Of two depths that a point can have only one is real. The real ones of all points are alike, the others spread
    out with the distance from the crossing.
    """
    if centre is not None:
        return float(sheets.meeting_inverse_depth[np.argmin(np.hypot(*(sheets.meeting_uv - centre).T))])
    both = sheets.inverse_depth[clear]
    both = both[_believable(both, inverse_range)]
    if not len(both):
        return float(np.mean(inverse_range))
    count, edges = np.histogram(both, bins=80, range=inverse_range)
    smooth = np.convolve(count, [1, 2, 3, 2, 1], "same")
    best = int(np.argmax(smooth))
    return float(0.5 * (edges[best] + edges[best + 1]))


def _label(
    fragment: NDArray, inverse_depth: Array, slopes: Array, start: float, inverse_range: tuple[float, float]
) -> Labels:
    """Arm (N,) of points by fragments: each goes to the sheet that puts it nearer to the surface of all others.

    With the level surface at the centre's depth, the first round is the paper's rule of left and right. The
    surface is then a plane (a plane in space is one in inverse depth too) fitted robustly to the labelled points,
    until no label changes.
    """
    unique, index = np.unique(fragment, return_inverse=True)
    design = np.column_stack([np.ones(len(slopes)), slopes])
    plane = np.array([start, 0.0, 0.0])
    outside = ~_believable(inverse_depth, inverse_range)
    steepness = np.array([_steepness(inverse_depth[index == k], slopes[index == k, 1]) for k in range(len(unique))])
    arm = np.full(len(unique), -1)
    for _ in range(_ROUNDS):
        misfit = np.abs(inverse_depth / (design @ plane)[:, None] - 1)
        misfit[outside] = np.inf
        cost = np.array([np.median(misfit[index == k], axis=0) for k in range(len(unique))])
        cost = cost / _RELIEF + steepness / _SLOPE
        before, arm = arm, np.where(np.isfinite(cost).any(axis=1), np.argmin(cost, axis=1), -1)
        if (arm == before).all():
            break
        chosen = arm[index]
        used = chosen >= 0
        plane = _robust_plane(design[used], inverse_depth[used, chosen[used]], plane)
    return arm[index].astype(np.int8)


def _steepness(inverse_depth: Array, y: Array) -> Array:
    """Slope of the bottom (2,) along a fragment if it is on sheet a or b: median of |dZ| over Z |dy|."""
    lag = max(1, min(len(y) // 2, 12))
    order = np.argsort(y, kind="stable")
    y, inverse_depth = y[order], inverse_depth[order]
    rise = np.abs(inverse_depth[lag:] - inverse_depth[:-lag]) / np.maximum(np.abs(inverse_depth[lag:]), 1e-6)
    run = np.maximum(y[lag:] - y[:-lag], 1e-9)
    return np.median(rise / run[:, None], axis=0) if len(rise) else np.zeros(2)


def _unlikely(fragment: NDArray, arm: Labels, uv: Array, inverse_depth: Array) -> NDArray[np.bool_]:
    """Points (N,) of fragments too short for how far they stand out from the bottom around them.

    Chains of stray points get rarer with their length, and so does relief with its height; a fragment has to have
    a hundred points times its height above (or depth below) the longer fragments next to it, as a share of the range.
    """
    held = np.flatnonzero(arm >= 0)
    number, size = np.unique(fragment[held], return_counts=True)
    own = inverse_depth[held, arm[held]]
    size_of = size[np.searchsorted(number, fragment[held])]
    unlikely = np.zeros(len(arm), bool)
    for k, n in zip(number[size < _LONG], size[size < _LONG], strict=True):
        members, longer = fragment[held] == k, size_of > n
        if not longer.any():
            continue
        middle = uv[held][members].mean(axis=0)
        distance = np.hypot(*(uv[held][longer] - middle).T)
        nearest = np.argsort(distance)[:25]
        around, mean = np.median(own[longer][nearest]), np.median(own[members])
        unlikely[held[members]] = n < 100 * abs(mean / around - 1)
    return unlikely


def _robust_plane(design: Array, inverse_depth: Array, plane: Array) -> Array:
    """Coefficients (3,) of a plane through points, by least squares with Cauchy weights, weakly held to be level."""
    for _ in range(5):
        residual = inverse_depth - design @ plane
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weight = 1 / (1 + (residual / (2 * scale)) ** 2)
        level = 1e-5 * len(design) * np.diag([0.0, 1.0, 1.0]) + 1e-9 * np.eye(3)
        normal = design.T @ (weight[:, None] * design) + level
        plane = np.linalg.solve(normal, design.T @ (weight * inverse_depth)).astype(np.float64)
    return plane


# ---------------------------------------------------------------------------------------------- whole line


def whole_line(uv: Array, arm: NDArray, step_px: int, shape: tuple[int, int]) -> Array:
    """Pixels (M, 2) along all light of the cross, no farther apart than the rows of detection.

    All points, the straight joints over gaps of an arm (the crossing, dark stones, faint stretches) and its last
    stretch to the border of the image, where the window of detection does not reach. Gaps wider than a tenth of
    the image are left open: there the arm is hidden or displaced.

    Parameters
    ----------
    uv : (N, 2) pixels of points on lines of light
    arm : (N,) number of the sheet, negative where it is not known
    step_px : distance between rows of points, pixels
    shape : height and width of the image
    """
    pieces = [uv]
    widest = 0.1 * max(shape)
    for number in (0, 1):
        own = uv[arm == number]
        if len(own) < 2:
            continue
        own = own[np.argsort(own[:, 1], kind="stable")]
        ends = [_to_border(own[19::-1], shape), _to_border(own[-20:], shape)]
        own = np.concatenate([ends[0], own, ends[1]])
        length = np.hypot(*np.diff(own, axis=0).T)
        for k in np.flatnonzero((length > 3 * step_px) & (length < widest)):
            share = np.linspace(0, 1, int(np.ceil(length[k] / step_px)) + 1)[:, None]
            pieces.append(own[k] + share * (own[k + 1] - own[k]))
    return np.concatenate(pieces)


def _to_border(uv: Array, shape: tuple[int, int]) -> Array:
    """Where (0 or 1, 2) the line through an arm's last points (N, 2) leaves the image, if that is near."""
    direction = uv[-1] - uv[0]
    length = float(np.hypot(*direction))
    if length == 0:
        return np.zeros((0, 2))
    direction /= length
    limit = np.where(direction > 0, [shape[1] - 1.0, shape[0] - 1.0], 0.0)
    steps = np.divide(limit - uv[-1], direction, out=np.full(2, np.inf), where=np.abs(direction) > 1e-9)
    step = float(steps.min())
    return (uv[-1] + step * direction)[None] if 0 < step < 0.03 * max(shape) else np.zeros((0, 2))
