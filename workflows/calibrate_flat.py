"""`seamosaic calibrate flat`: over a flat floor, and its report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Calibration, Mount
from ..schemas.parameters import Parameters
from ..tasks import calibration_flat as flat
from ..tasks.calibration_sheets import altitude_error
from . import calibrate
from . import calibrate_inputs as inputs
from . import calibration_report as report

Array = NDArray[np.float64]

_LEVELS: Final = 4
_OF_MOUNT: Final = (
    "Mount angles cannot be told from constant errors of the navigation's roll and pitch; their sigma includes those "
    "as the mission states them."
)


def run_flat(
    missions: Sequence[str],
    out: Path,
    start: Calibration | None,
    priors: flat.Priors,
    parameters: Parameters,
    boresight: bool = True,
    images: int = 120,
) -> calibrate.Written:
    """Calibrate over a flat floor, from one mission or from several of the same vehicle.

    Raises
    ------
    InvalidInput
        A mission is wrong, or none can be used; one of several that cannot is left out and named.
    """
    calibrate.prepare(out)
    first = inputs.open_survey(missions[0], start, laser_only=True, level_floor=True)
    calibration = first.opened.calibration
    given = "--start" if start else f"{missions[0]}/{first.opened.mission.calibration}"
    others = [
        inputs.open_survey(url, calibration, laser_only=True, level_floor=True, given=given) for url in missions[1:]
    ]
    share = max(4, images // len(missions))
    surveys = [survey._replace(rows=inputs.spread(survey.rows, share)) for survey in (first, *others)]
    data, unused = inputs.flat_data(surveys, [inputs.flat_lines(survey, parameters) for survey in surveys])
    found = flat.calibrate_flat(data, calibration, priors, boresight)
    rotation = (*found.boresight_deg.tolist(), calibration.mount.rotation[2])
    sheets = calibrate.Sheets(found.starts, found.sheets, found.steps, found.covariance[:6, :6], found.prior_sigma[:6])
    result = calibration.model_copy(
        update={
            "laser": calibrate.with_sheets(calibration, sheets),
            "mount": Mount(translation=calibration.mount.translation, rotation=rotation),
            "covariance": calibrate.sheets_and_mount(
                calibration, sheets, found.covariance, calibrate.MOUNT[: 2 * boresight]
            ),
        }
    )
    page = _flat_page(missions, data, calibration, priors, boresight, found, sheets, result)
    return calibrate.write(
        out, result, page._replace(warnings=(*page.warnings, *(f"left out: {one}" for one in unused)))
    )


def _flat_page(
    missions: Sequence[str],
    data: flat.FlatData,
    start: Calibration,
    priors: flat.Priors,
    boresight: bool,
    found: flat.FlatResult,
    sheets: calibrate.Sheets,
    result: Calibration,
) -> report.Page:
    by_image = _floor_ranges(data, start)
    ranges = by_image[np.isfinite(by_image)]
    shown = calibrate.altitudes(float(ranges.min()), float(ranges.max()))
    sigma = np.degrees(np.sqrt(np.diag(found.covariance)[6:]))
    rows = calibrate.sheet_rows(sheets)
    if boresight:
        rows += [
            report.Row(f"mount {name}", "deg", float(v), float(s), float(b), priors.boresight_deg)
            for name, v, s, b in zip(calibrate.MOUNT, found.boresight_deg, sigma, start.mount.rotation, strict=False)
        ]
    said, figures = calibrate.port_parts(result, shown)
    lit = found.used
    size = (start.camera.width, start.camera.height)
    names = [f"sheet {s.name}" for s in found.starts]
    residuals = report.residual_map(data.uv[lit], 1e3 * found.residual_m[lit], size, data.arm[lit], names, "mm")
    means = report.bars(list(1e3 * found.image_m.T), names, "image", "mean height above the floor (mm)")
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
            calibrate.accuracy_statement(result, sheets, shown),
            *calibrate.verdicts(rows),
            f"The scale rests on the altimeter and the mount's lever arm: a constant error of either goes into every "
            f"altitude; it was taken as {1e3 * priors.altimeter_m:.2g} mm (1-sigma), and several altitudes find "
            f"{1e3 * found.altimeter_m[0]:.2f} ± {1e3 * found.altimeter_m[1]:.2f} mm of it.",
            *([_OF_MOUNT] if boresight else []),
            *said,
        ),
        left_out_header=("Left out", "images", *(f"change of altitude by {name}" for name in names)),
        left_out=tuple(_flat_left_out(data, start, priors, boresight, found, by_image)),
        pictures=(
            report.picture("Residuals in the image", residuals, "Heights above the floor, where they were measured."),
            report.picture("Residuals by image", means, "Mean height of each image's points above the floor."),
            calibrate.sensitivity_picture(result, sheets, shown),
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
    """Height of each camera above the floor (n,), by the altimeter; NaN where that was blind."""
    return data.altitude_m + (data.R_local_vehicle @ np.asarray(calibration.mount.translation))[:, 2]


def _flat_left_out(
    data: flat.FlatData, start: Calibration, priors: flat.Priors, boresight: bool, full: flat.FlatResult, ranges: Array
) -> list[report.LeftOut]:
    """What happens to the altitude of a quarter of the images, by height, if the calibration does not know them."""
    known = np.flatnonzero(np.isfinite(ranges))
    if len(known) < 2 * _LEVELS:
        return []
    lines = []
    for part in np.array_split(known[np.argsort(ranges[known], kind="stable")], _LEVELS):
        found = flat.calibrate_flat(data.take(~np.isin(data.image, part)), start, priors, boresight)
        at = float(ranges[part].mean())
        change = [altitude_error(start.camera, full.sheets[s], found.sheets[s], at) for s in (0, 1)]
        values = f"{len(part)}", *(f"{1e3 * c:+.2f} mm ({100 * c / at:+.3f} %)" for c in change)
        lines.append(report.LeftOut(f"around {at:.2f} m", values))
    return lines
