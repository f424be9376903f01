"""`seamosaic compare V1 V2`: where and by how much two versions differ, and in what they were made differently."""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyproj
import rasterio
from rasterio import DatasetReader
from rasterio.windows import Window

from ..catalog import rasters, trajectories, versions
from ..catalog.filesystems import Folder, asking, place
from ..catalog.rasters import NODATA_M, Layer, RasterWriter
from ..catalog.trajectories import Row
from ..schemas.problems import InvalidInput, Problem
from ..tasks import comparison, grids, rotations
from ..tasks.grids import Grid
from . import report_figures
from .archive_states import differences
from .report import template

_BLOCK: Final = 1024
_LISTED: Final = 20
_METRES = Layer(("second minus first",), "float32", NODATA_M, "metre")
_SIGMAS = Layer(("second minus first over its 1-sigma",), "float32", NODATA_M)
_MAPS: Final = {"difference.tif": _METRES, "difference-sigmas.tif": _SIGMAS}


class _Side(NamedTuple):
    """A version: where it is, its grid, its rasters, its trajectory and its provenance."""

    folder: Folder
    grid: Grid
    crs_wkt: str
    elevation: DatasetReader
    sigma: DatasetReader
    trajectory: list[Row]
    made: dict[str, Any]


def compare(first: str | Path, second: str | Path, out: Path | None = None) -> dict[str, Any]:
    """Compare two versions of one place.

    Parameters
    ----------
    first, second : folders of versions, or URLs that fsspec reads.
    out : folder for difference.tif and difference-sigmas.tif, compare.json and compare.html; None for figures only.

    Returns
    -------
    dict
        `bathymetry`: cells gained and lost, and differences second minus first, in metres and in sigmas;
        `trajectory`, None without common images; `parameters`, `software`, `code` and `inputs` that differ.

    Raises
    ------
    InvalidInput
        If one is no version, or their grids do not fit on each other.
    """
    with ExitStack() as opened:
        sides = _open(first, opened), _open(second, opened)
        _check_fit(*sides)
        found = {
            "first": str(first),
            "second": str(second),
            "cell_m": sides[0].grid.cell_m,
            "bathymetry": _bathymetry(*sides, out),
            "trajectory": _trajectory(*(side.trajectory for side in sides)),
            **_made_differently(*(side.made for side in sides)),
        }
    if out is not None:
        (out / "compare.json").write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        _write_page(found, out, pyproj.CRS.from_wkt(sides[0].crs_wkt).is_projected)
    return found


def _wrong(path: Folder, key: str, found: str, expected: str, remedy: str) -> InvalidInput:
    return InvalidInput([Problem(str(path), None, key, found, expected, remedy)])


def _open(url: str | Path, opened: ExitStack) -> _Side:
    names = "bathymetry.tif", "uncertainty.tif", "trajectory.csv", versions.PROVENANCE
    folder = place(url)
    local = _local(folder, names, opened)
    missing = [name for name in names if not (local / name).is_file()]
    if missing:
        remedy = "Give two folders such as products/<mission id>/v1 and v2."
        raise _wrong(folder, "", f"no {missing[0]}", "a version's folder", remedy)
    opened.enter_context(rasters.gdal_settings())
    elevation, sigma = (opened.enter_context(rasterio.open(local / name)) for name in names[:2])
    cell = abs(elevation.transform.a)
    left, top = round(elevation.transform.c / cell), round(elevation.transform.f / cell)
    grid = Grid(round(cell, 9), left, top, elevation.width, elevation.height)
    made = json.loads((local / versions.PROVENANCE).read_text(encoding="utf-8"))
    trajectory = trajectories.read(local / "trajectory.csv")
    return _Side(folder, grid, elevation.crs.to_wkt(), elevation, sigma, trajectory, made)


def _local(folder: Folder, names: Sequence[str], opened: ExitStack) -> Path:
    """Where the files that are wanted, of those that are there, can be opened as long as the context lasts."""
    if isinstance(folder, Path):
        return folder
    local = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="seamosaic-compare-")))
    for name in names:
        (local / name).parent.mkdir(exist_ok=True)
        with asking(folder.fs, f"{folder}/{name}"), suppress(FileNotFoundError):
            folder.fs.get_file((folder / name).path, str(local / name))
    return local


def _check_fit(first: _Side, second: _Side) -> None:
    """Grids fit if their cells are the same squares of the same map.

    Raises
    ------
    InvalidInput
        If they do not.
    """
    a, b = first.grid, second.grid
    if a.cell_m != b.cell_m:
        remedy = f"Make one with the other's cells: --set grid.cell_m={a.cell_m:g}."
        raise _wrong(second.folder, "cell", f"{b.cell_m:g} m", f"{a.cell_m:g} m, as in {first.folder}", remedy)
    names = [pyproj.CRS.from_wkt(side.crs_wkt) for side in (first, second)]
    if names[0] != names[1]:
        remedy = "Give both missions the same crs and vertical_datum in mission.yaml."
        raise _wrong(second.folder, "crs", names[1].name, f"{names[0].name}, as in {first.folder}", remedy)
    missions = [side.made.get("mission_id") for side in (first, second)]
    if not names[0].is_projected and missions[0] != missions[1]:
        remedy = "Without navigation only versions of one mission share a frame."
        raise _wrong(second.folder, "mission", f"{missions[1]}", f"{missions[0]}, as in {first.folder}", remedy)
    if grids.intersection(a, b) is None:
        remedy = "Compare maps that overlap."
        raise _wrong(second.folder, "", "no cell in common", f"the place of {first.folder}", remedy)


def _bathymetry(first: _Side, second: _Side, out: Path | None) -> dict[str, Any]:
    grid = _union(first.grid, second.grid)
    totals = comparison.Totals(min(side.grid.width * side.grid.height for side in (first, second)))
    tags = {"FIRST": str(first.folder), "SECOND": str(second.folder)}
    with ExitStack() as files:
        writers = []
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            new = [RasterWriter(out / name, *grid, first.crs_wkt, layer, tags) for name, layer in _MAPS.items()]
            writers = [files.enter_context(writer) for writer in new]
        for part in grids.tiles(grid, _BLOCK):
            z1, sigma1, z2, sigma2 = (
                _read(file, side.grid, part) for side in (first, second) for file in (side.elevation, side.sigma)
            )
            found = comparison.difference(z1, z2, sigma1, sigma2)
            totals.add(found, np.isfinite(z1), np.isfinite(z2))
            for writer, values in zip(writers, found, strict=False):
                writer.write(part.left - grid.left, grid.top - part.top, values)
    before = totals.common + totals.lost
    return {
        "cells_first": before,
        "cells_second": totals.common + totals.gained,
        "cells_common": totals.common,
        "cells_gained": totals.gained,
        "cells_lost": totals.lost,
        "gained_share": totals.gained / before if before else None,
        "lost_share": totals.lost / before if before else None,
        "metres": totals.metres(),
        "sigmas": totals.sigmas(),
    }


def _union(a: Grid, b: Grid) -> Grid:
    left, top = min(a.left, b.left), max(a.top, b.top)
    right, bottom = max(a.left + a.width, b.left + b.width), min(a.top - a.height, b.top - b.height)
    return Grid(a.cell_m, left, top, right - left, top - bottom)


def _read(file: DatasetReader, grid: Grid, part: Grid) -> np.ndarray:
    """The cells (h, w) of a part, NaN where the file has none."""
    values, shared = np.full((part.height, part.width), np.nan), grids.intersection(grid, part)
    if shared is not None:
        rows, columns = grids.window(grid, shared)
        read = file.read(1, window=Window.from_slices(rows, columns), masked=True)
        values[grids.window(part, shared)] = read.astype(float).filled(np.nan)
    return values


def _trajectory(first: list[Row], second: list[Row]) -> dict[str, Any] | None:
    """How cameras moved, over the images that both have placed."""
    before, after = ({row.image: row for row in rows} for rows in (first, second))
    common = [(before[name], after[name]) for name in before if name in after]
    if not common:
        return None
    poses = [(a.pose, b.pose) for a, b in common if a.pose is not None and b.pose is not None]
    positions = np.array([np.subtract(b.position, a.position) for a, b in poses]).reshape(-1, 3)
    turned = [rotations.quaternion_angle_deg(np.array(a.quaternion), np.array(b.quaternion)) for a, b in poses]
    distance = np.linalg.norm(positions, axis=1)
    figures = None
    if len(poses):
        figures = {
            "position_rms_m": float(np.sqrt((distance**2).mean())),
            "position_max_m": float(distance.max()),
            "vertical_rms_m": float(np.sqrt((positions[:, 2] ** 2).mean())),
            "rotation_median_deg": float(np.median(turned)),
            "rotation_max_deg": float(np.max(turned)),
        }
    return {
        "images_common": len(common),
        "images_only_first": len(before) - len(common),
        "images_only_second": len(after) - len(common),
        "status_changed": sum(a.kind != b.kind for a, b in common),
        "placed_in_both": len(poses),
        "moved": figures,
    }


def _made_differently(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    def listed(name: str) -> list[dict[str, Any]]:
        found = differences(first.get(name) or {}, second.get(name) or {})
        return [{"name": key, "first": a, "second": b} for key, a, b in found]

    code = [{step["name"]: step["code_version"] for step in made.get("steps", ())} for made in (first, second)]
    before, after = (made.get("inputs") or {} for made in (first, second))
    inputs = {
        "added": [name for name in after if name not in before],
        "removed": [name for name in before if name not in after],
        "changed": [name for name in before if name in after and before[name]["sha256"] != after[name]["sha256"]],
    }
    return {
        "parameters": listed("parameters"),
        "software": listed("software"),
        "code": [name for name in code[0] if name in code[1] and code[0][name] != code[1][name]],
        "inputs": {kind: {"count": len(names), "names": names[:_LISTED]} for kind, names in inputs.items()},
    }


def lines(found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What was found, for a person: name and value."""
    cells = found["bathymetry"]
    yield "cells", f"{cells['cells_first']:,} before, {cells['cells_second']:,} now, of {found['cell_m']:g} m"
    shares = [f"{100 * (cells[f'{kind}_share'] or 0):.2f} %" for kind in ("gained", "lost")]
    yield "gained and lost", f"{cells['cells_gained']:,} ({shares[0]}) and {cells['cells_lost']:,} ({shares[1]})"
    yield from _height_lines(cells)
    yield from _trajectory_lines(found["trajectory"])
    for name in ("parameters", "software"):
        changes = [f"{one['name']}: {one['first']} → {one['second']}" for one in found[name]]
        yield name, "\n".join(changes) or "the same"
    yield "code of steps", ", ".join(found["code"]) or "the same"
    inputs = [f"{files['count']} {kind}" for kind, files in found["inputs"].items() if files["count"]]
    yield "input files", ", ".join(inputs) or "the same"


def _height_lines(cells: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    metres, sigmas = cells["metres"], cells["sigmas"]
    if metres:
        names = {"median": "median", "median_abs": "median size", "p95_abs": "95 % below", "rmse": "rms"}
        said = [f"{said} {1e3 * metres[name]:.2f} mm" for name, said in names.items()]
        yield "difference of heights", ", ".join(said)
    if sigmas:
        above = f"{100 * sigmas['share_above_2']:.1f} % above two"
        yield "in sigmas", f"median size {sigmas['median_abs']:.2f}, rms {sigmas['rms']:.2f}, {above}"


def _trajectory_lines(moved: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    if moved is None:
        yield "trajectory", "no image in common"
        return
    images = f"{moved['images_common']:,} in common, {moved['status_changed']} with another status"
    yield "images", f"{images}; {moved['images_only_first']} gone, {moved['images_only_second']} new"
    if moved["moved"]:
        by = moved["moved"]
        position = f"rms {1e3 * by['position_rms_m']:.2f} mm, at most {1e3 * by['position_max_m']:.2f} mm"
        yield "cameras moved", f"{position}; turned by {by['rotation_median_deg']:.4f} degrees (median)"


def _write_page(found: Mapping[str, Any], out: Path, geographic: bool) -> None:
    labels = {"difference.tif": ("second minus first (mm)", 1e3), "difference-sigmas.tif": ("in sigmas", 1.0)}
    pictures = []
    for name, (label, scale) in labels.items():
        figure = report_figures.difference_map(rasters.read_overview(out / name), geographic, label, scale)
        if figure is not None:
            pictures.append((name, report_figures.data_uri(figure)))
    page = template("compare.html").render(found=found, lines=list(lines(found)), pictures=pictures)
    (out / "compare.html").write_text(page, encoding="utf-8")
