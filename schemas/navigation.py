"""navigation.csv, tide.csv and times.csv (FORMATS, "navigation.csv" and "mission.yaml")."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .csv_input import Array, Bounds, Table, order_problems, read_table
from .problems import InvalidInput, Problem, on_lines

_DEGREES = Bounds(-180, 180, "degrees")
_COLUMNS = {
    "latitude": Bounds(-90, 90, "degrees", "Write decimal degrees; check that latitude and longitude are not swapped."),
    "longitude": Bounds(-360, 360, "degrees", "Write decimal degrees, west negative."),
    # Negative depths are above the surface: the format also serves drones.
    "depth": Bounds(-10_000, 12_000, "metres below the sea surface"),
    "altitude": Bounds(0, 12_000, "metres above the seabed", "Leave the cell empty where there was no bottom return."),
    "roll": _DEGREES,
    "pitch": Bounds(-90, 90, "degrees"),
    "heading": Bounds(-1e5, 1e5, "degrees from true north"),  # some count their turns
}
_POSITIVE = "Write a 1-sigma above zero, or leave the cell empty to use the one of mission.yaml."
_METRES = Bounds(1e-4, 1e5, "metres", _POSITIVE)
_ANGLE = Bounds(1e-5, 180, "degrees", _POSITIVE)
_SIGMAS = {
    "horizontal": _METRES,
    "latitude": _METRES,
    "longitude": _METRES,
    "depth": _METRES,
    "altitude": _METRES,
    "roll": _ANGLE,
    "pitch": _ANGLE,
    "heading": _ANGLE,
}
# Without one of these an image has no pose.
_NEEDED = ("latitude", "longitude", "depth", "roll", "pitch", "heading")


class Navigation(NamedTuple):
    """The samples of a navigation.csv in order of time; NaN where a value is missing.

    Attributes
    ----------
    ns : (N,) int64 nanoseconds since 1970 UTC, strictly increasing.
    latitude, longitude : (N,) degrees.
    depth : (N,) metres, positive down from the sea surface.
    altitude : (N,) metres above the seabed.
    roll, pitch, heading : (N,) degrees; heading from true north.
    sigma : 1-sigma of horizontal, depth, roll, pitch, heading, (N,) metres and degrees, where a column gives it.
    """

    ns: NDArray[np.int64]
    latitude: Array
    longitude: Array
    depth: Array
    altitude: Array
    roll: Array
    pitch: Array
    heading: Array
    sigma: dict[str, Array]


class Tide(NamedTuple):
    """Height of the sea surface above the vertical datum.

    Attributes
    ----------
    ns : (N,) int64 nanoseconds since 1970 UTC, strictly increasing.
    height : (N,) metres.
    """

    ns: NDArray[np.int64]
    height: Array


def load_navigation(content: str | bytes, file: str) -> Navigation:
    """Read a navigation.csv.

    Raises
    ------
    InvalidInput
        With every wrong column, cell and time (of each kind the first twenty).
    """
    return _checked(*read_navigation(content, file))


def load_tide(content: str | bytes, file: str) -> Tide:
    """Read a tide.csv (`time,height`); raises InvalidInput as `load_navigation`."""
    return _checked(*read_tide(content, file))


def load_image_times(content: str | bytes, file: str) -> dict[str, int]:
    """Read a times.csv (`image,time`) into {image: nanoseconds since 1970}; raises as `load_navigation`."""
    return _checked(*read_image_times(content, file))


def _checked(value, problems: list[Problem]):
    if problems:
        raise InvalidInput(problems)
    return value


def read_navigation(content: str | bytes, file: str) -> tuple[Navigation, list[Problem]]:
    """As `load_navigation`, but hands over what could be read together with the problems."""
    table = read_table(content, file, ["time", *_COLUMNS], [f"sigma_{name}" for name in _SIGMAS])
    ns, keep = _increasing(table)
    columns = {name: table.numbers(name, bounds) for name, bounds in _COLUMNS.items()}
    sigma = {
        name: table.numbers(f"sigma_{name}", bounds)
        for name, bounds in _SIGMAS.items()
        if f"sigma_{name}" in table.columns
    }
    for name in _NEEDED:
        if len(table) and name in table.columns and not np.isfinite(columns[name]).any() and not table.problems:
            remedy = f"If {name} was not measured write its best constant value and a large sigma."
            table.problems.append(Problem(file, None, name, "no value on any row", "at least one value", remedy))
    return (
        Navigation(
            ns=ns[keep],
            **{name: values[keep] for name, values in columns.items()},
            sigma=_horizontal({name: values[keep] for name, values in sigma.items()}),
        ),
        table.problems,
    )


def _horizontal(sigma: dict[str, Array]) -> dict[str, Array]:
    """One horizontal 1-sigma an axis from those of latitude and longitude, both in metres."""
    axes = [sigma[name] for name in ("latitude", "longitude") if name in sigma]
    kept = {name: sigma[name] for name in ("horizontal", "depth", "roll", "pitch", "heading") if name in sigma}
    if axes and "horizontal" not in kept:
        kept["horizontal"] = np.sqrt(np.mean(np.square(axes), axis=0))
    return kept


def read_tide(content: str | bytes, file: str) -> tuple[Tide, list[Problem]]:
    """As `load_tide`, but hands over what could be read together with the problems."""
    table = read_table(content, file, ["time", "height"])
    height = table.numbers("height", Bounds(-100, 100, "metres above the vertical datum"))
    ns, keep = _increasing(table)
    keep = keep[np.isfinite(height[keep])]
    if not len(keep) and not table.problems:
        problem = Problem(file, None, "height", "no value on any row", "at least one value", "Write the heights.")
        table.problems.append(problem)
    return Tide(ns[keep], height[keep]), table.problems


def _increasing(table: Table) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Times of all rows, and the rows to keep: those with a time, in order, each time once."""
    ns, good = table.times()
    rows = np.flatnonzero(good)
    table.problems += order_problems(table.file, table.lines[rows], ns[rows])
    _, first = np.unique(ns[rows], return_index=True)
    return ns, rows[first]


def read_image_times(content: str | bytes, file: str) -> tuple[dict[str, int], list[Problem]]:
    """As `load_image_times`, but hands over what could be read together with the problems."""
    table = read_table(content, file, ["image", "time"])
    ns, good = table.times()
    times: dict[str, int] = {}
    first: dict[str, int] = {}
    again: list[tuple[int, str]] = []
    for i, image in enumerate(table.columns.get("image", [])):
        line = int(table.lines[i])
        if image in first:
            again.append((line, image))
        elif good[i]:
            times[image] = int(ns[i])
        first.setdefault(image, line)
    table.problems += on_lines(
        file,
        [line for line, _ in again],
        "image",
        lambda i: f"{again[i][1]!r}, which line {first[again[i][1]]} has too",
        "each image once",
        "Remove one of the two rows.",
    )
    return times, table.problems
