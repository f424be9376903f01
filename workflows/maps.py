"""Per map tile: soundings to cells, cells to surface, images to mosaics. What touches a tile decides its digest."""

import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..catalog.store import Entry
from ..tasks import (
    camera,
    colour,
    frames,
    gridding,
    grids,
    laser,
    mosaic,
    planar,
    surface,
    terrain,
    tiepoints,
)
from ..tasks.frames import MapFrame
from ..tasks.gridding import LASER, MATCHING, Cells
from ..tasks.grids import Grid
from ..tasks.navigation import Poses
from ..tasks.surface import Growth
from . import extract, match, solve
from .job import Done, Job, Made, array_digest, code_version, load, once, stage
from .solve import Solution

CELLS, GROWTH, SURFACE, LIGHTING = "cells", "growth", "surface", "lighting"
ORTHOMOSAIC, ALIGN, PLANAR = "orthomosaic", "planar-align", "planar-mosaic"
_VERSION = code_version(sys.modules[__name__])


class Image(NamedTuple):
    """An image as the maps need it.

    Attributes
    ----------
    row : of the frames table and of trajectory.csv. path, sha256 : of the file. key : of its extraction.
    texture : whether it shows the seabed and not only the laser.
    """

    row: int
    path: str
    sha256: str
    key: str
    texture: bool


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
    inputs = [f"{image.row}:{image.key}" for image in tile.images] + [_pose_digest(solution, tile)]
    inputs += [f"{pair.i}-{pair.j}:{pair.key}" for pair in tile.pairs]

    def make() -> Made:
        parts = [_NO_PART, *(_laser(m, image, solution) for image in tile.images)]
        parts += [_matched(m, pair, solution) for pair in tile.pairs]
        X, sigma, source, frame, pose_sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
        X_map = m.frame.map_from_local(X)
        cells = gridding.grid_soundings(tile.grid, X_map, sigma, source.astype(np.uint8), frame, pose_sigma)
        return Made(cells._asdict(), {"sounded": int((cells.density > 0).sum())})

    return once(m.job, CELLS, _VERSION, inputs, _context(m, tile), make, compress=True)


def _context(m: MapJob, tile: Tile) -> list[Any]:
    place = [m.frame.crs, m.frame.latitude, m.frame.longitude]
    return [list(tile.grid), place, *stage(m.job.calibration.camera)]


def _pose_digest(solution: Solution, tile: Tile) -> str:
    rows = sorted({image.row for image in tile.images} | {k for pair in tile.pairs for k in (pair.i, pair.j)})
    poses = solution.poses
    values = poses.R_local_camera[rows], poses.C_local[rows], solution.sigma_m[rows], solution.sigma_tilt_rad[rows]
    return array_digest(*(np.round(value, 9) for value in values))


Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
_NO_PART: Part = (np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0, int), np.zeros(0))


def _laser(m: MapJob, image: Image, solution: Solution) -> Part:
    """Local points, sigma, source, frame and the sigma they share through their image's pose."""
    arrays = load(m.job, extract.STEP, image.key).arrays
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


def lighting(job: Job, images: Sequence[Image]) -> Done:
    """The mission's mean lighting from the thumbnails of some of its images."""

    def make() -> Made:
        thumbnails = [load(job, extract.STEP, image.key).arrays["thumbnail"] for image in images]
        return Made({"pattern": colour.lighting(np.stack(thumbnails))}, {"images": len(images)})

    return once(job, LIGHTING, _VERSION, [image.key for image in images], [], make)


def orthomosaic_tile(m: MapJob, tile: Tile, ground: Sequence[tuple[Grid, Done]], light: Done | None) -> Done:
    """One tile of the orthomosaic over the surface tiles `ground`."""
    solution = solve.solution(load(m.job, solve.STEP, m.adjusted))
    inputs = [*_mosaic_inputs(tile, solution, light), *(done.key for _, done in ground)]

    def make() -> Made:
        cell = ground[0][0].cell_m
        around = ground_around(tile.grid, cell, m.max_interpolation_m)
        elevation = np.full(around.shape, np.nan)
        for grid, done in ground:
            paste(around, elevation, grid, load(m.job, SURFACE, done.key).arrays["elevation"])
        local = _affine(m.frame, tile.grid, elevation)
        canvas = mosaic.start(tile.grid, terrain.Terrain(elevation, around, local))
        if np.isfinite(elevation).any():
            for view in _views(m.job, tile, solution.poses, light):
                canvas = mosaic.add_view(canvas, view)
        return _finished(mosaic.finish(canvas))

    return once(m.job, ORTHOMOSAIC, _VERSION, inputs, _mosaic_context(m, tile), make, compress=True)


def ground_around(tile: Grid, cell_m: float, max_interpolation_m: float) -> Grid:
    """The bathymetry that a mosaic tile needs: its own ground, and as far around as terrain may hide it."""
    return grids.pad(grids.grid_around(tile.bounds, cell_m), max(3, round(max_interpolation_m / cell_m)))


def _mosaic_inputs(tile: Tile, solution: Solution, light: Done | None) -> list[str]:
    images = [f"{image.row}:{image.key}" for image in tile.images]
    return [*images, _pose_digest(solution, tile), light.key if light else ""]


def _mosaic_context(m: MapJob, tile: Tile) -> list[Any]:
    return [*_context(m, tile), m.max_interpolation_m, *stage(m.job.parameters.mosaic)]


def _affine(frame: MapFrame, tile: Grid, elevation: np.ndarray) -> frames.LocalAffine:
    """The map around a tile's middle."""
    z = float(np.nanmean(elevation)) if np.isfinite(elevation).any() else 0.0
    west, south, east, north = tile.bounds
    return frame.affine_at(np.array([(west + east) / 2, (south + north) / 2, z]))


def _finished(made: mosaic.Mosaic) -> Made:
    return Made({"rgb": made.rgb, "mask": made.mask, "source": made.source}, {"pixels": int(made.mask.sum())})


def _views(job: Job, tile: Tile, poses: Poses, light: Done | None):
    """The tile's images one at a time, RGB, with their lighting removed and the laser marked."""
    cv2.setNumThreads(1)
    pattern = load(job, LIGHTING, light.key).arrays["pattern"] if light else None
    for image in tile.images:
        bgr = extract.read_verified(job, image.path, image.sha256)
        entry = load(job, extract.STEP, image.key)
        erase = _erased(entry, bgr.shape[:2])
        flat = bgr if pattern is None else colour.flatten(bgr, pattern)
        yield mosaic.View(
            image=np.ascontiguousarray(flat[..., ::-1]),
            erase=erase,
            camera=job.calibration.camera,
            R_local_camera=poses.R_local_camera[image.row],
            C_local=poses.C_local[image.row],
            number=image.row,
        )


def _erased(entry: Entry, shape: tuple[int, int]) -> np.ndarray:
    if "line_uv" not in entry.arrays:
        return np.zeros(shape, bool)
    return laser.mask(shape, entry.arrays["line_uv"], entry.info["halfwidth_px"])


def align_planar(m: MapJob, images: Sequence[Image], linked: Sequence[Pair], ranges: dict[int, float]) -> Done:
    """Similarities of all images on the plane of the planar-scene hypothesis.

    ranges : height of the camera above the seabed, by row.
    """
    solution = solve.solution(load(m.job, solve.STEP, m.adjusted))
    whole = Tile(Grid(1.0, 0, 0, 1, 1), tuple(images), tuple(linked))
    inputs = [*_mosaic_inputs(whole, solution, None), *(f"{pair.i}-{pair.j}:{pair.key}" for pair in linked)]

    def make() -> Made:
        rows = np.array([image.row for image in images], int)
        if not len(rows):
            return Made({"rows": rows, "similarity": np.zeros((0, 2, 3))}, {})
        C_map = m.frame.map_from_local(solution.poses.C_local[rows])
        above = np.array([ranges[row] for row in rows.tolist()])
        height, seabed = float(np.median(above)), float(np.median(C_map[:, 2] - above))
        R_map_local = np.eye(3) if m.frame.crs is None else m.frame.R_map_local(C_map.mean(0))
        believed = planar.prior(C_map, np.maximum(C_map[:, 2] - seabed, 0.1), R_map_local)
        matches = _levelled(m, linked, solution.poses, {int(row): k for k, row in enumerate(rows)}, height)
        return Made({"rows": rows, "similarity": planar.align(believed, matches, 0.1 * height)}, {})

    context = [*_mosaic_context(m, whole), sorted(ranges.items())]
    return once(m.job, ALIGN, _VERSION, inputs, context, make)


def _levelled(m: MapJob, linked: Sequence[Pair], poses: Poses, number: dict[int, int], range_m: float):
    """Matches of the linked pairs as levelled slopes."""
    sides: tuple[list, list] = ([], [])
    images: tuple[list, list] = ([], [])
    for pair in linked:
        arrays = load(m.job, match.STEP, pair.key).arrays
        for side, row, uv in ((0, pair.i, arrays["uv_i"]), (1, pair.j, arrays["uv_j"])):
            slopes = camera.normalised(m.job.calibration.camera, uv.astype(float), range_m)
            sides[side].append(planar.level_slopes(poses.R_local_camera[row], slopes))
            images[side].append(np.full(len(uv), number[row]))
    none = [np.zeros((0, 2))], [np.zeros(0, int)]
    xy_i, xy_j = (np.concatenate(side + none[0]) for side in sides)
    image_i, image_j = (np.concatenate(side + none[1]) for side in images)
    return planar.Matches(image_i.astype(int), image_j.astype(int), xy_i, xy_j)


def planar_tile(m: MapJob, tile: Tile, aligned: Done, light: Done | None) -> Done:
    """One tile of the planar mosaic."""
    solution = solve.solution(load(m.job, solve.STEP, m.adjusted))
    inputs = [*_mosaic_inputs(tile, solution, light), aligned.key]

    def make() -> Made:
        entry = load(m.job, ALIGN, aligned.key)
        similarity = dict(zip(entry.arrays["rows"].tolist(), entry.arrays["similarity"], strict=True))
        canvas = planar.start(tile.grid)
        for view in _views(m.job, tile, solution.poses, light):
            canvas = planar.add_view(canvas, view, similarity[view.number])
        return _finished(mosaic.finish(canvas))

    return once(m.job, PLANAR, _VERSION, inputs, _mosaic_context(m, tile), make, compress=True)


VERSIONS = dict.fromkeys((CELLS, GROWTH, SURFACE, LIGHTING, ORTHOMOSAIC, ALIGN, PLANAR), _VERSION)
