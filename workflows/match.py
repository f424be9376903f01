"""Per pair: matches and the metric motion between two images (paper III.E)."""

import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..catalog.store import Entry
from ..tasks import camera, features, motion, pairs
from ..tasks.navigation import Poses, RelativePrior
from . import extract
from .job import Done, Job, Made, array_digest, code_version, load, once, stage

STEP = "match"
VERSION = code_version(sys.modules[__name__])


class PairTask(NamedTuple):
    """Two images to match, i < j, rows of the frames table; their poses so far, if any.

    poses : of these two images. range_m : height above the seabed where the laser does not tell.
    margin_m : how far the relative position may be wrong.
    """

    i: int
    j: int
    poses: Poses | None
    prior: RelativePrior | None
    range_m: float
    margin_m: float


def match_batch(job: Job, batch: Sequence[PairTask], extracted: Mapping[int, Done]) -> list[tuple[int, int, Done]]:
    """Match some pairs; `extracted` maps rows to their extraction."""
    cv2.setNumThreads(1)
    loaded: dict[int, Entry] = {}
    found = []
    for pair in batch:
        if any(extracted[row].info["status"] for row in (pair.i, pair.j)):
            found.append((pair.i, pair.j, Done(STEP, "", False, 0.0, {"model": "", "matches": 0, "inliers": 0})))
            continue
        for row in (pair.i, pair.j):
            if row not in loaded:
                loaded[row] = load(job, extract.STEP, extracted[row].key)
        keys = extracted[pair.i].key, extracted[pair.j].key
        found.append((pair.i, pair.j, _match(job, pair, keys, loaded[pair.i], loaded[pair.j])))
        loaded = {row: entry for row, entry in loaded.items() if row >= pair.i}
    return found


def _match(job: Job, pair: PairTask, keys: tuple[str, str], a: Entry, b: Entry) -> Done:
    known = [] if pair.poses is None else [array_digest(*pair.poses)]
    known += [] if pair.prior is None else [array_digest(*pair.prior)]
    parameters = [
        *stage(job.calibration.camera, job.parameters.match),
        round(pair.range_m, 6),
        round(pair.margin_m, 6),
    ]
    return once(job, STEP, VERSION, [*keys, *known], parameters, lambda: between(job, pair, a, b))


def between(job: Job, pair: PairTask, a: Entry, b: Entry) -> Made:
    """Motion between two extracted images; their laser may be left out, which leaves its length open."""
    lens, p = job.calibration.camera, job.parameters.match
    if "feature_uv" not in a.arrays or "feature_uv" not in b.arrays:
        return Made({}, {"model": "", "matches": 0, "inliers": 0})
    ranges = [range_m for range_m in (a.info["range_m"], b.info["range_m"]) if range_m]
    at = float(np.mean(ranges)) if ranges else pair.range_m
    index_a, index_b = _candidates(job, pair, a, b, at)
    matches = features.match(
        a.arrays["feature_descriptors"][index_a], b.arrays["feature_descriptors"][index_b], p.ratio
    )
    uv_a = a.arrays["feature_uv"][index_a[matches[:, 0]]].astype(float)
    uv_b = b.arrays["feature_uv"][index_b[matches[:, 1]]].astype(float)
    found = motion.estimate(
        camera.normalised(lens, uv_a, at),
        camera.normalised(lens, uv_b, at),
        a.arrays.get("laser_X", np.zeros((0, 3))),
        b.arrays.get("laser_X", np.zeros((0, 3))),
        at / camera.ground_sample_distance(lens, at),
        p,
        pair.prior,
    )
    if found is None:
        return Made({}, {"model": "", "matches": len(matches), "inliers": 0})
    return Made(
        {
            "R": found.R_i_j,
            "t": found.t_i_j,
            "covariance": found.covariance,
            "uv_i": uv_a[found.inliers].astype(np.float32),
            "uv_j": uv_b[found.inliers].astype(np.float32),
        },
        {
            "model": found.model,
            "metric": found.metric,
            "scale_sigma": found.scale_sigma if found.metric else None,
            "matches": len(matches),
            "inliers": len(found.inliers),
        },
    )


def _candidates(job: Job, pair: PairTask, a: Entry, b: Entry, range_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Features that the other image may see too: all of them where no poses are known."""
    counts = len(a.arrays["feature_uv"]), len(b.arrays["feature_uv"])
    if pair.poses is None:
        return np.arange(counts[0]), np.arange(counts[1])
    lens = job.calibration.camera
    seen = [
        pairs.seen_by(lens, entry.arrays["feature_uv"].astype(float), pair.poses, k, 1 - k, range_m, pair.margin_m)
        for k, entry in enumerate((a, b))
    ]
    return np.flatnonzero(seen[0]), np.flatnonzero(seen[1])


def link_motion(entry: Entry) -> motion.Motion:
    """A stored motion."""
    return motion.Motion(
        R_i_j=entry.arrays["R"],
        t_i_j=entry.arrays["t"],
        covariance=entry.arrays["covariance"],
        inliers=np.arange(entry.info["inliers"]),
        model=entry.info["model"],
        metric=entry.info["metric"],
        scale_sigma=entry.info["scale_sigma"] if entry.info["metric"] else float("nan"),
    )
