"""The frames table: one entry an image, with its time, its pose from navigation and why it is rejected, if so."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from ..schemas.mission import Mission
from ..schemas.problems import Problem
from ..schemas.timestamps import iso
from .digests import Inspection
from .image_times import ImageTime, image_times
from .images import size_fault
from .interpolation import Poses, at_times
from .mission_files import ImageFile
from .mission_inputs import MissionInputs

# One bad image never stops a mission; a fifth of them being bad is one mistake and not many.
_REJECTED_SHARE = 0.2

_UNITS = {
    "longitude": "degrees_east",
    "latitude": "degrees_north",
    "elevation": "m",
    "altitude": "m",
    "roll": "degrees",
    "pitch": "degrees",
    "heading": "degrees",
    "sigma_horizontal": "m",
    "sigma_depth": "m",
    **{f"sigma_{name}": "degrees" for name in ("roll", "pitch", "heading")},
}

_KINDS = {
    "file": ("complete JPEG, PNG or TIFF files", "Copy these images again from the camera, or remove them."),
    "size": ("images of the camera in the calibration", "Use the calibration of this camera and image size."),
    "time": ("a time for each image", "Correct timestamps in mission.yaml, or remove the images that have none."),
    "duplicate": ("another time for each image", "Use timestamps with fractions of a second, or remove the copies."),
    "navigation": (
        "navigation from before the first to after the last image",
        "Add the missing navigation, correct navigation.time_offset, or remove these images.",
    ),
}


class Frames(NamedTuple):
    """The table and what is wrong with it.

    Attributes
    ----------
    table : the frames, sorted by time.
    rejections : one problem a kind of rejection.
    fatal : too many are rejected, or none is left.
    warnings : gaps.
    """

    table: xarray.Dataset
    rejections: list[Problem]
    fatal: bool
    warnings: list[str]


class _Rejection(NamedTuple):
    kind: str
    reason: str


def build_frames(
    images: Sequence[ImageFile], inspections: Sequence[Inspection], inputs: MissionInputs, mission: Mission
) -> Frames:
    """Join images, times and navigation.

    Parameters
    ----------
    inspections : of each image.
    inputs : navigation and calibration are left out of the checks where they are None.
    """
    exif = [inspection.header.exif_time for inspection in inspections]
    times = image_times(mission.timestamps, [image.image for image in images], exif, inputs.times)
    ns = np.array([time.ns or 0 for time in times], np.int64)
    camera = None if inputs.calibration is None else inputs.calibration.camera
    rejected = [_rejection(i, t, camera) for i, t in zip(inspections, times, strict=True)]
    _reject_duplicates(rejected, images, ns)
    warnings: list[str] = []
    source, poses = mission.navigation, None
    if source is not None and inputs.navigation is not None and len(inputs.navigation.ns):
        poses = at_times(inputs.navigation, ns, source.time_offset, source.sigma, inputs.tide)
        _reject_outside(rejected, ns, poses)
        warnings += _pose_warnings(rejected, poses)
    order = sorted(range(len(images)), key=lambda i: (times[i].ns is None, times[i].ns or 0, images[i].image))
    table = _table(images, inspections, times, rejected, poses).isel(image=order)
    bad = [rejection for rejection in rejected if rejection is not None]
    fatal = len(bad) > max(1, _REJECTED_SHARE * len(images)) or len(bad) == len(images)
    problems = _whole_mission(rejected, ns, poses) or _by_kind(images, rejected)
    return Frames(table, problems, fatal, warnings)


def _rejection(inspection: Inspection, time: ImageTime, camera: Camera | None) -> _Rejection | None:
    header = inspection.header
    if header.fault:
        return _Rejection("file", header.fault)
    fault = "" if camera is None else size_fault(header.width, header.height, camera)
    if fault:
        return _Rejection("size", fault)
    return _Rejection("time", time.fault) if time.fault else None


def _reject_duplicates(rejected: list[_Rejection | None], images: Sequence[ImageFile], ns: NDArray[np.int64]) -> None:
    """Of images of one role with one time the first is kept; a strobe and a laser image may share a time."""
    first: dict[tuple[str, int], str] = {}
    for i, image in enumerate(images):
        if rejected[i] is not None:
            continue
        key = (image.role, int(ns[i]))
        if key in first:
            rejected[i] = _Rejection("duplicate", f"duplicate timestamp of {first[key]}")
        first.setdefault(key, image.image)


def _reject_outside(rejected: list[_Rejection | None], ns: NDArray[np.int64], poses: Poses) -> None:
    start, end = poses.span
    reason = f"outside the navigation ({iso(start)} to {iso(end)})"
    for i in range(len(rejected)):
        if rejected[i] is None and not start <= ns[i] <= end:
            rejected[i] = _Rejection("navigation", reason)


def _pose_warnings(rejected: list[_Rejection | None], poses: Poses) -> list[str]:
    kept = np.array([rejection is None for rejection in rejected], bool)
    gaps = int(np.count_nonzero(poses.in_gap & kept))
    blind = int(np.count_nonzero(np.isnan(poses.values["altitude"]) & kept))
    warnings = []
    if gaps:
        warnings.append(f"{gaps} images were taken in gaps of the navigation; their poses are interpolated")
    if blind:
        warnings.append(f"{blind} of {np.count_nonzero(kept)} images have no altitude from navigation")
    return warnings


def _whole_mission(rejected: list[_Rejection | None], ns: NDArray[np.int64], poses: Poses | None) -> list[Problem]:
    """One problem instead of one an image, where no image at all falls into the navigation."""
    outside = [i for i, rejection in enumerate(rejected) if rejection is not None and rejection.kind == "navigation"]
    if poses is None or not outside or any(rejection is None for rejection in rejected):
        return []
    start, end = poses.span
    found = (
        f"navigation from {iso(start)} to {iso(end)} but images from {iso(ns[outside].min())} "
        f"to {iso(ns[outside].max())}"
    )
    remedy = "Check that both are of the same dive and in UTC; navigation.time_offset shifts the navigation."
    return [Problem("mission.yaml", None, "navigation", found, "navigation that covers the images", remedy)]


def _by_kind(images: Sequence[ImageFile], rejected: list[_Rejection | None]) -> list[Problem]:
    problems = []
    for kind, (expected, remedy) in _KINDS.items():
        of_kind = [(images[i].image, r.reason) for i, r in enumerate(rejected) if r is not None and r.kind == kind]
        if of_kind:
            more = f" and {len(of_kind) - 3} more" if len(of_kind) > 3 else ""
            examples = "; ".join(f"{image}: {reason}" for image, reason in of_kind[:3])
            found = f"{len(of_kind)} of {len(images)} images rejected: {examples}{more}"
            problems.append(Problem("images", None, "", found, expected, remedy))
    return problems


def _table(
    images: Sequence[ImageFile],
    inspections: Sequence[Inspection],
    times: Sequence[ImageTime],
    rejected: Sequence[_Rejection | None],
    poses: Poses | None,
) -> xarray.Dataset:
    time = np.array([np.datetime64("NaT") if t.ns is None else np.datetime64(t.ns, "ns") for t in times], "M8[ns]")
    status = ["" if rejection is None else f"rejected: {rejection.reason}" for rejection in rejected]
    texts = {
        "role": [image.role for image in images],
        "sha256": [inspection.sha256 for inspection in inspections],
        "status": status,
    }
    table = xarray.Dataset(
        {name: ("image", np.array(column, str)) for name, column in texts.items()},
        coords={"image": np.array([image.image for image in images], str)},
    )
    table["time"] = ("image", time)
    table["size"] = ("image", np.array([image.info.get("size") or 0 for image in images], np.int64), {"units": "byte"})
    timed = ~np.isnat(time)
    for name, unit in _UNITS.items():
        column = np.full(len(images), np.nan) if poses is None else np.where(timed, poses.values[name], np.nan)
        table[name] = ("image", column, {"units": unit})
    return table
