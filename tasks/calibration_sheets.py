"""Sheets of light as unknowns, their covariance, and what an error of them does to altitudes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, CovarianceBlock, LaserPlane
from .camera import normalised, outline

Array = NDArray[np.float64]


class SheetBasis(NamedTuple):
    """A sheet from which small changes are measured: two turns about its point nearest the emitter, and a shift.

    Attributes
    ----------
    name : of the sheet. anchor : (3,) point of the sheet, camera frame, metres.
    normal : (3,). tangents : (2, 3) unit vectors in the sheet.
    """

    name: str
    anchor: Array
    normal: Array
    tangents: Array


def basis(sheet: LaserPlane, origin: Sequence[float]) -> SheetBasis:
    """Changes of a sheet of light whose emitter is at `origin` (3,), camera frame, metres."""
    normal = np.asarray(sheet.normal, float)
    length = float(np.linalg.norm(normal))
    normal, offset = normal / length, sheet.offset / length
    emitter = np.asarray(origin, float)
    anchor = emitter + (offset - normal @ emitter) * normal
    first = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    return SheetBasis(sheet.name, anchor, normal, np.stack([first, np.cross(normal, first)]))


def moved(start: SheetBasis, step: Array) -> Array:
    """Normal and offset (4,) of a sheet turned by step[:2] (radians) and shifted by step[2] (metres)."""
    normal = start.normal + step[0] * start.tangents[0] + step[1] * start.tangents[1]
    normal = normal / np.linalg.norm(normal)
    return np.append(normal, normal @ start.anchor + step[2])


def as_plane(name: str, sheet: Array) -> LaserPlane:
    """The model of normal and offset (4,)."""
    x, y, z, offset = (float(v) for v in sheet)
    return LaserPlane(name=name, normal=(x, y, z), offset=offset)


def step_jacobian(start: SheetBasis, step: Array) -> Array:
    """Change (4, 3) of normal and offset by the step."""
    h = 1e-6
    columns = [(moved(start, step + h * e) - moved(start, step - h * e)) / (2 * h) for e in np.eye(3)]
    return np.stack(columns, axis=1)


def sheet_names(name: str) -> tuple[str, ...]:
    """Names of a sheet's four numbers in a covariance block."""
    return tuple(f"laser.planes.{name}.{part}" for part in ("normal.x", "normal.y", "normal.z", "offset"))


def block(names: Sequence[str], covariance: Array) -> CovarianceBlock:
    """A covariance block; symmetric to the last digit."""
    symmetric = 0.5 * (covariance + covariance.T)
    return CovarianceBlock(parameters=tuple(names), matrix=tuple(tuple(float(v) for v in row) for row in symmetric))


def cast_rays(origin: Array, direction: Array, sheet: Array) -> Array:
    """Points (N, 3) where rays (N, 3), (N, 3) meet sheets given as normal and offset (4,) or (N, 4)."""
    normal, offset = sheet[..., :3], sheet[..., 3]
    toward = (direction * normal).sum(-1)
    distance = (offset - (origin * normal).sum(-1)) / np.where(np.abs(toward) < 1e-12, np.nan, toward)
    return origin + distance[:, None] * direction


def line_on_floor(camera: Camera, sheet: Array, altitude_m: float, count: int = 60) -> Array:
    """Points (M, 3), camera frame, of a sheet on a floor square to the optical axis, as far as the camera sees it.

    Parameters
    ----------
    sheet : (4,) normal and offset.
    altitude_m : distance of the floor along the axis.
    """
    edge = altitude_m * normalised(camera, outline(camera, 9), altitude_m)
    low, high = edge.min(0), edge.max(0)
    Y = np.linspace(low[1], high[1], count)
    X = (sheet[3] - sheet[2] * altitude_m - sheet[1] * Y) / sheet[0]
    seen = (low[0] < X) & (high[0] > X)
    return np.column_stack([X, Y, np.full(count, altitude_m)])[seen]


def altitude_error(camera: Camera, sheet: Array, wrong: Array, altitude_m: float) -> float:
    """Mean error of altitude, metres, where a floor lit by `sheet` is triangulated with `wrong`, both (4,).

    NaN where the camera does not see the sheet on the floor.
    """
    X = line_on_floor(camera, sheet, altitude_m)
    if not len(X):
        return float("nan")
    # to first order: the sheet at the point is off by so much, and the ray closes the gap along itself
    gap = wrong[3] - X @ wrong[:3]
    direction = X / np.linalg.norm(X, axis=1, keepdims=True)
    step = gap / (direction @ wrong[:3])
    return float(np.mean(step * direction[:, 2]))


class Sensitivity(NamedTuple):
    """What calibration errors do to the mean altitude over level ground.

    Attributes
    ----------
    altitude_m : (A,). gradient : (A, 8) metres per unit of the two sheets' normals and offsets, as in the covariance.
    """

    altitude_m: Array
    gradient: Array

    def sigma_m(self, covariance: Array) -> Array:
        """1-sigma (A,) of the mean altitude for a covariance (8, 8) of both sheets."""
        variance = np.einsum("ai,ij,aj->a", self.gradient, covariance, self.gradient)
        return np.sqrt(np.maximum(variance, 0))


def sensitivity(camera: Camera, sheets: Sequence[LaserPlane], altitude_m: Array) -> Sensitivity:
    """Change of the altitude, the mean over the arms in view, with each number of both sheets; NaN where none is."""
    h, size = 1e-6, 4 * len(sheets)
    gradient = np.zeros((len(altitude_m), size))
    for s, plane in enumerate(sheets):
        true = np.array([*plane.normal, plane.offset])
        for k in range(4):
            step = h * np.eye(4)[k]
            for a, altitude in enumerate(altitude_m):
                up, down = (altitude_error(camera, true, true + sign * step, float(altitude)) for sign in (1, -1))
                gradient[a, 4 * s + k] = (up - down) / (2 * h)
    seen = np.isfinite(gradient).reshape(len(altitude_m), len(sheets), 4).all(2).sum(1)
    mean = np.nan_to_num(gradient) / np.where(seen, seen, np.nan)[:, None]
    return Sensitivity(np.asarray(altitude_m, float), mean)


def angle_deg(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle between two planes by their normals, degrees, whichever way these point."""
    a_, b_ = np.asarray(a, float), np.asarray(b, float)
    cross = np.linalg.norm(np.cross(a_, b_))
    return float(np.degrees(np.arctan2(cross, abs(a_ @ b_))))
