"""`seamosaic calibrate flat | board | field`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..schemas.problems import InvalidInput, Problem

app = typer.Typer(
    help="Make a calibration.yaml with covariances, and a report: over a flat floor, with a board, or in the field.",
    no_args_is_help=True,
    add_completion=False,
)
_console = Console()

OutOption = Annotated[
    Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for calibration.yaml and calibration-report.html.")
]
StartOption = Annotated[
    Path | None,
    typer.Option("--start", metavar="FILE", help="calibration.yaml to start from; default: the mission's own."),
]
SheetDegOption = Annotated[
    float, typer.Option(min=1e-3, max=30, help="1-sigma of the starting sheets' angles, degrees.")
]
SheetMmOption = Annotated[float, typer.Option(min=1e-3, help="1-sigma of the starting sheets' positions, mm.")]
AltimeterOption = Annotated[
    float, typer.Option(min=1e-3, help="1-sigma of the altimeter's (and lever arm's) constant error, mm.")
]


@app.callback()
def _begin(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log more of what is done.")] = False,
) -> None:
    from .progress import log_to_stderr

    log_to_stderr(verbose)


def _start(path: Path | None) -> Any:
    from .calibrate_inputs import read_calibration

    return None if path is None else read_calibration(path)


@app.command()
def flat(
    missions: Annotated[list[str], typer.Argument(metavar="MISSION...", help="Missions over a flat floor.")],
    out: OutOption,
    start: StartOption = None,
    boresight: Annotated[bool, typer.Option(help="Solve for the mount's roll and pitch too.")] = True,
    sheet_deg: SheetDegOption = 2.0,
    sheet_mm: SheetMmOption = 40.0,
    altimeter_mm: AltimeterOption = 1.0,
    images: Annotated[int, typer.Option(min=4, max=400, help="At most so many images.")] = 120,
) -> None:
    """Sheets and mount angles over a pool's floor or a flat seabed, sailed at several altitudes."""
    from ..schemas.parameters import Parameters
    from ..tasks.calibration_flat import Priors
    from .calibrate_flat import run_flat

    priors = Priors(sheet_deg=sheet_deg, sheet_m=1e-3 * sheet_mm, altimeter_m=1e-3 * altimeter_mm)
    _show(run_flat(missions, out, _start(start), priors, Parameters(), boresight, images))


@app.command()
def board(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Photographs of the board with the laser.")],
    out: OutOption,
    columns: Annotated[int, typer.Option(min=3, max=100, help="Inner corners (ChArUco: squares) in a row.")],
    rows: Annotated[int, typer.Option(min=3, max=100, help="Rows of them.")],
    square_mm: Annotated[float, typer.Option(min=0.1, help="Side of a square, mm.")],
    kind: Annotated[Literal["chessboard", "charuco"], typer.Option(help="What is printed on it.")] = "chessboard",
    marker_share: Annotated[float, typer.Option(min=0.1, max=0.95, help="ChArUco: marker over square.")] = 0.75,
    dictionary: Annotated[str, typer.Option(help="ChArUco: OpenCV's name of the markers.")] = "DICT_4X4_50",
    lines: Annotated[str, typer.Option(help="cross, or a number of lines that do not cross.")] = "cross",
    beside: Annotated[bool, typer.Option(help="The light lies beside the board, on what it is fixed to.")] = False,
    start: Annotated[
        Path | None, typer.Option("--start", metavar="FILE", help="calibration.yaml to start from; a cross needs one.")
    ] = None,
    hold_camera: Annotated[bool, typer.Option(help="Take the camera of --start as right.")] = False,
    model: Annotated[Literal["brown", "fisheye"], typer.Option(help="Camera where there is no --start.")] = "brown",
    bent: Annotated[bool, typer.Option(help="The board may not be flat: estimate its shape too.")] = False,
) -> None:
    """Camera and sheets from photographs of a chessboard or ChArUco board in the laser's light."""
    import cv2

    from ..schemas.parameters import Parameters
    from ..tasks.calibration_targets import Board
    from . import calibrate_board

    begun = _start(start)
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        remedy = "Write DICT_4X4_50, DICT_5X5_100 or another of OpenCV's."
        raise InvalidInput([Problem("--dictionary", None, "", dictionary, "a dictionary of markers", remedy)])
    if hold_camera and begun is None:
        remedy = "Add --start calibration.yaml, or leave --hold-camera out."
        raise InvalidInput([Problem("--hold-camera", None, "", "no --start", "the camera to hold", remedy)])
    if bent and kind == "chessboard" and (columns + rows) % 2 == 0:
        remedy = "Use a board of which one number is even and the other odd, or a ChArUco board."
        found = f"{columns} x {rows} corners, which look the same upside down"
        raise InvalidInput([Problem("--bent", None, "", found, "a board whose way up can be told", remedy)])
    target = Board(kind, columns, rows, 1e-3 * square_mm, marker_share, dictionary)
    setup = calibrate_board.BoardSetup(target, _lines(lines, begun), beside, begun, hold_camera, model, bent)
    _show(calibrate_board.run_board(folder, out, setup, Parameters()))


@app.command()
def field(
    mission: Annotated[str, typer.Argument(metavar="MISSION", help="An ordinary mission with overlap.")],
    out: OutOption,
    start: StartOption = None,
    sheet_deg: SheetDegOption = 2.0,
    sheet_mm: SheetMmOption = 40.0,
    mount_deg: Annotated[
        float, typer.Option(min=1e-3, max=30, help="1-sigma of the starting mount angles, degrees.")
    ] = 1.0,
    altimeter_mm: AltimeterOption = 1.0,
    images: Annotated[int, typer.Option(min=6, max=200, help="At most so many images, from the middle.")] = 60,
) -> None:
    """Sheets, mount angles and the navigation's clock from the crossovers of an ordinary mission."""
    from ..schemas.parameters import Parameters
    from ..tasks.calibration_field import FieldPriors
    from .calibrate_field import run_field

    priors = FieldPriors(sheet_deg, 1e-3 * sheet_mm, mount_deg, altimeter_m=1e-3 * altimeter_mm)
    _show(run_field(mission, out, _start(start), priors, Parameters(), images))


def _lines(text: str, start: Any) -> Any:
    if text != "cross":
        if text.isdecimal() and 1 <= int(text) <= 100:
            return int(text)
        remedy = "Write --lines cross, or --lines 15."
        raise InvalidInput([Problem("--lines", None, "", repr(text), "cross, or a number from 1 to 100", remedy)])
    if start is None or start.laser is None:
        remedy = "Give --start: camera, baseline, angle and roll by tape measure will do."
        raise InvalidInput([Problem("--start", None, "laser", "none", "a laser cross to start from", remedy)])
    return text


def _show(written: Any) -> None:
    table = Table(title=Text(written.page.title))
    for name in ("parameter", "value", "1-sigma", "the data say"):
        table.add_column(name)
    for row in written.page.rows:
        table.add_row(row.name, f"{row.value:.6g} {row.unit}", f"{row.sigma:.2g}", row.verdict)
    _console.print(table)
    for statement in written.page.statements:
        _console.print(Text(f"- {statement}"))
    for warning in written.page.warnings:
        _console.print(Text("warning: ", "yellow") + Text(warning))
    _console.print(Text(f"{written.calibration} and {written.html}"))
