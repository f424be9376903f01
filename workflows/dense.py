"""Per pair of images: its tie points, and dense matching, reduced to map cells; how well both agree with the laser."""

import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from ..tasks import dense, dense_cells, dense_refine, laser, tiepoints
from ..tasks.dense_cells import PairCells
from ..tasks.navigation import Poses
from . import extract, match, solve
from .job import Done, Job, Made, code_version, load, once, rounded_digest, stage
from .maps_inputs import Image, MapJob, Pair, pose_digest
from .solve import Solution

TIES, STEP, AGREEMENT = "ties", "dense", "agreement"
_VERSION = code_version(sys.modules[__name__])
_WIDTH_PX = 1200  # of the images that are matched, at most; they are at least halved
_DEPTH_SHARE = 0.005  # of what is known of the depth is left out at either end
_DEPTH_MARGIN, _SPREAD_MARGIN = 0.02, 0.3  # of the depth, and of how much it varies
_IMAGES_KEPT = 12
_WITHIN_CELLS = 0.5
# where no laser tells: half a pixel of dense matching, which is on smaller images, and one of tie points
_DENSE_PX, _TIE_PX, _UNKNOWN_M = 0.5, 1.0, 1.0


class DensePair(NamedTuple):
    """Two images to match densely and the key of their tie points."""

    i: Image
    j: Image
    ties: str


_Views = Callable[[Image], tuple[np.ndarray, np.ndarray]]


def ties_batch(m: MapJob, batch: Sequence[Pair]) -> list[Done]:
    """Triangulate the matches of some pairs."""
    poses, camera = solve.solution(m.job, m.adjusted).poses, m.job.calibration.camera

    def one(pair: Pair) -> Done:
        def make() -> Made:
            points = triangulated(m.job, poses, pair.i, pair.j, pair.key)
            return Made(points._asdict(), {"points": len(points.X_local)})

        both = [pair.i, pair.j]
        inputs = [pair.key, rounded_digest(poses.R_local_camera[both], poses.C_local[both])]
        return once(m.job, TIES, _VERSION, inputs, stage(camera), make)

    return [one(pair) for pair in batch]


def triangulated(job: Job, poses: Poses, i: int, j: int, key: str) -> tiepoints.TiePoints:
    """The matches of two images, by the key of their matching."""
    arrays = load(job, match.STEP, key, ("uv_i", "uv_j")).arrays
    uv_i, uv_j = (arrays[name].astype(float) for name in ("uv_i", "uv_j"))
    return tiepoints.triangulate(job.calibration.camera, uv_i, uv_j, poses, i, j)


def dense_batch(m: MapJob, batch: Sequence[DensePair]) -> list[Done]:
    """Match some pairs densely."""
    cv2.setNumThreads(1)
    solution = solve.solution(m.job, m.adjusted)
    view = lru_cache(_IMAGES_KEPT)(lambda image: _view(m, image))

    def one(pair: DensePair) -> Done:
        inputs = [pair.i.key, pair.j.key, pair.ties, pose_digest(solution, (pair.i.row, pair.j.row))]
        parameters = [m.frame.crs, m.frame.latitude, m.frame.longitude, m.cell_m, *stage(m.job.calibration.camera)]
        return once(m.job, STEP, _VERSION, inputs, parameters, lambda: _make(m, pair, solution, view), True)

    return [one(pair) for pair in batch]


def _view(m: MapJob, image: Image) -> tuple[np.ndarray, np.ndarray]:
    """An image's grey levels, reduced, and which of its pixels the laser lights."""
    scale = _scale(m)
    bgr = extract.read_verified(m.job, image.path, image.sha256, scale)
    entry = load(m.job, extract.STEP, image.key, ("line_uv",))
    line = (entry.arrays.get("line_uv", np.zeros((0, 2))) + 0.5) / scale - 0.5
    halfwidth = entry.info["halfwidth_px"] / scale + 1
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)), laser.mask(bgr.shape[:2], line, halfwidth)


def _scale(m: MapJob) -> int:
    scale = 2
    while m.job.calibration.camera.width > _WIDTH_PX * scale:
        scale *= 2
    return scale


def _make(m: MapJob, pair: DensePair, solution: Solution, view: _Views) -> Made:
    camera, poses, (i, j) = m.job.calibration.camera, solution.poses, (pair.i.row, pair.j.row)
    known = np.concatenate([tie_points(m, pair.ties).X_local, *(sounded(m, k, solution) for k in (pair.i, pair.j))])
    nothing = Made({}, {"cells": 0, "window_m": 0.0})
    axes = dense.rectified_axes(poses, i, j)
    if not len(known) or axes is None:
        return nothing
    depth = (known - poses.C_local[i]) @ axes[:, 2]
    least, most = np.quantile(depth, (_DEPTH_SHARE, 1 - _DEPTH_SHARE))
    margin = _DEPTH_MARGIN * float(np.median(depth)) + _SPREAD_MARGIN * (most - least)
    scale = _scale(m)
    made = dense.rectify(camera, poses, i, j, (max(least - margin, 0.2), most + margin), 1 / scale)
    if made is None:
        return nothing
    sights = [dense.sight(camera, made, poses.R_local_camera[k], k == j) for k in (i, j)]
    pixels = [view(image) for image in (pair.i, pair.j)]
    warped = [dense.warp(made, seen, *of, scale) for seen, of in zip(sights, pixels, strict=True)]
    found = dense_refine.refine(dense.disparity(made, *warped), *warped)
    pixels_a_cell = m.cell_m * made.focal_px / float(np.median(depth))
    every = dense.spacing(pixels_a_cell)
    relief = dense.points(made, found, *sights, every=every)

    def to_map(X_local: np.ndarray) -> np.ndarray:
        return m.frame.map_around(X_local, poses.C_local[i])

    expected = (pixels_a_cell / every) ** 2
    cells = dense_cells.reduce_to_cells(
        to_map(relief.X_local), relief.metres_per_px, relief.noise_px, to_map(known), m.cell_m, expected
    )
    window_m = dense_refine.WINDOW_PX * m.cell_m / pixels_a_cell
    return Made(cells._asdict(), {"cells": len(cells.X_map), "window_m": round(window_m, 4)})


def sounded(m: MapJob, image: Image, solution: Solution) -> np.ndarray:
    """The laser soundings (N, 3) of an image, local."""
    X = load(m.job, extract.STEP, image.key, ("laser_X",)).arrays.get("laser_X", np.zeros((0, 3)))
    return X @ solution.poses.R_local_camera[image.row].T + solution.poses.C_local[image.row]


def tie_points(m: MapJob, key: str, pose_sigma_px: float = _TIE_PX) -> tiepoints.TiePoints:
    """The tie points of a pair that are known well enough. pose_sigma_px : what its poses may be wrong by."""
    arrays = load(m.job, TIES, key).arrays
    return tiepoints.certain(tiepoints.TiePoints(**arrays), pose_sigma_px)


def read_cells(m: MapJob, key: str) -> PairCells:
    """The cells of a densely matched pair."""
    arrays = load(m.job, STEP, key).arrays
    if not arrays:
        return dense_cells.NO_CELLS
    return PairCells(**{name: arrays[name] for name in PairCells._fields})


def agreement(m: MapJob, pairs: Sequence[tuple[DensePair, str, tuple[Image, ...]]]) -> Done:
    """How well matching agrees with the laser over some pairs.

    The info has the 1-sigma of dense matching and tie points in pixels of disparity, dense_px and tie_px, and that of
    the laser's elevations by its images' poses, laser_m (_UNKNOWN_M where nothing tells); and how wide the windows of
    dense matching are on the ground, window_m (0 without).

    pairs : each with the key of its dense matching, "" without, and the images that touch it.
    """
    solution = solve.solution(m.job, m.adjusted)

    def make() -> Made:
        dense_off, tie_off, windows = [dense_cells.NO_DIFFERENCES], [dense_cells.NO_DIFFERENCES], [0.0]
        for pair, key, around in pairs:
            near, within = solution.poses.C_local[pair.i.row], _WITHIN_CELLS * m.cell_m
            lit = [m.frame.map_around(sounded(m, image, solution), near) for image in around]
            ties = tie_points(m, pair.ties)
            there = m.frame.map_around(ties.X_local, near)
            tie_off.append(dense_cells.differences(there, ties.metres_per_px, np.concatenate(lit), within))
            if key:
                cells = read_cells(m, key)
                windows.append(load(m.job, STEP, key, ()).info["window_m"])
                X, scale = cells.X_map[cells.borne_out], cells.metres_per_px[cells.borne_out]
                dense_off += [dense_cells.departures(X, scale, soundings, m.cell_m) for soundings in lit]
        dense_m, dense_px = (np.concatenate(values) for values in zip(*dense_off, strict=True))
        tie_m, tie_px = (np.concatenate(values) for values in zip(*tie_off, strict=True))
        found = {
            "dense_px": dense_cells.share_of_each(dense_px, _DENSE_PX),
            "tie_px": dense_cells.share_of_each(tie_px, _TIE_PX),
            "window_m": float(np.median(windows[1:] or windows)),
            "laser_m": dense_cells.share_of_each(dense_m if dense_cells.tell(dense_m) else tie_m, _UNKNOWN_M),
        }
        return Made({}, {name: round(value, 4) for name, value in found.items()})

    rows = sorted({image.row for pair, _, around in pairs for image in (pair.i, pair.j, *around)})
    inputs = [pose_digest(solution, rows)]
    for pair, key, around in pairs:
        inputs += [pair.ties, key, *(image.key for image in around)]
    place = [m.frame.crs, m.frame.latitude, m.frame.longitude]
    return once(m.job, AGREEMENT, _VERSION, inputs, [*place, m.cell_m, *stage(m.job.calibration.camera)], make)


VERSIONS = dict.fromkeys((TIES, STEP, AGREEMENT), _VERSION)
