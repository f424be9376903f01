import numpy as np
import pytest
from seamosaic.tasks import camera as cameras
from seamosaic.tasks import colour

from tests.tasks.seabed import CAMERA, ground_points, pose


def test_thumbnail_is_the_mean_of_what_is_not_masked():
    image = np.full((480, 640, 3), 80, np.uint8)
    mask = np.zeros((480, 640), bool)
    image[:40, :40], image[100:120, 200] = 255, 200
    mask[:40, :40], mask[100:120, 200] = True, True
    small = colour.thumbnail(image, mask)
    assert small.shape == (*colour.THUMBNAIL, 3)
    assert np.isnan(small[0, 0]).all()
    assert np.isfinite(small[3:, 3:]).all()
    assert np.abs(small[np.isfinite(small)] - 80).max() < 1


def test_light_is_linear():
    assert colour.as_light(np.array([0.0, 127.5, 255.0]), 2.2) == pytest.approx([0, 0.5**2.2, 1])
    assert colour.as_light(np.array([51]), 1.0) == pytest.approx([0.2])


def distances(R, C, height, uv):
    """Distance (N,) of the ground at pixels of a camera."""
    X = ground_points(R, C, height).reshape(CAMERA.height, CAMERA.width, 3)
    u, v = np.rint(uv).astype(int).T
    return np.linalg.norm(X[v, u] - C, axis=1)


def middles():
    rows, columns = colour.THUMBNAIL
    u, v = (np.arange(n) * size / n + size / n / 2 - 0.5 for n, size in ((columns, 320), (rows, 240)))
    return np.column_stack([w.ravel() for w in np.meshgrid(u, v)])


def test_ranges_are_those_of_level_ground_under_a_leaning_camera():
    R, C = pose(0.1, -0.2, 0.0, 70, 6, -8)
    none = np.zeros((0, 2)), np.zeros((0, 3))
    found, exact = colour.ranges(CAMERA, -R[2], 3.0, *none)
    error = found.ravel() - distances(R, C, -3.0, middles())
    assert exact.all()
    assert 1e-6 < np.abs(error).max() < 0.02
    level = colour.ranges(CAMERA, np.array([0, 0, 1.0]), 3.0, *none)[0]
    assert np.abs(level.ravel() - distances(R, C, -3.0, middles())).max() > 0.1


def test_ranges_follow_the_laser():
    def step(x, y):
        return -3 + 0.1 * x + 0.3 * (x > 0.2)

    R, C = pose(0.0, 0.0, 0.0)
    uv = np.array([[k, 30 + 0.6 * k] for k in range(310)])
    direction = cameras.rays(CAMERA, uv).direction
    X = direction * distances(R, C, step, uv)[:, None]
    found, exact = colour.ranges(CAMERA, -R[2], 5.0, uv, X)
    error = (found.ravel() - distances(R, C, step, middles())).reshape(found.shape)
    assert 20 < exact.sum() < 90
    assert np.median(np.abs(error[exact])) < 0.02
    assert 0.02 < np.median(np.abs(error)) < 0.2  # elsewhere a plane: not as good, and not the 5 m that were believed
