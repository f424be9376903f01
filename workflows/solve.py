"""Once per mission: all poses from the pair motions and navigation."""

import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..catalog.store import Entry
from ..tasks import adjust
from ..tasks.navigation import NavigationPrior, Poses
from . import match
from .job import Done, Job, Made, array_digest, code_version, load, once, stage

STEP = "adjust"
VERSION = code_version(sys.modules[__name__])


class Solution(NamedTuple):
    """What the adjustment stored: poses (n,), sigmas and status of the images, and the pairs that hold them.

    Attributes
    ----------
    poses, sigma_m, sigma_tilt_rad, status, turned : see `tasks.adjust.Adjusted`.
    pairs : (P, 2) rows of the linked pairs that were used.
    """

    poses: Poses
    sigma_m: np.ndarray
    sigma_tilt_rad: np.ndarray
    status: list[str]
    pairs: np.ndarray
    turned: np.ndarray


def adjust_all(
    job: Job, count: int, matched: Sequence[tuple[int, int, Done]], prior: NavigationPrior | None, R_first: np.ndarray
) -> Done:
    """Adjust `count` images; matched are the results of `match`."""
    linked = [(i, j, done) for i, j, done in matched if done.info["model"]]
    inputs = [f"{i}-{j}:{done.key}" for i, j, done in linked]
    if prior is not None:
        measured = (prior.time_s, prior.sigma_horizontal, prior.sigma_depth, prior.sigma_attitude)
        inputs.append(array_digest(*prior.poses, *measured))
    inputs.append(array_digest(R_first))

    def make() -> Made:
        links = [match.link(i, j, load(job, match.STEP, done.key)) for i, j, done in linked]
        found = adjust.adjust(count, links, prior, R_first, job.parameters.adjust)
        used = np.array([[link.i, link.j] for link, ok in zip(links, found.used, strict=True) if ok], int)
        arrays = {
            "R": found.poses.R_local_camera,
            "C": found.poses.C_local,
            "sigma_m": found.sigma_m,
            "sigma_tilt_rad": found.sigma_tilt_rad,
            "pairs": used.reshape(-1, 2),
            "turned": found.turned,
        }
        return Made(arrays, {"status": found.status})

    return once(job, STEP, VERSION, [str(count), *inputs], stage(job.parameters.adjust), make)


def solution(entry: Entry) -> Solution:
    """The stored adjustment."""
    arrays = entry.arrays
    poses = Poses(arrays["R"], arrays["C"])
    status, turned = entry.info["status"], arrays["turned"]
    return Solution(poses, arrays["sigma_m"], arrays["sigma_tilt_rad"], status, arrays["pairs"], turned)
