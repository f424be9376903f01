"""Per map tile: soundings to cells, cells to surface. What touches a tile decides its digest."""

import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..tasks import coarsening, gridding, grids, matching_noise, smooth, surface
from ..tasks.gridding import LASER, MATCHING, Cells, Soundings
from ..tasks.grids import Grid
from ..tasks.surface import Growth
from . import dense, extract, solve
from .job import Done, Job, Made, array_digest, code_version, load, once
from .maps_inputs import Image, MapJob, Pair, Tile, context, pose_digest, rows_of
from .solve import Solution

CELLS, GROWTH, SURFACE = "cells", "growth", "surface"
_VERSION = code_version(sys.modules[__name__], dense)
_LEAST_HALO = 6  # cells
# Of the variance that poses give to matching: what a pair's poses do to all of its cells, and what neighbouring pairs
# have in common, as they share images and the bend of the whole, so that it does not average down
_SHARED, _BEND = 0.5, 0.5
_LEAST_NOISE_PX = 0.02
_ONE_LINE = 0.05  # of points' extent: less aside tells no slope across
_FINE_CELLS = 1536  # across, of the usual cells that coarse ones are made of at a time
_BESIDE = "beside_"  # names of what matching says of the laser's cells
_TRUST = 2 / 3  # in what laser and matching say of each other, against what the adjustment says


def cells_tile(m: MapJob, tile: Tile, agreed: Done) -> Done:
    """Soundings, tie points and dense matching of a tile, gridded. agreed : by `dense.agreement`."""
    solution = relative(solve.solution(m.job, m.adjusted), agreed.info["laser_m"])
    # what was found and not from what: another image elsewhere is no reason to make this tile anew
    said = [agreed.info[name] for name in ("dense_px", "tie_px", "window_m")] + [round(_bend_m(solution), 4)]
    inputs = [f"{image.row}:{image.key}" for image in tile.images] + [pose_digest(solution, rows_of(tile))]
    inputs += [f"{pair.i}-{pair.j}:{pair.ties}:{pair.dense}" for pair in tile.pairs]

    def make() -> Made:
        count = len(solution.sigma_m)
        parts = [_within(tile.grid, _laser(m, image, solution)) for image in tile.images]
        for pair in tile.pairs:
            parts.append(_within(tile.grid, _matched(m, pair, solution, agreed.info["tie_px"])))
            if pair.dense:
                parts.append(_within(tile.grid, _dense(m, pair, count, agreed.info["dense_px"])))
        soundings = Soundings._make(np.concatenate(column) for column in zip(_NOTHING, *parts, strict=True))
        made = {}
        for prefix, gridded in (("", gridding.grid_soundings), (_BESIDE, gridding.beside_laser)):
            cells = gridded(tile.grid, soundings)
            cells = cells._replace(sigma=np.hypot(cells.sigma, said[-1]))
            at = np.flatnonzero(cells.density)
            made[f"{prefix}cell"] = at.astype(np.int32)
            made |= {f"{prefix}{name}": values.ravel()[at] for name, values in cells._asdict().items()}
        return Made(made, {"sounded": len(made["cell"]), "window_m": agreed.info["window_m"]})

    return once(m.job, CELLS, _VERSION, inputs, [context(m, tile), said], make)


def relative(solution: Solution, measured_m: float) -> Solution:
    """The solution with sigmas relative to the map itself, where matches hold its images together.

    What all images share, the error of the datum, is no error of one cell against another: the sigma of the best
    image stands for it and is taken off. What is left is too cautious where all images hold each other well, and laser
    and matching agree better than it says, to measured_m, 1-sigma of the elevation; but these see nothing of what bends
    neighbours alike. The mean of both, on a scale of ratios, counts. Images that navigation alone places keep theirs.
    """
    held = np.array([status == "adjusted" for status in solution.status], bool) & solution.poses.known
    if not held.any():
        return solution
    sigma_m, tilt = solution.sigma_m.copy(), solution.sigma_tilt_rad.copy()
    for values in (sigma_m, tilt):
        own = values[held]
        values[held] = np.sqrt(np.maximum(own**2 - own.min(0) ** 2, 0))
    calm = min(1.0, measured_m / max(float(np.median(sigma_m[held, 2])), 1e-6)) ** _TRUST
    sigma_m[held], tilt[held] = calm * sigma_m[held], calm * tilt[held]
    return solution._replace(sigma_m=sigma_m, sigma_tilt_rad=tilt)


def _bend_m(solution: Solution) -> float:
    """1-sigma of the elevation by the poses, as far as neighbouring images share it."""
    held = np.array([status == "adjusted" for status in solution.status], bool) & solution.poses.known
    return float(np.sqrt(_BEND) * np.median(solution.sigma_m[held, 2])) if held.any() else 0.0


def bend_m(m: MapJob, agreed: Done) -> float:
    """1-sigma of the elevation that all cells of a place share, m. agreed : by `dense.agreement`."""
    return _bend_m(relative(solve.solution(m.job, m.adjusted), agreed.info["laser_m"]))


def _soundings(X_map: np.ndarray, sigma: np.ndarray, source: int, frame: int, shared: np.ndarray) -> Soundings:
    count = len(X_map)
    return Soundings(
        X_map,
        sigma,
        np.full(count, source, np.uint8),
        np.full(count, frame),
        np.broadcast_to(shared, count),
        np.zeros(count, bool),
    )


def _within(grid: Grid, soundings: Soundings) -> Soundings:
    """Those in a tile: what many images and pairs have elsewhere need not be held."""
    there = grids.inside(grid, *grids.index_of(grid, soundings.X))
    return Soundings._make(values[there] for values in soundings)


_NOTHING = _soundings(np.zeros((0, 3)), np.zeros(0), MATCHING, 0, np.zeros(0))


def _laser(m: MapJob, image: Image, solution: Solution) -> Soundings:
    arrays = load(m.job, extract.STEP, image.key, ("laser_X", "laser_sigma")).arrays
    X_camera = arrays.get("laser_X", np.zeros((0, 3)))
    aside = X_camera @ solution.poses.R_local_camera[image.row].T
    lean = np.hypot(aside[:, 0], aside[:, 1]) * solution.sigma_tilt_rad[image.row]
    # an image that lies beside its place has a slope too high or too low
    moved = np.linalg.norm(_slope(aside) * solution.sigma_m[image.row, :2])
    shared = np.hypot(np.hypot(solution.sigma_m[image.row, 2], moved), lean)
    X = m.frame.map_around(dense.sounded(m, image, solution), solution.poses.C_local[image.row])
    return _soundings(X, arrays.get("laser_sigma", np.zeros(0)), LASER, image.row, shared)


def _slope(X: np.ndarray) -> np.ndarray:
    """Rise over run (2,) of the plane through points (N, 3); level across a single line and where there are none."""
    off = X - X.mean(0) if len(X) else X
    return np.linalg.lstsq(off[:, :2], off[:, 2], rcond=_ONE_LINE)[0]


def _matched(m: MapJob, pair: Pair, solution: Solution, tie_px: float) -> Soundings:
    points = dense.tie_points(m, pair.ties, tie_px)
    X = m.frame.map_around(points.X_local, solution.poses.C_local[pair.i])
    return _soundings(X, points.sigma_m, MATCHING, pair.i, tie_px * points.metres_per_px)


def _dense(m: MapJob, pair: Pair, images: int, dense_px: float) -> Soundings:
    """One sounding a cell, numbered as one more frame for the pair: what it errs by is its poses', mostly."""
    cells = dense.read_cells(m, pair.dense)
    sigma, number = dense_px * cells.metres_per_px, images * (pair.i + 1) + pair.j
    noise = np.maximum(cells.noise_px, _LEAST_NOISE_PX) * cells.metres_per_px
    found = _soundings(cells.X_map, noise, MATCHING, number, np.sqrt(_SHARED) * sigma)
    return found._replace(doubtful=~cells.borne_out)


class Sample(NamedTuple):
    """A tile that tells how interpolation errs: with the tiles around it, and the outlines (K, M, 2) of its images."""

    tile: Grid
    neighbours: Sequence[tuple[Grid, Done]]
    outlines: np.ndarray


def fit_growth(m: MapJob, samples: Sequence[Sample]) -> Done:
    """How matching and interpolation err on this seabed; and which guesses to show.

    Matching, noise_scale of the info, where the laser has seen the same cells; interpolation by soundings held out;
    both in some of the tiles.

    Interpolated cells are shown as long as they are more certain than max_sigma_m of the info: than the worst of the
    best `m.least_seen` of the cells that images have seen, and than m.max_sigma_m.
    """

    def make() -> Made:
        reach, held, guessed = m.max_interpolation_m, [], []
        scale = round(matching_noise.noise_scale(_beside(m, samples)), 4)
        for sample in samples:
            halo = with_halo(m, sample.tile)
            known, inner = _cells(m.job, halo, sample.neighbours, scale), grids.window(halo, sample.tile)
            held.append(surface.hold_out(halo, known, reach, sample.tile))
            guesses = surface.guesses(halo, known, reach, sample.tile)
            seen = surface.seen(sample.tile, sample.outlines)
            guessed.append(surface.Guesses(*(layer[inner][seen] for layer in guesses)))
        law = surface.fit_growth(surface.Holdout(*(np.concatenate(column) for column in zip(*held, strict=True))))
        own, distance, spread = (np.concatenate(column) for column in zip(*guessed, strict=True))
        sigma = np.hypot(own, surface.growth_sigma(law, distance, spread))
        worst = surface.worst_shown(sigma, m.least_seen, m.max_sigma_m)
        return Made({}, {**law._asdict(), "noise_scale": scale, "max_sigma_m": worst})

    inputs = [done.key for sample in samples for _, done in sample.neighbours]
    inputs.append(array_digest(*(np.round(sample.outlines, 3) for sample in samples)))
    parameters = [m.max_interpolation_m, m.max_sigma_m, m.least_seen, [list(sample.tile) for sample in samples]]
    return once(m.job, GROWTH, _VERSION, inputs, parameters, make)


def _beside(m: MapJob, samples: Sequence[Sample]) -> matching_noise.Beside:
    """Matched cells beside the laser's in some tiles."""
    found = [matching_noise.NOTHING]
    for sample in samples:
        halo = grids.pad(sample.tile, smooth.REACH + 1)
        beside = _gridded(m.job, halo, sample.neighbours, _BESIDE)
        if beside.density.any():
            cells = _gridded(m.job, halo, sample.neighbours)
            alone = matching_noise.instead_of_laser(cells, beside)
            matched = smooth.matched(halo, alone, _window_m(sample.neighbours))
            found.append(matching_noise.compare(halo, matched, cells, sample.tile))
    return matching_noise.Beside(*(np.concatenate(column) for column in zip(*found, strict=True)))


def with_halo(m: MapJob, tile: Grid) -> Grid:
    """A tile with the cells around it that its surface depends on, and what these, smoothed, depend on."""
    return grids.pad(tile, surface.halo_cells(m.max_interpolation_m, tile.cell_m) + smooth.REACH)


def surface_tile(m: MapJob, tile: Grid, neighbours: Sequence[tuple[Grid, Done]], growth: Done) -> Done:
    """The Delaunay surface of a tile from the cells of the tiles around it."""
    law, worst = Growth(*(growth.info[name] for name in Growth._fields)), growth.info["max_sigma_m"]
    inputs, scale = [done.key for _, done in neighbours], growth.info["noise_scale"]

    def make() -> Made:
        halo = with_halo(m, tile)
        cells = _cells(m.job, halo, neighbours, scale)
        found = surface.delaunay_surface(halo, cells, m.max_interpolation_m, law, tile)
        mapped = surface.without_guesses(found, worst)
        inner = grids.window(halo, tile)
        layers = {
            "elevation": mapped.elevation.astype(np.float32),
            "sigma": mapped.sigma.astype(np.float32),
            "density": cells.density.astype(np.uint32),
            "source": mapped.source,
            # guesses too: to lay pictures on, they are better than nothing
            "ground": found.elevation.astype(np.float32),
        }
        cut = {name: values[inner] for name, values in layers.items()}
        return Made(cut, {"cells": int(np.isfinite(cut["elevation"]).sum()), "max_sigma_m": worst})

    parameters = [list(tile), m.max_interpolation_m, worst, list(law), scale]
    return once(m.job, SURFACE, _VERSION, inputs, parameters, make, compress=True)


def coarse_tile(m: MapJob, tile: Grid, neighbours: Sequence[tuple[Grid, Done]]) -> Done:
    """The surface of a tile of coarser cells, from the tiles of the usual ones over it."""
    inputs, usual = [done.key for _, done in neighbours], neighbours[0][0].cell_m
    worst = neighbours[0][1].info["max_sigma_m"]

    def part(tile: Grid) -> coarsening.Coarse:
        around = grids.pad(grids.grid_around(tile.bounds, usual), 1)
        values = {name: np.full(around.shape, np.nan) for name in ("elevation", "sigma")}
        values |= {name: np.zeros(around.shape, np.int64) for name in ("source", "density")}
        for grid, done in neighbours:
            if grids.intersection(around, grid) is not None:
                arrays = load(m.job, SURFACE, done.key, values).arrays
                for name, whole in values.items():
                    paste(around, whole, grid, arrays[name])
        return coarsening.coarsen(around, **values, coarse=tile)

    def make() -> Made:
        layers: dict[str, np.ndarray] = {}
        size = max(1, int(_FINE_CELLS * usual / tile.cell_m))
        for block in grids.tiles(tile, min(size, m.job.parameters.grid.tile_cells)):
            for name, values in part(block)._asdict().items():
                values = values.astype(np.float32) if values.dtype == float else values
                layers.setdefault(name, np.zeros(tile.shape, values.dtype))
                paste(tile, layers[name], block, values)
        return Made(layers, {"cells": int(np.isfinite(layers["elevation"]).sum()), "max_sigma_m": worst})

    return once(m.job, SURFACE, _VERSION, inputs, [list(tile), worst], make, compress=True)


def _cells(job: Job, grid: Grid, tiles: Sequence[tuple[Grid, Done]], noise_scale: float) -> Cells:
    return smooth.matched(grid, _gridded(job, grid, tiles), _window_m(tiles), noise_scale)


def _window_m(tiles: Sequence[tuple[Grid, Done]]) -> float:
    return max((done.info["window_m"] for _, done in tiles), default=0.0)


def _gridded(job: Job, grid: Grid, tiles: Sequence[tuple[Grid, Done]], prefix: str = "") -> Cells:
    """The cells of some tiles on a grid over them; with `_BESIDE` what matching says of those of the laser."""
    empty = Cells(
        elevation=np.full(grid.shape, np.nan),
        sigma=np.full(grid.shape, np.nan),
        noise=np.full(grid.shape, np.nan),
        density=np.zeros(grid.shape, np.int32),
        source=np.zeros(grid.shape, np.uint8),
        x=np.full(grid.shape, np.nan),
        y=np.full(grid.shape, np.nan),
    )
    for tile, done in tiles:
        arrays = load(job, CELLS, done.key, [f"{prefix}{name}" for name in ("cell", *Cells._fields)]).arrays
        row, column = np.divmod(arrays[f"{prefix}cell"], tile.width)
        row, column = row + grid.top - tile.top, column + tile.left - grid.left
        here = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
        for name, values in empty._asdict().items():
            values[row[here], column[here]] = arrays[f"{prefix}{name}"][here]
    return empty


def paste(grid: Grid, values: np.ndarray, tile: Grid, part: np.ndarray) -> None:
    """Copy a tile's values to where it overlaps the grid."""
    shared = grids.intersection(grid, tile)
    if shared is None:
        return
    values[grids.window(grid, shared)] = part[grids.window(tile, shared)]


def ground_around(tile: Grid, cell_m: float, hiding_m: float) -> Grid:
    """The bathymetry that a mosaic tile needs: its own ground, and as far around as terrain may hide it."""
    return grids.pad(grids.grid_around(tile.bounds, cell_m), max(_LEAST_HALO, round(hiding_m / cell_m)))


VERSIONS = dict.fromkeys((CELLS, GROWTH, SURFACE), _VERSION)
