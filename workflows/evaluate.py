"""Measures products against a simulation's truth or any reference (`seamosaic evaluate PRODUCTS --truth ...`)."""

import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from ..catalog import trajectories, versions
from ..schemas.problems import InvalidInput, Problem
from ..tasks import evaluation
from ..tasks.frames import MapFrame

Array = NDArray[np.float64]

# A map with more cells is thinned before it is compared: a few million say the same.
_MAX_CELLS = 6_000_000
# The seabed straight below a camera: cells within this distance east and north.
_NADIR_M = 0.06
_CLOUD_CHUNK = 2_000_000


class _Map(NamedTuple):
    """Cells of bathymetry.tif.

    Attributes
    ----------
    X : (N, 3) centres and elevations, map coordinates.
    sigma : (N,) of uncertainty.tif, NaN without.
    crs : horizontal CRS; None for a local one.
    cell_m : cell size.
    thinned : every how many cells, each way, one was read.
    """

    X: Array
    sigma: Array
    crs: pyproj.CRS | None
    cell_m: float
    thinned: int


class _Truth(NamedTuple):
    """A simulated mission's truth; poses (n, ...) in the local frame, camera matrix K (3, 3)."""

    latitude: float
    longitude: float
    images: tuple[str, ...]
    R: Array
    C: Array
    K: Array
    half_m: float
    surface: evaluation.Surface


def evaluate(products: Path | str, truth: Path | str) -> dict[str, Any]:
    """Figures of a products folder against a truth.

    Parameters
    ----------
    products : OUT, OUT/<mission id> or OUT/<mission id>/vN; the newest version is used.
    truth : a simulated mission's folder or its truth/; or a raster of elevations in any CRS; or a point cloud
        (.las, .laz).

    Returns
    -------
    dict
        Against a simulation, ``trajectory`` and ``bathymetry``; against anything else, ``reference``. Lengths in
        metres, angles in degrees. A mission without navigation is first laid on the truth by its trajectory.

    Raises
    ------
    InvalidInput
        If a file is missing or cannot be read, or nothing overlaps.
    """
    folder, truth = _newest(Path(products)), Path(truth)
    if not truth.exists():
        raise _wrong(truth, "nothing", "a simulated mission, a raster or a point cloud", "Check the path.")
    if truth.is_dir():
        return {"products": str(folder), **_against_simulation(folder, _read_truth(truth))}
    found = _read_map(folder)
    if found.crs is None:
        raise _wrong(
            folder / "bathymetry.tif",
            "a local CRS",
            "a projected CRS",
            "A mission without navigation fits no reference.",
        )
    is_cloud = truth.suffix.lower() in (".las", ".laz")
    z, reference = (_beside_cloud if is_cloud else _beside_raster)(found, truth)
    if not len(z):
        raise _wrong(truth, "no value where the map has cells", "an overlap with the map", "Check its CRS and extent.")
    return {"products": str(folder), "reference": evaluation.agreement(z, reference)._asdict()}


def _wrong(path: Path, found: str, expected: str, remedy: str) -> InvalidInput:
    return InvalidInput([Problem(str(path), None, "", found, expected, remedy)])


def _newest(products: Path) -> Path:
    """The folder that holds the products: the newest version below what was given."""
    if (products / "trajectory.csv").exists() or (products / "bathymetry.tif").exists():
        return products
    newest = versions.newest_version(products.parent, products.name)
    if newest is not None:
        return Path(str(newest.path))
    below = [p.name for p in sorted(products.iterdir()) if p.is_dir()] if products.is_dir() else []
    missions = [name for name in below if versions.newest_version(products, name) is not None]
    if len(missions) > 1:
        raise _wrong(products, f"products of {', '.join(missions)}", "those of one mission", "Name one of them.")
    newest = versions.newest_version(products, missions[0]) if missions else None
    if newest is None:
        raise _wrong(products, "no products", "OUT, OUT/<mission id> or a version", "Run `seamosaic run` first.")
    return Path(str(newest.path))


def _horizontal(crs: Any) -> pyproj.CRS | None:
    """The horizontal part of a rasterio or pyproj CRS; None if it is local or missing."""
    if not crs:
        return None
    whole = pyproj.CRS.from_user_input(crs.to_wkt())
    level = whole.sub_crs_list[0] if whole.is_compound else whole
    return level if level.is_projected or level.is_geographic else None


def _read_map(folder: Path) -> _Map:
    path, sigma_path = folder / "bathymetry.tif", folder / "uncertainty.tif"
    if not path.exists():
        raise _wrong(path, "nothing", "the bathymetry to evaluate", "Run `seamosaic run` to its end.")
    with rasterio.open(path) as file:
        step = int(np.ceil(np.sqrt(file.width * file.height / _MAX_CELLS)))
        row, column, z = _read_cells(path, step)
        x, y = _affine(file.transform, column + 0.5, row + 0.5)
        crs, cell_m = _horizontal(file.crs), abs(file.transform.a)
    if not len(z):
        raise _wrong(path, "no cell with a value", "a map", "Look at quality.json for why it is empty.")
    sigma = np.full(len(z), np.nan)
    if sigma_path.exists():
        r, c, values = _read_cells(sigma_path, step)
        width = 1 + int(max(column.max(), c.max(initial=0)))
        _, mine, theirs = np.intersect1d(row * width + column, r * width + c, assume_unique=True, return_indices=True)
        sigma[mine] = values[theirs]
    return _Map(np.column_stack([x, y, z]), sigma, crs, cell_m, step)


def _read_cells(path: Path, step: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Row, column and value of every step-th cell each way that has one, block by block."""
    parts = []
    with rasterio.open(path) as file:
        for _, window in file.block_windows(1):
            part = _thinned(file, window, step)
            if part is not None:
                parts.append(part)
    if not parts:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    row, column, value = (np.concatenate(p) for p in zip(*parts, strict=True))
    return row, column, value


def _thinned(file: rasterio.DatasetReader, window: Window, step: int):
    first_row, first_column = -window.row_off % step, -window.col_off % step
    block = file.read(1, window=window, masked=True).filled(np.nan)[first_row::step, first_column::step]
    row, column = np.nonzero(np.isfinite(block))
    if not len(row):
        return None
    place = window.row_off + first_row + step * row, window.col_off + first_column + step * column
    return *place, block[row, column].astype(float)


def _read_truth(path: Path) -> _Truth:
    folder = path if (path / "truth.json").exists() else path / "truth"
    for name in ("truth.json", "terrain.npz"):
        if not (folder / name).exists():
            raise _wrong(
                folder / name, "nothing", "the truth of a simulated mission", "Make one with `seamosaic simulate`."
            )
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    with np.load(folder / "terrain.npz") as t:
        half_m, period_m = float(t["half"]), float(t.get("period", 0.0))
        surface = evaluation.grid_surface(t["h"], half_m, float(t["cell"]), float(t["depth"]))
    frames = truth["frames"]
    R, C, K = np.array([f["R"] for f in frames]), np.array([f["C"] for f in frames]), np.array(truth["K"])
    if period_m:  # the grid holds little more than one period of a seabed that goes on
        surface = evaluation.repeated(surface, period_m)
        half_m += float(abs(C[:, :2]).max())
    return _Truth(truth["lat0"], truth["lon0"], tuple(f["image"] for f in frames), R, C, K, half_m, surface)


def _against_simulation(folder: Path, truth: _Truth) -> dict[str, Any]:
    found = _read_map(folder)
    frame = MapFrame(None if found.crs is None else found.crs.to_wkt(), truth.latitude, truth.longitude)
    names, X_map = _positions(folder)
    known = [k for k, name in enumerate(names) if name in truth.images]
    if not known:
        raise _wrong(folder / "trajectory.csv", "no image of the truth", "the same mission", "Check --truth.")
    C_map, C_true = X_map[known], truth.C[[truth.images.index(names[k]) for k in known]]
    C, X = frame.local_from_map(C_map), frame.local_from_map(found.X)
    errors = evaluation.trajectory_errors(C, C_true)._asdict()
    if found.crs is None:
        X = evaluation.align(C, C_true).apply(X)
        errors.pop("absolute_rms_m")
    bathymetry = _bathymetry(found, X, truth)
    if found.crs is not None:
        bathymetry |= _altitude(found, C_map, C_true, truth)
    return {"trajectory": {"frames": len(known), "of": len(truth.images), **errors}, "bathymetry": bathymetry}


def _positions(folder: Path) -> tuple[list[str], Array]:
    """Names and centres (n, 3), map coordinates, of the images that were placed."""
    path = folder / "trajectory.csv"
    if not path.exists():
        raise _wrong(path, "nothing", "the trajectory to evaluate", "Run `seamosaic run` to its end.")
    placed = [(Path(row.image).name, row.pose.position) for row in trajectories.read(path) if row.pose is not None]
    return [name for name, _ in placed], np.array([position for _, position in placed]).reshape(-1, 3)


def _bathymetry(found: _Map, X: Array, truth: _Truth) -> dict[str, Any]:
    figures: dict[str, Any] = {"cells_compared": len(X), "cell_m": found.cell_m}
    if found.crs is not None:
        difference = X[:, 2] - truth.surface(X[:, 0], X[:, 1])
        figures |= {
            "abs_bias_m": float(np.median(difference)),
            "abs_rmse_m": float(np.sqrt((difference**2).mean())),
        }
    shift = evaluation.fit_shift(X, truth.surface)
    left = evaluation.residuals(X, shift, truth.surface)
    within_1, within_2 = evaluation.honesty(left, found.sigma)
    figures |= {
        "shift_m": [shift.east_m, shift.north_m, shift.up_m],
        "yaw_deg": shift.yaw_deg,
        "tilt_deg": [shift.tilt_east_deg, shift.tilt_north_deg],
        **evaluation.spread(left)._asdict(),
        "within_1sigma": within_1,
        "within_2sigma": within_2,
    }
    if found.cell_m * found.thinned <= 0.05:
        moved = X + np.array([shift.east_m, shift.north_m, shift.up_m])
        share = evaluation.coverage(moved, truth.surface, truth.half_m, truth.R, truth.C, truth.K)
        figures |= {"completeness_seen": share.seen, "completeness_seen_twice": share.seen_twice}
    return figures


def _altitude(found: _Map, C_map: Array, C_true: Array, truth: _Truth) -> dict[str, Any]:
    below = []
    for centre in C_map:
        near = (abs(found.X[:, :2] - centre[:2]) <= _NADIR_M).all(axis=1)
        below.append(np.median(found.X[near, 2]) if near.any() else np.nan)
    seen = np.isfinite(below)
    if not seen.any():
        return {}
    above_map = C_map[seen, 2] - np.array(below)[seen]
    above_truth = C_true[seen, 2] - truth.surface(C_true[seen, 0], C_true[seen, 1])
    return {"altitude_bias_pct": evaluation.altitude_bias_pct(above_map, above_truth)}


def _beside_raster(found: _Map, path: Path) -> tuple[Array, Array]:
    """Elevations (N,) of the map and of a raster, bilinear, where both have one."""
    try:
        with _open_reference(path) as file:
            crs = _horizontal(file.crs)
            if crs is None:
                raise _wrong(path, "no CRS", "a georeferenced raster", "Assign its CRS, e.g. with gdal_edit.py -a_srs.")
            x, y = _transform(found, crs)
            column, row = _affine(~file.transform, x, y)
            window = _window(column, row, file.width, file.height)
            if window is None:
                return np.zeros(0), np.zeros(0)
            z = file.read(1, window=window, masked=True).astype(float).filled(np.nan)
    except rasterio.RasterioIOError as error:
        raise _wrong(
            path, str(error), "a raster or a point cloud", "Give a file that GDAL opens, or .las, .laz."
        ) from None
    at = [row - window.row_off - 0.5, column - window.col_off - 0.5]
    reference = np.asarray(map_coordinates(z, at, order=1, mode="constant", cval=np.nan))
    both = np.isfinite(reference)
    return found.X[both, 2], reference[both]


def _open_reference(path: Path) -> rasterio.DatasetReader:
    with warnings.catch_warnings():
        # a raster without a place is refused by the caller, with a remedy
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(path)


def _affine(matrix: rasterio.Affine, u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    return matrix.a * u + matrix.b * v + matrix.c, matrix.d * u + matrix.e * v + matrix.f


def _transform(found: _Map, crs: pyproj.CRS) -> tuple[Array, Array]:
    x, y = pyproj.Transformer.from_crs(found.crs, crs, always_xy=True).transform(found.X[:, 0], found.X[:, 1])
    return np.asarray(x), np.asarray(y)


def _window(column: Array, row: Array, width: int, height: int) -> Window | None:
    """The part of a raster under some places, with a cell to spare."""
    left, right = np.clip([np.floor(column.min()) - 1, np.ceil(column.max()) + 1], 0, width).astype(int)
    top, bottom = np.clip([np.floor(row.min()) - 1, np.ceil(row.max()) + 1], 0, height).astype(int)
    return Window(left, top, right - left, bottom - top) if right > left and bottom > top else None  # pyright: ignore[reportCallIssue]


def _beside_cloud(found: _Map, path: Path) -> tuple[Array, Array]:
    """Elevations (N,) of the map and, in the same cells, the medians of a point cloud."""
    keys, z = _cloud_cells(found, path)
    unique, start, count = np.unique(keys, return_index=True, return_counts=True)
    medians = (z[start + (count - 1) // 2] + z[start + count // 2]) / 2
    mine = _cell_keys(found, found.X[:, 0], found.X[:, 1])
    _, a, b = np.intersect1d(mine, unique, assume_unique=True, return_indices=True)
    return found.X[a, 2], medians[b]


def _cell_keys(found: _Map, x: Array, y: Array) -> NDArray[np.int64]:
    """A number for the cell of each place; cells are aligned to whole multiples of their size."""
    column, row = (np.floor(v / found.cell_m).astype(np.int64) for v in (x, y))
    return column * (1 << 32) + row


def _cloud_cells(found: _Map, path: Path) -> tuple[NDArray[np.int64], Array]:
    """Cell numbers and elevations of a cloud's points over the map, sorted by cell, then by elevation."""
    keys, heights = [np.zeros(0, np.int64)], [np.zeros(0)]
    low, high = found.X[:, :2].min(axis=0) - found.cell_m, found.X[:, :2].max(axis=0) + found.cell_m
    with laspy.open(path) as file:
        crs = _horizontal(file.header.parse_crs()) or found.crs
        assert found.crs is not None
        to_map = pyproj.Transformer.from_crs(crs, found.crs, always_xy=True)
        for points in file.chunk_iterator(_CLOUD_CHUNK):
            x, y = (np.asarray(v) for v in to_map.transform(np.asarray(points.x), np.asarray(points.y)))
            over = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
            keys.append(_cell_keys(found, x[over], y[over]))
            heights.append(np.asarray(points.z, float)[over])
    key, z = np.concatenate(keys), np.concatenate(heights)
    order = np.lexsort((z, key))
    return key[order], z[order]
