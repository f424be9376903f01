"""What a picture of a board shows: its corners, and the lines of light on it or beside it."""

from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..schemas.parameters import LaserParameters
from . import corner_fit, laser
from .calibration_lines import Area, between_edges

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

_NEAR_PX: Final = 3.0
_MIN_POINTS: Final = 40
_TRIALS: Final = 1500
_VOTING: Final = 4000  # points that say which of the trials is best
_SMOOTH_PX: Final = 1.5
_DARK: Final = 20
_CLEAR_PX: Final = 20.0
_DICTIONARY: Final = "DICT_4X4_50"


class Board(NamedTuple):
    """A flat target.

    Attributes
    ----------
    kind : chessboard or charuco. columns, rows : inner corners of a chessboard, squares of a ChArUco board.
    square_m : side of a square. marker_share : side of a ChArUco marker over that of a square.
    dictionary : of its markers, as OpenCV names it.
    """

    kind: Literal["chessboard", "charuco"]
    columns: int
    rows: int
    square_m: float
    marker_share: float = 0.75
    dictionary: str = _DICTIONARY


class Light(NamedTuple):
    """Points of lines of light. uv (N, 2) pixels, sheet (N,) number of the line, sigma_px (N,)."""

    uv: Array
    sheet: NDArray[np.intp]
    sigma_px: Array


def without_light(image_bgr: NDArray[np.uint8]) -> Grey:
    """Grey levels (H, W) of blue and red: a green line across a corner would move it. Grey pictures stay as they are.

    Where blue and red show next to nothing, as far down as there is no red, all three colours are used.
    """
    blue, red = image_bgr[..., 0], image_bgr[..., 2]
    grey = cv2.addWeighted(blue, 0.5, red, 0.5, 0)
    if float(np.percentile(grey, 85)) < _DARK:
        grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, np.uint8)


def corners(grey: Grey, board: Board) -> tuple[Array, Array] | None:
    """Corners on the board (N, 3), metres, and in the image (N, 2), pixels; None where the board is not found.

    Parameters
    ----------
    grey : (H, W) uint8. For a chessboard brightness is stretched first, since a laser's glare leaves it in the dark.
    """
    if board.kind == "charuco":
        return _charuco(grey, board)
    bright = max(float(np.percentile(grey, 85)), 1.0)
    stretched = np.clip(grey.astype(np.float32) * (200 / bright), 0, 255).astype(np.uint8)
    size = board.columns, board.rows
    found = _chessboard(stretched, grey, size)
    if found is None:
        return None
    y, x = np.mgrid[: board.rows, : board.columns]
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * board.square_m
    # the stretched picture is clipped where the glare is; the fit is given all grey levels
    return flat.astype(np.float64), corner_fit.refined(grey, _oriented(found, grey, size), size)


def _chessboard(stretched: Grey, grey: Grey, size: tuple[int, int]) -> Array | None:
    """Corners to a pixel or so, by the quickest of OpenCV's ways that finds them all."""
    smooth = np.asarray(cv2.GaussianBlur(stretched, (0, 0), _SMOOTH_PX), np.uint8)
    quick = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    ways = (
        lambda: cv2.findChessboardCornersSB(stretched, size, flags=0),
        lambda: cv2.findChessboardCornersSB(smooth, size, flags=0),
        lambda: cv2.findChessboardCorners(stretched, size, flags=quick),
        lambda: cv2.findChessboardCorners(grey, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH),
        lambda: cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_EXHAUSTIVE),
    )
    for way in ways:
        done, found = way()
        if done:
            return np.asarray(found, np.float64).reshape(-1, 2)
    return None


def _oriented(uv: Array, grey: Grey, size: tuple[int, int]) -> Array:
    """The same corners (N, 2) counted from the same corner of the board in every image.

    The first square is dark and the rows go clockwise from the columns. A board with an odd sum of columns and rows
    has one such corner; another looks the same turned upside down.
    """
    grid = uv.reshape(size[1], size[0], 2)
    (a, b), (c, d) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    grid = grid if a * d - b * c > 0 else grid[::-1]
    first, next_ = (_brightness(grey, grid[:2, k : k + 2].reshape(4, 2).mean(0)) for k in (0, 1))
    return (grid if first <= next_ else grid[::-1, ::-1]).reshape(-1, 2)


def _brightness(grey: Grey, uv: Array) -> float:
    u, v = np.round(uv).astype(int)
    return float(grey[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3].mean())


def _charuco(image: Grey, board: Board) -> tuple[Array, Array] | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    marker = board.marker_share * board.square_m
    target = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, marker, dictionary)
    found, ids, _, _ = cv2.aruco.CharucoDetector(target).detectBoard(image)
    if ids is None or len(ids) < 8:
        return None
    flat = np.asarray(target.getChessboardCorners(), np.float64)[np.ravel(np.asarray(ids)).astype(np.intp)]
    return flat, np.asarray(found, np.float64).reshape(-1, 2)


def clear_of(corners: tuple[Array, Array], light_uv: Array) -> tuple[Array, Array]:
    """Those of the corners, on the board (N, 3) and in the image (N, 2), that no light (M, 2), pixels, comes near.

    A line through the neighbourhood of a corner moves it by a tenth of a pixel, ten times what others are off by. All
    are kept where fewer than half would be.
    """
    if not len(light_uv):
        return corners
    clear = KDTree(light_uv).query(corners[1])[0] > _CLEAR_PX
    return (corners[0][clear], corners[1][clear]) if 2 * clear.sum() >= len(clear) else corners


def outline(corner_uv: Array, grow: float) -> Array:
    """Polygon (M, 2) around a board's corners, grown from their middle by a share of its size."""
    hull = cv2.convexHull(np.ascontiguousarray(corner_uv, np.float32)).reshape(-1, 2).astype(np.float64)
    return hull.mean(0) + (1 + grow) * (hull - hull.mean(0))


def parallel_lines(image_bgr: NDArray[np.uint8], area: Area, count: int, p: LaserParameters) -> Light:
    """Points of `count` lines that run from top to bottom without crossing, numbered from the left.

    Parameters
    ----------
    image_bgr : (H, W, 3) or (H, W) uint8.
    area : where the light lies.

    Returns
    -------
    Light, empty where another number of lines was found.
    """
    points = laser.detect(image_bgr, p)
    keep = area.holds(points.uv)
    uv, sigma = points.uv[keep], points.sigma_px[keep]
    lines = straight_lines(uv, count)
    if len(lines) != count:
        return Light(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0))
    sheet = np.full(len(uv), -1, np.intp)
    middle = float(np.median(np.concatenate([uv[own, 1] for own in lines])))
    order = sorted(lines, key=lambda own: float(np.polyval(np.polyfit(uv[own, 1], uv[own, 0], 1), middle)))
    for number, own in enumerate(order):
        sheet[own] = number
    told = sheet >= 0
    return Light(between_edges(image_bgr, uv[told]), sheet[told], sigma[told])


def straight_lines(uv: Array, count: int) -> list[NDArray[np.intp]]:
    """Indices of the points on each of the `count` lines with most points, by RANSAC one after the other."""
    rng, left, found = np.random.default_rng(0), np.arange(len(uv)), []
    while len(found) < count and len(left) >= _MIN_POINTS:
        x = uv[left]
        a, b = rng.integers(0, len(x), (2, _TRIALS))
        d = x[b] - x[a]
        far = np.abs(d[:, 1]) > 10 * _NEAR_PX
        if not far.any():
            break
        slope = d[far, 0] / d[far, 1]
        some = x[:: max(1, len(x) // _VOTING)]
        near = np.abs(some[:, :1] - x[a[far], 0] - (some[:, 1:] - x[a[far], 1]) * slope) < _NEAR_PX
        most = int(near.sum(0).argmax())
        best = np.abs(x[:, 0] - x[a[far][most], 0] - (x[:, 1] - x[a[far][most], 1]) * slope[most]) < _NEAR_PX
        if best.sum() < _MIN_POINTS:
            break
        own = _tightened(x, best)
        found.append(left[own])
        wide = np.abs(x[:, 0] - np.polyval(np.polyfit(x[own, 1], x[own, 0], 2), x[:, 1])) < 3 * _NEAR_PX
        left = left[~(wide | own)]
    return found


def _tightened(x: Array, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points (N,) near the quadratic curve through those of a line."""
    for _ in range(4):
        off = np.abs(x[:, 0] - np.polyval(np.polyfit(x[keep, 1], x[keep, 0], 2), x[:, 1]))
        near = off < max(4 * 1.4826 * float(np.median(off[keep])), 0.5)
        if near.sum() < _MIN_POINTS:
            break
        keep = near
    return keep
