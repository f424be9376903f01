"""mission.yaml: what a mission folder holds and how its files are to be read (FORMATS, "mission.yaml")."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import Model

Role = Literal["combined", "texture", "laser"]


class ImageSet(Model):
    """Images of one kind: laser and texture in one image, texture only, or laser only."""

    path: Annotated[str, Field(min_length=1, description="glob relative to the mission folder")]
    role: Role


class FilenameTimestamps(Model):
    """Time of exposure, found anywhere in the file's stem by a strptime pattern. UTC."""

    from_: Annotated[Literal["filename"], Field(alias="from")]
    pattern: Annotated[str, Field(min_length=2)]


class ExifTimestamps(Model):
    """Time of exposure from EXIF DateTimeOriginal with sub-seconds and, where given, the offset; else UTC."""

    from_: Annotated[Literal["exif"], Field(alias="from")]


class CsvTimestamps(Model):
    """Time of exposure from a table with columns image,time."""

    from_: Annotated[Literal["csv"], Field(alias="from")]
    path: Annotated[str, Field(min_length=1)]


Timestamps = Annotated[FilenameTimestamps | ExifTimestamps | CsvTimestamps, Field(discriminator="from_")]


class NavigationSigma(Model):
    """1-sigma of the navigation: metres and degrees."""

    horizontal: Annotated[float, Field(gt=0, description="metres")] = 1.0
    depth: Annotated[float, Field(gt=0, description="metres")] = 0.1
    roll: Annotated[float, Field(gt=0, le=90, description="degrees")] = 0.5
    pitch: Annotated[float, Field(gt=0, le=90, description="degrees")] = 0.5
    heading: Annotated[float, Field(gt=0, le=180, description="degrees")] = 2.0


class NavigationSource(Model):
    """Where the navigation is and how good it is."""

    path: Annotated[str, Field(min_length=1)]
    time_offset: Annotated[float, Field(description="seconds added to navigation times")] = 0.0
    sigma: NavigationSigma = NavigationSigma()


class Reporting(Model):
    """Who, where and under what licence: copied into the metadata of every product."""

    organisation: str | None = None
    contact: str | None = None
    licence: str | None = None
    protected_area: str | None = None
    site_code: str | None = None
    purpose: str | None = None


class Mission(Model):
    """A mission.yaml."""

    format: Literal[1]
    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
    title: str = ""
    platform: str = ""
    images: Annotated[tuple[ImageSet, ...], Field(min_length=1)]
    timestamps: Timestamps
    calibration: str = "calibration.yaml"
    navigation: NavigationSource | None = None
    crs: Annotated[str | None, Field(description="projected CRS, e.g. EPSG:32631")] = None
    vertical_datum: Annotated[str | None, Field(description="vertical CRS, e.g. EPSG:5714")] = None
    tide: Annotated[str | None, Field(description="table with columns time,height (metres)")] = None
    reporting: Reporting | None = None

    @model_validator(mode="after")
    def _tide_needs_navigation(self) -> "Mission":
        if self.tide is not None and self.navigation is None:
            raise ValueError("a tide is given but no navigation whose depths it could correct")
        return self
