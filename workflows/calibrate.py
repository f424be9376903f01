"""`seamosaic calibrate`: three ways to a calibration.yaml with covariances, each with a report of one page."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from ..schemas.calibration import Calibration, CovarianceBlock, Laser, LaserPlane, Mount
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..tasks import calibration_field as field
from ..tasks import calibration_flat as flat
from ..tasks.calibration_refraction import pinhole_error
from ..tasks.calibration_sheets import (
    SheetBasis,
    altitude_error,
    as_plane,
    block,
    sensitivity,
    sheet_names,
    step_jacobian,
)
from . import calibrate_inputs as inputs
from . import calibration_report as report
from .calibrate_field import calibrate_field

Array = NDArray[np.float64]

CALIBRATION: Final = "calibration.yaml"
REPORT: Final = "calibration-report.html"
STEPS: Final = ("turned in the image", "tilted", "shifted")
_UNITS: Final = ("deg", "deg", "mm")
_MOUNT: Final = ("roll", "pitch", "yaw")
_SHOWN_M: Final = 9
_LEVELS: Final = 4


class Written(NamedTuple):
    """What a calibration left: the file, the report and the page's content."""

    calibration: Path
    html: Path
    page: report.Page
    result: Calibration


def prepare(out: Path) -> None:
    """Refuse a folder that has a calibration already, before anything is computed.

    Raises
    ------
    InvalidInput
    """
    if (out / CALIBRATION).exists():
        remedy = "Choose another folder; calibrations are never overwritten."
        raise InvalidInput([Problem(str(out / CALIBRATION), None, "", "a calibration", "no such file yet", remedy)])
    if out.exists() and not out.is_dir():
        remedy = "Give --out a folder, which need not exist."
        raise InvalidInput([Problem(str(out), None, "", "a file", "a folder", remedy)])


def write(out: Path, calibration: Calibration, page: report.Page) -> Written:
    """Write both files, each whole or not at all."""
    content = json.loads(calibration.model_dump_json(exclude_none=True))
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    out.mkdir(parents=True, exist_ok=True)
    paths = out / CALIBRATION, out / REPORT
    temporary = paths[0].with_name(f".{CALIBRATION}.{os.getpid()}")
    temporary.write_text(text, encoding="utf-8")
    report.write_page(paths[1], page)
    temporary.replace(paths[0])
    return Written(*paths, page, calibration)


# --------------------------------------------------------------------------------------------- shared parts


class Sheets(NamedTuple):
    """Sheets as steps from where they started.

    Attributes
    ----------
    starts : bases. steps : (6,). covariance : (6, 6) of the steps. prior : (6,) or None.
    """

    starts: Sequence[SheetBasis]
    sheets: Array
    steps: Array
    covariance: Array
    prior: Array | None

    @property
    def jacobian(self) -> Array:
        """(8, 6) normals and offsets by step."""
        J = np.zeros((8, 6))
        for s in (0, 1):
            own = slice(3 * s, 3 * s + 3)
            J[4 * s : 4 * s + 4, own] = step_jacobian(self.starts[s], self.steps[own])
        return J

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the eight numbers in a covariance block."""
        return tuple(name for start in self.starts for name in sheet_names(start.name))

    @property
    def planes(self) -> tuple[LaserPlane, LaserPlane]:
        """As the calibration has them."""
        first, second = (as_plane(b.name, s) for b, s in zip(self.starts, self.sheets, strict=True))
        return first, second


def with_sheets(start: Calibration, sheets: Sheets) -> Laser:
    """The laser of a calibration with other sheets."""
    assert start.laser is not None
    return Laser(wavelength_nm=start.laser.wavelength_nm, origin=start.laser.origin, planes=sheets.planes)


def sheet_rows(sheets: Sheets) -> list[report.Row]:
    """Rows of both sheets: how they were moved from where they started."""
    sigma, rows = np.sqrt(np.diag(sheets.covariance)), []
    for k in range(6):
        factor = 1e3 if k % 3 == 2 else float(np.degrees(1.0))
        prior = None if sheets.prior is None else float(factor * sheets.prior[k])
        name = f"sheet {sheets.starts[k // 3].name}: {STEPS[k % 3]} by"
        value, start = float(factor * sheets.steps[k]), None if sheets.prior is None else 0.0
        rows.append(report.Row(name, _UNITS[k % 3], value, float(factor * sigma[k]), start, prior))
    return rows


def altitudes(low: float, high: float) -> Array:
    """Altitudes to show, a third beyond those of the data on either side."""
    return np.linspace(0.75 * low, 1.33 * high, _SHOWN_M)


def sensitivity_picture(calibration: Calibration, sheets: Sheets, shown: Array) -> report.Figured:
    """The figure of what each parameter's sigma does."""
    effect = sensitivity(calibration.camera, sheets.planes, shown)
    names = [f"{start.name}: {step}" for start in sheets.starts for step in STEPS]
    figure = report.sensitivity_figure(effect, sheets.covariance, sheets.jacobian, names)
    caption = (
        "What one sigma of each sheet parameter does to the mean altitude over level ground, and all together. "
        "Below the dotted line, calibration costs less than 0.1 %."
    )
    return report.picture("Sensitivity of the altitude", figure, caption)


def accuracy_statement(calibration: Calibration, sheets: Sheets, shown: Array) -> str:
    """The altitude's sigma at three altitudes, in words."""
    three = shown[[0, len(shown) // 2, -1]]
    covariance = sheets.jacobian @ sheets.covariance @ sheets.jacobian.T
    sigma = sensitivity(calibration.camera, sheets.planes, three).sigma_m(covariance)
    parts = [f"{1e3 * s:.2g} mm ({100 * s / a:.2g} %) at {a:.2f} m" for s, a in zip(sigma, three, strict=True)]
    return "Mean altitudes over level ground are known to " + ", ".join(parts) + " (1-sigma, by this calibration)."


def verdicts(rows: Sequence[report.Row]) -> list[str]:
    """Sentences about what the data leave open."""
    partly = [row.name.removesuffix(" by") for row in rows if row.verdict == "partly determined"]
    open_ = [row.name.removesuffix(" by") for row in rows if row.verdict == "not determined"]
    said = []
    if open_:
        said.append("The data do not determine: " + "; ".join(open_) + ". These keep what they started with.")
    if partly:
        said.append("The data determine only in part: " + "; ".join(partly) + ".")
    if not open_ and not partly:
        said.append("Every parameter is determined by the data, not by what was believed before.")
    return said


def port_parts(calibration: Calibration, shown: Array) -> tuple[list[str], list[report.Figured]]:
    """For a flat port: how wrong a camera fitted without it would be."""
    if calibration.camera.port is None or calibration.laser is None:
        return [], []
    error = pinhole_error(calibration.camera, calibration.laser, shown)
    worst = int(np.nanargmax(np.abs(error.fitted_percent)))
    said = (
        "With a pinhole (brown) camera fitted in water instead of this port's exact refraction, sheets fitted with it, "
        f"altitudes would be wrong by up to {error.fitted_percent[worst]:+.2f} % (at {shown[worst]:.2f} m); with the "
        f"camera alone exchanged, by up to {np.nanmax(np.abs(error.camera_only_percent)):.2f} %."
    )
    caption = "Even with perfect observations; the camera is fitted at the middle altitude."
    figure = report.picture("If a pinhole were fitted instead", report.pinhole_figure(error), caption)
    return [said], [figure]


# --------------------------------------------------------------------------------------------------- flat


def run_flat(
    missions: Sequence[str],
    out: Path,
    start: Calibration | None,
    priors: flat.Priors,
    parameters: Parameters,
    boresight: bool = True,
    images: int = 120,
) -> Written:
    """Calibrate over a flat floor, from one mission or from several of the same vehicle.

    Raises
    ------
    InvalidInput
        A mission cannot be used.
    """
    prepare(out)
    first = inputs.open_survey(missions[0], start, laser_only=True, level_floor=True)
    calibration = first.opened.calibration
    others = [inputs.open_survey(url, calibration, laser_only=True, level_floor=True) for url in missions[1:]]
    share = max(4, images // len(missions))
    surveys = [survey._replace(rows=inputs.spread(survey.rows, share)) for survey in (first, *others)]
    data = inputs.flat_data(surveys, [inputs.flat_lines(survey, parameters) for survey in surveys])
    found = flat.calibrate_flat(data, calibration, priors, boresight)
    rotation = (*found.boresight_deg.tolist(), calibration.mount.rotation[2])
    sheets = Sheets(found.starts, found.sheets, found.steps, found.covariance[:6, :6], found.prior_sigma[:6])
    result = calibration.model_copy(
        update={
            "laser": with_sheets(calibration, sheets),
            "mount": Mount(translation=calibration.mount.translation, rotation=rotation),
            "covariance": _joined(calibration, sheets, found.covariance, _MOUNT[:2]),
        }
    )
    return write(out, result, _flat_page(missions, data, calibration, priors, boresight, found, sheets, result))


def _joined(start: Calibration, sheets: Sheets, covariance: Array, mount: Sequence[str]) -> tuple[CovarianceBlock, ...]:
    """One block of both sheets and the mount's angles (degrees); the starting calibration's block of the camera."""
    count = len(mount)
    J = np.zeros((8 + count, 6 + count))
    J[:8, :6], J[8:, 6:] = sheets.jacobian, np.degrees(np.eye(count))
    names = [*sheets.names, *(f"mount.rotation.{name}" for name in mount)]
    kept = [b for b in start.covariance if all(name.startswith("camera.") for name in b.parameters)]
    return (*kept, block(names, J @ covariance[: 6 + count, : 6 + count] @ J.T))


def _flat_page(
    missions: Sequence[str],
    data: flat.FlatData,
    start: Calibration,
    priors: flat.Priors,
    boresight: bool,
    found: flat.FlatResult,
    sheets: Sheets,
    result: Calibration,
) -> report.Page:
    ranges = _floor_ranges(data, start)
    shown = altitudes(float(ranges.min()), float(ranges.max()))
    sigma = np.degrees(np.sqrt(np.diag(found.covariance)[6:]))
    rows = sheet_rows(sheets)
    if boresight:
        rows += [
            report.Row(f"mount {name}", "deg", float(v), float(s), float(b), priors.boresight_deg)
            for name, v, s, b in zip(_MOUNT, found.boresight_deg, sigma, start.mount.rotation, strict=False)
        ]
    said, figures = port_parts(result, shown)
    lit = found.used
    size = (start.camera.width, start.camera.height)
    names = [f"sheet {s.name}" for s in found.starts]
    residuals = report.residual_map(data.uv[lit], 1e3 * found.residual_m[lit], size, data.arm[lit], names, "mm")
    by_image = report.bars(list(1e3 * found.image_m.T), names, "image", "mean height above the floor (mm)")
    facts = (
        ("Missions", ", ".join(missions)),
        ("Images with both lines", f"{len(data.X_local)}"),
        ("Laser points used", f"{int(lit.sum())} of {len(lit)}"),
        ("Ranges to the floor", f"{ranges.min():.2f} to {ranges.max():.2f} m"),
        ("Heights above the floor, rms", f"{1e3 * np.sqrt(np.mean(found.residual_m[lit] ** 2)):.2f} mm"),
        ("Noise of depth, tilt, altimeter", _noise(found)),
        ("Slope of the floor to east, north", "; ".join(f"{e:.3f}, {n:.3f} deg" for e, n in found.slopes_deg)),
    )
    return report.Page(
        title="Calibration over a flat floor",
        way="All light of an image lies on the floor; navigation says where the floor is.",
        facts=facts,
        rows=tuple(rows),
        statements=(
            accuracy_statement(result, sheets, shown),
            *verdicts(rows),
            f"The scale rests on the altimeter and the mount's lever arm: a constant error of either goes into every "
            f"altitude; it was taken as {1e3 * priors.altimeter_m:.2g} mm (1-sigma), and several altitudes find "
            f"{1e3 * found.altimeter_m[0]:.2f} ± {1e3 * found.altimeter_m[1]:.2f} mm of it.",
            "Mount angles cannot be told from constant errors of the navigation's roll and pitch; their sigma "
            "includes those as the mission states them.",
            *said,
        ),
        left_out_header=("Left out", "images", *(f"change of altitude by {name}" for name in names)),
        left_out=tuple(_flat_left_out(data, start, priors, boresight, found, ranges)),
        pictures=(
            report.picture("Residuals in the image", residuals, "Heights above the floor, where they were measured."),
            report.picture("Residuals by image", by_image, "Mean height of each image's points above the floor."),
            sensitivity_picture(result, sheets, shown),
            *figures,
        ),
        warnings=tuple(_flat_warnings(ranges)),
    )


def _noise(found: flat.FlatResult) -> str:
    noise = found.noise
    return f"{1e3 * noise['depth_m']:.1f} mm, {noise['tilt_deg']:.3f} deg, {1e3 * noise['altimeter_m']:.1f} mm"


def _flat_warnings(ranges: Array) -> list[str]:
    if ranges.max() < 1.25 * ranges.min():
        return [
            f"all ranges lie between {ranges.min():.2f} and {ranges.max():.2f} m: tilt and shift of the sheets can "
            "hardly be told apart; sail at two altitudes or more, one half again as high as the other"
        ]
    return []


def _floor_ranges(data: flat.FlatData, calibration: Calibration) -> Array:
    """Height of each camera above the floor (n,), by the altimeter."""
    lever = data.R_local_vehicle @ np.asarray(calibration.mount.translation)
    ranges = data.altitude_m + lever[:, 2]
    known = ranges[np.isfinite(ranges)]
    return known if len(known) else np.array([2.5])


def _flat_left_out(
    data: flat.FlatData, start: Calibration, priors: flat.Priors, boresight: bool, full: flat.FlatResult, ranges: Array
) -> list[report.LeftOut]:
    """What happens to the altitude of a quarter of the images, by height, if the calibration does not know them."""
    if len(ranges) != len(data.X_local) or len(ranges) < 2 * _LEVELS:
        return []
    lines = []
    for part in np.array_split(np.argsort(ranges, kind="stable"), _LEVELS):
        found = flat.calibrate_flat(data.take(~np.isin(data.image, part)), start, priors, boresight)
        at = float(ranges[part].mean())
        change = [altitude_error(start.camera, full.sheets[s], found.sheets[s], at) for s in (0, 1)]
        values = f"{len(part)}", *(f"{1e3 * c:+.2f} mm ({100 * c / at:+.3f} %)" for c in change)
        lines.append(report.LeftOut(f"around {at:.2f} m", values))
    return lines


# -------------------------------------------------------------------------------------------------- field


def run_field(
    mission: str,
    out: Path,
    start: Calibration | None,
    priors: field.FieldPriors,
    parameters: Parameters,
    images: int = 60,
) -> Written:
    """Calibrate from the crossovers of an ordinary mission.

    Raises
    ------
    InvalidInput
        The mission cannot be used, or its images hardly overlap.
    """
    prepare(out)
    outcome = calibrate_field(mission, start, priors, parameters, images)
    found, begun = outcome.result, outcome.problem.calibration
    own = outcome.problem.starts
    sheets = Sheets(own, found.sheets, found.shared[:6], found.covariance[:6, :6], found.prior_sigma[:6])
    mount = Mount(translation=begun.mount.translation, rotation=tuple(found.mount_deg.tolist()))
    result = begun.model_copy(
        update={
            "laser": with_sheets(begun, sheets),
            "mount": mount,
            "covariance": _joined(begun, sheets, found.covariance, _MOUNT),
        }
    )
    page = _field_page(mission, outcome.problem, found, sheets, result, priors, outcome.range_m)
    return write(out, result, page)


def _field_rows(begun: Calibration, found: field.FieldResult, sheets: Sheets) -> list[report.Row]:
    sigma, prior = np.sqrt(np.diag(found.covariance)), found.prior_sigma
    rows = sheet_rows(sheets)
    for k, name in enumerate(_MOUNT):
        s, p = (float(np.degrees(v[6 + k])) for v in (sigma, prior))
        rows.append(report.Row(f"mount {name}", "deg", float(found.mount_deg[k]), s, begun.mount.rotation[k], p))
    rows.append(report.Row("time offset to add", "s", found.clock_s, float(sigma[9]), 0.0, float(prior[9])))
    return rows


def _field_page(
    mission: str,
    problem: field.FieldProblem,
    found: field.FieldResult,
    sheets: Sheets,
    result: Calibration,
    priors: field.FieldPriors,
    range_m: float,
) -> report.Page:
    camera = result.camera
    rows = _field_rows(problem.calibration, found, sheets)
    shown = altitudes(0.8 * range_m, 1.2 * range_m)
    said, figures = port_parts(result, shown)
    first = problem.points.arm[problem.crossings.p[:, 0]]
    names = [f"sheet {s.name}" for s in problem.starts]
    lit = found.used
    heights = 1e3 * found.crossing_m
    residuals = report.residual_map(
        found.crossing_uv[lit], heights[lit], (camera.width, camera.height), first[lit], names, "mm"
    )
    facts = (
        ("Mission", mission),
        ("Images", f"{len(problem.track.time_s)}"),
        ("Crossovers of laser lines", f"{found.counts['crossover']}"),
        ("Their height differences, rms", f"{np.sqrt(np.mean(heights[lit] ** 2)):.2f} mm"),
        ("Matches beside a line, matches in all", f"{found.counts['beside']}, {found.counts['match']}"),
        ("Altimeter readings over a line", f"{found.counts['altimeter']}"),
    )
    said_clock = (
        f"The navigation's clock: {found.clock_s:+.3f} s is to be added to navigation.time_offset in mission.yaml "
        f"(± {np.sqrt(found.covariance[9, 9]):.3f} s); it is no part of calibration.yaml."
    )
    return report.Page(
        title="Calibration from crossovers",
        way="Where lines of light of different images cross, they have to be at one height.",
        facts=facts,
        rows=tuple(rows),
        statements=(
            accuracy_statement(result, sheets, shown),
            *verdicts(rows),
            said_clock,
            "Crossovers alone say nothing of the scale: it comes from the altimeter, whose constant error, with the "
            f"lever arm's, was taken as {1e3 * priors.altimeter_m:.2g} mm (1-sigma) and goes into every altitude, and "
            "from the lengths of the track.",
            "Mount angles cannot be told from constant errors of the navigation's roll, pitch and heading; their sigma "
            "includes those as the mission states them.",
            *said,
        ),
        left_out_header=(
            "Left out",
            "crossovers",
            "rms of those left out",
            *(f"change of altitude by {n}" for n in names),
        ),
        left_out=tuple(_field_left_out(problem, found, range_m)),
        pictures=(
            report.picture("Crossovers in the image", residuals, "Height differences, at the first image's line."),
            sensitivity_picture(result, sheets, shown),
            *figures,
        ),
    )


def _field_left_out(problem: field.FieldProblem, full: field.FieldResult, range_m: float) -> list[report.LeftOut]:
    """Every second crossover left out, in turn."""
    lines, count = [], len(problem.crossings.f)
    for turn, name in enumerate(("odd", "even")):
        out = np.arange(count) % 2 == turn
        c = problem.crossings
        kept = field.Crossings(c.p[~out], c.q[~out], c.f[~out], c.g[~out])
        found = field.adjust_field(problem._replace(crossings=kept, sigma=full.sigma), full.x, rounds=1)
        off = field.heights_with(problem, found.x)[out & full.used]
        change = [altitude_error(problem.calibration.camera, full.sheets[s], found.sheets[s], range_m) for s in (0, 1)]
        rms = f"{1e3 * np.sqrt(np.mean(off**2)):.2f} mm"
        lines.append(report.LeftOut(name, (f"{out.sum()}", rms, *(f"{1e3 * c:+.2f} mm" for c in change))))
    return lines
