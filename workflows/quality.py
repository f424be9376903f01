"""The figures of quality.json: what a run counted and measured of its own results."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyproj

from ..catalog import rasters, trajectories
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
    RingScale,
    SoundingQuality,
    SourceShares,
    TerrainQuality,
    TrajectoryQuality,
)
from ..tasks.derivatives import Ring
from ..tasks.rings import rings
from . import calibration_quality, plan, residual_quality
from .results import Results, span, vertical_reference

_MANY_DARK = 0.5  # of the images in which the laser should be


def figures(
    results: Results,
    folder: Path,
    rows: Sequence[trajectories.Row],
    navigation: np.ndarray,
    soundings: int,
    triangles: MeshQuality,
) -> Quality:
    """All figures of a version.

    rows : of trajectory.csv. navigation : its camera centres (n, 3), map. soundings : how many were written.
    folder : where the rasters are.
    """
    opened = results.opened
    calibration = calibration_quality.measured(results)
    solution = results.posed.solution
    block = residual_quality.held_together(solution)
    roles = Counter(str(role) for role in opened.frames["role"].values)
    start, end = span(opened)
    return Quality(
        mission=MissionSummary(
            id=opened.mission.id,
            title=opened.mission.title,
            platform=opened.mission.platform,
            start=start,
            end=end,
            crs=None if opened.crs is None else pyproj.CRS.from_wkt(opened.crs).name,
            vertical_reference=vertical_reference(opened),
            reporting=opened.mission.reporting,
            images=ImageCounts(total=len(rows), by_role=dict(roles), by_status=dict(Counter(row.kind for row in rows))),
        ),
        soundings=_sounding_quality(results, soundings),
        calibration=calibration,
        pairs=_pair_quality(results),
        trajectory=_trajectory_quality(rows, navigation, solution.reprojection_px).model_copy(
            update={
                "blocks": residual_quality.sizes(rows, block),
                "images": tuple(residual_quality.images(rows, navigation, solution, block)),
            }
        ),
        bathymetry=_bathymetry_quality(folder, results.mapped.cell_m),
        terrain=_terrain_quality(results, folder),
        mosaic=_mosaic_quality(results, folder),
        mesh=triangles,
        warnings=(
            *opened.warnings,
            *_doubts(rows, results),
            *residual_quality.doubts(rows, block),
            *calibration_quality.doubts(calibration, calibration_quality.typical_range(results)),
        ),
    )


def _doubts(rows: Sequence[trajectories.Row], results: Results) -> Iterator[str]:
    """What the figures show but a hurried reader may miss."""
    alone = sum(row.kind == "navigation" for row in rows)
    if alone:
        yield (
            f"{alone} of {len(rows)} images are placed by navigation alone: neither matches nor crossing laser lines "
            "hold them"
        )
    turned = [rows[k].image for k in np.flatnonzero(results.posed.solution.turned).tolist()]
    if turned:
        names = ", ".join(turned[:6]) + (" ..." if len(turned) > 6 else "")
        yield (
            f"{len(turned)} of {len(rows)} images lie the other way round than mount and heading say, by their matches "
            f"with others, and were placed so (turned by a picture viewer? flown backwards?): {names}"
        )
    if len(results.posed.solution.pairs) and results.posed.solution.reprojection_px is None:
        yield (
            "poses are from the motions of pairs alone: tie points were too few, or with the laser's ranges left "
            "something open, such as the scale"
        )
    yield from _dark(results)
    if results.posed.matched and not len(results.posed.solution.pairs):
        yield f"none of {len(results.posed.matched)} pairs of images could be linked"


def _dark(results: Results) -> Iterator[str]:
    """Whether the laser was missed where it should be."""
    job, extracted = results.job, results.posed.extracted
    lit = [extracted[image.row] for image in results.plan.images if image.role != "texture"]
    dark = sum(not done.info["soundings"] for done in lit)
    if job.calibration.laser is not None and dark > _MANY_DARK * len(lit):
        height = float(np.median(results.plan.range_m))
        measured = np.isfinite(results.opened.frames["altitude"].values).any()
        why = plan.beyond_the_laser(job.parameters, height) if measured else ""
        yield f"no laser was found in {dark} of {len(lit)} images that should show it" + (f"; {why}" if why else "")


def _sounding_quality(results: Results, count: int) -> SoundingQuality | None:
    roles = results.opened.frames["role"].values
    if results.opened.calibration.laser is None or (roles == "texture").all():
        return None
    extracted = results.posed.extracted.items()
    lit = [done for row, done in extracted if roles[row] != "texture" and not done.info["status"]]
    sigmas = [done.info["sigma_m"] for done in lit if done.info.get("sigma_m")]
    return SoundingQuality(
        count=count,
        per_image_median=float(np.median([done.info["soundings"] for done in lit])) if lit else None,
        sigma_median_m=float(np.median(sigmas)) if sigmas else None,
        reasons=dict(Counter(done.info["reason"] for done in lit if done.info.get("reason"))),
    )


def _pair_quality(results: Results) -> PairQuality | None:
    left, names = results.posed.solution.residuals, [str(name) for name in results.opened.frames["image"].values]
    crossed = 0 if left is None else len(left.crossed)
    if not results.posed.matched and not crossed:
        return None
    used = {(int(i), int(j)) for i, j in results.posed.solution.pairs}
    linked = [done.info for i, j, done in results.posed.matched if (i, j) in used]
    models = Counter(info["model"] for info in linked)
    return PairQuality(
        tried=len(results.posed.matched),
        linked=len(linked),
        homography=models["homography"],
        essential=models["essential"],
        median_inliers=float(np.median([info["inliers"] for info in linked])) if linked else None,
        crossed=crossed,
        crossover_rms_m=residual_quality.crossover_rms(results.posed.solution),
        residuals=tuple(residual_quality.pairs(names, results.posed.solution)),
    )


def _trajectory_quality(
    rows: Sequence[trajectories.Row], navigation: np.ndarray, reprojection_px: float | None
) -> TrajectoryQuality:
    kinds = Counter(row.kind for row in rows)
    placed = [(k, row.pose) for k, row in enumerate(rows) if row.pose is not None]
    positions = np.array([pose.position for _, pose in placed]).reshape(-1, 3)
    adjusted = np.array([rows[k].kind == "adjusted" for k, _ in placed], bool)
    difference = navigation[[k for k, _ in placed]] - positions if placed else np.zeros((0, 3))
    difference = difference[adjusted & np.isfinite(difference).all(1)]
    sigmas = np.array([pose.sigma for _, pose in placed]).reshape(-1, 3)
    return TrajectoryQuality(
        adjusted=kinds["adjusted"],
        navigation_only=kinds["navigation"],
        rejected=kinds["rejected"],
        navigation_minus_adjusted=_difference(difference) if len(difference) else None,
        sigma_median_m=tuple(np.median(sigmas, axis=0).tolist()) if len(sigmas) else None,
        reprojection_rms_px=reprojection_px,
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


def _terrain_quality(results: Results, folder: Path) -> TerrainQuality:
    cell = results.mapped.cell_m
    fine, broad = rings(results.job.parameters.terrain, cell)
    slope, vrm, rugosity, roughness = (
        rasters.summarise(folder / f"terrain/{name}.tif").median for name in ("slope", "vrm", "rugosity", "roughness")
    )
    return TerrainQuality(
        slope_deg=slope,
        vrm=vrm,
        rugosity=rugosity,
        roughness_m=roughness,
        bpi_fine=ring_scale(fine, cell),
        bpi_broad=ring_scale(broad, cell),
        contour_interval_m=results.mapped.terrain.interval_m,
    )


def ring_scale(ring: Ring, cell_m: float) -> RingScale:
    """A ring in cells and in metres."""
    inner, outer = ring
    return RingScale(inner_cells=inner, outer_cells=outer, inner_m=inner * cell_m, outer_m=outer * cell_m)


def ring_text(scale: RingScale) -> str:
    """A ring's scale in words."""
    return f"{scale.inner_cells} to {scale.outer_cells} cells, {scale.inner_m:g} to {scale.outer_m:g} m"


def _mosaic_quality(results: Results, folder: Path) -> MosaicQuality | None:
    cell = results.mapped.mosaic_cell_m
    pixels = sum(done.info["pixels"] for _, done in results.mapped.mosaic.tiles)
    if not pixels:
        return None
    painted = sum(done.info["painted"] for _, done in results.mapped.mosaic.tiles)
    return MosaicQuality(
        cell_m=cell,
        area_m2=pixels * cell**2,
        coverage_share=rasters.covered_share(folder / "bathymetry.tif", folder / "mosaic.tif"),
        painted_share=painted / pixels,
    )
