"""Time and memory of adjusting large surveys: `python benchmarks/poses_scale.py [IMAGES ...]`.

A made survey of parallel lines at 3 m, 0.9 m between images and 1.3 m between lines, with tie points, soundings,
pair motions and drifting navigation, goes through the pose graph and the bundle adjustment. What images measure is
made here, not detected: this is about the adjustment alone, in a process that has the environment of a run's workers.
"""

import itertools
import os
import resource
import sys
import time

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from seamosaic.schemas.calibration import Camera
from seamosaic.schemas.parameters import AdjustParameters
from seamosaic.tasks import adjust, bundle, crossovers
from seamosaic.tasks.adjust import Link
from seamosaic.tasks.camera import project
from seamosaic.tasks.motion import Motion
from seamosaic.tasks.navigation import NavigationPrior, Poses
from seamosaic.tasks.rotations import R_vehicle_camera
from seamosaic.tasks.tracks import Sights
from seamosaic.workflows.heap import WORKER_ENVIRONMENT

LENS = Camera(model="brown", width=1216, height=912, fx=1584, fy=1584, cx=607.5, cy=455.5)
HALF = np.array([0.38, 0.28]) * 3
DENSITY = 200  # tie points a square metre: 790 sights an image, as the parameters ask for
NOISE_PX = 0.3


def survey(count: int, rng: np.random.Generator) -> Poses:
    lines = max(2, round(np.sqrt(count / 4)))
    along = -(-count // lines)
    k = np.arange(count)
    line, step = k // along, k % along
    y = np.where(line % 2, along - 1 - step, step) * 0.9
    C = np.column_stack([line * 1.3, y, rng.normal(0, 0.05, count)])
    turned = np.where(line % 2, np.pi, 0)
    level = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_rotvec(np.outer(turned, [0, 0, 1])).as_matrix()
    return Poses(level @ Rotation.from_rotvec(rng.normal(0, np.radians(1), (count, 3))).as_matrix(), C)


def height(x, y):
    return -3 + 0.15 * np.sin(1.3 * x) * np.cos(1.1 * y) + 0.05 * np.sin(4 * x + y)


def sights(poses: Poses, rng: np.random.Generator) -> Sights:
    low, high = poses.C_local[:, :2].min(0) - 1, poses.C_local[:, :2].max(0) + 1
    xy = rng.uniform(low, high, (int(np.prod(high - low) * DENSITY), 2))
    X = np.column_stack([xy, height(*xy.T)])
    tree, parts = KDTree(xy), []
    for k, (R, C) in enumerate(zip(*poses, strict=True)):
        near = np.array(tree.query_ball_point(C[:2], 1.5), int)
        uv = project(LENS, (X[near] - C) @ R)
        inside = ((uv > 0) & (uv < [LENS.width - 1, LENS.height - 1])).all(1)
        parts.append((np.full(inside.sum(), k), near[inside], uv[inside] + rng.normal(0, NOISE_PX, (inside.sum(), 2))))
    image, track, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((image, track))
    every = Sights(image[order], np.unique(track[order], return_inverse=True)[1], uv[order])
    return every.take(np.ones(len(order), bool))


def soundings(poses: Poses, k: int, rng: np.random.Generator):
    t = np.linspace(-0.26, 0.26, 60)
    ray = np.concatenate([np.column_stack([t, s * t, np.ones(60)]) for s in (1, -1)])
    direction, C = ray @ poses.R_local_camera[k].T, poses.C_local[k]
    Z = np.full(len(ray), 3.0)
    for _ in range(15):
        ground = C + direction * Z[:, None]
        Z += (height(*ground[:, :2].T) - ground[:, 2]) / direction[:, 2]
    return ray * (Z + rng.normal(0, 0.001, len(Z)))[:, None]


def links(poses: Poses, rng: np.random.Generator) -> list[Link]:
    sigma_r, sigma_t = np.radians(0.1), 0.01
    covariance = np.diag([sigma_r] * 3 + [sigma_t] * 3) ** 2
    found = []
    for i, j in sorted(KDTree(poses.C_local[:, :2]).query_pairs(1.4)):
        R_i, R_j = poses.R_local_camera[[i, j]]
        R = R_i.T @ R_j @ Rotation.from_rotvec(rng.normal(0, sigma_r, 3)).as_matrix()
        t = R_i.T @ (poses.C_local[j] - poses.C_local[i]) + rng.normal(0, sigma_t, 3)
        found.append(Link(i, j, Motion(R, t, covariance, np.arange(100), "essential", True, 0.003)))
    return found


def navigation(poses: Poses, rng: np.random.Generator) -> NavigationPrior:
    count = len(poses.C_local)
    noise = np.column_stack([np.cumsum(rng.normal(0, 0.03, (count, 2)), 0), rng.normal(0, 0.03, count)])
    turned = Rotation.from_rotvec(np.radians(rng.normal(0, 0.27, (count, 3)))).as_matrix()
    return NavigationPrior(
        Poses(poses.R_local_camera @ turned, poses.C_local + noise),
        4.0 * np.arange(count),
        np.full(count, 0.4),
        np.full(count, 0.03),
        np.radians(np.tile([0.27, 0.27, 0.84], (count, 1))),
        0.02,
        R_vehicle_camera(0, 0, 0).T,
    )


def spread(off) -> float:
    """Rms distance (M, 3) from the mean."""
    return float(np.sqrt(((off - off.mean(0)) ** 2).sum(1).mean()))


def run(count: int) -> float:
    """Adjust a survey of `count` images; processor seconds."""
    rng, p = np.random.default_rng(count), AdjustParameters()
    true = survey(count, rng)
    seen, prior, linked = sights(true, rng), navigation(true, rng), links(true, rng)
    lit = {k: soundings(true, k, rng) for k in range(count)}
    lines = crossovers.lines({k: (X, np.repeat([0, 1], len(X) // 2)) for k, X in lit.items()})
    first, began = time.monotonic(), time.process_time()
    chained = adjust.adjust(count, linked, prior, true.R_local_camera[0], p)
    middle = time.process_time()
    found = bundle.adjust(LENS, chained, seen, lit, lines, prior, p)
    ended = time.process_time()
    rms = [spread(each.poses.C_local - true.C_local) for each in (chained, found)]
    wall = time.monotonic() - first
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{count} images, {len(seen.image)} sights, {seen.tie_points} tie points, {len(linked)} links: pose graph "
        f"{middle - began:.0f} core-s, bundle {ended - middle:.0f} core-s, {wall:.0f} s, peak {memory:.1f} GiB; "
        f"rms {rms[0] * 1e3:.1f} mm, then {rms[1] * 1e3:.1f} mm",
        flush=True,
    )
    return ended - began


if __name__ == "__main__":
    if not WORKER_ENVIRONMENT.keys() <= os.environ.keys():
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **WORKER_ENVIRONMENT})
    sizes = sorted(int(a) for a in sys.argv[1:]) or [1000, 10_000]  # the peak of memory is that of all so far
    seconds = [run(size) for size in sizes]
    for (n, before), (m, after) in itertools.pairwise(zip(sizes, seconds, strict=True)):
        print(f"from {n} to {m} images time grows as n^{np.log(after / before) / np.log(m / n):.2f}")
