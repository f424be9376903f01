"""Whole surveys without images: what a detector and a matcher would give of a simulated scene, with its truth.

`python -m tests.tasks.surveys` prints how honest the stated sigmas are, and how good the poses, over many of them.
"""

import sys
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from seamosaic.schemas.parameters import AdjustParameters
from seamosaic.schemas.scene import SCENES, Scene
from seamosaic.tasks import adjust, bundle, crossovers, evaluation, tracks
from seamosaic.tasks import simulation_navigation as simulated
from seamosaic.tasks.adjust import Adjusted, Link
from seamosaic.tasks.camera import normalised, outline, project
from seamosaic.tasks.motion import Motion
from seamosaic.tasks.navigation import NavigationPrior, Poses
from seamosaic.tasks.rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera
from seamosaic.tasks.simulation_terrain import Terrain, height, make_terrain
from seamosaic.workflows.simulate import calibration_of

P = AdjustParameters()
DENSITY = 150  # features a square metre
NOISE_PX, SOUNDING_M = 0.3, 0.0009
TURN, STEP_M = np.radians(0.1), 0.01  # errors of pair motions


class Survey(NamedTuple):
    """What is measured in a survey, and where its cameras truly were."""

    scene: Scene
    true: Poses
    navigation: NavigationPrior
    soundings: dict
    arms: dict
    sights: tracks.Sights
    links: list
    roles: tuple


def survey(name: str, seed: int, **changes) -> Survey:
    scene = SCENES[name].model_copy(update=changes)
    calibration = calibration_of(scene)
    camera, altitude = calibration.camera, scene.survey.altitude_m
    streams = [np.random.default_rng([seed, k]) for k in range(5)]
    x, y = np.abs(normalised(camera, outline(camera, 3), altitude)).max(0)
    footprint = 2 * altitude * x, 2 * altitude * y
    ahead, aside, down = calibration.mount.translation
    z = altitude - scene.terrain.depth_m + down
    made = simulated.plan(scene.survey, scene.images, footprint, z, (ahead, aside), streams[0])
    placed = simulated.cameras(simulated.trajectory(made, made.image_time_s), calibration.mount)
    true = Poses(*placed)
    half = float(np.abs(true.C_local[:, :2]).max() + 1.0 * altitude + 0.5)
    terrain = make_terrain(scene.terrain, half, streams[1])
    lit = [k for k, role in enumerate(made.image_role) if role != "texture"]
    found = {k: cross(calibration, terrain, true, k, streams[2]) for k in lit}
    textured = [k for k, role in enumerate(made.image_role) if role != "laser"]
    if scene.texture.contrast < 0.05:
        textured = []
    return Survey(
        scene,
        true,
        navigation(scene, calibration.mount, made, streams[3]),
        {k: X for k, (X, _) in found.items()},
        {k: arm for k, (_, arm) in found.items()},
        sights(camera, terrain, true, textured, altitude, streams[4]),
        links(true, textured, altitude, streams[4]),
        made.image_role,
    )


def navigation(scene, mount, made, rng) -> NavigationPrior:
    """Navigation at the images' times, as a mission's is read."""
    times = simulated.sample_times(made, scene.navigation.rate_hz)
    said = simulated.measured(simulated.trajectory(made, times), scene.navigation, rng)
    at = made.image_time_s
    X = np.column_stack([np.interp(at, times, column) for column in said.X_local.T])
    attitude = [np.interp(at, times, np.unwrap(column, period=360)) for column in said.attitude_deg.T]
    R = R_LOCAL_LEVEL @ R_level_vehicle(*attitude)
    sigma, count = scene.navigation.sigma, len(at)
    return NavigationPrior(
        Poses(R @ R_vehicle_camera(*mount.rotation), X + R @ np.asarray(mount.translation)),
        at,
        np.full(count, sigma.horizontal),
        np.full(count, sigma.depth),
        np.radians(np.tile([sigma.roll, sigma.pitch, sigma.heading], (count, 1))),
        P.drift_m_per_sqrt_s,
        R_vehicle_camera(*mount.rotation).T,
    )


def cross(calibration, terrain: Terrain, poses: Poses, k: int, rng):
    """Soundings (L, 3) of image k, camera frame, and their arms: a point on each sheet in every row."""
    R, C, camera = poses.R_local_camera[k], poses.C_local[k], calibration.camera
    half = np.array([camera.width, camera.height]) / 2 / camera.fx
    y = np.linspace(-half[1], half[1], camera.height)
    parts = []
    for arm, sheet in enumerate(calibration.laser.sheets):
        n, Z = np.asarray(sheet.normal), np.full(len(y), 3.0)
        for _ in range(40):
            X = np.column_stack([(sheet.offset / Z - n[1] * y - n[2]) / n[0], y, np.ones(len(y))]) * Z[:, None]
            ground = X @ R.T + C
            off = ground[:, 2] - height(terrain, ground[:, 0], ground[:, 1])
            Z = np.clip(Z + 0.7 * off, 0.5, 8.0)
        good = (np.abs(off) < 1e-4) & (np.abs(X[:, 0] / X[:, 2]) < half[0])
        ray = X[good] / np.linalg.norm(X[good], axis=1, keepdims=True)
        parts.append((X[good] + ray * rng.normal(0, SOUNDING_M, (good.sum(), 1)), np.full(good.sum(), arm, np.uint8)))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def sights(camera, terrain: Terrain, poses: Poses, rows, altitude: float, rng) -> tracks.Sights:
    """Features that some images see, each found in four of five."""
    if not rows:
        return tracks.join([])
    low, high = poses.C_local[:, :2].min(0) - altitude, poses.C_local[:, :2].max(0) + altitude
    xy = rng.uniform(low, high, (int(np.prod(high - low) * DENSITY), 2))
    X, tree = np.column_stack([xy, height(terrain, *xy.T)]), KDTree(xy)
    parts = []
    for k in rows:
        near = np.array(tree.query_ball_point(poses.C_local[k, :2], 0.7 * altitude), int)
        uv = project(camera, (X[near] - poses.C_local[k]) @ poses.R_local_camera[k])
        seen = ((uv > 0) & (uv < [camera.width - 1, camera.height - 1])).all(1) & (rng.random(len(near)) < 0.8)
        parts.append((np.full(seen.sum(), k), near[seen], uv[seen] + rng.normal(0, NOISE_PX, (seen.sum(), 2))))
    image, track, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((image, track))
    every = tracks.Sights(image[order], np.unique(track[order], return_inverse=True)[1], uv[order])
    shape = camera.height, camera.width
    return tracks.thin(every.take(np.ones(len(order), bool)), shape, P.tie_cells, P.tie_points_per_cell)


def links(poses: Poses, rows, altitude: float, rng) -> list:
    """Motions of the pairs of images that overlap enough."""
    covariance, found = np.diag([TURN] * 3 + [STEP_M] * 3) ** 2, []
    for a, i in enumerate(rows):
        for j in rows[a + 1 :]:
            if np.linalg.norm(poses.C_local[i, :2] - poses.C_local[j, :2]) < 0.45 * altitude:
                R_i, R_j = poses.R_local_camera[[i, j]]
                R = R_i.T @ R_j @ Rotation.from_rotvec(rng.normal(0, TURN, 3)).as_matrix()
                t = R_i.T @ (poses.C_local[j] - poses.C_local[i]) + rng.normal(0, STEP_M, 3)
                found.append(Link(i, j, Motion(R, t, covariance, np.arange(100), "essential", True, 0.003)))
    return found


def adjusted(made: Survey) -> Adjusted:
    """All poses, as a run finds them."""
    camera = calibration_of(made.scene).camera
    first = made.true.R_local_camera[0]
    chained = adjust.adjust(len(made.true.C_local), made.links, made.navigation, first, P)
    lines = crossovers.lines({k: (X, made.arms[k]) for k, X in made.soundings.items()})
    return bundle.adjust(camera, chained, made.sights, made.soundings, lines, made.navigation, P)


def rigid_rms(poses: Poses, true: Poses) -> float:
    return evaluation.trajectory_errors(poses.C_local, true.C_local).rigid_rms_m


class Honesty(NamedTuple):
    """Root mean squares over surveys: error in sigmas along x, y, z; rigid rms, mm, by navigation and adjusted."""

    z: tuple[float, float, float]
    navigation_mm: float
    adjusted_mm: float
    worse: int


def honesty(name: str, seeds) -> Honesty:
    """Of many surveys of a scene; worse : how many are farther from the truth than their navigation."""
    z, rms = [], []
    for seed in seeds:
        made = survey(name, seed)
        found = adjusted(made)
        z.append(((found.poses.C_local - made.true.C_local) / found.sigma_m) ** 2)
        rms.append([rigid_rms(poses, made.true) for poses in (made.navigation.poses, found.poses)])
    x, y, up = np.sqrt(np.mean([one.mean(0) for one in z], axis=0)).tolist()
    before, after = 1e3 * np.sqrt(np.mean(np.square(rms), axis=0))
    return Honesty((x, y, up), float(before), float(after), sum(b > a for a, b in rms))


if __name__ == "__main__":
    names, number = sys.argv[2:] or ["reef", "sea", "night", "sand", "pairs"], int(sys.argv[1])
    for each in names:
        print(each, honesty(each, range(1000, 1000 + number)), flush=True)
