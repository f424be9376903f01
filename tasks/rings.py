"""The rings of the bathymetric position indices, in cells of the map."""

from ..schemas.parameters import RingParameters, TerrainParameters
from ..schemas.problems import InvalidInput, Problem
from .derivatives import Ring

_MOST_CELLS = 1000  # of a ring: a tile is read with such a rim


def rings(parameters: TerrainParameters, cell_m: float) -> tuple[Ring, Ring]:
    """The rings of the two position indices in cells, fine and broad.

    Raises
    ------
    InvalidInput
        If one has more cells than a tile can be read with around it.
    """
    return _ring(parameters.fine, "terrain.fine", cell_m), _ring(parameters.broad, "terrain.broad", cell_m)


def _ring(given: RingParameters, key: str, cell_m: float) -> Ring:
    cells = cell_m if given.unit == "metres" else 1.0
    found = Ring(round(given.inner / cells), max(1, round(given.outer / cells)))
    if found.outer_cells > _MOST_CELLS:
        expected = f"at most {_MOST_CELLS} cells of {cell_m:g} m"
        remedy = "Choose a smaller ring, or larger cells (grid.cell_m)."
        raise InvalidInput([Problem("parameters", None, f"{key}.outer", f"{given.outer:g} m", expected, remedy)])
    return found
