"""Per map tile: what analysts derive from the surface, and its contours, from the tiles around it."""

import sys
from collections.abc import Sequence

import numpy as np

from ..schemas.parameters import TerrainParameters
from ..tasks import contours, derivatives, grids
from ..tasks.grids import Grid
from ..tasks.rings import rings
from .job import Done, Made, code_version, load, once
from .maps import SURFACE, paste
from .maps_inputs import MapJob

TERRAIN, CONTOURS = "terrain", "contours"
_VERSION = code_version(sys.modules[__name__])


def reach(parameters: TerrainParameters, cell_m: float) -> int:
    """Cells around a tile that its layers depend on."""
    return max(derivatives.reach(ring) for ring in rings(parameters, cell_m))


def terrain_tile(m: MapJob, tile: Grid, neighbours: Sequence[tuple[Grid, Done]]) -> Done:
    """The habitat layers of a tile, and how many of its cells there are of each elevation."""
    fine, broad = rings(m.job.parameters.terrain, m.cell_m)
    around = grids.pad(tile, reach(m.job.parameters.terrain, m.cell_m))

    def make() -> Made:
        z, inner = _elevation(m, around, neighbours), grids.window(around, tile)
        found = derivatives.layers(z, m.cell_m, fine, broad)
        counts = contours.heights(z[inner])
        cut = {name: values[inner] for name, values in found.items()}
        return Made(cut, {"heights": list(counts), "cells": list(counts.values())})

    inputs = [done.key for _, done in neighbours]
    return once(m.job, TERRAIN, _VERSION, inputs, [list(tile), fine, broad], make, compress=True)


def contour_interval_m(terrain: Sequence[Done]) -> float:
    """The interval of contours of the whole map, by the elevations of all tiles."""
    total: dict[int, int] = {}
    for done in terrain:
        for height, cells in zip(done.info["heights"], done.info["cells"], strict=True):
            total[height] = total.get(height, 0) + cells
    return contours.interval_m(total)


def contour_tile(m: MapJob, tile: Grid, neighbours: Sequence[tuple[Grid, Done]], interval_m: float) -> Done:
    """The contours of a tile, up to the first row and column of the tiles south and east of it."""
    shared = contour_grid(tile)

    def make() -> Made:
        found = contours.contours(_elevation(m, shared, neighbours), shared, interval_m)
        return Made(found._asdict(), {"lines": len(found.elevation)})

    inputs = [done.key for _, done in neighbours]
    return once(m.job, CONTOURS, _VERSION, inputs, [list(tile), interval_m], make, compress=True)


def contour_grid(tile: Grid) -> Grid:
    """The cells between whose centres the contours of a tile run."""
    return tile._replace(width=tile.width + 1, height=tile.height + 1)


def _elevation(m: MapJob, grid: Grid, tiles: Sequence[tuple[Grid, Done]]) -> np.ndarray:
    z = np.full(grid.shape, np.nan)
    for tile, done in tiles:
        paste(grid, z, tile, load(m.job, SURFACE, done.key, ("elevation",)).arrays["elevation"])
    return z


VERSIONS = dict.fromkeys((TERRAIN, CONTOURS), _VERSION)
