"""Once per mission: all poses from the pair motions and navigation."""

import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..catalog.store import Store
from ..tasks import adjust, bundle, crossovers, tracks
from ..tasks.adjust import Adjusted, Link
from ..tasks.navigation import NavigationPrior, Poses
from ..tasks.residuals import Residuals
from . import extract, match
from .job import Done, Job, Made, code_version, load, once, read, rounded_digest, stage

STEP = "adjust"
_ELSEWHERE = 0.1  # of the range
VERSION = code_version(sys.modules[__name__])


class Solution(NamedTuple):
    """What the adjustment stored: poses (n,), sigmas and status of the images, and the pairs that hold them.

    Attributes
    ----------
    poses, sigma_m, covariance_xy_m2, sigma_tilt_rad, status, turned, reprojection_px, residuals : see
        `tasks.adjust.Adjusted`.
    pairs : (P, 2) rows of the linked pairs that were used.
    """

    poses: Poses
    sigma_m: np.ndarray
    covariance_xy_m2: np.ndarray
    sigma_tilt_rad: np.ndarray
    status: list[str]
    pairs: np.ndarray
    turned: np.ndarray
    reprojection_px: float | None
    residuals: Residuals | None


def adjust_all(
    job: Job,
    count: int,
    matched: Sequence[tuple[int, int, Done]],
    extracted: Mapping[int, Done],
    prior: NavigationPrior | None,
    R_first: np.ndarray,
) -> Done:
    """Adjust `count` images: the pair motions and navigation first, then the tie points with the laser's ranges.

    matched, extracted : results of `match` and, by row, of `extract`.
    """
    linked = [(i, j, done) for i, j, done in matched if done.info["model"]]
    inputs = [f"{i}-{j}:{done.key}" for i, j, done in linked]
    lit = {row: done for row, done in extracted.items() if done.info["soundings"]}
    inputs += [f"{row}:{done.key}" for row, done in sorted(lit.items())]
    if prior is not None:
        measured = (prior.time_s, prior.sigma_horizontal, prior.sigma_depth, prior.sigma_attitude)
        inputs.append(rounded_digest(*prior.poses, *measured))
    first = min((row for row, done in extracted.items() if not done.info["status"]), default=0)
    inputs.append(f"{first}:{rounded_digest(R_first)}")
    parameters = stage(job.calibration.camera, job.parameters.adjust)

    def make() -> Made:
        links = _links(job, linked)
        chained = adjust.adjust(count, links, prior, R_first, job.parameters.adjust, first)
        used = [pair for pair, ok in zip(linked, chained.used, strict=True) if ok]
        found = _bundle(job, chained, used, lit, prior)
        arrays = {
            "R": found.poses.R_local_camera,
            "C": found.poses.C_local,
            "sigma_m": found.sigma_m,
            "covariance_xy_m2": found.covariance_xy_m2,
            "sigma_tilt_rad": found.sigma_tilt_rad,
            "pairs": np.array([[i, j] for i, j, _ in used], int).reshape(-1, 2),
            "turned": found.turned,
        }
        if found.residuals is not None:
            arrays |= {f"left_{name}": values for name, values in found.residuals._asdict().items()}
        return Made(arrays, {"status": found.status, "reprojection_px": found.reprojection_px})

    return once(job, STEP, VERSION, [str(count), *inputs], parameters, make)


def _links(job: Job, linked: Sequence[tuple[int, int, Done]]) -> list[Link]:
    names = "R", "t", "covariance"
    return [match.link(i, j, load(job, match.STEP, done.key, names)) for i, j, done in linked]


def would_change(
    job: Job, made: Done, later: Sequence[tuple[int, int, Done]], prior: NavigationPrior, range_m: float
) -> bool:
    """Whether pairs matched after an adjustment would change it; see `tasks.adjust.would_change`."""
    found = solution(job, made.key)
    links = _links(job, [pair for pair in later if pair[2].info["model"]])
    return adjust.would_change(links, found.poses, found.status, prior, _ELSEWHERE * range_m)


def _bundle(
    job: Job,
    chained: Adjusted,
    used: Sequence[tuple[int, int, Done]],
    lit: Mapping[int, Done],
    prior: NavigationPrior | None,
) -> Adjusted:
    camera, p = job.calibration.camera, job.parameters.adjust
    sights = tracks.thin(_sights(job, used), (camera.height, camera.width), p.tie_cells, p.tie_points_per_cell)
    arrays = {row: load(job, extract.STEP, done.key, ("laser_X", "laser_arm")).arrays for row, done in lit.items()}
    soundings = {row: own["laser_X"] for row, own in arrays.items()}
    lines = crossovers.lines({row: (own["laser_X"], own["laser_arm"]) for row, own in arrays.items()})
    return bundle.adjust(camera, chained, sights, soundings, lines, prior, p)


def _sights(job: Job, used: Sequence[tuple[int, int, Done]]) -> tracks.Sights:
    matches = []
    for i, j, done in used:
        arrays = load(job, match.STEP, done.key, ("features", "uv_i", "uv_j")).arrays
        matches.append(tracks.PairMatches(i, j, arrays["features"], arrays["uv_i"], arrays["uv_j"]))
    return tracks.join(matches)


def solution(job: Job, key: str) -> Solution:
    """The stored adjustment; not to be written to, for tiles one after the other share it."""
    return _solution(job.store, key)


@lru_cache(maxsize=2)
def _solution(store: Store, key: str) -> Solution:
    entry = read(store, STEP, key)
    arrays = entry.arrays
    poses = Poses(arrays["R"], arrays["C"])
    status, turned = entry.info["status"], arrays["turned"]
    left = [arrays[f"left_{name}"] for name in Residuals._fields if f"left_{name}" in arrays]
    return Solution(
        poses,
        arrays["sigma_m"],
        arrays["covariance_xy_m2"],
        arrays["sigma_tilt_rad"],
        status,
        arrays["pairs"],
        turned,
        entry.info["reprojection_px"],
        Residuals(*left) if left else None,
    )
