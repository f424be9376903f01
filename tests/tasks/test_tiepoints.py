import numpy as np
from seamosaic.schemas.calibration import Camera
from seamosaic.tasks import tiepoints
from seamosaic.tasks.camera import project

from tests.tasks import scenes

LENS = Camera(
    model="brown", width=1200, height=900, fx=1500, fy=1500, cx=599.5, cy=449.5, distortion=(-0.05, 0.02, 0, 0)
)


def _pixels(points, poses, k):
    return project(LENS, (points - poses.C_local[k]) @ poses.R_local_camera[k])


def _scene(noise_px, seed=0):
    rng = np.random.default_rng(seed)
    points, poses = scenes.seabed(0.2, size_m=2, count=800), scenes.cameras([[0, 0, 0], [0, 0.8, 0]], tilt_deg=1)
    uv = [_pixels(points, poses, k) + rng.normal(0, noise_px, (800, 2)) for k in (0, 1)]
    return points, poses, uv


def test_points_come_back_with_an_honest_sigma():
    points, poses, (uv_i, uv_j) = _scene(0.5)
    found = tiepoints.triangulate(LENS, uv_i, uv_j, poses, 0, 1)
    assert len(found.X_local) == len(points)
    error = found.X_local[:, 2] - points[:, 2]
    assert 0.001 < np.std(error) < 0.01
    assert 0.6 < np.std(error / found.sigma_m) < 1.4
    # a pixel along the baseline of 0.8 m, 3 m below
    assert 0.8 < np.median(found.metres_per_px) / (3**2 / 0.8 / LENS.fx) < 1.3


def test_rays_that_miss_each_other_are_left_out():
    points, poses, (uv_i, uv_j) = _scene(0.2)
    uv_j[:100, 0] += 30  # across the baseline: off the epipolar lines
    found = tiepoints.triangulate(LENS, uv_i, uv_j, poses, 0, 1)
    assert len(found.X_local) == len(points) - 100


def test_pixels_behind_a_port_are_those_in_water():
    port = {"distance": 0.035, "thickness": 0.012, "water_index": 1.34}
    lens = Camera.model_validate({**LENS.model_dump(), "model": "flat-port", "distortion": (), "port": port})
    points, poses, _ = _scene(0.0)
    seen = [(points - poses.C_local[k]) @ poses.R_local_camera[k] for k in (0, 1)]
    found = tiepoints.triangulate(lens, *(project(lens, X) for X in seen), poses, 0, 1)
    pinhole = tiepoints.triangulate(LENS, *(_pixels(points, poses, k) for k in (0, 1)), poses, 0, 1)
    assert len(found.X_local) == len(pinhole.X_local) == len(points)
    assert 0.98 < 1.34 * np.median(found.metres_per_px) / np.median(pinhole.metres_per_px) < 1.02


def test_no_depth_without_parallax():
    points, poses, (uv_i, uv_j) = _scene(0.0)
    near = poses._replace(C_local=np.array([[0, 0, 0], [0, 0.01, 0]]))
    uv_j = _pixels(points, near, 1)
    assert len(tiepoints.triangulate(LENS, uv_i, uv_j, near, 0, 1).X_local) == 0


def test_points_that_say_nothing_are_left_out():
    _, poses, (uv_i, uv_j) = _scene(0.2)
    found = tiepoints.triangulate(LENS, uv_i, uv_j, poses, 0, 1)
    assert len(tiepoints.certain(found, 0.3).X_local) == len(found.X_local) > 0
    assert len(tiepoints.certain(found, 60.0).X_local) == 0
