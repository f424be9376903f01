"""How wrong a camera without refraction would be behind a flat port (acceptance of `port`)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..schemas.calibration import Camera, Laser
from .calibration_board_start import fit_sheet
from .calibration_sheets import cast_rays, line_on_floor
from .camera import normalised, outline, project, rays

Array = NDArray[np.float64]


class PinholeError(NamedTuple):
    """Error of the mean altitude, percent, by altitude (A,).

    Attributes
    ----------
    fitted_percent : with a brown camera fitted in water at the middle altitude, and sheets fitted with it.
    camera_only_percent : with that camera and the true sheets.
    """

    altitude_m: Array
    fitted_percent: Array
    camera_only_percent: Array


def brown_in_water(camera: Camera, range_m: float) -> Camera:
    """The brown camera that comes nearest to a flat-port one for things at one distance: what a board would give."""
    edge = range_m * normalised(camera, outline(camera, 2), range_m)
    low, high = edge.min(0), edge.max(0)
    x, y = np.meshgrid(np.linspace(low[0], high[0], 15), np.linspace(low[1], high[1], 11))
    X = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, range_m)])
    uv = project(camera, X)
    keep = np.isfinite(uv).all(1)

    def made(v: Array) -> Camera:
        return Camera(
            model="brown",
            width=camera.width,
            height=camera.height,
            fx=float(v[0] * camera.fx),
            fy=float(v[1] * camera.fy),
            cx=float(v[2]),
            cy=float(v[3]),
            distortion=(float(v[4]), float(v[5]), 0.0, 0.0, float(v[6])),
        )

    start = np.array([1.33, 1.33, camera.cx, camera.cy, 0.0, 0.0, 0.0])
    found = least_squares(lambda v: (project(made(v), X[keep]) - uv[keep]).ravel(), start, x_scale="jac")
    return made(found.x)


def pinhole_error(camera: Camera, laser: Laser, altitude_m: Array) -> PinholeError:
    """What the altitudes (A,) would be off by, had the camera been fitted without its port.

    The best case is taken: perfect observations, sheets fitted by total least squares to points of all altitudes on
    known floors, as in a calibration over a flat floor.
    """
    wrong = brown_in_water(camera, float(np.median(altitude_m)))
    sheets = [np.array([*sheet.normal, sheet.offset]) for sheet in laser.sheets]
    seen = [[_seen(camera, wrong, sheet, float(a)) for a in altitude_m] for sheet in sheets]
    fitted, camera_only = np.zeros(len(altitude_m)), np.zeros(len(altitude_m))
    for sheet, views in zip(sheets, seen, strict=True):
        lit = [on_floor for on_floor, _ in views if len(on_floor)]
        refitted = fit_sheet(np.concatenate(lit)) if lit else sheet
        for a, (on_floor, slopes) in enumerate(views):
            for result, used in ((fitted, refitted), (camera_only, sheet)):
                X = cast_rays(np.zeros_like(slopes), slopes, used)
                result[a] += 50 * float(np.mean(X[:, 2] - on_floor[:, 2])) / float(altitude_m[a]) if len(X) else np.nan
    return PinholeError(np.asarray(altitude_m, float), fitted, camera_only)


def _seen(camera: Camera, wrong: Camera, sheet: Array, altitude_m: float) -> tuple[Array, Array]:
    """Where the wrong camera's rays of the line on a floor meet that floor (M, 3), and these rays (M, 3)."""
    uv = project(camera, line_on_floor(camera, sheet, altitude_m))
    direction = rays(wrong, uv[np.isfinite(uv).all(1)]).direction
    return direction * (altitude_m / direction[:, 2:]), direction
