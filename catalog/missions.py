"""Opens a mission: everything that is known of it before a pixel is looked at."""

from collections.abc import MutableMapping
from typing import Any, NamedTuple

import numpy as np
import xarray

from ..schemas.calibration import Calibration
from ..schemas.mission import Mission
from ..schemas.problems import InvalidInput, Problem
from ..schemas.timestamps import iso
from .coordinate_systems import Place, Systems, resolve
from .digests import are_known, inspect_images, peek_images
from .frames_table import build_frames
from .interpolation import smoothed
from .mission_files import MissionFiles, find_images
from .mission_inputs import MISSION, MissionInputs, input_warnings, read_inputs


class OpenedMission(NamedTuple):
    """A mission that can be processed.

    Attributes
    ----------
    url : the folder or URL, as given.
    mission, calibration : its two YAML files.
    frames : one entry an image, sorted by time; dimension `image`. `image` (path relative to the mission folder),
        `role`, `time` (datetime64[ns], UTC), `sha256`, `status` ("" or "rejected: why"); from navigation, NaN
        without it: `longitude`, `latitude`, `roll`, `pitch`, `heading` (degrees), `elevation` (tide - depth, of the
        navigation reference point), `altitude` (metres, NaN where missing), and 1-sigma `sigma_horizontal`,
        `sigma_depth` (metres), `sigma_roll`, `sigma_pitch`, `sigma_heading` (degrees).
    crs : WKT of the projected CRS; None without navigation.
    vertical : WKT of the vertical CRS; None where heights refer to the sea surface at survey time.
    input_digests : SHA-256 of every YAML and CSV file read, by path relative to the mission folder.
    warnings : what is allowed but worth a second look.
    """

    url: str
    mission: Mission
    calibration: Calibration
    frames: xarray.Dataset
    crs: str | None
    vertical: str | None
    input_digests: dict[str, str]
    warnings: list[str]


def span(frames: xarray.Dataset) -> tuple[np.datetime64, np.datetime64] | None:
    """First and last exposure of the images that count, of all where none does; None without a time.

    A rejected image may be one whose clock was wrong.
    """
    times = frames["time"].values
    known, counts = ~np.isnat(times), (frames["status"] == "").values
    times = times[known & counts] if (known & counts).any() else times[known]
    return (times.min(), times.max()) if len(times) else None


def open_mission(
    url: str,
    digests: MutableMapping[str, Any] | None = None,
    *,
    hashed: bool | None = True,
    smooth_s: float = 0.0,
    level_floor: bool = False,
    shift_s: float = 0.0,
) -> OpenedMission:
    """Read and check all files of a mission; nothing is written to it.

    Parameters
    ----------
    url : a folder, or any URL that fsspec reads.
    digests : what earlier runs learnt of the images, by path, size and time of change, so that a rerun does not
        read them all again; added to. Its values are plain lists, fit for JSON.
    hashed : False to look at the headers only, of images that `digests` does not know, for a quick check; `sha256`
        is empty then. None to do so unless all of them are known.
    smooth_s : half the window over which depth, altitude, roll and pitch are smoothed, seconds; 0 for not at all.
    level_floor : the seabed is flat, so that altitudes are smoothed together with depths.
    shift_s : seconds added to navigation times besides the mission's own time_offset.

    Raises
    ------
    InvalidInput
        With every problem of every file. A single bad image is no problem: its `status` says why it is rejected.
    """
    files = MissionFiles(url)
    problems: list[Problem] = []
    inputs = read_inputs(files, problems)
    mission, document = inputs.mission, inputs.document
    if mission is None or document is None:
        raise InvalidInput(problems)
    images, more = find_images(files, mission, document)
    problems += more
    listed = [(image.path, image.info) for image in images]
    # What is wrong anyway is said without reading gigabytes first.
    quick = problems or not (are_known(listed, digests) if hashed is None else hashed)
    inspections = peek_images(files.fs, listed, digests) if quick else inspect_images(files.fs, listed, digests)
    if inputs.navigation is not None and smooth_s > 0:
        inputs = inputs._replace(navigation=smoothed(inputs.navigation, smooth_s, level_floor))
    if mission.navigation is not None and shift_s:
        source = mission.navigation.model_copy(update={"time_offset": mission.navigation.time_offset + shift_s})
        mission = mission.model_copy(update={"navigation": source})
    frames = build_frames(images, inspections, inputs, mission)
    systems = _systems(inputs, mission, frames.table)
    problems += [*systems.problems, *_tide_problems(inputs, mission, frames.table)]
    if problems or (images and frames.fatal) or inputs.calibration is None:
        raise InvalidInput([*problems, *frames.rejections])
    return OpenedMission(
        url=url,
        mission=mission,
        calibration=inputs.calibration,
        frames=frames.table,
        crs=systems.crs,
        vertical=systems.vertical,
        input_digests=dict(files.digests),
        warnings=[
            *input_warnings(inputs, [image.image for image in images], systems.vertical),
            *systems.warnings,
            *(problem.found for problem in frames.rejections),
            *frames.warnings,
        ],
    )


def _systems(inputs: MissionInputs, mission: Mission, frames: xarray.Dataset) -> Systems:
    document = inputs.document
    assert document is not None
    crs, datum = (Place(MISSION, document.line((key,)), key) for key in ("crs", "vertical_datum"))
    if mission.navigation is None:
        return resolve(mission.crs, mission.vertical_datum, None, crs, datum)
    position = _middle(inputs, frames)
    if position is None:  # the navigation is unusable, which is a problem already
        systems = resolve(mission.crs, mission.vertical_datum, None, crs, datum)
        return systems._replace(warnings=[])
    return resolve(mission.crs, mission.vertical_datum, position, crs, datum)


def _middle(inputs: MissionInputs, frames: xarray.Dataset) -> tuple[float, float] | None:
    """Median latitude and longitude of the usable images, else of all navigation."""
    used = (frames["status"] == "").values
    latitude, longitude = frames["latitude"].values[used], frames["longitude"].values[used]
    if not np.isfinite(latitude).any() and inputs.navigation is not None:
        latitude, longitude = inputs.navigation.latitude, inputs.navigation.longitude
    latitude, longitude = latitude[np.isfinite(latitude)], longitude[np.isfinite(longitude)]
    if not len(latitude) or not len(longitude):
        return None
    middle = float(np.median(np.unwrap(longitude, period=360)))
    return float(np.median(latitude)), (middle + 180) % 360 - 180


def _tide_problems(inputs: MissionInputs, mission: Mission, frames: xarray.Dataset) -> list[Problem]:
    """A tide table has to cover the images: a height held constant beyond its end would be invented."""
    time = frames["time"].values[(frames["status"] == "").values].astype(np.int64)
    tide = inputs.tide
    if tide is None or mission.tide is None or not len(tide.ns) or not len(time):
        return []
    if tide.ns[0] <= time.min() and time.max() <= tide.ns[-1]:
        return []
    found = f"heights from {iso(tide.ns[0])} to {iso(tide.ns[-1])}"
    expected = f"heights from before {iso(time.min())} to after {iso(time.max())}, the images' times"
    return [Problem(mission.tide, None, "time", found, expected, "Add the missing rows; times are in UTC.")]
