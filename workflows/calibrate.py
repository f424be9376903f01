"""What all three ways of `seamosaic calibrate` share: the files they write, sheets as found, words and figures."""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from ..schemas.calibration import Calibration, CovarianceBlock, Laser, LaserPlane
from ..schemas.problems import InvalidInput, Problem
from ..tasks.calibration_refraction import pinhole_error
from ..tasks.calibration_sheets import (
    SheetBasis,
    as_plane,
    block,
    sensitivity,
    sheet_names,
    step_jacobian,
)
from . import calibration_report as report

Array = NDArray[np.float64]

CALIBRATION: Final = "calibration.yaml"
REPORT: Final = "calibration-report.html"
STEPS: Final = ("turned in the image", "tilted", "shifted")
_UNITS: Final = ("deg", "deg", "mm")
MOUNT: Final = ("roll", "pitch", "yaw")
_SHOWN_M: Final = 9


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
    if out.parts[:1] and out.parts[0].endswith(":"):
        remedy = "Write it to this machine, and copy it from there."
        raise InvalidInput([Problem(str(out), None, "", "a URL", "a local folder", remedy)])
    if (out / CALIBRATION).exists():
        remedy = "Choose another folder; calibrations are never overwritten."
        raise InvalidInput([Problem(str(out / CALIBRATION), None, "", "a calibration", "no such file yet", remedy)])
    there = next(place for place in (out, *out.parents) if os.path.exists(place))
    if not there.is_dir() or not os.access(there, os.W_OK):
        found = "a folder that may not be written" if there.is_dir() else "a file"
        remedy = "Give --out a folder, which need not exist, where you may write."
        raise InvalidInput([Problem(str(there), None, "", found, "a folder that can be written", remedy)])


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
    return start.laser.model_copy(update={"planes": sheets.planes})


def sheets_and_mount(
    start: Calibration, sheets: Sheets, covariance: Array, mount: Sequence[str]
) -> tuple[CovarianceBlock, ...]:
    """One block of both sheets and the mount's angles (degrees), and what the start knew of all else."""
    count = len(mount)
    J = np.zeros((8 + count, 6 + count))
    J[:8, :6], J[8:, 6:] = sheets.jacobian, np.degrees(np.eye(count))
    names = [*sheets.names, *(f"mount.rotation.{name}" for name in mount)]
    return (
        *known_of(start, lambda name: not name.startswith("laser.") and name not in names),
        block(names, J @ covariance[: 6 + count, : 6 + count] @ J.T),
    )


def known_of(start: Calibration, wanted: Callable[[str], bool]) -> tuple[CovarianceBlock, ...]:
    """The covariances of some parameters in a calibration."""
    found = []
    for one in start.covariance:
        kept = [k for k, name in enumerate(one.parameters) if wanted(name)]
        if kept:
            found.append(block([one.parameters[k] for k in kept], np.array(one.matrix)[np.ix_(kept, kept)]))
    return tuple(found)


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
    covariance = sheets.jacobian @ sheets.covariance @ sheets.jacobian.T
    sigma = sensitivity(calibration.camera, sheets.planes, shown).sigma_m(covariance)
    lit = np.flatnonzero(np.isfinite(sigma))
    if not len(lit):
        return "At none of these altitudes does the camera see the laser on level ground."
    three = lit[[0, len(lit) // 2, -1]]
    parts = [
        f"{1e3 * s:.2g} mm ({100 * s / a:.2g} %) at {a:.2f} m" for s, a in zip(sigma[three], shown[three], strict=True)
    ]
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
    if not np.isfinite(error.fitted_percent).any():
        return [], []
    worst = int(np.nanargmax(np.abs(error.fitted_percent)))
    said = (
        "With a pinhole (brown) camera fitted in water instead of this port's exact refraction, sheets fitted with it, "
        f"altitudes would be wrong by up to {error.fitted_percent[worst]:+.2f} % (at {shown[worst]:.2f} m); with the "
        f"camera alone exchanged, by up to {np.nanmax(np.abs(error.camera_only_percent)):.2f} %."
    )
    caption = "Even with perfect observations; the camera is fitted at the middle altitude."
    figure = report.picture("If a pinhole were fitted instead", report.pinhole_figure(error), caption)
    return [said], [figure]
