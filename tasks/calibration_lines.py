"""Lines of light on a flat thing: two that cross told apart without any calibration, rows averaged."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, LaserPlane
from ..schemas.parameters import LaserParameters
from . import laser
from .camera import normalised

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_TRIALS = 400
_NEAR_PX = 4.0
_APART_WIDTHS = 8.0
_MIN_POINTS = 30
_POINTS_A_LINE = 60
_CLIPPED = 250
_PLATEAU_PX = 4


class Area(NamedTuple):
    """The inside of a convex polygon (M, 2), pixels, or, if `beside`, all but that."""

    polygon: Array
    beside: bool = False

    def holds(self, uv: Array) -> NDArray[np.bool_]:
        """Which points (N, 2) lie in it."""
        shape = np.ascontiguousarray(self.polygon, np.float32).reshape(-1, 1, 2)
        inside = [cv2.pointPolygonTest(shape, (float(u), float(v)), False) >= 0 for u, v in uv]
        return np.array(inside, bool) != self.beside


class Lines(NamedTuple):
    """Laser points on the arms of a cross.

    Attributes
    ----------
    uv : (N, 2) pixels. arm : (N,) which sheet. sigma_px : (N,) 1-sigma of u.
    """

    uv: Array
    arm: NDArray[np.int8]
    sigma_px: Array


def no_lines() -> Lines:
    """Nothing found."""
    return Lines(np.zeros((0, 2)), np.zeros(0, np.int8), np.zeros(0))


def averaged(uv: Array, sheet: Indices, sigma_px: Array) -> tuple[Array, Indices, Array]:
    """At most sixty points of each line, each the mean of neighbours: speckle and glare of single rows average out.

    Parameters
    ----------
    uv, sheet, sigma_px : (N, 2) pixels, (N,), (N,) points of lines of light; sheet -1 is left out.

    Returns
    -------
    tuple
        uv (M, 2), sheet (M,), sigma_px (M,), as if rows erred independently; the adjustment measures by how much not.
    """
    parts = [(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0))]
    for number in np.unique(sheet[sheet >= 0]):
        own = np.flatnonzero(sheet == number)
        own = own[np.argsort(uv[own, 1], kind="stable")]
        first = np.linspace(0, len(own), min(len(own), _POINTS_A_LINE), endpoint=False).astype(int)
        size = np.diff(np.append(first, len(own)))
        mean = np.add.reduceat(uv[own], first) / size[:, None]
        sigma = np.sqrt(np.add.reduceat(sigma_px[own] ** 2, first)) / size
        parts.append((mean, np.full(len(first), number, np.intp), sigma))
    uv_, sheet_, sigma_ = (np.concatenate(column) for column in zip(*parts, strict=True))
    return uv_, sheet_, sigma_


def between_edges(image: NDArray[np.uint8], uv: Array) -> Array:
    """Points (N, 2), each that is on a broad clipped crest moved to the middle between the crest's edges.

    A line that outshines the sensor keeps its two steep edges, and nothing between them. The glare beside them is
    uneven, a third as bright as what can be shown and much wider, so that it draws any centroid to one side by a third
    of a pixel; the edges it moves by a third of that.

    Parameters
    ----------
    image : (H, W, 3) or (H, W) uint8. uv : (N, 2) pixels, on lines that cross the rows.
    """
    green = image if image.ndim == 2 else image[..., 1]
    height, width = green.shape
    row = np.clip(np.round(uv[:, 1]).astype(int), 1, height - 2)
    column = np.clip(np.round(uv[:, 0]).astype(int), 0, width - 1)
    rows, line = np.unique(row, return_inverse=True)
    level = green[rows[:, None] + np.arange(-1, 2)].mean(axis=1)
    below = level < _CLIPPED
    left = np.maximum.accumulate(np.where(below, np.arange(width), -1), axis=1)[line, column]
    right = np.minimum.accumulate(np.where(below, np.arange(width), width)[:, ::-1], axis=1)[line, width - 1 - column]
    broad = np.flatnonzero((left >= 0) & (right < width) & (right - left > _PLATEAU_PX))
    line, left, right = line[broad], left[broad], right[broad]
    inward = [
        (_CLIPPED - level[line, at]) / (level[line, at + side] - level[line, at])
        for at, side in ((left, 1), (right, -1))
    ]
    moved = uv.copy()
    moved[broad] = np.column_stack([0.5 * (left + inward[0] + right - inward[1]), row[broad]])
    return moved


def rising(sheet: LaserPlane) -> bool:
    """Whether the sheet's line on level ground goes down to the right in the image (y grows with x)."""
    return -sheet.normal[0] / sheet.normal[1] > 0


def cross_on_flat(
    image_bgr: NDArray[np.uint8],
    camera: Camera,
    sheets: tuple[LaserPlane, LaserPlane],
    parameters: LaserParameters,
    area: Area | None = None,
) -> Lines:
    """The two lines of a cross on a flat surface.

    Of the sheets only the direction in which each leans is used, so they may be wrong by many degrees. The lines are
    straight in slopes x/z, y/z (slightly bent behind a flat port); what is off them, and the crossing itself, is left.

    Parameters
    ----------
    image_bgr : (H, W, 3) uint8. area : where the surface is, which one line alone may meet; None: everywhere, and there
        is nothing unless both do.
    """
    points = laser.detect(image_bgr, parameters)
    if area is not None:
        points = points.take(area.holds(points.uv))
    if len(points.uv) < _MIN_POINTS:
        return no_lines()
    x = normalised(camera, points.uv) * camera.fx
    found = [_line(x, down_right, np.random.default_rng(0)) for down_right in (True, False)]
    curves = [None if keep is None else _curve(x, keep) for keep in found]
    if area is None and None in curves:
        return no_lines()
    width = float(np.median(points.width_px))
    across = [x[:, 0] - curve(x[:, 1]) for curve in curves if curve is not None]
    apart = np.ptp(across, axis=0) > max(_APART_WIDTHS * width, 8.0 * points.step_px) if len(across) > 1 else True
    arm = np.full(len(x), -1, np.int8)
    for curve, down_right in zip(curves, (True, False), strict=True):
        if curve is None:
            continue
        off = np.abs(x[:, 0] - curve(x[:, 1]))
        near = off < _NEAR_PX
        spread = 1.4826 * float(np.median(off[near])) if near.any() else 0.0
        own = 0 if rising(sheets[0]) == down_right else 1
        arm[(off < max(4 * spread, 0.5)) & apart] = own
    told = arm >= 0
    return Lines(points.uv[told], arm[told], points.sigma_px[told])


def _line(x: Array, down_right: bool, rng: np.random.Generator) -> NDArray[np.bool_] | None:
    """Points (N,) on the line with most points that leans the given way, by RANSAC; None where there is none."""
    a, b = rng.integers(0, len(x), (2, _TRIALS))
    d = x[b] - x[a]
    far = np.hypot(*d.T) > 20 * _NEAR_PX
    leans = (d[:, 0] * d[:, 1] > 0) == down_right
    steep = np.abs(d[:, 1]) > 0.1 * np.abs(d[:, 0])
    a, d = a[far & leans & steep], d[far & leans & steep]
    if not len(a):
        return None
    slope = d[:, 0] / d[:, 1]
    off = np.abs(x[:, :1] - x[a, 0] - (x[:, 1:] - x[a, 1]) * slope) / np.hypot(1, slope)
    best = int((off < _NEAR_PX).sum(0).argmax())
    keep = off[:, best] < _NEAR_PX
    return keep if keep.sum() >= _MIN_POINTS else None


def _curve(x: Array, keep: NDArray[np.bool_]) -> np.polynomial.Polynomial:
    """x as a quadratic function of y, refitted to what is near it."""
    for _ in range(4):
        curve = np.polynomial.Polynomial.fit(x[keep, 1], x[keep, 0], 2)
        off = np.abs(x[:, 0] - curve(x[:, 1]))
        near = keep & (off < max(4 * 1.4826 * float(np.median(off[keep])), 0.5))
        if near.sum() < _MIN_POINTS:
            break
        keep = near
    return np.polynomial.Polynomial.fit(x[keep, 1], x[keep, 0], 2)
