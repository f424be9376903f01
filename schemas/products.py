"""What comes out: the product table (FORMATS, "Products") and the figures of quality.json and report.html."""

from datetime import datetime
from typing import Annotated, Final, NamedTuple

from pydantic import Field

from .base import Model
from .mission import Reporting

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Metres = Annotated[float, Field(ge=0, description="metres")]
Vector = tuple[float, float, float]

_COG: Final = "image/tiff; application=geotiff; profile=cloud-optimized"


class Product(NamedTuple):
    """One file of a version.

    Attributes
    ----------
    name : path inside the version's folder, forward slashes.
    description : for a person, one line.
    media_type : as in a STAC asset.
    role : STAC asset role: data, visual, overview or metadata.
    """

    name: str
    description: str
    media_type: str
    role: str


PRODUCTS: Final[tuple[Product, ...]] = (
    Product("bathymetry.tif", "Elevation of the seabed, metres, positive up", _COG, "data"),
    Product("uncertainty.tif", "1-sigma of each cell's elevation relative to the map, metres", _COG, "data"),
    Product("density.tif", "Number of soundings in each cell", _COG, "data"),
    Product("source.tif", "Where each cell comes from: 1 laser, 2 image matching, 3 interpolated", _COG, "data"),
    Product("bathymetry.nc", "The four layers above in one CF-NetCDF file", "application/x-netcdf", "data"),
    Product("terrain/slope.tif", "Steepest slope, degrees (Horn 1981)", _COG, "data"),
    Product("terrain/aspect.tif", "Where the slope faces, degrees from grid north; none where flat", _COG, "data"),
    Product(
        "terrain/profile-curvature.tif",
        "Curvature down the slope, 1/m, convex positive (Zevenbergen)",
        _COG,
        "data",
    ),
    Product(
        "terrain/plan-curvature.tif",
        "Curvature across the slope, 1/m, ridges positive (Zevenbergen)",
        _COG,
        "data",
    ),
    Product("terrain/bpi-fine.tif", "Height above a narrow ring around, metres (Lundblad 2006)", _COG, "data"),
    Product("terrain/bpi-broad.tif", "Height above a wide ring around, metres (Lundblad 2006)", _COG, "data"),
    Product("terrain/vrm.tif", "Vector ruggedness, 0 smooth to 1 (Sappington 2007)", _COG, "data"),
    Product("terrain/rugosity.tif", "Area of the surface over that of its map (Jenness 2004)", _COG, "data"),
    Product("terrain/roughness.tif", "Highest less lowest of 3 x 3 cells, metres (Wilson 2007)", _COG, "data"),
    Product("terrain/tri.tif", "Mean difference from the eight neighbours, metres (Wilson 2007)", _COG, "data"),
    Product("terrain/tpi.tif", "Height above the eight neighbours, metres (Wilson 2007)", _COG, "data"),
    Product("mosaic.tif", "Orthomosaic over the 3D model, laser removed", _COG, "visual"),
    Product(
        "mosaic-source.tif", "Which image is behind each mosaic pixel: row of trajectory.csv, from 0", _COG, "data"
    ),
    Product(
        "mosaic-painted.tif",
        "1 where only laser light shows the seabed and colours are those around it, else 0",
        _COG,
        "data",
    ),
    Product("mosaic-planar.tif", "Conventional 2D mosaic that takes the seabed as a plane, to compare", _COG, "visual"),
    Product("mesh.ply", "Coloured surface about a local origin", "application/ply", "data"),
    Product("mesh.glb", "Textured surface about a local origin, for viewers", "model/gltf-binary", "visual"),
    Product(
        "mesh-3dtiles/tileset.json",
        "The whole surface at full detail, as 3D Tiles 1.1: this file names the others",
        "application/json",
        "visual",
    ),
    Product(
        "soundings.laz", "Every accepted laser point with image number, arm and sigma", "application/vnd.laszip", "data"
    ),
    Product("trajectory.csv", "Position, attitude, sigma and status of every image", "text/csv", "data"),
    Product(
        "survey.gpkg", "Footprints, track, contours and coverage, for a GIS", "application/geopackage+sqlite3", "data"
    ),
    Product("quality.json", "Every figure of the report, for programs", "application/json", "metadata"),
    Product("report.html", "This report", "text/html", "overview"),
    Product(
        "metadata/provenance.json",
        "Every input, parameter and step behind this version",
        "application/json",
        "metadata",
    ),
)


class ImageCounts(Model):
    """How many images of what kind, and what became of them."""

    total: Count
    by_role: dict[str, Count] = Field(default_factory=dict)
    by_status: dict[str, Count] = Field(default_factory=dict, description="adjusted, navigation, rejected")


class MissionSummary(Model):
    """The title block."""

    id: str
    title: str = ""
    platform: str = ""
    start: Annotated[datetime | None, Field(description="first exposure that counts, UTC")] = None
    end: Annotated[datetime | None, Field(description="last exposure that counts, UTC")] = None
    crs: Annotated[str | None, Field(description="name of the map's CRS; absent for a local frame")] = None
    vertical_reference: Annotated[str, Field(description="what elevations are measured from")] = ""
    reporting: Annotated[Reporting | None, Field(description="as mission.yaml has it")] = None
    images: ImageCounts


class SoundingQuality(Model):
    """Laser points."""

    count: Count
    per_image_median: Annotated[float | None, Field(ge=0, description="over images with a laser")] = None
    sigma_median_m: Annotated[
        Metres | None,
        Field(description="1-sigma of detection along the ray; what the calibration adds is in `calibration`"),
    ] = None
    reasons: dict[str, Count] = Field(
        default_factory=dict, description="why images gave no soundings: reason to images"
    )


class CalibrationQuality(Model):
    """What the calibration behind the maps is worth, and what the data say of it."""

    sigma_m: Annotated[
        Metres | None,
        Field(
            description="1-sigma that all soundings have in common, by the calibration's covariance, median over "
            "soundings; it is part of uncertainty.tif and of the sigma of soundings.laz; absent without covariance"
        ),
    ] = None
    laser_gap_m: Annotated[
        float | None, Field(description="how much deeper arm b has the seabed than arm a where they meet, median")
    ] = None
    laser_gap_sigma_m: Metres | None = None
    laser_gap_images: Count = 0
    pinhole_percent: Annotated[
        float | None, Field(description="flat port: by how much a pinhole fitted instead would make altitudes wrong")
    ] = None


class PairResidual(Model):
    """What the adjustment left of one pair of images, root mean squares."""

    images: tuple[str, str]
    tie_points: Annotated[int, Field(ge=0, description="that both images see")] = 0
    reprojection_px: Annotated[float | None, Field(ge=0, description="of these, pixels at full resolution")] = None
    crossovers: Annotated[int, Field(ge=0, description="crossings of their laser lines")] = 0
    apart_m: Annotated[Metres | None, Field(description="distance of the lines there, along the normal")] = None


class ImageResidual(Model):
    """What the adjustment left of one image."""

    image: str
    block: Annotated[int, Field(ge=0, description="images of one block hold together without navigation")]
    reprojection_px: Annotated[float | None, Field(ge=0, description="rms, pixels at full resolution")] = None
    navigation_minus_adjusted_m: Annotated[Vector | None, Field(description="along x, y, z of the map")] = None


class PairQuality(Model):
    """Relative motions between overlapping images."""

    tried: Count
    linked: Count
    homography: Count = 0
    essential: Count = 0
    median_inliers: Annotated[float | None, Field(ge=0)] = None
    crossed: Annotated[int, Field(ge=0, description="pairs of images whose laser lines cross")] = 0
    crossover_rms_m: Annotated[Metres | None, Field(description="distance of lines at their crossings")] = None
    residuals: Annotated[tuple[PairResidual, ...], Field(description="pairs that the adjustment holds")] = ()


class AxisDifference(Model):
    """One axis of navigation minus adjusted position, metres."""

    rms_m: Metres
    max_m: Annotated[float, Field(ge=0, description="largest absolute difference, metres")]


class NavigationDifference(Model):
    """Navigation minus adjusted position along the map's axes."""

    x: AxisDifference
    y: AxisDifference
    z: AxisDifference


class TrajectoryQuality(Model):
    """Poses."""

    adjusted: Count
    navigation_only: Count
    rejected: Count
    navigation_minus_adjusted: Annotated[NavigationDifference | None, Field(description="of the adjusted images")] = (
        None
    )
    sigma_median_m: Annotated[Vector | None, Field(description="1-sigma along x, y, z, metres")] = None
    reprojection_rms_px: Annotated[
        float | None, Field(ge=0, description="of tie points from where images see them, pixels at full resolution")
    ] = None
    blocks: Annotated[
        tuple[int, ...],
        Field(description="images in each block that matches or crossovers join, largest first"),
    ] = ()
    images: Annotated[tuple[ImageResidual, ...], Field(description="images with a pose, in order of time")] = ()


class SourceShares(Model):
    """Shares of the cells with an elevation."""

    laser: Share = 0.0
    image_matching: Share = 0.0
    interpolated: Share = 0.0


class BathymetryQuality(Model):
    """The elevation grid."""

    cell_m: Annotated[float, Field(gt=0)]
    cells: Annotated[int, Field(ge=0, description="cells with an elevation")]
    area_m2: Annotated[float, Field(ge=0)]
    by_source: SourceShares | None = None
    elevation_min_m: float | None = None
    elevation_median_m: float | None = None
    elevation_max_m: float | None = None
    sigma_median_m: Metres | None = None


class RingScale(Model):
    """From how far to how far the ring of a bathymetric position index reaches."""

    inner_cells: Count
    outer_cells: Count
    inner_m: Metres
    outer_m: Metres


class TerrainQuality(Model):
    """The habitat layers in terrain/; figures are medians over cells."""

    slope_deg: Annotated[float | None, Field(ge=0, le=90)] = None
    vrm: Share | None = None
    rugosity: Annotated[float | None, Field(ge=0.99)] = None
    roughness_m: Metres | None = None
    bpi_fine: RingScale
    bpi_broad: RingScale
    contour_interval_m: Annotated[float, Field(gt=0, description="of the contours in survey.gpkg")]


class MosaicQuality(Model):
    """The orthomosaic."""

    cell_m: Annotated[float, Field(gt=0)]
    area_m2: Annotated[float, Field(ge=0)]
    coverage_share: Annotated[Share | None, Field(description="of the area with an elevation")] = None
    painted_share: Annotated[
        Share | None, Field(description="of the mosaic, where only laser light shows the seabed: mosaic-painted.tif")
    ] = None


class MeshQuality(Model):
    """The surface."""

    vertices: Annotated[Count, Field(description="of mesh.ply")]
    triangles: Annotated[Count, Field(description="of mesh.ply and mesh.glb")]
    level: Annotated[Count, Field(description="of the pyramid that these two files are, 0 the finest")] = 0
    error_m: Annotated[Metres | None, Field(description="most that the bathymetry is away from their triangles")] = None
    tiles: Annotated[Count, Field(description="of all levels, in mesh-3dtiles/")] = 0
    finest_triangles: Annotated[Count, Field(description="of the finest tiles together")] = 0


class Quality(Model):
    """A quality.json. A part that a mission has no data for is absent (null), never zero."""

    mission: MissionSummary
    soundings: SoundingQuality | None = None
    pairs: PairQuality | None = None
    calibration: CalibrationQuality | None = None
    trajectory: TrajectoryQuality | None = None
    bathymetry: BathymetryQuality | None = None
    terrain: TerrainQuality | None = None
    mosaic: MosaicQuality | None = None
    mesh: MeshQuality | None = None
    warnings: tuple[str, ...] = ()
