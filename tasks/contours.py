"""Contour lines of bathymetry: of a tile, and joined over tiles to those of the whole map."""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import contourpy
import numpy as np
import shapely
from numpy.typing import NDArray

from .grids import Grid, axes

Array = NDArray[np.float64]

HEIGHT_STEP_M: Final = 0.01  # of the heights by which the interval is chosen
_STEPS: Final = (1.0, 2.0, 5.0, 10.0)
_FINEST_M: Final = 0.01
_DECIMALS: Final = 6  # micrometres: two tiles compute the same point of their common edge, but for its last bits


class Contours(NamedTuple):
    """Lines of one elevation each.

    Attributes
    ----------
    elevation : (L,) m.
    first : (L + 1,) of each line its first point in xy; the last is len(xy).
    xy : (N, 2) map coordinates, m.
    """

    elevation: Array
    first: NDArray[np.int64]
    xy: Array

    def lines(self) -> Iterator[tuple[float, Array]]:
        """Elevation and points (M, 2) of each line."""
        for elevation, start, stop in zip(self.elevation.tolist(), self.first[:-1], self.first[1:], strict=True):
            yield elevation, self.xy[start:stop]


def heights(z: Array) -> dict[int, int]:
    """How many cells there are of each elevation, in whole steps of HEIGHT_STEP_M."""
    steps, counts = np.unique(np.rint(z[np.isfinite(z)] / HEIGHT_STEP_M).astype(int), return_counts=True)
    return dict(zip(steps.tolist(), counts.tolist(), strict=True))


def interval_m(counts: dict[int, int], lines: int = 12) -> float:
    """A round interval (1, 2 or 5 times a power of ten, metres) for about that many contours of the middle 98 %.

    counts : by `heights`, of all tiles together.
    """
    steps = np.array(sorted(counts), int)
    share = np.cumsum([counts[step] for step in steps.tolist()]) / max(sum(counts.values()), 1)
    low, high = (steps[np.searchsorted(share, at)] if len(steps) else 0 for at in (0.01, 0.99))
    wish = max((high - low) * HEIGHT_STEP_M / lines, _FINEST_M)
    power = 10.0 ** np.floor(np.log10(wish) + 1e-9)
    return float(power * min(_STEPS, key=lambda step: abs(np.log(step * power / wish))))


def contours(z: Array, grid: Grid, interval: float) -> Contours:
    """Contours of elevations (rows, columns), NaN for none, at whole multiples of an interval, m.

    Lines run between the centres of cells. Tiles that share a row or column of cells share the points on it.
    """
    known = z[np.isfinite(z)]
    if not known.size or min(z.shape) < 2:
        return _contours([])
    x, y = axes(grid)
    generator = contourpy.contour_generator(x, y, np.ma.masked_invalid(z))
    first, last = np.ceil(known.min() / interval), np.floor(known.max() / interval)
    levels = [round(float(k * interval), 6) for k in np.arange(first, last + 1)]
    return _contours([(level, np.asarray(line)) for level in levels for line in generator.lines(level)])


def _contours(found: Sequence[tuple[float, Array]]) -> Contours:
    lines = [np.round(line, _DECIMALS) for _, line in found]
    first = np.cumsum([0, *(len(line) for line in lines)])
    return Contours(np.array([level for level, _ in found], float), first, np.concatenate([np.zeros((0, 2)), *lines]))


def join(parts: Sequence[Contours], cell_m: float) -> Contours:
    """Contours of neighbouring tiles as those of the whole, without what does not leave a cell.

    That is noise, or the point of an extremum.
    """
    elevation = np.concatenate([np.zeros(0), *(part.elevation for part in parts)])
    length = np.concatenate([np.zeros(0, int), *(np.diff(part.first) for part in parts)])
    xy = np.concatenate([np.zeros((0, 2)), *(part.xy for part in parts)])
    lines = np.asarray(shapely.linestrings(xy, indices=np.repeat(np.arange(len(length)), length)))
    levels = np.unique(elevation)
    joined = [shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines[elevation == z]))) for z in levels]
    west, south, east, north = shapely.bounds(whole := np.concatenate([lines[:0], *joined])).reshape(-1, 4).T
    large = np.maximum(east - west, north - south) > cell_m
    kept, of = whole[large], np.repeat(levels, [len(found) for found in joined])[large]
    return Contours(of, np.cumsum([0, *shapely.get_num_coordinates(kept)]), shapely.get_coordinates(kept))
