"""The two arms of the laser cross in an image, roughly: one curve on each known sheet of light.

The image is reduced (rows are sampled, columns averaged) and its channels weighed so that what stands out is the
laser's colour, not the bottom's. Peaks along the rows are then linked on each sheet by itself: in inverse depth on
its own sheet a line follows the bottom, on the other sheet it would be a cliff, so that pieces of line tell their
arm. The best chain of pieces is found by dynamic programming: points speak for a piece, jumps in depth against it.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, Laser
from ..schemas.parameters import LaserParameters
from .laser_colour import evidence
from .medians import median
from .sheet_grid import on_sheets

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

_WIDTH_PX, _ROWS = 600, 300
_SMALLEST_PX: Final = 100
# Widths of the box that sums up the line, pixels of the reduced image.
_BOXES: Final = (1, 3, 5, 9, 15)
# Neighbours on a chain: so many rows apart at most, and so many columns apart for the noise; and so much slope.
_REACH_ROWS: Final = 3
_NOISE_PX: Final = 1.0
_SLOPE: Final = 0.6
_STEEP: Final = 1.5
# A chain is cut where it climbs so steeply for so many points.
_CLIFF: Final = 1.25
_CLIFF_POINTS: Final = 4
# Points, of 900 rows, that a jump costs: by the whole range; and any jump.
_JUMP_POINTS: Final = 80.0
_STEP_POINTS: Final = 6.0
# What texture alone does not reach, points of 900 rows: in one piece, and in all pieces of an arm.
_LONG_POINTS, _MANY_POINTS = 45.0, 160.0
_PIECES: Final = 250
# Share of an arm's points that it may lose to the other without being sought anew: those at the crossing.
_FEW_LOST: Final = 0.1


class Reduced(NamedTuple):
    """An image made small: rows sampled, columns averaged.

    Attributes
    ----------
    image : (h, w, 3) or (h, w), uint8.
    factor : columns of the full image to one of this.
    row_step : rows of the full image from one row of this to the next.
    first_column : of the full image that is in this.
    """

    image: NDArray[np.uint8]
    factor: int
    row_step: int
    first_column: int = 0

    @property
    def origin_uv(self) -> Array:
        """Pixel (2,) of the full image in the middle of the first pixel of this."""
        return np.array([self.first_column + 0.5 * (self.factor - 1), (self.row_step - 1) // 2])

    @property
    def pitch_uv(self) -> Array:
        """Pixels (2,) of the full image from column to column and from row to row."""
        return np.array([float(self.factor), float(self.row_step)])


class Peaks(NamedTuple):
    """Places where a row of the reduced image crosses something like a line, sorted by row.

    Attributes
    ----------
    row : (N,) rows of the reduced image.
    u, v : (N,) pixels of the full image.
    strength : (N,) height of the line over the scatter of heights around it.
    """

    row: Indices
    u: Array
    v: Array
    strength: Array

    def take(self, keep: NDArray) -> "Peaks":
        """The peaks that a mask or an index array (N,) selects."""
        return Peaks(self.row[keep], self.u[keep], self.v[keep], self.strength[keep])


class Piece(NamedTuple):
    """An unbroken piece of an arm: its pixels in the full image, (n,) each, from top to bottom."""

    u: Array
    v: Array


class Arms(NamedTuple):
    """What was found.

    Attributes
    ----------
    pieces : of each sheet, from top to bottom.
    box_px : the width of the line along the rows, roughly, pixels of the full image.
    """

    pieces: tuple[list[Piece], list[Piece]]
    box_px: float


def reduce(image_bgr: NDArray[np.uint8]) -> Reduced:
    """An image (H, W[, 3]) about 600 pixels wide, of about 300 rows."""
    factor = max(1, round(image_bgr.shape[1] / _WIDTH_PX))
    row_step = max(1, round(image_bgr.shape[0] / _ROWS))
    # rows far apart in memory get into each other's way: copied once, then averaged
    rows = np.ascontiguousarray(image_bgr[(row_step - 1) // 2 :: row_step][: image_bgr.shape[0] // row_step])
    if factor == 1:
        return Reduced(rows, 1, row_step)
    if factor % 2:
        size = (rows.shape[1] // factor, len(rows))
        narrow = cv2.resize(rows[:, : size[0] * factor], size, interpolation=cv2.INTER_AREA)
        return Reduced(np.asarray(narrow, np.uint8), factor, row_step)
    return Reduced(_pairs_averaged(rows, factor), factor, row_step, factor // 2 - 1)


def _pairs_averaged(rows: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Means over an even number of columns, from column factor / 2 - 1 on: faster than cv2.INTER_AREA.

    Linear interpolation in the middle between two columns is their mean; one pair of each group after the other.
    """
    width = (rows.shape[1] - factor + 2) // factor
    mean = np.zeros(0, np.uint8)
    for k in range(factor // 2):
        part = rows[:, 2 * k : 2 * k + width * factor]
        pair = np.asarray(cv2.resize(part, (width, len(rows)), interpolation=cv2.INTER_LINEAR), np.uint8)
        mean = np.asarray(cv2.addWeighted(mean, k / (k + 1), pair, 1 / (k + 1), 0), np.uint8) if k else pair
    return mean


def search(small: Reduced, camera: Camera, light: Laser, parameters: LaserParameters) -> Arms:
    """Find both arms.

    Parameters
    ----------
    small : the reduced image.
    camera, light : which sheets the arms lie on.
    parameters : range window, gamma and thresholds.
    """
    if min(small.image.shape[:2]) < _SMALLEST_PX:
        return Arms(([], []), 1.0)
    seen = evidence(small.image, parameters.gamma)
    box = _best_box(seen)
    peaks = _peaks(seen, box, small, parameters)
    inverse_depth = on_sheets(camera, light, peaks.u, peaks.v).inverse_depth
    found = _both(peaks, inverse_depth, small, parameters)
    pieces = [[_piece(peaks, m) for m in arm.members] if _seen(arm) else [] for arm in found]
    return Arms((pieces[0], pieces[1]), float(box * small.factor))


def _seen(arm: "_Arm") -> bool:
    """Whether there is an arm: texture makes short pieces, and few that follow each other."""
    return max(arm.gains, default=0.0) > _LONG_POINTS or sum(arm.gains) > _MANY_POINTS


def _both(
    peaks: Peaks, inverse_depth: tuple[Array, Array], small: Reduced, parameters: LaserParameters
) -> list["_Arm"]:
    """Both arms; a peak that both claim goes to the piece that has more to say for itself."""
    everything = np.arange(len(peaks.row))
    found = [_arm(peaks, q, everything, small, parameters) for q in inverse_depth]
    claim = np.zeros((2, len(peaks.row)))
    for number, arm in enumerate(found):
        for members, gain in zip(arm.members, arm.gains, strict=True):
            claim[number, members] = gain
    for number, q in enumerate(inverse_depth):
        lost = (claim[number] > 0) & (claim[number] <= claim[1 - number] - number * 1e-9)
        if lost.sum() > _FEW_LOST * (claim[number] > 0).sum():
            found[number] = _arm(peaks, q, np.flatnonzero(~lost), small, parameters)
        elif lost.any():
            own = found[number]
            found[number] = _Arm([m[~lost[m]] if (~lost[m]).sum() > 2 else m for m in own.members], own.gains)
    return found


def _lobes(seen: Floats, box: int) -> tuple[Floats, Floats]:
    """How far the mean over a box (h, w) is above the higher one, and above the mean, of the boxes to both sides."""
    mean = cv2.blur(seen, (box, 1), borderType=cv2.BORDER_REPLICATE) if box > 1 else seen
    shift = box + (box + 1) // 2
    wide = cv2.copyMakeBorder(mean, 0, 0, shift, shift, cv2.BORDER_REPLICATE)
    left, right = wide[:, : -2 * shift], wide[:, 2 * shift :]
    return np.asarray(mean - cv2.max(left, right), np.float32), np.asarray(mean - 0.5 * (left + right), np.float32)


def _best_box(seen: Floats) -> int:
    """The box that the line fills best: where the strongest peak of a row stands highest above the scatter."""
    rows = np.ascontiguousarray(seen[4::16])
    strength = []
    for box in _BOXES:
        if 6 * box > seen.shape[1]:
            break
        height, scatter = _lobes(rows, box)
        strength.append(median(height.max(axis=1)) / max(median(np.abs(scatter[:, ::3])), 1e-6))
    return _BOXES[int(np.argmax(strength))]


def _peaks(seen: Floats, box: int, small: Reduced, parameters: LaserParameters) -> Peaks:
    height, scatter = _lobes(seen, box)
    strength = height / _local_scatter(scatter)
    top = cv2.dilate(strength, np.ones((1, 2 * (box // 2 + 1) + 1), np.uint8))
    mask = (strength >= top) & (strength > parameters.peak_sigmas)
    mask[:, 0] = mask[:, -1] = False
    place = np.flatnonzero(mask)
    before, at, after = (height.ravel()[place + k].astype(float) for k in (-1, 0, 1))
    bend = np.maximum(2 * at - before - after, 1e-9)
    row, column = np.divmod(place, mask.shape[1])
    column = column + np.clip(0.5 * (after - before) / bend, -0.5, 0.5)
    (first_u, first_v), (step_u, step_v) = small.origin_uv, small.pitch_uv
    return Peaks(row, column * step_u + first_u, row * step_v + first_v, strength.ravel()[place].astype(float))


def _local_scatter(scatter: Floats) -> Floats:
    """Robust 1-sigma (h, w) of heights around each pixel, not below a third of that of the whole image."""
    # of every other row: a mean over 128 pixels is sure enough
    size = np.abs(scatter[::2])
    usual = max(median(size[1::3, 1::5]), 1e-5)
    cells = (max(scatter.shape[1] // 16, 8), max(scatter.shape[0] // 16, 8))
    mean = cv2.resize(np.minimum(size, np.float32(4 * usual)), cells, interpolation=cv2.INTER_AREA)
    # a mean of sizes is 0.8 sigma
    sigma = np.maximum(1.25 * cv2.GaussianBlur(mean, (0, 0), 2.0), 0.5 * usual)
    return np.asarray(cv2.resize(sigma, scatter.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


# ------------------------------------------------------------------------------------------------ one arm


class _Arm(NamedTuple):
    """Pieces of one arm, as indices of peaks sorted by row, and what speaks for each, points of 900 rows."""

    members: list[Indices]
    gains: list[float]


def _arm(peaks: Peaks, inverse_depth: Array, usable: Indices, small: Reduced, parameters: LaserParameters) -> _Arm:
    """The best chain of pieces of line on one sheet, made of usable peaks."""
    q = inverse_depth[usable]
    own = usable[(q > 1 / parameters.range_max_m) & (q < 1 / parameters.range_min_m)]
    if len(own) < parameters.chain_min_points:
        return _Arm([], [])
    place = np.zeros(len(inverse_depth))
    place[own] = _in_columns(peaks.take(own), inverse_depth[own], small.factor)
    # what is a slope in the full image is so much steeper where rows are farther apart than columns
    stretch, points = small.row_step / small.factor, 900 / len(small.image)
    chain = _without_cliffs(_linked(peaks.row[own], place[own], stretch), peaks.row[own], place[own], stretch)
    length = np.bincount(chain)
    # of texture everywhere, the longest pieces
    enough = max(parameters.chain_min_points, int(np.sort(length)[-_PIECES:][0]))
    members = [own[m] for m in _groups(chain, length >= enough)]
    if not members:
        return _Arm([], [])
    typical = _typical_strength(peaks.strength, members)
    ends = np.array([[*peaks.row[m[[0, -1]]], *_end_values(place[m])] for m in members])
    gain = np.array([np.minimum(peaks.strength[m] / typical, 1).sum() for m in members])
    # a piece of the other arm looks steep
    steep = np.abs(ends[:, 3] - ends[:, 2]) / (ends[:, 1] - ends[:, 0])
    gain *= np.maximum(1 - steep / (_STEEP * stretch), 0) * points
    path = _best_path(gain, ends, points, stretch)
    return _Arm([members[k] for k in path], [float(gain[k]) for k in path])


def _in_columns(peaks: Peaks, inverse_depth: Array, factor: int) -> Array:
    """Place (N,) on the sheet in columns of the reduced image: inverse depth over its change from one to the next."""
    few = slice(None, None, max(1, len(peaks.u) // 400))
    design = np.column_stack([np.ones(len(peaks.u[few])), peaks.u[few], peaks.v[few]])
    per_px = abs(float(np.linalg.lstsq(design, inverse_depth[few], rcond=None)[0][1]))
    return inverse_depth / max(per_px * factor, 1e-12)


def _linked(row: Indices, place: Array, stretch: float) -> Indices:
    """Number of the chain (N,) that each point is on: points of near rows that are each other's nearest hang together.

    Parameters
    ----------
    row : (N,) sorted.
    place : (N,) along the row, on the sheet, columns of the reduced image.
    stretch : distance of rows over that of columns.
    """
    count = len(row)
    scale = 4 * (float(np.ptp(place)) + 10)
    key = row * scale + (place - place.min())
    order = np.argsort(key)
    key = key[order]
    below, above = np.full(count, -1), np.full(count, -1)
    for gap in range(1, _REACH_ROWS + 1):
        start, goal = np.flatnonzero(below < 0), np.flatnonzero(above < 0)
        reach = _NOISE_PX + _SLOPE * stretch * gap
        down, up = (
            _nearest(key[start] + gap * scale, key[goal], reach),
            _nearest(key[goal] - gap * scale, key[start], reach),
        )
        mutual = np.flatnonzero((down >= 0) & (up[down] == np.arange(len(start))))
        below[start[mutual]], above[goal[down[mutual]]] = goal[down[mutual]], start[mutual]
    chain = np.empty(count, np.intp)
    chain[order] = _tops(above)
    return chain


def _tops(above: Indices) -> Indices:
    """Number of the topmost point (N,) of each point's chain; above: the next one up, -1 for none."""
    top = np.where(above < 0, np.arange(len(above)), above)
    # each round doubles how far a point sees
    while True:
        higher = top[top]
        if np.array_equal(higher, top):
            return (np.cumsum(above < 0) - 1)[top]
        top = higher


def _without_cliffs(chain: NDArray, row: Indices, place: Array, stretch: float) -> NDArray:
    """Chains (N,) cut where they turn off as steeply as the other arm does: there one runs on along the other.

    Points of the steep stretch have chains of their own.
    """
    order = np.lexsort((row, chain))
    ahead, behind = order[_CLIFF_POINTS:], order[:-_CLIFF_POINTS]
    steep = np.abs(place[ahead] - place[behind]) > _CLIFF * stretch * (row[ahead] - row[behind])
    steep = np.flatnonzero(steep & (chain[ahead] == chain[behind]))
    alone = np.zeros(len(row), bool)
    for k in range(_CLIFF_POINTS + 1):
        alone[steep + k] = True
    change = (np.diff(chain[order]) != 0) | alone[1:] | alone[:-1]
    cut = np.empty(len(row), np.intp)
    cut[order] = np.concatenate([[0], np.cumsum(change)])
    return cut


def _nearest(wanted: Array, key: Array, reach: float) -> Indices:
    """For each wanted value the index of the nearest of sorted keys, -1 where that is farther than reach."""
    if not len(key):
        return np.full(len(wanted), -1)
    place = np.searchsorted(key, wanted)
    left, right = np.maximum(place - 1, 0), np.minimum(place, len(key) - 1)
    nearest = np.where(np.abs(key[left] - wanted) < np.abs(key[right] - wanted), left, right)
    return np.where(np.abs(key[nearest] - wanted) <= reach, nearest, -1)


def _groups(chain: NDArray, wanted: NDArray[np.bool_]) -> list[Indices]:
    """Indices of the members of each wanted chain, in the order of the points."""
    members = np.flatnonzero(wanted[chain])
    members = members[np.argsort(chain[members], kind="stable")]
    return np.split(members, np.flatnonzero(np.diff(chain[members])) + 1) if len(members) else []


def _typical_strength(strength: Array, members: list[Indices]) -> float:
    """Median strength of points, each counted as often as its chain has points: that of the line, if there is one."""
    value = np.concatenate([strength[m] for m in members])
    weight = np.concatenate([np.full(len(m), float(len(m))) for m in members])
    order = np.argsort(value)
    heap = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(heap, 0.5 * heap[-1])])


def _end_values(value: Array) -> tuple[float, float]:
    """Middle values of the first and the last five."""
    first, last = sorted(value[:5].tolist()), sorted(value[-5:].tolist())
    return first[len(first) // 2], last[len(last) // 2]


def _best_path(gain: Array, ends: Array, scale: float, stretch: float) -> list[int]:
    """Pieces that follow each other down the image, most points for fewest jumps: dynamic programming.

    Parameters
    ----------
    gain : (M,) what speaks for each piece, points.
    ends : (M, 4) first and last row; place on the sheet there, columns of the reduced image.
    scale : points to a row.
    stretch : distance of rows over that of columns.
    """
    order = np.argsort(ends[:, 0], kind="stable")
    gain, (top, bottom, at_top, at_bottom) = gain[order], ends[order].T
    best, previous = gain.copy(), np.full(len(gain), -1)
    for k in range(1, len(gain)):
        jump = np.abs(at_top[k] - at_bottom[:k])
        gap = top[k] - bottom[:k]
        # what a bottom without steps may do in between costs nothing
        sudden = np.maximum(jump - _NOISE_PX - _SLOPE * stretch * np.maximum(gap, 1), 0)
        cost = _JUMP_POINTS * jump / np.minimum(at_top[k], at_bottom[:k]) + _STEP_POINTS * np.minimum(sudden, 1)
        total = best[:k] - cost - np.maximum(1 - gap, 0) * scale
        total[bottom[:k] >= bottom[k]] = -np.inf
        i = int(np.argmax(total))
        if total[i] > 0:
            best[k], previous[k] = gain[k] + total[i], i
    path = [int(np.argmax(best))]
    while previous[path[-1]] >= 0:
        path.append(int(previous[path[-1]]))
    return [int(order[k]) for k in reversed(path)]


def _piece(peaks: Peaks, members: Indices) -> Piece:
    """A chain's pixels, one a row, smoothed over three rows."""
    u, v = peaks.u[members], peaks.v[members]
    u = np.concatenate([[2 * u[0] - u[1]], u, [2 * u[-1] - u[-2]]])
    return Piece(np.convolve(u, np.full(3, 1 / 3), "valid"), v)
