"""`seamosaic check MISSION`: everything that is wrong at once, or what will be produced."""

from typing import NamedTuple

import numpy as np
import pyproj
import shapely
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..catalog.missions import OpenedMission, open_mission
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.products import PRODUCTS
from ..tasks.camera import ground_sample_distance
from ..tasks.frames import MapFrame
from ..tasks.grids import bathymetry_cell_m, mosaic_cell_m
from ..tasks.navigation import VehicleState, camera_poses
from ..tasks.pairs import footprints
from ..tasks.rings import rings
from . import memory_need, plan
from .results import vertical_reference


class Coverage(NamedTuple):
    """What the images see, as far as navigation tells.

    Attributes
    ----------
    altitude_m : median altitude of the camera.
    area_m2 : of all images together; images without altitude are taken at the median.
    ground_sample_m : at the median altitude.
    """

    altitude_m: float
    area_m2: float
    ground_sample_m: float


class CheckResult(NamedTuple):
    """The outcome of a check.

    Attributes
    ----------
    url : the mission, as given.
    opened : the mission, without the images' digests; None if it is invalid.
    problems : what is wrong; empty for a valid mission.
    warnings : what is allowed but worth a second look.
    plan : what will be produced, as lines of (name, value).
    """

    url: str
    opened: OpenedMission | None
    problems: tuple[Problem, ...]
    warnings: tuple[str, ...]
    plan: tuple[tuple[str, str], ...]

    @property
    def valid(self) -> bool:
        """Whether the mission can be run; the command line exits with 2 if not."""
        return not self.problems


def check(url: str, parameters: Parameters) -> CheckResult:
    """Check a mission without processing it; never raises for what is wrong with the input.

    Images are judged by their headers and ends, so a mission of gigabytes is checked in seconds.
    """
    try:
        opened = open_mission(url, hashed=False)
    except InvalidInput as invalid:
        return CheckResult(url, None, invalid.problems, (), ())
    seen = coverage(opened)
    if seen is not None:
        try:
            rings(
                parameters.terrain, memory_need.planned_cell_m(opened.calibration.camera, parameters, seen.altitude_m)
            )
        except InvalidInput as invalid:
            return CheckResult(url, opened, invalid.problems, tuple(opened.warnings), ())
    warnings = opened.warnings
    if seen is not None and opened.calibration.laser is not None:
        height = plan.beyond_the_laser(parameters, seen.altitude_m)
        warnings = [*warnings, height] if height else warnings
    return CheckResult(url, opened, (), tuple(warnings), tuple(_plan(opened, parameters, seen)))


def coverage(opened: OpenedMission) -> Coverage | None:
    """What the images see on a level seabed at the altitudes of navigation; None without navigation or altitude."""
    frames = opened.frames.isel(image=np.flatnonzero(opened.frames["status"].values == ""))
    altitude = frames["altitude"].values
    if opened.crs is None or not np.isfinite(altitude).any():
        return None
    latitude, longitude = float(frames["latitude"][0]), float(frames["longitude"][0])
    names = ("longitude", "latitude", "elevation", "roll", "pitch", "heading")
    state = VehicleState(*(frames[name].values for name in names))
    poses = camera_poses(state, opened.calibration.mount, MapFrame(opened.crs, latitude, longitude))
    median = float(np.nanmedian(altitude))
    # Altitude is that of the reference point; the camera hangs a lever arm below it.
    seabed = state.elevation - np.where(np.isfinite(altitude), altitude, median)
    height = np.maximum(poses.C_local[:, 2] - seabed, 0.05)
    outlines = footprints(opened.calibration.camera, poses, height)
    area = shapely.area(shapely.union_all(shapely.polygons(outlines)))
    camera_height = float(np.median(height))
    ground_sample = ground_sample_distance(opened.calibration.camera, camera_height)
    return Coverage(camera_height, float(area), ground_sample)


def _plan(opened: OpenedMission, parameters: Parameters, seen: Coverage | None) -> list[tuple[str, str]]:
    mission, frames = opened.mission, opened.frames
    used = frames.isel(image=np.flatnonzero(frames["status"].values == ""))
    roles, counts = np.unique(used["role"].values, return_counts=True)
    images = ", ".join(f"{count} {role}" for role, count in zip(roles, counts, strict=True))
    rejected = frames.sizes["image"] - used.sizes["image"]
    times = used["time"].values
    seconds = float((times[-1] - times[0]) / np.timedelta64(1, "s"))
    lines = [
        ("mission", f"{mission.id}  {mission.title}".strip()),
        ("images", images + (f" ({rejected} rejected)" if rejected else "")),
        ("time", f"{_utc(times[0])} to {_utc(times[-1])} UTC ({_duration(seconds)})"),
        ("camera", _camera(opened)),
        ("laser", "yes" if opened.calibration.laser is not None else "no: heights come from image matching alone"),
        ("navigation", _navigation(opened)),
        ("map", _map(opened)),
        *_cells(seen, parameters),
    ]
    if seen is not None:
        largest = int(frames["size"].max())
        found = memory_need.needs(opened.calibration.camera, parameters, int(counts.sum()), seen.altitude_m, largest)
        most = max(found)
        lines.append(("memory", f"{most.size / memory_need.GIB:.1f} GiB a worker, most of all for {most.what}"))
    return lines


def _camera(opened: OpenedMission) -> str:
    camera = opened.calibration.camera
    return f"{camera.model}, {camera.width} x {camera.height} pixels"


def _navigation(opened: OpenedMission) -> str:
    if opened.crs is None:
        return "none: motion comes from the images"
    sigma = float(opened.frames["sigma_horizontal"].median())
    return f"{opened.mission.navigation.path if opened.mission.navigation else ''}, horizontal 1-sigma {sigma:.2g} m"


def _map(opened: OpenedMission) -> str:
    if opened.crs is None:
        return "local frame, origin at the first image placed"
    return f"{pyproj.CRS.from_wkt(opened.crs).name}; heights: {vertical_reference(opened)}"


def _cells(seen: Coverage | None, parameters: Parameters) -> list[tuple[str, str]]:
    chosen = {"bathymetry": parameters.grid.cell_m, "mosaic": parameters.mosaic.cell_m}
    if seen is None:
        unknown = {
            name: "set by the range that laser or matches tell" if cell == "auto" else f"{cell:g} m"
            for name, cell in chosen.items()
        }
        return [(f"{name} cell", text) for name, text in unknown.items()]
    automatic = {"bathymetry": bathymetry_cell_m, "mosaic": mosaic_cell_m}
    lines = [
        ("height", f"camera {seen.altitude_m:.2f} m above the seabed, {seen.ground_sample_m * 1000:.2g} mm a pixel"),
        ("area", f"about {_rounded(seen.area_m2)} m²"),
    ]
    for name, cell in chosen.items():
        size = automatic[name](seen.ground_sample_m) if cell == "auto" else float(cell)
        lines.append((f"{name} cell", f"{size:g} m, about {_rounded(seen.area_m2 / size**2)} cells"))
    return lines


def _rounded(number: float) -> str:
    """Two digits that count, written out: 13,000."""
    return f"{float(f'{number:.2g}'):,.16g}"


def _utc(time: np.datetime64) -> str:
    return str(time.astype("datetime64[s]")).replace("T", " ")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def print_check(result: CheckResult, console: Console) -> None:
    """Print the outcome of a check for a person."""
    if not result.valid:
        print_problems(result.problems, result.url, console)
        return
    table = Table(title=f"{escape(result.url)} is valid", show_header=False, title_justify="left", box=None)
    for name, value in result.plan:
        table.add_row(Text(name, "cyan"), Text(value))
    console.print(table)
    _print_warnings(result.warnings, console)
    console.print("\nseamosaic run will write:")
    products = Table(show_header=False, box=None, padding=(0, 2))
    for product in PRODUCTS:
        products.add_row(Text(product.name, "cyan"), Text(product.description))
    console.print(products)


def _print_warnings(warnings: tuple[str, ...], console: Console) -> None:
    for warning in warnings:
        console.print(Text("warning: ", "yellow") + Text(warning))


def print_problems(problems: tuple[Problem, ...], url: str, console: Console) -> None:
    """Print what is wrong with the input: place, what was found, what was expected, what to do."""
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    console.print(Text(f"{url}: {count}", "bold red"))
    for problem in problems:
        place = problem.file if problem.line is None else f"{problem.file}:{problem.line}"
        heading = Text(place, "bold")
        if problem.key:
            heading += Text(f"  {problem.key}", "cyan")
        console.print(heading)
        console.print(Text(f"    found     {problem.found}"))
        console.print(Text(f"    expected  {problem.expected}"))
        console.print(Text(f"    remedy    {problem.remedy}"))
