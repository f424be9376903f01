"""What calibrations take from a mission: images, lines of light, navigation and matches."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..catalog.images import UnreadableImage, read_image
from ..catalog.interpolation import smoothed
from ..catalog.mission_files import MissionFiles
from ..catalog.mission_inputs import read_inputs
from ..catalog.missions import OpenedMission, open_mission
from ..catalog.store import Entry, Store
from ..schemas.calibration import Calibration, Mount
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.yaml_input import load_model
from ..tasks import features, laser, navigation, triangulation
from ..tasks.calibration_field import Matches, Points, Track
from ..tasks.calibration_flat import FlatData, gather
from ..tasks.calibration_lines import Lines, cross_on_flat, no_lines
from ..tasks.rotations import R_vehicle_camera
from . import match, plan
from .extract import ImageTask
from .job import Job, Made, log
from .progress import progress

Result = TypeVar("Result")

SMOOTH_S = 1.5
_RATE_STEP_S = 0.25
_LEAST_IMAGES = 4  # of a mission over a floor
_NEAR_S = 3.0
_POINTS_AN_ARM = 300


def read_calibration(path: Path) -> Calibration:
    """A calibration.yaml.

    Raises
    ------
    InvalidInput
        It cannot be read, or what is wrong with it.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        found = error.strerror or str(error)
        problem = Problem(str(path), None, "", found, "a calibration.yaml", "Correct the path.")
        raise InvalidInput([problem]) from error
    return load_model(content, str(path), Calibration)


class Survey(NamedTuple):
    """A mission to calibrate from.

    Attributes
    ----------
    url : as given. opened, plan : the mission, its navigation smoothed. rows : (n,) usable images.
    """

    url: str
    opened: OpenedMission
    made: plan.Plan
    rows: NDArray[np.intp]


def open_survey(
    url: str, start: Calibration | None, laser_only: bool, level_floor: bool, given: str = "--start"
) -> Survey:
    """Open a mission with navigation, its calibration replaced by `start` if given.

    given : where `start` comes from, for errors.

    Raises
    ------
    InvalidInput
        The mission is wrong, has no navigation or no laser.
    """
    opened = open_mission(url, hashed=False, smooth_s=SMOOTH_S, level_floor=level_floor)
    problems = []
    if start is not None:
        problems += _size_problems(url, opened, start, given)
        opened = opened._replace(calibration=start)
    if opened.crs is None:
        remedy = "Add navigation to mission.yaml, or calibrate with a board."
        problems.append(Problem(f"{url}/mission.yaml", 1, "navigation", "none", "navigation", remedy))
    if opened.calibration.laser is None:
        remedy = "Add laser to the calibration to start from: baseline, angle and roll by tape measure will do."
        where = f"{url}/{opened.mission.calibration}" if start is None else given
        problems.append(Problem(where, None, "laser", "none", "a laser", remedy))
    if problems:
        raise InvalidInput(problems)
    made = plan.plan(opened, Parameters())
    wanted = [image.row for image in made.images if not laser_only or image.role != "texture"]
    return Survey(url, opened, made, np.array(wanted, np.intp))


def _size_problems(url: str, opened: OpenedMission, start: Calibration, where: str) -> list[Problem]:
    own, given = ((c.camera.width, c.camera.height) for c in (opened.calibration, start))
    if own == given:
        return []
    found, expected = "x".join(map(str, given)), "{}x{}, as the images of {}".format(*own, url)
    remedy = "Start from a calibration of this camera at this image size."
    return [Problem(where, None, "camera", found, expected, remedy)]


def spread(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most so many rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int))]


def _read(survey: Survey, row: int) -> NDArray[np.uint8] | None:
    path = str(survey.opened.frames["image"].values[row])
    try:
        return read_image(survey.url, path, survey.opened.calibration.camera).bgr
    except (UnreadableImage, OSError) as error:
        log.warning("step=calibrate image=%s rejected: %s", path, error)
        return None


def _each(survey: Survey, step: str, measure: Callable[[Any], Result], wanted: Sequence[Any]) -> list[Result]:
    """What `measure` makes of each of those wanted, two at a time, in their order; progress is shown."""
    made = []
    with progress(survey.opened.mission.id, step, len(wanted)) as advance, ThreadPoolExecutor(2) as pool:
        for result in pool.map(measure, wanted):
            made.append(result)
            advance(1)
    return made


def flat_lines(survey: Survey, parameters: Parameters) -> list[Lines]:
    """Both lines of each image on a flat floor."""
    calibration = survey.opened.calibration
    assert calibration.laser is not None
    sheets = calibration.laser.sheets

    def one(row: int) -> Lines:
        bgr = _read(survey, row)
        return no_lines() if bgr is None else cross_on_flat(bgr, calibration.camera, sheets, parameters.laser)

    return _each(survey, "lines", one, survey.rows.tolist())


def _reference(survey: Survey) -> tuple[NDArray, NDArray]:
    """R_local_vehicle (n, 3, 3) and navigation reference points (n, 3) of the survey's rows, local frame."""
    prior, mount = survey.made.prior, survey.opened.calibration.mount
    assert prior is not None
    R = prior.poses.R_local_camera[survey.rows] @ R_vehicle_camera(*mount.rotation).T
    return R, prior.poses.C_local[survey.rows] - R @ np.asarray(mount.translation)


def _no_altitude(url: str) -> Problem:
    found, expected = "no altitude near the time of an image", "an altimeter: the laser's scale is measured against it"
    return Problem(url, None, "navigation", found, expected, "Fill the column altitude of the navigation.")


def flat_data(surveys: list[Survey], lines: list[list[Lines]]) -> tuple[FlatData, list[Problem]]:
    """Points and navigation of one mission or more, images with both lines only; and what is wrong with the others.

    Raises
    ------
    InvalidInput
        No mission can be used.
    """
    parts, problems = [], []
    for survey, found in zip(surveys, lines, strict=True):
        part = _over_floor(survey, found)
        (problems if isinstance(part, Problem) else parts).append(part)
    if not parts:
        raise InvalidInput(problems)
    for problem in problems:
        log.warning("step=calibrate left out: %s", problem)
    # each mission has a local frame of its own, and a floor of its own
    number = np.repeat(np.arange(len(parts)), [len(told) for told, _ in parts])
    R, X, altitude, depth, tilt = (np.concatenate(c) for c in zip(*[c for _, c in parts], strict=True))
    uv, image, arm, sigma = gather([one for told, _ in parts for one in told])
    return FlatData(uv, image, arm, sigma, R, X, altitude, number, depth, tilt), problems


def _over_floor(survey: Survey, found: list[Lines]) -> tuple[list[Lines], list[NDArray]] | Problem:
    """Lines and navigation of a mission's images with both lines, or why it is of no use."""
    R, X = _reference(survey)
    prior = survey.made.prior
    assert prior is not None
    keep = np.array([len(one.uv) > 0 for one in found], bool) & np.isfinite(X).all(1)
    if keep.sum() < _LEAST_IMAGES:
        shown, remedy = f"{keep.sum()} images with both lines", "Check that the laser was on and the floor is flat."
        return Problem(survey.url, None, "images", shown, f"at least {_LEAST_IMAGES}", remedy)
    altitude = survey.opened.frames["altitude"].values.astype(float)[survey.rows]
    if not np.isfinite(altitude[keep]).any():
        return _no_altitude(survey.url)
    tilt = prior.sigma_attitude[survey.rows][:, :2].mean(1)
    columns = R, X, altitude, prior.sigma_depth[survey.rows], tilt
    return [one for one, ok in zip(found, keep, strict=True) if ok], [c[keep] for c in columns]


def _reference_at(survey: Survey, opened: OpenedMission) -> tuple[NDArray, NDArray]:
    """As `_reference`, by another navigation but in the same local frame."""
    names = "longitude", "latitude", "elevation", "roll", "pitch", "heading"
    state = navigation.VehicleState(*(opened.frames[name].values.astype(float)[survey.rows] for name in names))
    poses = navigation.camera_poses(state, Mount(), survey.made.frame)
    return poses.R_local_camera @ R_vehicle_camera(0, 0, 0).T, poses.C_local


# ------------------------------------------------------------------------------------------------ survey


def track(survey: Survey, parameters: Parameters) -> Track:
    """Navigation of the survey's rows and how fast it changes."""
    prior = survey.made.prior
    assert prior is not None
    R, X = _reference(survey)
    sides = []
    for sign in (-1, 1):
        shifted = open_mission(survey.url, hashed=False, smooth_s=SMOOTH_S, shift_s=sign * _RATE_STEP_S)
        sides.append(_reference_at(survey, shifted))
    turn = np.einsum("nji,njk->nik", sides[0][0], sides[1][0])
    rate = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    step = 2 * _RATE_STEP_S
    return Track(
        R,
        X,
        np.nan_to_num(0.5 * rate / step),
        np.nan_to_num((sides[1][1] - sides[0][1]) / step),
        prior.time_s[survey.rows],
        prior.sigma_horizontal[survey.rows],
        prior.sigma_depth[survey.rows],
        prior.sigma_attitude[survey.rows],
        parameters.adjust.drift_m_per_sqrt_s,
    )


def altimeter(survey: Survey) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Every reading of the altimeter: the image (S,) nearest in time and the foot (S, 3) from its reference point."""
    problems: list[Problem] = []
    inputs = read_inputs(MissionFiles(survey.url), problems)
    mission, samples = inputs.mission, inputs.navigation
    assert mission is not None
    assert mission.navigation is not None
    assert samples is not None
    slow = smoothed(samples, SMOOTH_S)
    frames = survey.opened.frames
    start = frames["time"].values[survey.rows].astype(np.int64)
    ns = samples.ns + round(mission.navigation.time_offset * 1e9)
    known = np.isfinite(samples.altitude) & np.isfinite(slow.depth) & np.isfinite(slow.latitude)
    ns, altitude = ns[known], samples.altitude[known]
    if not len(ns):
        raise InvalidInput([_no_altitude(survey.url)])
    after = np.clip(np.searchsorted(start, ns), 1, max(1, len(start) - 1))
    before_nearer = np.abs(ns - start[after - 1]) <= np.abs(ns - start[np.minimum(after, len(start) - 1)])
    image = np.where(before_nearer, after - 1, np.minimum(after, len(start) - 1))
    near = np.abs(ns - start[image]) < _NEAR_S * 1e9
    if not near.any():
        raise InvalidInput([_no_altitude(survey.url)])
    image, ns, altitude = image[near], ns[near], altitude[near]
    frame = survey.made.frame
    place = [getattr(slow, name)[known][near] for name in ("longitude", "latitude", "depth")]
    X = frame.local_from_geographic(place[0], place[1], -place[2])
    at = [
        np.interp(start * 1e-9 - start[0] * 1e-9, (ns - start[0]) * 1e-9, column) for column in X.T
    ]  # tides and offsets cancel in the difference
    foot = X - np.column_stack(at)[image]
    foot[:, 2] -= altitude
    return image.astype(np.intp), foot


def soundings(survey: Survey, calibration: Calibration, parameters: Parameters) -> Points:
    """Laser points of the survey's rows with the arms as a calibration tells them."""
    light = calibration.laser
    assert light is not None

    def one(row: int) -> triangulation.Soundings:
        bgr = _read(survey, row)
        if bgr is None:
            return triangulation.no_soundings()
        return triangulation.sound(bgr, calibration.camera, light, parameters.laser).soundings

    parts = []
    for k, s in enumerate(_each(survey, "soundings", one, survey.rows.tolist())):
        for arm in (0, 1):
            own = np.flatnonzero(s.arm == arm)
            own = own[np.argsort(s.uv[own, 1], kind="stable")][:: max(1, len(own) // _POINTS_AN_ARM)]
            parts.append((s.uv[own], np.full(len(own), k), np.full(len(own), arm, np.int8)))
    uv, image, arm = (np.concatenate(field) for field in zip(*parts, strict=True))
    return Points(uv, image.astype(np.intp), arm, np.full(len(uv), 0.3))


def matches(survey: Survey, parameters: Parameters) -> Matches:
    """Matches of all overlapping pairs of the survey's rows, by feature and epipolar geometry: no laser is asked."""
    calibration, made = survey.opened.calibration, survey.made
    job = Job(survey.url, survey.opened.mission.id, Store(""), calibration, parameters)  # nothing is stored
    number = {int(row): k for k, row in enumerate(survey.rows)}
    of_survey = made._replace(images=tuple(image for image in made.images if image.row in number))
    tasks = plan.first_pairs(of_survey, survey.opened, parameters)
    paired = {row for task in tasks for row in (task.i, task.j)}
    needed = [image for image in of_survey.images if image.row in paired]
    seen = _each(survey, "features", lambda image: _entry(survey, image, parameters), needed)
    entries = {image.row: entry for image, entry in zip(needed, seen, strict=True)}

    def one(wanted: match.Wanted) -> Made:
        return match.between(job, match.believed(wanted, made.prior), entries[wanted.i], entries[wanted.j])

    found = _each(survey, "matches", one, tasks)
    linked = [(task, made_) for task, made_ in zip(tasks, found, strict=True) if made_.info["model"]]
    if not linked:
        none = np.zeros(0, np.intp)
        return Matches(none, none, np.zeros((0, 2)), np.zeros((0, 2)))
    sizes = [len(made_.arrays["uv_i"]) for _, made_ in linked]
    return Matches(
        np.repeat([number[task.i] for task, _ in linked], sizes).astype(np.intp),
        np.repeat([number[task.j] for task, _ in linked], sizes).astype(np.intp),
        np.concatenate([made_.arrays["uv_i"] for _, made_ in linked]).astype(float),
        np.concatenate([made_.arrays["uv_j"] for _, made_ in linked]).astype(float),
    )


def _entry(survey: Survey, image: ImageTask, parameters: Parameters) -> Entry:
    """Features of an image, away from whatever looks like laser light."""
    bgr = _read(survey, image.row)
    info: dict[str, Any] = {"range_m": None, "status": ""}
    if bgr is None:
        return Entry({"feature_uv": np.zeros((0, 2)), "feature_descriptors": np.zeros((0, 128), np.uint8)}, info)
    points = laser.detect(bgr, parameters.laser)
    width = float(np.median(points.width_px)) if len(points.uv) else 1.0
    erase = laser.mask(bgr.shape[:2], points.uv, 3.3 * width)
    grey = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
    found = features.detect(grey, erase, parameters.features, image.north_rad)
    return Entry({"feature_uv": found.uv, "feature_descriptors": found.descriptors}, info)
