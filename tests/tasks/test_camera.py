import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.schemas.calibration import Camera, Port
from seamosaic.tasks import camera

SIZE = {"width": 1216, "height": 912, "fx": 1583.9, "fy": 1584.7, "cx": 611.7, "cy": 450.8}
PORT = Port(distance=0.035, thickness=0.012, glass_index=1.49, water_index=1.34)
BROWN = Camera(model="brown", distortion=(-0.05, 0.02, 0.0004, -0.0003, 0.0), **SIZE)
FISHEYE = Camera(model="fisheye", distortion=(-0.05, 0.02, 0.004, -0.003), **SIZE)
FLAT_PORT = Camera(model="flat-port", port=PORT, **SIZE)
CAMERAS = [BROWN, FISHEYE, FLAT_PORT]


@pytest.mark.parametrize("lens", CAMERAS, ids=lambda lens: lens.model)
@given(u=st.floats(0, 1215), v=st.floats(0, 911), range_m=st.floats(0.5, 8))
@settings(deadline=None, max_examples=60)
def test_projecting_a_point_on_a_ray_gives_its_pixel(lens, u, v, range_m):
    origin, direction = camera.rays(lens, np.array([[u, v]]))
    np.testing.assert_allclose(camera.project(lens, origin + range_m * direction), [[u, v]], atol=1e-6)


def test_brown_is_opencvs():
    X = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 3.0]])
    K = camera.camera_matrix(BROWN)
    expected = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, np.array(BROWN.distortion))[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(BROWN, X), expected, atol=1e-9)


def test_flat_port_obeys_snell_at_both_faces():
    uv = np.array([[1200.0, 880.0]])
    slope = np.array([(1200 - SIZE["cx"]) / SIZE["fx"], (880 - SIZE["cy"]) / SIZE["fy"]])
    sine_air = np.hypot(*slope) / np.sqrt(1 + slope @ slope)
    origin, direction = camera.rays(FLAT_PORT, uv)
    assert abs(np.hypot(*direction[0, :2]) - sine_air / 1.34) < 1e-12
    glass = np.tan(np.arcsin(sine_air / 1.49)) * 0.012
    assert abs(np.hypot(*origin[0, :2]) - (np.hypot(*slope) * 0.035 + glass)) < 1e-12
    assert abs(origin[0, 2] - 0.047) < 1e-12


def test_what_is_behind_has_no_pixel():
    assert np.isnan(camera.project(BROWN, np.array([[0.0, 0, -1]]))).all()
    assert np.isnan(camera.project(FLAT_PORT, np.array([[0.0, 0, 0.04]]))).all()


def test_normalised_is_exact_at_its_range_for_a_flat_port():
    X = np.array([[0.6, -0.4, 3.0]])
    uv = camera.project(FLAT_PORT, X)
    np.testing.assert_allclose(camera.normalised(FLAT_PORT, uv, 3.0), X[:, :2] / 3.0, atol=1e-9)


def test_ground_sample_distance_and_outline():
    assert abs(camera.ground_sample_distance(BROWN, 3.0) - 3.0 / 1584.3) < 1e-6
    assert abs(camera.ground_sample_distance(FLAT_PORT, 3.0) * 1584.3 * 1.34 / 3.0 - 1) < 0.02
    assert abs(camera.focal_px(BROWN, 3.0) - 1584.3) < 1e-3
    for range_m in (1.0, 3.0, 10.0):
        assert 0 < abs(camera.focal_px(FLAT_PORT, range_m) / (1584.3 * 1.34) - 1) < 0.012
    border = camera.outline(BROWN, 3)
    assert border.shape == (8, 2)
    np.testing.assert_allclose(border[0], [0, 0])
    np.testing.assert_allclose(border[4], [1215, 911])


@pytest.mark.parametrize("lens", CAMERAS, ids=lambda lens: lens.model)
def test_no_points_are_fine(lens):
    assert camera.rays(lens, np.zeros((0, 2))).direction.shape == (0, 3)
    assert camera.project(lens, np.zeros((0, 3))).shape == (0, 2)
