"""From stored results to a version's folder: every product of FORMATS, with quality figures and provenance."""

import re
import sys
from collections import ChainMap
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from pyproj.crs import CompoundCRS

from ..catalog import memory, meshes, metadata, netcdf, pointclouds, rasters, tiles3d, trajectories, vectors, versions
from ..catalog.filesystems import Folder
from ..catalog.mission_files import MissionFiles
from ..catalog.missions import OpenedMission
from ..catalog.store import digest
from ..schemas.mission import Mission
from ..schemas.products import Quality
from ..schemas.provenance import InputFile, Provenance
from ..tasks import contours, derivatives, rotations
from ..tasks.frames import MapFrame
from ..tasks.grids import Grid
from ..tasks.rings import rings
from . import (
    calibration_quality,
    extract,
    layers,
    maps,
    mesh_products,
    mosaics,
    quality,
    report,
    report_figures,
    residual_quality,
    unchanged,
)
from .job import Done, code_version, load, stage
from .results import Results, span, vertical_reference
from .solve import Solution

DECIDING = (
    *(sys.modules[__name__], report_figures, meshes, metadata, netcdf, pointclouds, rasters, trajectories, vectors),
    *(contours, mesh_products, tiles3d, report, quality, calibration_quality, residual_quality, unchanged),
)
VERSION = code_version(*DECIDING, pages=[report.TEMPLATE])
_WRITERS = 2  # each holds a tile
_STAC_LICENCE = re.compile(r"[\w.+-]+")  # an SPDX identifier; other texts STAC has no field for


def write(results: Results) -> tuple[Folder, bool, Quality]:
    """Write the next version, unless the newest was made from the same: its folder, whether new, its figures."""
    job, mapped = results.job, results.mapped
    tiles = *mapped.surface.tiles, *mapped.terrain.layers.tiles, *mapped.mosaic.tiles
    keys = [done.key for done in (*(done for _, done in tiles), *mapped.terrain.contours, *mapped.mesh.values())]
    keys += [done.key for done in results.posed.extracted.values()] + [results.posed.adjusted.key]
    inputs = memory.inputs_digest(results.opened)
    made_from = digest("products", VERSION, [inputs, *keys], job.parameters.model_dump(mode="json"))
    writer = versions.new_version(results.out, job.mission_id, made_from)
    if not isinstance(writer, versions.VersionWriter):
        return writer, False, Quality.model_validate_json((writer / "quality.json").read_text(encoding="utf-8"))
    with writer:
        figures = _write_all(results, writer.folder, made_from)
    assert writer.path is not None
    return writer.path, True, figures


def _write_all(results: Results, folder: Path, made_from: str) -> Quality:
    crs_wkt, before = _product_crs(results.opened), unchanged.newest(results.out, results.job.mission_id)
    parts = _parts(results, crs_wkt)
    rows, navigation = _trajectory(results)
    trajectories.write(folder / "trajectory.csv", rows)
    taken = {part: unchanged.take(before, folder, part, made) for part, made in parts.items()}
    wanted = [_write_bathymetry, _write_terrain]
    wanted += [] if taken["mosaics"] else [_write_mosaic, _write_planar]
    wanted += [] if taken["soundings"] else [_write_soundings]
    _side_by_side(wanted, results, folder, crs_wkt)
    triangles = before.quality.mesh if before and taken["mesh"] else None
    triangles = triangles or mesh_products.write(results, folder, crs_wkt)
    _write_survey(results, folder, crs_wkt, rows)
    count = sum(done.info["soundings"] for done, _ in _sounded(results))
    figures = quality.figures(results, folder, rows, navigation, count, triangles)
    metadata.write_quality(folder / "quality.json", figures)
    provenance = _provenance(results, made_from)
    report.write_report(folder, figures, provenance, None if results.plan.prior is None else navigation)
    digests = metadata.output_digests(folder, dict(ChainMap(*taken.values())))
    provenance = provenance.model_copy(update={"parts": parts, "outputs": digests})
    metadata.write_provenance(folder / "metadata" / "provenance.json", provenance)
    (start, end), mission = span(results.opened), results.opened.mission
    number = versions.next_number(results.out, mission.id)
    # last: it lists all other files
    metadata.write_stac_item(folder, mission.id, number, mission.title, start, end, digests, _about(mission))
    return figures


def _side_by_side(write: Sequence[Callable[[Results, Path, str], None]], *given: Any) -> None:
    """Write groups of files, two at a time: most of it is GDAL's work."""
    with ThreadPoolExecutor(_WRITERS) as pool:
        written = [pool.submit(one, *given) for one in write]
        try:
            for each in written:
                each.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _parts(results: Results, crs_wkt: str) -> dict[str, str]:
    """What each group of files that versions may share is made from."""
    job, mapped, posed = results.job, results.mapped, results.posed
    common = [VERSION, memory.inputs_digest(results.opened), crs_wkt]
    made = {
        "mosaics": [str(mapped.mosaic.grid), *(done.key for _, done in mapped.mosaic.tiles)],
        "soundings": [posed.adjusted.key, *(done.key for done in posed.extracted.values())],
        "mesh": [str(mapped.ground.grid), *(done.key for done in mapped.mesh.values())],
    }
    return {part: digest(part, VERSION, [*common, *keys], stage(job.parameters.mesh)) for part, keys in made.items()}


def _about(mission: Mission) -> dict[str, str]:
    """What mission.yaml says of platform, people, licence and place, for the metadata."""
    given = {} if mission.reporting is None else mission.reporting.model_dump(exclude_none=True)
    licence = given.get("licence", "")
    if _STAC_LICENCE.fullmatch(licence):
        del given["licence"]
    named = {"platform": mission.platform, "license": licence and ("other" if "licence" in given else licence)}
    return {name: value for name, value in {**named, **given}.items() if value}


def _product_crs(opened: OpenedMission) -> str:
    """The map's CRS with the vertical datum where one is given; the local CRS without navigation."""
    if opened.crs is None:
        return rasters.local_crs_wkt()
    horizontal = pyproj.CRS.from_wkt(opened.crs)
    if opened.vertical is None:
        return horizontal.to_wkt()
    vertical = pyproj.CRS.from_wkt(opened.vertical)
    return CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical]).to_wkt()


def _trajectory(results: Results) -> tuple[list[trajectories.Row], np.ndarray]:
    """Rows of trajectory.csv and navigation's camera centres (n, 3), both in map coordinates."""
    frames, solution, frame = results.opened.frames, results.posed.solution, results.plan.frame
    status = _status(results)
    C_map = _map_points(frame, solution.poses.C_local)
    prior = results.plan.prior
    navigation = np.full_like(C_map, np.nan) if prior is None else _map_points(frame, prior.poses.C_local)
    placed = [k for k, state in enumerate(status) if not state.startswith("rejected")]
    poses = dict(zip(placed, _poses(frame, solution, C_map, placed), strict=True))
    taken = zip(frames["image"].values.tolist(), frames["time"].values, status, strict=True)
    rows = [trajectories.Row(image, time, poses.get(k), state) for k, (image, time, state) in enumerate(taken)]
    return rows, navigation


def _poses(frame: MapFrame, solution: Solution, C_map: np.ndarray, rows: Sequence[int]) -> Iterator[trajectories.Pose]:
    R_map_local = frame.R_map_local(C_map[rows])
    quaternions = rotations.quaternion_wxyz(R_map_local @ solution.poses.R_local_camera[rows])
    sigmas = _along_map_axes(solution, R_map_local, rows)
    for place, turn, sigma in zip(C_map[rows].tolist(), quaternions.tolist(), sigmas.tolist(), strict=True):
        yield trajectories.Pose(tuple(place), tuple(turn), tuple(sigma))


def _along_map_axes(solution: Solution, R_map_local: np.ndarray, rows: Sequence[int]) -> np.ndarray:
    """1-sigma (n, 3) of the cameras' centres: near a pole the map's axes lie any way to east and north."""
    local = solution.sigma_m[rows, None] ** 2 * np.eye(3)
    local[:, 0, 1] = local[:, 1, 0] = solution.covariance_xy_m2[rows]
    return np.sqrt(np.einsum("nij,njk,nik->ni", R_map_local, local, R_map_local))


def _map_points(frame: MapFrame, local: np.ndarray) -> np.ndarray:
    known = np.isfinite(local).all(1)
    points = np.full_like(local, np.nan)
    points[known] = frame.map_from_local(local[known])
    return points


def _status(results: Results) -> list[str]:
    """Per image: why it was rejected on opening or on decoding, else what the adjustment made of it."""
    opened = [str(status) for status in results.opened.frames["status"].values]
    found = []
    for k, adjusted in enumerate(results.posed.solution.status):
        done = results.posed.extracted.get(k)
        decoded = done.info["status"] if done else ""
        found.append(opened[k] or decoded or adjusted)
    return found


def _writer(folder: Path, name: str, grid: Grid, crs_wkt: str, tags: dict[str, str]) -> rasters.RasterWriter:
    return rasters.product_writer(folder, name, *grid, crs_wkt=crs_wkt, tags=tags)


def _inner(grid: Grid, tile: Grid) -> tuple[int, int]:
    return tile.left - grid.left, grid.top - tile.top


def _write_bathymetry(results: Results, folder: Path, crs_wkt: str) -> None:
    surface, opened = results.mapped.surface, results.opened
    tags = {"VERTICAL_REFERENCE": vertical_reference(opened), "MISSION": opened.mission.id}
    layers = {"bathymetry": "elevation", "uncertainty": "sigma", "density": "density", "source": "source"}
    common = calibration_quality.median_sigma(results) or 0.0
    for product, layer in layers.items():
        with _writer(folder, f"{product}.tif", surface.grid, crs_wkt, tags) as file:
            for tile, done in surface.tiles:
                values = load(results.job, maps.SURFACE, done.key, (layer,)).arrays[layer]
                # an error of the calibration is the same in all soundings: it goes to the sigma last, never averaged
                file.write(*_inner(surface.grid, tile), np.hypot(values, common) if layer == "sigma" else values)
    reporting = opened.mission.reporting
    attributes = {
        "platform": opened.mission.platform,
        "institution": reporting.organisation if reporting else None,
        "license": reporting.licence if reporting else None,
    }
    netcdf.write_bathymetry(
        folder / "bathymetry.nc",
        *(folder / f"{product}.tif" for product in layers),
        title=opened.mission.title or opened.mission.id,
        history=f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} seamosaic run",
        vertical_reference=vertical_reference(opened),
        attributes={name: value for name, value in attributes.items() if value},
    )


def _write_terrain(results: Results, folder: Path, crs_wkt: str) -> None:
    found, job = results.mapped.terrain.layers, results.job
    fine, broad = rings(job.parameters.terrain, results.mapped.cell_m)
    shown = {"bpi-fine": fine, "bpi-broad": broad}
    with ExitStack() as stack:
        files = {}
        for name in derivatives.LAYERS:
            tags = {"MISSION": results.opened.mission.id}
            if name in shown:
                tags["RING"] = quality.ring_text(quality.ring_scale(shown[name], results.mapped.cell_m))
            files[name] = stack.enter_context(_writer(folder, f"terrain/{name}.tif", found.grid, crs_wkt, tags))
        for tile, done in found.tiles:
            for name, values in load(job, layers.TERRAIN, done.key).arrays.items():
                files[name].write(*_inner(found.grid, tile), values)


def _write_mosaic(results: Results, folder: Path, crs_wkt: str) -> None:
    tags = {"MISSION": results.opened.mission.id}
    mosaic, job = results.mapped.mosaic, results.job
    with (
        _writer(folder, "mosaic.tif", mosaic.grid, crs_wkt, tags) as colours,
        _writer(folder, "mosaic-source.tif", mosaic.grid, crs_wkt, tags) as sources,
        _writer(folder, "mosaic-painted.tif", mosaic.grid, crs_wkt, tags) as painted,
    ):
        for tile, done in mosaic.tiles:
            arrays = mosaics.layers(job, tile, done, ("rgb", "mask", "source", "painted"))
            place = _inner(mosaic.grid, tile)
            colours.write(*place, arrays["rgb"], arrays["mask"])
            sources.write(*place, arrays["source"])
            painted.write(*place, arrays["painted"])


def _write_planar(results: Results, folder: Path, crs_wkt: str) -> None:
    mosaic, tags = results.mapped.mosaic, {"MISSION": results.opened.mission.id}
    with _writer(folder, "mosaic-planar.tif", mosaic.grid, crs_wkt, tags) as planar:
        for tile, done in mosaic.tiles:
            arrays = mosaics.layers(results.job, tile, done, ("planar_rgb", "planar_mask"))
            planar.write(*_inner(mosaic.grid, tile), arrays["planar_rgb"], arrays["planar_mask"])


def _sounded(results: Results) -> Iterator[tuple[Done, int]]:
    """Extractions with soundings, and their rows, of the images that have a pose."""
    status = _status(results)
    for row, done in results.posed.extracted.items():
        if done.info["soundings"] and not status[row].startswith("rejected"):
            yield done, row


def _write_soundings(results: Results, folder: Path, crs_wkt: str) -> None:
    """Every accepted laser point of the images that have a pose."""
    poses, error = results.posed.solution.poses, calibration_quality.of_calibration(results.job)
    west, south = np.floor(np.nanmin(results.mapped.outlines.reshape(-1, 2), axis=0))
    with pointclouds.SoundingsWriter(folder / "soundings.laz", crs_wkt, np.array([west, south, 0.0])) as file:
        for done, row in _sounded(results):
            names = "laser_X", "laser_uv", "laser_arm", "laser_sigma"
            arrays = load(results.job, extract.STEP, done.key, names).arrays
            X = arrays["laser_X"] @ poses.R_local_camera[row].T + poses.C_local[row]
            frame = np.full(len(X), row, np.int32)
            sigma = np.hypot(arrays["laser_sigma"], calibration_quality.soundings_sigma(error, dict(arrays)))
            file.write(results.plan.frame.map_around(X, poses.C_local[row]), frame, arrays["laser_arm"], sigma)


def _write_survey(results: Results, folder: Path, crs_wkt: str, rows: Sequence[trajectories.Row]) -> None:
    outlines = results.mapped.outlines
    footprints = [
        vectors.Footprint(outlines[k] if row.pose is not None else np.zeros((0, 2)), row.image, row.time, row.status)
        for k, row in enumerate(rows)
    ]
    placed = [row for row in rows if row.pose is not None]
    parts = [
        contours.Contours(**load(results.job, layers.CONTOURS, done.key).arrays)
        for done in results.mapped.terrain.contours
    ]
    lines = contours.join(parts, results.mapped.cell_m).lines()
    vectors.write_survey(
        folder / "survey.gpkg",
        crs_wkt,
        footprints,
        np.array([row.pose.position for row in placed if row.pose]).reshape(-1, 3),
        np.array([row.time for row in placed], "datetime64[ns]"),
        [vectors.Contour(elevation, line) for elevation, line in lines],
        vectors.coverage(rasters.read_overview(folder / "bathymetry.tif")),
        sum(done.info["cells"] for _, done in results.mapped.surface.tiles) * results.mapped.cell_m**2,
    )


def _provenance(results: Results, made_from: str) -> Provenance:
    job, mapped = results.job, results.mapped
    resolved = job.parameters.model_dump(mode="json")
    resolved["grid"] |= {"cell_m": mapped.cell_m, "max_interpolation_m": mapped.map_job.max_interpolation_m}
    resolved["grid"]["max_sigma_m"] = mapped.surface.tiles[0][1].info["max_sigma_m"]
    resolved["mosaic"]["cell_m"] = mapped.mosaic_cell_m
    return Provenance(
        digest=made_from,
        mission_id=job.mission_id,
        created=datetime.now(UTC),
        software=metadata.software_versions(),
        host=metadata.host(),
        inputs=dict(_inputs(results.opened)),
        parameters=resolved,
        steps=results.steps,
        request=results.request,
    )


def _inputs(opened: OpenedMission) -> Iterator[tuple[str, InputFile]]:
    """Every file of the mission that was read, with its digest and size."""
    files = MissionFiles(opened.url)
    frames = opened.frames
    for name, sha256 in opened.input_digests.items():
        yield name, InputFile(sha256=sha256, size=int(files.fs.size(f"{files.root}/{name}") or 0))
    for name, sha256, size in zip(*(frames[of].values.tolist() for of in ("image", "sha256", "size")), strict=True):
        if sha256:
            yield name, InputFile(sha256=sha256, size=size)
