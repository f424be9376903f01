"""What the map tasks are given: images, pairs and tiles, and how they enter the digests of their results."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from ..tasks.frames import MapFrame
from ..tasks.grids import Grid
from .job import Job, rounded_digest, stage
from .solve import Solution


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
    """Two linked images, the keys of their match, of their tie points and of their dense matching, "" without."""

    i: int
    j: int
    key: str
    ties: str = ""
    dense: str = ""


class Tile(NamedTuple):
    """A tile and what touches it."""

    grid: Grid
    images: tuple[Image, ...]
    pairs: tuple[Pair, ...] = ()


class MapJob(NamedTuple):
    """What the map tasks know besides the job.

    Attributes
    ----------
    frame : local and map. adjusted : key of the poses. cell_m : of the bathymetry.
    max_interpolation_m, max_sigma_m : how far from soundings, and how uncertain, interpolated cells may be.
    hiding_m : how far away terrain may hide a place from a camera.
    least_seen : share of the ground seen beyond which no guesses are shown.
    """

    job: Job
    frame: MapFrame
    adjusted: str
    cell_m: float
    max_interpolation_m: float
    max_sigma_m: float
    hiding_m: float
    least_seen: float


def context(m: MapJob, tile: Tile) -> list[Any]:
    """Where a tile lies and what its images were taken with, as it enters its digest."""
    place = [m.frame.crs, m.frame.latitude, m.frame.longitude]
    return [list(tile.grid), place, *stage(m.job.calibration.camera)]


def rows_of(tile: Tile) -> list[int]:
    """Rows of all images that touch a tile, themselves or by a pair."""
    return sorted({image.row for image in tile.images} | {k for pair in tile.pairs for k in (pair.i, pair.j)})


def pose_digest(solution: Solution, rows: Sequence[int]) -> str:
    """Digest of the poses of some images and of their sigmas."""
    rows = list(rows)
    poses = solution.poses
    values = poses.R_local_camera[rows], poses.C_local[rows], solution.sigma_m[rows], solution.sigma_tilt_rad[rows]
    return rounded_digest(*values)
