"""Per map tile: soundings to cells, cells to surface. What touches a tile decides its digest."""

import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..tasks import gridding, grids, surface, tiepoints
from ..tasks.frames import MapFrame
from ..tasks.gridding import LASER, MATCHING, Cells
from ..tasks.grids import Grid
from ..tasks.surface import Growth
from . import extract, match, solve
from .job import Done, Job, Made, array_digest, code_version, load, once, stage
from .solve import Solution

CELLS, GROWTH, SURFACE = "cells", "growth", "surface"
_VERSION = code_version(sys.modules[__name__])
_LEAST_HALO = 6  # cells


class Image(NamedTuple):
    """An image as the maps need it.

    Attributes
    ----------
    row : of the frames table and of trajectory.csv. path, sha256 : of the file. key : of its extraction.
    texture : whether it shows the seabed and not only the laser. range_m : height above the seabed.
    """

    row: int
    path: str
    sha256: str
    key: str
    texture: bool
    range_m: float


class Pair(NamedTuple):
    """Two linked images and the key of their match."""

    i: int
    j: int
    key: str


class Tile(NamedTuple):
    """A tile and what touches it."""

    grid: Grid
    images: tuple[Image, ...]
    pairs: tuple[Pair, ...] = ()


class MapJob(NamedTuple):
    """What the map tasks know besides the job: the frame, the adjusted poses, the interpolation's reach."""

    job: Job
    frame: MapFrame
    adjusted: str
    max_interpolation_m: float


def cells_tile(m: MapJob, tile: Tile) -> Done:
    """Soundings and tie points of a tile, gridded."""
    solution = solve.solution(load(m.job, solve.STEP, m.adjusted))
    inputs = [f"{image.row}:{image.key}" for image in tile.images] + [pose_digest(solution, tile)]
    inputs += [f"{pair.i}-{pair.j}:{pair.key}" for pair in tile.pairs]

    def make() -> Made:
        parts = [_NO_PART, *(_laser(m, image, solution) for image in tile.images)]
        parts += [_matched(m, pair, solution) for pair in tile.pairs]
        X, sigma, source, frame, pose_sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
        X_map = m.frame.map_from_local(X)
        cells = gridding.grid_soundings(tile.grid, X_map, sigma, source.astype(np.uint8), frame, pose_sigma)
        return Made(cells._asdict(), {"sounded": int((cells.density > 0).sum())})

    return once(m.job, CELLS, _VERSION, inputs, context(m, tile), make, compress=True)


def context(m: MapJob, tile: Tile) -> list[Any]:
    """Where a tile lies and what its images were taken with, as it enters its digest."""
    place = [m.frame.crs, m.frame.latitude, m.frame.longitude]
    return [list(tile.grid), place, *stage(m.job.calibration.camera)]


def pose_digest(solution: Solution, tile: Tile) -> str:
    """Digest of the poses of the images that touch a tile."""
    rows = sorted({image.row for image in tile.images} | {k for pair in tile.pairs for k in (pair.i, pair.j)})
    poses = solution.poses
    values = poses.R_local_camera[rows], poses.C_local[rows], solution.sigma_m[rows], solution.sigma_tilt_rad[rows]
    return array_digest(*(np.round(value, 9) for value in values))


Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
_NO_PART: Part = (np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0, int), np.zeros(0))


def _laser(m: MapJob, image: Image, solution: Solution) -> Part:
    """Local points, sigma, source, frame and the sigma they share through their image's pose."""
    arrays = load(m.job, extract.STEP, image.key, ("laser_X", "laser_sigma")).arrays
    X_camera = arrays.get("laser_X", np.zeros((0, 3)))
    count, poses = len(X_camera), solution.poses
    X = X_camera @ poses.R_local_camera[image.row].T + poses.C_local[image.row]
    lean = np.hypot(X_camera[:, 0], X_camera[:, 1]) * solution.sigma_tilt_rad[image.row]
    shared = np.hypot(solution.sigma_m[image.row, 2], lean)
    sigma = arrays.get("laser_sigma", np.zeros(0))
    return X, sigma, np.full(count, LASER), np.full(count, image.row), shared


def _matched(m: MapJob, pair: Pair, solution: Solution) -> Part:
    entry = load(m.job, match.STEP, pair.key)
    covariance = entry.arrays["covariance"].copy()
    if not entry.info["metric"]:  # stated for a baseline of unit length
        baseline = float(np.linalg.norm(solution.poses.C_local[pair.j] - solution.poses.C_local[pair.i]))
        covariance[3:] *= baseline
        covariance[:, 3:] *= baseline
    points = tiepoints.triangulate(
        m.job.calibration.camera,
        entry.arrays["uv_i"].astype(float),
        entry.arrays["uv_j"].astype(float),
        solution.poses,
        pair.i,
        pair.j,
        covariance,
    )
    count = len(points.X_local)
    shared = np.hypot(solution.sigma_m[pair.i, 2], points.common_sigma_m)
    return points.X_local, points.sigma_m, np.full(count, MATCHING), np.full(count, pair.i), shared


def fit_growth(m: MapJob, tiles: Sequence[tuple[Grid, Done]]) -> Done:
    """How interpolation errs on this seabed, from soundings held out in some of its tiles."""

    def make() -> Made:
        found = [
            surface.hold_out(grid, _cells(m.job, grid, [(grid, done)]), m.max_interpolation_m) for grid, done in tiles
        ]
        joined = surface.Holdout(*(np.concatenate(column) for column in zip(*found, strict=True)))
        return Made({}, surface.fit_growth(joined)._asdict())

    inputs = [done.key for _, done in tiles]
    return once(m.job, GROWTH, _VERSION, inputs, [m.max_interpolation_m], make)


def surface_tile(m: MapJob, tile: Grid, neighbours: Sequence[tuple[Grid, Done]], growth: Done) -> Done:
    """The Delaunay surface of a tile from the cells of the tiles around it."""
    law = Growth(*(growth.info[name] for name in Growth._fields))
    inputs = [done.key for _, done in neighbours]

    def make() -> Made:
        halo = grids.pad(tile, surface.halo_cells(m.max_interpolation_m, tile.cell_m))
        cells = _cells(m.job, halo, neighbours)
        found = surface.delaunay_surface(halo, cells, m.max_interpolation_m, law)
        inner = grids.window(halo, tile)
        layers = {
            "elevation": found.elevation.astype(np.float32),
            "sigma": found.sigma.astype(np.float32),
            "density": cells.density.astype(np.uint32),
            "source": found.source,
        }
        cut = {name: values[inner] for name, values in layers.items()}
        return Made(cut, {"cells": int(np.isfinite(cut["elevation"]).sum())})

    parameters = [list(tile), m.max_interpolation_m, list(law)]
    return once(m.job, SURFACE, _VERSION, inputs, parameters, make, compress=True)


def _cells(job: Job, grid: Grid, tiles: Sequence[tuple[Grid, Done]]) -> Cells:
    empty = Cells(
        elevation=np.full(grid.shape, np.nan),
        sigma=np.full(grid.shape, np.nan),
        density=np.zeros(grid.shape, np.int32),
        source=np.zeros(grid.shape, np.uint8),
        x=np.full(grid.shape, np.nan),
        y=np.full(grid.shape, np.nan),
    )
    for tile, done in tiles:
        entry = load(job, CELLS, done.key)
        for name, values in empty._asdict().items():
            paste(grid, values, tile, entry.arrays[name])
    return empty


def paste(grid: Grid, values: np.ndarray, tile: Grid, part: np.ndarray) -> None:
    """Copy a tile's values to where it overlaps the grid."""
    shared = grids.intersection(grid, tile)
    if shared is None:
        return
    values[grids.window(grid, shared)] = part[grids.window(tile, shared)]


def ground_around(tile: Grid, cell_m: float, max_interpolation_m: float) -> Grid:
    """The bathymetry that a mosaic tile needs: its own ground, and as far around as terrain may hide it."""
    return grids.pad(grids.grid_around(tile.bounds, cell_m), max(_LEAST_HALO, round(max_interpolation_m / cell_m)))


VERSIONS = dict.fromkeys((CELLS, GROWTH, SURFACE), _VERSION)
