"""From laser points to soundings (paper III.D): each ray meets its own sheet of light."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, Laser, LaserPlane
from ..schemas.parameters import LaserParameters
from . import cross, laser, line_profile, sheet_search
from .camera import normalised, project, rays
from .laser_colour import without_grey_channels
from .medians import median
from .sheet_grid import OnSheets, on_sheets

Array = NDArray[np.float64]

# A Gaussian line of 100 grey levels is below one half at 3.3 sigma.
_REACH_SIGMAS = 3.3
_LEAST_NEAR = 8
_MOST_ALIKE = 0.95  # correlation of neighbours beyond which a line is too short to tell


class Soundings(NamedTuple):
    """Points measured on the bottom in one image.

    Attributes
    ----------
    uv : (N, 2) pixels.
    arm : (N,) uint8, index into laser.sheets.
    X_camera : (N, 3) metres, camera frame.
    sigma_m : (N,) 1-sigma of the position along the ray, metres, from the noise of detection alone.
    """

    uv: Array
    arm: NDArray[np.uint8]
    X_camera: Array
    sigma_m: Array

    def take(self, keep: NDArray) -> "Soundings":
        """The soundings that a mask or an index array (N,) selects."""
        return Soundings(self.uv[keep], self.arm[keep], self.X_camera[keep], self.sigma_m[keep])


def no_soundings() -> Soundings:
    """An image without soundings."""
    return Soundings(np.zeros((0, 2)), np.zeros(0, np.uint8), np.zeros((0, 3)), np.zeros(0))


def intersect(camera: Camera, sheet: LaserPlane, uv: Array) -> tuple[Array, Array]:
    """Points (N, 3) where the rays of pixels (N, 2) meet a sheet, camera frame, and their distances (N,) on the ray.

    A distance is negative where ray and sheet meet behind the camera, and infinite (with the point NaN) where they are
    parallel.
    """
    origin, direction = rays(camera, uv)
    normal = np.array(sheet.normal)
    toward = direction @ normal
    toward = np.where(np.abs(toward) < 1e-12, np.nan, toward)
    distance = (sheet.offset - origin @ normal) / toward
    return origin + distance[:, None] * direction, np.where(np.isfinite(distance), distance, np.inf)


def triangulate(
    camera: Camera, light: Laser, uv: Array, arm: NDArray, sigma_px: Array, seen: OnSheets | None = None
) -> Soundings:
    """Soundings of points whose arm is known (paper III.D).

    The uncertainty of the column is carried along the ray by the distance's change over one pixel.

    Parameters
    ----------
    uv : (N, 2) pixels
    arm : (N,) index into light.sheets
    sigma_px : (N,) 1-sigma of u, pixels
    seen : what the pixels see on either sheet, where it is known
    """
    uv = np.asarray(uv, float).reshape(-1, 2)
    X, sigma = np.full((len(uv), 3), np.nan), np.full(len(uv), np.nan)
    change = (seen or on_sheets(camera, light, *uv.T)).per_px
    for number, sheet in enumerate(light.sheets):
        own = np.flatnonzero(np.asarray(arm) == number)
        X[own], distance = intersect(camera, sheet, uv[own])
        sigma[own] = np.abs(distance * change[number][own]) * np.asarray(sigma_px)[own]
    return Soundings(uv, np.asarray(arm).astype(np.uint8), X, sigma)


def sheets_at(camera: Camera, light: Laser, uv: Array, parameters: LaserParameters) -> cross.Sheets:
    """What cross.segment has to know of the calibration."""
    half = np.array([0.5, 0.0])

    def inverse(sheet: LaserPlane, at: Array) -> Array:
        depth = intersect(camera, sheet, at)[0][:, 2]
        return np.where(np.isfinite(depth), 1 / depth, 0.0)

    own = [inverse(sheet, uv) for sheet in light.sheets]
    change = [inverse(sheet, uv + half) - inverse(sheet, uv - half) for sheet in light.sheets]
    inverse_depth = np.linspace(1 / parameters.range_max_m, 1 / parameters.range_min_m, 400)
    meeting = project(camera, _meeting_line(light, 1 / inverse_depth))
    seen = np.isfinite(meeting).all(axis=1)
    return cross.Sheets(
        np.column_stack(own), np.column_stack(change), normalised(camera, uv), meeting[seen], inverse_depth[seen]
    )


def _meeting_line(light: Laser, depth: Array) -> Array:
    """Points (M, 3) of the line in which the two sheets meet, at depths (M,)."""
    normals = np.array([sheet.normal for sheet in light.sheets])
    offsets = np.array([sheet.offset for sheet in light.sheets])
    XY = np.linalg.solve(normals[:, :2], offsets[:, None] - normals[:, 2:] * depth).T
    return np.column_stack([XY, depth]).astype(np.float64)


def reject_outliers(soundings: Soundings, parameters: LaserParameters) -> NDArray[np.bool_]:
    """Which soundings (N,) to keep: in the range window, and in a well-filled bin of the histogram of z (III.D)."""
    Z = soundings.X_camera[:, 2]
    keep = np.isfinite(Z) & np.greater(Z, parameters.range_min_m) & np.less(Z, parameters.range_max_m)
    bin_number = np.floor(np.where(keep, Z, 0) / parameters.histogram_bin_m).astype(int)
    for number in (0, 1):
        own = keep & (soundings.arm == number)
        if not own.any():
            continue
        count = np.bincount(bin_number[own], minlength=3)
        # three bins together: a steep face passes thinly through bins that it joins, strays lie in bins of their own
        filled = np.convolve(count, [1, 1, 1], "same") >= parameters.histogram_min_share * own.sum()
        keep[own] = filled[bin_number[own]]
    return keep


class Agreement(NamedTuple):
    """How well both sheets agree on the bottom where they meet: a check of the calibration.

    Attributes
    ----------
    gap_m : how much deeper arm b has the bottom there than arm a, metres.
    sigma_m : its 1-sigma, from the scatter of the soundings about their straight lines, and from how much
        neighbours are alike in it: a bump makes many soundings err together.
    """

    gap_m: float
    sigma_m: float


class ImageSoundings(NamedTuple):
    """What one image gives.

    Attributes
    ----------
    soundings : the accepted ones.
    line_uv : (M, 2) pixels along the whole line of light, gaps closed: what laser.mask is to erase, whether or not it
        gave soundings.
    halfwidth_px : how far the light reaches to each side of line_uv.
    reason : empty, or why there are no soundings.
    agreement : of the two arms, or None where they are not both seen around their crossing.
    """

    soundings: Soundings
    line_uv: Array
    halfwidth_px: float
    reason: str
    agreement: Agreement | None = None


def nothing(reason: str) -> ImageSoundings:
    """An image without soundings, and why."""
    return ImageSoundings(no_soundings(), np.zeros((0, 2)), 0.0, reason)


def sound(image_bgr: NDArray[np.uint8], camera: Camera, light: Laser, parameters: LaserParameters) -> ImageSoundings:
    """Soundings of one image: detection, segmentation, triangulation, rejection of outliers (III.B to III.D).

    Parameters
    ----------
    image_bgr : (H, W, 3) or (H, W) uint8 of the camera's size
    """
    height, width = image_bgr.shape[:2]
    if (width, height) != (camera.width, camera.height):
        return nothing(f"size {width}x{height}, calibration says {camera.width}x{camera.height}")
    if parameters.method == "paper":
        return _sound_paper(image_bgr, camera, light, parameters)
    return _sound_sheets(image_bgr, camera, light, parameters)


class Sounded(NamedTuple):
    """What `on_both_sheets` finds.

    Attributes
    ----------
    soundings : the accepted ones.
    line : all points that were measured.
    small : the reduced image in which the arms were found.
    reason : empty, or why there are no soundings.
    """

    soundings: Soundings
    line: line_profile.Line
    small: sheet_search.Reduced
    reason: str


def on_both_sheets(image_bgr: NDArray[np.uint8], camera: Camera, light: Laser, parameters: LaserParameters) -> Sounded:
    """Detection, segmentation and triangulation by both sheets at once, of an image of the camera's size."""
    image = without_grey_channels(image_bgr, parameters.gamma)
    small = sheet_search.reduce(image)
    arms = sheet_search.search(small, camera, light, parameters)
    line = line_profile.measure(image, arms, small.factor, parameters.gamma)
    if len(line.uv) < parameters.min_soundings:
        return Sounded(no_soundings(), line, small, "no laser found")
    seen = on_sheets(camera, light, *line.uv.T)
    soundings = triangulate(camera, light, line.uv, line.arm, line.sigma_px, seen)
    keep = np.flatnonzero(_apart(seen, line) & reject_outliers(soundings, parameters))
    if len(keep) < parameters.min_soundings:
        return Sounded(no_soundings(), line, small, _no_cross(len(line.uv), len(keep)))
    return Sounded(soundings.take(keep), line, small, "")


def _sound_sheets(
    image_bgr: NDArray[np.uint8], camera: Camera, light: Laser, parameters: LaserParameters
) -> ImageSoundings:
    """`on_both_sheets`, and what else is to be known of the light: where it is to be erased, and whether arms agree."""
    soundings, line, small, reason = on_both_sheets(image_bgr, camera, light, parameters)
    if not len(line.uv):
        return nothing(reason)
    every = slice(None, None, small.row_step)
    whole = cross.whole_line(line.uv[every], line.arm[every], small.row_step, image_bgr.shape[:2])
    reach = _REACH_SIGMAS * median(line.width_px)
    first, pitch = small.origin_uv, small.pitch_uv
    patch = (3.0, 3.0 * small.factor / small.row_step)
    glow = laser.glow(small.image, (whole - first) / pitch, reach / small.factor, patch) * pitch + first
    return ImageSoundings(soundings, np.concatenate([whole, glow]), reach, reason, agreement(soundings))


def _apart(seen: OnSheets, line: line_profile.Line) -> NDArray[np.bool_]:
    """Which points (N,) are clear of the crossing: on a level bottom the other arm is far from them in their row."""
    first, second = seen.inverse_depth
    per_px = 0.5 * (np.abs(first * seen.per_px[0]) + np.abs(second * seen.per_px[1]))
    return np.abs(first - second) > line_profile.APART * line.width_px * per_px


def _no_cross(points: int, on_cross: int) -> str:
    return f"no laser cross found: {points} points on lines of light, {on_cross} of them on the cross"


def _sound_paper(
    image_bgr: NDArray[np.uint8], camera: Camera, light: Laser, parameters: LaserParameters
) -> ImageSoundings:
    points, reason = laser.detect(image_bgr, parameters), ""
    if not len(points.uv):
        return nothing("no laser found")
    if len(points.uv) < parameters.min_soundings:
        found, reason = cross.nowhere(points), "no laser found"
    else:
        sheets = sheets_at(camera, light, points.uv, parameters)
        inverse_range = (1 / parameters.range_max_m, 1 / parameters.range_min_m)
        found = cross.segment(points, image_bgr.shape[:2], sheets, inverse_range)
    told = np.flatnonzero(found.arm >= 0)
    soundings = triangulate(camera, light, points.uv[told], found.arm[told], points.sigma_px[told])
    soundings = soundings.take(reject_outliers(soundings, parameters))
    count = len(soundings.uv)
    if count < parameters.min_soundings:
        soundings, reason = no_soundings(), reason or _no_cross(len(points.uv), count)
    line = cross.whole_line(points.uv, found.arm, points.step_px, image_bgr.shape[:2])
    reach = _REACH_SIGMAS * float(np.median(points.width_px))
    line = np.concatenate([line, laser.glow(image_bgr, line, reach, (3.0 * points.step_px, 3.0 * points.step_px))])
    return ImageSoundings(soundings, line, reach, reason, agreement(soundings))


def agreement(soundings: Soundings) -> Agreement | None:
    """Whether both arms have the same bottom where they meet.

    Near the crossing (within a tenth of the range, half of it on either side) each arm's depth is a straight line in
    its own direction; the two are compared where they cross in plan.
    """
    arms = [soundings.X_camera[soundings.arm == number] for number in (0, 1)]
    where = _crossing(arms)
    if where is None:
        return None
    ends, reach = [], 0.1 * float(np.median(arms[0][:, 2]))
    for X in arms:
        along = X[:, 1] - where
        near = np.abs(along) < reach
        if min((near & (along < 0)).sum(), (near & (along > 0)).sum()) < _LEAST_NEAR:
            return None
        ends.append(_value_at_zero(along[near], X[near, 2]))
    return Agreement(ends[1][0] - ends[0][0], float(np.hypot(ends[0][1], ends[1][1])))


def _crossing(arms: list[Array]) -> float | None:
    """Camera y, metres, at which both arms have the same x, if they do."""
    if min(map(len, arms)) < 2 * _LEAST_NEAR:
        return None
    # every few points: where both arms pass is looked for no finer than in 400 places
    few = [X[:: max(1, len(X) // 800)] for X in arms]
    (x_a, y_a), (x_b, y_b) = (X[np.argsort(X[:, 1], kind="stable"), :2].T for X in few)
    y = np.linspace(max(y_a[0], y_b[0]), min(y_a[-1], y_b[-1]), 400)
    apart = np.interp(y, y_a, x_a) - np.interp(y, y_b, x_b)
    change = np.flatnonzero(np.sign(apart[1:]) != np.sign(apart[:-1]))
    return float(y[change[len(change) // 2]]) if len(change) and y[-1] > y[0] else None


def _value_at_zero(along: Array, depth: Array) -> tuple[float, float]:
    """Depth at 0 of the straight line through points (N,), and its 1-sigma."""
    middle, mean = along.mean(), depth.mean()
    spread = ((along - middle) ** 2).sum()
    slope = ((along - middle) * (depth - mean)).sum() / max(spread, 1e-18)
    off = (depth - mean - slope * (along - middle))[np.argsort(along, kind="stable")]
    alike = float(np.clip((off[1:] * off[:-1]).sum() / max((off**2).sum(), 1e-18), 0.0, _MOST_ALIKE))
    scatter = off.std() * np.sqrt((1 + alike) / (1 - alike))
    return float(mean - slope * middle), float(scatter * np.sqrt(1 / len(along) + middle**2 / max(spread, 1e-18)))
