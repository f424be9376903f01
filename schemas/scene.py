"""What the simulator makes: terrain, light, camera, survey and navigation errors of one mission."""

from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator

from .base import Model
from .calibration import Port
from .mission import NavigationSigma

Share = Annotated[float, Field(ge=0, le=1)]
Rgb = tuple[
    Annotated[float, Field(ge=0, le=10)], Annotated[float, Field(ge=0, le=10)], Annotated[float, Field(ge=0, le=10)]
]


class TerrainScene(Model):
    """The seabed's shape: heights above a level datum."""

    kind: Literal["plane", "box", "pool", "rough"] = "rough"
    depth_m: Annotated[float, Field(gt=0, le=12_000, description="of the datum below the surface, metres")] = 15.0
    cell_m: Annotated[float, Field(ge=0.002, le=0.2, description="spacing of the height grid, metres")] = 0.01
    box_height_m: Annotated[float, Field(gt=0, le=2, description="paper III.D: 225 mm")] = 0.225
    box_size_m: Annotated[tuple[float, float], Field(description="sides of the box, metres")] = (0.6, 0.45)
    slope_deg: Annotated[float, Field(gt=0, le=70, description="pool: slope down to the flat floor")] = 45.0
    slope_drop_m: Annotated[float, Field(gt=0, le=10, description="pool: height of the slope, metres")] = 1.6
    relief_m: Annotated[float, Field(ge=0, le=2, description="rough: standard deviation of the relief, metres")] = 0.08
    boulders_per_m2: Annotated[float, Field(ge=0, le=20)] = 0.35
    boulder_height_m: Annotated[float, Field(gt=0, le=3, description="of the highest boulders, metres")] = 0.4
    ripple_height_m: Annotated[float, Field(ge=0, le=1, description="rough: crest to trough, metres")] = 0.0
    ripple_length_m: Annotated[float, Field(gt=0, le=20, description="crest to crest, metres")] = 0.6


class TextureScene(Model):
    """The seabed's colour."""

    cell_m: Annotated[float, Field(ge=0.0005, le=0.1, description="size of a texel, metres")] = 0.003
    contrast: Annotated[float, Field(ge=0, le=1, description="standard deviation of the albedo over its mean")] = 0.16
    spots_per_m2: Annotated[float, Field(ge=0, le=2000, description="stones and shells")] = 120.0
    period_m: Annotated[float, Field(ge=0, le=100, description="it repeats itself in x and y; 0: never")] = 0.0


class CameraScene(Model):
    """The camera; its focal length and principal point scale with the image's width."""

    model: Literal["brown", "fisheye", "flat-port"] = "brown"
    focal_share: Annotated[float, Field(gt=0.2, le=10, description="focal length over image width")] = 1.3026
    distortion: tuple[float, ...] = (-0.05, 0.02, 0.0004, -0.0003, 0.0)
    port: Port | None = None


class LaserScene(Model):
    """The projected cross (paper III.A) and how it was mounted."""

    enabled: bool = True
    baseline_m: Annotated[float, Field(gt=0, le=5)] = 1.2
    angle_deg: Annotated[float, Field(gt=0, lt=90, description="alpha, degrees from the camera axis")] = 25.0
    roll_deg: Annotated[float, Field(gt=0, lt=90)] = 45.3
    offset_m: Annotated[tuple[float, float], Field(description="emitter in camera y and z, metres")] = (0.012, -0.03)
    width_px: Annotated[float, Field(ge=0.5, le=20, description="1-sigma across the line on level ground")] = 1.6
    brightness: Annotated[float, Field(ge=0, le=10, description="peak, of full scale, at nominal altitude")] = 0.6
    speckle: Annotated[Share, Field(description="standard deviation over mean of the line's speckle")] = 0.15


class LightScene(Model):
    """Strobe and water. Everything may be zero."""

    strobe: Annotated[float, Field(ge=0, le=1, description="green level of mean seabed at nominal altitude")] = 0.32
    strobe_position_m: Annotated[
        tuple[float, float, float], Field(description="camera frame, metres; what it cannot see is not shaded")
    ] = (0.0, 0.5, 0.0)
    ambient: Annotated[
        float, Field(ge=0, le=1, description="green level of mean seabed without strobe, laser images too")
    ] = 0.002
    falloff: Annotated[bool, Field(description="inverse square law and cosine of incidence")] = True
    attenuation_per_m: Annotated[Rgb, Field(description="red, green, blue")] = (0.32, 0.07, 0.09)
    backscatter: Annotated[
        Rgb, Field(description="red, green, blue level of an endless water column, of the strobe's level")
    ] = (0.1, 0.3, 0.36)
    backscatter_per_m: Annotated[float, Field(ge=0, le=10, description="how fast backscatter builds up")] = 0.2


class SensorScene(Model):
    """From light to file."""

    read_noise: Annotated[float, Field(ge=0, le=0.2, description="1-sigma, of full scale, linear")] = 0.002
    full_well: Annotated[
        float, Field(ge=0, description="electrons of a full pixel, for shot noise; 0: no shot noise")
    ] = 6000.0
    gamma: Annotated[float, Field(ge=1, le=3, description="level = light ** (1 / gamma)")] = 2.2
    jpeg_quality: Annotated[int, Field(ge=10, le=100)] = 92


class SurveyScene(Model):
    """A lawnmower pattern: parallel lines, alternately sailed there and back, centred on the origin."""

    latitude: Annotated[float, Field(ge=-85, le=85, description="of the origin, degrees")] = 43.0421
    longitude: Annotated[float, Field(ge=-180, le=180, description="of the origin, degrees")] = 6.0127
    lines: Annotated[int, Field(ge=1, le=100)] = 3
    altitude_m: Annotated[float, Field(gt=0.3, le=30, description="of the camera above the datum")] = 2.7
    altitude_step_m: Annotated[
        float, Field(ge=0, le=5, description="by which each line is sailed higher than the one before")
    ] = 0.0
    heading_deg: Annotated[float, Field(ge=0, lt=360, description="of the first line, from true north")] = 20.0
    speed_m_s: Annotated[float, Field(gt=0, le=5)] = 0.3
    overlap: Annotated[float, Field(ge=-1, lt=0.99, description="of successive images of a line")] = 0.57
    sidelap: Annotated[float, Field(ge=-1, lt=0.99, description="of neighbouring lines")] = 0.45
    roles: Annotated[
        Literal["combined", "texture", "laser", "pairs"], Field(description="pairs: texture, laser in turn")
    ] = "combined"
    pair_delay_s: Annotated[float, Field(gt=0, le=60, description="from a texture image to its laser image")] = 2.0
    wobble: Annotated[float, Field(ge=0, le=10, description="1: degrees and centimetres of a real vehicle")] = 1.0

    @property
    def highest_m(self) -> float:
        """Altitude of the last line."""
        return self.altitude_m + (self.lines - 1) * self.altitude_step_m


class NavigationScene(Model):
    """Errors of the navigation: constant biases, white noise and the random walk of dead reckoning."""

    enabled: bool = True
    sigma: Annotated[NavigationSigma, Field(description="stated in mission.yaml; errors are drawn from it")] = (
        NavigationSigma(horizontal=0.4, depth=0.0323, roll=0.269, pitch=0.269, heading=0.838)
    )
    error_scale: Annotated[float, Field(ge=0, le=10, description="0: perfect; 1: as stated")] = 1.0
    drift_m_per_sqrt_s: Annotated[float, Field(ge=0, le=1, description="random walk, each axis")] = 0.015
    horizontal_noise_m: Annotated[float, Field(ge=0, le=10, description="white noise, each axis")] = 0.003
    noise_share: Annotated[Share, Field(description="of depth and attitude sigma that is white, not constant")] = 0.3
    rate_hz: Annotated[float, Field(gt=0, le=100)] = 5.0


class Scene(Model):
    """A mission to simulate. Lengths in metres, angles in degrees, light as a share of full scale."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
    images: Annotated[int, Field(ge=1, le=10_000, description="exposures in all, both of each pair counted")] = 36
    width: Annotated[int, Field(ge=64, le=8192, description="pixels; the height is three quarters of it")] = 1216
    period_m: Annotated[
        float,
        Field(ge=0, le=100, description="seabed and motion repeat themselves north and east, images too; 0: never"),
    ] = 0.0
    terrain: TerrainScene = TerrainScene()
    texture: TextureScene = TextureScene()
    camera: CameraScene = CameraScene()
    laser: LaserScene = LaserScene()
    mount_translation: tuple[float, float, float] = (0.35, 0.12, 0.25)
    mount_rotation: tuple[float, float, float] = (0.4, -0.6, 0.5)
    light: LightScene = LightScene()
    sensor: SensorScene = SensorScene()
    survey: SurveyScene = SurveyScene()
    navigation: NavigationScene = NavigationScene()

    @property
    def height(self) -> int:
        """Rows of an image."""
        return round(self.width * 3 / 4)

    @model_validator(mode="after")
    def _possible(self) -> "Scene":
        if self.survey.roles in ("laser", "pairs") and not self.laser.enabled:
            raise ValueError(f"survey.roles is {self.survey.roles} but laser.enabled is false")
        if self.survey.highest_m >= self.terrain.depth_m:
            raise ValueError("survey.altitude_m must be less than terrain.depth_m: the camera would be in the air")
        if self.period_m:
            self._can_repeat()
        if self.survey.lines > self.images:
            raise ValueError(f"{self.survey.lines} lines need at least as many images, found {self.images}")
        return self

    def _can_repeat(self) -> None:
        if self.terrain.kind != "rough" or self.terrain.ripple_height_m:
            raise ValueError("period_m needs terrain.kind rough without ripples")
        if self.survey.heading_deg or self.survey.altitude_step_m or self.survey.roles == "pairs":
            raise ValueError("period_m needs lines to the north, all at one altitude, and no pairs")
        for name, cell_m in (("terrain", self.terrain.cell_m), ("texture", self.texture.cell_m)):
            if abs(self.period_m / cell_m - round(self.period_m / cell_m)) > 1e-6:
                raise ValueError(f"period_m must be a whole number of {name}.cell_m, {cell_m:g}")


_GOOD_NAVIGATION: Final[dict[str, Any]] = {
    "sigma": {"horizontal": 0.05, "depth": 0.0108, "roll": 0.058, "pitch": 0.058, "heading": 0.158},
    "drift_m_per_sqrt_s": 0.002,
}
_POOL_RIG: Final[dict[str, Any]] = {"camera": {"focal_share": 1.178}, "laser": {"baseline_m": 1.04}}
_BARE: Final[dict[str, Any]] = {"relief_m": 0.0, "boulders_per_m2": 0.0}

SCENES: Final[dict[str, Scene]] = {
    scene["name"]: Scene.model_validate(scene)
    for scene in (
        {
            "name": "plane",
            "images": 12,
            **_POOL_RIG,
            "terrain": {"kind": "plane", "depth_m": 4.0},
            "survey": {"lines": 2, "altitude_m": 2.0, "overlap": 0.6, "sidelap": 0.55},
        },
        {
            "name": "box",
            "images": 9,
            **_POOL_RIG,
            "terrain": {"kind": "box", "depth_m": 3.0},
            "survey": {"lines": 1, "altitude_m": 1.9, "overlap": 0.8},
        },
        {
            "name": "pool",
            "images": 50,
            **_POOL_RIG,
            "terrain": {"kind": "pool", "depth_m": 3.0},
            "survey": {"lines": 5, "altitude_m": 1.9, "overlap": 0.55, "sidelap": 0.65, "heading_deg": 0.0},
            "navigation": {"enabled": False},
        },
        {"name": "reef", "images": 36},
        {
            "name": "sea",
            "images": 40,
            "survey": {"lines": 5, "altitude_m": 2.9, "overlap": 0.3, "sidelap": 0.3},
        },
        {
            "name": "night",
            "images": 28,
            "terrain": {"depth_m": 18.0},
            "light": {"strobe": 0.0},
            "survey": {"lines": 2, "overlap": 0.6, "sidelap": 0.5, "roles": "laser"},
            "navigation": _GOOD_NAVIGATION,
        },
        {
            "name": "pairs",
            "images": 46,
            "terrain": {"depth_m": 18.0},
            "survey": {"lines": 2, "overlap": 0.5, "sidelap": 0.5, "roles": "pairs"},
        },
        {
            "name": "sand",
            "images": 24,
            "terrain": {**_BARE, "depth_m": 12.0, "ripple_height_m": 0.05},
            "texture": {"contrast": 0.02, "spots_per_m2": 0.0},
            "survey": {"lines": 2, "overlap": 0.55},
            "navigation": _GOOD_NAVIGATION,
        },
        {
            "name": "port",
            "images": 16,
            "camera": {"model": "flat-port", "distortion": (), "port": {"distance": 0.035, "thickness": 0.012}},
            "survey": {"lines": 2, "altitude_m": 2.2, "overlap": 0.5},
            "navigation": _GOOD_NAVIGATION,
        },
        {
            "name": "floor",
            "images": 32,
            "terrain": {"kind": "plane", "depth_m": 8.0},
            "survey": {"lines": 4, "altitude_m": 1.8, "altitude_step_m": 0.5, "overlap": 0.4, "sidelap": 0.6},
            "navigation": _GOOD_NAVIGATION,
        },
        {
            "name": "full",
            "images": 6250,
            "width": 3648,
            "period_m": 8.0,
            "texture": {"cell_m": 0.00125},
            "survey": {"lines": 25, "altitude_m": 3.0, "overlap": 0.42, "sidelap": 0.13, "heading_deg": 0.0},
        },
        {"name": "demo", "images": 24, "width": 912, "survey": {"overlap": 0.5, "sidelap": 0.45}},
    )
}
