"""`seamosaic calibrate board`: photographs of a chessboard or ChArUco board with the laser on it, or beside it."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ..schemas.calibration import Calibration, Camera, Laser, Mount
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..tasks import calibration_board as adjusting
from ..tasks import calibration_board_start as starting
from ..tasks import calibration_targets as targets
from ..tasks.board_shape import heights
from ..tasks.calibration_lines import Area, averaged, cross_on_flat
from ..tasks.calibration_sheets import as_plane, basis, block, sheet_names, step_jacobian
from . import calibrate
from . import calibration_report as report
from .job import log
from .progress import progress

Array = NDArray[np.float64]
Lines = Literal["cross"] | int

PLANES: Final = "planes.yaml"
_MIN_IMAGES: Final = 4
_LEAST_LIT: Final = 3  # photographs with light
_LEAST_OF_SHEET: Final = 2  # of them, with that of each sheet
_LEAST_BENT: Final = 10  # photographs from which a board's shape can be told
_GROW: Final = 0.15
_KINDS: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_FREE: Final = {
    "brown": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "flat-port": ("fx", "fy", "cx", "cy"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2"),
}
_FEW: Final = 15  # images below which tangential distortion is left out


class BoardSetup(NamedTuple):
    """How the photographs were taken.

    Attributes
    ----------
    board : the target. lines : cross, or how many lines run from top to bottom without crossing.
    beside : the light lies beside the board, on the surface to which it is fixed, rather than on it.
    start : camera (held if `hold_camera`), sheets and mount to start from, or None.
    model : of the camera where there is no start. bent : whether the board's shape is estimated too.
    """

    board: targets.Board
    lines: Lines
    beside: bool
    start: Calibration | None
    hold_camera: bool
    model: starting.Model
    bent: bool = False


class _Seen(NamedTuple):
    names: tuple[str, ...]
    corners: list[tuple[Array, Array]]
    light: list[targets.Light]
    size: tuple[int, int]


def run_board(folder: Path, out: Path, setup: BoardSetup, parameters: Parameters) -> calibrate.Written:
    """Calibrate camera and sheets from a folder of photographs.

    A cross gives a whole calibration.yaml. Any other number of lines has no place in that format: it gives the camera
    there, and the sheets in planes.yaml beside it.

    Raises
    ------
    InvalidInput
        Too few photographs show the board.
    """
    calibrate.prepare(out)
    seen = _look(folder, setup, parameters)
    camera = _first_camera(seen, setup)
    free = () if setup.hold_camera else _free(camera.model, len(seen.names))
    found = adjusting.calibrate_board(_data(seen), camera, free, setup.bent)
    result = _calibration(found, setup, free)
    page = _page(folder, seen, setup, found, free, result)
    if result.laser is None and len(found.sheets):  # first: with calibration.yaml the folder is finished
        _write_planes(out, found)
    return calibrate.write(out, result, page)


def _free(model: starting.Model, images: int) -> tuple[str, ...]:
    free = _FREE[model]
    return tuple(name for name in free if images >= _FEW or name not in ("p1", "p2"))


def _first_camera(seen: _Seen, setup: BoardSetup) -> Camera:
    if setup.start is None:
        return starting.first_camera(seen.corners, seen.size, setup.model, _free(setup.model, len(seen.names)))
    camera = setup.start.camera
    if (camera.width, camera.height) != seen.size:
        found, expected = f"{seen.size[0]} x {seen.size[1]}", f"{camera.width} x {camera.height} pixels"
        raise InvalidInput([Problem("images", None, "", found, expected, "Use the calibration of this camera.")])
    return camera


def _look(folder: Path, setup: BoardSetup, parameters: Parameters) -> _Seen:
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in _KINDS) if folder.is_dir() else []
    if not paths:
        remedy = "Give the folder that holds the photographs."
        raise InvalidInput([Problem(str(folder), None, "", "no images", "JPEG, PNG or TIFF images", remedy)])
    names, corners, light, sizes = [], [], [], []
    for path in _shown(paths, folder.name):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            log.warning("step=calibrate image=%s rejected: it cannot be decoded", path.name)
            continue
        bgr = np.asarray(image, np.uint8)
        board = targets.corners(targets.without_light(bgr), setup.board)
        if board is None:
            log.warning("step=calibrate image=%s rejected: no board found", path.name)
            continue
        names.append(path.name)
        light.append(_light(bgr, board[1], setup, parameters))
        corners.append(targets.clear_of(board, light[-1].uv))
        sizes.append((bgr.shape[1], bgr.shape[0]))
    _enough(folder, setup, names, sizes, light)
    return _Seen(tuple(names), corners, light, sizes[0])


def _shown(paths: Sequence[Path], name: str) -> Iterator[Path]:
    """The paths one by one, and how far they are."""
    with progress(name, "photographs", len(paths)) as advance:
        for path in paths:
            yield path
            advance(1)


def _enough(folder: Path, setup: BoardSetup, names: list, sizes: list, light: list[targets.Light]) -> None:
    problems = []
    if len(names) < _MIN_IMAGES:
        size = f"{setup.board.columns} x {setup.board.rows}"
        found = f"{len(names)} images with a {setup.board.kind} of {size}"
        remedy = "Count inner corners for a chessboard and squares for ChArUco; light it evenly; show all of it."
        problems.append(Problem(str(folder), None, "", found, f"at least {_MIN_IMAGES}", remedy))
    else:
        problems += _too_dark(folder, setup, light)
    if len(set(sizes)) > 1:
        found = "images of " + ", ".join(f"{w} x {h}" for w, h in sorted(set(sizes)))
        problems.append(Problem(str(folder), None, "", found, "one size", "Take all with one camera setting."))
    if problems:
        raise InvalidInput(problems)


def _too_dark(folder: Path, setup: BoardSetup, light: list[targets.Light]) -> Iterator[Problem]:
    """Every sheet has to be seen in two photographs or more: about the line of a single one it could turn freely."""
    remedy = "Check --lines, and whether the light is on the board or --beside it; hold it so that every line is on it."
    if sum(len(one.uv) > 0 for one in light) < _LEAST_LIT:
        found = f"the laser in {sum(len(one.uv) > 0 for one in light)} of them"
        yield Problem(str(folder), None, "", found, f"the laser in at least {_LEAST_LIT}", remedy)
        return
    for sheet, name in enumerate(_sheet_names(setup)):
        lit = sum(bool((one.sheet == sheet).any()) for one in light)
        if lit < _LEAST_OF_SHEET:
            found = f"the laser's sheet {name} in {lit} of them"
            yield Problem(str(folder), None, "", found, f"in at least {_LEAST_OF_SHEET}", remedy)


def _sheet_names(setup: BoardSetup) -> list[str]:
    """Names of the sheets, of which those of parallel lines are numbers from the left."""
    if setup.lines != "cross":
        return [str(k) for k in range(setup.lines)]
    assert setup.start is not None
    assert setup.start.laser is not None
    return [sheet.name for sheet in setup.start.laser.sheets]


def _light(bgr: NDArray[np.uint8], corner_uv: Array, setup: BoardSetup, parameters: Parameters) -> targets.Light:
    """The lines on the board's plane, and no other light."""
    area = Area(targets.outline(corner_uv, _GROW if setup.beside else 0.0), setup.beside)
    if setup.lines != "cross":
        return targets.parallel_lines(bgr, area, setup.lines, parameters.laser)
    assert setup.start is not None
    assert setup.start.laser is not None
    found = cross_on_flat(bgr, setup.start.camera, setup.start.laser.sheets, parameters.laser, area)
    return targets.Light(found.uv, found.arm.astype(np.intp), found.sigma_px)


def _data(seen: _Seen) -> adjusting.BoardData:
    light = [averaged(*one) for one in seen.light]
    number = np.arange(len(seen.names))
    return adjusting.BoardData(
        np.concatenate([uv for _, uv in seen.corners]),
        np.concatenate([X for X, _ in seen.corners]),
        np.repeat(number, [len(uv) for _, uv in seen.corners]),
        np.concatenate([uv for uv, _, _ in light]),
        np.concatenate([sheet for _, sheet, _ in light]),
        np.repeat(number, [len(uv) for uv, _, _ in light]),
        np.concatenate([sigma for _, _, sigma in light]),
        len(seen.names),
    )


def _calibration(found: adjusting.BoardResult, setup: BoardSetup, free: Sequence[str]) -> Calibration:
    """The calibration with the covariance of camera and sheets; of a camera that was held, what the start knew."""
    count = len(found.camera_names)
    names = [f"camera.{n}" if n in ("fx", "fy", "cx", "cy") else f"camera.distortion.{n}" for n in found.camera_names]
    laser, J = None, np.eye(count)
    if setup.lines == "cross" and setup.start is not None and setup.start.laser is not None:
        old = setup.start.laser
        moved = [_facing(sheet, np.array(plane.normal)) for sheet, plane in zip(found.sheets, old.sheets, strict=True)]
        first, second = (as_plane(plane.name, sheet) for plane, sheet in zip(old.sheets, moved, strict=True))
        laser = Laser(wavelength_nm=old.wavelength_nm, origin=old.origin, planes=(first, second))
        J = np.zeros((count + 8, count + 6))
        J[:count, :count] = np.eye(count)
        for s in (0, 1):
            sign = np.sign(moved[s][:3] @ found.sheets[s][:3])
            own = step_jacobian(found.starts[s], found.steps[3 * s : 3 * s + 3]) * sign
            J[count + 4 * s : count + 4 * s + 4, count + 3 * s : count + 3 * s + 3] = own
            names += sheet_names(old.sheets[s].name)
    covariance = J @ found.covariance[: J.shape[1], : J.shape[1]] @ J.T
    kept = [k for k, name in enumerate(names) if name.startswith("laser.") or name.rpartition(".")[2] in free]
    mount = setup.start.mount if setup.start is not None else Mount()
    left = () if setup.start is None else calibrate.known_of(setup.start, lambda name: _left(name, setup.hold_camera))
    own = (block([names[k] for k in kept], covariance[np.ix_(kept, kept)]),) if kept else ()
    return Calibration(
        format=1,
        camera=found.camera,
        laser=laser,
        mount=mount,
        covariance=(*left, *own),
    )


def _left(name: str, hold_camera: bool) -> bool:
    """Whether a calibration with a board leaves a parameter as it was."""
    return name.startswith("mount.") or (hold_camera and name.startswith("camera."))


def _facing(sheet: Array, normal: Array) -> Array:
    """The same plane with its normal on the side of another's."""
    return sheet if sheet[:3] @ normal >= 0 else -sheet


def _write_planes(out: Path, found: adjusting.BoardResult) -> None:
    """Sheets that calibration.yaml has no place for: normal . X = offset, camera frame, metres, with covariances."""
    planes = [
        {
            "name": str(s),
            "normal": [float(v) for v in sheet[:3]],
            "offset": float(sheet[3]),
            "covariance": _sheet_covariance(found, s).tolist(),
        }
        for s, sheet in enumerate(found.sheets)
    ]
    out.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump({"planes": planes}, sort_keys=False, default_flow_style=None, width=120)
    (out / PLANES).write_text(text, encoding="utf-8")


def _sheet_covariance(found: adjusting.BoardResult, sheet: int) -> Array:
    """(4, 4) of a sheet's normal and offset."""
    first = len(found.camera_names) + 3 * sheet
    own, J = slice(first, first + 3), step_jacobian(found.starts[sheet], found.steps[3 * sheet : 3 * sheet + 3])
    return J @ found.covariance[own, own] @ J.T


def _rows(found: adjusting.BoardResult, free: Sequence[str], result: Calibration) -> list[report.Row]:
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0))
    of_camera = dict(zip(found.camera_names, sigma.tolist(), strict=False))
    rows = report.camera_rows(result, {name: s for name, s in of_camera.items() if name in free})
    for s, sheet in enumerate(found.sheets):
        away, leans = abs(float(sheet[3])), min(abs(float(sheet[2])), 1.0)
        _, _, of_normal, of_offset = np.sqrt(np.diag(_sheet_covariance(found, s))).tolist()
        rows.append(report.Row(f"sheet {s}: distance from the camera", "mm", 1e3 * away, 1e3 * of_offset))
        turn = float(np.degrees(of_normal / np.sqrt(max(1 - leans**2, 1e-9))))
        rows.append(
            report.Row(f"sheet {s}: angle to the optical axis", "deg", float(np.degrees(np.arcsin(leans))), turn)
        )
    return rows


def _page(
    folder: Path,
    seen: _Seen,
    setup: BoardSetup,
    found: adjusting.BoardResult,
    free: Sequence[str],
    result: Calibration,
) -> report.Page:
    data = _data(seen)
    relative = found.left_out_m / found.range_m[data.laser_image]
    rms, share, mean = (_rms(found.left_out_m), 300 * _rms(relative), 300 * float(np.nanmean(np.abs(relative))))
    corner = np.repeat(np.arange(2), len(data.corner_uv))
    residuals = report.residual_map(
        np.tile(data.corner_uv, (2, 1)),
        found.corner_residual_px.T.ravel(),
        seen.size,
        corner,
        ["along u", "along v"],
        "px",
    )
    lit = found.laser_used
    laser = report.residual_map(
        data.laser_uv[lit], 1e3 * found.laser_residual_m[lit], seen.size, np.zeros(int(lit.sum())), ["all sheets"], "mm"
    )
    facts = (
        ("Photographs", f"{len(seen.names)} from {folder}"),
        (
            "Board",
            f"{setup.board.kind}, {setup.board.columns} x {setup.board.rows}, "
            f"squares of {1e3 * setup.board.square_m:g} mm",
        ),
        ("Corners", f"{len(data.corner_uv)}, sigma {found.corner_sigma_px:.3f} px"),
        ("Laser points", f"{int(lit.sum())} on {len(found.sheets)} sheets"),
        ("Ranges", f"{np.nanmin(found.range_m):.3f} to {np.nanmax(found.range_m):.3f} m"),
        (
            "Left-out light from the board",
            f"rms {1e3 * rms:.3f} mm; per 300 mm of range rms {share:.3f} mm, mean distance {mean:.3f} mm",
        ),
    )
    if setup.bent:
        facts = (*facts, ("Shape of the board", _shape(data, found)))
    rows = _rows(found, free, result)
    figures = [
        report.picture("Residuals of the corners", residuals, "Projected minus seen."),
        report.picture("Residuals of the light", laser, "Distance of the light on the board from its sheet."),
    ]
    said = [*_said(found, rms), *_port(result, found, figures)]
    of_image = [found.left_out_m[data.laser_image == k] for k in range(len(seen.names))]
    left_out = [
        report.LeftOut(name, (f"{found.range_m[k]:.3f} m", f"{1e3 * _rms(own):.3f} mm"))
        for k, (name, own) in enumerate(zip(seen.names, of_image, strict=True))
        if np.isfinite(own).any()
    ]
    return report.Page(
        title="Calibration with a board",
        way="Camera, poses of the board and sheets of light in one adjustment.",
        facts=facts,
        rows=tuple(rows),
        statements=tuple(said),
        left_out_header=("Photograph", "range", "its light from the board, rms"),
        left_out=tuple(left_out),
        pictures=tuple(figures),
        warnings=tuple(_warnings(seen, found)),
    )


def _shape(data: adjusting.BoardData, found: adjusting.BoardResult) -> str:
    """How far the board is from flat where its corners are, and where light was."""
    corners = heights(found.shape, data.corner_board[:, :2])
    light = heights(found.shape, found.light_on_board[found.laser_used, :2])
    low, high = (1e3 * float(f(np.concatenate([corners, light]))) for f in (np.min, np.max))
    return f"{low:+.2f} to {high:+.2f} mm from flat, over the corners and the light"


def _port(result: Calibration, found: adjusting.BoardResult, figures: list[report.Figured]) -> list[str]:
    """For a cross: the sensitivity figure and, behind a flat port, what a pinhole would do. Adds to the figures."""
    if result.laser is None:
        return []
    low, high = float(np.nanmin(found.range_m)), float(np.nanmax(found.range_m))
    shown, count = calibrate.altitudes(low, high), len(found.camera_names)
    starts = [basis(sheet, result.laser.origin) for sheet in result.laser.sheets]
    own = slice(count, count + 6)
    named = [b._replace(name=s.name) for b, s in zip(found.starts, starts, strict=True)]
    sheets = calibrate.Sheets(named, found.sheets, found.steps, found.covariance[own, own], None)
    figures.append(calibrate.sensitivity_picture(result, sheets, shown))
    said, more = calibrate.port_parts(result, shown)
    figures += more
    return [calibrate.accuracy_statement(result, sheets, shown), *said]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _said(found: adjusting.BoardResult, rms: float) -> list[str]:
    return [
        f"Light of a photograph that the adjustment did not know lies {1e3 * rms:.3f} mm (rms) from the board as its "
        "corners have it; errors of the board's own pose are in that figure.",
        "Scale comes from the size of the squares: 0.1 % of it is 0.1 % of every range. Measure the whole board.",
        "The mount is no part of this: it keeps what it was; calibrate it over a floor or in the field.",
        "Parameters of the camera that are not listed were held.",
    ]


def _warnings(seen: _Seen, found: adjusting.BoardResult) -> list[str]:
    said = []
    known = found.range_m[np.isfinite(found.range_m)]
    if len(known) and known.max() < 1.3 * known.min():
        said.append("all photographs are from about the same distance: the sheets are extrapolated elsewhere")
    uv = np.concatenate([uv for _, uv in seen.corners])
    covered = np.ptp(uv, axis=0) / np.array(seen.size)
    if covered.min() < 0.6:
        said.append("the board was never shown near the edges of the image: distortion there is a guess")
    if len(found.shape.terms) and len(seen.names) < _LEAST_BENT:
        said.append(f"the board's shape rests on {len(seen.names)} photographs; take {_LEAST_BENT} or more")
    if found.corner_sigma_px > 0.3:
        remedy = "" if len(found.shape.terms) else "; --bent estimates its shape"
        said.append(
            f"corners are off by {found.corner_sigma_px:.2f} px: is the board flat, sharp and evenly lit?{remedy}"
        )
    return said
