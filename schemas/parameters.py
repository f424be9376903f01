"""What can be chosen: one model per stage, each field with its default, unit and bounds.

Every step of the pipeline is stored under a digest of the stage models that it reads, so a change here
recomputes what depends on it and nothing else.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import Model
from .problems import inconsistent


class LaserParameters(Model):
    """Laser point detection, segmentation and triangulation (paper III.B, III.C, III.D)."""

    method: Annotated[
        Literal["sheets", "paper"],
        Field(description="sheets: the two arms at once as curves on their sheets of light; paper: III.B and III.C"),
    ] = "sheets"
    gamma: Annotated[
        float, Field(ge=1, le=3, description="sheets: the camera's, undone before measuring; level = light^(1/gamma)")
    ] = 2.2
    peak_sigmas: Annotated[
        float,
        Field(ge=1, le=20, description="sheets: height of a line in the reduced image over the scatter around it"),
    ] = 3.0
    intensity_sigmas: Annotated[
        float, Field(ge=0.5, le=20, description="green threshold: standard deviations above the mean")
    ] = 3.0
    curvature_sigmas: Annotated[
        float, Field(ge=1, le=20, description="second derivative threshold: standard deviations below zero")
    ] = 5.0
    chain_min_points: Annotated[
        int, Field(ge=2, le=1000, description="a line with fewer points, from row to row, is an orphan")
    ] = 6
    colour_share: Annotated[
        float,
        Field(ge=0, le=10, description="blue and red on a line, as a share of what white light would add, at most"),
    ] = 0.55
    min_soundings: Annotated[
        int, Field(ge=1, le=10_000, description="an image with fewer has no laser, but something that looks like it")
    ] = 60
    range_min_m: Annotated[float, Field(gt=0, description="nearest believable sounding, metres")] = 0.5
    range_max_m: Annotated[float, Field(gt=0, description="farthest believable sounding, metres")] = 8.0
    histogram_bin_m: Annotated[float, Field(gt=0, le=1, description="paper III.D: 0.1 m")] = 0.1
    histogram_min_share: Annotated[
        float, Field(ge=0, le=0.5, description="a depth bin with a smaller share of an arm's points is rejected")
    ] = 0.01

    @model_validator(mode="after")
    def _range_not_empty(self) -> "LaserParameters":
        if self.range_min_m >= self.range_max_m:
            expected, remedy = f"less than range_max_m, {self.range_max_m:g}", "Swap or correct the two."
            raise inconsistent("range_min_m", f"{self.range_min_m:g}", expected, remedy)
        return self


class FeatureParameters(Model):
    """SIFT features (paper III.E)."""

    max_features: Annotated[int, Field(ge=100, le=50_000)] = 4000
    max_pixels: Annotated[int, Field(ge=100_000, description="images with more pixels are scaled down to this")] = (
        700_000
    )
    contrast_threshold: Annotated[float, Field(gt=0, le=0.2)] = 0.004


class MatchParameters(Model):
    """Pairs of images and their relative motion (paper III.E)."""

    ratio: Annotated[float, Field(gt=0.4, lt=1, description="Lowe's ratio test")] = 0.8
    min_inliers: Annotated[int, Field(ge=8, description="matches that agree, for a pair to count")] = 15
    inlier_px: Annotated[float, Field(gt=0, le=20, description="RANSAC distance, pixels at full resolution")] = 3.0
    min_overlap: Annotated[
        float, Field(ge=0, lt=1, description="share of a footprint, from navigation, for a pair to be tried")
    ] = 0.05
    max_pairs_per_image: Annotated[int, Field(ge=1, le=100)] = 12
    planarity_m: Annotated[
        float, Field(gt=0, description="laser points of a pair within this of one plane: homography; else essential")
    ] = 0.02
    planar_share: Annotated[float, Field(gt=0.5, le=1, description="share of laser points on the plane")] = 0.9


class AdjustParameters(Model):
    """The global estimate that holds the chain of motions to navigation (paper IV)."""

    robust_threshold: Annotated[
        float, Field(gt=0, description="in sigmas: Huber on pair motions, Cauchy at twice that on tie points")
    ] = 1.5
    tie_cells: Annotated[
        int, Field(ge=4, le=64, description="cells along an image's longer side, each with its share of tie points")
    ] = 16
    tie_points_per_cell: Annotated[int, Field(ge=1, le=50)] = 4
    max_ranges: Annotated[
        int, Field(ge=0, le=2000, description="tie points of an image that its laser tells the range of, at most")
    ] = 150
    drift_m_per_sqrt_s: Annotated[
        float, Field(gt=0, description="random walk of dead reckoning, metres per root second")
    ] = 0.02


class BathymetryParameters(Model):
    """What the bathymetry is made from, besides the laser and tie points."""

    dense: Annotated[
        bool, Field(description="match the pixels of overlapping images too; without, the gaps are interpolated")
    ] = True
    pairs_per_image: Annotated[
        int, Field(ge=1, le=20, description="pairs that are matched densely, of those that an image is best seen in")
    ] = 3


class GridParameters(Model):
    """Gridded bathymetry."""

    cell_m: Annotated[
        Annotated[float, Field(gt=0)] | Literal["auto"], Field(description="metres; auto: max(0.02, 4 GSD)")
    ] = "auto"
    max_interpolation_m: Annotated[
        Annotated[float, Field(ge=0, le=50)] | Literal["auto"],
        Field(description="cells farther than this from any sounding stay empty, metres; auto: max(1, range / 3)"),
    ] = "auto"
    max_sigma_m: Annotated[
        Annotated[float, Field(gt=0)] | Literal["auto"],
        Field(description="less certain interpolated cells stay empty, metres, 1-sigma; auto: range / 75 or less"),
    ] = "auto"
    tile_cells: Annotated[int, Field(ge=64, le=8192)] = 512


class RingParameters(Model):
    """The ring of a bathymetric position index: how far from a cell its neighbourhood begins and ends."""

    inner: Annotated[float, Field(ge=0, description="where the ring begins")]
    outer: Annotated[float, Field(gt=0, le=1000, description="where it ends, this distance included")]
    unit: Annotated[Literal["cells", "metres"], Field(description="of inner and outer")] = "cells"

    @model_validator(mode="after")
    def _ring_not_empty(self) -> "RingParameters":
        if self.inner > self.outer:
            expected = f"at most outer, {self.outer:g}"
            raise inconsistent("inner", f"{self.inner:g}", expected, "Swap or correct the two.")
        return self


class TerrainParameters(Model):
    """Habitat layers: slope, aspect, curvature, position, ruggedness, contours."""

    fine: Annotated[RingParameters, Field(description="bathymetric position index of small forms")] = RingParameters(
        inner=1, outer=5
    )
    broad: Annotated[RingParameters, Field(description="bathymetric position index of large forms")] = RingParameters(
        inner=5, outer=25
    )


class MosaicParameters(Model):
    """Orthomosaic and planar mosaic."""

    cell_m: Annotated[
        Annotated[float, Field(gt=0)] | Literal["auto"], Field(description="metres; auto: max(0.002, GSD)")
    ] = "auto"
    tile_cells: Annotated[int, Field(ge=256, le=16384)] = 3072
    colour: Annotated[
        Literal["flatfield", "none"],
        Field(description="flatfield: lamps' lighting and the water's colour are removed; none: pixels as taken"),
    ] = "flatfield"
    gamma: Annotated[
        float, Field(ge=1, le=3, description="of the images: level = light ** (1 / gamma); colours are mixed as light")
    ] = 2.2


class MeshParameters(Model):
    """Textured surface: how much of the pyramid in mesh-3dtiles/ goes into the files mesh.glb and mesh.ply."""

    max_triangles: Annotated[
        int, Field(ge=100, le=20_000_000, description="the finest level with no more than these is taken")
    ] = 400_000
    texture_px: Annotated[
        int, Field(ge=256, le=16384, description="mesh.glb has no more texture than a square of this side, pixels")
    ] = 6144


class Parameters(Model):
    """All stages; `seamosaic run --params FILE --set grid.cell_m=0.05`."""

    laser: LaserParameters = LaserParameters()
    features: FeatureParameters = FeatureParameters()
    match: MatchParameters = MatchParameters()
    adjust: AdjustParameters = AdjustParameters()
    bathymetry: BathymetryParameters = BathymetryParameters()
    grid: GridParameters = GridParameters()
    terrain: TerrainParameters = TerrainParameters()
    mosaic: MosaicParameters = MosaicParameters()
    mesh: MeshParameters = MeshParameters()
