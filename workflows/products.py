"""From stored results to a version's folder: every product of FORMATS, with quality figures and provenance."""

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import rasterio
from pyproj.crs import CompoundCRS
from rasterio.enums import Resampling

from ..catalog import meshes, metadata, netcdf, pointclouds, rasters, trajectories, vectors, versions
from ..catalog.mission_files import MissionFiles
from ..catalog.missions import OpenedMission
from ..catalog.store import digest
from ..schemas.mission import Mission
from ..schemas.products import (
    AxisDifference,
    BathymetryQuality,
    ImageCounts,
    MeshQuality,
    MissionSummary,
    MosaicQuality,
    NavigationDifference,
    PairQuality,
    Quality,
    SoundingQuality,
    SourceShares,
    TrajectoryQuality,
)
from ..schemas.provenance import InputFile, Provenance, Step
from ..tasks import mesh, rotations
from ..tasks.grids import Bounds, Grid
from . import extract, maps, mosaics, report, report_figures
from .job import Done, Job, code_version, load
from .maps import MapJob
from .plan import Plan
from .solve import Solution

_VERSION = code_version(
    sys.modules[__name__],
    report_figures,
    meshes,
    metadata,
    netcdf,
    pointclouds,
    rasters,
    trajectories,
    vectors,
    mesh,
    report,
)
_MESH_CELLS = 2_000_000
_NAMED_BY = ("image", "role", "time", "status", "sha256")


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


class Mapped(NamedTuple):
    """Results of the map tiles. outlines : (n, M, 2) footprints in map coordinates."""

    map_job: MapJob
    cell_m: float
    mosaic_cell_m: float
    surface: Tiles
    mosaic: Tiles
    outlines: np.ndarray


class Results(NamedTuple):
    """All that products are made from."""

    job: Job
    opened: OpenedMission
    plan: Plan
    out: Path
    steps: tuple[Step, ...]
    posed: Posed
    mapped: Mapped


def write(results: Results) -> tuple[Path, bool, Quality]:
    """Write the next version, unless the newest was made from the same: its folder, whether new, its figures."""
    job, mapped = results.job, results.mapped
    keys = [done.key for _, done in (*mapped.surface.tiles, *mapped.mosaic.tiles)]
    keys += [done.key for done in results.posed.extracted.values()] + [results.posed.adjusted.key]
    inputs = sorted(f"{name}:{sha}" for name, sha in results.opened.input_digests.items())
    frames = results.opened.frames
    inputs += [str(row) for row in zip(*(frames[name].values for name in _NAMED_BY), strict=True)]
    made_from = digest("products", _VERSION, [*inputs, *keys], job.parameters.model_dump(mode="json"))
    writer = versions.new_version(results.out, job.mission_id, made_from)
    if isinstance(writer, Path):
        return writer, False, Quality.model_validate_json((writer / "quality.json").read_text(encoding="utf-8"))
    with writer:
        quality = _write_all(results, writer.folder, made_from)
    assert writer.path is not None
    return writer.path, True, quality


def _write_all(results: Results, folder: Path, made_from: str) -> Quality:
    crs_wkt = _product_crs(results.opened)
    rows, navigation = _trajectory(results)
    trajectories.write(folder / "trajectory.csv", rows)
    _write_bathymetry(results, folder, crs_wkt)
    _write_mosaics(results, folder, crs_wkt)
    count = _write_soundings(results, folder, crs_wkt)
    triangles = _write_mesh(folder, crs_wkt, results)
    _write_survey(results, folder, crs_wkt, rows)
    quality = _quality(results, folder, rows, navigation, count, triangles)
    metadata.write_quality(folder / "quality.json", quality)
    provenance = _provenance(results, made_from)
    report.write_report(folder, quality, provenance, None if results.plan.prior is None else navigation)
    if results.opened.crs is not None:
        start, end = _span(results.opened)
        mission = results.opened.mission
        newest = versions.newest_version(results.out, mission.id)
        number = newest.number + 1 if newest else 1
        metadata.write_stac_item(folder, mission.id, number, mission.title, start, end, _about(mission))
    provenance = provenance.model_copy(update={"outputs": metadata.output_digests(folder)})
    metadata.write_provenance(folder / "metadata" / "provenance.json", provenance)
    return quality


def _span(opened: OpenedMission) -> tuple[datetime, datetime]:
    """First and last exposure; an image without a time has none."""
    times = opened.frames["time"].values
    times = times[~np.isnat(times)]
    return _utc(times.min()), _utc(times.max())


def _about(mission: Mission) -> dict[str, str]:
    """What mission.yaml says of platform, people, licence and place, for the metadata."""
    given = {} if mission.reporting is None else mission.reporting.model_dump(exclude_none=True)
    named = {"platform": mission.platform, "license": given.pop("licence", "")}
    return {name: value for name, value in {**named, **given}.items() if value}


def _utc(time: np.datetime64) -> datetime:
    return datetime.fromtimestamp(float(time.astype("datetime64[us]").astype(np.int64)) / 1e6, UTC)


def _product_crs(opened: OpenedMission) -> str:
    """The map's CRS with the vertical datum where one is given; the local CRS without navigation."""
    if opened.crs is None:
        return rasters.local_crs_wkt()
    horizontal = pyproj.CRS.from_wkt(opened.crs)
    if opened.vertical is None:
        return horizontal.to_wkt()
    vertical = pyproj.CRS.from_wkt(opened.vertical)
    return CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical]).to_wkt()


def vertical_reference(opened: OpenedMission) -> str:
    """What elevations are measured from, in words."""
    if opened.crs is None:
        return "the first image's centre of projection"
    if opened.vertical is not None:
        return pyproj.CRS.from_wkt(opened.vertical).name
    return "the sea surface at survey time"


def _trajectory(results: Results) -> tuple[list[trajectories.Row], np.ndarray]:
    """Rows of trajectory.csv and navigation's camera centres (n, 3), both in map coordinates."""
    frames, solution, frame = results.opened.frames, results.posed.solution, results.plan.frame
    status = _status(results)
    C_map = _map_points(frame, solution.poses.C_local)
    prior = results.plan.prior
    navigation = np.full_like(C_map, np.nan) if prior is None else _map_points(frame, prior.poses.C_local)
    rows = []
    for k, state in enumerate(status):
        pose = None if state.startswith("rejected") else _row_pose(frame, solution, C_map[k], k)
        rows.append(trajectories.Row(str(frames["image"].values[k]), frames["time"].values[k], pose, state))
    return rows, navigation


def _row_pose(frame: Any, solution: Solution, C_map: np.ndarray, k: int) -> trajectories.Pose:
    R_map_local = np.eye(3) if frame.crs is None else frame.R_map_local(C_map)
    w, x, y, z = rotations.quaternion_wxyz(R_map_local @ solution.poses.R_local_camera[k]).tolist()
    sigma_x, sigma_y, sigma_z = solution.sigma_m[k].tolist()
    return trajectories.Pose((C_map[0], C_map[1], C_map[2]), (w, x, y, z), (sigma_x, sigma_y, sigma_z))


def _map_points(frame: Any, local: np.ndarray) -> np.ndarray:
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
    for product, layer in layers.items():
        with _writer(folder, f"{product}.tif", surface.grid, crs_wkt, tags) as file:
            for tile, done in surface.tiles:
                file.write(*_inner(surface.grid, tile), load(results.job, maps.SURFACE, done.key).arrays[layer])
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


def _write_mosaics(results: Results, folder: Path, crs_wkt: str) -> None:
    tags = {"MISSION": results.opened.mission.id}
    mosaic, job = results.mapped.mosaic, results.job
    with (
        _writer(folder, "mosaic.tif", mosaic.grid, crs_wkt, tags) as colours,
        _writer(folder, "mosaic-source.tif", mosaic.grid, crs_wkt, tags) as sources,
        _writer(folder, "mosaic-planar.tif", mosaic.grid, crs_wkt, tags) as planar,
    ):
        for tile, done in mosaic.tiles:
            arrays, place = load(job, mosaics.MOSAIC, done.key).arrays, _inner(mosaic.grid, tile)
            colours.write(*place, arrays["rgb"], arrays["mask"])
            sources.write(*place, arrays["source"])
            planar.write(*place, arrays["planar_rgb"], arrays["planar_mask"])


def _write_soundings(results: Results, folder: Path, crs_wkt: str) -> int:
    """Every accepted laser point of the images that have a pose; how many."""
    grid, poses = results.mapped.surface.grid, results.posed.solution.poses
    west, south, _, _ = grid.bounds
    count, status = 0, _status(results)
    with pointclouds.SoundingsWriter(folder / "soundings.laz", crs_wkt, np.array([west, south, 0.0])) as file:
        for row, done in results.posed.extracted.items():
            if status[row].startswith("rejected") or not done.info["soundings"]:
                continue
            arrays = load(results.job, extract.STEP, done.key).arrays
            X = arrays["laser_X"] @ poses.R_local_camera[row].T + poses.C_local[row]
            frame = np.full(len(X), row, np.int32)
            file.write(results.plan.frame.map_from_local(X), frame, arrays["laser_arm"], arrays["laser_sigma"])
            count += len(X)
    return count


def _write_mesh(folder: Path, crs_wkt: str, results: Results) -> MeshQuality:
    """The surface, thinned to a bounded size, textured with the orthomosaic."""
    p, grid = results.job.parameters.mesh, results.mapped.surface.grid
    step = max(1, int(np.ceil(np.sqrt(grid.width * grid.height / _MESH_CELLS))))
    coarse = Grid(grid.cell_m * step, 0, 0, -(-grid.width // step), -(-grid.height // step))
    with rasterio.open(folder / "bathymetry.tif") as file:
        z = file.read(1, out_shape=coarse.shape, masked=True, resampling=Resampling.average).astype(float)
    with rasterio.open(folder / "mosaic.tif") as file:
        shrink = max(1.0, max(file.width, file.height) / p.texture_px)
        size = max(1, round(file.height / shrink)), max(1, round(file.width / shrink))
        texture = np.moveaxis(file.read(out_shape=(3, *size), resampling=Resampling.average), 0, -1)
        edges = file.bounds
    # a coarse cell need not lie on whole multiples of itself in the map: it counts from the grid's corner
    west, _, _, north = grid.bounds
    moved = Bounds(edges.left - west, edges.bottom - north, edges.right - west, edges.top - north)
    origin = np.array([west, north, 0.0])
    made = mesh.surface_mesh(z.filled(np.nan), coarse, np.zeros(3), moved, p.max_triangles)
    uv = np.column_stack([made.uv[:, 0], 1 - made.uv[:, 1]])  # images begin at the north, meshes at the south
    comments = [f"offset {west:.3f} {north:.3f} 0.000", f"crs {crs_wkt}"]
    colours = _sampled(texture, uv)
    meshes.write_ply(folder / "mesh.ply", made.vertices, made.triangles, colours, comments=comments)
    about = {"crs": crs_wkt, "offset": origin.tolist()}
    meshes.write_glb(folder / "mesh.glb", made.vertices, made.triangles, uv, texture, about)
    return MeshQuality(vertices=len(made.vertices), triangles=len(made.triangles))


def _sampled(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours (V, 3) of a texture (h, w, 3) at uv (V, 2), row 0 at v = 0."""
    height, width = texture.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip((uv[:, 1] * height).astype(int), 0, height - 1)
    return texture[row, column]


def _write_survey(results: Results, folder: Path, crs_wkt: str, rows: Sequence[trajectories.Row]) -> None:
    outlines = results.mapped.outlines
    footprints = [
        vectors.Footprint(outlines[k] if row.pose is not None else np.zeros((0, 2)), row.image, row.time, row.status)
        for k, row in enumerate(rows)
    ]
    placed = [row for row in rows if row.pose is not None]
    overview = rasters.read_overview(folder / "bathymetry.tif")
    elevation = overview.values[0].astype(float)
    vectors.write_survey(
        folder / "survey.gpkg",
        crs_wkt,
        footprints,
        np.array([row.pose.position for row in placed if row.pose]).reshape(-1, 3),
        np.array([row.time for row in placed], "datetime64[ns]"),
        vectors.contours(overview, vectors.contour_interval(elevation)),
        vectors.coverage(overview),
    )


def _quality(
    results: Results,
    folder: Path,
    rows: Sequence[trajectories.Row],
    navigation: np.ndarray,
    soundings: int,
    triangles: MeshQuality,
) -> Quality:
    opened = results.opened
    roles = Counter(str(role) for role in opened.frames["role"].values)
    start, end = _span(opened)
    return Quality(
        mission=MissionSummary(
            id=opened.mission.id,
            title=opened.mission.title,
            platform=opened.mission.platform,
            start=start,
            end=end,
            crs=None if opened.crs is None else pyproj.CRS.from_wkt(opened.crs).name,
            vertical_reference=vertical_reference(opened),
            images=ImageCounts(total=len(rows), by_role=dict(roles), by_status=dict(Counter(row.kind for row in rows))),
        ),
        soundings=_sounding_quality(results, soundings),
        pairs=_pair_quality(results),
        trajectory=_trajectory_quality(rows, navigation),
        bathymetry=_bathymetry_quality(folder, results.mapped.cell_m),
        mosaic=_mosaic_quality(results),
        mesh=triangles,
        warnings=(*opened.warnings, *_doubts(rows, results)),
    )


def _doubts(rows: Sequence[trajectories.Row], results: Results) -> Iterator[str]:
    """What the figures show but a hurried reader may miss."""
    alone = sum(row.kind == "navigation" for row in rows)
    if alone:
        yield f"{alone} of {len(rows)} images are placed by navigation alone: no match with another image holds them"
    turned = [rows[k].image for k in np.flatnonzero(results.posed.solution.turned).tolist()]
    if turned:
        names = ", ".join(turned[:6]) + (" ..." if len(turned) > 6 else "")
        yield (
            f"{len(turned)} of {len(rows)} images lie the other way round than mount and heading say, by their matches "
            f"with others, and were placed so (turned by a picture viewer? flown backwards?): {names}"
        )
    if results.posed.matched and not len(results.posed.solution.pairs):
        yield f"none of {len(results.posed.matched)} pairs of images could be linked"


def _sounding_quality(results: Results, count: int) -> SoundingQuality | None:
    if results.opened.calibration.laser is None:
        return None
    lit = [done for done in results.posed.extracted.values() if "soundings" in done.info]
    sigmas = [done.info["sigma_m"] for done in lit if done.info.get("sigma_m")]
    return SoundingQuality(
        count=count,
        per_image_median=float(np.median([done.info["soundings"] for done in lit])) if lit else None,
        sigma_median_m=float(np.median(sigmas)) if sigmas else None,
        reasons=dict(Counter(done.info["reason"] for done in lit if done.info.get("reason"))),
    )


def _pair_quality(results: Results) -> PairQuality:
    used = {(int(i), int(j)) for i, j in results.posed.solution.pairs}
    linked = [done.info for i, j, done in results.posed.matched if (i, j) in used]
    models = Counter(info["model"] for info in linked)
    return PairQuality(
        tried=len(results.posed.matched),
        linked=len(linked),
        homography=models["homography"],
        essential=models["essential"],
        median_inliers=float(np.median([info["inliers"] for info in linked])) if linked else None,
    )


def _trajectory_quality(rows: Sequence[trajectories.Row], navigation: np.ndarray) -> TrajectoryQuality:
    kinds = Counter(row.kind for row in rows)
    placed = [(k, row.pose) for k, row in enumerate(rows) if row.pose is not None]
    positions = np.array([pose.position for _, pose in placed]).reshape(-1, 3)
    difference = navigation[[k for k, _ in placed]] - positions if placed else np.zeros((0, 3))
    difference = difference[np.isfinite(difference).all(1)]
    sigmas = np.array([pose.sigma for _, pose in placed]).reshape(-1, 3)
    return TrajectoryQuality(
        adjusted=kinds["adjusted"],
        navigation_only=kinds["navigation"],
        rejected=kinds["rejected"],
        navigation_minus_adjusted=_difference(difference) if len(difference) else None,
        sigma_median_m=tuple(np.median(sigmas, axis=0).tolist()) if len(sigmas) else None,
    )


def _difference(difference: np.ndarray) -> NavigationDifference:
    x, y, z = (
        AxisDifference(rms_m=float(np.sqrt(np.mean(axis**2))), max_m=float(np.abs(axis).max())) for axis in difference.T
    )
    return NavigationDifference(x=x, y=y, z=z)


def _bathymetry_quality(folder: Path, cell_m: float) -> BathymetryQuality:
    heights, sigma = rasters.summarise(folder / "bathymetry.tif"), rasters.summarise(folder / "uncertainty.tif")
    codes = rasters.count_codes(folder / "source.tif")
    total = sum(codes.get(code, 0) for code in (1, 2, 3))
    shares = [codes.get(code, 0) / total if total else 0.0 for code in (1, 2, 3)]
    return BathymetryQuality(
        cell_m=cell_m,
        cells=total,
        area_m2=total * cell_m**2,
        by_source=SourceShares(laser=shares[0], image_matching=shares[1], interpolated=shares[2]),
        elevation_min_m=heights.minimum,
        elevation_median_m=heights.median,
        elevation_max_m=heights.maximum,
        sigma_median_m=sigma.median,
    )


def _mosaic_quality(results: Results) -> MosaicQuality:
    cell = results.mapped.mosaic_cell_m
    pixels = sum(done.info["pixels"] for _, done in results.mapped.mosaic.tiles)
    surface = sum(done.info["cells"] for _, done in results.mapped.surface.tiles) * results.mapped.cell_m**2
    area = pixels * cell**2
    return MosaicQuality(cell_m=cell, area_m2=area, coverage_share=min(1.0, area / surface) if surface else None)


def _provenance(results: Results, made_from: str) -> Provenance:
    job, mapped = results.job, results.mapped
    resolved = job.parameters.model_dump(mode="json")
    resolved["grid"] |= {"cell_m": mapped.cell_m, "max_interpolation_m": mapped.map_job.max_interpolation_m}
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
    )


def _inputs(opened: OpenedMission) -> Iterator[tuple[str, InputFile]]:
    """Every file of the mission that was read, with its digest and size."""
    files = MissionFiles(opened.url)
    frames = opened.frames
    images = zip(frames["image"].values.tolist(), frames["sha256"].values.tolist(), strict=True)
    for name, sha256 in (*opened.input_digests.items(), *images):
        if sha256:
            yield name, InputFile(sha256=sha256, size=int(files.fs.size(f"{files.root}/{name}") or 0))
