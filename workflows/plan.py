"""What a mission's frames table says before anything is computed: poses by navigation, pairs, batches."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray

from ..catalog.missions import OpenedMission
from ..schemas.parameters import Parameters
from ..tasks import navigation, pairs, rotations
from ..tasks.frames import MapFrame
from ..tasks.navigation import NavigationPrior, Poses
from .extract import ImageTask
from .match import NEAR_SHARE, Wanted, margin_m

# Height above the seabed that is assumed where neither altimeter nor laser tells (paper V: 3 m)
ASSUMED_RANGE_M = 3.0
_SEQUENTIAL_REACH = 3
_BRIDGE_REACH = 16
# A laser image taken within this of a texture image sounds for it, seconds
_LIT_WITHIN_S = 10.0
_NEAR_LIMIT = 1.1  # of the laser's range


class Plan(NamedTuple):
    """A mission ready to be processed.

    Attributes
    ----------
    images : all that are not rejected.
    frame : local and map. prior : navigation, None without. range_m : (n,) height above the seabed as far as known.
    R_first : R_local_camera (3, 3) of the first image of a mission without navigation.
    """

    images: tuple[ImageTask, ...]
    frame: MapFrame
    prior: NavigationPrior | None
    range_m: np.ndarray
    R_first: np.ndarray


def plan(opened: OpenedMission, parameters: Parameters) -> Plan:
    """Poses by navigation and the list of images to extract."""
    frames = opened.frames
    status, role = frames["status"].values, frames["role"].values
    mount = opened.calibration.mount
    frame = _map_frame(opened)
    prior = None if opened.crs is None else _prior(frames, frame, opened, parameters)
    rows = [k for k in range(frames.sizes["image"]) if not status[k]]
    north = _north_deg(prior, rows)
    images = tuple(
        ImageTask(k, str(frames["image"].values[k]), str(frames["sha256"].values[k]), role[k], deg)
        for k, deg in zip(rows, north, strict=True)
    )
    altitude = frames["altitude"].values.astype(float)
    known = altitude[np.isfinite(altitude)]
    range_m = np.where(np.isfinite(altitude), altitude, np.median(known) if len(known) else ASSUMED_RANGE_M)
    if len(known):  # the altimeter's range is that of the reference point
        range_m = range_m - mount.translation[2]
    R_first = navigation.first_camera_without_navigation(mount)
    return Plan(images, frame, prior, np.maximum(range_m, 0.1), R_first)


def _north_deg(prior: NavigationPrior | None, rows: list[int]) -> list[int | None]:
    """Where north is in each image, if the headings of all are known: descriptors must be alike in all images.

    Whole degrees, so that navigation can be corrected a little without all images being extracted again.
    """
    if prior is None or not prior.poses.known[rows].all():
        return [None] * len(rows)
    return np.round(np.degrees(navigation.north_rad(prior.poses)[rows])).astype(int).tolist()


def _map_frame(opened: OpenedMission) -> MapFrame:
    """The local frame's origin: the mission's middle, rounded so that one image more does not move it much."""
    if opened.crs is None:
        return MapFrame(None)
    longitude = np.radians(opened.frames["longitude"].values.astype(float))
    east = np.degrees(np.angle(np.nanmean(np.exp(1j * longitude))))  # the 180th meridian is no edge
    north = np.nanmedian(opened.frames["latitude"].values)
    return MapFrame(opened.crs, round(float(north), 4), round(float(east), 4))


def _prior(frames: xarray.Dataset, frame: MapFrame, opened: OpenedMission, parameters: Parameters) -> NavigationPrior:
    def column(name: str) -> np.ndarray:
        return frames[name].values.astype(float)

    names = "longitude", "latitude", "elevation", "roll", "pitch", "heading"
    state = navigation.VehicleState(*(column(name) for name in names))
    complete = np.asarray(np.isfinite(np.column_stack(state)).all(1))
    mount = opened.calibration.mount
    safe = navigation.VehicleState(*(np.where(complete, values, 0.0) for values in state))
    poses = navigation.camera_poses(safe, mount, frame)
    C = np.where(complete[:, None], poses.C_local, np.nan)
    time = frames["time"].values
    since = time[complete][0] if complete.any() else time[0]  # a rejected image may have any time
    return NavigationPrior(
        poses=Poses(poses.R_local_camera, C),
        time_s=(time - since) / np.timedelta64(1, "s"),
        sigma_horizontal=column("sigma_horizontal"),
        sigma_depth=column("sigma_depth"),
        sigma_attitude=np.radians(np.column_stack([column(f"sigma_{n}") for n in ("roll", "pitch", "heading")])),
        drift_m_per_sqrt_s=parameters.adjust.drift_m_per_sqrt_s,
        R_camera_vehicle=rotations.R_vehicle_camera(*mount.rotation).T,
    )


def first_pairs(made: Plan, opened: OpenedMission, parameters: Parameters) -> list[Wanted]:
    """Pairs to match: by navigation's footprints, or each image with the next few where there is no navigation."""
    rows = _pictures(made)
    if made.prior is None:
        found = pairs.sequential(len(rows), _SEQUENTIAL_REACH)
        return [Wanted(int(rows[a]), int(rows[b]), ASSUMED_RANGE_M) for a, b in found.images]
    known = rows[made.prior.poses.known[rows]]
    following = set(itertools.pairwise(known.tolist()))
    overlap = _overlapping(made, opened, parameters, made.prior.poses, made.range_m, _margin(made.prior))
    found = sorted({*overlap, *following})
    lit, above = _lit(made), made.range_m.tolist()
    return [Wanted(i, j, above[i], lit.get(i, ()), lit.get(j, ()), (i, j) in following) for i, j in found]


def _lit(made: Plan) -> dict[int, tuple[int, ...]]:
    """Of each texture image the laser images taken just before and just after."""
    assert made.prior is not None
    time, known = made.prior.time_s, made.prior.poses.known
    lasers = np.array([image.row for image in made.images if image.role == "laser" and known[image.row]], int)
    found = {}
    for image in made.images:
        if image.role != "texture" or not known[image.row]:
            continue
        after = int(np.searchsorted(lasers, image.row))
        beside = lasers[max(0, after - 1) : after + 1].tolist()
        found[image.row] = tuple(row for row in beside if _soon(time, image.row, row))
    return found


def _soon(time_s: np.ndarray, a: int, b: int) -> bool:
    return abs(float(time_s[a] - time_s[b])) <= _LIT_WITHIN_S


def chained_pairs(
    made: Plan,
    opened: OpenedMission,
    parameters: Parameters,
    poses: Poses,
    range_m: np.ndarray,
    known: Sequence[tuple[int, int]],
) -> list[Wanted]:
    """Without navigation: pairs not tried yet that overlap by the chained poses, or may join what is not linked.

    Where the chain is broken, as on the turn to the next line, images of both sides are tried that are near in time.
    """
    rows, margin = _pictures(made), np.full(len(range_m), 0.1 * float(np.median(range_m)))
    found = _overlapping(made, opened, parameters, poses, range_m, margin)
    linked = poses.known[rows]
    near = pairs.sequential(len(rows), _BRIDGE_REACH).images
    bridges = near[linked[near[:, 0]] != linked[near[:, 1]]]
    found += [(int(rows[a]), int(rows[b])) for a, b in bridges]
    tried = set(known)
    return [Wanted(i, j, float(range_m[i])) for i, j in found if (i, j) not in tried]


def misplaced_pairs(
    made: Plan,
    opened: OpenedMission,
    parameters: Parameters,
    poses: Poses,
    range_m: np.ndarray,
    known: Sequence[tuple[int, int]],
) -> list[Wanted]:
    """With navigation: pairs not linked that overlap by the adjusted poses, but for navigation lie elsewhere.

    Where navigation jumped or drifted more than it says, its pairs are the wrong ones; so are some where no altimeter
    says how wide images are.
    """
    assert made.prior is not None
    corrected, lit, linked = adjusted_prior(made, poses), _lit(made), set(known)
    assert corrected is not None
    moved = poses.C_local - made.prior.poses.C_local
    found, guessed = [], not np.isfinite(opened.frames["altitude"].values).any()
    for i, j in _overlapping(made, opened, parameters, poses, range_m, _margin(made.prior)):
        off, above = float(np.linalg.norm(moved[j] - moved[i])), float(range_m[i])
        far = off > NEAR_SHARE * above and off > margin_m(navigation.relative(corrected, i, j), above)
        if (i, j) not in linked and (far or guessed):
            found.append(Wanted(i, j, above, lit.get(i, ()), lit.get(j, ()), free=far))
    return found


def adjusted_prior(made: Plan, poses: Poses) -> NavigationPrior | None:
    """Navigation with adjusted poses in place of its own; None without."""
    return made.prior and made.prior._replace(poses=poses)


def _pictures(made: Plan) -> np.ndarray:
    """Rows of the images that may be matched."""
    return np.array([image.row for image in made.images if image.role != "laser"], int)


def _overlapping(
    made: Plan,
    opened: OpenedMission,
    parameters: Parameters,
    poses: Poses,
    range_m: np.ndarray,
    margin_m: np.ndarray,
) -> list[tuple[int, int]]:
    """Rows (i, j) of the images whose footprints overlap by the poses, each footprint margin_m (n,) wider."""
    rows, p = _pictures(made), parameters.match
    outlines = pairs.footprints(opened.calibration.camera, poses, range_m)
    found = pairs.overlapping(outlines[rows], margin_m[rows], p.min_overlap, p.max_pairs_per_image)
    return [(int(rows[a]), int(rows[b])) for a, b in found.images]


def _margin(prior: NavigationPrior) -> np.ndarray:
    """How far a footprint may be from where navigation has it, relative to those of neighbouring lines, (n,) m."""
    elapsed = prior.time_s[prior.poses.known]
    drift = prior.drift_m_per_sqrt_s * np.sqrt(max(float(elapsed.max(initial=1.0)), 1.0))
    return np.minimum(prior.sigma_horizontal, drift) / 2


def beyond_the_laser(parameters: Parameters, height_m: float) -> str:
    """What to say where the seabed is hardly within the distances at which the laser is sought; else nothing."""
    least, most = parameters.laser.range_min_m, parameters.laser.range_max_m
    if _NEAR_LIMIT * least < height_m < most / _NEAR_LIMIT:
        return ""
    name = "range_max_m" if height_m >= most / _NEAR_LIMIT else "range_min_m"
    return (
        f"cameras are {height_m:.1f} m above the seabed by the altimeter, and the laser is sought from {least:g} to "
        f"{most:g} m: set laser.{name}"
    )


def batches(items: Sequence, size: int) -> list[Sequence]:
    """Items in runs of `size`."""
    return [items[start : start + size] for start in range(0, len(items), size)]
