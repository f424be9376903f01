"""calibration.yaml: the camera, the two laser sheets and the mount (FORMATS, "calibration.yaml")."""

import math
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from .base import Model
from .problems import inconsistent

Vector = tuple[float, float, float]
_LEAST_ROLL = 0.01  # degrees from a plus, of which a row of the image crosses one arm nowhere or everywhere


class Port(Model):
    """A flat window square to the optical axis, in metres from the centre of projection."""

    distance: Annotated[float, Field(ge=0, le=1, description="centre of projection to inner face, metres")]
    thickness: Annotated[float, Field(ge=0, le=0.2, description="metres")]
    glass_index: Annotated[float, Field(ge=1, le=2.5)] = 1.49
    water_index: Annotated[float, Field(ge=1, le=1.6)] = 1.34


class Camera(Model):
    """Interior orientation. Pixel centres at integer coordinates; brown and fisheye as OpenCV defines them."""

    model: Literal["brown", "fisheye", "flat-port"]
    width: Annotated[int, Field(gt=0, le=100_000, description="pixels")]
    height: Annotated[int, Field(gt=0, le=100_000, description="pixels")]
    fx: Annotated[float, Field(gt=0, description="pixels")]
    fy: Annotated[float, Field(gt=0, description="pixels")]
    cx: Annotated[float, Field(description="pixels")]
    cy: Annotated[float, Field(description="pixels")]
    distortion: Annotated[tuple[float, ...], Field(description="k1 k2 p1 p2 [k3], or fisheye k1 k2 k3 k4")] = ()
    port: Port | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Camera":
        allowed = {"brown": (0, 4, 5), "flat-port": (0, 4, 5), "fisheye": (0, 4)}[self.model]
        if len(self.distortion) not in allowed:
            raise inconsistent(
                "distortion",
                f"{len(self.distortion)} coefficients",
                f"{' or '.join(map(str, allowed))} for the model {self.model}",
                "Give k1 k2 k3 k4." if self.model == "fisheye" else "Give k1 k2 p1 p2 k3, as OpenCV orders them.",
            )
        if self.model == "flat-port" and self.port is None:
            raise inconsistent(
                "port", "nothing", "the window of a flat-port camera", "Add port: {distance, thickness}."
            )
        if self.model != "flat-port" and self.port is not None:
            remedy = "Remove port, or set model: flat-port if the camera was calibrated in air."
            raise inconsistent("port", "a window", f"none for the model {self.model}", remedy)
        return self


class LaserPlane(Model):
    """A sheet of light: normal . X = offset, camera frame, metres."""

    name: Annotated[str, Field(min_length=1)]
    normal: Vector
    offset: float

    @model_validator(mode="after")
    def _unit_normal(self) -> "LaserPlane":
        length = math.sqrt(sum(v * v for v in self.normal))
        if abs(length - 1) > 1e-3:
            remedy = "Divide normal and offset by that length."
            raise inconsistent("normal", f"a vector of length {length:.6g}", "a vector of length 1", remedy)
        if abs(self.normal[1]) < 1e-6:
            raise inconsistent(
                "normal",
                "a sheet along the image's columns, as in a plus along rows and columns",
                "one rising and one falling arm (a cross, paper III.A)",
                "Check the order of the components: x right, y down in the image, z along the optical axis.",
            )
        return self


class CrossGeometry(Model):
    """The paper's parametrisation (III.A): baseline d along camera +x, tilt alpha, roll of the cross."""

    baseline: Annotated[float, Field(gt=0, description="d, metres along camera x")]
    angle: Annotated[float, Field(gt=0, lt=90, description="alpha, degrees from the camera axis")]
    roll: Annotated[float, Field(ge=-180, le=180, description="degrees; 45 in the paper")] = 45.0

    @model_validator(mode="after")
    def _a_cross(self) -> "CrossGeometry":
        if abs(math.remainder(self.roll, 90.0)) < _LEAST_ROLL:
            raise inconsistent(
                "roll",
                f"{self.roll:g} degrees, a plus along rows and columns of the image",
                "one rising and one falling arm (a cross, paper III.A)",
                "Give the roll of the cross, about 45 degrees.",
            )
        return self


def _how_given(planes: object) -> str | None:
    """Which of the two ways of giving the sheets is meant, so that an error speaks of that one only."""
    if isinstance(planes, dict | CrossGeometry):
        return "geometry"
    return "planes" if isinstance(planes, list | tuple) else None


class Laser(Model):
    """The projected cross: two sheets, given as planes or by the cross's geometry."""

    wavelength_nm: Annotated[float, Field(ge=500, le=560, description="nm; the detector looks for green light")] = 532.0
    origin: Annotated[Vector, Field(description="emitter, camera frame, metres")]
    planes: Annotated[
        Annotated[tuple[LaserPlane, LaserPlane], Tag("planes")] | Annotated[CrossGeometry, Tag("geometry")],
        Discriminator(_how_given),
    ]

    @property
    def sheets(self) -> tuple[LaserPlane, LaserPlane]:
        """The two sheets as planes, however they were given."""
        if isinstance(self.planes, CrossGeometry):
            return _sheets(self.planes)
        return self.planes

    @model_validator(mode="after")
    def _two_directions(self) -> "Laser":
        if self.sheets[0].name == self.sheets[1].name:
            remedy = "Give each sheet a name of its own, as a and b."
            raise inconsistent("planes", f"two sheets named {self.sheets[0].name}", "two names", remedy)
        slopes = [-plane.normal[0] / plane.normal[1] for plane in self.sheets]
        if slopes[0] * slopes[1] >= 0:
            raise inconsistent(
                "planes",
                "two sheets that lean the same way in the image",
                "one rising and one falling arm (a cross, paper III.A)",
                "Check the signs of the normals; roll of a cross is about 45 degrees.",
            )
        return self


def _sheets(geometry: CrossGeometry) -> tuple[LaserPlane, LaserPlane]:
    """Planes of a cross aimed from (d, 0, 0) at the optical axis under alpha: X ± Y/cos(alpha) + Z tan(alpha) = d
    for a roll of 45 degrees."""
    alpha, roll = math.radians(geometry.angle), math.radians(geometry.roll)
    # The laser's own axes in the camera frame: its optical axis leans towards -x.
    axis_x = (math.cos(alpha), 0.0, math.sin(alpha))
    axis_y = (0.0, 1.0, 0.0)

    def plane(name: str, angle: float) -> LaserPlane:
        cosine, sine = math.cos(angle), math.sin(angle)
        nx, ny, nz = (cosine * axis_x[k] + sine * axis_y[k] for k in range(3))
        return LaserPlane(name=name, normal=(nx, ny, nz), offset=nx * geometry.baseline)

    return plane("a", -roll), plane("b", math.pi / 2 - roll)


class Mount(Model):
    """The camera in the vehicle: metres, and roll, pitch, yaw in degrees relative to the zero mount."""

    translation: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)


class CovarianceBlock(Model):
    """Covariance of named calibration parameters, in the order given."""

    parameters: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _square(self) -> "CovarianceBlock":
        size = len(self.parameters)
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            remedy = "Give one row and one column a parameter."
            raise inconsistent("matrix", f"{len(self.matrix)} rows", f"{size} x {size} numbers", remedy)
        return self

    @model_validator(mode="after")
    def _covariance(self) -> "CovarianceBlock":
        if len(set(self.parameters)) < len(self.parameters):
            raise inconsistent(
                "parameters", "a parameter twice", "each once", "Give one row and one column a parameter."
            )
        for k, (name, row) in enumerate(zip(self.parameters, self.matrix, strict=True)):
            if row[k] < 0:
                raise inconsistent("matrix", f"{row[k]:g} as variance of {name}", "0 or more", "Correct the diagonal.")
            for j, value in enumerate(row[:k]):
                other, most = self.matrix[j][k], 1e-6 * math.sqrt(row[k] * self.matrix[j][j])
                if abs(value - other) > max(most, 1e-6 * abs(value)):
                    expected = f"{other:g}, as in row {j + 1}"
                    raise inconsistent("matrix", f"{value:g} in row {k + 1}", expected, "Make the matrix symmetric.")
        return self


DISTORTION = {"brown": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
DISTORTION["flat-port"] = DISTORTION["brown"]


class Calibration(Model):
    """A calibration.yaml."""

    format: Literal[1]
    camera: Camera
    laser: Laser | None = None
    mount: Mount = Mount()
    covariance: tuple[CovarianceBlock, ...] = ()

    @property
    def unknown_parameters(self) -> list[str]:
        """Parameters of the covariance blocks that the file does not have."""
        known = {f"camera.{name}" for name in ("fx", "fy", "cx", "cy")}
        known |= {f"camera.distortion.{name}" for name in DISTORTION[self.camera.model]}
        known |= {f"mount.translation.{axis}" for axis in "xyz"}
        known |= {f"mount.rotation.{angle}" for angle in ("roll", "pitch", "yaw")}
        for sheet in self.laser.sheets if self.laser else ():
            known |= {f"laser.planes.{sheet.name}.{part}" for part in ("normal.x", "normal.y", "normal.z", "offset")}
        return [name for block in self.covariance for name in block.parameters if name not in known]
