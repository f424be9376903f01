"""What the steps of a run came to, as the products are made from it."""

from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import pyproj

from ..catalog import missions
from ..catalog.missions import OpenedMission
from ..schemas.provenance import Request, Step
from ..tasks.grids import Grid
from .job import Done, Job
from .maps_inputs import MapJob
from .meshing import Place
from .plan import Plan
from .solve import Solution


class Posed(NamedTuple):
    """Results of the images and pairs: extraction by row, matches, the adjustment."""

    extracted: dict[int, Done]
    matched: list[tuple[int, int, Done]]
    adjusted: Done
    solution: Solution


class Tiles(NamedTuple):
    """A map: its grid and the results of its tiles."""

    grid: Grid
    tiles: tuple[tuple[Grid, Done], ...]


class TerrainLayers(NamedTuple):
    """Habitat layers, and the contours of each tile with their interval."""

    layers: Tiles
    contours: tuple[Done, ...]
    interval_m: float


class Mapped(NamedTuple):
    """Results of the map tiles.

    ground : the surface under mosaics and mesh, whose cells do not depend on `grid.cell_m`.
    outlines : (n, M, 2) footprints in map coordinates.
    """

    map_job: MapJob
    cell_m: float
    mosaic_cell_m: float
    surface: Tiles
    terrain: TerrainLayers
    ground: Tiles
    mosaic: Tiles
    mesh: dict[Place, Done]
    outlines: np.ndarray


class Results(NamedTuple):
    """All that products are made from. request : what was asked for, unless the next run has to look again."""

    job: Job
    opened: OpenedMission
    plan: Plan
    out: str
    steps: tuple[Step, ...]
    posed: Posed
    mapped: Mapped
    request: Request | None


def span(opened: OpenedMission) -> tuple[datetime, datetime]:
    """First and last exposure of the images that count."""
    found = missions.span(opened.frames)
    assert found is not None  # a mission is not opened without an image that has a time
    start, end = map(_utc, found)
    return start, end


def _utc(time: np.datetime64) -> datetime:
    return datetime.fromtimestamp(float(time.astype("datetime64[us]").astype(np.int64)) / 1e6, UTC)


def vertical_reference(opened: OpenedMission) -> str:
    """What elevations are measured from, in words."""
    if opened.crs is None:
        return "the centre of projection of the first image placed"
    if opened.vertical is not None:
        return pyproj.CRS.from_wkt(opened.vertical).name
    if opened.mission.tide is not None:
        return f"the zero of the tide table {opened.mission.tide}, of which mission.yaml names no datum"
    return "the sea surface at survey time"
