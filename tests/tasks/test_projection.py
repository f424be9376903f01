import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera, Port
from seamosaic.tasks import camera as cameras
from seamosaic.tasks import projection

BROWN = Camera(
    model="brown", width=3648, height=2736, fx=4751.7, fy=4754.1, cx=1827.7, cy=1362.8,
    distortion=(-0.11, 0.05, 0.0006, -0.0004, 0.01),
)  # fmt: skip
FISHEYE = BROWN.model_copy(
    update={"model": "fisheye", "fx": 1900.0, "fy": 1901.0, "distortion": (-0.03, 0.01, 0.0, 0.0)}
)
PORT = BROWN.model_copy(
    update={"model": "flat-port", "fx": 3550.0, "fy": 3550.0, "port": Port(distance=0.05, thickness=0.012)}
)


@pytest.mark.parametrize(
    ("camera", "bound"), [(BROWN, 0.1), (FISHEYE, 0.2), (PORT, 0.1)], ids=["brown", "fisheye", "flat-port"]
)
def test_pixels_are_those_of_the_exact_projection(camera, bound):
    rng = np.random.default_rng(0)
    uv = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (20_000, 2))
    origin, direction = cameras.rays(camera, uv)
    points = origin + direction * rng.uniform(1.2, 8, (len(uv), 1))
    found = np.column_stack(projection.pixels(projection.departure(camera), *points.T))
    error = np.abs(found - uv)
    assert error.max() < bound
    assert error.max() > 1e-5  # a table, not the projection itself


def test_points_outside_of_the_image_stay_outside():
    # far out, brown's polynomial turns back into the image
    x = np.linspace(-3, 3, 601)
    u, _ = projection.pixels(projection.departure(BROWN), 2 * x, 0 * x, 0 * x + 2.0)
    inside = (u >= 0) & (u <= BROWN.width - 1)
    assert (np.abs(x[inside]) < 0.5).all()
    assert inside.sum() > 70


def test_look_up_is_bilinear_for_lists_of_any_length():
    image = np.arange(30, dtype=np.float32).reshape(5, 6)
    for count in (0, 1, 7, 512, 513):
        u, v = (np.linspace(0, top, count, dtype=np.float32) for top in (5, 4))
        np.testing.assert_allclose(projection.look_up(image, u, v), u + 6 * v, atol=0.12)
    outside = np.array([-3.0, 9.0], np.float32)
    np.testing.assert_array_equal(projection.look_up(image, outside, outside), [0, 29])
    assert np.isnan(projection.look_up(image, outside, outside, beyond=np.nan)).all()
