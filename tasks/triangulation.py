"""From laser points to soundings (paper III.D): each ray meets its own sheet of light."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, Laser, LaserPlane
from ..schemas.parameters import LaserParameters
from . import cross, laser
from .camera import normalised, project, rays

Array = NDArray[np.float64]

# A Gaussian line of 100 grey levels is below one half at 3.3 sigma.
_REACH_SIGMAS = 3.3


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


def triangulate(camera: Camera, light: Laser, uv: Array, arm: NDArray, sigma_px: Array) -> Soundings:
    """Soundings of points whose arm is known (paper III.D).

    The uncertainty of the column is carried along the ray by the distance's change over one pixel.

    Parameters
    ----------
    uv : (N, 2) pixels
    arm : (N,) index into light.sheets
    sigma_px : (N,) 1-sigma of u, pixels
    """
    uv = np.asarray(uv, float).reshape(-1, 2)
    X, sigma = np.full((len(uv), 3), np.nan), np.full(len(uv), np.nan)
    half = np.array([0.5, 0.0])
    for number, sheet in enumerate(light.sheets):
        own = np.asarray(arm) == number
        X[own] = intersect(camera, sheet, uv[own])[0]
        change = intersect(camera, sheet, uv[own] + half)[1] - intersect(camera, sheet, uv[own] - half)[1]
        sigma[own] = np.abs(change) * np.asarray(sigma_px)[own]
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


class ImageSoundings(NamedTuple):
    """What one image gives.

    Attributes
    ----------
    soundings : the accepted ones.
    points : everything detected.
    cross : its arms and centre.
    line_uv : (M, 2) pixels along the whole line of light, gaps closed: what laser.mask is to erase.
    halfwidth_px : how far the light reaches to each side of line_uv.
    reason : empty, or why there are no soundings.
    """

    soundings: Soundings
    points: laser.LaserPoints
    cross: cross.Cross
    line_uv: Array
    halfwidth_px: float
    reason: str


def sound(image_bgr: NDArray[np.uint8], camera: Camera, light: Laser, parameters: LaserParameters) -> ImageSoundings:
    """Soundings of one image: detection, segmentation, triangulation, rejection of outliers (III.B to III.D).

    Parameters
    ----------
    image_bgr : (H, W, 3) uint8 of the camera's size
    """
    points = laser.detect(image_bgr, parameters)
    nothing = ImageSoundings(no_soundings(), points, cross.nowhere(points), np.zeros((0, 2)), 0.0, "no laser found")
    if len(points.uv) < parameters.min_soundings:
        return nothing
    sheets = sheets_at(camera, light, points.uv, parameters)
    inverse_range = (1 / parameters.range_max_m, 1 / parameters.range_min_m)
    found = cross.segment(points, image_bgr.shape[:2], sheets, inverse_range)
    told = np.flatnonzero(found.arm >= 0)
    soundings = triangulate(camera, light, points.uv[told], found.arm[told], points.sigma_px[told])
    keep = reject_outliers(soundings, parameters)
    if keep.sum() < parameters.min_soundings:
        reason = f"no laser cross found: {len(points.uv)} points on lines of light, {keep.sum()} of them on the cross"
        return nothing._replace(cross=found, reason=reason)
    line = cross.whole_line(points, found, image_bgr.shape[:2])
    reach = _REACH_SIGMAS * float(np.median(points.width_px))
    line = np.concatenate([line, laser.glow(image_bgr, line, reach, points.step_px)])
    return ImageSoundings(soundings.take(keep), points, found, line, reach, "")
