"""report.html: one self-contained page about a version, for a marine scientist.

Numbers come from the quality model (quality.json holds the same ones), pictures from the products in the folder. What
a mission has no data for is said to be missing, never drawn empty.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import jinja2
import numpy as np
import pyproj
import rasterio
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..catalog import rasters, trajectories
from ..schemas.products import PRODUCTS, NavigationDifference, Quality
from ..schemas.provenance import Provenance
from . import report_figures as figures
from .quality import ring_text

_REJECTED_SHOWN: Final = 200
_WORST_SHOWN: Final = 10
TEMPLATE: Final = Path(__file__).with_name("templates") / "report.html"
_WRITTEN_LATER: Final = ("report.html", "metadata/provenance.json")


class KeyFigure(NamedTuple):
    """A line of the table: what, how much, and what it means in plain words."""

    name: str
    value: str
    meaning: str


class Picture(NamedTuple):
    """A picture and its words; `uri` is None when there is nothing to show, and `caption` then says why."""

    title: str
    uri: str | None
    caption: str
    wide: bool = True


class FileLine(NamedTuple):
    """A file of the version; size is empty for those written after the report, and `there` false for none at all."""

    name: str
    size: str
    there: bool
    description: str


def template(name: str) -> jinja2.Template:
    """A page of `templates/`."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def write_report(
    folder: str | os.PathLike[str],
    quality: Quality,
    provenance: Provenance,
    navigation: NDArray[np.float64] | None = None,
) -> Path:
    """Write report.html into a version's folder, whose other products are there.

    Parameters
    ----------
    quality : every figure of the report.
    provenance : inputs, steps and software; its outputs may still be missing.
    navigation : (rows of trajectory.csv, 3) camera centres by navigation alone, map coordinates, NaN where
        unknown; None for a mission without.
    """
    root = Path(folder)
    rows = trajectories.read(root / "trajectory.csv")
    rejected = [row for row in rows if row.kind == "rejected"]
    page = template(TEMPLATE.name).render(
        quality=quality,
        title=quality.mission.title or quality.mission.id,
        key_figures=list(_key_figures(quality)),
        pictures=list(_pictures(root, rows, quality, navigation)),
        worst=_worst(quality),
        rejected=rejected[:_REJECTED_SHOWN],
        rejected_count=len(rejected),
        provenance=provenance,
        input_bytes=readable_size(sum(file.size for file in provenance.inputs.values())),
        core_seconds=sum(step.core_seconds for step in provenance.steps),
        files=[_file_line(root, name, description) for name, description, *_ in PRODUCTS],
    )
    path = root / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _worst(quality: Quality) -> list[tuple[str, str, str]]:
    """What the pairs with the largest residuals are off: names, by tie points, by crossovers."""
    found = quality.pairs.residuals if quality.pairs else ()
    order = sorted(found, key=lambda pair: -max(pair.reprojection_px or 0, 1000 * (pair.apart_m or 0)))
    return [
        (
            " – ".join(pair.images),
            "" if pair.reprojection_px is None else f"{pair.reprojection_px:.2f} px at {pair.tie_points:,} tie points",
            "" if pair.apart_m is None else f"{_length(pair.apart_m)} at {pair.crossovers:,} crossings",
        )
        for pair in order[:_WORST_SHOWN]
    ]


def readable_size(size: int) -> str:
    """A number of bytes in kB, MB or GB."""
    value = size / 1000
    for unit in ("kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


def _file_line(root: Path, name: str, description: str) -> FileLine:
    path = root / name
    size = readable_size(path.stat().st_size) if path.is_file() else ""
    return FileLine(name, size, bool(size) or name in _WRITTEN_LATER, description)


def _key_figures(quality: Quality) -> Iterator[KeyFigure]:
    yield from _image_figures(quality)
    yield from _sounding_figures(quality)
    yield from _calibration_figures(quality)
    yield from _bathymetry_figures(quality)
    yield from _other_figures(quality)


def _image_figures(quality: Quality) -> Iterator[KeyFigure]:
    images, trajectory = quality.mission.images, quality.trajectory
    roles = ", ".join(f"{count:,} {role}" for role, count in sorted(images.by_role.items()))
    yield KeyFigure("Images", f"{images.total:,}", f"in the mission: {roles}" if roles else "in the mission")
    if trajectory is None:
        return
    placed = trajectory.adjusted + trajectory.navigation_only
    yield KeyFigure(
        "Images placed",
        f"{placed:,}",
        f"{trajectory.adjusted:,} by matches or crossing laser lines, {trajectory.navigation_only:,} by navigation "
        f"alone; {trajectory.rejected:,} rejected",
    )
    if trajectory.sigma_median_m is not None:
        x, y, z = trajectory.sigma_median_m
        yield KeyFigure(
            "Position of a camera",
            f"± {_length(max(x, y))} across, ± {_length(z)} in height",
            "median 1-sigma along an axis: two times out of three the camera really was within this",
        )
    if trajectory.reprojection_rms_px is not None:
        meaning = "rms distance between where tie points are seen and where the adjusted cameras should see them"
        yield KeyFigure("Reprojection error", f"{trajectory.reprojection_rms_px:.2f} px", meaning)
    if trajectory.blocks:
        shown = ", ".join(f"{size:,}" for size in trajectory.blocks[:6]) + (
            " ..." if len(trajectory.blocks) > 6 else ""
        )
        meaning = f"of {shown} images: matches and crossing laser lines join each"
        if len(trajectory.blocks) > 1:
            meaning += ", navigation alone holds them to another"
        yield KeyFigure("Blocks of images", f"{len(trajectory.blocks):,}", meaning)
    if trajectory.navigation_minus_adjusted is not None:
        yield _difference_figure(trajectory.navigation_minus_adjusted)


def _difference_figure(difference: NavigationDifference) -> KeyFigure:
    values = [_length(axis.rms_m) for axis in (difference.x, difference.y, difference.z)]
    largest = max(axis.max_m for axis in (difference.x, difference.y, difference.z))
    return KeyFigure(
        "Navigation minus adjusted",
        f"{values[0]}, {values[1]}, {values[2]}",
        f"rms along x, y, z: how far the images moved the track from its navigation; {_length(largest)} at most",
    )


def _sounding_figures(quality: Quality) -> Iterator[KeyFigure]:
    soundings, pairs = quality.soundings, quality.pairs
    if soundings is not None:
        each = "" if soundings.per_image_median is None else f"; {soundings.per_image_median:,.0f} in a typical image"
        yield KeyFigure("Laser soundings", f"{soundings.count:,}", f"accepted points on the laser cross{each}")
        if soundings.sigma_median_m is not None:
            meaning = "median 1-sigma of detection along the ray from the camera, the calibration's own not counted"
            yield KeyFigure("Precision of a sounding", f"± {_length(soundings.sigma_median_m)}", meaning)
    if pairs is not None and pairs.tried:
        inliers = "" if pairs.median_inliers is None else f"; {pairs.median_inliers:,.0f} tie points in a typical pair"
        yield KeyFigure(
            "Linked pairs of images",
            f"{pairs.linked:,} of {pairs.tried:,}",
            f"{pairs.homography:,} as flat ground, {pairs.essential:,} as relief{inliers}",
        )
    if pairs is not None and pairs.crossover_rms_m is not None:
        meaning = f"rms distance of the laser lines of different images where they cross, {pairs.crossed:,} pairs"
        yield KeyFigure("Crossovers", _length(pairs.crossover_rms_m), meaning)


def _calibration_figures(quality: Quality) -> Iterator[KeyFigure]:
    found = quality.calibration
    if found is None:
        return
    if found.sigma_m is not None:
        meaning = "1-sigma that all soundings have in common; no averaging lessens it, and every cell's includes it"
        yield KeyFigure("Error of the calibration", f"± {_length(found.sigma_m)}", meaning)
    if found.laser_gap_m is not None and found.laser_gap_sigma_m is not None:
        yield KeyFigure(
            "Laser sheets where they meet",
            f"{1000 * found.laser_gap_m:+.2f} ± {1000 * found.laser_gap_sigma_m:.2f} mm",
            f"how much deeper arm b has the seabed than arm a, median of {found.laser_gap_images:,} images; "
            "nothing if the calibration is right",
        )
    if found.pinhole_percent is not None:
        yield KeyFigure(
            "Had the flat port been ignored",
            f"{found.pinhole_percent:+.2f} %",
            "largest error of altitudes around these, with a pinhole camera and sheets fitted in water; this run "
            "traced every ray through the port",
        )


def _bathymetry_figures(quality: Quality) -> Iterator[KeyFigure]:
    grid = quality.bathymetry
    if grid is None:
        return
    yield KeyFigure("Mapped area", f"{grid.area_m2:,.1f} m²", f"{grid.cells:,} cells of {_length(grid.cell_m)}")
    if grid.by_source is not None:
        shares = grid.by_source
        yield KeyFigure(
            "Where cells come from",
            f"{shares.laser:.0%} / {shares.image_matching:.0%} / {shares.interpolated:.0%}",
            "measured by laser / by image matching / interpolated between measured cells",
        )
    if grid.elevation_min_m is not None and grid.elevation_max_m is not None:
        median = "" if grid.elevation_median_m is None else f"; half of it lies below {grid.elevation_median_m:.3f} m"
        yield KeyFigure(
            "Elevation",
            f"{grid.elevation_min_m:.3f} to {grid.elevation_max_m:.3f} m",
            f"lowest to highest cell{median}",
        )
    if grid.sigma_median_m is not None:
        yield KeyFigure(
            "Uncertainty of a cell",
            f"± {_length(grid.sigma_median_m)}",
            "median 1-sigma, relative to the map",
        )


def _other_figures(quality: Quality) -> Iterator[KeyFigure]:
    mosaic, mesh, terrain = quality.mosaic, quality.mesh, quality.terrain
    if terrain is not None and terrain.slope_deg is not None:
        rugosity = "" if terrain.rugosity is None else f"; its surface is {terrain.rugosity:.3f} of its map"
        yield KeyFigure("Slope", f"{terrain.slope_deg:.1f}°", f"of a typical cell{rugosity}")
        yield KeyFigure(
            "Position indices",
            f"{ring_text(terrain.bpi_fine)} / {ring_text(terrain.bpi_broad)}",
            f"rings of bpi-fine and bpi-broad; contours every {_length(terrain.contour_interval_m)}",
        )
    if mosaic is not None:
        share = "" if mosaic.coverage_share is None else f"; covers {mosaic.coverage_share:.0%} of the mapped area"
        yield KeyFigure("Mosaic", f"{mosaic.area_m2:,.1f} m²", f"pixels of {_length(mosaic.cell_m)}{share}")
    if mesh is not None:
        yield KeyFigure("Mesh", f"{mesh.triangles:,} triangles", f"{mesh.vertices:,} vertices")


def _length(metres: float) -> str:
    """Millimetres below a centimetre, centimetres below a metre, then metres."""
    if metres < 0.01:
        return f"{1000 * metres:.2g} mm"
    return f"{100 * metres:.3g} cm" if metres < 1 else f"{metres:.3g} m"


def _pictures(
    root: Path, rows: list[trajectories.Row], quality: Quality, navigation: NDArray[np.float64] | None
) -> Iterator[Picture]:
    bathymetry = _overview(root / "bathymetry.tif")
    geographic = _is_projected(root / "bathymetry.tif")
    reference = quality.mission.vertical_reference
    yield _picture(
        "Bathymetry",
        figures.bathymetry_map(bathymetry, geographic) if bathymetry is not None else None,
        "Elevation of the seabed, lit from the north-west; relief is exaggerated in the shading only."
        + (f" Heights: {reference}." if reference else ""),
    )
    yield from _mosaics(root, geographic)
    yield from _layers(root, geographic)
    yield from _terrain(root, geographic)
    soundings = root / "soundings.laz"
    yield _picture(
        "Precision of soundings",
        figures.sigma_histogram(soundings) if soundings.is_file() else None,
        "1-sigma of every accepted laser point along its ray, the calibration's included. A bar at 20 mm counts all "
        "beyond.",
        wide=False,
    )
    yield _picture(
        "Track",
        figures.track_map(rows, bathymetry, geographic),
        "Where each image was taken. Adjusted: placed by matches with other images or crossing laser lines; "
        "navigation: by "
        "navigation alone.",
    )
    yield _picture(
        "Residuals of images and pairs",
        figures.residuals(quality),
        "Left: what tie points are off in each image, in order of time. Right: the same of each pair, and how far "
        "apart the laser lines of a pair are where they cross.",
    )
    yield _picture(
        "Navigation minus adjusted",
        figures.navigation_difference(rows, navigation) if navigation is not None else None,
        "How far navigation alone would have put each camera from where the images put it."
        if navigation is not None
        else "The mission has no navigation: its map is a local frame.",
    )


def _mosaics(root: Path, geographic: bool) -> Iterator[Picture]:
    captions = {
        "mosaic.tif": ("Orthomosaic", "Images laid over the 3D surface; the laser is removed."),
        "mosaic-planar.tif": ("Planar mosaic", "The conventional mosaic, as if the seabed were flat, to compare."),
    }
    for name, (title, caption) in captions.items():
        overview = _overview(root / name)
        figure = figures.picture_map(overview, geographic) if overview is not None else None
        yield _picture(title, figure, caption, kind="jpeg")


def _layers(root: Path, geographic: bool) -> Iterator[Picture]:
    uncertainty, density, source = (_overview(root / f"{name}.tif") for name in ("uncertainty", "density", "source"))
    yield _picture(
        "Uncertainty",
        figures.quantity_map(uncertainty, geographic, "1-sigma (mm)", scale=1000) if uncertainty is not None else None,
        "1-sigma of each cell's elevation, relative to the map; that of navigation's datum is in trajectory.csv.",
        wide=False,
    )
    yield _picture(
        "Source",
        figures.source_map(source, geographic) if source is not None else None,
        "Where each cell comes from. Interpolated cells were not measured.",
        wide=False,
    )
    yield _picture(
        "Density",
        figures.quantity_map(density, geographic, "soundings in a cell", log=True) if density is not None else None,
        "Soundings in each cell; cells without are left white.",
        wide=False,
    )


def _terrain(root: Path, geographic: bool) -> Iterator[Picture]:
    shown = {
        "slope": ("Slope", "slope (degrees)", "Steepest slope of each cell."),
        "bpi-broad": ("Position", "height above ring (m)", "Bathymetric position index, wide ring: crests, hollows."),
        "vrm": ("Ruggedness", "VRM", "Vector ruggedness: 0 where the ground is plane, whatever its slope."),
    }
    for name, (title, label, caption) in shown.items():
        overview = _overview(root / f"terrain/{name}.tif")
        figure = figures.quantity_map(overview, geographic, label) if overview is not None else None
        yield _picture(title, figure, caption, wide=False)


def _picture(title: str, figure: Figure | None, caption: str, wide: bool = True, kind: str = "png") -> Picture:
    return Picture(title, None if figure is None else figures.data_uri(figure, kind), caption, wide)


def _overview(path: Path) -> rasters.Overview | None:
    return rasters.read_overview(path, figures.MAP_PX) if path.is_file() else None


def _is_projected(path: Path) -> bool:
    """Whether the map has a place on Earth, or is a local frame."""
    if not path.is_file():
        return False
    with rasterio.open(path) as file:
        crs = pyproj.CRS.from_wkt(file.crs.to_wkt())
    return crs.is_projected or any(part.is_projected for part in crs.sub_crs_list)
