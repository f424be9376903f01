"""mission.yaml: what a mission folder holds and how its files are to be read (FORMATS, "mission.yaml")."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from .base import Model
from .problems import inconsistent
from .timestamps import check_pattern


def _inside(path: str) -> str:
    """A path that stays in the mission folder, so that the folder can be moved, zipped or put in a bucket."""
    if "\\" in path:
        raise inconsistent("", repr(path), "forward slashes", f"Write {path.replace(chr(92), '/')!r}.")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if path.startswith("/") or not parts or ":" in parts[0] or ".." in parts:
        remedy = "Copy the file into the mission folder and give its path from there."
        raise inconsistent("", repr(path), "a path inside the mission folder", remedy)
    return "/".join(parts)  # one file has one name


RelativePath = Annotated[str, Field(min_length=1), AfterValidator(_inside)]
Role = Literal["combined", "texture", "laser"]


class ImageSet(Model):
    """Images of one kind: laser and texture in one image, texture only, or laser only."""

    path: Annotated[RelativePath, Field(description="glob relative to the mission folder")]
    role: Role


class FilenameTimestamps(Model):
    """Time of exposure, found anywhere in the file's stem by a strptime pattern. UTC."""

    from_: Annotated[Literal["filename"], Field(alias="from")]
    pattern: Annotated[
        str, AfterValidator(check_pattern), Field(description="strptime pattern, e.g. %Y%m%dT%H%M%S.%fZ")
    ]


class ExifTimestamps(Model):
    """Time of exposure from EXIF DateTimeOriginal with sub-seconds and, where given, the offset; else UTC."""

    from_: Annotated[Literal["exif"], Field(alias="from")]


class CsvTimestamps(Model):
    """Time of exposure from a table with columns image,time."""

    from_: Annotated[Literal["csv"], Field(alias="from")]
    path: RelativePath


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

    path: RelativePath
    time_offset: Annotated[float, Field(ge=-4e9, le=4e9, description="seconds added to navigation times")] = 0.0
    sigma: NavigationSigma = NavigationSigma()


class Reporting(Model):
    """Who, where and under what licence: in quality.json, report and STAC item; who and licence in NetCDF, too."""

    organisation: str | None = None
    contact: str | None = None
    licence: str | None = None
    protected_area: str | None = None
    site_code: str | None = None
    purpose: str | None = None


class Mission(Model):
    """A mission.yaml."""

    format: Literal[1]
    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=200, description="e.g. vortex-2026-06-03-a")]
    title: str = ""
    platform: str = ""
    images: Annotated[tuple[ImageSet, ...], Field(min_length=1)]
    timestamps: Timestamps
    calibration: RelativePath = "calibration.yaml"
    navigation: NavigationSource | None = None
    crs: Annotated[str | None, Field(description="projected CRS, e.g. EPSG:32631")] = None
    vertical_datum: Annotated[str | None, Field(description="vertical CRS, e.g. EPSG:5714")] = None
    tide: Annotated[RelativePath | None, Field(description="table with columns time,height (metres)")] = None
    reporting: Reporting | None = None

    @model_validator(mode="after")
    def _tide_needs_navigation(self) -> "Mission":
        if self.tide is not None and self.navigation is None:
            remedy = "Add navigation, or remove tide."
            raise inconsistent("tide", repr(self.tide), "a tide only where navigation gives depths", remedy)
        return self
