"""trajectory.csv: one row an image (FORMATS, "Products")."""

import csv
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple
from uuid import uuid4

import numpy as np

COLUMNS: Final = (
    *("image", "time", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("sigma_x", "sigma_y", "sigma_z", "status"),
)
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Pose(NamedTuple):
    """Where a camera was.

    Attributes
    ----------
    position : camera centre in map coordinates, metres.
    quaternion : w x y z of the rotation from camera to map axes.
    sigma : 1-sigma of the position along map axes, metres; NaN where not known.
    """

    position: Vector
    quaternion: Quaternion
    sigma: Vector


class Row(NamedTuple):
    """One image.

    Attributes
    ----------
    image : path relative to the mission folder, forward slashes.
    time : of exposure, UTC, microseconds.
    pose : None where there is none.
    status : adjusted | navigation | rejected: why.
    """

    image: str
    time: np.datetime64
    pose: Pose | None
    status: str

    @property
    def kind(self) -> str:
        """The status without the reason: adjusted, navigation or rejected."""
        return self.status.split(":", 1)[0]


def write(path: str | os.PathLike[str], rows: Iterable[Row]) -> None:
    """Write rows in the order given: others count on it (mosaic-source.tif, soundings.laz)."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}")
    try:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(COLUMNS)
            table.writerows(_cells(row) for row in rows)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Read a trajectory.csv back."""
    with Path(path).open(newline="", encoding="utf-8") as file:
        return [_row(cells) for cells in csv.DictReader(file)]


def _cells(row: Row) -> list[str]:
    known, _, reason = row.status.partition(": ")
    if known not in ("adjusted", "navigation", "rejected") or (known == "rejected") != bool(reason):
        raise ValueError(f"{row.status!r} is not adjusted, navigation or 'rejected: why'")
    time = "" if np.isnat(row.time) else f"{np.datetime_as_string(row.time, unit='us')}Z"
    pose = [""] * 10 if row.pose is None else _pose_cells(row.pose)
    return [row.image, time, *pose, row.status]


def _pose_cells(pose: Pose) -> list[str]:
    groups = ((pose.position, 4), (pose.quaternion, 9), (pose.sigma, 4))
    return [_number(value, digits) for values, digits in groups for value in values]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


def _row(cells: dict[str, str]) -> Row:
    text = cells["time"].removesuffix("Z")
    time = np.datetime64(text, "us") if text else np.datetime64("NaT", "us")
    values = [float(cells[name]) if cells[name] else np.nan for name in COLUMNS[2:12]]
    pose = None
    if not np.isnan(values[:7]).any():
        x, y, z, qw, qx, qy, qz, *sigma = values
        pose = Pose((x, y, z), (qw, qx, qy, qz), (sigma[0], sigma[1], sigma[2]))
    return Row(cells["image"], time, pose, cells["status"])
