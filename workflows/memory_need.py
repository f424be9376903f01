"""How much memory the largest tasks of a run need, known before it starts, so that one that cannot fit is refused.

Measured as peaks of resident memory (`benchmarks/README.md`); what a task needs depends on the sizes of image and tile,
not on the length of the mission, but for the adjustment of all poses.
"""

from typing import Final, NamedTuple

from ..schemas.calibration import Camera
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..tasks import grids, smooth
from ..tasks.camera import ground_sample_distance
from ..tasks.surface import halo_cells

GIB: Final = 2**30
_PROCESS: Final = 0.35 * GIB  # Python with all libraries
_EACH_PIXEL: Final = 20  # of an image while it is measured, bytes
_EACH_DECODED: Final = 15  # while 16 bits a channel are decoded
_EACH_ADJUSTED: Final = 600_000  # of an image in the adjustment, bytes
_EACH_CELL: Final = 200  # of a tile of the bathymetry with what surrounds it
_EACH_TEXEL: Final = 30  # of a tile of the mosaic
_BESIDES: Final = 0.1 * GIB


class Need(NamedTuple):
    """The memory of a kind of task, bytes; what it depends on, in words; the parameter that makes it smaller."""

    size: float
    what: str
    parameter: str = ""


def needs(camera: Camera, parameters: Parameters, images: int, range_m: float, file_bytes: int = 0) -> list[Need]:
    """What the largest tasks need.

    Parameters
    ----------
    images : how many of the mission are processed. range_m : typical height above the seabed. file_bytes : of the
        largest image file; one is worked on while the next is being read.
    """
    pixels = camera.width * camera.height
    usual = grids.bathymetry_cell_m(ground_sample_distance(camera, range_m))
    cell = min(usual, planned_cell_m(camera, parameters, range_m))
    across = parameters.grid.max_interpolation_m
    reach = grids.max_interpolation_m(range_m) if across == "auto" else float(across)
    side = parameters.grid.tile_cells + 2 * (halo_cells(reach, cell) + smooth.REACH)
    texels = parameters.mosaic.tile_cells
    image = _PROCESS + max(_EACH_PIXEL * pixels + file_bytes, _EACH_DECODED * pixels + 2 * file_bytes)
    return [
        Need(image, f"an image of {camera.width} x {camera.height} pixels"),
        Need(_PROCESS + _EACH_ADJUSTED * images, f"the adjustment of {images:,} images"),
        Need(
            _PROCESS + _BESIDES + _EACH_CELL * side**2,
            f"a tile of the bathymetry with what surrounds it ({side} x {side} cells)",
            "grid.tile_cells",
        ),
        Need(image + _EACH_TEXEL * texels**2, f"a tile of the mosaic ({texels} x {texels})", "mosaic.tile_cells"),
    ]


def planned_cell_m(camera: Camera, parameters: Parameters, range_m: float) -> float:
    """Cell of the bathymetry as far as it is known before the laser tells the range."""
    usual = grids.bathymetry_cell_m(ground_sample_distance(camera, range_m))
    return usual if parameters.grid.cell_m == "auto" else float(parameters.grid.cell_m)


def refuse_what_cannot_fit(found: list[Need], limit: float | None) -> None:
    """Refuse a run whose tasks need more than a worker has.

    Parameters
    ----------
    limit : bytes that a worker may use; None if it has no limit.

    Raises
    ------
    InvalidInput
        With every kind of task that does not fit.
    """
    problems = [_problem(need, limit) for need in found if limit and need.size > limit]
    if problems:
        raise InvalidInput(problems)


def _problem(need: Need, limit: float) -> Problem:
    more = "give a worker more memory (fewer --workers, or `memory` in the cluster file)"
    remedy = f"Make {need.parameter} smaller, or {more}." if need.parameter else f"{more.capitalize()}."
    wanted = f"{need.what} needs {need.size / GIB:.1f} GiB"
    return Problem("memory", None, need.parameter, wanted, f"at most the {limit / GIB:.1f} GiB of a worker", remedy)
